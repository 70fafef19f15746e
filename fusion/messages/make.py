"""From the values that a wire carried to our messages, each checked: the same for all wires."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.errors import FrameError
from fusion.messages.base import (
    Bytes,
    CameraInfo,
    CompressedImage,
    Header,
    PointField,
    Points,
    RawImage,
    Transform,
    Transforms,
)
from fusion.messages.layout import Records

MAX_FIELDS = 1024  # of a point
_LAST_NS = (1 << 63) - 1
_LENGTHS = 1e-6, 1e6  # of a quaternion that means a rotation
# The numbers of a point's types: sensor_msgs/PointField's, foxglove.PackedElementField's.
TYPES = {
    "ros": dict(enumerate(("i1", "u1", "<i2", "<u2", "<i4", "<u4", "<f4", "<f8"), 1)),
    "foxglove": dict(enumerate(("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<f4", "<f8"), 1)),
}


def stamp_of(sec: int, nsec: int) -> int | None:
    """ns since 1970, None for zero, which is a stamp that nobody set.

    Raises `FrameError` for one that cannot be: negative, a second or more of nanoseconds, beyond int64.
    """
    if 0 <= nsec < 10**9 and sec >= 0:
        stamp_ns = sec * 10**9 + nsec
        if stamp_ns <= _LAST_NS:
            return stamp_ns or None
    raise FrameError(f"its stamp cannot be: {sec} s, {nsec} ns")


def header(sec: int, nsec: int, frame_id: str) -> Header:
    return Header(stamp_of(sec, nsec), frame_id)


def image(
    head: Header, height: int, width: int, encoding: str, big_endian: int, step: int, data: Bytes
) -> RawImage:
    return RawImage(head, width, height, encoding, bool(big_endian), step, data)


def compressed(head: Header, format: str, data: Bytes) -> CompressedImage:
    return CompressedImage(head, format, data)


def points(
    head: Header,
    height: int,
    width: int,
    fields: Sequence[tuple[Any, ...]],
    big_endian: int,
    point_step: int,
    row_step: int,
    data: Bytes,
) -> Points:
    """ROS's form: `fields` are (name, offset, datatype, count)."""
    made = point_fields(tuple(fields), "ros", bool(big_endian))
    return Points(head, width, height, made, point_step, row_step, data)


@lru_cache(256)
def point_fields(
    fields: tuple[tuple[Any, ...], ...], numbering: str, big_endian: bool = False
) -> tuple[PointField, ...]:
    """(name, offset, number of the type[, count]) each; a count of 0 is meant as 1. All clouds of a topic
    have the same fields, so they are remembered.
    """
    if len(fields) > MAX_FIELDS:
        raise FrameError(f"it claims {len(fields)} fields a point")
    made = []
    for name, offset, kind, *count in fields:
        if kind not in TYPES[numbering]:
            raise FrameError(f"its field {name!r} is of an unknown type, {kind}")
        dtype = np.dtype(TYPES[numbering][kind])
        made.append(
            PointField(name, offset, dtype.newbyteorder() if big_endian else dtype, *(c or 1 for c in count))
        )
    return tuple(made)


def livox(head: Header, records: Records) -> Points:
    """Livox's own message as points; the fields under the names that everybody else uses."""
    names = {"reflectivity": "intensity", "line": "ring"}
    fields = tuple(
        PointField(names.get(name, name), offset, dtype) for name, (offset, dtype) in records.fields.items()
    )
    row_step = records.count * records.step
    return Points(head, records.count, 1, fields, records.step, row_step, records.view)


def camera(
    head: Header,
    height: int,
    width: int,
    model: str,
    D: Sequence[float],
    K: Sequence[float],
    R: Sequence[float],
    P: Sequence[float],
) -> CameraInfo:
    matrices = [_matrix("K", K, 3), _matrix("R", R, 3), _matrix("P", P, 4)]
    return CameraInfo(head, width, height, model, tuple(D), *matrices)


def _matrix(name: str, values: Sequence[float], columns: int) -> NDArray[np.float64]:
    """3 x `columns`; zeros where the message has none, which is ROS's word for a camera not calibrated."""
    if len(values) not in (0, 3 * columns):
        raise FrameError(f"its {name} has {len(values)} numbers, not {3 * columns}")
    return np.array(values or (0.0,) * (3 * columns), np.float64).reshape(3, columns)


def transforms(items: Sequence[tuple[Any, ...]]) -> Transforms:
    """Of (sec, nsec, parent, child, x, y, z, and the quaternion x, y, z, w) each."""
    made = []
    for sec, nsec, parent, child, *numbers in items:
        T = _pose(*numbers)
        if T is None:
            raise FrameError(f"its transformation from {child!r} to {parent!r} is none: {numbers}")
        made.append(Transform(stamp_of(sec, nsec), parent, child, T))
    return Transforms(tuple(made))


def _pose(
    x: float, y: float, z: float, qx: float, qy: float, qz: float, qw: float
) -> NDArray[np.float64] | None:
    """`geometry.rotation_of_quat`'s formula on plain numbers: arrays take ten times as long for one."""
    length = math.hypot(qx, qy, qz, qw)
    if not (math.isfinite(x + y + z) and _LENGTHS[0] < length < _LENGTHS[1]):
        return None
    a, b, c, w = qx / length, qy / length, qz / length, qw / length
    rows = (
        (1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b), x),
        (2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a), y),
        (2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b), z),
        (0, 0, 0, 1),
    )
    return np.array(rows, np.float64)
