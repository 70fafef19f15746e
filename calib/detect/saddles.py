"""Corners of a chessboard as saddle points of brightness: where four squares meet, of either polarity.

Pixel coordinates as everywhere: (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from calib.detect.saddles_kernels import fit_windows
from fusion.geometry import Floats
from fusion.kernels import read_only

Image = NDArray[np.float32]

_RING = np.linspace(0, 2 * np.pi, 24, endpoint=False)


@dataclass(frozen=True, slots=True, eq=False)
class Saddles:
    """N saddle points.

    `xy` (N, 2) px; `bright` (N,) rad, the direction in which it is brighter on both sides, modulo pi; `half`
    (N,) rad, the angle from there to either edge of the squares; `strength` (N,), minus the Hessian's
    determinant.
    """

    xy: Floats
    bright: Floats
    half: Floats
    strength: Floats

    def __len__(self) -> int:
        return len(self.xy)

    def __getitem__(self, rows: NDArray[Any]) -> Saddles:
        return Saddles(self.xy[rows], self.bright[rows], self.half[rows], self.strength[rows])


def normalised(gray: NDArray[Any], sigma_px: float = 15.0) -> Image:
    """`gray` (H x W of numbers) less its blurred background, by its local deviation: H x W float32.

    What is flat to less than half a count stays near 0.
    """
    image = gray.astype(np.float32)
    flat = np.asarray(image - _wide_blur(image, sigma_px), np.float32)
    power = _wide_blur(np.square(flat, dtype=np.float32), sigma_px)
    return np.asarray(flat / np.sqrt(power + np.float32(0.25)), np.float32)


def _wide_blur(image: Image, sigma_px: float) -> Image:
    """A Gaussian blur by way of an image a quarter as wide and high, which costs a tenth."""
    h, w = image.shape
    if min(h, w) < 32 or sigma_px < 8:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), np.float32)
    small = cv2.resize(image, (w // 4, h // 4), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), sigma_px / 4, borderType=cv2.BORDER_REFLECT)
    return np.asarray(cv2.resize(small, (w, h), interpolation=cv2.INTER_LINEAR), np.float32)


class Surface:
    """An image smoothed by `sigma_px`, with its derivatives, to be looked up between pixels."""

    def __init__(self, image: Image, sigma_px: float) -> None:
        self.value = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), np.float32)
        xx = cv2.Sobel(self.value, cv2.CV_32F, 2, 0, ksize=3, scale=1 / 4)
        yy = cv2.Sobel(self.value, cv2.CV_32F, 0, 2, ksize=3, scale=1 / 4)
        xy = cv2.Sobel(self.value, cv2.CV_32F, 1, 1, ksize=3, scale=1 / 4)
        self._maps = (
            cv2.Sobel(self.value, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8),
            cv2.Sobel(self.value, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8),
            xx,
            xy,
            yy,
        )
        self.saddleness = np.asarray(xy * xy - xx * yy, np.float32)

    def at(self, xy: Floats) -> Floats:
        """The smoothed image at any array of (x, y); beyond the border as at the border."""
        return look_up(self.value, xy)

    def derivatives(self, xy: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """d/dx, d/dy, d2/dx2, d2/dxdy, d2/dy2 at (N, 2) places."""
        x, y, xx, xy_, yy = (look_up(np.asarray(m, np.float32), xy) for m in self._maps)
        return x, y, xx, xy_, yy

    def saddles_from(
        self, start: Floats, reach_px: NDArray[Any] | float
    ) -> tuple[Saddles, NDArray[np.bool_]]:
        """The saddle points next to (N, 2) places, by Newton's method, and which are such within reach."""
        xy = start.astype(np.float64)
        step = np.zeros_like(xy)
        for _ in range(5):
            x, y, xx, cross, yy = self.derivatives(xy)
            det = np.minimum(xx * yy - cross * cross, -1e-12)
            step = np.stack([(cross * y - yy * x) / det, (cross * x - xx * y) / det], 1)
            step *= np.minimum(1, 1 / np.maximum(np.hypot(*step.T), 1e-9))[:, None]
            xy = xy + step
        _, _, xx, cross, yy = self.derivatives(xy)
        strength = cross * cross - xx * yy
        h, w = self.value.shape
        inside = (xy >= 1).all(1) & (xy <= (w - 2, h - 2)).all(1)
        near = np.hypot(*(xy - start).T) <= reach_px
        good = inside & near & (strength > 0) & (np.hypot(*step.T) < 0.1)
        bright = 0.5 * np.arctan2(2 * cross, xx - yy)
        root = np.hypot((xx - yy) / 2, cross)
        upper, lower = (xx + yy) / 2 + root, root - (xx + yy) / 2
        half = np.arctan2(np.sqrt(np.maximum(upper, 1e-12)), np.sqrt(np.maximum(lower, 1e-12)))
        return Saddles(xy, bright, half, strength), good


def look_up(image: Image, xy: Floats) -> Floats:
    """Bilinear values of `image` at places of any shape (..., 2); beyond the border as at the border."""
    flat = np.ascontiguousarray(xy, np.float32).reshape(1, -1, 2)
    if not flat.size:
        return np.zeros(xy.shape[:-1])
    rows = [
        cv2.remap(image, part, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
        for part in np.array_split(flat, flat.shape[1] // 30000 + 1, axis=1)  # remap takes short rows only
    ]
    return np.concatenate(rows, 1).reshape(xy.shape[:-1]).astype(np.float64)


def find_saddles(surface: Surface, ring_px: float, most: int = 1500) -> Saddles:
    """The strongest saddle points whose ring of radius `ring_px` is bright, dark, bright, dark."""
    peak = surface.saddleness
    floor = max(1e-4, float(np.percentile(peak[::4, ::4], 50)))
    is_peak = (peak >= cv2.dilate(peak, np.ones((3, 3), np.uint8))) & (peak > floor)
    y, x = np.nonzero(is_peak)
    order = np.argsort(-peak[y, x], kind="stable")[: 3 * most]
    start = np.stack([x[order], y[order]], 1).astype(np.float64)
    if not len(start):
        return Saddles(start, start[:, 0], start[:, 0], start[:, 0])
    found, good = surface.saddles_from(start, 2.0)
    found = found[np.flatnonzero(good)]
    found = found[np.flatnonzero(alternates(surface, found.xy, ring_px))]
    return found[_first_of_each(found.xy)[:most]]


def alternates(surface: Surface, xy: Floats, ring_px: float) -> NDArray[np.bool_]:
    """Whether brightness on a ring about each point changes exactly four times, by like amounts."""
    ring = surface.at(xy[:, None] + ring_px * np.stack([np.cos(_RING), np.sin(_RING)], 1))
    ring = ring - surface.at(xy)[:, None]
    changes = ((ring > 0) != (np.roll(ring, 1, 1) > 0)).sum(1)
    opposite = ring + np.roll(ring, len(_RING) // 2, 1)  # the same on both sides, unlike an edge's
    even, odd = (opposite**2).mean(1), ((ring * 2 - opposite) ** 2).mean(1)
    return (changes == 4) & (even > odd)


def _first_of_each(xy: Floats) -> NDArray[np.intp]:
    """Rows of points, of which those that lie within a pixel of an earlier one are left out."""
    keep = np.ones(len(xy), bool)
    for _, later in sorted(KDTree(xy).query_pairs(1.0)) if len(xy) else ():
        keep[later] = False
    return np.flatnonzero(keep)


def fit_corners(image: Image, xy: Floats, along: Floats, radius_px: Floats) -> tuple[Floats, Floats]:
    """Corners of squares to a small part of a pixel: a blurred corner on a slope, by least squares.

    About each of N places `xy`, the model is c0 + c . d + A erf(d1 / s) erf(d2 / s) with d the offset from
    the corner and d1, d2 the distances to its edges, whose directions `along` (N, 2) rad begin the search.
    Unlike the saddle point itself it is not moved by a glow, whose slope has terms of its own. `radius_px`
    (N,) is the window's. Returns (N, 2) px and A (N,) in grey levels, whose sign says which two of the four
    squares are bright. Fits that moved by more than a third of their window are NaN in both.
    """
    start = np.clip(xy, 0, np.array(image.shape[::-1]) - 1.0)
    moved, height = np.zeros((len(xy), 2)), np.zeros(len(xy))
    fit_windows(
        read_only(np.ascontiguousarray(image, np.float32)),
        read_only(np.ascontiguousarray(start, np.float64)),
        read_only(np.ascontiguousarray(along, np.float64)),
        read_only(np.ascontiguousarray(radius_px, np.float64)),
        moved,
        height,
    )
    good = np.hypot(*moved.T) <= radius_px / 3
    return np.where(good[:, None], start + moved, np.nan), np.where(good, height, np.nan)
