"""Chessboards by saddle points: heated or painted, of either polarity, with hidden parts, cut by the frame.

The image is normalised locally, its saddle points are grown to lattices, and a lattice is laid upon the
board's pattern. How far a lattice reaches is not taken on trust: a corner that is missing may be covered,
washed out or beyond the frame. What counts is corners that are there, and where squares are seen to end.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.signal import correlate2d

from calib.boards import Board
from calib.detect.grid import Cells, Sheet, Smooth, lattices
from calib.detect.saddles import Surface, find_saddles, fit_corners, normalised
from calib.detect.trace import SILENT, Trace
from calib.observations import Detection, Ids, Refusal
from fusion.geometry import Floats

_LONG_SIDE_PX = 960  # the search begins in an image at most this long
_LEAST_CORNERS, _MOST_LATTICES = 8, 8
_SHARE_DONE = 0.9  # of the corners in the frame: then no other scale is tried
# So many of the visible corners must be there: in the frame; in the frame where lines are missing; of all.
_SHARE_IN_FRAME, _SHARE_CUT, _SHARE = 0.6, 0.75, 0.3


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """A labelled lattice at one scale.

    `along` are the edges' directions (rad), `spacing_px` the squares' sides; `share` of the corners that
    should be in the frame are there.
    """

    ids: Ids
    xy: Floats
    along: Floats
    spacing_px: Floats
    share: float


def find_chessboard(gray: NDArray[Any], board: Board, trace: Trace = SILENT) -> Detection | Refusal:
    """A chessboard's inner corners in `gray` (H x W uint8 or uint16).

    Labels are right up to `board.symmetries()`; of these the one is taken whose rows run most to the right.
    Points that `board.visible` hides are never told. A board cut by the frame or covered is found where the
    rest says which corners these are; where that is open it is refused: a wrong label is worse than none.
    Raises `ValueError` for another kind of board or array.
    """
    if board.kind != "chessboard" or gray.ndim != 2 or gray.dtype not in (np.uint8, np.uint16):
        raise ValueError(
            f"expected a chessboard and H x W uint8 or uint16, got {board.kind}, {gray.dtype} {gray.shape}"
        )
    best: _Found | None = None
    best_scale, reasons = 1.0, list[tuple[int, str]]()
    for scale, sigma in _levels(gray):
        level = (
            gray if scale == 1 else cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        )
        found, why = _search(level, sigma, board, trace)
        reasons += why
        if found is not None and (best is None or len(found.ids) > len(best.ids)):
            best, best_scale = found, (level.shape[1] / gray.shape[1])
        if best is not None and best.share > _SHARE_DONE:
            break
    if best is None:
        return Refusal(max(reasons, default=(0, "the image is too small"))[1])
    return _finish(gray, board, best, best_scale, trace)


def _levels(gray: NDArray[Any]) -> Iterator[tuple[float, float]]:
    """(scale, sigma) in the order in which they are tried."""
    h, w = gray.shape
    first = 1.0
    while max(h, w) * first > _LONG_SIDE_PX:
        first /= 2
    tries = [(first, 1.5), (min(2 * first, 1.0), 1.5), (first / 2, 1.5), (first, 1.0), (first, 2.2)]
    for k, (scale, sigma) in enumerate(tries):
        if (scale, sigma) not in tries[:k] and min(h, w) * scale >= 60:
            yield scale, sigma


def _search(
    gray: NDArray[Any], sigma: float, board: Board, trace: Trace
) -> tuple[_Found | None, list[tuple[int, str]]]:
    """The lattice that fits the board best; and how many corners those had that do not, with the reason."""
    image, raw = normalised(gray), gray.astype(np.float32)
    surface = Surface(image, sigma)
    saddles = find_saddles(surface, 2.33 * sigma)
    trace.add(f"saddles in the normalised image, sigma {sigma:g}", image, saddles.xy)
    best: _Found | None = None
    reasons = [(0, f"no lattice of corners among {len(saddles)} saddle points")]
    grown = lattices(saddles, max(_LEAST_CORNERS, int(0.2 * board.visible.sum())))
    for lattice in islice(grown, _MOST_LATTICES):
        if len(lattice) > 2 * len(board.visible):
            size = f"{board.cols} x {board.rows}"
            reasons.append((len(lattice), f"a lattice of {len(lattice)} corners is no board of {size}"))
            continue
        try:
            sheet = Sheet(lattice, surface, raw)
            sheet.extend(max(board.cols, board.rows), 2 * len(board.visible))
            trace.add("lattice", image, sheet.xy)
            placed = _place(sheet, board)
        except ValueError:  # nothing remained of it
            continue
        if isinstance(placed, str):
            reasons.append((len(sheet.cells), placed))
        elif best is None or len(placed.ids) > len(best.ids):
            best = placed
        if best is not None and best.share > _SHARE_DONE:
            break
    return best, reasons


def _place(sheet: Sheet, board: Board) -> _Found | str:
    """The sheet's corners with the board's labels; or why it has none."""
    n = len(sheet)
    size = " x ".join(str(k) for k in sorted(np.ptp(sheet.cells, axis=0) + 1, reverse=True))
    what = f"a lattice of {n} corners ({size})"
    tries = _placements(sheet, board)
    cost, doubts, ids = tries[0]
    if cost > max(2, 0.1 * n):
        return (
            f"{what} does not fit the board's {board.cols} x {board.rows}: {cost} corners too many or too few"
        )
    margin = max(2.0, 0.4 * np.ptp(sheet.cells, axis=0).min())
    rivals = [other for c, _, other in tries[1:] if c < cost + margin]
    if doubts >= margin or any(not _same(ids, other, board) for other in rivals):
        size = f"{board.cols} x {board.rows}"
        return f"{what} may lie at several places of the board's {size}: it is cut or covered"
    full = set(np.ptp(sheet.cells[ids >= 0], axis=0) + 1) == {board.cols, board.rows}
    before = int((ids >= 0).sum())
    labels = _settle(sheet, board, ids)
    expected, seen = _expected(sheet, board, labels), len(labels)
    share = _SHARE_IN_FRAME if full else _SHARE_CUT
    if before < share * expected or seen < max(_SHARE * board.visible.sum(), _LEAST_CORNERS):
        return f"{what} is too little of the board: {seen} of {expected} corners that should be in the image"
    labels = _rightmost(labels, sheet.xy, board)
    return _Found(
        labels, sheet.xy, sheet.along(sheet.cells), sheet.spacing(sheet.cells), seen / max(expected, 1)
    )


def _settle(sheet: Sheet, board: Board, ids: Ids) -> Ids:
    """With the pattern known: drop what it has not, look again for what it has; the sheet's labels."""
    keep = ids >= 0
    on_board = np.stack([ids % board.cols, ids // board.cols, np.ones_like(ids)], 1)
    to_cell = np.linalg.lstsq(on_board[keep].astype(float), sheet.cells[keep].astype(float), rcond=None)[0]
    every = np.flatnonzero(board.visible)
    where = np.stack([every % board.cols, every // board.cols, np.ones_like(every)], 1) @ to_cell
    cells = np.round(where).astype(np.intp)
    sheet.extend(5, len(every), cells)
    label = dict(zip(map(tuple, cells.tolist()), every.tolist(), strict=True))
    return np.array([label[cell] for cell in map(tuple, sheet.cells.tolist())], np.intp)


def _placements(sheet: Sheet, board: Board) -> list[tuple[int, int, Ids]]:
    """Ways to lay the sheet upon the pattern, best first.

    Each: corners that speak against it; how many more of the board's corners lie where its squares may end;
    the label of each of the sheet's corners or -1.
    """
    visible = board.visible.reshape(board.rows, board.cols).astype(np.intp)
    ends = sheet.ends(), sheet.ends(strict=False)
    result = list[tuple[int, int, Ids]]()
    for turn in range(4):
        both = np.concatenate([sheet.cells, *ends])
        for _ in range(turn):
            both = np.stack([-both[:, 1], both[:, 0]], 1)
        both = both - both.min(0)
        kinds = np.repeat([0, 1, 2], [len(sheet), len(ends[0]), len(ends[1])])
        mask = np.zeros((3, int(both[:, 1].max()) + 1, int(both[:, 0].max()) + 1), np.intp)
        mask[kinds, both[:, 1], both[:, 0]] = 1
        cost = len(sheet) - correlate2d(visible, mask[0] - mask[1])
        maybe = correlate2d(visible, mask[2] * (1 - mask[1]))
        for y, x in np.argwhere(cost <= cost.min() + max(board.cols, board.rows)):
            at = both[kinds == 0] + (x - mask.shape[2] + 1, y - mask.shape[1] + 1)
            result.append((int(cost[y, x]), int(maybe[y, x]), _ids(at, board)))
    return sorted(result, key=lambda row: row[0])


def _ids(at: Cells, board: Board) -> Ids:
    """Labels of (column, row), -1 where there is no visible corner."""
    inside = ((at >= 0) & (at < (board.cols, board.rows))).all(1)
    ids = np.where(inside, at[:, 1] * board.cols + at[:, 0], 0)
    return np.where(inside & board.visible[ids], ids, -1)


def _same(ids: Ids, other: Ids, board: Board) -> bool:
    """Whether two labellings differ by a symmetry of the board only."""
    keep = ids >= 0
    return any((symmetry[ids[keep]] == other[keep]).all() for symmetry in board.symmetries())


def _expected(sheet: Sheet, board: Board, ids: Ids) -> int:
    """How many visible corners of the board should be in the image."""
    on_board = np.stack([ids % board.cols, ids // board.cols], 1).astype(np.float64)
    flat, _ = cv2.findHomography(on_board, sheet.xy, 0)
    every = np.flatnonzero(board.visible)
    place = np.c_[every % board.cols, every // board.cols, np.ones(len(every))] @ flat.T
    place = place[:, :2] / place[:, 2:]
    h, w = sheet.shape
    inside = ((place > 3) & (place < (w - 4, h - 4))).all(1)
    return int(np.union1d(every[inside], ids).size)


def _rightmost(ids: Ids, xy: Floats, board: Board) -> Ids:
    """Of the labellings that the board's symmetries allow, the one whose rows run most to the right."""

    def run(labels: Ids) -> float:
        columns = labels % board.cols
        return float(((columns - columns.mean()) * (xy[:, 0] - xy[:, 0].mean())).sum())

    return max((symmetry[ids] for symmetry in board.symmetries()), key=run)


def _finish(gray: NDArray[Any], board: Board, found: _Found, scale: float, trace: Trace) -> Detection:
    """Corners refined in the image itself, less those that lie off a smooth surface."""
    xy = (found.xy + 0.5) / scale - 0.5
    size = found.spacing_px / scale
    radius = np.clip(0.4 * size, 2.5, np.maximum(9.0, 0.2 * size))  # large squares may be soft ones
    image = gray.astype(np.float32)
    fitted, _ = fit_corners(image, xy, found.along, radius)
    good = np.isfinite(fitted).all(1)
    ids, xy = found.ids[good], fitted[good]
    keep = Smooth(np.stack([ids % board.cols, ids // board.cols], 1), xy).inlier
    trace.add("corners", image, xy[keep])
    order = np.argsort(ids[keep])
    return Detection(ids[keep][order], xy[keep][order], "saddle points")
