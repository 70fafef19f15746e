"""The warp of a rig where all things are taken to be at one distance, or infinitely far."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fusion.errors import UsageError
from fusion.geometry import Floats
from fusion.rig import Rig
from fusion.rig_warp.views import (
    Sampling,
    Views,
    blocks,
    checked_index,
    inside,
    locked,
    positions,
    sampling_of,
)
from fusion.warp import Counts, Size, checked_counts


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
        metres = metres_of(distance_m)
        return cls.of(Views.of(rig, fir_size_wh, rgb_size_wh, undistort), metres)

    @classmethod
    def of(cls, views: Views, distance_m: float, rays: Floats | None = None) -> RigWarp:
        """The same of views that are there already, and of the `rays` of all output pixels, where known."""
        from fusion import rig_warp_kernels as loops

        mask, sampling = _maps(views, distance_m, rays)
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
            views, distance_m, locked(mask), share, share == 1, (x, y, w, h), border, sampling, from_rgb
        )

    def apply(self, index: NDArray[np.uint8], out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """`index` (h x w uint8, thermal grid) sampled bilinearly on the output grid: H x W uint8.

        Written to `out` where given. Outside `mask` values mean nothing. Raises `ValueError`.
        """
        from fusion.kernels import resample

        return resample(checked_index(index, self.views), *self._sampling, out)

    def counts(self, fir: Counts) -> NDArray[np.uint16]:
        """The counts (h x w uint8 or uint16) on the output grid: H x W uint16, 0 outside `mask`.

        Sampled where `apply` samples, with its rounding. Raises `ValueError` for another size or type.
        """
        from fusion.kernels16 import resample_counts

        return resample_counts(checked_counts(fir, self.views.fir.size_wh), *self._sampling, self.mask)

    def positions(self) -> Floats:
        """Where each output pixel samples the thermal image: H x W x 2 (x, y) in 1/256 px; NaN: nowhere."""
        return positions(*self._sampling, self.mask, self.views.fir.size_wh)

    def rgb(self, bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The RGB image (H x W x 3 uint8) on the output grid: itself, or undistorted, sampled bilinearly."""
        if self._from_rgb is None:
            return bgr
        from fusion.kernels import resample

        planes = [resample(np.ascontiguousarray(bgr[..., k]), *self._from_rgb) for k in range(3)]
        return np.ascontiguousarray(np.stack(planes, -1))


def metres_of(distance_m: float | None) -> float:
    """None stands for infinity. Raises `ValueError` for what is no positive number."""
    metres = math.inf if distance_m is None else float(distance_m)
    if not metres > 0:
        raise ValueError(f"expected a positive distance, got {distance_m}")
    return metres


def _maps(views: Views, metres: float, rays: Floats | None) -> tuple[NDArray[np.uint8], Sampling]:
    """Mask, and where to sample the thermal image, of every output pixel."""
    W, H = views.output.size_wh
    mask = np.empty((H, W), np.uint8)
    offset, fraction = np.empty((H, W), np.uint32), np.empty((H, W), np.uint16)
    for rows, uv in blocks((W, H)):
        known = None if rays is None else rays[rows.start * W : rows.stop * W]
        xy, seen = views.thermal_px(views.rays(uv) if known is None else known, metres)
        seen = seen & inside(xy, views.fir.size_wh)
        mask[rows] = np.where(seen, np.uint8(255), np.uint8(0)).reshape(-1, W)
        offset[rows], fraction[rows] = (a.reshape(-1, W) for a in sampling_of(xy, seen, views.fir.size_wh))
    return mask, (locked(offset), locked(fraction))


def _rgb_maps(views: Views) -> Sampling:
    """Where to sample the RGB image of every output pixel."""
    W, H = views.output.size_wh
    offset, fraction = np.empty((H, W), np.uint32), np.empty((H, W), np.uint16)
    for rows, uv in blocks((W, H)):
        xy, seen = views.rgb.project(views.rays(uv))
        offset[rows], fraction[rows] = (a.reshape(-1, W) for a in sampling_of(xy, seen, (W, H)))
    return locked(offset), locked(fraction)
