"""Depth as people look at it: in colour with a scale beside it (thesis figure 6.3), or over an image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.colormaps import colormap_bgr
from fusion.lidar.sparse import SparseDepth

NONE_GREY, PAPER, INK = 96, 255, (32, 32, 32)
BAR_WIDTH, BAR_GAP, LABEL_WIDTH = 18, 10, 76
FONT_PX, LEAST_HEIGHT = 14, 120
REGULAR = 400  # said, for OpenCV draws on in the weight that this thread drew in last


def coloured(value_m: NDArray[np.float32], colormap: str, show_m: tuple[float, float]) -> NDArray[np.uint8]:
    """BGR of values (metres): `show_m` spans the whole map, beyond it the end colours; 0 is grey."""
    lo, hi = show_m
    index = np.floor(np.clip((value_m - np.float32(lo)) / np.float32(hi - lo), 0, 1) * 255 + np.float32(0.5))
    bgr = colormap_bgr(colormap)[index.astype(np.uint8)]
    bgr[value_m <= 0] = NONE_GREY
    return bgr


def depth_picture(
    value_m: NDArray[np.float32], colormap: str = "jet", show_m: tuple[float, float] = (1.0, 10.0)
) -> NDArray[np.uint8]:
    """A map in colour with a scale bar in metres on its right, BGR uint8. Grey: no value."""
    bgr = coloured(value_m, colormap, show_m)
    height = max(len(bgr), LEAST_HEIGHT)
    padded = np.full((height, bgr.shape[1], 3), PAPER, np.uint8)
    padded[: len(bgr)] = bgr
    return np.hstack([padded, _scale(height, colormap, show_m)])


def overlay(
    bgr: NDArray[np.uint8],
    sparse: SparseDepth,
    colormap: str = "jet",
    show_m: tuple[float, float] = (1.0, 10.0),
) -> NDArray[np.uint8]:
    """A copy of an image with every sample as a dot, coloured by its value, the nearer over the farther."""
    if bgr.shape[1::-1] != sparse.size_wh:
        raise ValueError(f"expected an image of {sparse.size_wh}, got {bgr.shape[1::-1]}")
    picture, radius = bgr.copy(), max(1, round(bgr.shape[1] / 640))
    order = np.argsort(-sparse.value_m, kind="stable")
    colours = coloured(sparse.value_m[order], colormap, show_m).tolist()
    at = np.rint(np.stack([sparse.u[order], sparse.v[order]], -1)).astype(int).tolist()
    for centre, colour in zip(at, colours, strict=True):
        cv2.circle(picture, centre, radius, colour, cv2.FILLED)
    return picture


def _scale(height: int, colormap: str, show_m: tuple[float, float]) -> NDArray[np.uint8]:
    """The colour bar: the largest value on top, labelled at round numbers."""
    lo, hi = show_m
    margin = FONT_PX
    strip = np.full((height, BAR_GAP + BAR_WIDTH + LABEL_WIDTH, 3), PAPER, np.uint8)
    rows = np.arange(margin, height - margin)
    values = hi - (rows - margin + 0.5) / len(rows) * (hi - lo)
    bar = colormap_bgr(colormap)[np.clip(np.floor((values - lo) / (hi - lo) * 255 + 0.5), 0, 255).astype(int)]
    strip[rows, BAR_GAP : BAR_GAP + BAR_WIDTH] = bar[:, None]
    for tick in _ticks(lo, hi, len(rows) // (3 * FONT_PX)):
        row = round(margin + (hi - tick) / (hi - lo) * len(rows) - 0.5)
        cv2.line(strip, (BAR_GAP + BAR_WIDTH, row), (BAR_GAP + BAR_WIDTH + 3, row), INK)
        at = (BAR_GAP + BAR_WIDTH + 6, row + FONT_PX // 2 - 2)
        cv2.putText(strip, f"{tick:g} m", at, INK, cv2.FontFace("sans"), FONT_PX, weight=REGULAR)
    return strip


def _ticks(lo: float, hi: float, most: int) -> list[float]:
    """Round values (1, 2 or 5 times a power of ten apart) from `lo` to `hi`, both ends included."""
    least = (hi - lo) / max(most, 1)
    power = 10.0 ** np.floor(np.log10(least))
    step = next(power * k for k in (1, 2, 5, 10) if power * k >= least * (1 - 1e-9))
    inner = np.arange(np.ceil(lo / step), np.floor(hi / step) + 1) * step
    kept = [float(t) for t in inner if min(t - lo, hi - t) > 0.4 * step]
    return [lo, *kept, hi]
