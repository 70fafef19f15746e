"""What a camera sees of a map: its points become small oriented discs, which hide what lies behind them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.frames import PointCloud
from fusion.geometry import Camera
from fusion.kernels import read_only
from fusion.lidar import surfel_kernels

NEIGHBOURS = 16  # for a normal
COVER = 8  # a disc reaches to this neighbour: of points strewn at random exp(-8) of the surface stays bare
WIDE = 3.0  # lesser deviations across the normal: half a disc's radius, of a cable's points nothing
FLAT = 0.8  # of that deviation, at most, along the normal: else a point hangs in the air
LONELY = 0.5  # of its neighbours' reach, for a point that is on no surface
LARGEST = 4.0  # times the map's median radius
TOLERANCE = 0.4  # radii along the normal, beside half a pixel of the range image
GRAZING = 0.1  # the least cosine of incidence that counts
STEP = 2  # pixels a side of a pixel of the range image
MOST_PX = 64.0  # of the range image
_CHUNK = 1 << 17


@dataclass(frozen=True, slots=True)
class Surfels:
    """A disc a point: unit `normal` (N x 3 float32, in the cloud's frame, sign arbitrary) and `radius_m` (N
    float32).
    """

    normal: NDArray[np.float32]
    radius_m: NDArray[np.float32]

    def __post_init__(self) -> None:
        if self.normal.shape != (*self.radius_m.shape, 3) or self.radius_m.ndim != 1:
            raise ValueError(
                f"expected Nx3 normals and N radii, got {self.normal.shape}, {self.radius_m.shape}"
            )


def surfels_of(cloud: PointCloud) -> Surfels:
    """A disc for each point, once a map: normals of least variance over 16 neighbours, radii to the eighth.

    A disc is no wider than its neighbours' lesser spread (a cable is no wall), and small where they form no
    surface, where the point does not lie on it, or hangs in the air: twice as far from its neighbours as they
    are from theirs. Clouds of fewer than three points give discs of radius 0. Builds a tree over all points.
    """
    from scipy.spatial import KDTree

    n = len(cloud)
    normal, radius = np.tile(np.array([0, 0, 1], np.float32), (n, 1)), np.zeros(n, np.float32)
    if n >= 3:
        xyz = np.asarray(cloud.xyz_m, np.float64)
        tree: Any = KDTree(xyz - xyz.mean(0), balanced_tree=False, compact_nodes=False)
        parts = [slice(start, start + _CHUNK) for start in range(0, n, _CHUNK)]
        cover = min(COVER, n - 1) + 1
        reach = np.concatenate([tree.query(tree.data[part], [cover])[0][:, 0] for part in parts])
        for part in parts:
            normal[part], radius[part] = _discs(tree, reach, part, min(NEIGHBOURS, n))
        np.minimum(radius, LARGEST * np.median(radius), out=radius)
    return Surfels(normal, radius)


def _discs(
    tree: Any, reach: NDArray[np.float64], part: slice, k: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    _, index = tree.query(tree.data[part], k)
    near = tree.data[index] - tree.data[part, None]
    middle = near.mean(1)
    near -= middle[:, None]
    spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near) / k)
    normal = axes[:, :, 0]
    thick, wide, _ = np.sqrt(np.maximum(spread, 0)).T  # deviations along the normal, and across it the lesser
    off = np.abs((normal * middle).sum(1))
    around = np.median(reach[index], 1)
    flat = (thick < FLAT * wide) & (off < FLAT * wide) & (reach[part] < 2 * around)
    radius = np.minimum(reach[part], WIDE * wide)
    return normal, np.where(flat, radius, np.minimum(radius, LONELY * around))


def visible_in_map(
    xyz_cam_m: NDArray[np.floating[Any]],
    camera: Camera,
    normal_cam: NDArray[np.floating[Any]],
    radius_m: NDArray[np.floating[Any]],
    *,
    tolerance: float = TOLERANCE,
) -> NDArray[np.bool_]:
    """Which of N x 3 points in the camera's frame (metres) it sees, N bool; False for those outside the
    frame.

    All discs (`normal_cam` N x 3 unit, camera's frame; `radius_m` N) are drawn into a range image, met
    exactly by the ray of each pixel; a point is hidden where it lies behind that image, at its pixel, by
    more than
    `tolerance` times its radius, plus half a pixel, over the cosine of incidence (no less than 0.1: 84
    degrees). So what lies just behind a surface passes for it. Discs of points outside the frame count as
    far as they reach into it. Works with every camera model. Raises `ValueError` for wrong shapes.
    """
    xyz = np.ascontiguousarray(xyz_cam_m, np.float32)
    normal, radius = np.ascontiguousarray(normal_cam, np.float32), np.ascontiguousarray(radius_m, np.float32)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or normal.shape != xyz.shape or radius.shape != xyz.shape[:1]:
        raise ValueError(
            f"expected Nx3 points and normals, N radii, got {xyz.shape}, {normal.shape}, {radius.shape}"
        )
    uv, seen = camera.project(np.asarray(xyz_cam_m, np.float64))
    u, v = (
        np.ascontiguousarray(a, np.float32)
        for a in ((np.where(seen[:, None], uv, -1e6) + 0.5) / STEP - 0.5).T
    )
    range_m = np.linalg.norm(xyz, axis=1)
    flags, rays = read_only(seen), _rays(camera)
    buffer = np.full(rays.shape[:2], np.inf, np.float32)
    order = np.empty(len(xyz), np.int64)
    drawn = order[
        : surfel_kernels.near_first(u, v, range_m, flags, np.float32(MOST_PX), *rays.shape[1::-1], order)
    ]
    surfel_kernels.splat(drawn, xyz, normal, radius, u, v, range_m, rays, np.float32(MOST_PX), buffer)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.nan_to_num(np.abs((xyz * normal).sum(1)) / range_m)
    blur = tolerance * radius + _half_cell(rays) * range_m
    allowed = (blur / np.maximum(cosine, GRAZING)).astype(np.float32)
    visible = np.empty(len(xyz), np.bool_)
    surfel_kernels.behind(u, v, range_m, allowed, flags, buffer, visible)
    size = np.asarray(camera.size_wh)
    return visible & ((uv >= -0.5) & (uv < size - 0.5)).all(
        1
    )  # an odd row or column reaches beyond the frame


def _half_cell(rays: NDArray[np.float32]) -> float:
    """Half the angle between neighbouring pixels in the middle of the picture; 0 where there are none."""
    row, column = rays.shape[0] // 2, rays.shape[1] // 2
    return float(np.nan_to_num(np.linalg.norm(rays[row, column] - rays[row, max(column - 1, 0)]) / 2))


@lru_cache(maxsize=4)
def _rays(camera: Camera) -> NDArray[np.float32]:
    """Unit vectors through the centres of blocks of `STEP` x `STEP` pixels; the last ones may reach beyond
    the frame.
    """
    w, h = camera.size_wh
    v, u = np.mgrid[: -(-h // STEP), : -(-w // STEP)]
    uv = (np.stack([u.ravel(), v.ravel()], -1) + 0.5) * STEP - 0.5
    rays = camera.unproject(uv.astype(np.float64))
    return read_only(np.ascontiguousarray(rays.reshape(*u.shape, 3), np.float32))
