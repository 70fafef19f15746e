"""Circle grids, symmetric and asymmetric: circles darker or brighter than the plate, printed, warm or cold.

Spots are found as blobs over all sizes, which no glow hides; a lattice grows from them by local prediction;
the board is laid over the lattice where it fits in one way only; then each circle is fitted through the
homography as the perspective picture of a disc, so that its centre is the circle's and not the ellipse's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.boards import Board
from calib.detect.blobs import Blobs, Discs, find_blobs, fit_discs
from calib.detect.dots import Placed, cells_beside, cells_m, lattices, place
from calib.detect.known import Known, mapped
from calib.detect.saddles import Image
from calib.detect.trace import SILENT, Trace
from calib.observations import Detection, Refusal
from fusion.geometry import Floats

_LEAST_SHARE = 0.6  # of the points inside the image that must be there
_LEAST_POINTS = 8
_CLEAR = 2  # by how many points the best way to lay the board must win
_RINGS = 8
_ROUGH, _FINE = 6, 11  # samples across a circle's window, on either side
_GRIDS = 4  # that are tried
_METRICS = 2  # of each
_SAMPLE = 12  # spots by which a metric is chosen
_LARGEST = 1.6  # times the board's points: spots of a lattice
_ARE_CIRCLES = 0.5  # share of a lattice's spots that must be circles
_ON_BOARD = 0.95  # share of its circles that the board must have
_EXPLAINED, _EXPLAINED_OF_MEDIAN = 0.35, 0.7  # share of a window's variance that a circle must explain
_CONTRAST = 0.3  # least contrast, of the median
_WINDOW = 1.8  # radii
_ADRIFT = 0.12  # how far a centre may lie off its neighbours' prediction, of the distance of circles


_Why = tuple[int, str]  # how far a search came, and the reason for a refusal


def find_circles(gray: NDArray[Any], board: Board, trace: Trace = SILENT) -> Detection | Refusal:
    """Find a grid of circles in H x W uint8 or uint16; of `board` its visible points.

    A board that the frame cuts is found as long as only one way to label it explains which circles are
    there. Labels are right up to the board's symmetries.
    """
    image = gray.astype(np.float32)
    both = find_blobs(image)
    visible = int(board.visible.sum())
    least = max(min(_LEAST_POINTS, visible), int(0.4 * visible))
    grids: list[tuple[NDArray[np.intp], Blobs, bool]] = []
    for dark, blobs in zip((True, False), both, strict=True):
        trace.add(f"{_name(dark)} spots", gray, blobs.xy)
        grids += [(cells, blobs[rows], dark) for cells, rows in lattices(blobs, least)]
    grids.sort(key=lambda grid: -len(grid[0]))
    why: _Why = -1, f"no grid of circles among {len(both[0])} dark and {len(both[1])} bright spots"
    for cells, spots, dark in grids[:_GRIDS]:
        trace.add(f"grid of {len(cells)} {_name(dark)} spots", gray, spots.xy)
        found = _on_lattice(image, cells, spots, board, dark)
        if isinstance(found, Detection):
            return found
        trace.add(found[1], gray)
        why = max(why, found, key=lambda one: one[0])  # the first that came farthest
    return Refusal(why[1])


def _name(dark: bool) -> str:
    return "dark" if dark else "bright"


def _on_lattice(
    image: Image, cells: NDArray[np.intp], spots: Blobs, board: Board, dark: bool
) -> Detection | _Why:
    size_wh, rim_px = (image.shape[1], image.shape[0]), float(np.median(spots.radius))
    few = min(_LEAST_POINTS, int(board.visible.sum()))
    spotted = f"a grid of {len(cells)} {_name(dark)} spots"
    if len(cells) > _LARGEST * board.visible.sum():
        return 0, f"{spotted}, more than the board has"
    placed = place(cells, spots.xy, board, size_wh, rim_px)
    if not placed or placed[0].hits < few:
        return 0, f"{spotted} that does not fit the board"
    circles = _circles(image, board, placed, spots, dark)
    if len(circles.cells) < max(_ARE_CIRCLES * len(cells), few):
        return 0, f"{spotted} that are no circles"
    circles.extend()
    placed = place(circles.cells, circles.discs.uv, board, size_wh, rim_px)
    count = len(circles.cells)
    if not placed:
        return count, f"{spotted} that does not fit the board"
    best = placed[0]
    fit = f"a grid of {count} {_name(dark)} circles, of which {best.hits} fit the board"
    needed = max(_LEAST_SHARE * (best.hits + best.misses), _ON_BOARD * count, few)
    rank = 2 * best.hits - count
    if best.hits < needed:
        return rank, fit
    if not _is_clear(placed, board):
        return rank, f"{fit}, but in more ways than one: is it cut?"
    there = best.ids >= 0
    known = Known.of(board.points_m[best.ids[there], :2], circles.discs.uv[there], robust=True)
    if known is None:
        return rank, f"{fit}, which no plane explains"
    return _fitted(image, board, known, circles.radius, dark)


def _circles(image: Image, board: Board, placed: list[Placed], spots: Blobs, dark: bool) -> _Circles:
    """The circles among the spots, by the best of the lattice's metrics: a sheared one makes no circles."""
    first = {one.metric: one for one in reversed(placed)}
    ranked = sorted(first.values(), key=lambda one: one.misses - one.hits)[:_METRICS]
    few = np.linspace(0, len(spots) - 1, min(_SAMPLE, len(spots))).round().astype(np.intp)
    tried = [(len(_Circles(image, board, one.cells, spots, dark, few).cells), one.cells) for one in ranked]
    count, cells = max(tried, key=lambda pair: pair[0])
    part = slice(None) if count >= _ARE_CIRCLES * len(few) else few
    return _Circles(image, board, cells, spots, dark, part)


class _Circles:
    """The circles of a lattice: those spots that are some, and what lies beside them and was no spot.

    (A circle near the plate's edge is none where the plate stands out more than the circle.)
    """

    def __init__(
        self,
        image: Image,
        board: Board,
        cells: NDArray[np.intp],
        spots: Blobs,
        dark: bool,
        part: NDArray[np.intp] | slice,
    ) -> None:
        """Of a lattice, or `part` of it."""
        self._image, self._board, self._dark = image, board, dark
        self.cells, self.discs, self.radius = cells[:0], Discs.none(), 0.0
        known = Known.of(cells_m(cells, board), spots.xy, robust=True)
        if known is not None:
            self.radius = _radius(board, known, spots)
            self._add(known, cells[part])

    def extend(self) -> None:
        """Look for circles beside those that are there, until there are no more."""
        for _ in range(_RINGS):
            known = Known.of(cells_m(self.cells, self._board), self.discs.uv, robust=False)
            size = len(self.cells)
            if known is None:
                return
            self._add(known, cells_beside(self.cells))
            if len(self.cells) <= size or len(self.cells) > 2 * len(self._board.points_m):
                return

    def _add(self, known: Known, cells: NDArray[np.intp]) -> None:
        """Fit circles at cells, and keep what is one in the company of the others."""
        cells = cells[_inside(cells_m(cells, self._board), known, self.radius, self._image.shape)]
        new = _discs(self._image, self._board, known, cells_m(cells, self._board), self.radius, _ROUGH)
        cells, discs = np.concatenate([self.cells, cells]), self.discs.and_(new)
        good = _is_good(discs, cells_m(cells, self._board), self._board, self._dark)
        self.cells, self.discs = cells[good], discs[good]
        if good.any():
            self.radius = float(np.median(self.discs.radius))


def _is_clear(placed: list[Placed], board: Board) -> bool:
    """Whether every other labelling that is nearly as good is the same up to a symmetry of the board."""
    best = placed[0]
    score = best.hits - best.misses
    for other in placed[1:]:
        if other.hits - other.misses <= score - _CLEAR:
            return True
        both = (best.ids >= 0) & (other.ids >= 0)
        if not any(np.array_equal(turn[best.ids[both]], other.ids[both]) for turn in board.symmetries()):
            return False
    return True


def _fitted(image: Image, board: Board, known: Known, radius: float, dark: bool) -> Detection | _Why:
    """Fit circles wherever the board has them inside the image, and again from what was found."""
    points, visible = board.points_m[:, :2], np.flatnonzero(board.visible)
    few = min(_LEAST_POINTS, len(visible))
    for last in (False, True):
        inside = visible[_inside(points[visible], known, radius, image.shape)]
        discs = _discs(image, board, known, points[inside], radius, _FINE)
        good = _is_good(discs, points[inside], board, dark)
        ids, uv = inside[good], discs.uv[good]
        if len(ids) < max(_LEAST_SHARE * len(inside), few):
            return len(ids), f"a board of which {len(ids)} of {len(inside)} points are {_name(dark)} circles"
        if last:
            return Detection(ids, uv, "circles", (f"{_name(dark)} circles",))
        refined = Known.of(points[ids], uv, robust=False)
        if refined is None:
            break
        known, radius = refined, float(np.median(discs.radius[good]))
    return len(visible), "a grid of circles that no plane explains"


def _discs(image: Image, board: Board, known: Known, xy: Floats, radius: float, samples: int) -> Discs:
    """Circles fitted about places of the board, in windows that hold no other."""
    return fit_discs(image, known, xy, radius, min(_WINDOW * radius, _distance(board) - radius), samples)


def _distance(board: Board) -> float:
    """From a circle to the nearest other one, m."""
    return board.spacing_m * (2**0.5 if board.kind == "asymmetric-circles" else 1.0)


def _radius(board: Board, known: Known, spots: Blobs) -> float:
    """The circles' radius on the board, from the spots' in the image."""
    at = known.xy.mean(0, keepdims=True)
    step = 0.01 * board.spacing_m
    sides = [(mapped(known.H, at + step * axis) - mapped(known.H, at))[0] / step for axis in np.eye(2)]
    area = abs(sides[0][0] * sides[1][1] - sides[0][1] * sides[1][0])
    most = board.spacing_m * (0.65 if board.kind == "asymmetric-circles" else 0.45)
    return float(np.clip(np.median(spots.radius) / np.sqrt(area), 0.05 * board.spacing_m, most))


def _inside(xy: Floats, known: Known, radius: float, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Whether whole circles about places of the board lie inside the image."""
    rim = radius * np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
    uv = mapped(known.H, (xy[:, None] + rim).reshape(-1, 2)).reshape(len(xy), 4, 2)
    h, w = shape[:2]
    return np.asarray(((uv >= 0) & (uv <= (w - 1, h - 1))).all((1, 2)), np.bool_)


def _is_good(discs: Discs, xy: Floats, board: Board, dark: bool) -> NDArray[np.bool_]:
    """Circles of the right polarity, contrast and size, where their neighbours have them."""
    contrast = discs.contrast * (-1 if dark else 1)
    good = (contrast > 0) & (discs.explained > _EXPLAINED)
    if not good.any():
        return good
    radius = float(np.median(discs.radius[good]))
    good &= contrast > _CONTRAST * np.median(contrast[good])
    good &= discs.explained > _EXPLAINED_OF_MEDIAN * np.median(discs.explained[good])
    good &= np.abs(np.log(discs.radius / radius)) < np.log(1.4)
    if good.sum() < 6:
        return good
    sure = Known.of(xy[good], discs.uv[good], robust=True)
    if sure is None:
        return np.zeros(len(xy), bool)
    guess, gap = sure.predict(xy)
    itself, _ = sure.predict(xy, without_itself=True)
    guess = np.where((gap < 1e-9)[:, None], itself, guess)
    distance = _distance(board)
    side = 0.01 * distance
    scale = np.minimum(
        *(np.hypot(*(mapped(sure.H, xy + side * a) - mapped(sure.H, xy)).T) for a in np.eye(2))
    )
    near = np.hypot(*(discs.uv - guess).T) < np.maximum(_ADRIFT * distance * scale / side, 1.0)
    good[~near] = False
    return good
