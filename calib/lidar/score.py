"""How well a cloud's edges lie on an image's: oriented edge points against orientation channels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from fusion.geometry import Camera, Floats, transform

CHANNELS = 4  # unsigned directions of the gradient: across, diagonal, down, diagonal
_NEIGHBOURS = 9
_JUMP, _JUMP_M = 0.05, 0.15  # of the range, and at least: what counts as a step in depth
_MOST_EDGES = 6000
_INTENSITY_WEIGHT = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class SceneEdges:
    """Points of a scan where depth or reflectance steps, LiDAR frame.

    `xyz_m` (N, 3) on the rim of the nearer thing, `toward_m` (N, 3) the same, moved across the edge; `weight`
    (N,). `depth` (N,) says which are steps in depth, the others are steps in intensity.
    """

    xyz_m: Floats
    toward_m: Floats
    weight: Floats
    depth: NDArray[np.bool_]


def scene_edges(xyz_m: Floats, intensity: NDArray[Any] | None) -> SceneEdges:
    """Steps between neighbouring directions of N x 3 points, finite and not zero.

    A step in depth counts with the root of its relative height, half way to the farther neighbour; one in
    intensity, if it is well above the noise between neighbours, with its height in the intensities' spread.
    The strongest 6,000 of either sort are kept.
    """
    range_m = np.linalg.norm(xyz_m, axis=1)
    ray = xyz_m / range_m[:, None]
    if len(xyz_m) <= _NEIGHBOURS:
        return _none()
    found: Any = KDTree(ray).query(ray, _NEIGHBOURS)
    gap, near = found[0][:, 1:], found[1][:, 1:]
    usual = float(np.median(gap[:, 0]))
    close = (gap < 12 * usual) & (gap > 0)
    rise = np.where(close, range_m[near] - range_m[:, None], 0.0)
    jump = rise > np.maximum(_JUMP * range_m[:, None], _JUMP_M)
    # The nearest neighbour beyond a step: where the rim is, is known best there.
    first = np.argmax(jump, 1)
    is_depth = jump[np.arange(len(jump)), first]
    parts = [_at(ray, range_m, near, gap, first, is_depth, np.sqrt(_height(rise, range_m, first)), True)]
    if intensity is not None and np.ptp(intensity) > 0:
        value = np.asarray(intensity, np.float64)
        spread = max(float(np.ptp(np.percentile(value, (5, 95)))), 1e-12)
        change = np.where(
            close & (np.abs(rise) < _JUMP * range_m[:, None]), np.abs(value[near] - value[:, None]), 0
        )
        strongest = np.argmax(change, 1)
        height = change[np.arange(len(change)), strongest]
        noise = float(np.median(np.abs(value[near[:, 0]] - value)))
        marked = (height > max(0.25 * spread, 6 * noise)) & ~jump.any(1)
        height = np.minimum(height / spread, 1)
        parts.append(_at(ray, range_m, near, gap, strongest, marked, _INTENSITY_WEIGHT * height, False))
    return SceneEdges(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _none() -> SceneEdges:
    return SceneEdges(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, bool))


def _height(rise: Floats, range_m: Floats, which: NDArray[np.intp]) -> Floats:
    rows = np.arange(len(rise))
    return np.clip(rise[rows, which] / range_m, 0, 1)


def _at(
    ray: Floats,
    range_m: Floats,
    near: NDArray[np.intp],
    gap: Floats,
    which: NDArray[np.intp],
    marked: NDArray[np.bool_],
    weight: Floats,
    depth: bool,
) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
    rows = np.flatnonzero(marked)
    if len(rows) > _MOST_EDGES:
        rows = np.sort(rows[np.argsort(-weight[rows], kind="stable")[:_MOST_EDGES]])
    other = near[rows, which[rows]]
    middle = ray[rows] + ray[other]
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    r = range_m[rows, None]
    # An edge is known to half the gap between both rays.
    sure = 1 / (1 + (gap[rows, which[rows]] / 0.01) ** 2)
    return r * middle, r * ray[other], weight[rows] * sure, np.full(len(rows), depth)


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """Orientation channels of an image, H x W x 4 float32, mean 0 and deviation 1; `scale` is its pixels a
    pixel of the image.
    """

    maps: NDArray[np.float32]
    scale: float


def orientation_fields(image: NDArray[Any], sigmas_px: tuple[float, ...], scale: float) -> list[Field]:
    """Blurred to each of `sigmas_px` (of the image's own pixels), of an image made smaller by `scale`.

    The image is H x W or H x W x 3 of any number; contrast is made equal locally, so that weak
    and strong edges count alike.
    """
    grey = np.asarray(image, np.float32)
    grey = grey if grey.ndim == 2 else cv2.cvtColor(grey, cv2.COLOR_BGR2GRAY)
    if scale < 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    grey = cv2.GaussianBlur(grey, (0, 0), 1.0)
    gx, gy = cv2.Scharr(grey, cv2.CV_32F, 1, 0), cv2.Scharr(grey, cv2.CV_32F, 0, 1)
    angles = np.arange(CHANNELS) * np.pi / CHANNELS
    steps = np.stack([np.abs(gx * np.float32(np.cos(a)) + gy * np.float32(np.sin(a))) for a in angles], -1)
    energy = cv2.blur(np.hypot(gx, gy), (31, 31))
    steps /= (energy + 0.2 * float(energy.mean()) + 1e-6)[..., None]
    steps = np.minimum(steps, 4)
    fields = []
    for sigma in sigmas_px:
        maps = cv2.GaussianBlur(steps, (0, 0), max(sigma * scale, 0.7))
        # What surrounds is taken off: a busy part of the image attracts nothing by itself.
        maps = maps - cv2.GaussianBlur(steps, (0, 0), max(6 * sigma * scale, 6.0))
        deviation = maps.std((0, 1), keepdims=True)
        fields.append(Field(np.asarray(maps / np.maximum(deviation, 1e-6), np.float32), scale))
    return fields


@dataclass(frozen=True, slots=True, eq=False)
class Lifted:
    """A scan's edges with the weight of each in each channel: `xyz_m` (N, 3), `weights` (N, 4)."""

    xyz_m: Floats
    weights: Floats

    def part(self, rows: NDArray[Any]) -> Lifted:
        return Lifted(self.xyz_m[rows], self.weights[rows])


def lift(edges: SceneEdges, camera: Camera, T_cam_lidar: Floats) -> tuple[Lifted, Floats]:
    """The edges that fall into the picture or a tenth beside it, their directions as seen from the start;
    their pixels.
    """
    uv, seen = camera.project(transform(T_cam_lidar, edges.xyz_m))
    toward, seen_too = camera.project(transform(T_cam_lidar, edges.toward_m))
    w, h = camera.size_wh
    with np.errstate(invalid="ignore"):
        inside = (np.abs(uv / [w, h] - 0.5) < 0.6).all(1) & seen & seen_too
    d = toward[inside] - uv[inside]
    angle = np.arctan2(d[:, 1], d[:, 0])
    centres = np.arange(CHANNELS) * np.pi / CHANNELS
    share = np.maximum(np.cos(2 * (angle[:, None] - centres)), 0)
    share /= np.maximum(share.sum(1, keepdims=True), 1e-9)
    return Lifted(edges.xyz_m[inside], share * edges.weight[inside, None]), uv[inside]


def edge_score(lifted: Lifted, camera: Camera, T_cam_lidar: Floats, field: Field) -> float:
    """The weighted mean of the field where the edges are projected; an edge out of the picture counts as 0,
    which is the mean of a field: leaving is no gain.
    """
    total = lifted.weights.sum()
    if total <= 0:
        return 0.0
    uv, seen = camera.project(transform(T_cam_lidar, lifted.xyz_m))
    at = (uv + 0.5) * field.scale - 0.5
    h, w = field.maps.shape[:2]
    with np.errstate(invalid="ignore"):
        inside = seen & (at >= 0).all(1) & (at[:, 0] < w - 1) & (at[:, 1] < h - 1)
    at, weights = at[inside], lifted.weights[inside]
    corner = at.astype(np.intp)
    a, b = (at - corner).T
    x, y = corner.T
    flat = field.maps.reshape(-1, CHANNELS)
    k = y * w + x
    top = flat[k] * (1 - a)[:, None] + flat[k + 1] * a[:, None]
    bottom = flat[k + w] * (1 - a)[:, None] + flat[k + w + 1] * a[:, None]
    return float((weights * (top * (1 - b)[:, None] + bottom * b[:, None])).sum() / total)
