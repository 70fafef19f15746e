"""Small pictures of what was found: thumbnails, histograms, a cloud from above, a stream along time."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.codecs import encode_jpeg, encode_png
from fusion.frames import PointCloud
from fusion.inspect.base import Picture
from fusion.inspect.measure import PixelTally

THUMB_WH = (480, 360)
STRIP_WH = (720, 16)
HISTOGRAM_WH = (512, 120)
TOP_PX = 480
_TOP_SHARE = 0.99  # of the points lie in the picture from above: a few stray ones would shrink the rest
_PAPER, _INK, _RED, _LINE = (255, 255, 255), (120, 70, 20), (60, 60, 220), (205, 205, 205)


def thumbnail(title: str, pixels: NDArray[Any]) -> Picture:
    """A picture, at most `THUMB_WH`. Counts are stretched from their 1st to their 99th percentile, and it
    says so.
    """
    size = f"{pixels.shape[1]}x{pixels.shape[0]} {pixels.dtype.name}"
    small = _shrunk(pixels)
    if small.ndim == 3:
        bgr = small[..., :3]
        bgr = bgr if bgr.dtype == np.uint8 else cv2.convertScaleAbs(bgr, alpha=1 / 257)
        return Picture(title, size, encode_jpeg(np.ascontiguousarray(bgr), 85))
    if small.dtype == np.uint8:
        return Picture(title, size, encode_png(small))
    grey, lo, hi = _stretched(pixels, small)
    return Picture(title, f"{size}; black is {lo:,.6g}, white {hi:,.6g}", encode_png(grey))


def histogram(title: str, tally: PixelTally) -> Picture | None:
    """How often each count occurs, from the least to the most; None for floats, and where there are none."""
    there = np.flatnonzero(tally.histogram)
    if not len(there):
        return None
    lo, hi = int(there[0]), int(there[-1])
    width, height = HISTOGRAM_WH
    bars = min(width, hi - lo + 1)
    at = (np.arange(lo, hi + 1) - lo) * bars // (hi - lo + 1)
    heights = np.bincount(at, tally.histogram[lo : hi + 1], bars)
    tops = np.ceil(heights / heights.max() * (height - 1)).astype(int)
    column = np.arange(width) * bars // width
    filled = np.arange(height)[::-1, None] < tops[column][None, :]
    bgr = np.where(filled[..., None], _INK, _PAPER).astype(np.uint8)
    return Picture(title, f"{lo:,} (left) to {hi:,} (right)", encode_png(np.ascontiguousarray(bgr)))


def top_view(title: str, cloud: PointCloud) -> Picture | None:
    """The cloud from above, x up and y to the left, denser places darker; the sensor is the cross. None if
    empty.
    """
    if not len(cloud):
        return None
    xy = cloud.xyz_m[:, :2].astype(np.float64)
    half = max(float(np.quantile(np.abs(xy - np.median(xy, axis=0)).max(axis=1), _TOP_SHARE)), 1e-3) * 1.02
    centre = np.median(xy, axis=0)
    per_m = TOP_PX / (2 * half)
    rows, cols = ((TOP_PX / 2 - (xy - centre) * per_m).T).astype(np.int64)
    inside = (rows >= 0) & (rows < TOP_PX) & (cols >= 0) & (cols < TOP_PX)
    hits = np.bincount(rows[inside] * TOP_PX + cols[inside], minlength=TOP_PX**2).reshape(TOP_PX, TOP_PX)
    shade = np.log1p(hits) / max(np.log1p(hits.max()), 1e-9)
    grey = np.where(hits > 0, 200 - 200 * shade, 255).astype(np.uint8)
    bgr = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    here = np.rint(TOP_PX / 2 + centre * per_m).astype(int)  # of the origin: column by y, row by x
    if (np.abs(here) < 10 * TOP_PX).all():
        where = (int(here[1]), int(here[0]))
        cv2.drawMarker(bgr, where, _RED, cv2.MARKER_CROSS, 14, 2)
    step = _round_length(half / 2)
    cv2.line(bgr, (10, TOP_PX - 12), (10 + round(step * per_m), TOP_PX - 12), _RED, 3)
    shown = int(np.count_nonzero(inside))
    caption = f"from above, x up, y left; the bar is {step:g} m; {shown:,} of {len(cloud):,} points"
    return Picture(title, caption, encode_png(bgr))


def strip(stamps_ns: NDArray[Any], span_ns: tuple[int, int], gaps_ns: tuple[tuple[int, int], ...]) -> bytes:
    """When a stream's messages came, from left to right over `span_ns`; its longest gaps are red. PNG."""
    width, height = STRIP_WH
    first, last = span_ns
    scale = (width - 1) / max(last - first, 1)
    bgr = np.full((height, width, 3), _PAPER, np.uint8)
    bgr[[0, -1]] = _LINE
    for begin, end in gaps_ns:
        left, right = (round((t - first) * scale) for t in (begin, end))
        bgr[3:-3, max(left, 0) : max(right + 1, 0)] = _RED
    at = np.clip(((stamps_ns - first).astype(np.float64) * scale).round().astype(np.int64), 0, width - 1)
    bgr[1:-1, np.unique(at)] = _INK
    return encode_png(bgr)


def _shrunk(pixels: NDArray[Any]) -> NDArray[Any]:
    height, width = pixels.shape[:2]
    scale = min(THUMB_WH[0] / width, THUMB_WH[1] / height, 1.0)
    if scale == 1.0:
        return pixels
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def _stretched(pixels: NDArray[Any], small: NDArray[Any]) -> tuple[NDArray[np.uint8], float, float]:
    finite = pixels[np.isfinite(pixels)] if pixels.dtype.kind == "f" else pixels.reshape(-1)
    lo, hi = (
        float(v)
        for v in np.quantile(finite[:: max(finite.size // 100_000, 1)], (0.01, 0.99), method="nearest")
    )
    hi = hi if hi > lo else lo + 1
    scaled = np.nan_to_num((small.astype(np.float64) - lo) / (hi - lo), nan=0.0, posinf=1.0, neginf=0.0)
    return (np.clip(scaled, 0, 1) * 255 + 0.5).astype(np.uint8), lo, hi


def _round_length(most: float) -> float:
    """1, 2 or 5 times a power of ten, not above `most`."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(max(power * k for k in (1, 2, 5) if power * k <= most * (1 + 1e-9)))
