"""Boards with codes: every corner named rightly and where it is, of either polarity; none where none is."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from board_pictures import glow, shoot, without_board

from calib.boards import Board
from calib.codes import board_codes
from calib.detect.coded import find_coded
from calib.observations import Detection, Refusal

CHARUCO = Board.of("charuco", 7, 5, 0.03, marker_m=0.022, dictionary="DICT_4X4_50")
APRIL = Board.of("aprilgrid", 5, 3, 0.04, marker_m=0.03)
BOARDS = pytest.mark.parametrize("board", [CHARUCO, APRIL], ids=str)


def found(image: Any, board: Board) -> Detection:
    result = find_coded(image, board)
    assert isinstance(result, Detection), result
    return result


def worst(result: Detection, true: Any) -> float:
    return float(np.hypot(*(result.uv - true[result.ids]).T).max())


@BOARDS
@pytest.mark.parametrize("contrast", [120, -120])
def test_all_corners_of_either_polarity(board: Board, contrast: int) -> None:
    shot = shoot(board, turn=0.4, fill=0.6)
    result = found(shot.counts(130 - contrast / 2, contrast), board)
    assert sorted(result.ids) == list(range(len(board.points_m)))
    assert worst(result, shot.uv) < 0.1


@BOARDS
def test_upside_down_the_ids_stay_with_the_board(board: Board) -> None:
    shot = shoot(board, turn=3.0)
    result = found(shot.counts(60, 120, noise=3), board)
    assert len(result.ids) > 0.9 * len(board.points_m)
    assert worst(result, shot.uv) < 0.4


@BOARDS
def test_weak_contrast_under_a_glow_in_16_bit(board: Board) -> None:
    """A tenth of the contrast is noise; the corner's error is about noise / contrast px."""
    shot = shoot(board, fill=0.85)
    image = np.round(shot.counts(21000, -40, noise=4, bits=16) + 3000 * glow()).astype(np.uint16)
    result = found(image, board)
    assert len(result.ids) > 0.9 * len(board.points_m)
    assert worst(result, shot.uv) < 0.6
    assert np.hypot(*(result.uv - shot.uv[result.ids]).T).mean() < 0.15


@BOARDS
def test_a_board_that_the_frame_cuts_is_found_in_part(board: Board) -> None:
    shot = shoot(board, shift=(150, 20), fill=0.8)
    result = found(shot.counts(60, 120, noise=2), board)
    assert 4 <= len(result.ids) < len(board.points_m)
    assert worst(result, shot.uv) < 0.3


def test_covered_tags_are_left_out() -> None:
    shot = shoot(APRIL)
    picture = shot.counts(60, 120)
    covered = np.arange(len(shot.uv)).reshape(6, 10)[0:2, 0:2].ravel()  # the tag at the top left
    cv2.fillConvexPoly(picture, cv2.convexHull(shot.uv[covered].astype(np.int32)), 90)
    result = found(picture, APRIL)
    assert set(result.ids) == set(range(60)) - set(covered.tolist())
    assert "14 of 15 codes" in result.notes


@pytest.mark.parametrize(("cols", "rows"), [(6, 4), (5, 4)])
def test_older_layout_of_charuco_boards(cols: int, rows: int) -> None:
    """OpenCV's own picture of such a board."""
    codes = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    theirs = cv2.aruco.CharucoBoard((cols, rows), 0.03, 0.022, codes)
    theirs.setLegacyPattern(True)
    picture = cv2.copyMakeBorder(
        theirs.generateImage((cols * 60, rows * 60)), 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255
    )
    board = Board.of("charuco", cols, rows, 0.03, marker_m=0.022, dictionary="DICT_4X4_50")
    result = found(picture, board)
    assert len(result.ids) == len(board.points_m)
    assert worst(result, (board.points_m[:, :2] / 0.03 + 1) * 60 + 39.5) < 0.1
    assert "OpenCV's older layout" in result.notes


@pytest.mark.parametrize(("cols", "rows"), [(7, 5), (6, 4), (5, 4)])
@pytest.mark.parametrize("legacy", [False, True])
def test_codes_lie_where_opencv_has_them(cols: int, rows: int, legacy: bool) -> None:
    codes = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    theirs = cv2.aruco.CharucoBoard((cols, rows), 0.03, 0.02, codes)
    theirs.setLegacyPattern(legacy)
    board = Board.of("charuco", cols, rows, 0.03, marker_m=0.02, dictionary="DICT_5X5_100")
    ours = board_codes(board, legacy=legacy)
    assert [code.number for code in ours] == np.ravel(theirs.getIds()).tolist()
    for code, corners in zip(ours, theirs.getObjPoints(), strict=True):
        np.testing.assert_allclose(code.corners_m(), np.asarray(corners)[:, :2] - 0.03, atol=1e-7)


def test_another_dictionary_or_size_is_refused() -> None:
    picture = shoot(CHARUCO).counts(60, 120)
    other = Board.of("charuco", 7, 5, 0.03, marker_m=0.022, dictionary="DICT_6X6_50")
    assert isinstance(find_coded(picture, other), Refusal)
    assert isinstance(find_coded(picture, APRIL), Refusal)
    wider = Board.of("charuco", 9, 5, 0.03, marker_m=0.022, dictionary="DICT_4X4_50")
    assert isinstance(find_coded(picture, wider), Refusal)


def test_codes_that_contradict_the_board_are_no_board() -> None:
    """The lower row's tags are where the board has them, those of the upper rows stand one column further."""
    shot = shoot(APRIL, tilt=(0.0, 0.0), turn=0.0, fill=0.75)
    picture = shot.counts(60, 120)
    corner = shot.uv.reshape(6, 10, 2)
    blocks = {}
    for row, col in np.ndindex(2, 5):
        x, y = np.round(corner[2 * row, 2 * col]).astype(int)
        blocks[row, col] = (slice(y - 3, y + 62), slice(x - 3, x + 62))
    side = corner[0, 1, 0] - corner[0, 0, 0]
    assert 52 < side < 60
    tags = {key: picture[block].copy() for key, block in blocks.items()}
    for (row, col), block in blocks.items():
        picture[block] = tags[row, (col + 1) % 5]
    result = find_coded(picture, APRIL)
    assert isinstance(result, Refusal)
    assert "where the board has them" in result.reason


@BOARDS
def test_no_board_where_there_is_none(board: Board) -> None:
    for seed in range(6):
        assert isinstance(find_coded(without_board(seed), board), Refusal), seed
