"""foxglove's types in protobuf and JSON, against google.protobuf's own classes and mcap-protobuf-support."""

from __future__ import annotations

import base64
import io
import json
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from google.protobuf import json_format
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from mcap_protobuf.writer import Writer

from fusion.errors import FrameError, InputError
from fusion.messages import reader_of
from fusion.messages.base import CameraInfo, CompressedImage, Header, Points, RawImage, Transforms
from fusion.messages.jsons import MAX_JSON
from fusion.recordings.base import Schema, Topic
from tests.messages.samples import NSEC, SEC, STAMP_NS, descriptors, foxglove, foxglove_topic

WIRES = pytest.mark.parametrize("wire", ["protobuf", "json"])
HEADER = Header(STAMP_NS, "camera")
QUARTER = {"z": 2.0, "w": 2.0}


def sent(wire: str, message: Any) -> bytes:
    if wire == "protobuf":
        return message.SerializeToString()
    options = {"preserving_proto_field_name": True, "always_print_fields_with_no_presence": True}
    values = json_format.MessageToDict(message, use_integers_for_enums=True, **options)  # type: ignore[arg-type]
    return json.dumps(stamped(values)).encode()


def stamped(values: Any) -> Any:
    """protobuf's JSON writes times as text; foxglove's schema wants numbers."""
    if isinstance(values, dict):
        stamp = {"sec": SEC, "nsec": NSEC}
        return {key: stamp if key == "timestamp" else stamped(value) for key, value in values.items()}
    return [stamped(each) for each in values] if isinstance(values, list) else values


SAMPLES: dict[str, Any] = {
    "RawImage": foxglove(
        "RawImage", frame_id="camera", width=3, height=2, encoding="mono16", step=6, data=bytes(range(12))
    ),
    "CompressedImage": foxglove("CompressedImage", frame_id="camera", format="webp", data=b"RIFF\0\xff"),
    "PointCloud": foxglove(
        "PointCloud",
        frame_id="camera",
        point_stride=9,
        fields=[
            {"name": name, "offset": offset, "type": kind}
            for name, offset, kind in (("x", 0, 7), ("i", 4, 3), ("t", 6, 4), ("b", 8, 2))
        ],
        data=bytes(range(27)),
        pose={"position": {"x": 1.0}, "orientation": QUARTER},
    ),
    "CameraCalibration": foxglove(
        "CameraCalibration",
        frame_id="camera",
        width=640,
        height=512,
        distortion_model="plumb_bob",
        D=[0.1, 0, 0, 0, 0.5],
        K=range(9),
        R=range(9, 18),
        P=range(12),
    ),
    "FrameTransform": foxglove(
        "FrameTransform",
        parent_frame_id="camera",
        child_frame_id="lidar",
        translation={"x": 1.0, "z": -3.0},
        rotation=QUARTER,
    ),
}
SAMPLES["FrameTransforms"] = foxglove("FrameTransforms", transforms=[SAMPLES["FrameTransform"]] * 2)


def read(wire: str, name: str) -> Any:
    data = sent(wire, SAMPLES[name])
    reader = reader_of(foxglove_topic(name, wire))
    message = reader.message(data)
    assert type(message) is reader.kind
    assert reader.header(data) == message.header == HEADER
    return message


@WIRES
def test_raw_images(wire: str) -> None:
    image = read(wire, "RawImage")
    assert isinstance(image, RawImage)
    assert (image.width, image.height, image.encoding, image.step) == (3, 2, "mono16", 6)
    assert not image.big_endian
    assert bytes(image.data) == bytes(range(12))


def test_an_images_data_is_a_view() -> None:
    data = sent("protobuf", SAMPLES["RawImage"])
    image = reader_of(foxglove_topic("RawImage")).message(data)
    assert isinstance(image, RawImage)
    assert isinstance(image.data, memoryview)
    assert image.data.obj is data


@WIRES
def test_compressed_images(wire: str) -> None:
    image = read(wire, "CompressedImage")
    assert isinstance(image, CompressedImage)
    assert (image.format, bytes(image.data)) == ("webp", b"RIFF\0\xff")


@WIRES
def test_points_have_foxgloves_numbers_of_types(wire: str) -> None:
    """3 is uint16 here and int16 in ROS."""
    points = read(wire, "PointCloud")
    assert isinstance(points, Points)
    assert (points.width, points.height, points.point_step, points.row_step) == (3, 1, 9, 27)
    kinds = [(field.name, field.offset, field.dtype.str, field.count) for field in points.fields]
    assert kinds == [("x", 0, "<f4", 1), ("i", 4, "<u2", 1), ("t", 6, "<i2", 1), ("b", 8, "|i1", 1)]
    assert points.T_frame_points is not None
    assert np.allclose(points.T_frame_points, [[0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


@WIRES
def test_points_without_a_pose_have_none(wire: str) -> None:
    for pose in ({}, {"orientation": {"w": 1.0}}):
        data = sent(wire, foxglove("PointCloud", point_stride=4, data=bytes(8), pose=pose))
        points = reader_of(foxglove_topic("PointCloud", wire)).message(data)
        assert isinstance(points, Points)
        assert points.T_frame_points is None


@WIRES
@pytest.mark.parametrize("values", [{"point_stride": 0, "data": b"a"}, {"point_stride": 4, "data": bytes(7)}])
def test_points_that_do_not_fit_are_refused(wire: str, values: dict[str, Any]) -> None:
    with pytest.raises(FrameError, match="bytes are not points of"):
        reader_of(foxglove_topic("PointCloud", wire)).message(sent(wire, foxglove("PointCloud", **values)))


@WIRES
def test_calibrations(wire: str) -> None:
    info = read(wire, "CameraCalibration")
    assert isinstance(info, CameraInfo)
    assert (info.width, info.height, info.model, info.D) == (640, 512, "plumb_bob", (0.1, 0, 0, 0, 0.5))
    assert info.K.ravel().tolist() == [*range(9)]
    assert info.R.ravel().tolist() == [*range(9, 18)]
    assert info.P.ravel().tolist() == [*range(12)]


@WIRES
@pytest.mark.parametrize("name", ["FrameTransform", "FrameTransforms"])
def test_transforms(wire: str, name: str) -> None:
    message = read(wire, name)
    assert isinstance(message, Transforms)
    assert len(message.transforms) == (2 if name.endswith("s") else 1)
    last = message.transforms[-1]
    assert (last.stamp_ns, last.parent, last.child) == (STAMP_NS, "camera", "lidar")
    assert np.allclose(last.T_parent_child, [[0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, -3], [0, 0, 0, 1]])


@WIRES
def test_types_that_are_not_used(wire: str) -> None:
    grid = reader_of(foxglove_topic("Grid", wire))
    assert grid.kind is None
    assert grid.header(sent(wire, foxglove("Grid", frame_id="camera", data=b"abc"))) == HEADER
    log = reader_of(foxglove_topic("Log", wire))
    assert log.kind is None
    assert log.header(sent(wire, foxglove("Log", message="hello"))) == Header()
    with pytest.raises(FrameError, match="not read"):
        log.message(b"")


def test_what_mcaps_own_writer_wrote() -> None:
    """The schema and the bytes as others write them, against their decoder's values."""
    file = io.BytesIO()
    with Writer(file) as writer:
        for k, (name, message) in enumerate(SAMPLES.items()):
            writer.write_message(f"/{name}", message, log_time=k)
    found = list(
        make_reader(io.BytesIO(file.getvalue()), decoder_factories=[DecoderFactory()]).iter_decoded_messages()
    )
    assert len(found) == len(SAMPLES)
    for schema, channel, raw, decoded in found:
        assert schema is not None
        there = Topic("/a", Schema(schema.name, schema.encoding, schema.data), channel.message_encoding)
        message = reader_of(there).message(raw.data)
        assert bytes(getattr(message, "data", b"")) == getattr(decoded, "data", b"")
        if isinstance(message, RawImage):
            assert (message.width, message.encoding) == (decoded.width, decoded.encoding)


@pytest.mark.parametrize(
    ("stamp", "expected"),
    [
        ({"sec": 0, "nsec": 0}, None),
        ({"sec": 1, "nsec": 5}, 1_000_000_005),
        ({"sec": -1, "nsec": 0}, "cannot be: -1 s"),
        ({"sec": 1, "nsec": 10**9}, "cannot be"),
        ({"sec": 10**12, "nsec": 0}, "cannot be"),
        ({"sec": 10**300, "nsec": 0}, "cannot be"),
        ({"sec": float("nan"), "nsec": 0}, "timestamp.sec is of the type float, not a whole number"),
        ({"sec": True, "nsec": 0}, "of the type bool"),
        ({"sec": "1", "nsec": 0}, "of the type str"),
        ("now", "timestamp is no object"),
    ],
)
def test_stamps_in_json(stamp: Any, expected: Any) -> None:
    reader = reader_of(foxglove_topic("CompressedImage", "json"))
    data = json.dumps({"timestamp": stamp, "frame_id": "a", "data": "", "format": "png"}).encode()
    if isinstance(expected, str):
        for method in (reader.header, reader.message):
            with pytest.raises(FrameError) as raised:
                method(data)
            assert expected in str(raised.value)
            assert raised.value.where == "/sensor"
    else:
        assert reader.header(data).stamp_ns == expected


@pytest.mark.parametrize(("sec", "nsec"), [(-1, 0), (0, -1), (0, 10**9), (2**62, 0)])
def test_stamps_in_protobuf(sec: int, nsec: int) -> None:
    message = foxglove("CompressedImage", timestamp={"seconds": sec, "nanos": nsec})
    with pytest.raises(FrameError, match=f"/sensor: its stamp cannot be: {sec} s, {nsec} ns"):
        reader_of(foxglove_topic("CompressedImage")).header(message.SerializeToString())


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"[]",
        b"{",
        b"\xff\xfe",
        b'{"data": 5}',
        b'{"data": "a"}',
        b'{"data": "??=="}',
        b'{"data": "\xc3\xa4"}',
        b'{"data": ["YQ=="]}',
        b'{"timestamp": {"sec": ' + b"9" * 5000 + b"}}",
        b"[" * 100_000,
        b'{"a":' * 100_000,
    ],
)
def test_what_is_no_json_message_is_refused(data: bytes) -> None:
    with pytest.raises(FrameError):
        reader_of(foxglove_topic("CompressedImage", "json")).message(data)


def test_more_of_what_json_may_hold() -> None:
    camera = reader_of(foxglove_topic("CameraCalibration", "json"))
    for numbers in ([10**400], ["1"], [None, True], {}, "1", [1] * 5):
        with pytest.raises(FrameError):
            camera.message(json.dumps({"K": numbers}).encode())
    with pytest.raises(FrameError, match="more than"):
        camera.header(b" " * (MAX_JSON + 1))
    image = reader_of(foxglove_topic("CompressedImage", "json"))
    data = json.dumps({"data": base64.b64encode(b"abc").decode(), "format": None}).encode()
    assert image.message(data) == CompressedImage(Header(), "", b"abc")


@pytest.mark.parametrize(
    ("there", "words"),
    [
        (Topic("/a", Schema("foxglove.RawImage"), "protobuf"), "the form '', not 'protobuf'"),
        (Topic("/a", Schema("foxglove.RawImage", "protobuf", b"\xff\xff"), "protobuf"), "no set of"),
        (Topic("/a", Schema("foxglove.Other", "protobuf", descriptors()), "protobuf"), "not define"),
        (
            Topic("/a", Schema("foxglove.RawImage", "protobuf", b""), "protobuf"),
            "does not define foxglove.RawImage",
        ),
        (Topic("/a", Schema("foxglove.RawImage", "protobuf", bytes(1 << 21)), "protobuf"), "more than"),
        (
            Topic("/a", Schema("foxglove.RawImage", "protobuf"), "json"),
            "the form 'protobuf', not 'jsonschema'",
        ),
        (
            Topic(
                "/a",
                Schema("foxglove.RawImage", "protobuf", descriptors().replace(b"step", b"stop")),
                "protobuf",
            ),
            "no field step",
        ),
    ],
)
def test_schemas_that_cannot_be_used(there: Topic, words: str) -> None:
    with pytest.raises(InputError) as raised:
        reader_of(there)
    assert words in str(raised.value)
    assert f"/a: topic of type {there.schema.name}, encoding {there.encoding}" in str(raised.value)


def test_repeated_fields_are_bounded() -> None:
    """Two bytes each on the wire; many times as much as objects."""
    with pytest.raises(FrameError, match="more than 16,384 transforms"):
        reader_of(foxglove_topic("FrameTransforms")).message(b"\x0a\x00" * 17_000)
    with pytest.raises(FrameError, match="more than 262,144 fields"):
        reader_of(foxglove_topic("RawImage")).message(b"\x78\x00" * 263_000)
    with pytest.raises(FrameError, match="bytes of D"):
        reader_of(foxglove_topic("CameraCalibration")).message(b"\x2a\xc0\xbb\x78" + bytes(1_973_696))


@pytest.mark.parametrize("name", SAMPLES)
def test_every_cut_is_a_message_or_a_frame_error(name: str) -> None:
    """A cut between fields is a shorter message: whatever is read then, google.protobuf reads too."""
    data, reader = sent("protobuf", SAMPLES[name]), reader_of(foxglove_topic(name))
    whole = 0
    for end in range(len(data)):
        try:
            reader.message(data[:end])
        except FrameError:
            continue
        type(SAMPLES[name]).FromString(data[:end])
        whole += 1
    assert whole < 12


@pytest.mark.parametrize("wire", ["protobuf", "json"])
@pytest.mark.parametrize("name", SAMPLES)
@settings(max_examples=30)
@given(st.data())
def test_changed_bytes_give_a_message_or_a_frame_error(wire: str, name: str, data: st.DataObject) -> None:
    message = bytearray(sent(wire, SAMPLES[name]))
    for _ in range(data.draw(st.integers(1, 4))):
        message[data.draw(st.integers(0, len(message) - 1))] = data.draw(st.integers(0, 255))
    reader = reader_of(foxglove_topic(name, wire))
    for method in (reader.message, reader.header):
        with suppress(FrameError):
            method(bytes(message))
