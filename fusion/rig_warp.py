"""The thermal image on the RGB grid by a calibrated rig: as if all were infinitely far, at one distance, or
at the depth that each pixel has. Undistortion is part of the one resampling.

A fixed map is computed once. With depth each RGB pixel's point is placed into the thermal image, and a
z-buffer on the thermal grid tells which points something nearer hides from the thermal camera.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fusion.errors import FrameError, UsageError
from fusion.geometry import FisheyeCamera, Floats, PinholeCamera, invert
from fusion.rig import Rig, RigCamera
from fusion.warp import STEPS, Size

Mode = Literal["infinity", "distance", "depth"]
Value = Literal["depth", "range"]
Sampling = tuple[NDArray[np.uint32], NDArray[np.uint16]]

PARALLAX_M = (0.5, 1.0, 2.0, 5.0, 10.0, math.inf)
_MARGIN_PX = 0.5 + 0.5 / STEPS  # as in `fusion.warp`
_BLOCK_PIXELS = 1 << 15
_SAME_SHARE, _SAME_PX = 0.02, 1.0  # nearer by less than this share and this parallax: the same surface
_LARGEST_FOCAL_GROWTH = 16.0


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """The two cameras of a rig as a warp needs them.

    `rgb` and `fir` are the cameras, `T_fir_rgb` takes points of the RGB camera's frame to the thermal one's.
    `output` is the camera of the frames that come out: `rgb` itself, or, with `undistort`, a pinhole without
    distortion, its focal lengths those of `rgb`, longer if some pixel would otherwise see past its picture.
    """

    rgb: RigCamera
    fir: RigCamera
    T_fir_rgb: Floats
    output: RigCamera

    @classmethod
    def of(cls, rig: Rig, fir_size_wh: Size, rgb_size_wh: Size, undistort: bool = False) -> Views:
        """Raises `UsageError` where the rig lacks a camera or a transformation, or is for other sizes."""
        rgb, fir = rig.camera("rgb"), rig.camera("fir")
        for role, camera, size in (("RGB", rgb, rgb_size_wh), ("thermal", fir, fir_size_wh)):
            if tuple(camera.size_wh) != tuple(size):
                hint = "a rig holds for the image size that it was calibrated at"
                what = f"the rig's {role} camera has {_wh(camera.size_wh)} pixels, the images {_wh(size)}"
                raise UsageError(what, hint=hint)
        return cls(rgb, fir, invert(rig.pose("rgb", "fir")), _rectified(rgb) if undistort else rgb)

    def rays(self, uv: Floats) -> Floats:
        """Unit directions N x 3, RGB camera's frame, of pixels of the output; NaN where none falls there."""
        return self.output.unproject(uv)

    def per_value(self, rays: Floats, value: Value) -> Floats:
        """Rays scaled to one unit of `value`: along the axis or from the centre; NaN behind the axis."""
        if value == "range":
            return rays
        return rays / np.where(rays[:, 2:] > 0, rays[:, 2:], np.nan)

    @property
    def value(self) -> Value:
        """What distances count along: the RGB camera's axis, or the ray, where it looks all round."""
        return "depth" if self.rgb.has_axis else "range"

    def thermal_px(self, rays: Floats, metres: float) -> tuple[Floats, NDArray[np.bool_]]:
        """Where in the thermal image (N x 2) things lie `metres` off, and whether it can be seen there."""
        R, t = self.T_fir_rgb[:3, :3], self.T_fir_rgb[:3, 3]
        points = rays @ R.T if math.isinf(metres) else self.per_value(rays, self.value) @ R.T * metres + t
        with np.errstate(invalid="ignore", over="ignore"):
            return self.fir.project(points)


@dataclass(frozen=True, slots=True, eq=False)
class RigWarp:
    """Carries a thermal image onto the RGB grid by a rig, all things taken to be at one distance.

    `mask` (H x W uint8, 255 where thermal reaches, read-only), `coverage`, `full`, `crop_xywh` and
    `border_ltrb` are as those of `fusion.warp.Warp`. `distance_m` is the assumed depth along the RGB camera's
    axis (from its centre where it looks all round), inf for infinity. Safe to share between threads.
    """

    views: Views
    distance_m: float
    mask: NDArray[np.uint8] = field(repr=False)
    coverage: float
    full: bool
    crop_xywh: tuple[int, int, int, int]
    border_ltrb: tuple[int, int, int, int]
    _sampling: Sampling = field(repr=False)
    _from_rgb: Sampling | None = field(repr=False)
    is_identity: bool = False

    @classmethod
    def fixed(
        cls,
        rig: Rig,
        fir_size_wh: Size,
        rgb_size_wh: Size,
        mode: Literal["infinity", "distance"] = "infinity",
        distance_m: float | None = None,
        undistort: bool = False,
    ) -> RigWarp:
        """The warp for images of these sizes.

        Raises `UsageError` where the rig is for other sizes or lacks what is needed, or thermal reaches no
        RGB pixel; `ValueError` for a mode without its distance or a distance that is no positive number.
        """
        if (mode == "distance") != (distance_m is not None) or mode not in ("infinity", "distance"):
            raise ValueError(f"expected infinity, or distance with metres, got {mode}, {distance_m}")
        metres = math.inf if distance_m is None else float(distance_m)
        if not metres > 0:
            raise ValueError(f"expected a positive distance, got {distance_m}")
        return cls.of(Views.of(rig, fir_size_wh, rgb_size_wh, undistort), metres)

    @classmethod
    def of(cls, views: Views, distance_m: float) -> RigWarp:
        """The same of views that are there already."""
        from fusion import rig_warp_kernels as loops

        mask, sampling = _maps(views, distance_m)
        from_rgb = None if views.output is views.rgb else _rgb_maps(views)
        H, W = mask.shape
        scratch = np.zeros(W, np.int64), np.zeros(W + 1, np.int64), np.zeros(W + 1, np.int64)
        x, y, w, h = (int(n) for n in loops.largest_rectangle(mask, *scratch))
        if not w:
            away = "at infinity" if math.isinf(distance_m) else f"{distance_m:g} m away"
            hint = "T_rgb_fir takes points of the thermal camera's frame to the RGB camera's; is it inverted?"
            raise UsageError(f"by the rig thermal and RGB share no view {away}", hint=hint)
        share = float(np.count_nonzero(mask)) / mask.size
        border = (x, y, W - x - w, H - y - h)
        return cls(
            views, distance_m, _locked(mask), share, share == 1, (x, y, w, h), border, sampling, from_rgb
        )

    def apply(self, index: NDArray[np.uint8], out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """`index` (h x w uint8, thermal grid) sampled bilinearly on the output grid: H x W uint8.

        Written to `out` where given. Outside `mask` values mean nothing. Raises `ValueError`.
        """
        from fusion.kernels import resample

        return resample(_checked_index(index, self.views), *self._sampling, out)

    def positions(self) -> Floats:
        """Where each output pixel samples the thermal image: H x W x 2 (x, y) in 1/256 px; NaN: nowhere."""
        return _positions(*self._sampling, self.mask, self.views.fir.size_wh)

    def rgb(self, bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The RGB image (H x W x 3 uint8) on the output grid: itself, or undistorted, sampled bilinearly."""
        if self._from_rgb is None:
            return bgr
        from fusion.kernels import resample

        planes = [resample(np.ascontiguousarray(bgr[..., k]), *self._from_rgb) for k in range(3)]
        return np.ascontiguousarray(np.stack(planes, -1))


@dataclass(frozen=True, slots=True, eq=False)
class Warped:
    """Thermal on the RGB grid by depth.

    `index` (H x W uint8) holds where `mask` (H x W uint8) is 255. `hidden` counts the pixels that something
    nearer hides from the thermal camera, `unknown` those in its view without depth, `assumed` those seen
    at the fixed distance for want of depth.
    """

    index: NDArray[np.uint8]
    mask: NDArray[np.uint8]
    hidden: int
    unknown: int
    assumed: int


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
        mode = "infinity" if distance_m is None else "distance"
        self.fixed = RigWarp.fixed(rig, fir_size_wh, rgb_size_wh, mode, distance_m, undistort)
        self.views = views = self.fixed.views
        self.value: Value = value or views.value
        self.distance_m = distance_m
        self.mask, self.coverage, self.full = self.fixed.mask, self.fixed.coverage, self.fixed.full
        self.crop_xywh, self.border_ltrb = self.fixed.crop_xywh, self.fixed.border_ltrb
        rays = np.concatenate([views.rays(uv) for _, uv in _blocks(views.output.size_wh)])
        per_value = views.per_value(rays, self.value) @ views.T_fir_rgb[:3, :3].T
        self._ray = _locked(np.ascontiguousarray(per_value.T, np.float32))
        self._half = _locked(_half_extents(views, rays))
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
    ) -> Warped:
        """`index` (h x w uint8, thermal grid) sampled bilinearly where each RGB pixel's point is seen.

        `depth_m` is H x W float32 metres on the RGB camera's own grid, 0 (or NaN, inf) where there is none;
        None: nowhere. Raises `FrameError` for another size, `ValueError` for another type.
        """
        from fusion.kernels import resample

        image = _checked_index(index, self.views)
        sampling, mask, counts = self._sampling(depth_m)
        return Warped(resample(image, *sampling, out), mask, *counts)

    def positions(self, depth_m: NDArray[np.float32] | None) -> Floats:
        """Where each output pixel samples the thermal image: H x W x 2 (x, y) in 1/256 px; NaN: nowhere."""
        sampling, mask, _ = self._sampling(depth_m)
        return _positions(*sampling, mask, self.views.fir.size_wh)

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
        box = _singles((-_MARGIN_PX, w - 1 + _MARGIN_PX, -_MARGIN_PX, h - 1 + _MARGIN_PX))
        place = loops.place_fisheye if isinstance(self.views.fir, FisheyeCamera) else loops.place_pinhole
        place(self._ray, value, t, *self._lens, box, x, y, near)
        grids = (array.reshape(H, W) for array in (x, y, near))
        loops.spread(*grids, self._half, self._jump, nearest)
        same, inside = np.float32(_SAME_SHARE), self.mask.reshape(-1)
        return loops.judge(x, y, near, nearest, same, self._jump, inside, value, offset, fraction, mask)


# --- predicted parallax


def parallax_px(
    rig: Rig, at_m: float, distances_m: Sequence[float] = PARALLAX_M, undistort: bool = False
) -> Floats:
    """How far off, in RGB pixels, thermal lies for things at `distances_m` where `at_m` is assumed.

    The median over the RGB pixels whose thing both cameras see; NaN where there is none. inf is infinity, as
    the distance of things and as the assumed one.
    """
    views = Views.of(rig, rig.camera("fir").size_wh, rig.camera("rgb").size_wh, undistort)
    W, H = views.output.size_wh
    u, v = np.meshgrid(np.linspace(0, W - 1, 33), np.linspace(0, H - 1, 25))
    uv = np.stack([u.ravel(), v.ravel()], -1)
    rays = views.rays(uv)
    found = []
    for metres in distances_m:
        xy, seen = views.thermal_px(rays, metres)
        drawn, there = _drawn_at(views, xy, at_m)
        off = np.linalg.norm(drawn - uv, axis=1)[seen & there & _inside(xy, views.fir.size_wh)]
        found.append(float(np.median(off)) if off.size else math.nan)
    return np.array(found)


def _drawn_at(views: Views, fir_xy: Floats, at_m: float) -> tuple[Floats, NDArray[np.bool_]]:
    """Where on the output grid a warp that assumes `at_m` draws thermal pixels N x 2."""
    T = invert(views.T_fir_rgb)
    ray, centre = views.fir.unproject(fir_xy) @ T[:3, :3].T, T[:3, 3]
    if math.isinf(at_m):
        points = ray
    elif views.value == "depth":
        points = centre + ray * ((at_m - centre[2]) / ray[:, 2])[:, None]
    else:  # the sphere around the RGB camera, from within
        along = ray @ centre
        points = centre + ray * (np.sqrt(along**2 - centre @ centre + at_m**2) - along)[:, None]
    with np.errstate(invalid="ignore", over="ignore"):
        return views.output.project(points)


# --- tables made once


def _rectified(camera: RigCamera) -> PinholeCamera:
    """The pinhole without distortion that sees only what is in the picture of `camera`."""
    if not any(camera.distortion) and isinstance(camera, PinholeCamera):
        return camera
    w, h = camera.size_wh
    edge = np.concatenate(
        [
            np.stack(np.meshgrid(np.arange(w), (0, h - 1)), -1).reshape(-1, 2),
            np.stack(np.meshgrid((0, w - 1), np.arange(h)), -1).reshape(-1, 2),
        ]
    ).astype(np.float64)

    def pinhole(growth: float) -> PinholeCamera:
        return PinholeCamera((w, h), growth * camera.fx, growth * camera.fy, camera.cx, camera.cy)

    def fits(growth: float) -> bool:
        with np.errstate(invalid="ignore"):
            xy, seen = camera.project(pinhole(growth).unproject(edge))
        return bool((seen & _inside(xy, (w, h), 0.5 + 1e-6)).all())

    if fits(1.0):
        return pinhole(1.0)
    low, high = 1.0, _LARGEST_FOCAL_GROWTH
    if not fits(high):
        raise UsageError("the RGB camera's distortion leaves no picture to undistort", hint="check the rig")
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (low, middle) if fits(middle) else (middle, high)
    return pinhole(high)


def _blocks(size_wh: Size) -> Iterator[tuple[slice, Floats]]:
    """The rows of a picture, a few at a time, and their pixels N x 2."""
    w, h = size_wh
    step = max(1, _BLOCK_PIXELS // w)
    for top in range(0, h, step):
        rows = slice(top, min(top + step, h))
        v, u = np.mgrid[rows, :w]
        yield rows, np.stack([u.ravel(), v.ravel()], -1).astype(np.float64)


def _inside(xy: Floats, size_wh: Size, margin_px: float = _MARGIN_PX) -> NDArray[np.bool_]:
    w, h = size_wh
    with np.errstate(invalid="ignore"):
        return np.all((xy >= -margin_px) & (xy <= (w - 1 + margin_px, h - 1 + margin_px)), axis=-1)


def _maps(views: Views, metres: float) -> tuple[NDArray[np.uint8], Sampling]:
    """Mask, and where to sample the thermal image, of every output pixel."""
    W, H = views.output.size_wh
    mask = np.empty((H, W), np.uint8)
    offset, fraction = np.empty((H, W), np.uint32), np.empty((H, W), np.uint16)
    for rows, uv in _blocks((W, H)):
        xy, seen = views.thermal_px(views.rays(uv), metres)
        seen = seen & _inside(xy, views.fir.size_wh)
        mask[rows] = np.where(seen, np.uint8(255), np.uint8(0)).reshape(-1, W)
        offset[rows], fraction[rows] = (a.reshape(-1, W) for a in _sampling_of(xy, seen, views.fir.size_wh))
    return mask, (_locked(offset), _locked(fraction))


def _rgb_maps(views: Views) -> Sampling:
    """Where to sample the RGB image of every output pixel."""
    W, H = views.output.size_wh
    offset, fraction = np.empty((H, W), np.uint32), np.empty((H, W), np.uint16)
    for rows, uv in _blocks((W, H)):
        xy, seen = views.rgb.project(views.rays(uv))
        offset[rows], fraction[rows] = (a.reshape(-1, W) for a in _sampling_of(xy, seen, (W, H)))
    return _locked(offset), _locked(fraction)


def _sampling_of(xy: Floats, seen: NDArray[np.bool_], size_wh: Size) -> tuple[Any, Any]:
    """y0 w + x0 and fy << 8 | fx of positions, as `fusion.kernels.resample` reads them; 0 where not seen."""
    w, h = size_wh
    held = np.where(seen[:, None], np.clip(xy, 0, (w - 1, h - 1)), 0)
    qx, qy = np.rint(held * STEPS).astype(np.int64).T
    return ((qy >> 8) * w + (qx >> 8)).astype(np.uint32), ((qy & 255) << 8 | (qx & 255)).astype(np.uint16)


def _positions(
    offset: NDArray[np.uint32], fraction: NDArray[np.uint16], mask: NDArray[np.uint8], size_wh: Size
) -> Floats:
    row, column = np.divmod(offset.astype(np.int64), size_wh[0])
    x, y = column + (fraction & 255) / STEPS, row + (fraction >> 8) / STEPS
    return np.where(mask[..., None] > 0, np.stack([x, y], -1), np.nan)


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
    return _locked(np.negative(metres).astype(np.float32))


def _nearest_source(views: Views, rays: Floats) -> NDArray[np.int64]:
    """The RGB pixel nearest to each output pixel, as a flat index: depth is not mixed across edges."""
    w, h = views.rgb.size_wh
    xy, _ = views.rgb.project(rays)
    column, row = np.clip(np.floor(np.nan_to_num(xy) + 0.5), 0, (w - 1, h - 1)).astype(np.int64).T
    return _locked(row * w + column)


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


def _checked_index(index: NDArray[np.uint8], views: Views) -> NDArray[np.uint8]:
    shape = views.fir.size_wh[::-1]
    if index.shape != shape or index.dtype != np.uint8:
        raise ValueError(f"expected {shape} uint8 on the thermal grid, got {index.shape} {index.dtype}")
    return np.ascontiguousarray(index)


def _checked_depth(depth_m: NDArray[np.float32], views: Views) -> NDArray[np.float32]:
    if depth_m.dtype != np.float32 or depth_m.ndim != 2:
        raise ValueError(f"expected H x W float32 metres, got {depth_m.shape} {depth_m.dtype}")
    if depth_m.shape[::-1] != tuple(views.rgb.size_wh):
        ours, theirs = _wh(views.rgb.size_wh), _wh(depth_m.shape[::-1])
        hint = "make it with `fusion depth --rig` and this rig"
        raise FrameError(f"the depth map is {theirs}, the RGB camera {ours}", hint=hint)
    return np.ascontiguousarray(depth_m)


def _locked(array: Any) -> Any:
    array.setflags(write=False)
    return array


def _wh(size_wh: Sequence[int]) -> str:
    return f"{size_wh[0]}x{size_wh[1]}"
