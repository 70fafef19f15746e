"""foxglove's own message types, as trees of the fields that are needed: the same for protobuf and JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from fusion.errors import FrameError
from fusion.messages import make
from fusion.messages.base import (
    CameraInfo,
    CompressedImage,
    Header,
    Message,
    Points,
    RawImage,
    Transforms,
)

MAX_PARTS = 1 << 14  # of a repeated field

# A leaf is `int`, `float`, `str` or `bytes`; a list of one leaf or tree is a repeated field.
Tree = Mapping[str, Any]
STAMP: Tree = {"sec": int, "nsec": int}  # google.protobuf.Timestamp says seconds and nanos
HEADER: Tree = {"timestamp": STAMP, "frame_id": str}
_XYZ: Tree = dict.fromkeys("xyz", float)
_XYZW: Tree = dict.fromkeys("xyzw", float)
_SIZE: Tree = {"width": int, "height": int}
_TRANSFORM: Tree = {
    "timestamp": STAMP,
    "parent_frame_id": str,
    "child_frame_id": str,
    "translation": _XYZ,
    "rotation": _XYZW,
}
_POINTS: Tree = {
    **HEADER,
    "pose": {"position": _XYZ, "orientation": _XYZW},
    "point_stride": int,
    "fields": [{"name": str, "offset": int, "type": int}],
    "data": bytes,
}


_STILL = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class Shape(NamedTuple):
    kind: type[Message]
    tree: Tree
    make: Callable[[dict[str, Any]], Message]


def header(values: Mapping[str, Any]) -> Header:
    stamp = values["timestamp"]
    return make.header(stamp["sec"], stamp["nsec"], values["frame_id"])


def _image(values: dict[str, Any]) -> RawImage:
    size = values["height"], values["width"]
    return make.image(header(values), *size, values["encoding"], False, values["step"], values["data"])


def _compressed(values: dict[str, Any]) -> CompressedImage:
    return CompressedImage(header(values), values["format"], values["data"])


def _points(values: dict[str, Any]) -> Points:
    step, data = values["point_stride"], values["data"]
    if step <= 0 or len(data) % step:
        raise FrameError(f"its {len(data):,} bytes are not points of {step} bytes")
    fields = tuple((field["name"], field["offset"], field["type"]) for field in values["fields"])
    made = make.point_fields(fields, "foxglove")
    at = _numbers(values["pose"]["position"], values["pose"]["orientation"])
    moved = None
    if at != _STILL:
        moved = make.transforms([(0, 0, "its frame", "its points", *at)]).transforms[0].T_parent_child
    return Points(header(values), len(data) // step, 1, made, step, len(data), data, moved)


def _numbers(xyz: Mapping[str, float], quat: Mapping[str, float]) -> tuple[float, ...]:
    """x y z and the quaternion x y z w; zeros are what a sender means who leaves the rotation out."""
    rotation = [quat[axis] for axis in "xyzw"] if any(quat.values()) else [0.0, 0.0, 0.0, 1.0]
    return (*(xyz[axis] for axis in "xyz"), *rotation)


def _camera(values: dict[str, Any]) -> CameraInfo:
    numbers = [values[letter] for letter in "DKRP"]
    size = values["height"], values["width"]
    return make.camera(header(values), *size, values["distortion_model"], *numbers)


def _transform(values: Mapping[str, Any]) -> tuple[Any, ...]:
    stamp, names = values["timestamp"], (values["parent_frame_id"], values["child_frame_id"])
    return stamp["sec"], stamp["nsec"], *names, *_numbers(values["translation"], values["rotation"])


def _one_transform(values: dict[str, Any]) -> Transforms:
    return make.transforms([_transform(values)])


def _transforms(values: dict[str, Any]) -> Transforms:
    return make.transforms([_transform(each) for each in values["transforms"]])


_RAW_IMAGE: Tree = {**HEADER, **_SIZE, "encoding": str, "step": int, "data": bytes}
_CAMERA: Tree = {**HEADER, **_SIZE, "distortion_model": str, **{letter: [float] for letter in "DKRP"}}
# The last part of a type's name -> how it is read.
SHAPES: dict[str, Shape] = {
    "RawImage": Shape(RawImage, _RAW_IMAGE, _image),
    "CompressedImage": Shape(CompressedImage, {**HEADER, "data": bytes, "format": str}, _compressed),
    "PointCloud": Shape(Points, _POINTS, _points),
    "CameraCalibration": Shape(CameraInfo, _CAMERA, _camera),
    "FrameTransform": Shape(Transforms, _TRANSFORM, _one_transform),
    "FrameTransforms": Shape(Transforms, {"transforms": [_TRANSFORM]}, _transforms),
}
