"""The values that cross stage boundaries: frozen, validated when made, importing nothing of ours.

Pixel arrays are never mutated by the stages that receive them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Image:
    """One image as a source delivers it.

    `pixels` is H x W x 3 uint8 in BGR order for the RGB camera, H x W uint8 or uint16 counts for the
    thermal camera. `stem` names it (posix path relative to its source, without suffix). `stamp_ns`
    is its time in integer nanoseconds, None where the source has no clock. `flags` says in one word
    each what was done to it on the way in (for example ``rgb-grey``).
    """

    pixels: NDArray[np.uint8] | NDArray[np.uint16]
    stem: str
    stamp_ns: int | None = None
    flags: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        shape, dtype = self.pixels.shape, self.pixels.dtype
        colour = len(shape) == 3 and shape[2] == 3 and dtype == np.uint8
        counts = len(shape) == 2 and dtype in (np.uint8, np.uint16)
        if not (colour or counts) or 0 in shape:
            raise ValueError(f"expected HxWx3 uint8 BGR or HxW uint8/uint16 counts, got {shape} {dtype}")

    @property
    def size_wh(self) -> tuple[int, int]:
        return self.pixels.shape[1], self.pixels.shape[0]


@dataclass(frozen=True, slots=True)
class PointCloud:
    """Points of one scan or of one map, in the LiDAR's frame: x forward, y left, z up.

    `xyz_m` is N x 3 float32 (float64 where coordinates are large, as in LAS), finite, never exactly
    (0, 0, 0), which is how scanners write "no return". `fields` holds what else is known of each point, N
    values each, under the names ``intensity``, ``ring`` (integer, as the file numbers its lasers), ``time_s``
    (seconds) or the file's own. `read` is how many points the file had; `dropped` says in one word each how
    many were left out, and why (``nan``, ``zero``, ``range``, ``box``, ``voxel``, ``outlier``).
    """

    xyz_m: NDArray[np.float32] | NDArray[np.float64]
    fields: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    stem: str = ""
    stamp_ns: int | None = None
    read: int | None = None
    dropped: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shape, dtype = self.xyz_m.shape, self.xyz_m.dtype
        if len(shape) != 2 or shape[1] != 3 or dtype not in (np.float32, np.float64):
            raise ValueError(f"expected Nx3 float32 or float64 metres, got {shape} {dtype}")
        for name, values in self.fields.items():
            if values.shape != shape[:1]:
                raise ValueError(f"expected {shape[0]} values of {name}, got {values.shape}")

    def __len__(self) -> int:
        return len(self.xyz_m)


@dataclass(frozen=True, slots=True)
class FrameSet:
    """What the sensors saw at one moment: RGB and thermal images on their own grids, and perhaps a scan."""

    rgb: Image
    fir: Image
    cloud: PointCloud | None = None

    def __post_init__(self) -> None:
        if self.rgb.pixels.ndim != 3:
            raise ValueError(f"rgb must be HxWx3 BGR, got {self.rgb.pixels.shape}")
        if self.fir.pixels.ndim != 2:
            raise ValueError(f"fir must be HxW counts, got {self.fir.pixels.shape}")

    @property
    def bgr(self) -> NDArray[np.uint8]:
        return np.asarray(self.rgb.pixels, np.uint8)  # no copy: what they are

    @property
    def counts(self) -> NDArray[np.uint8] | NDArray[np.uint16]:
        return self.fir.pixels

    @property
    def stem(self) -> str:
        return self.rgb.stem

    @property
    def dt_ns(self) -> int | None:
        """Thermal stamp minus RGB stamp; None where either has no clock."""
        if self.rgb.stamp_ns is None or self.fir.stamp_ns is None:
            return None
        return self.fir.stamp_ns - self.rgb.stamp_ns


@dataclass(frozen=True, slots=True)
class Window:
    """The thermal interval, in counts, that is stretched to the whole colour map; `lo` < `hi`."""

    lo: float
    hi: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.lo) and np.isfinite(self.hi) and self.lo < self.hi):
            raise ValueError(f"expected finite counts lo < hi, got {self.lo} and {self.hi}")


@dataclass(frozen=True, slots=True)
class FusedFrame:
    """A fused frame and what is known of how it came about.

    `bgr` is H x W x 3 uint8 on the RGB grid, or its crop. `mask` is H x W uint8, 255 where thermal was
    seen, None where it was seen everywhere. `window` is in thermal counts; `clipped_below` and
    `clipped_above` are the shares [0, 1] of the thermal image outside it; `coverage` is the share of
    the RGB grid that thermal covers, before any crop.
    """

    stem: str
    bgr: NDArray[np.uint8]
    mask: NDArray[np.uint8] | None
    window: Window
    clipped_below: float
    clipped_above: float
    coverage: float
    rgb_stamp_ns: int | None = None
    fir_stamp_ns: int | None = None
    flags: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.bgr.ndim != 3 or self.bgr.shape[2] != 3 or self.bgr.dtype != np.uint8:
            raise ValueError(f"bgr must be HxWx3 uint8, got {self.bgr.shape} {self.bgr.dtype}")
        if self.mask is not None and (self.mask.shape != self.bgr.shape[:2] or self.mask.dtype != np.uint8):
            raise ValueError(
                f"mask must be {self.bgr.shape[:2]} uint8, got {self.mask.shape} {self.mask.dtype}"
            )
