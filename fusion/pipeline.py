"""The way of a frame: thermal counts -> window -> warp -> colour and blend (thesis section 6.1).

`Fuser` plans once over a whole sequence (window, registration, colour table), then fuses any frame on
its own, so that frames may be computed in any order and by several threads with the same result.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion import registration as reg
from fusion.blend import blender
from fusion.colormaps import colormap_bgr
from fusion.config import BlendConfig
from fusion.errors import FrameError, InputError, UsageError
from fusion.frames import FrameSet, FusedFrame, Window
from fusion.kernels import index_counts
from fusion.sync import Pairs
from fusion.thermal import equalise, plan_windows
from fusion.warp import Warp

Sizes = tuple[tuple[int, int], tuple[int, int]]


@dataclass(frozen=True, slots=True)
class Stages:
    """Every step of one fused frame, for looking at: `fused` is the last.

    `index` is H x W uint8 on the thermal grid (the windowed counts); `warped` is the same on the RGB
    grid, defined where `warp.mask` is set; `overlay_bgr` is `warped` through the colour table.
    """

    frames: FrameSet
    warp: Warp
    index: NDArray[np.uint8]
    warped: NDArray[np.uint8]
    table_bgr: NDArray[np.uint8]
    fused: FusedFrame

    @property
    def overlay_bgr(self) -> NDArray[np.uint8]:
        return self.table_bgr[self.warped]


class Fuser:
    """Fuses the pairs of a sequence by one configuration.

    Iterating yields a `FusedFrame` per usable pair, in order; a pair that cannot be used is left out
    and its `FrameError` added to `skipped` (raised instead with ``strict``). Memory does not grow
    with the sequence. Raises `FusionError` kinds when made, if the plan itself cannot hold.
    """

    def __init__(self, pairs: Pairs, config: BlendConfig | None = None) -> None:
        self.pairs = pairs
        self.config = config or BlendConfig.of()
        self.skipped: list[FrameError] = []
        thermal, blend = self.config.thermal, self.config.blend
        self.table_bgr = colormap_bgr(thermal.colormap)
        self._blend = blender(blend.method)
        self._given = self._read_registration()
        self._warps: dict[Sizes, tuple[reg.Registration, Warp]] = {}
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

    def fuse(self, index: int) -> FusedFrame:
        """Read and fuse pair `index`. Raises `FrameError` when this pair cannot be used."""
        return self.stages(index).fused

    def stages(self, index: int) -> Stages:
        """The same frame as `fuse(index)`, with every step on the way."""
        frames = self.pairs.read(index)
        _, warp = self._warp_for(frames.fir.size_wh, frames.rgb.size_wh)
        window = self.windows.window(index, frames.counts)
        stretched, below, above = index_counts(frames.counts, window.lo, window.hi)
        if self.config.thermal.clahe:
            stretched = equalise(stretched, self.config.thermal.clahe)
        warped = warp.apply(stretched)
        bgr, mask = self._blended(frames.bgr, warped, warp)
        fused = FusedFrame(
            frames.stem,
            bgr,
            mask,
            window,
            below / frames.counts.size,
            above / frames.counts.size,
            warp.coverage,
            frames.rgb.stamp_ns,
            frames.fir.stamp_ns,
            self._flags(frames, window),
        )
        return Stages(frames, warp, stretched, warped, self.table_bgr, fused)

    def _blended(
        self, bgr: NDArray[np.uint8], warped: NDArray[np.uint8], warp: Warp
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
        alpha, outside = self.config.blend.alpha, self.config.warp.outside
        if warp.full:
            return self._blend(bgr, warped, self.table_bgr, alpha, None), None
        if outside == "crop":
            x, y, w, h = warp.crop_xywh
            inside = np.s_[y : y + h, x : x + w]
            return self._blend(bgr[inside], warped[inside], self.table_bgr, alpha, None), None
        fused = self._blend(bgr, warped, self.table_bgr, alpha, warp.mask)
        if outside == "fill":
            fused[warp.mask == 0] = self.config.warp.fill_bgr
        return fused, warp.mask

    def _flags(self, frames: FrameSet, window: Window) -> tuple[str, ...]:
        # percentiles within one count: nothing to see, or the planner has widened a single value
        flat = self.config.thermal.window_unit == "percentile" and window.hi - window.lo <= 1
        return (*frames.rgb.flags, *frames.fir.flags, *(("fir-flat",) if flat else ()))

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
    ) -> tuple[reg.Registration, Warp]:
        sizes = (fir_size_wh, rgb_size_wh)
        with self._lock:
            if sizes not in self._warps:
                if self._given is not None and self._warps:
                    raise FrameError(
                        f"thermal {_wh(fir_size_wh)} and RGB {_wh(rgb_size_wh)}, but the registration"
                        f" holds for {_wh(self.sizes[0])} and {_wh(self.sizes[1])}",
                        hint="sizes changed midway: put each size in a folder of its own",
                    )
                self._warps[sizes] = self._build_warp(*sizes)
            return self._warps[sizes]

    def _build_warp(
        self, fir_size_wh: tuple[int, int], rgb_size_wh: tuple[int, int]
    ) -> tuple[reg.Registration, Warp]:
        if self._given is not None:
            registration = self._given
        elif fir_size_wh == rgb_size_wh:
            registration = reg.identity(rgb_size_wh)
        else:
            registration = reg.scale_to_fit(fir_size_wh, rgb_size_wh)
        notes = self._checked(registration, fir_size_wh, rgb_size_wh)
        registration = replace(registration, notes=(*registration.notes, *notes))
        return registration, Warp(registration.H_rgb_fir, fir_size_wh, rgb_size_wh)

    def _checked(self, registration: reg.Registration, *sizes: tuple[int, int]) -> list[str]:
        try:
            return reg.check(registration, *sizes)
        except UsageError as error:
            given = self.config.warp.homography or self.config.warp.points
            raise UsageError(error.what, where=given or error.where, hint=error.hint) from None


def _wh(size_wh: tuple[int, int]) -> str:
    return f"{size_wh[0]}x{size_wh[1]}"
