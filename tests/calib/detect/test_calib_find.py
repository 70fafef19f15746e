"""What all kinds of boards have in common: images that can be searched, refusals in words, pictures."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from board_pictures import shoot

from calib.boards import Board
from calib.detect.find import find_board, grey
from calib.detect.picture import debug_picture
from calib.detect.trace import Trace
from calib.observations import Detection, Refusal
from fusion.errors import FrameError

CIRCLES = Board.of("circles", 7, 5, 0.03)
BOARDS = [
    Board.of("chessboard", 7, 5, 0.03),
    Board.of("charuco", 7, 5, 0.03, marker_m=0.022, dictionary="DICT_4X4_50"),
    Board.of("aprilgrid", 4, 3, 0.04, marker_m=0.03),
    CIRCLES,
    Board.of("asymmetric-circles", 4, 11, 0.02),
]


@pytest.mark.parametrize("board", BOARDS, ids=str)
def test_every_kind_is_found_where_it_is(board: Board) -> None:
    shot = shoot(board, fill=0.4 if board.kind == "asymmetric-circles" else 0.6)
    result = find_board(cv2.cvtColor(shot.counts(60, 120, noise=2), cv2.COLOR_GRAY2BGR), board)
    assert isinstance(result, Detection), result
    assert len(result.ids) > 0.9 * len(board.points_m)
    assert shot.error(result.ids, result.uv, board).max() < 0.3


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((40, 40), np.float32),
        np.zeros((40, 40), np.int32),
        np.zeros((40, 40, 4), np.uint8),
        np.zeros((0, 40), np.uint8),
        np.zeros(40, np.uint8),
    ],
)
def test_arrays_that_are_no_images(image: Any) -> None:
    with pytest.raises(FrameError):
        find_board(image, CIRCLES)


def test_refusals_say_why() -> None:
    def reason(image: Any) -> str:
        result = find_board(image, CIRCLES)
        assert isinstance(result, Refusal)
        return result.reason

    assert reason(np.zeros((20, 400), np.uint8)) == "too small: 400x20 px"
    assert reason(np.full((60, 80), 7, np.uint16)) == "no contrast: every pixel is 7"
    assert "saturated: 100% of pixels at the top (65535)" in reason(np.full((60, 80), 65535, np.uint16))
    image = np.random.default_rng(1).integers(0, 16000, (60, 80)).astype(np.uint16)
    image[:30] = 16383
    assert "saturated: 50% of pixels at the top (16383)" in reason(image)


def test_saturation_is_noted_where_a_board_is_found() -> None:
    result = find_board(shoot(CIRCLES).counts(60, 260), CIRCLES)
    assert isinstance(result, Detection)
    assert any("saturated" in note for note in result.notes)


def test_grey_keeps_the_type_and_the_image() -> None:
    colour = np.random.default_rng(0).integers(0, 65535, (9, 7, 3)).astype(np.uint16)
    before = colour.copy()
    gray = grey(colour)
    assert gray.dtype == np.uint16
    luma = colour @ np.array([0.114, 0.587, 0.299])
    assert np.abs(gray - luma).max() < 2
    assert np.array_equal(colour, before)


@pytest.mark.parametrize("board", BOARDS[1:4], ids=str)
def test_picture_shows_steps_and_verdict(board: Board) -> None:
    image = shoot(board, fill=0.6).counts(21000, -90, noise=3, bits=16)
    trace = Trace(wanted=True)
    result = find_board(image, board, trace)
    found = debug_picture(image, result, trace, "fir/0001.png " * 30, board)
    assert found.dtype == np.uint8
    assert found.ndim == 3
    assert len(trace.steps) >= 2

    def greenish(picture: Any) -> int:
        blue, green, red = (picture[..., k].astype(int) for k in range(3))
        return int((green > np.maximum(blue, red) + 40).sum())

    refused = debug_picture(image, Refusal("no board: " + "word " * 60), trace, "x", board)
    assert greenish(found) > greenish(refused) + 500  # the joined rows
    assert (refused == (80, 80, 255)).all(2).any()  # the reason, in red


def test_no_trace_costs_nothing() -> None:
    trace = Trace()
    find_board(shoot(CIRCLES).counts(60, 120), CIRCLES, trace)
    assert trace.steps == []
