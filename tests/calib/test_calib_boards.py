"""Boards: their points, their symmetries, their files; and what is no board."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from calib.boards import Board, board_toml, load_board, rectangles, save_board, tag_of
from fusion.errors import FusionError, UsageError
from fusion.simulate.mine.board import Board as MineBoard
from fusion.simulate.mine.scene_config import BoardConfig

CHARUCO: dict[str, Any] = {"marker_m": 0.02, "dictionary": "DICT_5X5_100"}


def test_points_are_those_of_opencv_and_of_the_mine() -> None:
    codes = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    theirs = np.asarray(cv2.aruco.CharucoBoard((7, 4), 0.03, 0.02, codes).getChessboardCorners())
    np.testing.assert_allclose(
        Board.of("charuco", 7, 4, 0.03, **CHARUCO).points_m, theirs - (0.03, 0.03, 0), atol=1e-7
    )
    for config, kind in ((BoardConfig.circles(), "asymmetric-circles"), (BoardConfig(), "chessboard")):
        ours = Board.of(kind, config.cols, config.rows, config.square_m)  # type: ignore[arg-type]
        np.testing.assert_allclose(ours.points_m, MineBoard.of(config).corners_m, atol=1e-12)


def test_an_aprilgrid_has_four_points_a_tag_and_tag_0_at_the_bottom_left() -> None:
    board = Board.of("aprilgrid", 3, 2, 0.05, marker_m=0.04)
    assert board.points_m.shape == (24, 3)
    assert board.grid_wh == (6, 4)
    np.testing.assert_allclose(
        board.points_m[[0, 1, 2, 6, 12]][:, :2], [(0, 0), (0.04, 0), (0.05, 0), (0, 0.04), (0, 0.05)]
    )
    assert [tag_of(board, 0, 1), tag_of(board, 2, 1), tag_of(board, 0, 0)] == [0, 2, 3]


@pytest.mark.parametrize(
    ("board", "count"),
    [
        (Board.of("chessboard", 9, 6, 0.03), 2),
        (Board.of("chessboard", 7, 7, 0.03), 4),
        (Board.of("circles", 7, 5, 0.03), 2),
        (Board.of("asymmetric-circles", 4, 11, 0.03), 1),
        (Board.of("asymmetric-circles", 4, 10, 0.03), 2),
        (Board.of("chessboard", 11, 9, 0.03, hidden=[[3, 2, 5, 5]]), 2),
        (Board.of("chessboard", 11, 9, 0.03, hidden=[[3, 2, 5, 4]]), 1),
        (Board.of("chessboard", 9, 6, 0.03, hidden=[[8, 0, 1, 6]]), 2),
        (Board.of("charuco", 6, 6, 0.03, **CHARUCO), 1),
        (Board.of("aprilgrid", 4, 4, 0.03, marker_m=0.02), 1),
    ],
    ids=str,
)
def test_symmetries_are_turns_that_leave_the_visible_points_alike(board: Board, count: int) -> None:
    turns = board.symmetries()
    assert len(turns) == count
    assert np.array_equal(turns[0], np.arange(len(board.points_m)))
    seen = board.visible
    for turn in turns:
        assert sorted(turn) == list(range(len(turn)))
        assert seen[turn[seen]].all()
        one, two = board.points_m[seen], board.points_m[turn[seen]]
        R = np.linalg.lstsq(one - one.mean(0), two - two.mean(0), rcond=None)[0][:2, :2]
        np.testing.assert_allclose(R.T @ R, np.eye(2), atol=1e-9)
        assert np.linalg.det(R) > 0.99  # never a mirror image
    assert len({tuple(turn) for turn in turns}) == count


@pytest.mark.parametrize(
    "board",
    [
        Board.of(
            "chessboard",
            11,
            9,
            0.0505,
            hidden=[[3, 2, 5, 5], [0, 0, 1, 2]],
            plate_m=(-0.1, -0.1, 0.605, 0.504),
        ),
        Board.of("charuco", 7, 5, 0.03, **CHARUCO),
        Board.of("aprilgrid", 6, 6, 0.0715, marker_m=0.055, hidden=[[0, 0, 2, 2]]),
        Board.of("circles", 7, 5, 0.03),
        Board.of("asymmetric-circles", 4, 11, 0.03),
    ],
    ids=str,
)
def test_files_come_back_as_they_were(board: Board, tmp_path: Path) -> None:
    save_board(tmp_path / "board.toml", board)
    back = load_board(tmp_path / "board.toml")
    assert board_toml(back) == board_toml(board)
    assert np.array_equal(back.points_m, board.points_m)
    assert np.array_equal(back.visible, board.visible)
    assert (back.plate_m, back.marker_m, back.dictionary) == (board.plate_m, board.marker_m, board.dictionary)
    if board.plate_m:
        assert (~back.visible).sum() == 27
        assert not back.visible[3 + 2 * 11]


def test_rectangles_cover_a_mask_once() -> None:
    mask = np.random.default_rng(3).random((9, 13)) < 0.5
    count = np.zeros(mask.shape, int)
    for col, row, cols, rows in rectangles(mask):
        count[row : row + rows, col : col + cols] += 1
    assert np.array_equal(count, mask.astype(int))


HEAD = 'format = "fusion-board/1"\n'
GOOD = HEAD + 'kind = "chessboard"\ncols = 9\nrows = 6\nspacing_m = 0.03\n'


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (GOOD + "color = 1\n", "color"),
        (GOOD.replace("board/1", "board/2"), "fusion-board/1"),
        (GOOD.replace("cols = 9\n", ""), "cols"),
        (GOOD.replace("chessboard", "chess"), "kind"),
        (GOOD.replace("0.03", "nan"), "spacing_m"),
        (GOOD.replace("0.03", "-1.0"), "spacing_m"),
        (GOOD.replace("0.03", "300.0"), "spacing_m"),
        (GOOD.replace("cols = 9", "cols = 100000"), "columns and rows"),
        (GOOD.replace("cols = 9", "cols = 1"), "columns and rows"),
        (GOOD + "hidden = [[8, 0, 2, 1]]\n", "leaves the grid"),
        (GOOD + "hidden = [[0, 0, 9, 6]]\n", "left visible"),
        (GOOD + "hidden = [[0, 0, 9]]\n", "hidden"),
        (GOOD + "plate_m = [0.1, 0.0, 0.3, 0.2]\n", "does not hold"),
        (GOOD + "marker_m = 0.02\n", "marker_m"),
        (GOOD + 'dictionary = "DICT_4X4_50"\n', "dictionary"),
        (GOOD.replace("chessboard", "charuco"), "marker_m"),
        (GOOD.replace("chessboard", "charuco") + "marker_m = 0.02\n", "unknown dictionary"),
        (
            GOOD.replace("chessboard", "charuco") + 'marker_m = 0.02\ndictionary = "__class__"\n',
            "unknown dictionary",
        ),
        (GOOD.replace("chessboard", "aprilgrid") + "marker_m = 0.03\n", "between 0 and spacing_m"),
        (
            GOOD.replace("= 9", "= 60").replace("chessboard", "aprilgrid") + "marker_m = 0.02\ncols=3",
            "cannot be read",
        ),
        ("\x00\x01", "cannot be read"),
        ("", "fusion-board/1"),
    ],
)
def test_what_is_no_board_is_said_with_its_file(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "board.toml"
    path.write_text(text)
    with pytest.raises(UsageError) as error:
        load_board(path)
    assert says in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_more_codes_than_there_are() -> None:
    with pytest.raises(UsageError, match="587"):
        Board.of("aprilgrid", 30, 20, 0.03, marker_m=0.02)
    with pytest.raises(UsageError, match="has 50 codes, the board needs 60"):
        Board.of("charuco", 12, 10, 0.03, marker_m=0.02, dictionary="DICT_4X4_50")


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"none[.]toml"):
        load_board(tmp_path / "none.toml")
    with pytest.raises(FusionError):
        load_board(tmp_path)


def kalibr(tmp_path: Path, text: str) -> Board:
    pytest.importorskip("yaml")
    path = tmp_path / "target.yaml"
    path.write_text(text)
    return load_board(path)


APRIL = "target_type: 'aprilgrid' # gridtype\ntagCols: 6\ntagRows: 4\ntagSize: 0.088\ntagSpacing: 0.3\n"
CHESS = "target_type: checkerboard\ntargetCols: 6\ntargetRows: 7\n"
CHESS += "rowSpacingMeters: 0.06\ncolSpacingMeters: 0.06\n"


def test_kalibrs_aprilgrid(tmp_path: Path) -> None:
    """Theirs has y up and tag 0 at the bottom left: tag k is at (k % 6, k // 6) steps from there."""
    board = kalibr(tmp_path, APRIL)
    step = 0.088 * 1.3
    assert (board.kind, board.cols, board.rows, board.marker_m) == ("aprilgrid", 6, 4, 0.088)
    bottom = board.points_m[:, 1].max()
    for col, row in np.ndindex(6, 4):
        k = tag_of(board, col, row)
        corner = board.points_m[(2 * row + 1) * 12 + 2 * col, :2]  # its lower left
        np.testing.assert_allclose(
            [corner[0], bottom - corner[1]], [(k % 6) * step, (k // 6) * step], atol=1e-12
        )


def test_kalibrs_other_targets(tmp_path: Path) -> None:
    chess = kalibr(tmp_path, CHESS)
    assert board_toml(chess) == board_toml(Board.of("chessboard", 6, 7, 0.06))
    text = "target_type: circlegrid\ntargetCols: 4\ntargetRows: 11\nspacingMeters: 0.02\nasymmetricGrid: {}\n"
    assert kalibr(tmp_path, text.format("True")).kind == "asymmetric-circles"
    assert kalibr(tmp_path, text.format("False")).kind == "circles"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (CHESS.replace("colSpacingMeters: 0.06", "colSpacingMeters: 0.07"), "not square"),
        (CHESS + "extra: 1\n", "extra"),
        (CHESS.replace("checkerboard", "assymetric"), "known: checkerboard"),
        (APRIL.replace("0.088", "!!python/object/apply:os.getcwd []"), "YAML"),
        (APRIL.replace("tagSize: 0.088", "tagSize: [0.088"), "YAML"),
        (APRIL.replace("0.3", "-0.3"), "tagSpacing"),
        ("- target_type\n", "target_type"),
    ],
)
def test_targets_that_cannot_be_used(text: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=says):
        kalibr(tmp_path, text)
