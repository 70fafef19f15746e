"""Where the board was shown, how it was tilted, and where to hold it next."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib.boards import Board
from calib.evidence.linear import board_pose, moments_of
from calib.evidence.uncertainty import sensitivity
from calib.observations import View
from calib.solve.estimate import Solution
from fusion.geometry import Floats, pose, transform

CELLS_WH = (8, 6)
_ENOUGH_SHARE, _ENOUGH_TILT_DEG, _ENOUGH_VIEWS = 0.7, 15.0, 10
_PLACES = {"left": 0.2, "middle": 0.5, "right": 0.8}
_HEIGHTS = {"top": 0.2, "middle": 0.5, "bottom": 0.8}
_TILTS = {
    "facing the camera": (0.0, 0.0),
    "its left edge turned away by 35 degrees": (0.0, 35.0),
    "its right edge turned away by 35 degrees": (0.0, -35.0),
    "its top tipped away by 35 degrees": (-35.0, 0.0),
    "its bottom tipped away by 35 degrees": (35.0, 0.0),
}


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """How the views of a camera fill its image and its space.

    `cells` (6 x 8 int) counts the points seen in each part of the image; `tilt_deg` and `distance_m` are of
    each view: between the board's normal and the line of sight to its middle, and to its middle.
    """

    camera: str
    cells: NDArray[np.int64]
    tilt_deg: Floats
    distance_m: Floats

    @property
    def share(self) -> float:
        """The share of the image's cells in which points were seen."""
        return float((self.cells > 0).mean())

    def faults(self) -> tuple[str, ...]:
        """What is thin about it, and what to record, in words; empty when it is good."""
        found = []
        if len(self.tilt_deg) < _ENOUGH_VIEWS:
            found.append(f"{len(self.tilt_deg)} views are few: record {_ENOUGH_VIEWS} to 30")
        if self.share < _ENOUGH_SHARE:
            found.append(f"{self.share:.0%} of the image has points: show the board {self._empty()}")
        if np.percentile(self.tilt_deg, 75) < _ENOUGH_TILT_DEG:
            found.append(
                f"three quarters of the views are tilted by less than {_ENOUGH_TILT_DEG:.0f} degrees:"
                " tilt the board by 20 to 40"
            )
        if self.distance_m.max() < 1.3 * self.distance_m.min():
            found.append("all views are from one distance: bring the board nearer and farther")
        return tuple(found)

    def _empty(self) -> str:
        """In words, the part of the image with the fewest points."""
        rows, columns = (np.array_split(np.arange(n), 3) for n in self.cells.shape)
        sums = {
            (row, column): (self.cells[np.ix_(r, c)] > 0).mean()
            for row, r in zip(_HEIGHTS, rows, strict=True)
            for column, c in zip(_PLACES, columns, strict=True)
        }
        row, column = min(sums, key=lambda at: float(sums[at]))
        return f"at the {place_in_words(row, column)} of the image"


def place_in_words(row: str, column: str) -> str:
    """``top left``, ``middle``, ``bottom``."""
    words = [word for word in (row, column) if word != "middle"]
    return " ".join(words) or "middle"


def coverage(board: Board, solution: Solution, camera: str) -> Coverage:
    """The coverage of one camera's views; points that did not count are left out."""
    w, h = solution.estimate.cameras[camera].size_wh
    cells = np.zeros(CELLS_WH[::-1], np.int64)
    tilt, distance = [], []
    for view, used in zip(solution.views, solution.used, strict=True):
        if view.camera == camera:
            u, v = view.uv[used].T
            cells += np.histogram2d(v, u, CELLS_WH[::-1], [(-0.5, h - 0.5), (-0.5, w - 0.5)])[0].astype(int)
            middle, normal = _middle(board, solution, view)
            distance.append(np.linalg.norm(middle))
            tilt.append(np.degrees(np.arccos(np.clip(middle @ normal / distance[-1], -1, 1))))
    return Coverage(camera, cells, np.array(tilt), np.array(distance))


def _middle(board: Board, solution: Solution, view: View) -> tuple[Floats, Floats]:
    T = board_pose(solution.estimate, view.moment, view.camera, view.lag_s)
    return transform(T, board.points_m.mean(0)[None])[0], T[:3, 2]


@dataclass(frozen=True, slots=True)
class NextView:
    """The view that would help a camera most: in words, and what its uncertainty (px) would become."""

    words: str
    now_px: float
    then_px: float


def next_view(board: Board, solution: Solution, camera: str) -> NextView | None:
    """Of a few dozen places and tilts of the board, the one that lowers the projection uncertainty most.

    None where the camera's parameters were held fixed. The board is held where the nearer views were. The
    uncertainty is the median over the image at the usual distance of the board, after one more view of that
    kind.
    """
    if f"{camera}.fx" not in solution.names:
        return None
    seen = coverage(board, solution, camera)
    lens, away = solution.estimate.cameras[camera], float(np.median(seen.distance_m))
    places = lens.unproject(_spread_over(lens.size_wh)) * away
    found = sensitivity(board, solution, camera, places)
    now = float(np.nanmedian(found.deviation_px(solution.covariance)))
    information = np.linalg.inv(solution.covariance)
    best: NextView | None = None
    for words, T_camera_board in _candidates(
        board, solution, camera, float(np.quantile(seen.distance_m, 0.25))
    ):
        trial = _with_view(board, solution, camera, T_camera_board)
        if trial is not None:
            extra = moments_of(board, trial)[0].information()
            later = np.asarray(np.linalg.inv(information + extra), np.float64)
            then = float(np.nanmedian(found.deviation_px(later)))
            if best is None or then < best.then_px:
                best = NextView(words, now, then)
    return best


def _spread_over(size_wh: tuple[int, int]) -> Floats:
    u, v = np.meshgrid(np.linspace(0, size_wh[0] - 1, 12), np.linspace(0, size_wh[1] - 1, 9))
    return np.stack([u.ravel(), v.ravel()], -1)


_TRIAL = "next view"


def _candidates(board: Board, solution: Solution, camera: str, away_m: float) -> list[tuple[str, Floats]]:
    lens = solution.estimate.cameras[camera]
    w, h = lens.size_wh
    found = []
    for row, y in _HEIGHTS.items():
        for column, x in _PLACES.items():
            ray = lens.unproject(np.array([[x * (w - 1), y * (h - 1)]]))[0]
            for tilt, (about_x, about_y) in _TILTS.items():
                R = Rotation.from_euler("xy", [about_x, about_y], degrees=True).as_matrix()
                T = pose(R, ray * away_m - R @ board.points_m.mean(0))
                words = f"the board at the {place_in_words(row, column)}, {away_m:.1f} m away, {tilt}"
                found.append((words, T))
    return found


def _with_view(board: Board, solution: Solution, camera: str, T_camera_board: Floats) -> Solution | None:
    """The problem of one more view alone; None where less than half of the board would be in the image."""
    lens = solution.estimate.cameras[camera]
    at = transform(T_camera_board, board.points_m)
    uv, seen = lens.project(at)
    seen = seen & board.visible & (uv > 0).all(1) & (uv < np.array(lens.size_wh) - 1).all(1)
    if seen.sum() < board.visible.sum() / 2:
        return None
    ids = np.flatnonzero(seen)
    view = View(camera, _TRIAL, ids, uv[ids], lens.size_wh)
    T = solution.estimate.T_ref_sensor[camera] @ T_camera_board
    estimate = replace(solution.estimate, T_ref_board={_TRIAL: T})
    everything = np.ones(len(ids), bool)
    return replace(
        solution,
        estimate=estimate,
        views=(view,),
        used=(everything,),
        residual_px=(np.zeros((len(ids), 2)),),
        clouds=(),
        plane_used=(),
        edge_used=(),
    )


def unseen_mask(solution: Solution, camera: str, shape_wh: tuple[int, int]) -> NDArray[np.bool_]:
    """Where, on a grid of cells over the image, no point was seen: there the model extrapolates."""
    w, h = solution.estimate.cameras[camera].size_wh
    columns, rows = shape_wh
    counts = np.zeros((rows, columns))
    for view, used in zip(solution.views, solution.used, strict=True):
        if view.camera == camera:
            u, v = view.uv[used].T
            counts += np.histogram2d(v, u, (rows, columns), [(-0.5, h - 0.5), (-0.5, w - 0.5)])[0]
    return counts == 0
