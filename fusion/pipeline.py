"""The way of a frame: thermal counts -> window -> warp -> colour and blend (thesis section 6.1).

`Fuser` plans once over a whole sequence (window, registration, colour table), then fuses any frame on
its own, so that frames may be computed in any order and by several threads with the same result.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fusion import registration as reg
from fusion.blend import blender
from fusion.colormaps import colormap_bgr
from fusion.config import BlendConfig
from fusion.errors import FrameError, InputError, UsageError
from fusion.frames import FrameSet, FusedFrame, Image, Window
from fusion.kernels import index_counts
from fusion.rig import Rig, load_rig
from fusion.rig_warp import DepthWarp, RigWarp, Value, Warped
from fusion.sync import Pairs
from fusion.thermal import equalise, plan_windows
from fusion.warp import Warp

Sizes = tuple[tuple[int, int], tuple[int, int]]
AnyWarp = Warp | RigWarp | DepthWarp
LEAST_COVERAGE = 0.1


class DepthMaps(Protocol):
    """The depth of the pairs of a sequence; `read_m` is safe from several threads.

    `value` says what the maps hold: depth along the RGB camera's axis, or range; None where nobody said.
    """

    value: Value | None

    def name(self, index: int) -> str:
        """What the map of a pair is called, "" where it has none."""
        ...

    def read_m(self, index: int) -> NDArray[np.float32]:
        """H x W metres on the RGB camera's grid, 0 where there is none. Raises `FrameError`."""
        ...

    def changed_ns(self, index: int) -> int:
        """When the map of a pair was last written (0: it has none)."""
        ...


class PairsWithDepth:
    """Pairs (`fusion.sync.Pairs`), and the depth map that belongs to each."""

    def __init__(self, pairs: Pairs, depth: DepthMaps) -> None:
        self._pairs, self.depth = pairs, depth
        self.name, self.pairing, self.ignored = pairs.name, pairs.pairing, pairs.ignored

    def __len__(self) -> int:
        return len(self._pairs)

    def stems(self, index: int) -> tuple[str, str]:
        return self._pairs.stems(index)

    def read(self, index: int) -> FrameSet:
        return self._pairs.read(index)

    def read_fir(self, index: int) -> Image:
        return self._pairs.read_fir(index)

    def changed_ns(self, index: int) -> int:
        return max(self._pairs.changed_ns(index), self.depth.changed_ns(index))

    def close(self) -> None:
        self._pairs.close()


@dataclass(slots=True)
class DepthTally:
    """What warping by depth came to: sums of pixels, as `fusion.rig_warp.Warped` counts them."""

    frames: int = 0
    pixels: int = 0
    seen: int = 0
    hidden: int = 0
    unknown: int = 0
    assumed: int = 0

    def add(self, warped: Warped) -> None:
        self.frames += 1
        self.pixels += warped.mask.size
        self.seen += int(np.count_nonzero(warped.mask))
        self.hidden += warped.hidden
        self.unknown += warped.unknown
        self.assumed += warped.assumed


@dataclass(frozen=True, slots=True)
class Stages:
    """Every step of one fused frame, for looking at: `fused` is the last.

    `frames` is the pair, RGB undistorted where that was asked for. `index` is H x W uint8 on the thermal grid
    (the windowed counts); `warped` is the same on the RGB grid, defined where `mask` (H x W uint8) is set;
    `overlay_bgr` is `warped` through the colour table. `by_depth` is there where each pixel's depth was used.
    """

    frames: FrameSet
    warp: AnyWarp
    index: NDArray[np.uint8]
    warped: NDArray[np.uint8]
    mask: NDArray[np.uint8]
    table_bgr: NDArray[np.uint8]
    fused: FusedFrame
    by_depth: Warped | None = None

    @property
    def overlay_bgr(self) -> NDArray[np.uint8]:
        return self.table_bgr[self.warped]


class Fuser:
    """Fuses the pairs of a sequence by one configuration.

    Iterating yields a `FusedFrame` per usable pair, in order; a pair that cannot be used is left out
    and its `FrameError` added to `skipped` (raised instead with ``strict``). Memory does not grow
    with the sequence. Raises `FusionError` kinds when made, if the plan itself cannot hold.

    `rig` is the one that the configuration names (None: read from that rig.toml). A warp by depth needs
    `PairsWithDepth`. `registration` is None where a rig registers.
    """

    def __init__(
        self,
        pairs: Pairs,
        config: BlendConfig | None = None,
        rig: Rig | None = None,
        registration: reg.Registration | None = None,
    ) -> None:
        self.pairs = pairs
        self.config = config or BlendConfig.of()
        self.rig = self._checked_rig(rig)
        self.depth_tally = DepthTally()
        self.skipped: list[FrameError] = []
        thermal, blend = self.config.thermal, self.config.blend
        self.table_bgr = colormap_bgr(thermal.colormap)
        self._blend = blender(blend.method)
        self._given = self._read_registration() if registration is None else registration
        self._warps: dict[Sizes, tuple[reg.Registration | None, AnyWarp]] = {}
        self._lock = threading.Lock()
        self.sizes = self._first_sizes()
        self.registration, self.warp = self._warp_for(*self.sizes)
        self.windows = plan_windows(thermal.rule(), len(pairs), lambda i: pairs.read_fir(i).pixels)

    def __len__(self) -> int:
        return len(self.pairs)

    def __iter__(self) -> Iterator[FusedFrame]:
        for index in range(len(self)):
            try:
                yield self.fuse(index)
            except FrameError as error:
                if self.config.strict:
                    raise
                self.skipped.append(error)

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

    def fuse(self, index: int) -> FusedFrame:
        """Read and fuse pair `index`. Raises `FrameError` when this pair cannot be used."""
        stages = self.stages(index)
        if stages.by_depth is not None:
            with self._lock:
                self.depth_tally.add(stages.by_depth)
        return stages.fused

    def stages(self, index: int) -> Stages:
        """The same frame as `fuse(index)`, with every step on the way."""
        frames = self.pairs.read(index)
        _, warp = self._warp_for(frames.fir.size_wh, frames.rgb.size_wh)
        window = self.windows.window(index, frames.counts)
        stretched, below, above = index_counts(frames.counts, window.lo, window.hi)
        if self.config.thermal.clahe:
            stretched = equalise(stretched, self.config.thermal.clahe)
        by_depth = None
        if isinstance(warp, DepthWarp):
            by_depth = self._by_depth(warp, stretched, index)
            warped, mask = by_depth.index, by_depth.mask
            coverage = float(np.count_nonzero(mask)) / mask.size
        else:
            warped, mask, coverage = warp.apply(stretched), warp.mask, warp.coverage
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
            self._flags(frames, window, index),
        )
        return Stages(frames, warp, stretched, warped, mask, self.table_bgr, fused, by_depth)

    def _by_depth(self, warp: DepthWarp, stretched: NDArray[np.uint8], index: int) -> Warped:
        there = self._has_depth(index)
        if not there and warp.distance_m is None:
            hint = "a fixed distance as well (--distance) would stand in for it"
            raise FrameError("no depth map belongs to it", where=self.pairs.stems(index)[0], hint=hint)
        try:
            return warp.apply(stretched, self._depth.read_m(index) if there else None)
        except FrameError as error:
            where = error.where or self._depth.name(index)
            raise FrameError(error.what, where=where, hint=error.hint) from None

    @property
    def _depth(self) -> DepthMaps:
        if not isinstance(self.pairs, PairsWithDepth):
            raise UsageError("a warp by depth needs pairs with depth", hint="fusion.pipeline.PairsWithDepth")
        return self.pairs.depth

    def _has_depth(self, index: int) -> bool:
        return bool(self._depth.name(index))

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

    def _flags(self, frames: FrameSet, window: Window, index: int) -> tuple[str, ...]:
        # percentiles within one count: nothing to see, or the planner has widened a single value
        flat = self.config.thermal.window_unit == "percentile" and window.hi - window.lo <= 1
        no_map = self.config.warp.mode == "depth" and not self._has_depth(index)
        own = [flag for flag, holds in (("fir-flat", flat), ("depth-missing", no_map)) if holds]
        return (*frames.rgb.flags, *frames.fir.flags, *own)

    def _checked_rig(self, rig: Rig | None) -> Rig | None:
        warp = self.config.warp
        if warp.rig is None:
            return None
        if warp.mode == "depth":
            _ = self._depth  # raises where there is none
        return rig if rig is not None else load_rig(warp.rig)

    def _read_registration(self) -> reg.Registration | None:
        warp = self.config.warp
        if warp.homography:
            return reg.read_homography(Path(warp.homography))
        return reg.fit_points(*reg.read_points(Path(warp.points))) if warp.points else None

    def _first_sizes(self) -> Sizes:
        """The sizes (thermal, RGB) of the first pair that can be read."""
        first_error = None
        for index in range(len(self.pairs)):
            try:
                frames = self.pairs.read(index)
            except FrameError as error:
                if self.config.strict:
                    raise
                first_error = first_error or error
            else:
                return frames.fir.size_wh, frames.rgb.size_wh
        raise InputError(f"none of {len(self.pairs)} pairs can be used; the first: {first_error}")

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
                value, metres, undistort = self._depth.value, warp.distance_m, warp.undistort
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


def _on_grid_of(warp: AnyWarp, frames: FrameSet) -> FrameSet:
    bgr = warp.rgb(frames.bgr)
    return frames if bgr is frames.bgr else replace(frames, rgb=replace(frames.rgb, pixels=bgr))


def _wh(size_wh: tuple[int, int]) -> str:
    return f"{size_wh[0]}x{size_wh[1]}"
