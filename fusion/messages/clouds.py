"""From points as they were sent to a cloud."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.clouds.base import RawCloud, add_column, checked_count
from fusion.clouds.tidy import cloud_of
from fusion.errors import FrameError
from fusion.frames import PointCloud
from fusion.geometry import transform
from fusion.messages.base import PointField, Points

_MOST_COLUMNS = 1024
_MOST_BYTES_APART = 1 << 31


def cloud_of_points(points: Points, *, stem: str, where: str) -> PointCloud:
    """The valid points of a message, with its fields under our names; see `fusion.clouds.tidy.cloud_of`.

    Fields of several numbers become several (`name_0` …); rows are read in order. The stamp is the header's,
    unless the points tell their own since 1970. Where the points have a pose in their frame, it is applied.
    Raises `FrameError` for no points, for steps and fields that do not fit, and for bytes that are too few.
    """
    _check(points, where)
    columns: dict[str, NDArray[Any]] = {}
    for field in points.fields:
        for k in range(field.count):
            name = field.name if field.count == 1 else f"{field.name}_{k}"
            add_column(columns, name, _column(points, field, k))
    cloud = cloud_of(RawCloud(columns), where, stem, points.header.stamp_ns)
    if points.T_frame_points is None:
        return cloud
    moved = transform(points.T_frame_points, cloud.xyz_m)
    return replace(cloud, xyz_m=moved.astype(cloud.xyz_m.dtype))


def _check(points: Points, where: str) -> None:
    if points.width <= 0 or points.height <= 0:
        raise FrameError(f"a cloud of {points.width} x {points.height} points", where=where)
    checked_count(points.width * points.height, where)
    step = points.point_step
    if not 0 < step <= _MOST_BYTES_APART:
        raise FrameError(f"its points are {step} bytes apart", where=where)
    if sum(field.count for field in points.fields) > _MOST_COLUMNS:
        raise FrameError(f"its points have more than {_MOST_COLUMNS} numbers each", where=where)
    for field in points.fields:
        if field.offset < 0 or field.count < 1 or _end(field) > step:
            what = f"its field {field.name!r} ends at byte {_end(field)} of points of {step} bytes"
            raise FrameError(what, where=where)
    if points.height > 1 and points.row_step < points.width * step:
        what = f"its rows are {points.row_step} bytes apart, but {points.width} points of {step} bytes long"
        raise FrameError(what, where=where)
    extent = max(map(_end, points.fields), default=0)
    needed = (points.height - 1) * points.row_step + (points.width - 1) * step + extent
    if len(points.data) < needed:
        what = (
            f"its {points.width} x {points.height} points need {needed:,} bytes, it has {len(points.data):,}"
        )
        raise FrameError(what, where=where, hint="cut off while it was recorded?")


def _end(field: PointField) -> int:
    return field.offset + field.count * field.dtype.itemsize


def _column(points: Points, field: PointField, k: int) -> NDArray[Any]:
    """One number of every point: a view, unless rows are padded."""
    offset = field.offset + k * field.dtype.itemsize
    even = points.height == 1 or points.row_step == points.width * points.point_step
    shape = (points.height * points.width,) if even else (points.height, points.width)
    strides = (points.point_step,) if even else (points.row_step, points.point_step)
    view: NDArray[Any] = np.ndarray(shape, field.dtype, buffer=points.data, offset=offset, strides=strides)
    return view.reshape(-1)
