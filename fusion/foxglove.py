"""The schemas that Foxglove shows, as protobuf and as JSON: our messages become theirs.

Names, numbers and types of fields are those of the schemas that Foxglove publishes. The package that carries
them is not needed: it would add a hundred types to our five.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.errors import UsageError
from fusion.geometry import Camera, FisheyeCamera, PinholeCamera, quat_of_rotation
from fusion.messages.base import (
    CameraInfo,
    CompressedImage,
    Header,
    Message,
    Points,
    RawImage,
    Transform,
    Transforms,
)
from fusion.rig import Rig

if TYPE_CHECKING:
    from google.protobuf.descriptor_pb2 import FileDescriptorProto
    from google.protobuf.descriptor_pool import DescriptorPool


class _Field(NamedTuple):
    """`kind` is a scalar's word, ``time``, ``numeric`` or a row of `_TYPES`.

    `many` is None for one value, 0 for any number of them, else that number (JSON alone says it).
    """

    name: str
    number: int
    kind: str
    many: int | None = None


_TYPES: dict[str, tuple[_Field, ...]] = {
    "Vector3": tuple(_Field(axis, k + 1, "double") for k, axis in enumerate("xyz")),
    "Quaternion": tuple(_Field(axis, k + 1, "double") for k, axis in enumerate("xyzw")),
    "Pose": (_Field("position", 1, "Vector3"), _Field("orientation", 2, "Quaternion")),
    "CompressedImage": (
        _Field("timestamp", 1, "time"),
        _Field("frame_id", 4, "string"),
        _Field("data", 2, "bytes"),
        _Field("format", 3, "string"),
    ),
    "RawImage": (
        _Field("timestamp", 1, "time"),
        _Field("frame_id", 7, "string"),
        _Field("width", 2, "fixed32"),
        _Field("height", 3, "fixed32"),
        _Field("encoding", 4, "string"),
        _Field("step", 5, "fixed32"),
        _Field("data", 6, "bytes"),
    ),
    "PackedElementField": (
        _Field("name", 1, "string"),
        _Field("offset", 2, "fixed32"),
        _Field("type", 3, "numeric"),
    ),
    "PointCloud": (
        _Field("timestamp", 1, "time"),
        _Field("frame_id", 2, "string"),
        _Field("pose", 3, "Pose"),
        _Field("point_stride", 4, "fixed32"),
        _Field("fields", 5, "PackedElementField", 0),
        _Field("data", 6, "bytes"),
    ),
    "CameraCalibration": (
        _Field("timestamp", 1, "time"),
        _Field("frame_id", 9, "string"),
        _Field("width", 2, "fixed32"),
        _Field("height", 3, "fixed32"),
        _Field("distortion_model", 4, "string"),
        _Field("D", 5, "double", 0),
        _Field("K", 6, "double", 9),
        _Field("R", 7, "double", 9),
        _Field("P", 8, "double", 12),
    ),
    "FrameTransform": (
        _Field("timestamp", 1, "time"),
        _Field("parent_frame_id", 2, "string"),
        _Field("child_frame_id", 3, "string"),
        _Field("translation", 4, "Vector3"),
        _Field("rotation", 5, "Quaternion"),
    ),
    "FrameTransforms": (_Field("transforms", 1, "FrameTransform", 0),),
}
# Foxglove's NumericType in its order; ROS's PointField numbers the integers otherwise.
_NUMERIC = ("UNKNOWN", "UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64")
_TIMESTAMP = "google/protobuf/timestamp.proto"
_MODELS = {"equidistant": "kannala_brandt"}  # ROS's word -> Foxglove's
_KINDS = {
    CompressedImage: "CompressedImage",
    RawImage: "RawImage",
    Points: "PointCloud",
    CameraInfo: "CameraCalibration",
    Transforms: "FrameTransforms",
}


# --- the schemas


def schema_name(kind: type[Message]) -> str:
    """What a schema is called in a recording: ``foxglove.RawImage``, in both wires."""
    return f"foxglove.{_KINDS[kind]}"


@cache
def protobuf_schema(name: str) -> bytes:
    """The FileDescriptorSet of a schema (``foxglove.RawImage``) and all it builds on, as MCAP wants it."""
    from google.protobuf import timestamp_pb2
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    files = [_file(kind) for kind in _closure(name.removeprefix("foxglove."))]
    if any(_TIMESTAMP in file.dependency for file in files):
        stamp = FileDescriptorSet().file.add()
        timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
        files.insert(0, stamp)
    return FileDescriptorSet(file=files).SerializeToString(deterministic=True)


def json_schema(name: str) -> bytes:
    """The JSON schema of the same: times are {sec, nsec}, bytes are base64."""
    return json.dumps(_json_object(name.removeprefix("foxglove.")), separators=(",", ":")).encode()


def message_class(name: str) -> Any:
    """The protobuf class of a schema (``foxglove.RawImage``)."""
    from google.protobuf.message_factory import GetMessageClass

    return GetMessageClass(_pool().FindMessageTypeByName(name))


def _closure(kind: str) -> list[str]:
    """A type and those that it builds on, these first."""
    found: list[str] = []
    for field in _TYPES[kind]:
        if field.kind in _TYPES:
            found += [other for other in _closure(field.kind) if other not in found]
    return [*found, kind]


@cache
def _pool() -> DescriptorPool:
    from google.protobuf import timestamp_pb2
    from google.protobuf.descriptor_pb2 import FileDescriptorProto
    from google.protobuf.descriptor_pool import DescriptorPool

    pool, stamp = DescriptorPool(), FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    for file in (stamp, *map(_file, _TYPES)):
        pool.Add(file)
    return pool


def _file(kind: str) -> FileDescriptorProto:
    """One file a type, as they are published."""
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto

    file = FileDescriptorProto(name=f"foxglove/{kind}.proto", package="foxglove", syntax="proto3")
    built_on = {f"foxglove/{field.kind}.proto" for field in _TYPES[kind] if field.kind in _TYPES}
    if any(field.kind == "time" for field in _TYPES[kind]):
        built_on.add(_TIMESTAMP)
    file.dependency.extend(sorted(built_on))
    message = file.message_type.add(name=kind)
    scalars = FieldDescriptorProto.Type
    for name, number, of, many in _TYPES[kind]:
        field = message.field.add(name=name, number=number)
        field.label = (
            FieldDescriptorProto.LABEL_OPTIONAL if many is None else FieldDescriptorProto.LABEL_REPEATED
        )
        if of == "numeric":
            field.type, field.type_name = scalars.TYPE_ENUM, f".foxglove.{kind}.NumericType"
            numeric = message.enum_type.add(name="NumericType")
            for value, word in enumerate(_NUMERIC):
                numeric.value.add(name=word, number=value)
        elif of == "time" or of in _TYPES:
            field.type = scalars.TYPE_MESSAGE
            field.type_name = ".google.protobuf.Timestamp" if of == "time" else f".foxglove.{of}"
        else:
            field.type = scalars.Value(f"TYPE_{of.upper()}")
    return file


def _json_object(kind: str) -> dict[str, Any]:
    properties = {field.name: _json_field(field) for field in _TYPES[kind]}
    return {"title": f"foxglove.{kind}", "type": "object", "properties": properties}


def _json_field(field: _Field) -> dict[str, Any]:
    one = _json_object(field.kind) if field.kind in _TYPES else _JSON_SCALARS[field.kind]
    if field.many is None:
        return one
    length = {"minItems": field.many, "maxItems": field.many} if field.many else {}
    return {"type": "array", "items": one, **length}


_NATURAL = {"type": "integer", "minimum": 0}
_JSON_SCALARS: dict[str, dict[str, Any]] = {
    "time": {
        "type": "object",
        "title": "time",
        "properties": {"sec": _NATURAL, "nsec": {**_NATURAL, "maximum": 999_999_999}},
    },
    "string": {"type": "string"},
    "bytes": {"type": "string", "contentEncoding": "base64"},
    "fixed32": _NATURAL,
    "double": {"type": "number"},
    "numeric": {
        "title": "foxglove.NumericType",
        "oneOf": [{"title": word, "const": value} for value, word in enumerate(_NUMERIC)],
    },
}


# --- the messages


def protobuf_bytes(message: Message) -> bytes:
    """`message` in protobuf, its schema is `schema_name` of its type.

    Raises `ValueError` for what Foxglove has no place for: big endian, rows with padding, fields of 64-bit
    integers.
    """
    kind, values = _values_of(message)
    return message_class(f"foxglove.{kind}")(**_for_protobuf(kind, values)).SerializeToString(
        deterministic=True
    )


def json_bytes(message: Message) -> bytes:
    """`message` as JSON under the same name. Raises `ValueError` as `protobuf_bytes` does, and for NaN."""
    kind, values = _values_of(message)
    return json.dumps(_for_json(kind, values), separators=(",", ":"), allow_nan=False).encode()


def _for_protobuf(kind: str, values: Mapping[str, Any]) -> dict[str, Any]:
    out = {}
    for field in _TYPES[kind]:
        value = values[field.name]
        if field.kind == "time":
            value = None if value is None else {"seconds": value // 10**9, "nanos": value % 10**9}
        elif field.kind in _TYPES:
            nested = [
                _for_protobuf(field.kind, one) for one in (value if field.many is not None else [value])
            ]
            value = nested if field.many is not None else nested[0]
        elif field.kind == "bytes":
            value = bytes(value)
        out[field.name] = value
    return out


def _for_json(kind: str, values: Mapping[str, Any]) -> dict[str, Any]:
    out = {}
    for field in _TYPES[kind]:
        value = values[field.name]
        if field.kind == "time":
            value = {"sec": (value or 0) // 10**9, "nsec": (value or 0) % 10**9}
        elif field.kind in _TYPES:
            nested = [_for_json(field.kind, one) for one in (value if field.many is not None else [value])]
            value = nested if field.many is not None else nested[0]
        elif field.kind == "bytes":
            value = base64.b64encode(value).decode("ascii")
        out[field.name] = value
    return out


def _values_of(message: Message) -> tuple[str, dict[str, Any]]:
    """The schema without its package, and its fields; times in ns."""
    if isinstance(message, Transforms):
        return "FrameTransforms", {"transforms": [_transform(one) for one in message.transforms]}
    header = {"timestamp": message.header.stamp_ns, "frame_id": message.header.frame_id}
    if isinstance(message, CompressedImage):
        return "CompressedImage", {**header, "data": message.data, "format": message.format}
    if isinstance(message, RawImage):
        return "RawImage", {**header, **_raw(message)}
    if isinstance(message, Points):
        return "PointCloud", {**header, **_points(message)}
    return "CameraCalibration", {**header, **_calibration(message)}


def _raw(image: RawImage) -> dict[str, Any]:
    if image.big_endian:
        raise ValueError("Foxglove's RawImage is little endian")
    size = {"width": image.width, "height": image.height, "step": image.step}
    return {**size, "encoding": image.encoding, "data": image.data}


def _points(points: Points) -> dict[str, Any]:
    if points.height > 1 and points.row_step != points.width * points.point_step:
        raise ValueError("Foxglove's PointCloud has no padding between rows")
    fields = []
    for field in points.fields:
        name, dtype, count = field.name, np.dtype(field.dtype), field.count
        word = dtype.name.upper()
        if count != 1 or word not in _NUMERIC or dtype != dtype.newbyteorder("<"):
            raise ValueError(f"Foxglove's PointCloud has no field like {name!r}: {count} of {dtype}")
        fields.append({"name": name, "offset": field.offset, "type": _NUMERIC.index(word)})
    position, orientation = _pose(np.eye(4) if points.T_frame_points is None else points.T_frame_points)
    pose = {"position": position, "orientation": orientation}
    return {"pose": pose, "point_stride": points.point_step, "fields": fields, "data": points.data}


def _calibration(info: CameraInfo) -> dict[str, Any]:
    numbers = {name: [float(x) for x in np.ravel(getattr(info, name))] for name in "DKRP"}
    model = _MODELS.get(info.model, info.model)
    return {"width": info.width, "height": info.height, "distortion_model": model, **numbers}


def _transform(one: Transform) -> dict[str, Any]:
    translation, rotation = _pose(one.T_parent_child)
    names = {"parent_frame_id": one.parent, "child_frame_id": one.child}
    return {"timestamp": one.stamp_ns, **names, "translation": translation, "rotation": rotation}


def _pose(T: NDArray[np.float64]) -> tuple[dict[str, float], dict[str, float]]:
    """Vector3 and Quaternion of a pose."""
    w, x, y, z = (float(n) for n in quat_of_rotation(T[:3, :3]))
    return dict(zip("xyz", map(float, T[:3, 3]), strict=True)), {"x": x, "y": y, "z": z, "w": w}


# --- pictures, and what a rig says, as messages


def raw_image(header: Header, encoding: str, pixels: NDArray[Any]) -> RawImage:
    """H x W (x C) pixels without padding, little endian."""
    data = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("<"))
    h, w = data.shape[:2]
    return RawImage(header, w, h, encoding, False, data.nbytes // h, data.tobytes())


def calibration_of(camera: Camera, header: Header) -> CameraInfo | None:
    """ROS's calibration of a camera, its image not rectified; None for models that ROS has no word for.

    A missing distortion is five zeros; (k1 k2 p1 p2) gets k3 = 0.
    """
    if isinstance(camera, FisheyeCamera):
        model, D = "equidistant", camera.distortion or (0.0,) * 4
    elif isinstance(camera, PinholeCamera):
        model = "rational_polynomial" if len(camera.distortion) == 8 else "plumb_bob"
        D = (*camera.distortion, *(0.0,) * (5 - len(camera.distortion)))
    else:
        return None
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    P = np.hstack([K, np.zeros((3, 1))])
    return CameraInfo(header, *camera.size_wh, model, D, K, np.eye(3), P)


def transforms_of(rig: Rig, stamp_ns: int, parent: str = "rgb") -> Transforms:
    """T_parent_child of all other sensors that the rig links to `parent`; frames are named as sensors are."""
    names = {name for key in rig.transforms for name in key.split("_")[1:]} - {parent}
    found = []
    for child in sorted(names):
        with suppress(UsageError):  # a sensor of another island
            found.append(Transform(stamp_ns, parent, child, rig.pose(parent, child)))
    return Transforms(tuple(found))
