"""Chessboards in rendered images with exact truth, in real ones, and where there are none."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calib.boards import Board
from calib.detect.chessboard import find_chessboard
from calib.detect.trace import Trace
from calib.observations import Detection, Refusal
from fusion.geometry import Floats

FINE = 3  # rays a pixel and axis of the renderer


def _board(cols: int, rows: int, hidden: tuple[int, int, int, int] | None = None) -> Board:
    j, i = np.divmod(np.arange(cols * rows), cols)
    visible = np.ones((rows, cols), bool)
    if hidden is not None:
        c, r, w, h = hidden
        visible[r : r + h, c : c + w] = False
    points = np.stack([i, j, np.zeros(len(i))], 1) * 0.05
    return Board("chessboard", cols, rows, 0.05, points, visible.ravel())


BOARD = _board(9, 6)
HOLED = _board(11, 9, (3, 2, 5, 5))


class View:
    """A pinhole camera with radial distortion before a board: renders by casting rays, projects exactly."""

    def __init__(
        self,
        board: Board,
        tilt: tuple[float, float, float],
        away: float,
        size_wh: tuple[int, int] = (320, 240),
    ) -> None:
        self.board, self.size_wh = board, size_wh
        w, h = size_wh
        self.camera = np.array([[0.9 * w, 0, w / 2 + 1.3], [0, 0.9 * w, h / 2 - 0.7], [0, 0, 1]])
        self.distortion = np.array([-0.15, 0.03, 0, 0, 0])
        turns = [cv2.Rodrigues(np.array(v))[0] for v in ((*tilt[:2], 0.0), (0.0, 0.0, tilt[2]))]
        self.rotation = np.asarray(turns[0] @ turns[1], np.float64)
        middle = board.points_m.mean(0)
        self.shift = np.array([0.0, 0.0, away * 0.05 * (board.cols + 1)]) - self.rotation @ middle

    def truth(self) -> Floats:
        vector = cv2.Rodrigues(self.rotation)[0]
        uv, _ = cv2.projectPoints(self.board.points_m, vector, self.shift, self.camera, self.distortion)
        return np.asarray(uv.reshape(-1, 2), np.float64)

    def render(self, cover: Floats | None = None) -> Floats:
        """0 dark, 1 bright; `cover` (x0, y0, x1, y1), in squares, is grey."""
        w, h = self.size_wh
        fine = (np.arange(max(w, h) * FINE) + 0.5) / FINE - 0.5
        u, v = np.meshgrid(fine[: w * FINE], fine[: h * FINE])
        seen = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], 1) @ np.linalg.inv(self.camera).T
        ideal = seen[:, :2]
        for _ in range(9):  # undo the distortion
            square = (ideal**2).sum(1, keepdims=True)
            ideal = seen[:, :2] / (1 + self.distortion[0] * square + self.distortion[1] * square**2)
        to_board = np.linalg.inv(np.c_[self.rotation[:, :2], self.shift])
        flat = np.c_[ideal, np.ones(len(ideal))] @ to_board.T
        x, y = (flat[:, :2] / flat[:, 2:] / 0.05).T
        cols, rows = self.board.cols, self.board.rows
        bright = (np.floor(x) + np.floor(y)) % 2
        bright[(x < -1) | (x > cols) | (y < -1) | (y > rows)] = 1
        bright[(x < -1.8) | (x > cols + 0.8) | (y < -1.8) | (y > rows + 0.8)] = 0.4
        if not self.board.visible.all():
            bright[(x > 2.5) & (x < 7.5) & (y > 1.5) & (y < 6.5)] = 1
            bright[(x > 3) & (x < 7) & (y > 2) & (y < 6)] = 0
        if cover is not None:
            bright[(x > cover[0]) & (y > cover[1]) & (x < cover[2]) & (y < cover[3])] = 0.3
        return bright.reshape(h, FINE, w, FINE).mean((1, 3))


@cache
def _pictures() -> list[tuple[View, Floats]]:
    views = [
        View(BOARD, (0.5, -0.2, 0.05), 1.3),
        View(BOARD, (-0.4, 0.6, 2.0), 1.6),
        View(HOLED, (0.3, 0.4, 4.0), 1.4),
    ]
    return [(view, view.render()) for view in views]


def _counts(
    picture: Floats, noise: float, blur: float, low: float = 60, high: float = 190
) -> NDArray[np.uint8]:
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(low + (high - low) * picture, (0, 0), blur) + rng.normal(0, noise, picture.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def _error(found: Detection | Refusal, truth: Floats, board: Board) -> Floats:
    """Pixels off the truth under the symmetry of the board that fits best."""
    assert isinstance(found, Detection), found
    assert board.visible[found.ids].all()
    options = [found.uv - truth[symmetry[found.ids]] for symmetry in board.symmetries()]
    return min(options, key=lambda e: float(np.abs(e).mean()))


@pytest.mark.parametrize("which", [0, 1, 2])
def test_all_corners_are_found_to_a_small_part_of_a_pixel(which: int) -> None:
    view, picture = _pictures()[which]
    error = _error(find_chessboard(_counts(picture, 2.0, 0.7), view.board), view.truth(), view.board)
    assert len(error) == view.board.visible.sum()
    assert np.sqrt((error**2).mean()) < 0.05
    assert np.abs(error.mean(0)).max() < 0.01


@pytest.mark.parametrize("which", [0, 1, 2])
def test_the_same_in_sixteen_bits_weak_inverted_and_under_a_glow(which: int) -> None:
    view, picture = _pictures()[which]
    h, w = picture.shape
    y, x = np.mgrid[:h, :w]
    glow = 400 * np.exp(-((x - w / 2) ** 2 + (y - h / 2) ** 2) / (2 * 60.0**2))
    soft = cv2.GaussianBlur(-30 * picture, (0, 0), 1.2)
    counts = np.round(7000 + glow + soft + np.random.default_rng(1).normal(0, 1, picture.shape)).astype(
        np.uint16
    )
    before = counts.copy()
    found = find_chessboard(counts, view.board)
    assert (counts == before).all()
    error = _error(found, view.truth(), view.board)
    assert len(error) >= view.board.visible.sum() - 1
    assert np.sqrt((error**2).mean()) < 0.12
    assert np.abs(error.mean(0)).max() < 0.03  # not dragged along by the glow


def test_polarity_does_not_matter_and_the_result_is_the_same_twice() -> None:
    image = _counts(_pictures()[0][1], 1.0, 0.7)
    one, two = find_chessboard(image, BOARD), find_chessboard(255 - image, BOARD)
    again = find_chessboard(image, BOARD)
    assert isinstance(one, Detection)
    assert isinstance(two, Detection)
    assert isinstance(again, Detection)
    assert (one.ids == two.ids).all()
    np.testing.assert_allclose(one.uv, two.uv, atol=0.01)
    assert (again.uv == one.uv).all()


@pytest.mark.parametrize("turn", range(4))
def test_rows_run_to_the_right_and_are_never_mirrored(turn: int) -> None:
    _, picture = _pictures()[0]
    found = find_chessboard(np.ascontiguousarray(np.rot90(_counts(picture, 1.0, 0.7), turn)), BOARD)
    assert isinstance(found, Detection)
    at = dict(zip(found.ids.tolist(), found.uv, strict=True))
    right, down = at[8] - at[0], at[45] - at[0]
    assert right[0] > 0 or abs(right[0]) < abs(right[1])
    assert right[0] * down[1] - right[1] * down[0] > 0


@pytest.mark.parametrize(("scale", "size"), [(2.0, (640, 480)), (0.5, (160, 120)), (4.0, (1280, 960))])
def test_far_and_near_small_and_large(scale: float, size: tuple[int, int]) -> None:
    view, picture = _pictures()[0]
    image = cv2.resize(
        _counts(picture, 0.5, 0.5), size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    )
    truth = (view.truth() + 0.5) * scale - 0.5
    error = _error(find_chessboard(image, BOARD), truth, BOARD)
    assert len(error) == 54
    assert np.sqrt((error**2).mean()) < 0.08 * max(scale, 1)


def test_a_board_cut_by_the_frame_is_labelled_where_its_other_end_is_seen() -> None:
    view, picture = _pictures()[0]
    truth = view.truth()
    left = int(truth[:, 0].min() + 0.3 * np.ptp(truth[:, 0]))
    found = find_chessboard(_counts(picture, 1.0, 0.7)[:, left:], BOARD)
    error = _error(found, truth - (left, 0), BOARD)
    assert 18 <= len(error) < 50
    assert np.abs(error).max() < 0.5


def test_a_board_whose_ends_are_not_seen_is_refused() -> None:
    view, picture = _pictures()[0]
    columns = view.truth().reshape(6, 9, 2)[..., 0]
    left, right = int(columns[:, 0].max()) + 4, int(columns[:, -1].min()) - 4
    found = find_chessboard(_counts(picture, 1.0, 0.7)[:, left:right], BOARD)
    assert isinstance(found, Refusal)
    assert "several places" in found.reason


@pytest.mark.parametrize("cover", [(-2, -2, 0.5, 9), (7.4, -2, 12, 9), (-2, -2, 12, 0.45)])
def test_a_covered_line_is_labelled_right_or_not_at_all(cover: tuple[float, ...]) -> None:
    view = View(BOARD, (0.3, 0.2, 0.1), 1.4)
    found = find_chessboard(_counts(view.render(np.array(cover)), 1.0, 0.7), BOARD)
    if isinstance(found, Detection):
        assert np.abs(_error(found, view.truth(), BOARD)).max() < 0.5


def test_a_line_papered_over_like_the_rim_makes_another_board() -> None:
    view, picture = _pictures()[0]
    truth = view.truth().reshape(6, 9, 2)
    beyond = np.concatenate(
        [truth[:1, :2] * 2 - truth[1:2, :2], truth[:, :2], truth[-1:, :2] * 2 - truth[-2:-1, :2]]
    )
    rim = np.concatenate(
        [beyond[:, 0], 2 * beyond[::-1, 0] - beyond[::-1, 1]]
    )  # from the first line outwards
    papered = picture.copy()
    cv2.fillPoly(papered, [np.round(rim).astype(np.int32)], 1.0)
    found = find_chessboard(_counts(papered, 1.0, 0.7), BOARD)
    assert isinstance(found, Refusal)  # it ends on both sides, one line short
    assert isinstance(find_chessboard(_counts(papered, 1.0, 0.7), _board(8, 6)), Detection)


def test_a_hole_in_the_middle_says_where_a_cut_board_lies() -> None:
    view, picture = _pictures()[2]
    truth = view.truth()
    left = int(np.percentile(truth[:, 0], 12))
    found = find_chessboard(_counts(picture, 1.0, 0.7)[:, left:], HOLED)
    error = _error(found, truth - (left, 0), HOLED)
    assert len(error) >= 55
    assert np.abs(error).max() < 0.5


@pytest.mark.parametrize(("cols", "rows"), [(8, 6), (9, 7), (6, 4), (12, 9)])
def test_a_board_of_another_size_is_refused(cols: int, rows: int) -> None:
    found = find_chessboard(_counts(_pictures()[0][1], 1.0, 0.7), _board(cols, rows))
    assert isinstance(found, Refusal)
    assert f"{cols} x {rows}" in found.reason


def test_nothing_is_found_where_there_is_none() -> None:
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:240, :320] / 17.0
    u, v = 0.9 * x + 0.4 * y, 0.9 * y - 0.4 * x
    lattices = {
        "grid": (u % 1 < 0.12) | (v % 1 < 0.12),
        "bricks": ((u + np.floor(v) % 2 / 2) % 1 < 0.1) | (v % 1 < 0.18),
        "keys": (x % 1 > 0.2) & (y % 1 > 0.2) & (x < 14) & (y < 6),
        "dots": (u % 1 - 0.5) ** 2 + (v % 1 - 0.5) ** 2 < 0.09,
        "squares": (np.floor(u) + np.floor(v)) % 2 > 0,
        "noise": rng.random(x.shape) > 0.5,
        "blobs": cv2.GaussianBlur(rng.normal(0, 1, x.shape), (0, 0), 5) > 0,
    }
    for name, lattice in lattices.items():
        found = find_chessboard(_counts(lattice.astype(float), 3.0, 1.0), BOARD)
        assert isinstance(found, Refusal), name
        assert found.reason


@pytest.mark.parametrize("shape", [(1, 1), (5, 300), (61, 61), (100, 70)])
@pytest.mark.parametrize("value", [0, 65535])
def test_tiny_flat_and_saturated_images_are_refused(shape: tuple[int, int], value: int) -> None:
    assert isinstance(find_chessboard(np.full(shape, value, np.uint16), BOARD), Refusal)


def test_misuse_is_said() -> None:
    with pytest.raises(ValueError, match="float64"):
        find_chessboard(np.zeros((100, 100)), BOARD)
    with pytest.raises(ValueError, match="3"):
        find_chessboard(np.zeros((100, 100, 3), np.uint8), BOARD)
    circles = Board("circles", 9, 6, 0.05, BOARD.points_m, BOARD.visible)
    with pytest.raises(ValueError, match="circles"):
        find_chessboard(np.zeros((100, 100), np.uint8), circles)


def test_the_trace_keeps_what_was_seen() -> None:
    trace = Trace(wanted=True)
    found = find_chessboard(_counts(_pictures()[0][1], 1.0, 0.7), BOARD, trace)
    assert isinstance(found, Detection)
    titles = [title for title, _, _ in trace.steps]
    assert any("saddle" in title for title in titles)
    assert "lattice" in titles
    assert titles[-1] == "corners"
    points = trace.steps[-1][2]
    assert points is not None
    assert len(points) == len(found.ids)


def _gray(path: Path) -> NDArray[np.uint8] | NDArray[np.uint16]:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    return image.astype(np.uint16) if image.dtype == np.uint16 else image.astype(np.uint8)


def test_heated_boards_are_found_in_both_kinds_of_camera(shared_data: Path) -> None:
    for camera in ("5003", "5270", "13020556", "13232653"):
        files = sorted((shared_data / "thermal_boards/heated_9x6" / camera).iterdir())
        assert len(files) == 2
        for file in files:
            found = find_chessboard(_gray(file), BOARD)
            assert isinstance(found, Detection), file
            cut = file.match("13020556/000000029.png")  # the frame cuts off two columns
            assert len(found.ids) == 42 if cut else len(found.ids) >= 53, file


def test_boards_with_a_hidden_middle_are_found(shared_data: Path) -> None:
    counts = []
    for file in sorted((shared_data / "thermal_boards/partial_11x9").glob("temp*.png")):
        found = find_chessboard(_gray(file), HOLED)
        assert isinstance(found, Detection), file
        counts.append(len(found.ids))
    assert len(counts) == 6
    assert sum(n >= 64 for n in counts) >= 5  # the frame cuts through the sixth


def test_all_ten_board_images_are_found_and_calibrate(shared_data: Path) -> None:
    board = _board(7, 5)
    found = [find_chessboard(_gray(f), board) for f in sorted((shared_data / "board_images").glob("*.png"))]
    views = [d for d in found if isinstance(d, Detection)]
    assert len(views) == 10
    assert all(len(d.ids) == 35 for d in views)
    rms, *_ = cv2.calibrateCamera(
        [board.points_m[d.ids].astype(np.float32) for d in views],
        [d.uv.astype(np.float32) for d in views],
        (964, 724),
        np.array([[500.0, 0, 482], [0, 500, 362], [0, 0, 1]]),
        np.zeros(5),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
    )
    assert rms < 0.2
