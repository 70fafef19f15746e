"""How RGB and coloured thermal become one image: pure pixel methods, and the table that names them."""

from __future__ import annotations

from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.kernels import blend_indexed, checked
from fusion.tables import lookup

_Band = NDArray[Any]  # what OpenCV takes and gives, H x W x 3; float32 unless said otherwise

_LEVELS = 5
_SMALLEST_SIDE = 16  # pixels: no level is made of an image that is narrower


class Blender(Protocol):
    """Blends thermal, given as indices into a colour table, into RGB on the same grid.

    `bgr` is H x W x 3 uint8, `index` H x W uint8, `table_bgr` 256 x 3 uint8, `alpha` the weight [0, 1]
    of RGB, `mask` H x W uint8, non-zero where `index` is defined (None: everywhere). Returns a new
    H x W x 3 uint8 array; no argument is changed. May be called from several threads at once. Raises
    `ValueError` for other shapes, types or alpha.
    """

    def __call__(
        self,
        bgr: NDArray[np.uint8],
        index: NDArray[np.uint8],
        table_bgr: NDArray[np.uint8],
        alpha: float,
        mask: NDArray[np.uint8] | None = None,
    ) -> NDArray[np.uint8]: ...


def blend_laplacian(
    bgr: NDArray[np.uint8],
    index: NDArray[np.uint8],
    table_bgr: NDArray[np.uint8],
    alpha: float,
    mask: NDArray[np.uint8] | None = None,
) -> NDArray[np.uint8]:
    """Blend in Laplacian pyramids (Burt & Adelson 1983), so that the edges of both images stay sharp.

    Parameters and result as for `Blender`. In every detail band the coefficient of larger magnitude
    wins, after weights of min(1, 2 alpha) for RGB and min(1, 2 - 2 alpha) for thermal: at 1/2 both count
    in full, at either end one image is left alone, and at 0.85 thermal must be 3.3 times as strong as
    RGB to win, and then enters at 0.3 of its strength. Magnitude is the length of the three channels
    together, so that no pixel mixes its hue from two images. The base is the mean with weights alpha and
    1 - alpha. Where `mask` is zero thermal counts as equal to RGB, and RGB is kept: nothing foreign is
    pulled over the border. Computed in float32, rounded half up.
    """
    if not 0 <= alpha <= 1:
        raise ValueError(f"expected alpha in [0, 1], got {alpha}")
    rgb = checked("bgr", bgr, np.uint8, (None, None, 3))
    index = checked("index", index, np.uint8, rgb.shape[:2])
    thermal: _Band = checked("table_bgr", table_bgr, np.uint8, (256, 3)).take(index, axis=0)
    outside = None if mask is None else (checked("mask", mask, np.uint8, rgb.shape[:2]) == 0).astype(np.uint8)
    if outside is not None:
        thermal = cv2.copyTo(rgb, outside, thermal)
    first, second = _pyramid(rgb), _pyramid(thermal)
    merged: _Band = cv2.addWeighted(first.pop(), alpha, second.pop(), 1 - alpha, 0)
    while first:
        detail = _stronger(first.pop() * min(1.0, 2 * alpha), second.pop() * min(1.0, 2 - 2 * alpha))
        merged = _expanded(merged, detail.shape) + detail
    fused: _Band = np.clip(np.floor(merged + np.float32(0.5)), 0, 255).astype(np.uint8)
    if outside is not None:
        fused = cv2.copyTo(rgb, outside, fused)
    return fused


def _pyramid(pixels: _Band) -> list[_Band]:
    """Detail bands from fine to coarse, and last the base that is left; float32, H x W x 3."""
    bands, rest = [], pixels.astype(np.float32)
    while len(bands) < _LEVELS and min(rest.shape[:2]) >= _SMALLEST_SIDE:
        coarse = cv2.pyrDown(rest)
        bands.append(rest - _expanded(coarse, rest.shape))
        rest = coarse
    return [*bands, rest]


def _expanded(coarse: _Band, shape: tuple[int, ...]) -> _Band:
    return cv2.pyrUp(coarse, dstsize=(shape[1], shape[0]))


def _stronger(first: _Band, second: _Band) -> _Band:
    """Of each pixel's two coefficient vectors the longer one; the first of equals."""
    wins = _squared_length(second) > _squared_length(first)
    return cv2.copyTo(second, wins.astype(np.uint8), first.copy())


def _squared_length(band: _Band) -> _Band:
    b, g, r = cv2.split(band)
    return b * b + g * g + r * r


BLENDERS: dict[str, Blender] = {"alpha": blend_indexed, "laplacian": blend_laplacian}


def blender(name: str) -> Blender:
    """The blender called `name`: one of `BLENDERS`, or of the installed entry points `fusion.blenders`.

    Raises `UsageError` that lists the names where there is none.
    """
    return lookup(BLENDERS, "fusion.blenders", name, "blender")
