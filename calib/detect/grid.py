"""From loose saddle points to lattices of corners: seeds, growth, the smooth surface they lie on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from calib.detect.saddles import Image, Saddles, Surface, fit_corners, look_up
from fusion.geometry import Floats

Cell = tuple[int, int]
Cells = NDArray[np.intp]

_NEIGHBOURS = 12
_ALONG_RAD = np.radians(22)  # how far a neighbour may lie off the edge that leads to it
_SEED_GAP, _GROW_GAP = 0.3, 0.25  # how far off its predicted place a corner may be, of the spacing
_SIDES = ((1, 0), (0, 1), (-1, 0), (0, -1))
_LOW = 0.35
_GAP = 0.2
_LEAST = 8  # corners of a sheet
_SQUARES = np.array([(-1, -1), (1, -1), (-1, 1), (1, 1)])  # the four squares about a corner
_COLOUR = np.array([1, -1, -1, 1])
_INNER = {(1, 0): (1, 3), (0, 1): (2, 3), (-1, 0): (0, 2), (0, -1): (0, 1)}  # of these, those on one side


@dataclass(frozen=True, slots=True, eq=False)
class Lattice:
    """Corners with their places in a square lattice: `cells` (N, 2), `xy` (N, 2) px.

    The second axis lies clockwise of the first, as the image is seen: x right, y down, however turned.
    """

    cells: Cells
    xy: Floats

    def __len__(self) -> int:
        return len(self.cells)


def lattices(saddles: Saddles, least: int, tries: int = 40) -> Iterator[Lattice]:
    """Lattices of at least `least` corners that share none, from the best seeds on; at most `tries` grow."""
    if len(saddles) < least:
        return
    tree = KDTree(saddles.xy)
    used = np.zeros(len(saddles), bool)
    for seed in _seeds(saddles, tree):
        if used[list(seed.values())].any():
            continue
        if tries == 0:
            return
        tries -= 1
        grown = _grow(saddles, tree, seed, used)
        used[list(grown.values())] = True
        if len(grown) >= least:
            rows = np.array(list(grown.values()))
            yield Lattice(np.array(list(grown), np.intp), saddles.xy[rows])


def _seeds(saddles: Saddles, tree: KDTree) -> list[dict[Cell, int]]:
    """Squares of four saddles of alternating orientation; those with other squares about them first."""
    ahead = _ahead(saddles, tree)
    xy = saddles.xy
    quads: list[tuple[NDArray[np.intp], int]] = []
    count = np.zeros(len(saddles), np.intp)
    for side in range(4):
        right, down = ahead[:, side], ahead[:, (side + 1) % 4]
        start = np.flatnonzero((right >= 0) & (down >= 0))
        right, down = right[start], down[start]
        guess = xy[right] + xy[down] - xy[start]
        gap, far = tree.query(guess)
        size = np.minimum(np.hypot(*(xy[right] - xy[start]).T), np.hypot(*(xy[down] - xy[start]).T))
        same = np.cos(2 * (saddles.bright[far] - saddles.bright[start])) > 0.5
        good = (gap < _SEED_GAP * size) & same & (far != start)
        count[start[good]] += 1
        quads += [(row, side) for row in np.stack([start, right, down, far], 1)[good]]
    quads.sort(key=lambda quad: (-int(count[quad[0]].sum()), int(quad[0][0]), quad[1]))
    cells: list[Cell] = [(0, 0), (1, 0), (0, 1), (1, 1)]
    return [dict(zip(cells, (int(k) for k in row), strict=True)) for row, _ in quads]


def _ahead(saddles: Saddles, tree: KDTree) -> NDArray[np.intp]:
    """(N, 4): the nearest saddle of the other orientation along each of its four edges, or -1."""
    n = len(saddles)
    gap, near = (np.asarray(part)[:, 1:] for part in tree.query(saddles.xy, k=min(_NEIGHBOURS + 1, n)))
    way = saddles.xy[near] - saddles.xy[:, None]
    angle = np.arctan2(way[..., 1], way[..., 0])
    other = np.cos(2 * (saddles.bright[near] - saddles.bright[:, None])) < -0.5
    result = np.full((n, 4), -1, np.intp)
    for side, (sign, turn) in enumerate(((-1, 0), (1, 0), (-1, np.pi), (1, np.pi))):
        edge = saddles.bright + sign * saddles.half + turn
        off = np.abs(np.angle(np.exp(1j * (angle - edge[:, None]))))
        cost = np.where(other & (off < _ALONG_RAD), gap, np.inf)
        best = cost.argmin(1)
        found = np.isfinite(cost[np.arange(n), best])
        result[found, side] = near[found, best[found]]
    return result


def _grow(saddles: Saddles, tree: KDTree, seed: dict[Cell, int], used: NDArray[np.bool_]) -> dict[Cell, int]:
    """All cells that can be reached from a seed over saddles that are not `used`, ring by ring."""
    held = dict(seed)
    taken = set(held.values()) | set(np.flatnonzero(used).tolist())
    parity = np.exp(2j * saddles.bright[seed[0, 0]])
    edge = list(held)
    while edge:
        empty = sorted({(i + a, j + b) for i, j in edge for a, b in _SIDES} - held.keys())
        edge = []
        wanted = [(cell, *guess) for cell in empty if (guess := _predict(saddles.xy, held, cell))]
        if not wanted:
            break
        gaps, nearest = map(np.asarray, tree.query(np.array([place for _, place, _ in wanted])))
        for rank in np.argsort(gaps, kind="stable"):
            (cell, _, size), row = wanted[rank], int(nearest[rank])
            sign = 1 - 2 * (sum(cell) % 2)
            turned = sign * (np.exp(2j * saddles.bright[row]) * np.conj(parity)).real
            if gaps[rank] < _GROW_GAP * size and turned > 0.3 and row not in taken:
                held[cell] = row
                taken.add(row)
                edge.append(cell)
    return held


def _predict(xy: Floats, held: dict[Cell, int], cell: Cell) -> tuple[Floats, float] | None:
    """Where a cell's corner should be, from the corners about it, and how long the sides are there."""
    i, j = cell
    guesses: list[Floats] = []
    sizes: list[float] = []
    for a, b in _SIDES:
        one = held.get((i + a, j + b))
        if one is None:
            continue
        two = held.get((i + 2 * a, j + 2 * b))
        if two is not None:
            guesses.append(2 * xy[one] - xy[two])
            sizes.append(float(np.hypot(*(xy[one] - xy[two]))))
        for c, d in ((-b, a), (b, -a)):
            beside, corner = held.get((i + c, j + d)), held.get((i + a + c, j + b + d))
            if beside is not None and corner is not None:
                guesses.append(xy[one] + xy[beside] - xy[corner])
                sizes.append(float(np.hypot(*(xy[beside] - xy[corner]))))
    return (np.mean(guesses, 0), min(sizes)) if guesses else None


class Sheet:
    """A lattice held against the image: corners on a smooth surface, whose squares alternate."""

    def __init__(self, lattice: Lattice, surface: Surface, image: Image) -> None:
        """`surface` is of the normalised image. Raises `ValueError` where too few corners remain."""
        self._surface, self._image = surface, image
        self._plain = np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.float32)
        self.cells, self.xy = lattice.cells, lattice.xy
        self._polarity, self._known = 1.0, False
        self.smooth = Smooth(self.cells, self.xy)
        self.xy, self._height = self._fit(self.cells, self.xy)
        self._contrast = np.ones(len(self))
        self._keep(np.isfinite(self._height))
        self._settle()

    def __len__(self) -> int:
        return len(self.cells)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the image."""
        h, w = self._surface.value.shape
        return h, w

    def extend(self, rounds: int, most: int, cells: Cells | None = None) -> None:
        """Look for corners that are missing inside and next to the sheet, until there are no more or `most`.

        With `cells` (M, 2) those are looked for and no others kept. Raises `ValueError` where too few remain.
        """
        if cells is not None:
            self._known = True
            self._keep(_within(self.cells, cells))
            self._settle()
        for _ in range(rounds):
            wanted = self.beside(within=True) if cells is None else cells[~_within(cells, self.cells)]
            before = len(self)
            if not len(wanted) or before > most or not self._look(wanted):
                return
            self._settle()
            if len(self) <= before:
                return

    def beside(self, within: bool) -> Cells:
        """Empty cells next to the sheet's corners; `within` also those inside its bounding box."""
        held = {(int(i), int(j)) for i, j in self.cells}
        cells = sorted({(i + a, j + b) for i, j in held for a, b in _SIDES} - held)
        low, high = self.cells.min(0), self.cells.max(0)
        result = np.array(cells, np.intp).reshape(-1, 2)
        outside = ((result < low) | (result > high)).any(1)
        return result if within else result[outside]

    def spacing(self, cells: Cells | Floats) -> Floats:
        """(N,) px: the shorter side of the squares at cells."""
        return np.minimum(*(np.hypot(*self._side(cells, axis).T) for axis in (0, 1)))

    def along(self, cells: Cells | Floats) -> Floats:
        """(N, 2) rad: the directions of the lattice's two axes at cells."""
        sides = [self._side(cells, axis) for axis in (0, 1)]
        return np.stack([np.arctan2(side[:, 1], side[:, 0]) for side in sides], 1)

    def ends(self, strict: bool = True) -> Cells:
        """Cells beyond the bounding box where squares are seen to end; not `strict`: where they may.

        The two squares before such a cell alternate, the two beyond are as one of these; a hand over the
        board, shade or the frame's edge seldom look so.
        """
        cells = self.beside(within=False)
        return cells[self._ended(cells, *((1.0, 0.35) if strict else (0.6, 0.7)))]

    def _ended(self, cells: Cells, least: float, most: float) -> NDArray[np.bool_]:
        """Where squares end: by at least so much of a step before, and at most so much of that is beyond."""
        value = self._squares(cells, of=self._plain) / self._typical(cells, np.abs(self._height))[:, None]
        ended = np.zeros(len(cells), bool)
        for side, (a, b) in _INNER.items():
            c, d = sorted({0, 1, 2, 3} - {a, b})
            step = (value[:, a] - value[:, b]) * _COLOUR[a]
            rim, middle = (value[:, c] + value[:, d]) / 2, (value[:, a] + value[:, b]) / 2
            off = np.maximum(np.abs(value[:, c] - value[:, d]), np.abs(np.abs(rim - middle) - step / 2))
            ended |= (step > least) & (off < most * step) & _within(cells + side, self.cells)
        return ended & self._in_frame(cells)

    def _settle(self) -> None:
        """Fit the surface, and let go of corners that lie off it or whose squares do not alternate."""
        for _ in range(4):
            if len(self) < _LEAST:
                raise ValueError(f"expected at least {_LEAST} corners, got {len(self)}")
            self.smooth = Smooth(self.cells, self.xy)
            self._polarity = 1.0
            square = self._squares(self.cells)
            self._polarity = float(np.sign(np.median((square * _COLOUR).mean(1))) or 1.0)
            square = square * self._polarity
            self._contrast = (square * _COLOUR).mean(1)
            keep = self.smooth.inlier & (
                self._alike(self.cells, self._height) if self._known else self._alternate(self.cells, square)
            )
            if keep.all():
                return
            self._keep(keep)

    def _keep(self, rows: NDArray[np.bool_]) -> None:
        self.cells, self.xy = self.cells[rows], self.xy[rows]
        self._contrast, self._height = self._contrast[rows], self._height[rows]

    def _look(self, cells: Cells) -> bool:
        """Take in the corners of cells that are there; whether there was any."""
        place, size = self.smooth(cells), self.spacing(cells)
        start, good = place, np.ones(len(cells), bool)
        if not self._known:
            found, good = self._surface.saddles_from(place, 0.25 * size)
            start = found.xy
        xy, height = self._fit(cells, start)
        good &= np.hypot(*(xy - place).T) < np.maximum(4 * self.smooth.sigma_px, 0.1 * size)
        good &= self._alike(cells, height)
        if self._known:
            good &= ~self._ended(cells, 1.0, 0.35)
        else:
            good &= self._alternate(cells, self._squares(cells, start - place))
        self.cells, self.xy = np.vstack([self.cells, cells[good]]), np.vstack([self.xy, xy[good]])
        self._height = np.append(self._height, height[good])
        return bool(good.any())

    def _fit(self, cells: Cells, xy: Floats) -> tuple[Floats, Floats]:
        return fit_corners(self._image, xy, self.along(cells), np.clip(0.4 * self.spacing(cells), 2.5, 5.0))

    def _alike(self, cells: Cells, height: Floats) -> NDArray[np.bool_]:
        """Whether steps are of their neighbours' sign and about as high."""
        sign = 1 - 2 * (cells.sum(1) % 2)
        own = height * sign
        typical = self._typical(cells, self._height * (1 - 2 * (self.cells.sum(1) % 2)))
        return (own / typical > _LOW) & (own / typical < 3)

    def _alternate(self, cells: Cells, square: Floats) -> NDArray[np.bool_]:
        """Whether the squares about cells are bright and dark in turn, as much as about their neighbours."""
        typical = self._typical(cells, self._contrast)
        apart = np.minimum(square[:, 0], square[:, 3]) - np.maximum(square[:, 1], square[:, 2])
        return (apart > _GAP * typical) & ((square * _COLOUR).mean(1) > 0.3 * typical)

    def _squares(self, cells: Cells, shift: Floats | None = None, of: Image | None = None) -> Floats:
        """(N, 4): brightness of the squares about cells, signed so that all should look like _COLOUR."""
        part = np.minimum(0.3, 8 / np.maximum(self.spacing(cells), 1))[:, None, None]
        at = self.smooth((cells[:, None] + part * _SQUARES).reshape(-1, 2)).reshape(-1, 4, 2)
        value = look_up(
            self._surface.value if of is None else of, at if shift is None else at + shift[:, None]
        )
        sign = (1 - 2 * (cells.sum(1) % 2)) * self._polarity
        return value * sign[:, None]

    def _typical(self, cells: Cells, of: Floats) -> Floats:
        """The median `of` the corners about cells."""
        _, near = KDTree(self.cells[: len(of)]).query(cells, k=min(7, len(of)))
        return np.median(of[near], 1)

    def _side(self, cells: Cells | Floats, axis: int) -> Floats:
        half = np.eye(2)[axis] / 2
        return self.smooth(cells + half) - self.smooth(cells - half)

    def _in_frame(self, cells: Cells) -> NDArray[np.bool_]:
        h, w = self.shape
        place, margin = self.smooth(cells), 0.35 * self.spacing(cells)[:, None]
        inside: NDArray[np.bool_] = np.asarray((place > margin) & (place < (w, h) - margin))
        return inside[:, 0] & inside[:, 1]


def _within(cells: Cells, others: Cells) -> NDArray[np.bool_]:
    """Which of `cells` are among `others`."""
    one, two = cells.astype(np.int64) @ (1 << 20, 1), others.astype(np.int64) @ (1 << 20, 1)
    return np.asarray(np.isin(one, two), np.bool_)


class Smooth:
    """A homography and a polynomial on top, from cells to pixels: a flat board through a real lens."""

    def __init__(self, cells: NDArray[np.intp] | Floats, xy: Floats) -> None:
        cells = np.asarray(cells, np.float64)
        self._middle, self._scale = xy.mean(0), float(np.abs(xy - xy.mean(0)).max())
        self.order = 3 if len(xy) >= 40 else 2 if len(xy) >= 20 else 0
        self.inlier = np.ones(len(xy), bool)
        for k in range(4):
            self._fit(cells[self.inlier], xy[self.inlier], robust=k == 0)
            off = np.hypot(*(self(cells) - xy).T)
            self.sigma_px = (
                1.4826 * float(np.median(off)) / 1.1774
            )  # the median of a circular error is 1.18 sigma
            inlier = off <= max(5 * self.sigma_px, 0.3)
            if (inlier == self.inlier).all() or inlier.sum() < 8:
                break
            self.inlier = inlier

    def _fit(self, cells: Floats, xy: Floats, robust: bool) -> None:
        flat = (xy - self._middle) / self._scale
        found, _ = cv2.findHomography(cells, flat, cv2.LMEDS if robust and len(cells) > 12 else 0)
        self._homography = np.eye(3) if found is None else np.asarray(found, np.float64)
        base = self._flat(cells)
        terms = _terms(base, self.order)
        ridge = 1e-4 * np.eye(terms.shape[1])  # holds the polynomial where the lattice is narrow
        lhs = np.vstack([terms / np.sqrt(len(cells)), ridge])
        rhs = np.vstack([(flat - base) / np.sqrt(len(cells)), np.zeros((terms.shape[1], 2))])
        self._bend = np.linalg.lstsq(lhs, rhs, rcond=None)[0]

    def _flat(self, cells: Floats) -> Floats:
        projected = np.c_[cells, np.ones(len(cells))] @ self._homography.T
        return projected[:, :2] / projected[:, 2:]

    def __call__(self, cells: NDArray[np.intp] | Floats) -> Floats:
        """(N, 2) pixels of (N, 2) cells."""
        base = self._flat(np.asarray(cells, np.float64))
        return (base + _terms(base, self.order) @ self._bend) * self._scale + self._middle


def _terms(flat: Floats, order: int) -> Floats:
    x, y = flat.T
    return np.stack([x**a * y**b for a in range(order + 1) for b in range(order + 1 - a)], 1)
