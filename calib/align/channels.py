"""What an image looks like where neither contrast nor its sign can be trusted: unsigned edge orientations.

After CFOG (Y. Ye et al., "Fast and robust matching for multimodal remote sensing image registration", 2019):
a histogram of unsigned orientations at every pixel. Here it is kept as its first Fourier terms, cos and sin
of 2, 4 and 6 times the angle, which are orthogonal, hold what eight smooth bins hold, and have no mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.errors import InputError

# What OpenCV takes and gives: H x W float32, and masks of uint8.
Floats = NDArray[Any]
Mask = NDArray[Any]
Doubles = NDArray[np.float64]

_WEIGHTS = (1.0, 0.8, 0.5)  # of the three Fourier terms: those of bins 22.5 degrees wide, smoothed once
_LEAST_EMPTY, _CONVEX = 5e-4, 0.97  # of the image; of the hull of what is left
_FLOOR = 0.02  # of the mean energy: what counts as flat
_CLIP = (0.5, 99.5)  # percentiles of the counts that are stretched to [0, 1]


@dataclass(frozen=True, slots=True, eq=False)
class Grey:
    """`pixels` H x W float32 in [0, 1], and `seen` H x W uint8, 255 where they show the scene."""

    pixels: Floats
    seen: Mask

    @property
    def shape(self) -> tuple[int, int]:
        return self.seen.shape[0], self.seen.shape[1]


def grey(image: NDArray) -> Grey:
    """`image` (H x W or H x W x 3, uint8 or uint16, BGR) between its percentiles, empty borders marked.

    Raises `ValueError` for other shapes or types, `InputError` for an image that shows nothing.
    """
    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3) or image.size == 0:
        raise ValueError(f"expected H x W (x 3) of uint8 or uint16, got {image.shape} {image.dtype}")
    if image.ndim == 3:
        if image.shape[2] not in (1, 3):
            raise ValueError(f"expected 1 or 3 channels, got {image.shape[2]}")
        image = image[:, :, 0] if image.shape[2] == 1 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    lo, hi = np.percentile(image, _CLIP)
    if hi <= lo:
        lo, hi = float(image.min()), float(image.max())
    if hi <= lo:
        raise InputError(f"the image shows nothing: every pixel is {lo:g}")
    stretched = np.clip((image.astype(np.float32) - np.float32(lo)) / np.float32(hi - lo), 0, 1)
    return Grey(stretched, _seen(image))


def _seen(plane: NDArray) -> NDArray[np.uint8]:
    """255, but 0 where a rectified or warped image is empty around its convex content.

    Empty is one value, the image's least, in areas that reach the border. Where what is left is not convex
    (a cold sky over roofs) those areas are content.
    """
    whole = np.full(plane.shape, 255, np.uint8)
    least = (plane == plane.min()).astype(np.uint8)
    count, label, about, _ = cv2.connectedComponentsWithStats(least, connectivity=4)
    rim = np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]])
    empty = np.zeros(count, bool)
    empty[rim] = True
    empty &= about[:, cv2.CC_STAT_AREA] > _LEAST_EMPTY * plane.size
    empty[0] = False
    content = np.where(empty, 0, 255).astype(np.uint8)[label]
    if not empty.any() or not content.any():
        return whole
    hull = cv2.convexHull(cv2.findNonZero(content))
    filled = cv2.fillConvexPoly(np.zeros_like(content), hull, 255)
    convex = np.count_nonzero(content) >= _CONVEX * np.count_nonzero(filled)
    return content if convex else whole


def inverse(matrix: Doubles) -> Doubles:
    return np.asarray(np.linalg.inv(matrix), np.float64)


def resized(image: Grey, scale: float) -> tuple[Grey, Doubles]:
    """`image` enlarged by about `scale`, and the 3x3 matrix from its pixels to those of the result."""
    height, width = image.shape
    w, h = max(round(width * scale), 1), max(round(height * scale), 1)
    if (w, h) == (width, height):
        return image, np.eye(3)
    way = cv2.INTER_AREA if w <= width else cv2.INTER_LINEAR
    sx, sy = w / width, h / height
    matrix = np.array([[sx, 0, 0.5 * sx - 0.5], [0, sy, 0.5 * sy - 0.5], [0, 0, 1]])
    seen = cv2.resize(image.seen, (w, h), interpolation=cv2.INTER_NEAREST)
    return Grey(cv2.resize(image.pixels, (w, h), interpolation=way), seen), matrix


def warped(image: Grey, matrix: Doubles, size_wh: tuple[int, int]) -> Grey:
    """`image` moved by `matrix` (source to result) without aliasing; not seen where it comes from outside."""
    shrink = float(np.sqrt(abs(np.linalg.det(matrix[:2, :2]))))
    if shrink < 0.8:
        image, smaller = resized(image, shrink)
        matrix = matrix @ inverse(smaller)
    moved = cv2.warpPerspective(image.pixels, matrix, size_wh, borderMode=cv2.BORDER_REPLICATE)
    return Grey(moved, cv2.warpPerspective(image.seen, matrix, size_wh, flags=cv2.INTER_NEAREST))


def channels(image: Grey, *, blur: float = 1.0, local: float = 6.0) -> Floats:
    """6 x H x W float32: the orientation terms of `image`, blurred by `blur` px and locally normalised.

    Zero where it is not seen and on a rim of 3 px around that, for such a border is no edge of the scene.
    """
    smooth = cv2.GaussianBlur(image.pixels, (0, 0), blur)
    x, y = cv2.Scharr(smooth, cv2.CV_32F, 1, 0), cv2.Scharr(smooth, cv2.CV_32F, 0, 1)
    strength = np.sqrt(x * x + y * y)
    unit = (x + 1j * y) / (strength + np.float32(1e-6))
    turn = unit * unit
    planes = np.empty((6, *image.shape), np.float32)
    term = (strength * _interior(image.seen)).astype(np.complex64)
    for k, weight in enumerate(_WEIGHTS):
        term = term * turn
        planes[2 * k], planes[2 * k + 1] = weight * term.real, weight * term.imag
    for plane in planes:
        cv2.GaussianBlur(plane, (0, 0), blur, dst=plane)
    energy = cv2.GaussianBlur(np.einsum("chw,chw->hw", planes, planes), (0, 0), local)
    floor = _FLOOR * float(energy.mean()) + 1e-12
    return planes / np.sqrt(energy + np.float32(floor))


def _interior(seen: NDArray[np.uint8]) -> NDArray[np.bool_]:
    return cv2.erode(seen, np.ones((7, 7), np.uint8), borderValue=255) > 0
