"""Fewer points: by range, by box, one a voxel, without stragglers. What is left out is counted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.errors import UsageError
from fusion.frames import PointCloud


def crop_range(cloud: PointCloud, min_m: float = 0.0, max_m: float = math.inf) -> PointCloud:
    """The points whose distance to the origin lies in [min_m, max_m); the others count as ``range``.

    Raises `UsageError` unless 0 <= min_m < max_m.
    """
    if not 0 <= min_m < max_m:
        raise UsageError(f"a range from {min_m:g} to {max_m:g} m", hint="0 <= min < max")
    x, y, z = (cloud.xyz_m[:, k].astype(np.float64) for k in range(3))
    range_m = np.sqrt(x * x + y * y + z * z)
    return _kept(cloud, (range_m >= min_m) & (range_m < max_m), "range")


def crop_box(cloud: PointCloud, lo_xyz: Sequence[float], hi_xyz: Sequence[float]) -> PointCloud:
    """The points with lo <= p < hi on every axis (metres, infinite allowed); the others count as ``box``.

    Raises `UsageError` unless both have three numbers and lo < hi.
    """
    if len(lo_xyz) != 3 or len(hi_xyz) != 3 or not all(a < b for a, b in zip(lo_xyz, hi_xyz, strict=True)):
        raise UsageError(f"a box from {tuple(lo_xyz)} to {tuple(hi_xyz)}", hint="x y z, the lower end first")
    keep = np.ones(len(cloud), np.bool_)
    for k in range(3):
        keep &= (cloud.xyz_m[:, k] >= float(lo_xyz[k])) & (cloud.xyz_m[:, k] < float(hi_xyz[k]))
    return _kept(cloud, keep, "box")


def voxel(cloud: PointCloud, size_m: float) -> PointCloud:
    """One point a cube of `size_m`: the mean of those in it; the others count as ``voxel``.

    The grid is Open3D's: it begins half a voxel before the least coordinates. Fields are those of the point
    that is nearest to the mean (means of rings and times are nothing measured). Voxels come in the order of
    their first points. Raises `UsageError` for a size that is not positive, or so small that the cubes
    cannot be counted.
    """
    if not (math.isfinite(size_m) and size_m > 0):
        raise UsageError(f"voxels of {size_m:g} m", hint="a positive size in metres")
    if len(cloud) == 0:
        return _kept(cloud, np.ones(0, np.bool_), "voxel")
    group, count = _voxel_of(cloud.xyz_m, size_m)
    size = np.bincount(group, minlength=count)
    far = np.zeros(len(cloud))
    mean = np.empty((count, 3), cloud.xyz_m.dtype)
    for k in range(3):
        axis = cloud.xyz_m[:, k].astype(np.float64)
        middle = np.bincount(group, axis, count) / size
        mean[:, k] = middle
        far += (axis - middle[group]) ** 2
    order = np.lexsort((far, group))  # the nearest to its mean comes first of each group
    chosen = order[np.searchsorted(group[order], np.arange(count))]
    dropped = _counted(cloud, "voxel", len(cloud) - count)
    return replace(cloud, xyz_m=mean, fields={n: v[chosen] for n, v in cloud.fields.items()}, dropped=dropped)


def _voxel_of(xyz_m: NDArray[Any], size_m: float) -> tuple[NDArray[np.int64], int]:
    """The number of each point's voxel, in the order of their first points, and how many there are."""
    least = xyz_m.min(axis=0).astype(np.float64) - size_m / 2
    cells = [math.floor((float(xyz_m[:, k].max()) - least[k]) / size_m) + 1 for k in range(3)]
    if math.prod(cells) >= 1 << 62:
        hint = "larger voxels, or a crop first"
        raise UsageError(f"voxels of {size_m:g} m are too many for the cloud's extent", hint=hint)
    key = np.zeros(len(xyz_m), np.int64)
    for k in range(3):
        key *= cells[k]
        key += np.floor((xyz_m[:, k] - least[k]) / size_m).astype(np.int64)
    _, first, group = np.unique(key, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[group], len(first)


def statistical_outliers(cloud: PointCloud, neighbours: int = 20, ratio: float = 2.0) -> PointCloud:
    """Without the points whose mean distance to their `neighbours` nearest is large; they count as
    ``outlier``.

    Large is more than the mean over the cloud plus `ratio` standard deviations (Rusu 2009; computed by
    Open3D, for which a point is the first of its own neighbours). Raises `UsageError` for less than 2
    neighbours or a ratio that is not positive.
    """
    if neighbours < 2 or not (math.isfinite(ratio) and ratio > 0):
        raise UsageError(f"{neighbours} neighbours and a ratio of {ratio:g}", hint="2 or more, and above 0")
    keep = np.ones(len(cloud), np.bool_)
    if len(cloud) > 2:
        keep[:] = False
        keep[_inliers(cloud.xyz_m, neighbours, ratio)] = True
    return _kept(cloud, keep, "outlier")


def _inliers(xyz_m: NDArray[Any], neighbours: int, ratio: float) -> NDArray[np.int64]:
    from fusion.open3d import load

    o3d: Any = load()
    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.ascontiguousarray(xyz_m, np.float64)))
    _, index = points.remove_statistical_outlier(neighbours, ratio)
    return np.asarray(index, np.int64)


def _kept(cloud: PointCloud, keep: NDArray[np.bool_], why: str) -> PointCloud:
    left_out = len(keep) - int(np.count_nonzero(keep))
    fields = {name: values[keep] for name, values in cloud.fields.items()}
    return replace(cloud, xyz_m=cloud.xyz_m[keep], fields=fields, dropped=_counted(cloud, why, left_out))


def _counted(cloud: PointCloud, why: str, points: int) -> dict[str, int]:
    return {**cloud.dropped, why: cloud.dropped.get(why, 0) + points}
