"""Messages written by other hands: by rosbags for ROS, by google.protobuf's own classes for foxglove."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from fusion.recordings.base import Schema, Topic

SEC, NSEC = 1_700_000_000, 123_456_789
STAMP_NS = SEC * 10**9 + NSEC
WIRES = ("ros1", "cdr", "cdr big")

_TF = "geometry_msgs/TransformStamped[] transforms"
_LIVOX = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
livox_ros_driver2/CustomPoint[] points
"""
_LIVOX_POINT = (
    "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line"
)
LIVOX = "livox_ros_driver2/msg/CustomMsg"


@cache
def store(ros: int) -> Typestore:
    found = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.LATEST)
    extra = get_types_from_msg(_LIVOX_POINT, "livox_ros_driver2/msg/CustomPoint")
    extra |= get_types_from_msg(_LIVOX, LIVOX)
    if ros == 1:
        extra |= get_types_from_msg(_TF, "tf2_msgs/msg/TFMessage")
    found.register(extra)
    return found


def ros_of(wire: str) -> int:
    return 1 if wire == "ros1" else 2


def made(wire: str, type_name: str, /, **values: Any) -> Any:
    """A message of rosbags' own; a `header` is added where the type has one and none is given."""
    name = type_name if "/msg/" in type_name else type_name.replace("/", "/msg/")
    kind: Any = store(ros_of(wire)).types[name]
    if "header" in kind.__dataclass_fields__:
        values.setdefault("header", header(wire))
    return kind(**values)


def header(wire: str, sec: int = SEC, nsec: int = NSEC, frame_id: str = "camera") -> Any:
    stamp = made(wire, "builtin_interfaces/Time", sec=sec, nanosec=nsec)
    seq = {"seq": 7} if wire == "ros1" else {}
    return made(wire, "std_msgs/Header", stamp=stamp, frame_id=frame_id, **seq)


def sent(wire: str, message: Any) -> bytes:
    name, types = message.__msgtype__, store(ros_of(wire))
    if wire == "ros1":
        return bytes(types.serialize_ros1(message, name))
    return bytes(types.serialize_cdr(message, name, little_endian=wire == "cdr"))


def topic(wire: str, name: str, *, defined: bool = True, definition: str = "") -> Topic:
    """A topic of the ROS type `name`, with the definition that rosbags writes, or another."""
    ros = ros_of(wire)
    text = definition or (store(ros).generate_msgdef(name, ros_version=ros)[0] if defined else "")
    form = ("ros1msg" if ros == 1 else "ros2msg") if text else ""
    return Topic("/sensor", Schema(name, form, text.encode()), "ros1" if ros == 1 else "cdr")


def image(wire: str, pixels: bytes, w: int, h: int, encoding: str, step: int, *, big: bool = False) -> Any:
    data = np.frombuffer(pixels, np.uint8)
    size = {"width": w, "height": h, "step": step, "is_bigendian": int(big)}
    return made(wire, "sensor_msgs/Image", encoding=encoding, data=data, **size)


def compressed(wire: str, data: bytes, format: str) -> Any:
    return made(wire, "sensor_msgs/CompressedImage", format=format, data=np.frombuffer(data, np.uint8))


def cloud(wire: str, array: np.ndarray, *, big: bool = False) -> Any:
    """PointCloud2 of a structured array of height x width."""
    numbers = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
    fields = []
    for name, (dtype, offset, *_) in (array.dtype.fields or {}).items():
        base, shape = dtype.base, dtype.shape
        kind = numbers[base.str[1:]]
        count = int(np.prod(shape)) if shape else 1
        fields.append(
            made(wire, "sensor_msgs/PointField", name=name, offset=offset, datatype=kind, count=count)
        )
    h, w = array.shape
    step = array.dtype.itemsize
    sizes = {"height": h, "width": w, "point_step": step, "row_step": w * step}
    data = np.frombuffer(array.tobytes(), np.uint8)
    return made(
        wire, "sensor_msgs/PointCloud2", fields=fields, is_bigendian=big, data=data, is_dense=True, **sizes
    )


def camera_info(wire: str, model: str, D: list[float], K: list[float]) -> Any:
    zeros = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    roi = made(wire, "sensor_msgs/RegionOfInterest", **zeros)
    arrays = {"D": D, "K": K, "R": np.eye(3).ravel(), "P": np.arange(12.0)}
    values = {key if wire == "ros1" else key.lower(): np.array(v, np.float64) for key, v in arrays.items()}
    size = {"width": 640, "height": 512, "binning_x": 0, "binning_y": 0, "roi": roi}
    return made(wire, "sensor_msgs/CameraInfo", distortion_model=model, **size, **values)


def stamped(wire: str, child: str, xyz: tuple[float, ...], quat_xyzw: tuple[float, ...]) -> Any:
    move = made(wire, "geometry_msgs/Vector3", **dict(zip("xyz", xyz, strict=True)))
    turn = made(wire, "geometry_msgs/Quaternion", **dict(zip("xyzw", quat_xyzw, strict=True)))
    both = made(wire, "geometry_msgs/Transform", translation=move, rotation=turn)
    return made(wire, "geometry_msgs/TransformStamped", child_frame_id=child, transform=both)


# --- foxglove's types, with the numbers of its .proto files

_F = descriptor_pb2.FieldDescriptorProto
_STAMP = (".google.protobuf.Timestamp", 1)
_XYZ = [("x", _F.TYPE_DOUBLE, 1), ("y", _F.TYPE_DOUBLE, 2), ("z", _F.TYPE_DOUBLE, 3)]
_PROTO: dict[str, list[tuple[Any, ...]]] = {
    "Vector3": _XYZ,
    "Quaternion": [*_XYZ, ("w", _F.TYPE_DOUBLE, 4)],
    "Pose": [("position", ".foxglove.Vector3", 1), ("orientation", ".foxglove.Quaternion", 2)],
    "RawImage": [
        *(("timestamp", *_STAMP), ("frame_id", _F.TYPE_STRING, 7), ("width", _F.TYPE_FIXED32, 2)),
        *(("height", _F.TYPE_FIXED32, 3), ("encoding", _F.TYPE_STRING, 4)),
        *(("step", _F.TYPE_FIXED32, 5), ("data", _F.TYPE_BYTES, 6)),
    ],
    "CompressedImage": [
        *(("timestamp", *_STAMP), ("frame_id", _F.TYPE_STRING, 4)),
        *(("data", _F.TYPE_BYTES, 2), ("format", _F.TYPE_STRING, 3)),
    ],
    "PackedElementField": [
        ("name", _F.TYPE_STRING, 1),
        ("offset", _F.TYPE_FIXED32, 2),
        ("type", ".foxglove.NumericType", 3),
    ],
    "PointCloud": [
        *(("timestamp", *_STAMP), ("frame_id", _F.TYPE_STRING, 2), ("pose", ".foxglove.Pose", 3)),
        *(("point_stride", _F.TYPE_FIXED32, 4), ("fields", ".foxglove.PackedElementField", 5, "many")),
        ("data", _F.TYPE_BYTES, 6),
    ],
    "CameraCalibration": [
        *(("timestamp", *_STAMP), ("frame_id", _F.TYPE_STRING, 9), ("width", _F.TYPE_FIXED32, 2)),
        *(("height", _F.TYPE_FIXED32, 3), ("distortion_model", _F.TYPE_STRING, 4)),
        *((letter, _F.TYPE_DOUBLE, n, "many") for n, letter in enumerate("DKRP", 5)),
    ],
    "FrameTransform": [
        *(("timestamp", *_STAMP), ("parent_frame_id", _F.TYPE_STRING, 2)),
        *(("child_frame_id", _F.TYPE_STRING, 3), ("translation", ".foxglove.Vector3", 4)),
        ("rotation", ".foxglove.Quaternion", 5),
    ],
    "FrameTransforms": [("transforms", ".foxglove.FrameTransform", 1, "many")],
    "Log": [("timestamp", *_STAMP), ("message", _F.TYPE_STRING, 3)],
    "Grid": [("timestamp", *_STAMP), ("frame_id", _F.TYPE_STRING, 2), ("data", _F.TYPE_BYTES, 3)],
}
_NUMERIC = ("UNKNOWN", "UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64")


def _file() -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto(name="foxglove.proto", package="foxglove", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    enum = file.enum_type.add(name="NumericType")
    for number, name in enumerate(_NUMERIC):
        enum.value.add(name=name, number=number)
    for name, fields in _PROTO.items():
        message = file.message_type.add(name=name)
        for field, kind, number, *many in fields:
            made: Any = message.field.add(name=field, number=number)
            made.label = _F.LABEL_REPEATED if many else _F.LABEL_OPTIONAL
            if isinstance(kind, int):
                made.type = kind
            else:
                made.type = _F.TYPE_ENUM if kind.endswith("NumericType") else _F.TYPE_MESSAGE
                made.type_name = kind
    return file


def descriptors() -> bytes:
    stamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    return descriptor_pb2.FileDescriptorSet(file=[stamp, _file()]).SerializeToString()


@cache
def _pool() -> descriptor_pool.DescriptorPool:
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptors()).file:
        pool.Add(file)
    return pool


def foxglove(name: str, **values: Any) -> Any:
    """A message of google.protobuf's own; `timestamp` is set where the type has one and none is given."""
    kind = message_factory.GetMessageClass(_pool().FindMessageTypeByName(f"foxglove.{name}"))
    if any(field[0] == "timestamp" for field in _PROTO[name]):
        values.setdefault("timestamp", {"seconds": SEC, "nanos": NSEC})
    return kind(**values)


def foxglove_topic(name: str, encoding: str = "protobuf") -> Topic:
    proto = encoding == "protobuf"
    schema = Schema(
        f"foxglove.{name}", encoding if proto else "jsonschema", descriptors() if proto else b"{}"
    )
    return Topic("/sensor", schema, encoding)
