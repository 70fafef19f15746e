"""Boards seen by a pinhole camera, drawn from their printed page: pictures whose truth is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.boards import Board
from calib.printing import Circle, Page, Rect, board_page
from fusion.geometry import Floats

SUPER = 4  # samples across a pixel
SIZE_WH = (480, 360)


def raster(page: Page, px_per_mm: float) -> NDArray[np.uint8]:
    """The page sampled at pixel centres, 0 black, 255 white: x mm is pixel x * px_per_mm - 0.5."""
    w, h = (round(side * px_per_mm) for side in page.size_wh_mm)
    x, y = ((np.arange(n) + 0.5) / px_per_mm for n in (w, h))
    picture = np.full((h, w), 255, np.uint8)
    for shape in page.shapes:
        if isinstance(shape, Rect):
            i0, i1 = np.searchsorted(y, (shape.y, shape.y + shape.h))
            j0, j1 = np.searchsorted(x, (shape.x, shape.x + shape.w))
            picture[i0:i1, j0:j1] = 0 if shape.black else 255
        elif isinstance(shape, Circle):
            i0, i1 = np.searchsorted(y, (shape.y - shape.r, shape.y + shape.r))
            j0, j1 = np.searchsorted(x, (shape.x - shape.r, shape.x + shape.r))
            inside = np.hypot(x[None, j0:j1] - shape.x, y[i0:i1, None] - shape.y) < shape.r
            picture[i0:i1, j0:j1][inside] = 0
    return picture


@dataclass(frozen=True)
class Shot:
    """A picture of a board: brightness 0..1 before noise, and the true pixels of all points."""

    bright: Floats
    uv: Floats

    def counts(self, low: float, contrast: float, noise: float = 0.0, seed: int = 0, bits: int = 8) -> Any:
        """As a camera counts it; a negative contrast is a board that is warm where the print is dark."""
        rng = np.random.default_rng(seed)
        value = low + contrast * self.bright + noise * rng.normal(size=self.bright.shape)
        return np.clip(np.round(value), 0, 2**bits - 1).astype(np.uint8 if bits == 8 else np.uint16)

    def error(self, ids: NDArray[np.intp], uv: Floats, board: Board) -> Floats:
        """Distances of found points from the truth, px, under the symmetry of the board that fits best."""
        errors = [np.hypot(*(uv - self.uv[turn[ids]]).T) for turn in board.symmetries()]
        return min(errors, key=lambda error: float(error.sum()))


def shoot(
    board: Board,
    *,
    tilt: tuple[float, float] = (0.3, -0.4),
    turn: float = 0.2,
    fill: float = 0.7,
    shift: tuple[float, float] = (0.0, 0.0),
    size_wh: tuple[int, int] = SIZE_WH,
    blur_px: float = 0.7,
    around: float = 0.6,
) -> Shot:
    """The board turned (rad), its pattern about `fill` of the width wide, `shift` px off the middle."""
    page = board_page(board)
    f = float(size_wh[0])
    first = np.array([*page.first_mm, 0.0])
    points = board.points_m * 1000 + first
    middle = (points.min(0) + points.max(0)) / 2
    R = cv2.Rodrigues(np.array([*tilt, 0.0]))[0] @ cv2.Rodrigues(np.array([0, 0, turn]))[0]
    away = f * np.ptp(points[:, 0]) / (fill * size_wh[0])
    centre = (np.array(size_wh) - 1) / 2 + shift
    K = np.array([[f, 0, centre[0]], [0, f, centre[1]], [0, 0, 1]])
    H = K @ np.column_stack([R[:, 0], R[:, 1], np.array([0, 0, away]) - R @ middle])  # mm on the page -> px
    px_per_mm = 2 * SUPER * f / away
    hi = np.array([[SUPER, 0, (SUPER - 1) / 2], [0, SUPER, (SUPER - 1) / 2], [0, 0, 1.0]])
    to_mm = np.array([[1 / px_per_mm, 0, 0.5 / px_per_mm], [0, 1 / px_per_mm, 0.5 / px_per_mm], [0, 0, 1]])
    size = (size_wh[0] * SUPER, size_wh[1] * SUPER)
    drawn = cv2.warpPerspective(raster(page, px_per_mm), hi @ H @ to_mm, size, borderValue=255 * around)
    small = cv2.resize(drawn, size_wh, interpolation=cv2.INTER_AREA).astype(np.float64) / 255
    uv = points @ np.column_stack([H[:, 0], H[:, 1], np.zeros(3)]).T + H[:, 2]
    return Shot(np.asarray(cv2.GaussianBlur(small, (0, 0), blur_px), np.float64), uv[:, :2] / uv[:, 2:])


def glow(size_wh: tuple[int, int] = SIZE_WH) -> Floats:
    """A strong uneven background, 0..1."""
    w, h = size_wh
    y, x = np.mgrid[:h, :w]
    return np.exp(-(((x - 0.3 * w) / (0.4 * w)) ** 2 + ((y - 0.8 * h) / (0.5 * h)) ** 2))


def without_board(seed: int, size_wh: tuple[int, int] = (240, 180)) -> NDArray[np.uint8]:
    """Pictures in which there is no board: noise, rock, stripes, tiles, windows, gravel, by turns."""
    rng, (w, h) = np.random.default_rng(seed), size_wh
    y, x = np.mgrid[:h, :w].astype(np.float64)
    kind = seed % 6
    if kind == 0:
        value = rng.normal(128, 40, (h, w))
    elif kind == 1:
        value = sum(
            cv2.resize(rng.normal(0, 30, (n, n)), (w, h), interpolation=cv2.INTER_CUBIC) for n in (5, 15, 45)
        )
        value = 128 + np.asarray(value)
    elif kind == 2:
        value = 128 + 80 * np.sign(np.sin(x / rng.uniform(2, 9) + y / rng.uniform(5, 30)))
    elif kind == 3:
        value = 60 + 130 * ((x % rng.integers(9, 30) > 3) & (y % rng.integers(9, 30) > 3))
    elif kind == 4:
        value = 90 + 60 * np.sin(x / rng.uniform(2, 4)) * np.sin(y / rng.uniform(2, 4))
    else:
        value = np.full((h, w), 90.0)
        for _ in range(60):
            at, r = (int(rng.integers(w)), int(rng.integers(h))), int(rng.integers(2, 12))
            cv2.circle(value, at, r, float(rng.uniform(0, 255)), -1, cv2.LINE_AA)
    return np.clip(value + rng.normal(0, 4, (h, w)), 0, 255).astype(np.uint8)
