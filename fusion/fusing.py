"""The way of one frame: thermal counts -> window -> warp -> colour and blend (thesis section 6.1).

`FrameFuser` holds what a whole run has in common (registration, colour table) and fuses any frame on its own,
in any order, by several threads, with the same result.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion import registration as reg
from fusion.blend import blender
from fusion.colormaps import colormap_bgr
from fusion.config import BlendConfig
from fusion.errors import FrameError, UsageError
from fusion.frames import FrameSet, FusedFrame, Window
from fusion.kernels import index_counts
from fusion.rig import Rig, load_rig
from fusion.rig_warp import DepthWarp, RigWarp, Value, Warped
from fusion.thermal import equalise
from fusion.warp import Warp

Sizes = tuple[tuple[int, int], tuple[int, int]]
AnyWarp = Warp | RigWarp | DepthWarp
LEAST_COVERAGE = 0.1


@dataclass(frozen=True, slots=True)
class Stages:
    """Every step of one fused frame, for looking at: `fused` is the last.

    `frames` is the pair, RGB undistorted where that was asked for. `index` is H x W uint8 on the thermal grid
    (the windowed counts); `warped` is the same on the RGB grid, defined where `mask` (H x W uint8) is set;
    `overlay_bgr` is `warped` through the colour table. `by_depth` is there where each pixel's depth was used,
    `fir_counts` (uint16, on the grid of `fused`, 0 = none) where they were asked for.
    """

    frames: FrameSet
    warp: AnyWarp
    index: NDArray[np.uint8]
    warped: NDArray[np.uint8]
    mask: NDArray[np.uint8]
    table_bgr: NDArray[np.uint8]
    fused: FusedFrame
    by_depth: Warped | None = None
    fir_counts: NDArray[np.uint16] | None = None

    @property
    def overlay_bgr(self) -> NDArray[np.uint8]:
        return self.table_bgr[self.warped]


class FrameFuser:
    """Fuses single frames by one configuration.

    `sizes` are those of the first frame, thermal and RGB; others may follow where nothing but the sizes
    registers them. `rig` is the one that the configuration names (None: read from that rig.toml),
    `registration` one that is known already. `depth_value` says what depth maps hold (None: nobody said).
    `registration` is None where a rig registers. Raises `FusionError` kinds when made.
    """

    def __init__(
        self,
        config: BlendConfig,
        sizes: Sizes,
        rig: Rig | None = None,
        registration: reg.Registration | None = None,
        depth_value: Value | None = None,
    ) -> None:
        self.config, self.sizes = config, sizes
        warp = config.warp
        self.rig = None if warp.rig is None else rig if rig is not None else load_rig(warp.rig)
        self.table_bgr = colormap_bgr(config.thermal.colormap)
        self._blend = blender(config.blend.method)
        self._given = _read_registration(config) if registration is None else registration
        self._depth_value: Value | None = depth_value
        self._warps: dict[Sizes, tuple[reg.Registration | None, AnyWarp]] = {}
        self._lock = threading.Lock()
        self.registration, self.warp = self._warp_for(*sizes)

    @property
    def size_groups(self) -> int:
        """How many different image sizes have been met so far."""
        return len(self._warps)

    @property
    def notes(self) -> list[str]:
        """What the user should know of the registration."""
        if self.registration is not None:
            return list(self.registration.notes)
        share = self.warp.coverage
        return [f"by the rig thermal covers only {share:.2%} of RGB"] if share < LEAST_COVERAGE else []

    def stages(
        self,
        frames: FrameSet,
        window: Window,
        depth_m: NDArray[np.float32] | None = None,
        *,
        with_counts: bool = False,
    ) -> Stages:
        """Fuse `frames` by `window`; `depth_m` is H x W metres on the RGB grid, 0 where there is none.

        `with_counts` warps what thermal measured as well. Raises `FrameError` where this frame cannot be
        used.
        """
        _, warp = self._warp_for(frames.fir.size_wh, frames.rgb.size_wh)
        stretched, below, above = index_counts(frames.counts, window.lo, window.hi)
        if self.config.thermal.clahe:
            stretched = equalise(stretched, self.config.thermal.clahe)
        by_depth = None
        if isinstance(warp, DepthWarp):
            if depth_m is None and warp.distance_m is None:
                hint = "a fixed distance as well (--distance) would stand in for it"
                raise FrameError("no depth map belongs to it", where=frames.stem, hint=hint)
            by_depth = warp.apply(stretched, depth_m, fir=frames.counts if with_counts else None)
            warped, mask, counts = by_depth.index, by_depth.mask, by_depth.counts
            coverage = float(np.count_nonzero(mask)) / mask.size
        else:
            warped, mask, coverage = warp.apply(stretched), warp.mask, warp.coverage
            counts = warp.counts(frames.counts) if with_counts else None
        frames = _on_grid_of(warp, frames)
        bgr, kept_mask = self._blended(frames.bgr, warped, warp, None if coverage == 1 else mask)
        fused = FusedFrame(
            frames.stem,
            bgr,
            kept_mask,
            window,
            below / frames.counts.size,
            above / frames.counts.size,
            coverage,
            frames.rgb.stamp_ns,
            frames.fir.stamp_ns,
            self._flags(frames, window, depth_m is not None),
        )
        if counts is not None and bgr.shape[:2] != counts.shape:
            x, y, w, h = warp.crop_xywh
            counts = np.ascontiguousarray(counts[y : y + h, x : x + w])
        return Stages(frames, warp, stretched, warped, mask, self.table_bgr, fused, by_depth, counts)

    def _blended(
        self,
        bgr: NDArray[np.uint8],
        warped: NDArray[np.uint8],
        warp: AnyWarp,
        mask: NDArray[np.uint8] | None,
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
        alpha, outside = self.config.blend.alpha, self.config.warp.outside
        if mask is None:
            return self._blend(bgr, warped, self.table_bgr, alpha, None), None
        if outside == "crop":
            x, y, w, h = warp.crop_xywh
            inside = np.s_[y : y + h, x : x + w]
            bgr, warped = bgr[inside], warped[inside]
            # By depth there are holes within the rectangle; of a fixed warp all of it is valid.
            mask = np.ascontiguousarray(mask[inside]) if isinstance(warp, DepthWarp) else None
            mask = None if mask is not None and mask.all() else mask
            return self._blend(bgr, warped, self.table_bgr, alpha, mask), mask
        fused = self._blend(bgr, warped, self.table_bgr, alpha, mask)
        if outside == "fill":
            fused[mask == 0] = self.config.warp.fill_bgr
        return fused, mask

    def _flags(self, frames: FrameSet, window: Window, has_depth: bool) -> tuple[str, ...]:
        # percentiles within one count: nothing to see, or the planner has widened a single value
        flat = self.config.thermal.window_unit == "percentile" and window.hi - window.lo <= 1
        no_map = self.config.warp.mode == "depth" and not has_depth
        own = [flag for flag, holds in (("fir-flat", flat), ("depth-missing", no_map)) if holds]
        return (*frames.rgb.flags, *frames.fir.flags, *own)

    def _warp_for(
        self, fir_size_wh: tuple[int, int], rgb_size_wh: tuple[int, int]
    ) -> tuple[reg.Registration | None, AnyWarp]:
        sizes = (fir_size_wh, rgb_size_wh)
        with self._lock:
            if sizes not in self._warps:
                if (self._given is not None or self.rig is not None) and self._warps:
                    raise FrameError(
                        f"thermal {_wh(fir_size_wh)} and RGB {_wh(rgb_size_wh)}, but the registration"
                        f" holds for {_wh(self.sizes[0])} and {_wh(self.sizes[1])}",
                        hint="sizes changed midway: put each size in a folder of its own",
                    )
                self._warps[sizes] = self._build_warp(*sizes)
            return self._warps[sizes]

    def _build_warp(
        self, fir_size_wh: tuple[int, int], rgb_size_wh: tuple[int, int]
    ) -> tuple[reg.Registration | None, AnyWarp]:
        if self.rig is not None:
            return None, self._rig_warp(self.rig, fir_size_wh, rgb_size_wh)
        if self._given is not None:
            registration = self._given
        elif fir_size_wh == rgb_size_wh:
            registration = reg.identity(rgb_size_wh)
        else:
            registration = reg.scale_to_fit(fir_size_wh, rgb_size_wh)
        notes = self._checked(registration, fir_size_wh, rgb_size_wh)
        registration = replace(registration, notes=(*registration.notes, *notes))
        return registration, Warp(registration.H_rgb_fir, fir_size_wh, rgb_size_wh)

    def _rig_warp(
        self, rig: Rig, fir_size_wh: tuple[int, int], rgb_size_wh: tuple[int, int]
    ) -> RigWarp | DepthWarp:
        warp = self.config.warp
        try:
            if warp.mode == "depth":
                value, metres, undistort = self._depth_value, warp.distance_m, warp.undistort
                return DepthWarp(
                    rig, fir_size_wh, rgb_size_wh, value=value, distance_m=metres, undistort=undistort
                )
            mode = "infinity" if warp.distance_m is None else "distance"
            return RigWarp.fixed(rig, fir_size_wh, rgb_size_wh, mode, warp.distance_m, warp.undistort)
        except UsageError as error:
            raise UsageError(error.what, where=warp.rig or "rig", hint=error.hint) from None

    def _checked(self, registration: reg.Registration, *sizes: tuple[int, int]) -> list[str]:
        try:
            return reg.check(registration, *sizes)
        except UsageError as error:
            given = self.config.warp.homography or self.config.warp.points
            raise UsageError(error.what, where=given or error.where, hint=error.hint) from None


def _read_registration(config: BlendConfig) -> reg.Registration | None:
    warp = config.warp
    if warp.homography:
        return reg.read_homography(Path(warp.homography))
    return reg.fit_points(*reg.read_points(Path(warp.points))) if warp.points else None


def _on_grid_of(warp: AnyWarp, frames: FrameSet) -> FrameSet:
    bgr = warp.rgb(frames.bgr)
    return frames if bgr is frames.bgr else replace(frames, rgb=replace(frames.rgb, pixels=bgr))


def _wh(size_wh: tuple[int, int]) -> str:
    return f"{size_wh[0]}x{size_wh[1]}"
