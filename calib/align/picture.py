"""A picture to judge a registration by eye."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.align.channels import Doubles, Floats, grey

_TILE = 640  # pixels of a panel's longer side
_SQUARES = 8
_ORANGE = (0, 140, 255)


def overlay_picture(rgb: NDArray, fir: NDArray, H_rgb_fir: Doubles, title: str) -> NDArray[np.uint8]:
    """Three panels side by side, BGR uint8, with `title` above.

    Thermal edges on RGB where thermal is only stretched over it (before) and with `H_rgb_fir` (after), and
    a checkerboard of RGB and registered thermal. `rgb` is H x W (x 3) uint8 or uint16, `fir` the same.
    """
    base, heat = _bgr8(rgb), grey(fir).pixels
    height, width = base.shape[:2]
    stretch = np.diag([width / heat.shape[1], height / heat.shape[0], 1.0])
    panels = [_edges(base, heat, stretch), _edges(base, heat, H_rgb_fir), _checker(base, heat, H_rgb_fir)]
    scale = _TILE / max(height, width)
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    names = ("before: stretched to fit", "after", "checkerboard: RGB, thermal")
    tiles = [
        _named(cv2.resize(p, size, interpolation=cv2.INTER_AREA), n)
        for p, n in zip(panels, names, strict=True)
    ]
    row = np.hstack(tiles)
    head = np.zeros((34, row.shape[1], 3), np.uint8)
    cv2.putText(
        head, title.encode("ascii", "replace").decode(), (8, 23), 0, 0.55, (255, 255, 255), 1, cv2.LINE_AA
    )
    return np.vstack([head, row])


def _bgr8(image: NDArray) -> Floats:
    if image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8:
        return image.copy()
    eight = (255 * grey(image).pixels + 0.5).astype(np.uint8)
    return cv2.cvtColor(eight, cv2.COLOR_GRAY2BGR)


def _edges(base: Floats, heat: Floats, H: Doubles) -> Floats:
    """The strongest thermal edges in orange on a dimmed RGB image, and the thermal image's outline."""
    h, w = base.shape[:2]
    smooth = cv2.GaussianBlur(heat, (0, 0), 1.2)
    gradient = cv2.magnitude(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    local = np.sqrt(cv2.GaussianBlur(gradient * gradient, (0, 0), 20)) + float(gradient.mean()) * 0.5 + 1e-6
    strength = np.clip(gradient / local - 1.0, 0, 1)
    weight = cv2.warpPerspective(strength, H, (w, h))[..., None]
    dim = 0.7 * base.astype(np.float32)
    out = np.clip(dim * (1 - weight) + np.array(_ORANGE, np.float32) * weight, 0, 255).astype(np.uint8)
    fh, fw = heat.shape
    outline = cv2.perspectiveTransform(
        np.array([[[0, 0], [fw - 1, 0], [fw - 1, fh - 1], [0, fh - 1]]], np.float64), H
    )
    cv2.polylines(out, [np.clip(outline, -1e6, 1e6).astype(np.int32)], True, (255, 255, 0), max(w // 400, 1))
    return out


def _checker(base: Floats, heat: Floats, H: Doubles) -> Floats:
    h, w = base.shape[:2]
    eight = cv2.cvtColor((255 * heat + 0.5).astype(np.uint8), cv2.COLOR_GRAY2BGR)
    moved = cv2.warpPerspective(eight, H, (w, h))
    seen = cv2.warpPerspective(np.full(heat.shape, 255, np.uint8), H, (w, h), flags=cv2.INTER_NEAREST)
    side = max(w, h) / _SQUARES
    y, x = np.indices((h, w))
    thermal = ((y // side + x // side) % 2 == 1) & (seen > 0)
    return np.where(thermal[..., None], moved, base)


def _named(tile: Floats, name: str) -> Floats:
    cv2.rectangle(tile, (0, 0), (9 * len(name) + 12, 22), (0, 0, 0), -1)
    cv2.putText(tile, name, (6, 16), 0, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return tile
