"""Foxglove's schemas and messages, where what outputs write does not reach."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from fusion import foxglove
from fusion.geometry import FisheyeCamera, PinholeCamera, pose
from fusion.messages.base import (
    CameraInfo,
    CompressedImage,
    Header,
    Message,
    PointField,
    Points,
    RawImage,
    Transforms,
)
from fusion.rig import Rig

HEADER = Header(1_700_000_000_123_456_789, "lidar")
KINDS: list[type[Any]] = [CompressedImage, RawImage, Points, CameraInfo, Transforms]
# As Foxglove documents PackedElementField: UINT8 1, INT8 2, UINT16 3, INT16 4, UINT32 5, INT32 6, FLOAT32 7,
# 64 8.
TYPES = {"u1": 1, "i1": 2, "u2": 3, "i2": 4, "u4": 5, "i4": 6, "f4": 7, "f8": 8}

# Fields and their numbers, as published.
NUMBERS = {
    "Vector3": "x 1, y 2, z 3",
    "Quaternion": "x 1, y 2, z 3, w 4",
    "Pose": "position 1, orientation 2",
    "CompressedImage": "timestamp 1, data 2, format 3, frame_id 4",
    "RawImage": "timestamp 1, width 2, height 3, encoding 4, step 5, data 6, frame_id 7",
    "PackedElementField": "name 1, offset 2, type 3",
    "PointCloud": "timestamp 1, frame_id 2, pose 3, point_stride 4, fields 5, data 6",
    "CameraCalibration": (
        "timestamp 1, width 2, height 3, distortion_model 4, D 5, K 6, R 7, P 8, frame_id 9"
    ),
    "FrameTransform": "timestamp 1, parent_frame_id 2, child_frame_id 3, translation 4, rotation 5",
    "FrameTransforms": "transforms 1",
}


def decoded(message: Message) -> Any:
    name = foxglove.schema_name(type(message))
    schema = Schema(id=1, name=name, encoding="protobuf", data=foxglove.protobuf_schema(name))
    decode = DecoderFactory().decoder_for("protobuf", schema)
    assert decode is not None
    return decode(foxglove.protobuf_bytes(message))


def points(fields: tuple[PointField, ...], **changes: Any) -> Points:
    values: dict[str, Any] = {"width": 2, "height": 1, "point_step": 8, "row_step": 16, "data": bytes(16)}
    return Points(HEADER, fields=fields, **(values | changes))


@pytest.mark.parametrize("word", TYPES)
def test_types_of_fields_have_foxgloves_numbers_in_both_wires(word: str) -> None:
    message = points((PointField("value", 0, np.dtype(f"<{word}")),))
    assert decoded(message).fields[0].type == TYPES[word]
    assert json.loads(foxglove.json_bytes(message))["fields"][0]["type"] == TYPES[word]


@pytest.mark.parametrize(
    "message",
    [
        points((PointField("value", 0, np.dtype(">f4")),)),
        points((PointField("value", 0, np.dtype("<i8")),)),
        points((PointField("value", 0, np.dtype("<f4"), 3),)),
        points((), height=2, row_step=20, data=bytes(40)),
        RawImage(HEADER, 2, 1, "mono16", True, 4, bytes(4)),
    ],
)
def test_what_foxglove_has_no_place_for_is_refused(message: Message) -> None:
    for write in (foxglove.protobuf_bytes, foxglove.json_bytes):
        with pytest.raises(ValueError, match="Foxglove's"):
            write(message)


def test_a_cloud_may_stand_elsewhere_in_its_frame() -> None:
    R = Rotation.from_euler("xyz", [0.3, -0.5, 1.2])
    found = decoded(points((), T_frame_points=pose(R.as_matrix(), [1, -2, 3.5]))).pose
    q, p = found.orientation, found.position
    np.testing.assert_allclose(
        (Rotation.from_quat([q.x, q.y, q.z, q.w]) * R.inv()).magnitude(), 0, atol=1e-12
    )
    assert (p.x, p.y, p.z) == (1, -2, 3.5)


def test_without_a_stamp_there_is_no_time() -> None:
    message = CompressedImage(Header(), "jpeg", memoryview(b"abc"))
    assert not decoded(message).HasField("timestamp")
    assert json.loads(foxglove.json_bytes(message))["timestamp"] == {"sec": 0, "nsec": 0}
    assert decoded(message).data == b"abc"


@pytest.mark.parametrize("kind", KINDS)
def test_a_schema_is_complete(kind: type[Message]) -> None:
    name = foxglove.schema_name(kind)
    files = FileDescriptorSet.FromString(foxglove.protobuf_schema(name)).file
    known: set[str] = set()
    for file in files:  # what a file builds on stands before it
        assert set(file.dependency) <= known
        known.add(file.name)
    fields = {
        field.name
        for file in files
        for message in file.message_type
        for field in message.field
        if f"foxglove.{message.name}" == name
    }
    schema = json.loads(foxglove.json_schema(name))
    assert schema["title"] == name
    assert set(schema["properties"]) == fields


def test_fields_have_the_published_numbers() -> None:
    found = {}
    for kind in KINDS:
        for file in FileDescriptorSet.FromString(foxglove.protobuf_schema(foxglove.schema_name(kind))).file:
            if file.package == "foxglove":
                fields = sorted(file.message_type[0].field, key=lambda field: field.number)
                found[file.message_type[0].name] = ", ".join(f"{f.name} {f.number}" for f in fields)
    assert found == NUMBERS


@pytest.mark.parametrize(
    ("camera", "model", "D"),
    [
        (PinholeCamera((4, 3), 2, 3, 1, 1), "plumb_bob", (0,) * 5),
        (PinholeCamera((4, 3), 2, 3, 1, 1, (1, 2, 3, 4)), "plumb_bob", (1, 2, 3, 4, 0)),
        (PinholeCamera((4, 3), 2, 3, 1, 1, (1, 2, 3, 4, 5)), "plumb_bob", (1, 2, 3, 4, 5)),
        (PinholeCamera((4, 3), 2, 3, 1, 1, (*range(8),)), "rational_polynomial", (*range(8),)),
        (FisheyeCamera((4, 3), 2, 3, 1, 1), "kannala_brandt", (0,) * 4),
        (FisheyeCamera((4, 3), 2, 3, 1, 1, (1, 2, 3, 4)), "kannala_brandt", (1, 2, 3, 4)),
    ],
)
def test_cameras_as_calibrations(
    camera: PinholeCamera | FisheyeCamera, model: str, D: tuple[float, ...]
) -> None:
    info = foxglove.calibration_of(camera, HEADER)
    assert info is not None
    found = decoded(info)
    assert (found.distortion_model, tuple(found.D)) == (model, D)
    assert (found.width, found.height, list(found.K)) == (4, 3, [2, 0, 1, 0, 3, 1, 0, 0, 1])


def test_only_what_the_rig_links_is_told() -> None:
    T = pose(translation_m=(1, 2, 3))
    rig = Rig({}, {"T_lidar_rgb": T, "T_imu_lidar": T, "T_gps_base": T})
    found = foxglove.transforms_of(rig, 5)
    assert [(one.parent, one.child) for one in found.transforms] == [("rgb", "imu"), ("rgb", "lidar")]
    np.testing.assert_allclose(found.transforms[0].T_parent_child[:3, 3], (-2, -4, -6))


def test_pictures_lose_nothing_on_the_way() -> None:
    strided = np.arange(24, dtype=">u2").reshape(4, 6)[:, ::2]
    image = foxglove.raw_image(HEADER, "mono16", strided)
    assert (image.width, image.height, image.step) == (3, 4, 6)
    np.testing.assert_array_equal(np.frombuffer(image.data, "<u2").reshape(4, 3), strided)
