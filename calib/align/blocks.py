"""What a first registration still lacks: displacements of blocks, and the map that most of them agree on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from calib.align.channels import Doubles, Floats, Grey, channels, warped
from calib.align.models import Model, corners_of, fit, project

_CELL = 8  # pixels of the working grid; blocks overlap, one is centred in every cell
_WINDOW = 1.5  # cells: the standard deviation of a block's bell-shaped window
_LEAST_BLOCKS = 6
_LEAST_FILL = 0.5  # of a block's window must be seen by both images


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """The part of the RGB image that matters, on a grid of its own: `matrix` takes RGB pixels to it."""

    matrix: Doubles
    size_wh: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """Correlation of blocks over displacements, in a grid's pixels.

    `at` (N, 2) are the middles of the blocks, `surface` (N, 2 reach + 1, 2 reach + 1) their correlation
    when the thermal image moves by (dy, dx) on the RGB image.
    """

    at: Doubles
    surface: Floats

    @property
    def reach(self) -> int:
        return self.surface.shape[1] // 2


def grid_for(H_rgb_fir: Doubles, rgb_shape: tuple[int, ...], fir_shape: tuple[int, ...], width: int) -> Grid:
    """The RGB rectangle around the projected thermal image, `width` px long, at most enlarged 1.5 times."""
    xy = project(H_rgb_fir, corners_of(fir_shape))
    h, w = rgb_shape
    low = np.clip(np.floor(xy.min(axis=0)), 0, [w - 1, h - 1])
    high = np.clip(np.ceil(xy.max(axis=0)), 0, [w - 1, h - 1])
    extent = np.maximum(high - low + 1, 16)
    scale = min(width / extent.max(), 1.5)
    size = np.maximum(np.round(extent * scale), 16).astype(int)
    sx, sy = size / extent
    matrix = np.array([[sx, 0, sx * (0.5 - low[0]) - 0.5], [0, sy, sy * (0.5 - low[1]) - 0.5], [0, 0, 1]])
    return Grid(matrix, (int(size[0]), int(size[1])))


def on_grid(rgb: Grey, fir: Grey, H: Doubles, grid: Grid) -> tuple[Floats, Floats]:
    """The channels of both images on `grid`, 6 x h x w; zero where either is not seen."""
    a, b = warped(rgb, grid.matrix, grid.size_wh), warped(fir, grid.matrix @ H, grid.size_wh)
    both = cv2.erode(cv2.min(a.seen, b.seen), np.ones((3, 3), np.uint8), borderValue=255) > 0
    return channels(a) * both, channels(b) * both


def correlation(p: Floats, q: Floats) -> float:
    """Masked feature correlation of channels from `on_grid`, in [-1, 1]."""
    energy = float(np.vdot(p, p)) * float(np.vdot(q, q))
    return float(np.vdot(p, q)) / float(np.sqrt(energy)) if energy > 0 else 0.0


def field_of(p: Floats, q: Floats, reach: int) -> Field:
    """The correlation of blocks of `q` (thermal) on `p` (RGB) for all displacements up to `reach`."""
    _, h, w = p.shape
    cells = max(h // _CELL, 1), max(w // _CELL, 1)
    h, w = cells[0] * _CELL, cells[1] * _CELL
    side = 2 * reach + 1
    p, q = p[:, :h, :w], q[:, :h, :w]
    padded = np.pad(p, ((0, 0), (reach, reach), (reach, reach)))
    energy_p = np.einsum("chw,chw->hw", padded, padded)
    energy_q = np.einsum("chw,chw->hw", q, q)
    base = _windowed(energy_q, cells)
    surface = np.empty((side, side, *cells), np.float32)
    for dy in range(side):
        for dx in range(side):
            moved = padded[:, dy : dy + h, dx : dx + w]
            dot = _windowed(np.einsum("chw,chw->hw", moved, q), cells)
            other = _windowed(energy_p[dy : dy + h, dx : dx + w], cells)
            surface[dy, dx] = dot / np.sqrt(base * other + 1e-6)
    fill = _windowed((energy_q > 0).astype(np.float32), cells)
    usable = fill >= _LEAST_FILL
    y, x = np.nonzero(usable)
    at = np.stack([(x + 0.5) * _CELL - 0.5, (y + 0.5) * _CELL - 0.5], axis=-1)
    return Field(at.astype(np.float64), np.ascontiguousarray(surface[:, :, usable].transpose(2, 0, 1)))


def _windowed(plane: Floats, cells: tuple[int, int]) -> Floats:
    small = cv2.resize(plane, (cells[1], cells[0]), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small, (0, 0), _WINDOW, borderType=cv2.BORDER_CONSTANT)


def peaks(field: Field, expected: Doubles, within: float) -> tuple[Doubles, Doubles]:
    """Of every block the displacement (N, 2) of best correlation near `expected` (N, 2), and its weight.

    The farther from what is expected, the less a peak counts: nothing at `within` pixels.
    """
    reach = field.reach
    steps = np.arange(-reach, reach + 1, dtype=np.float64)
    right = steps[None, None, :] - expected[:, 0, None, None]
    down = steps[None, :, None] - expected[:, 1, None, None]
    away = right**2 + down**2
    prior = np.maximum(1 - away / within**2, 0)
    flat = (np.maximum(field.surface, 0) * prior).reshape(len(field.at), len(steps) ** 2)
    best, rows = flat.argmax(axis=1), np.arange(len(flat))
    y, x = np.divmod(best, len(steps))
    inner = (x > 0) & (y > 0) & (x < 2 * reach) & (y < 2 * reach) & (flat[rows, best] > 0)
    yc, xc = np.clip(y, 1, 2 * reach - 1), np.clip(x, 1, 2 * reach - 1)
    s = field.surface
    at = s[rows, yc, xc]
    dx = _vertex(s[rows, yc, xc - 1], at, s[rows, yc, xc + 1])
    dy = _vertex(s[rows, yc - 1, xc], at, s[rows, yc + 1, xc])
    move = np.stack([xc - reach + dx, yc - reach + dy], axis=-1)
    return move, np.where(inner, np.maximum(at, 0).astype(np.float64) ** 2, 0)


def _vertex(before: Floats, at: Floats, after: Floats) -> Doubles:
    """Where the parabola through three neighbours has its top, within half a pixel."""
    bend = (before + after - 2 * at).astype(np.float64)
    slope = (before - after).astype(np.float64)
    return np.where(bend < -1e-9, np.clip(0.5 * slope / np.where(bend < -1e-9, bend, -1), -0.5, 0.5), 0)


def agree(fields: Sequence[Field], model: Model, widths: tuple[float, ...]) -> Doubles:
    """The map (3, 3), in grid pixels, by which most blocks of all fields move.

    Pass after pass peaks are looked for nearer to the map (`widths`, pixels) and it is refitted. The
    identity where fewer than `_LEAST_BLOCKS` can tell.
    """
    at = np.concatenate([field.at for field in fields])
    whole = Field(at, np.concatenate([field.surface for field in fields]))
    matrix = np.eye(3)
    for within in widths:
        move, weight = peaks(whole, project(matrix, at) - at, within)
        if np.count_nonzero(weight) < _LEAST_BLOCKS:
            break
        for _ in range(3):
            miss = np.linalg.norm(project(matrix, at) - at - move, axis=1)
            robust = weight / (1 + (miss / (0.3 * within)) ** 2) ** 2
            matrix = fit(at, at + move, robust, model)
    return matrix
