"""The warp of a rig by the depth that each pixel has: a z-buffer on the thermal grid tells what is hidden."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.errors import FrameError
from fusion.geometry import FisheyeCamera, Floats
from fusion.rig import Rig, RigCamera
from fusion.rig_warp.fixed import RigWarp, metres_of
from fusion.rig_warp.views import (
    MARGIN_PX,
    Sampling,
    Value,
    Views,
    blocks,
    checked_index,
    locked,
    positions,
    wh,
)
from fusion.warp import Counts, Size, checked_counts

_SAME_SHARE, _SAME_PX = 0.02, 1.0  # nearer by less than this share and this parallax: the same surface


@dataclass(frozen=True, slots=True, eq=False)
class Warped:
    """Thermal on the RGB grid by depth.

    `index` (H x W uint8) holds where `mask` (H x W uint8) is 255. `hidden` counts the pixels that something
    nearer hides from the thermal camera, `unknown` those in its view without depth, `assumed` those seen
    at the fixed distance for want of depth. `counts` (H x W uint16, 0 where `mask` is 0) is what was measured
    there, None where it was not asked for.
    """

    index: NDArray[np.uint8]
    mask: NDArray[np.uint8]
    hidden: int
    unknown: int
    assumed: int
    counts: NDArray[np.uint16] | None = None


class DepthWarp:
    """Carries a thermal image onto the RGB grid by a rig and each RGB pixel's own depth.

    `mask`, `coverage`, `full`, `crop_xywh` and `border_ltrb` are those of `fixed`: what thermal reaches at
    infinity, or at `distance_m` where given; pixels without depth are then taken to be so far. `value` says
    what maps hold: depth along the RGB camera's axis, or range from its centre (None: what `fusion depth`
    writes for this camera). Safe to share between threads, each of which keeps work memory of its own.

    A point is hidden where another RGB pixel's point covers it on the thermal grid, nearer to the thermal
    camera by 2 % and a (thermal) pixel of parallax. What hides something but is itself not in the RGB
    picture, or has no depth, cannot be known.
    """

    is_identity = False

    def __init__(
        self,
        rig: Rig,
        fir_size_wh: Size,
        rgb_size_wh: Size,
        *,
        value: Value | None = None,
        distance_m: float | None = None,
        undistort: bool = False,
    ) -> None:
        """Raises as `RigWarp.fixed` does."""
        self.views = views = Views.of(rig, fir_size_wh, rgb_size_wh, undistort)
        rays = np.concatenate([views.rays(uv) for _, uv in blocks(views.output.size_wh)])
        self.fixed = RigWarp.of(views, metres_of(distance_m), rays)
        self.value: Value = value or views.value
        self.distance_m = distance_m
        self.mask, self.coverage, self.full = self.fixed.mask, self.fixed.coverage, self.fixed.full
        self.crop_xywh, self.border_ltrb = self.fixed.crop_xywh, self.fixed.border_ltrb
        per_value = views.per_value(rays, self.value) @ views.T_fir_rgb[:3, :3].T
        self._ray = locked(np.ascontiguousarray(per_value.T, np.float32))
        self._half = locked(_half_extents(views, rays))
        self._otherwise = None if distance_m is None else _assumed(views, rays, distance_m, self.value)
        self._source = None if views.output is views.rgb else _nearest_source(views, rays)
        self._lens = _lens(views.fir)
        away = float(np.linalg.norm(views.T_fir_rgb[:3, 3]))
        focal = max(views.fir.fx, views.fir.fy)
        self._jump = np.float32(_SAME_PX / (focal * away) if away > 0 else math.inf)

    def rgb(self, bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """As `RigWarp.rgb`."""
        return self.fixed.rgb(bgr)

    def apply(
        self,
        index: NDArray[np.uint8],
        depth_m: NDArray[np.float32] | None,
        out: NDArray[np.uint8] | None = None,
        *,
        fir: Counts | None = None,
    ) -> Warped:
        """`index` (h x w uint8, thermal grid) sampled bilinearly where each RGB pixel's point is seen.

        `depth_m` is H x W float32 metres on the RGB camera's own grid, 0 (or NaN, inf) where there is none;
        None: nowhere. `fir`, the counts that `index` was made of (h x w uint8 or uint16), is sampled at the
        same positions into `counts` of the result. Raises `FrameError` for another size, `ValueError` for
        another type.
        """
        from fusion.kernels import resample
        from fusion.kernels16 import resample_counts

        image = checked_index(index, self.views)
        measured = None if fir is None else checked_counts(fir, self.views.fir.size_wh)
        sampling, mask, tally = self._sampling(depth_m)
        counts = None if measured is None else resample_counts(measured, *sampling, mask)
        return Warped(resample(image, *sampling, out), mask, *tally, counts)

    def counts(self, fir: Counts, depth_m: NDArray[np.float32] | None) -> NDArray[np.uint16]:
        """The counts (h x w uint8 or uint16) on the output grid: H x W uint16, 0 where none are seen.

        Sampled as `apply` samples, which gives both in one go.
        """
        from fusion.kernels16 import resample_counts

        fir = checked_counts(fir, self.views.fir.size_wh)
        sampling, mask, _ = self._sampling(depth_m)
        return resample_counts(fir, *sampling, mask)

    def positions(self, depth_m: NDArray[np.float32] | None) -> Floats:
        """Where each output pixel samples the thermal image: H x W x 2 (x, y) in 1/256 px; NaN: nowhere."""
        sampling, mask, _ = self._sampling(depth_m)
        return positions(*sampling, mask, self.views.fir.size_wh)

    def _sampling(
        self, depth_m: NDArray[np.float32] | None
    ) -> tuple[Sampling, NDArray[np.uint8], tuple[int, int, int]]:
        """What `resample` reads, in this thread's work memory; the mask, and the counts of `Warped`."""
        W, H = self.views.output.size_wh
        offset, fraction = _buffer("offset", W * H, np.uint32), _buffer("fraction", W * H, np.uint16)
        mask = np.empty(W * H, np.uint8)
        counts = self._see(self._values(depth_m), offset, fraction, mask)
        return (offset.reshape(H, W), fraction.reshape(H, W)), mask.reshape(H, W), counts

    def _values(self, depth_m: NDArray[np.float32] | None) -> NDArray[np.float32]:
        """Each output pixel's metres: negative where they are only assumed, 0 where not even that."""
        W, H = self.views.output.size_wh
        value = _buffer("value", W * H, np.float32)
        if depth_m is None:
            value[:] = 0
        else:
            given = _checked_depth(depth_m, self.views).reshape(-1)
            np.copyto(value, given) if self._source is None else np.take(
                given, self._source, out=value, mode="clip"
            )
        good = (value > 0) & (value < np.float32(math.inf))
        np.copyto(value, 0 if self._otherwise is None else self._otherwise, where=~good)
        return value

    def _see(
        self,
        value: NDArray[np.float32],
        offset: NDArray[np.uint32],
        fraction: NDArray[np.uint16],
        mask: NDArray[np.uint8],
    ) -> tuple[int, int, int]:
        from fusion import rig_warp_kernels as loops

        n, (w, h), (W, H) = value.size, self.views.fir.size_wh, self.views.output.size_wh
        x, y, near = (_buffer(name, n, np.float32) for name in ("x", "y", "near"))
        nearest = _buffer("nearest", w * h, np.float32).reshape(h, w)
        nearest[:] = 0
        t = _singles(self.views.T_fir_rgb[:3, 3])
        box = _singles((-MARGIN_PX, w - 1 + MARGIN_PX, -MARGIN_PX, h - 1 + MARGIN_PX))
        place = loops.place_fisheye if isinstance(self.views.fir, FisheyeCamera) else loops.place_pinhole
        place(self._ray, value, t, *self._lens, box, x, y, near)
        grids = (array.reshape(H, W) for array in (x, y, near))
        loops.spread(*grids, self._half, self._jump, nearest)
        same, inside = np.float32(_SAME_SHARE), self.mask.reshape(-1)
        return loops.judge(x, y, near, nearest, same, self._jump, inside, value, offset, fraction, mask)


def _half_extents(views: Views, rays: Floats) -> NDArray[np.float32]:
    """Half of what an output pixel measures on the thermal grid, left and right, up and down: 2 x H x W."""
    W, H = views.output.size_wh
    xy, _ = views.thermal_px(rays, math.inf)
    grid = xy.reshape(H, W, 2)
    steps = []
    for axis in (0, 1):
        step = np.abs(np.diff(grid, axis=axis)) if grid.shape[axis] > 1 else np.ones_like(grid)
        steps.append(np.concatenate([step, step[(slice(None),) * axis + (slice(-1, None),)]], axis)[:H, :W])
    largest = np.nan_to_num(np.maximum(*steps) / 2, nan=0.5, posinf=0.5)
    return np.ascontiguousarray(np.minimum(largest, 8).transpose(2, 0, 1), np.float32)


def _assumed(views: Views, rays: Floats, distance_m: float, value: Value) -> NDArray[np.float32]:
    """Minus the `value` of every pixel's point at the fixed distance; 0 where it has none."""
    metres = np.full(len(rays), distance_m)
    if value != views.value:
        with np.errstate(invalid="ignore", divide="ignore"):
            metres = metres / rays[:, 2] if value == "range" else metres * rays[:, 2]
    metres = np.where((metres > 0) & (metres < math.inf), metres, 0)
    return locked(np.negative(metres).astype(np.float32))


def _nearest_source(views: Views, rays: Floats) -> NDArray[np.int64]:
    """The RGB pixel nearest to each output pixel, as a flat index: depth is not mixed across edges."""
    w, h = views.rgb.size_wh
    xy, _ = views.rgb.project(rays)
    column, row = np.clip(np.floor(np.nan_to_num(xy) + 0.5), 0, (w - 1, h - 1)).astype(np.int64).T
    return locked(row * w + column)


def _lens(camera: RigCamera) -> tuple[tuple[np.float32, ...], np.float32]:
    """Numbers of the thermal camera for the loops, and the largest squared radius, or angle, in its picture.

    Beyond that a lens's polynomial may turn back into the picture.
    """
    w, h = camera.size_wh
    grid = np.stack(np.meshgrid(np.linspace(-1, w, 65), np.linspace(-1, h, 65)), -1).reshape(-1, 2)
    x, y, z = camera.unproject(grid).T
    everywhere = bool(np.isfinite(z).all())  # else the lens's own limit lies within the picture
    if isinstance(camera, FisheyeCamera):
        numbers = (*camera.distortion, *(0.0,) * (4 - len(camera.distortion)))
        reach = float(np.arctan2(np.hypot(x, y), z).max()) if everywhere else camera.valid_angle()
    else:
        numbers = (*camera.distortion, *(0.0,) * (8 - len(camera.distortion)))
        reach = float(((x * x + y * y) / (z * z)).max()) if everywhere else camera.valid_radius() ** 2
    return _singles((camera.fx, camera.fy, camera.cx, camera.cy, *numbers)), np.float32(reach)


def _singles(numbers: Any) -> tuple[np.float32, ...]:
    return tuple(np.float32(number) for number in numbers)


def _buffer(name: str, count: int, kind: Any) -> NDArray[Any]:
    from fusion.kernels import scratch

    return scratch(f"rig_warp.{name}", (count,), kind)


def _checked_depth(depth_m: NDArray[np.float32], views: Views) -> NDArray[np.float32]:
    if depth_m.dtype != np.float32 or depth_m.ndim != 2:
        raise ValueError(f"expected H x W float32 metres, got {depth_m.shape} {depth_m.dtype}")
    if depth_m.shape[::-1] != tuple(views.rgb.size_wh):
        ours, theirs = wh(views.rgb.size_wh), wh(depth_m.shape[::-1])
        hint = "make it with `fusion depth --rig` and this rig"
        raise FrameError(f"the depth map is {theirs}, the RGB camera {ours}", hint=hint)
    return np.ascontiguousarray(depth_m)
