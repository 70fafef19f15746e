"""How a camera moves, from its pictures: by how much each is shifted against the one before.

A rig's cameras turn together, so their pictures shift together, whatever they see. Each quarter of a picture
is compared with its predecessor by phase correlation and the median taken, so that neither dust before the
lens nor one thing that moves decides; local contrast is made even first, so that neither exposure nor a
correction of the thermal sensor does.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.timing.freeze import picture_digest

SIZE_WH = (128, 96)
_SMOOTH_PX, _AROUND_PX = 1.5, 8.0  # finer is noise, coarser is light and the sensor's own shading
_DARK = 8.0  # grey levels below which RGB is noise

Pixels = NDArray[np.uint8] | NDArray[np.uint16]
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """`stamps_ns` (N,) ascending, of pictures that are new; `shift_px` (N - 1, 2): of each against the one
    before, x and y in pixels of a picture of `SIZE_WH`, NaN where nothing can be told. `n_repeats` pictures
    repeated another, `n_back` did not come after their predecessor: both are left out.
    """

    stamps_ns: NDArray[np.int64]
    shift_px: Floats
    n_repeats: int = 0
    n_back: int = 0

    def __post_init__(self) -> None:
        steps = max(len(self.stamps_ns) - 1, 0)
        if self.shift_px.shape != (steps, 2) or (np.diff(self.stamps_ns) <= 0).any():
            raise ValueError(f"expected ascending stamps and {steps} x 2 shifts, got {self.shift_px.shape}")


class MotionMeter:
    """Takes the pictures of one camera in order; keeps one of them, small, and two numbers of each."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._shifts: list[tuple[float, float]] = []
        self._before: NDArray[np.float32] | None = None
        self._digest = b""
        self._repeats = self._back = 0
        w, h = SIZE_WH
        self._window = cv2.createHanningWindow((w // 2, h // 2), cv2.CV_32F)

    def add(self, stamp_ns: int, pixels: Pixels, *, repeat: bool = False) -> None:
        """`pixels` is H x W counts or H x W x 3 BGR. A picture equal to its predecessor, or told to `repeat`
        it (`freeze.frozen` knows of compressed ones), says nothing: the next is compared with the last new
        one.
        """
        digest = picture_digest(pixels)
        if repeat or digest == self._digest:
            self._repeats += 1
        elif self._stamps and stamp_ns <= self._stamps[-1]:
            self._back += 1
        else:
            prepared = _even(pixels)
            if self._before is not None:
                self._shifts.append(self._shift(self._before, prepared))
            self._stamps.append(stamp_ns)
            self._before, self._digest = prepared, digest

    def motion(self) -> Motion:
        """Of all that was added so far."""
        shifts = np.array(self._shifts, np.float64).reshape(-1, 2)
        return Motion(np.array(self._stamps, np.int64), shifts, self._repeats, self._back)

    def _shift(self, before: NDArray[np.float32], after: NDArray[np.float32]) -> tuple[float, float]:
        w, h = SIZE_WH[0] // 2, SIZE_WH[1] // 2
        found: list[tuple[float, float]] = []
        for y, x in ((0, 0), (0, w), (h, 0), (h, w)):
            one, two = (np.ascontiguousarray(p[y : y + h, x : x + w]) for p in (before, after))
            shift, _ = cv2.phaseCorrelate(one, two, self._window)
            found.append((shift[0], shift[1]))
        x, y = np.median(found, axis=0) if before.any() and after.any() else (np.nan, np.nan)
        return float(x), float(y)


def _even(pixels: Pixels) -> NDArray[np.float32]:
    """Small, grey, and of one contrast everywhere; all 0 where the picture is flat."""
    grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY) if pixels.ndim == 3 else pixels
    shrinks = grey.shape[1] >= SIZE_WH[0] and grey.shape[0] >= SIZE_WH[1]
    small = cv2.resize(grey, SIZE_WH, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    values = small.astype(np.float32)
    if pixels.ndim == 3:
        values = np.log(values + np.float32(_DARK))
    fine = cv2.GaussianBlur(values, (0, 0), _SMOOTH_PX)
    fine -= cv2.GaussianBlur(fine, (0, 0), _AROUND_PX)
    contrast = np.sqrt(cv2.GaussianBlur(fine * fine, (0, 0), 2 * _AROUND_PX))
    typical = float(contrast.mean())
    if not typical > 1e-6 * max(1.0, float(np.abs(values).max())):
        return np.zeros(fine.shape, np.float32)
    return np.asarray(fine / (contrast + np.float32(0.3 * typical)), np.float32)
