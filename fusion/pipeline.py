"""The way of a sequence: `Fuser` plans once over all pairs (window, registration), then fuses any of them.

Frames may be computed in any order and by several threads with the same result.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fusion import registration as reg
from fusion.config import BlendConfig
from fusion.errors import FrameError, InputError, UsageError
from fusion.frames import FrameSet, FusedFrame, Image
from fusion.fusing import AnyWarp, FrameFuser, Sizes, Stages
from fusion.rig import Rig
from fusion.rig_warp import Value, Warped
from fusion.sync import Pairs
from fusion.thermal import plan_windows


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
        self.depth_tally = DepthTally()
        self.skipped: list[FrameError] = []
        self._lock = threading.Lock()
        by_depth = self.config.warp.mode == "depth"
        self._each = FrameFuser(
            self.config, self._first_sizes(), rig, registration, self._depth.value if by_depth else None
        )
        rule = self.config.thermal.rule()
        self.windows = plan_windows(rule, len(pairs), lambda i: pairs.read_fir(i).pixels)

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
    def rig(self) -> Rig | None:
        return self._each.rig

    @property
    def registration(self) -> reg.Registration | None:
        return self._each.registration

    @property
    def warp(self) -> AnyWarp:
        return self._each.warp

    @property
    def sizes(self) -> Sizes:
        """Of the first pair that can be read: thermal, RGB."""
        return self._each.sizes

    @property
    def table_bgr(self) -> NDArray[np.uint8]:
        return self._each.table_bgr

    @property
    def size_groups(self) -> int:
        """How many different image sizes have been met so far."""
        return self._each.size_groups

    @property
    def notes(self) -> list[str]:
        """What the user should know of the registration."""
        return self._each.notes

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
        window = self.windows.window(index, frames.counts)
        if self.config.warp.mode != "depth" or not self._depth.name(index):
            return self._each.stages(frames, window)
        try:
            return self._each.stages(frames, window, self._depth.read_m(index))
        except FrameError as error:
            where = error.where or self._depth.name(index)
            raise FrameError(error.what, where=where, hint=error.hint) from None

    @property
    def _depth(self) -> DepthMaps:
        if not isinstance(self.pairs, PairsWithDepth):
            raise UsageError("a warp by depth needs pairs with depth", hint="fusion.pipeline.PairsWithDepth")
        return self.pairs.depth

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
