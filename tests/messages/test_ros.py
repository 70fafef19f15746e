"""ROS's wires against rosbags' own serialisers and readers, other layouts, and bytes that are no messages."""

from __future__ import annotations

import re
import struct
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros1.writer import Writer as Ros1Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from fusion.errors import FrameError, InputError
from fusion.messages import reader_of
from fusion.messages.base import CameraInfo, CompressedImage, Header, Points, RawImage, Transforms
from fusion.recordings.base import Schema, Topic
from tests.messages import samples
from tests.messages.samples import NSEC, SEC, STAMP_NS, WIRES, made, sent, store, topic

HEADER = Header(STAMP_NS, "camera")
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
POINTS, INFO = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/CameraInfo"
TF, STAMPED = "tf2_msgs/msg/TFMessage", "geometry_msgs/msg/TransformStamped"
DEFINED = pytest.mark.parametrize("defined", [True, False], ids=["embedded", "standard"])
EVERY_WIRE = pytest.mark.parametrize("wire", WIRES)


@EVERY_WIRE
@DEFINED
def test_images(wire: str, defined: bool) -> None:
    data = sent(wire, samples.image(wire, bytes(range(24)), 3, 4, "bgr8", 6, big=True))
    reader = reader_of(topic(wire, IMAGE, defined=defined))
    image = reader.message(data)
    assert reader.kind is RawImage
    assert isinstance(image, RawImage)
    assert (image.header, reader.header(data)) == (HEADER, HEADER)
    assert (image.width, image.height, image.encoding, image.big_endian, image.step) == (
        3,
        4,
        "bgr8",
        True,
        6,
    )
    assert bytes(image.data) == bytes(range(24))


@EVERY_WIRE
@DEFINED
def test_an_images_data_is_a_view(wire: str, defined: bool) -> None:
    data = sent(wire, samples.image(wire, bytes(100), 10, 10, "mono8", 10))
    image = reader_of(topic(wire, IMAGE, defined=defined)).message(data)
    assert isinstance(image, RawImage)
    assert isinstance(image.data, memoryview)
    assert image.data.obj is data  # no copy
    view = reader_of(topic(wire, IMAGE)).message(memoryview(bytearray(data)))
    assert isinstance(view, RawImage)
    assert bytes(view.data) == bytes(100)


@EVERY_WIRE
@DEFINED
def test_compressed_images(wire: str, defined: bool) -> None:
    data = sent(wire, samples.compressed(wire, b"\xff\xd8abc", "bgr8; jpeg compressed bgr8"))
    message = reader_of(topic(wire, COMPRESSED, defined=defined)).message(data)
    assert isinstance(message, CompressedImage)
    assert (message.header, message.format) == (HEADER, "bgr8; jpeg compressed bgr8")
    assert bytes(message.data) == b"\xff\xd8abc"


@EVERY_WIRE
@DEFINED
@pytest.mark.parametrize("big", [False, True])
def test_points(wire: str, defined: bool, big: bool) -> None:
    order = ">" if big else "<"
    kinds = [("x", "f4"), ("y", "f4"), ("z", "f8"), ("i", "u1"), ("n", "i2", (3,))]
    dtype = np.dtype([(name, order + kind, *shape) for name, kind, *shape in kinds])
    array = np.zeros((2, 5), dtype)
    array["x"] = np.arange(10).reshape(2, 5)
    data = sent(wire, samples.cloud(wire, array, big=big))
    points = reader_of(topic(wire, POINTS, defined=defined)).message(data)
    assert isinstance(points, Points)
    assert points.header == HEADER
    assert (points.width, points.height, points.point_step) == (5, 2, dtype.itemsize)
    assert [(f.name, f.count) for f in points.fields] == [("x", 1), ("y", 1), ("z", 1), ("i", 1), ("n", 3)]
    assert [f.dtype for f in points.fields] == [np.dtype(order + kind) for _, kind, *_ in kinds]
    assert bytes(points.data) == array.tobytes()


@EVERY_WIRE
@DEFINED
@pytest.mark.parametrize("D", [[], [0.1, -0.2, 0.001, 0.002, 0.5], [float(k) for k in range(8)]])
def test_camera_infos(wire: str, defined: bool, D: list[float]) -> None:
    K = [500.0, 0, 320, 0, 501, 256, 0, 0, 1]
    data = sent(wire, samples.camera_info(wire, "plumb_bob", D, K))
    info = reader_of(topic(wire, INFO, defined=defined)).message(data)
    assert isinstance(info, CameraInfo)
    assert (info.width, info.height, info.model) == (640, 512, "plumb_bob")
    assert tuple(D) == info.D
    assert info.K.ravel().tolist() == K
    assert np.array_equal(info.R, np.eye(3))
    assert info.P.ravel().tolist() == [*range(12)]


@EVERY_WIRE
@DEFINED
def test_transforms(wire: str, defined: bool) -> None:
    root = np.sqrt(0.5)
    moves = [samples.stamped(wire, "a", (1, 2, 3), (0, 0, 2 * root, 2 * root))]
    moves += [samples.stamped(wire, "longer", (4, 5, 6), (0, 0, 0, 1))]
    data = sent(wire, made(wire, "tf2_msgs/TFMessage", transforms=moves))
    reader = reader_of(topic(wire, TF, defined=defined))
    message = reader.message(data)
    assert isinstance(message, Transforms)
    assert reader.header(data) == message.header == HEADER
    first, second = message.transforms
    quarter_turn = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    assert np.allclose(first.T_parent_child, quarter_turn, atol=1e-15)
    assert (first.stamp_ns, first.parent, first.child, second.child) == (STAMP_NS, "camera", "a", "longer")
    assert second.T_parent_child[:3, 3].tolist() == [4, 5, 6]
    alone = reader_of(topic(wire, STAMPED, defined=defined)).message(sent(wire, moves[0]))
    assert isinstance(alone, Transforms)
    assert np.array_equal(alone.transforms[0].T_parent_child, first.T_parent_child)
    empty = sent(wire, made(wire, "tf2_msgs/TFMessage", transforms=[]))
    assert reader.header(empty) == Header()
    assert reader.message(empty) == Transforms(())


@EVERY_WIRE
@DEFINED
@pytest.mark.parametrize("n", [0, 1, 3, 10])
@pytest.mark.parametrize("frame_id", ["a", "lidar"])  # 4 and 0 modulo 8 where the points begin
def test_livox_points(wire: str, defined: bool, n: int, frame_id: str) -> None:
    values = [(1000 * k, k + 0.5, -k, 2 * k, 10 + k, k % 3, k % 6) for k in range(n)]
    names = ("offset_time", "x", "y", "z", "reflectivity", "tag", "line")
    point = "livox_ros_driver2/CustomPoint"
    points = [made(wire, point, **dict(zip(names, value, strict=True))) for value in values]
    header = samples.header(wire, frame_id=frame_id)
    rest = {"timebase": 5, "point_num": n, "lidar_id": 1, "rsvd": np.zeros(3, np.uint8)}
    data = sent(wire, made(wire, samples.LIVOX, header=header, points=points, **rest))
    message = reader_of(topic(wire, samples.LIVOX, defined=defined)).message(data)
    assert isinstance(message, Points)
    assert (message.width, message.height) == (n, 1)
    assert message.point_step == (19 if wire == "ros1" else 20)
    named = ("offset_time", "x", "y", "z", "intensity", "tag", "ring")
    assert [field.name for field in message.fields] == [*named]
    for k, value in enumerate(values):
        at = [message.data[k * message.point_step + f.offset :] for f in message.fields]
        got = [
            np.frombuffer(b[: f.dtype.itemsize], f.dtype)[0] for b, f in zip(at, message.fields, strict=True)
        ]
        assert tuple(got) == value


# --- other definitions than the usual

OWN = """# ours
uint8 KIND=3
string TEXT = a # b = c
Note[] notes           # skipped, item by item
float64[] curve
string[] words
bool[2] flags
Pair[2] pairs
Header header
uint8[] data
uint64 step
string<=20 encoding
time other
uint8 is_bigendian 1
uint16 width
int32 height
float32 after
===
MSG: own_msgs/Note
string text
int16[<=4] numbers
===
MSG: own_msgs/Pair
uint8 a
float64 b
===
MSG: std_msgs/Header
{seq}{stamp}
string frame_id
"""


def own_message(wire: str) -> tuple[Topic, bytes]:
    """A type of other name, order and fields than sensor_msgs/Image, which has all that an image needs."""
    ros = samples.ros_of(wire)
    seq, stamp = ("uint32 seq\n", "time stamp") if ros == 1 else ("", "builtin_interfaces/Time stamp")
    text = OWN.replace("{seq}", seq).replace("{stamp}", stamp)
    if ros == 2:
        text = text.replace("time other", "builtin_interfaces/Time other")
    name = "own_msgs/msg/ThermalPicture"
    from rosbags.typesys import get_types_from_msg

    sections = text.split("===\n")
    types = get_types_from_msg(sections[0], name)
    types |= get_types_from_msg(sections[1].split("\n", 1)[1], "own_msgs/msg/Note")
    types |= get_types_from_msg(sections[2].split("\n", 1)[1], "own_msgs/msg/Pair")
    known = store(ros)
    if name not in known.types:
        known.register(types)
    numbers = np.arange(3, dtype=np.int16)
    notes = [made(wire, "own_msgs/Note", text="abc"[:k], numbers=numbers[:k]) for k in range(4)]
    pairs = [made(wire, "own_msgs/Pair", a=1, b=2.0)] * 2
    values = {
        "notes": notes,
        "curve": np.arange(2.0),
        "words": ["one", "", "three"],
        "pairs": pairs,
        "flags": np.array([True, False]),
        "data": np.arange(6, dtype=np.uint8),
        "step": 3,
        "encoding": "mono8",
        "other": samples.header(wire).stamp,
        "is_bigendian": 1,
        "width": 3,
        "height": 2,
    }
    data = sent(wire, made(wire, name, after=1.0, **values))
    return topic(wire, name, definition=text), data


@EVERY_WIRE
def test_the_definition_in_the_file_decides(wire: str) -> None:
    there, data = own_message(wire)
    reader = reader_of(there)
    image = reader.message(data)
    assert reader.kind is RawImage
    assert isinstance(image, RawImage)
    assert (image.width, image.height, image.step, image.encoding, image.big_endian) == (
        3,
        2,
        3,
        "mono8",
        True,
    )
    assert bytes(image.data) == bytes(range(6))
    assert image.header == reader.header(data) == HEADER


IDL = """
================================================================================
IDL: sensor_msgs/msg/Image
// generated; "quoted"
#include "std_msgs/msg/Header.idl"
module sensor_msgs { module msg {
  module Image_Constants { const string LETTERS = "};"; };
  @verbatim (language="comment", text= "a ) \\" struct" "b")
  struct Image {
    std_msgs::msg::Header header; @unit (value="px") uint32 height; uint32 width;
    string encoding; octet is_bigendian; unsigned long step; sequence<uint8> data;
  };
}; };
================================================================================
IDL: std_msgs/msg/Header
/* block { */
module std_msgs { module msg { struct Header { builtin_interfaces::msg::Time stamp; string frame_id; }; }; };
================================================================================
IDL: builtin_interfaces/msg/Time
module builtin_interfaces { module msg { struct Time { long sec; unsigned long nanosec; }; }; };
"""


@pytest.mark.parametrize("wire", ["cdr", "cdr big"])
def test_idl_definitions(wire: str) -> None:
    data = sent(wire, samples.image(wire, bytes(4), 2, 2, "mono8", 2))
    there = Topic("/sensor", Schema(IMAGE, "ros2idl", IDL.encode()), "cdr")
    image = reader_of(there).message(data)
    assert isinstance(image, RawImage)
    assert image.header == HEADER
    assert bytes(image.data) == bytes(4)


def test_types_that_are_not_used_have_a_header_or_none() -> None:
    twist = store(2).types["geometry_msgs/msg/Twist"]
    zero = made("cdr", "geometry_msgs/Vector3", x=0, y=0, z=0)
    message = made("cdr", "geometry_msgs/TwistStamped", twist=twist(zero, zero))
    for defined in (True, False):
        reader = reader_of(topic("cdr", "geometry_msgs/msg/TwistStamped", defined=defined))
        assert reader.kind is None
        assert reader.header(sent("cdr", message)) == HEADER
        with pytest.raises(FrameError, match=r"/sensor: .*geometry_msgs/TwistStamped"):
            reader.message(sent("cdr", message))
    plain = reader_of(topic("cdr", "std_msgs/msg/String"))
    assert plain.kind is None
    assert plain.header(b"") == Header()
    own = reader_of(
        topic(
            "cdr", "a_msgs/msg/A", definition="std_msgs/Header h\n===\nMSG: std_msgs/Header\nstring frame_id"
        )
    )
    assert own.kind is None
    assert own.header(b"") == Header()


@pytest.mark.parametrize(
    ("there", "words"),
    [
        (Topic("/a", Schema("x/msg/Y"), "cdr"), "no definition of x/msg/Y"),
        (Topic("/a", Schema("x/msg/Y"), "flatbuffer"), "the encoding is not read"),
        (Topic("/a", Schema("", "", b""), ""), "type (none), encoding (none)"),
        (Topic("/a", Schema(IMAGE, "omgidl", b"x"), "cdr"), "form 'omgidl', not ros2msg or ros2idl"),
        (Topic("/a", Schema(IMAGE, "ros2msg", b"what is\nthis?"), "cdr"), "line 2 of the definition"),
        (Topic("/a", Schema(IMAGE, "ros2msg", b"uint8[] data"), "cdr"), "no field header.stamp.sec"),
        (Topic("/a", Schema(IMAGE, "ros2idl", b"struct {"), "cdr"), "IDL definition"),
        (Topic("/a", Schema(IMAGE, "ros2msg", b" " * (1 << 20) + b"x"), "cdr"), "more than 1,048,576"),
        (Topic("/a", Schema(IMAGE, "ros2msg", b"sensor_msgs/Image i"), "cdr"), "holds itself"),
    ],
)
def test_what_cannot_be_read_is_refused_with_its_topic_and_type(there: Topic, words: str) -> None:
    with pytest.raises(InputError) as raised:
        reader_of(there)
    assert words in str(raised.value)
    assert "/a: topic of type" in str(raised.value)
    assert f"encoding {there.encoding or '(none)'}" in str(raised.value)


# --- stamps


@pytest.mark.parametrize("wire", ["ros1", "cdr"])
@pytest.mark.parametrize(
    ("sec", "nsec", "stamp"),
    [(0, 0, None), (0, 1, 1), (5, 999_999_999, 5_999_999_999), (5, 10**9, "cannot be"), (-1, 0, "cannot be")],
)
def test_stamps(wire: str, sec: int, nsec: int, stamp: int | str | None) -> None:
    if sec < 0 and wire == "ros1":
        sec, stamp = 2**31 - 1, (2**31 - 1) * 10**9  # its seconds have no sign
    head = samples.header(wire, sec, nsec)
    message = made(wire, COMPRESSED, header=head, format="", data=np.zeros(0, np.uint8))
    reader, data = reader_of(topic(wire, COMPRESSED)), sent(wire, message)
    if isinstance(stamp, str):
        for read in (reader.header, reader.message):
            with pytest.raises(FrameError, match=f"/sensor: its stamp {stamp}"):
                read(data)
    else:
        assert reader.header(data).stamp_ns == stamp == reader.message(data).header.stamp_ns


# --- bytes that are no message


@pytest.mark.parametrize(
    ("second", "word"), [(2, "PL_CDR"), (3, "PL_CDR"), (7, "XCDR"), (0x0B, "XCDR"), (99, "unknown")]
)
def test_other_encapsulations_are_refused(second: int, word: str) -> None:
    data = sent("cdr", samples.compressed("cdr", b"abc", "png"))
    with pytest.raises(FrameError, match=word):
        reader_of(topic("cdr", COMPRESSED)).message(bytes([0, second]) + data[2:])
    with pytest.raises(FrameError, match="no CDR"):
        reader_of(topic("cdr", COMPRESSED)).header(data[:3])


@cache
def all_messages(wire: str) -> dict[str, bytes]:
    array = np.zeros((1, 4), [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    point = made(
        wire, "livox_ros_driver2/CustomPoint", offset_time=1, x=1, y=2, z=3, reflectivity=4, tag=5, line=6
    )
    rest = {"timebase": 5, "point_num": 2, "lidar_id": 1, "rsvd": np.zeros(3, np.uint8)}
    moves = [samples.stamped(wire, "a", (1, 2, 3), (0, 0, 0, 1))] * 2
    return {
        IMAGE: sent(wire, samples.image(wire, bytes(24), 3, 4, "bgr8", 6)),
        COMPRESSED: sent(wire, samples.compressed(wire, b"\xff\xd8abc", "jpeg")),
        POINTS: sent(wire, samples.cloud(wire, array)),
        INFO: sent(wire, samples.camera_info(wire, "plumb_bob", [0.1] * 5, [1.0] * 9)),
        TF: sent(wire, made(wire, "tf2_msgs/TFMessage", transforms=moves)),
        samples.LIVOX: sent(wire, made(wire, samples.LIVOX, points=[point] * 2, **rest)),
        "own": own_message(wire)[1],
    }


@cache
def reader_for(wire: str, name: str) -> Any:
    return reader_of(own_message(wire)[0] if name == "own" else topic(wire, name))


@EVERY_WIRE
def test_every_cut_is_refused(wire: str) -> None:
    """All bytes are needed but for what lies behind the last wanted field."""
    behind = {POINTS: 1, INFO: 25, "own": 8}
    for name, data in all_messages(wire).items():
        reader = reader_for(wire, name)
        reader.message(data)
        for end in range(len(data) - behind.get(name, 0)):
            with pytest.raises(FrameError):
                reader.message(data[:end])


@EVERY_WIRE
@pytest.mark.parametrize("name", [IMAGE, COMPRESSED, POINTS, INFO, TF, samples.LIVOX, "own"])
@settings(max_examples=30)
@given(st.data())
def test_changed_bytes_give_a_message_or_a_frame_error(wire: str, name: str, data: st.DataObject) -> None:
    message = bytearray(all_messages(wire)[name])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(4 if wire != "ros1" else 0, len(message) - 1))
        message[at : at + 4] = data.draw(
            st.sampled_from([b"\xff" * 4, b"\0" * 4, b"\x80\0\0\0", b"\x7f\xff\xff\xff"])
        )
    reader = reader_for(wire, name)
    for read in (reader.message, reader.header):
        with suppress(FrameError):
            read(bytes(message))


def test_claims_beyond_the_bytes_take_no_memory() -> None:
    """Lengths of 4 thousand millions wherever one stands, in front of no bytes at all."""
    text = "own_msgs/E[] nothing\nown_msgs/F[] few\nstd_msgs/Header header\nstring format\nuint8[] data"
    text += "\n===\nMSG: own_msgs/E\n===\nMSG: own_msgs/F\nuint8 a\n"
    text += "===\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id"
    reader = reader_of(topic("ros1", "own_msgs/msg/A", definition=text))
    tail = struct.pack("<IIII3sI4sI", 1, SEC, NSEC, 3, b"cam", 4, b"jpeg", 0)
    most = b"\xff" * 4
    fine = reader.message(most + bytes(4) + tail)  # so many things of no bytes are nothing
    assert isinstance(fine, CompressedImage)
    assert fine.header == Header(STAMP_NS, "cam")
    with pytest.raises(FrameError, match="claims 4,294,967,295 bytes where 31 are left"):
        reader.message(bytes(4) + most + tail)
    with pytest.raises(FrameError, match="claims 70,000 few"):
        reader.message(bytes(4) + struct.pack("<I", 70_000) + bytes(70_000) + tail)
    with pytest.raises(FrameError, match="a name of 70,000 bytes"):
        reader.message(bytes(8) + tail[:12] + struct.pack("<I", 70_000) + bytes(70_000) + tail[19:])


# --- recordings by others


def test_every_topic_of_a_real_recording_reads_as_others_read_it(shared_data: Path) -> None:
    """94 types from MCAP, with definitions, and from SQLite, without. They were recorded one after the other,
    so the stamps differ; in the types that are read nothing else does.
    """
    folder = shared_data / "recordings" / "rosbag2_geocam"
    with (folder / "test_bag_mcap" / "test_bag_mcap.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        mcap = {(c.topic, m.log_time): (s, m.data, d) for s, c, m, d in reader.iter_decoded_messages() if s}
    with AnyReader([folder / "test_bag_sqlite3"]) as bag:
        sqlite = [(c.topic, bytes(data), bag.deserialize(data, c.msgtype)) for c, _, data in bag.messages()]
    kinds = {}
    for ((name, _), (schema, *first)), second in zip(
        sorted(mcap.items(), key=by_topic), by_name(sqlite), strict=True
    ):
        assert second[0] == name
        defined = reader_of(Topic(name, Schema(schema.name, schema.encoding, schema.data), "cdr"))
        bare = reader_of(Topic(name, Schema(schema.name), "cdr"))
        kinds[schema.name] = defined.kind
        assert bare.kind is defined.kind
        for data, decoded in (first, second[1:]):
            assert defined.header(data) == bare.header(data) == header_of(schema.name, decoded), schema.name
        if defined.kind is not None:
            one, two, three = defined.message(first[0]), bare.message(first[0]), bare.message(second[1])
            assert without_stamp(one) == without_stamp(two) == without_stamp(three)
            assert getattr(one, "data", b"") == getattr(three, "data", b"") == getattr(first[1], "data", b"")
    assert len(kinds) == 94
    images = {IMAGE: RawImage, COMPRESSED: CompressedImage}
    others = {POINTS: Points, INFO: CameraInfo, TF: Transforms, STAMPED: Transforms}
    assert {name: kind for name, kind in kinds.items() if kind} == images | others


def by_topic(item: Any) -> Any:
    return item[0]


def by_name(found: list[Any]) -> list[Any]:
    return sorted(found, key=lambda each: each[0])  # stable: in the order of time


def header_of(name: str, decoded: Any) -> Header:
    head = decoded if name.endswith("/Header") else getattr(decoded, "header", None)
    head = decoded.transforms[0].header if name == TF else head
    return Header() if head is None else Header(head.stamp.sec * 10**9 + head.stamp.nanosec, head.frame_id)


def without_stamp(message: Any) -> str:
    return re.sub(r"stamp_ns=\d+|data=.*", "", repr(message))


def test_a_real_cloud(shared_data: Path) -> None:
    with AnyReader([shared_data / "recordings" / "PointCloud2.bag"]) as bag:
        ((connection, _, data),) = bag.messages()
        rosbags: Any = bag.deserialize(data, connection.msgtype)
        there = Topic(
            connection.topic, Schema(connection.msgtype, "ros1msg", connection.msgdef.data.encode()), "ros1"
        )
    points = reader_of(there).message(data)
    assert isinstance(points, Points)
    assert (points.width * points.height, points.point_step) == (124_914, 32)
    assert bytes(points.data) == rosbags.data.tobytes()
    assert [(f.name, f.offset) for f in points.fields] == [(f.name, f.offset) for f in rosbags.fields]
    assert points.header.stamp_ns == rosbags.header.stamp.sec * 10**9 + rosbags.header.stamp.nanosec


def test_what_mcaps_own_ros1_writer_wrote(tmp_path: Path) -> None:
    """Its encoder knows nothing of rosbags."""
    path = tmp_path / "a.mcap"
    message = made("ros1", COMPRESSED, format="png", data=np.arange(9, dtype=np.uint8))
    with path.open("wb") as file, Ros1Writer(file) as writer:
        writer.write_message("/a", _Ros1Message(message))
    with path.open("rb") as file:
        ((schema, channel, found),) = make_reader(file).iter_messages()
    assert schema is not None
    there = Topic("/a", Schema(schema.name, schema.encoding, schema.data), channel.message_encoding)
    read = reader_of(there).message(found.data)
    assert isinstance(read, CompressedImage)
    assert bytes(read.data) == bytes(range(9))
    assert read.header == HEADER


class _Ros1Message:
    """What that writer takes: a message of genpy's kind."""

    _type = "sensor_msgs/CompressedImage"
    _full_text = store(1).generate_msgdef(COMPRESSED, ros_version=1)[0]

    def __init__(self, message: Any) -> None:
        self._message = message

    def serialize(self, buffer: Any) -> None:
        buffer.write(sent("ros1", self._message))
