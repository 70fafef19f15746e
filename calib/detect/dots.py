"""From loose spots to a lattice, and from a lattice to the board's ids."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from calib.boards import Board
from calib.detect.blobs import Blobs
from calib.detect.known import Known, mapped
from fusion.geometry import Floats

Cell = tuple[int, int]
Cells = NDArray[np.intp]

_NEIGHBOURS = 8
_CROWD = 8  # spots that may be nearer than the one that is meant
_GAP = 0.27  # how far off its predicted place a spot may be, of the shorter side
_ALIKE_RADIUS, _ALIKE_STRENGTH = 1.7, 3.0
_SPACING = 1.7, 9.0  # least and largest distance of neighbours, in radii
_AROUND = np.array([(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)])
_LEAST_AROUND = 5
_TRIES = 30
_PLACEMENTS = 150  # that are looked at: more than that tie only where nothing is clear
_SIDES = ((1, 0), (0, 1), (-1, 0), (0, -1))
# Bases of one lattice that keep its handedness: the one that growth began with may be sheared, or turned.
_BASES = [
    np.array([(a, b), (c, d)]) for a, b, c, d in product((-2, -1, 0, 1, 2), repeat=4) if a * d - b * c == 1
]


def lattices(blobs: Blobs, least: int) -> Iterator[tuple[Cells, NDArray[np.intp]]]:
    """Cells (N, 2) and rows of `blobs`, for lattices of at least `least` spots, from the best seed on.

    No spot of a lattice is the seed of another, but it may belong to another.
    """
    if len(blobs) < least:
        return
    tree = cKDTree(blobs.xy)
    used = np.zeros(len(blobs), bool)
    tries = 0
    for row, a, b in _seeds(blobs, tree):
        if used[row]:
            continue
        tries += 1
        if tries > _TRIES:
            return
        held = _grow(blobs, tree, row, a, b)
        if len(held) >= least:
            used[list(held.values())] = True
            yield np.array(list(held), np.intp), np.array(list(held.values()), np.intp)


def _alike(blobs: Blobs, one: NDArray[np.intp], two: NDArray[np.intp]) -> NDArray[np.bool_]:
    radius = np.abs(np.log(blobs.radius[one] / blobs.radius[two])) < np.log(_ALIKE_RADIUS)
    return radius & (np.abs(np.log(blobs.strength[one] / blobs.strength[two])) < np.log(_ALIKE_STRENGTH))


def _seeds(blobs: Blobs, tree: cKDTree) -> list[tuple[int, Floats, Floats]]:
    """Spots with two sides of a lattice cell, those first that have the most of its eight neighbours."""
    n, xy = len(blobs), blobs.xy
    near = tree.query(xy, k=min(3 * _NEIGHBOURS + 1, n))[1][:, 1:]
    rows: list[NDArray[np.intp]] = []
    ones, twos = np.triu_indices(_NEIGHBOURS, 1)
    for row in range(n):
        others = near[row][_alike(blobs, np.full(near.shape[1], row), near[row])]
        length = np.linalg.norm(xy[others] - xy[row], axis=1) / blobs.radius[row]
        others = others[(length > _SPACING[0]) & (length < _SPACING[1])][:_NEIGHBOURS]
        good = twos < len(others)
        rows.append(np.stack([np.full(good.sum(), row), others[ones[good]], others[twos[good]]], 1))
    triple = np.concatenate(rows)
    a, b = xy[triple[:, 1]] - xy[triple[:, 0]], xy[triple[:, 2]] - xy[triple[:, 0]]
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    la, lb = np.hypot(*a.T), np.hypot(*b.T)
    good = (np.abs(cross) > 0.5 * la * lb) & (np.maximum(la, lb) < 2.5 * np.minimum(la, lb))
    triple, a, b, swap = triple[good], a[good], b[good], (cross < 0)[good]
    a, b = np.where(swap[:, None], b, a), np.where(swap[:, None], a, b)  # the second clockwise of the first
    return _ranked(blobs, tree, triple[:, 0], a, b)


def _ranked(
    blobs: Blobs, tree: cKDTree, row: NDArray[np.intp], a: Floats, b: Floats
) -> list[tuple[int, Floats, Floats]]:
    if not len(row):
        return []
    side = np.minimum(np.hypot(*a.T), np.hypot(*b.T))
    guess = blobs.xy[row][:, None] + _AROUND[:, :1] * a[:, None] + _AROUND[:, 1:] * b[:, None]
    gap = _gap_to_alike(blobs, tree, row, guess)
    good = gap < _GAP * side[:, None]
    count = np.where(_is_primitive(blobs, tree, row, a, b), good.sum(1), 0)
    loose = np.where(good, gap, 0).sum(1) / np.maximum(count, 1) / side
    order = np.lexsort((row, loose.round(6), -count))
    return [(int(row[k]), a[k], b[k]) for k in order if count[k] >= _LEAST_AROUND]


def _is_primitive(
    blobs: Blobs, tree: cKDTree, row: NDArray[np.intp], a: Floats, b: Floats
) -> NDArray[np.bool_]:
    """Whether no spot like the corners lies half way between them: else the cell is of every other spot."""
    half = np.array([(0.5, 0), (0, 0.5), (0.5, 0.5), (0.5, -0.5)])
    guess = blobs.xy[row][:, None] + half[:, :1] * a[:, None] + half[:, 1:] * b[:, None]
    side = np.minimum(np.hypot(*a.T), np.hypot(*b.T))
    return ~(_gap_to_alike(blobs, tree, row, guess) < 0.5 * _GAP * side[:, None]).any(1)


def _gap_to_alike(blobs: Blobs, tree: cKDTree, row: NDArray[np.intp], guess: Floats) -> Floats:
    """(N, K): from places (N, K, 2) to the nearest spot like that of the row, among the nearest few."""
    gap, there = tree.query(guess, k=min(_CROWD, len(blobs)))
    like = np.broadcast_to(row[:, None, None], there.shape)
    return np.asarray(np.where(_alike(blobs, like, there), gap, np.inf).min(2), np.float64)


def _grow(blobs: Blobs, tree: cKDTree, row: int, a: Floats, b: Floats) -> dict[Cell, int]:
    """Cells that can be reached from a spot, ring by ring, each predicted from those about it."""
    held: dict[Cell, int] = {(0, 0): row}
    taken = {row}
    edge = [(0, 0)]
    while edge:
        empty = sorted({(i + di, j + dj) for i, j in edge for di, dj in _SIDES} - held.keys())
        edge = []
        for cell in empty:
            guess, side, beside = _predict(blobs.xy, held, cell, a, b)
            nearest = _nearest(blobs, tree, guess, _GAP * side, beside, taken)
            if nearest is not None:
                held[cell] = nearest
                taken.add(nearest)
                edge.append(cell)
    return held


def _nearest(
    blobs: Blobs, tree: cKDTree, guess: Floats, gap: float, like: int, taken: set[int]
) -> int | None:
    """The spot nearest to a place that is like another one, within a gap."""
    gaps, rows = tree.query(guess, k=min(_CROWD, len(blobs)), distance_upper_bound=gap)
    rows = rows[np.isfinite(gaps)].astype(np.intp)
    same = rows[_alike(blobs, np.full(len(rows), like), rows)]
    return next((int(row) for row in same if int(row) not in taken), None)


def _predict(
    xy: Floats, held: dict[Cell, int], cell: Cell, a: Floats, b: Floats
) -> tuple[Floats, float, int]:
    """Where a cell's spot should be, the shorter side of cells there, and a spot beside it."""
    i, j = cell
    sure: list[Floats] = []
    rough: list[Floats] = []
    beside = -1
    for di, dj in _SIDES:
        one = held.get((i + di, j + dj))
        if one is None:
            continue
        beside = one
        two = held.get((i + 2 * di, j + 2 * dj))
        if two is not None:
            sure.append(2 * xy[one] - xy[two])
        for ci, cj in ((-dj, di), (dj, -di)):
            side, corner = held.get((i + ci, j + cj)), held.get((i + di + ci, j + dj + cj))
            if side is not None and corner is not None:
                sure.append(xy[one] + xy[side] - xy[corner])
        rough.append(xy[one] - di * a - dj * b)
    guess = np.mean(sure or rough, 0)
    step = float(np.hypot(*(guess - xy[beside])))
    return guess, min(step, 1.5 * float(min(np.hypot(*a), np.hypot(*b)))), beside


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A lattice laid on the board: `cells` (N, 2) as the board counts them, `ids` (N,), -1 for cells beside
    it; how many points it hits, and how many it misses inside the image. Placements of one `metric` differ by
    a turn and a shift."""

    metric: tuple[int, ...]
    cells: Cells
    ids: Cells
    hits: int
    misses: int


def board_cells(board: Board) -> Cells:
    """(N, 2): the points' cells in their lattice; an asymmetric grid's runs along its diagonals."""
    grid = np.round(board.points_m[:, :2] / board.spacing_m).astype(np.intp)
    if board.kind == "asymmetric-circles":
        x, y = grid.T
        return np.stack([(x + y) // 2, (y - x) // 2], 1)
    return grid


def cells_m(cells: Cells, board: Board) -> Floats:
    """(N, 2): where cells are in the board's frame, on it or beside it."""
    if board.kind == "asymmetric-circles":
        a, b = cells.T
        return np.stack([a - b, a + b], 1) * board.spacing_m
    return np.asarray(cells * board.spacing_m, np.float64)


def cells_beside(cells: Cells) -> Cells:
    """(M, 2): empty cells next to those, or at their corners."""
    held = {(int(i), int(j)) for i, j in cells}
    return np.array(
        sorted({(i + di, j + dj) for i, j in held for di, dj in _AROUND.tolist()} - held), np.intp
    )


def place(cells: Cells, uv: Floats, board: Board, size_wh: tuple[int, int], rim_px: float) -> list[Placed]:
    """Ways to lay the board over a lattice, by hits less misses: every basis and offset is tried."""
    pattern = board_cells(board)
    counted = [_Offsets.of(cells, basis, pattern[board.visible]) for basis in _BASES]
    counts = np.sort(np.concatenate([one.count for one in counted]))
    enough = max(0.8 * counts[-1], 4, counts[-min(_PLACEMENTS, len(counts))])
    placed: list[Placed] = []
    for one in counted:
        offsets = one.at_least(enough)
        known = Known.of(one.cells.astype(np.float64), uv, robust=False) if len(offsets) else None
        if known is not None:
            held = (pattern, board.visible, known, size_wh, rim_px)
            placed += [_held_against(one, offset, *held) for offset in offsets]
    return sorted(placed, key=lambda one: one.misses - one.hits)


@dataclass(frozen=True, slots=True, eq=False)
class _Offsets:
    """How many of the pattern's points meet a cell, for every offset between the two."""

    metric: tuple[int, ...]
    cells: Cells
    low: Cells
    span: Cells
    count: Cells

    @classmethod
    def of(cls, cells: Cells, basis: Cells, pattern: Cells) -> _Offsets:
        cells = cells @ basis.T
        low = cells.min(0) - pattern.max(0)
        span = cells.max(0) - pattern.min(0) - low + 1
        shift = (cells[:, None] - pattern[None]).reshape(-1, 2) - low
        return cls(
            tuple((basis.T @ basis).ravel().tolist()),
            cells,
            low,
            span,
            np.bincount(shift[:, 0] * span[1] + shift[:, 1]),
        )

    def at_least(self, count: float) -> Cells:
        """Offsets (K, 2) that meet that many."""
        k = np.flatnonzero(self.count >= count)
        return np.stack([k // self.span[1], k % self.span[1]], 1) + self.low


def _held_against(
    one: _Offsets,
    offset: Cells,
    pattern: Cells,
    visible: NDArray[np.bool_],
    known: Known,
    size_wh: tuple[int, int],
    rim_px: float,
) -> Placed:
    at = {(int(i), int(j)): k for k, (i, j) in enumerate(pattern + offset)}
    ids = np.array([at.get((int(i), int(j)), -1) for i, j in one.cells], np.intp)
    ids[(ids >= 0) & ~visible[ids]] = -1
    missing = visible.copy()
    missing[ids[ids >= 0]] = False
    uv = mapped(known.H, (pattern[missing] + offset).astype(np.float64))
    w, h = size_wh
    inside = ((uv > rim_px) & (uv < (w - 1 - rim_px, h - 1 - rim_px))).all(1)
    return Placed(one.metric, one.cells - offset, ids, int((ids >= 0).sum()), int(inside.sum()))
