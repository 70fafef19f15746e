"""A cloud seen by a camera: the list of samples, and its z-buffered picture (thesis 6.2, equation 6.1)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.errors import UsageError
from fusion.frames import PointCloud
from fusion.geometry import T_CAM_LIDAR, Camera, Floats, PinholeCamera, checked_pose, transform
from fusion.kernels import read_only
from fusion.lidar.kernels import nearest_of_pixels, project_pinhole
from fusion.lidar.sparse import SparseDepth, Value

FARTHEST_M = 65535 / 256  # what a depth PNG can hold
_CHUNK = 1 << 18  # points at a time, so that memory beside the result stays small

Samples = tuple[Floats, Floats, NDArray[np.float32], NDArray[np.int64]]


def project(
    cloud: PointCloud,
    camera: Camera,
    T_cam_lidar: Floats = T_CAM_LIDAR,
    *,
    value: Value = "depth",
    limits_m: tuple[float, float] = (0.0, FARTHEST_M),
) -> SparseDepth:
    """The thesis's list (r_i, c_i, d_i) of a cloud: exact, not rounded, every point of its own.

    `value` is "range", distance to the camera's centre (the thesis's d), or "depth", along its axis. A
    point is kept if the camera model can see it at all (in front of a pinhole, inside the radius where its
    distortion is valid), if it falls into the picture, and if its value lies in `limits_m`. The order is the
    cloud's; rings are those of its field ``ring``. `counts` has read, finite, in_front, in_frame, in_range.
    Raises `UsageError` for depth of a camera that has no axis, and for a transformation that is not rigid.
    """
    check_value(camera, value)
    T = checked_pose(T_cam_lidar, where="T_cam_lidar")
    counts = np.zeros(3, np.int64)
    parts = list(_parts(cloud, camera, T, value == "range", limits_m, counts))
    u, v, values, index = (
        np.concatenate(lists) if len(lists) != 1 else lists[0] for lists in zip(*parts, strict=True)
    )
    ring = cloud.fields.get("ring")
    return SparseDepth(
        camera.size_wh,
        u,
        v,
        values,
        value,
        index,
        None if ring is None else np.asarray(ring[index], np.int32),
        {
            "read": len(cloud) if cloud.read is None else cloud.read,
            "finite": len(cloud),
            **dict(zip(("in_front", "in_frame", "in_range"), counts.tolist(), strict=True)),
        },
    )


def check_value(camera: Camera, value: Value) -> None:
    """Refuse depth along an axis where pixels look sideways or back."""
    if value not in ("depth", "range"):
        raise ValueError(f"expected depth or range, got {value!r}")
    if value == "depth" and not camera.has_axis:
        hint = "use range: the distance to the camera's centre"
        raise UsageError("depth along the axis means nothing for a camera that looks all round", hint=hint)


def z_buffer(sparse: SparseDepth) -> NDArray[np.float32]:
    """The sparse picture: the least value of the samples that fall into each pixel, 0 where none does.

    Raises `ValueError` for samples outside the picture.
    """
    w, h = sparse.size_wh
    image = np.zeros((h, w), np.float32)
    samples = (sparse.u, sparse.v, sparse.value_m)
    outside = nearest_of_pixels(*(read_only(np.ascontiguousarray(a)) for a in samples), image)
    if outside:
        raise ValueError(f"expected samples inside {w}x{h} pixels, got {outside} outside")
    return image


def from_image(depth_m: NDArray[np.floating[Any]], value: Value = "depth") -> SparseDepth:
    """The samples of a sparse picture, H x W, 0 where there is none (as KITTI has them), row by row."""
    if depth_m.ndim != 2:
        raise ValueError(f"expected HxW, got {depth_m.shape}")
    rows, columns = np.nonzero(depth_m > 0)
    values = depth_m[rows, columns].astype(np.float32)
    index = np.ravel_multi_index((rows, columns), depth_m.shape).astype(np.int64)
    counts = {name: len(values) for name in ("read", "finite", "in_front", "in_frame", "in_range")}
    size_wh = depth_m.shape[1], depth_m.shape[0]
    return SparseDepth(
        size_wh, columns.astype(np.float64), rows.astype(np.float64), values, value, index, None, counts
    )


def _parts(
    cloud: PointCloud,
    camera: Camera,
    T: Floats,
    use_range: bool,
    limits_m: tuple[float, float],
    counts: NDArray[np.int64],
) -> Iterator[Samples]:
    """The samples of a chunk of points after the other; `counts` grows by in front, in frame, in range."""
    for first in range(0, max(len(cloud), 1), _CHUNK):
        xyz = cloud.xyz_m[first : first + _CHUNK]
        if isinstance(camera, PinholeCamera) and not any(camera.distortion):
            yield _through_pinhole(xyz, camera, T, use_range, limits_m, first, counts)
        else:
            yield _through_model(xyz, camera, T, use_range, limits_m, first, counts)


def _through_pinhole(
    xyz: NDArray[Any],
    camera: PinholeCamera,
    T: Floats,
    use_range: bool,
    limits_m: tuple[float, float],
    first: int,
    counts: NDArray[np.int64],
) -> Samples:
    n = len(xyz)
    u, v, values, index = np.empty(n), np.empty(n), np.empty(n, np.float32), np.empty(n, np.int64)
    # One type for each argument, whatever was given: every other one would be compiled anew.
    intrinsics = (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
    size = (int(camera.size_wh[0]), int(camera.size_wh[1]))
    limits = (float(limits_m[0]), float(limits_m[1]))
    kept = project_pinhole(
        read_only(np.ascontiguousarray(xyz)),
        T,
        intrinsics,
        size,
        limits,
        use_range,
        first,
        u,
        v,
        values,
        index,
        counts,
    )
    return u[:kept], v[:kept], values[:kept], index[:kept]


def _through_model(
    xyz: NDArray[Any],
    camera: Camera,
    T: Floats,
    use_range: bool,
    limits_m: tuple[float, float],
    first: int,
    counts: NDArray[np.int64],
) -> Samples:
    """Any model, in plain numpy: also what the compiled way is tested against."""
    at = transform(T, xyz)
    uv, seen = camera.project(at)
    w, h = camera.size_wh
    with np.errstate(invalid="ignore"):
        inside = seen & (uv >= -0.5).all(1) & (uv[:, 0] < w - 0.5) & (uv[:, 1] < h - 0.5)
    d = np.linalg.norm(at, axis=1) if use_range else at[:, 2]
    kept = inside & (d >= limits_m[0]) & (d <= limits_m[1]) & (d > 0)
    counts += [np.count_nonzero(seen), np.count_nonzero(inside), np.count_nonzero(kept)]
    return uv[kept, 0], uv[kept, 1], d[kept].astype(np.float32), first + np.flatnonzero(kept)
