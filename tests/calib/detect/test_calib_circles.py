"""Circle grids: found where they are, of either polarity, under a glow, cut by the frame; nowhere else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from board_pictures import glow, shoot, without_board

from calib.boards import Board
from calib.detect.circles import find_circles
from calib.detect.dots import place
from calib.detect.known import Known, mapped
from calib.observations import Detection, Refusal

ASYMMETRIC = Board.of("asymmetric-circles", 4, 11, 0.02)
SYMMETRIC = Board.of("circles", 7, 5, 0.03)


def found(image: Any, board: Board) -> Detection:
    result = find_circles(image, board)
    assert isinstance(result, Detection), result
    return result


@pytest.mark.parametrize("board", [ASYMMETRIC, SYMMETRIC], ids=str)
@pytest.mark.parametrize("contrast", [120, -120])
def test_centres_are_the_circles_not_the_ellipses(board: Board, contrast: int) -> None:
    fill = 0.4 if board is ASYMMETRIC else 0.7
    shot = shoot(board, fill=fill, tilt=(0.5, -0.6))
    result = found(shot.counts(130 - contrast / 2, contrast), board)
    assert sorted(result.ids) == list(range(len(board.points_m)))
    assert shot.error(result.ids, result.uv, board).max() < 0.05


def test_bias_of_the_ellipses_centre_is_what_is_removed() -> None:
    """The middles of the dark ellipses lie nearer to the camera than the circles' centres."""
    shot = shoot(SYMMETRIC, tilt=(0.6, -0.8), fill=0.7, size_wh=(640, 480))
    picture = shot.counts(70, 120)
    _, labels, _, _ = cv2.connectedComponentsWithStats((picture < 130).astype(np.uint8))
    dark = np.array([labels[round(y), round(x)] for x, y in shot.uv])
    assert len(set(dark)) == 35
    assert 0 not in dark
    middle = np.array([np.mean(np.argwhere(labels == k)[:, ::-1], 0) for k in dark])
    result = found(picture, SYMMETRIC)
    assert len(result.ids) == 35
    theirs, ours = np.hypot(*(middle - shot.uv).T), shot.error(result.ids, result.uv, SYMMETRIC)
    assert theirs.mean() > 0.1
    assert ours.mean() < 0.3 * theirs.mean()


def test_weak_contrast_under_a_glow_in_16_bit() -> None:
    """40 counts of board on 3000 of glow, noise 4: some 200 px of a rim hold its centre."""
    shot = shoot(ASYMMETRIC, fill=0.4)
    image = np.round(shot.counts(21000, -40, noise=4, bits=16) + 3000 * glow()).astype(np.uint16)
    result = found(image, ASYMMETRIC)
    assert len(result.ids) >= 42
    error = shot.error(result.ids, result.uv, ASYMMETRIC)
    assert np.sqrt((error**2).mean()) < 0.12
    assert "bright circles" in result.notes


@pytest.mark.parametrize("turn", [0.0, 1.4, 3.0, -1.8])
def test_labels_follow_the_board_however_it_is_turned(turn: float) -> None:
    shot = shoot(ASYMMETRIC, fill=0.35, turn=turn)
    result = found(shot.counts(60, 120, noise=2), ASYMMETRIC)
    assert len(result.ids) == 44
    assert shot.error(result.ids, result.uv, ASYMMETRIC).max() < 0.3


def test_a_board_that_the_frame_cuts_is_labelled_rightly_or_refused() -> None:
    labelled = 0
    for across in (60, 80, 100, 120, 140):
        shot = shoot(ASYMMETRIC, fill=0.45, shift=(across, 0), turn=0.05, tilt=(0.2, 0.3))
        result = find_circles(shot.counts(60, 120, noise=2), ASYMMETRIC)
        if isinstance(result, Refusal):
            continue
        assert shot.error(result.ids, result.uv, ASYMMETRIC).max() < 0.3
        labelled += len(result.ids) < 44
    assert labelled


def test_a_row_that_is_missing_is_no_reason_to_guess() -> None:
    """Without its last row the board of 11 rows looks the same turned by half."""
    shot = shoot(ASYMMETRIC, fill=0.4, turn=0.0, tilt=(0.0, 0.2))
    picture = shot.counts(60, 120, noise=1)
    for x, y in shot.uv[40:]:
        cv2.circle(picture, (round(x), round(y)), 9, 180, -1)
    result = find_circles(picture, ASYMMETRIC)
    assert isinstance(result, Refusal)
    assert "more ways than one" in result.reason


def test_hidden_circles_are_not_reported_and_settle_the_labels() -> None:
    board = Board.of("circles", 7, 5, 0.03, hidden=[[0, 0, 2, 2]])
    shot = shoot(board)
    result = found(shot.counts(60, 120, noise=2), board)
    assert set(result.ids) == set(np.flatnonzero(board.visible))
    assert np.hypot(*(result.uv - shot.uv[result.ids]).T).max() < 0.2


@pytest.mark.parametrize(("cols", "rows"), [(9, 7), (8, 5), (7, 4), (6, 6)])
def test_another_board_is_refused(cols: int, rows: int) -> None:
    shot = shoot(Board.of("circles", cols, rows, 0.03), fill=0.45)
    assert isinstance(find_circles(shot.counts(60, 120), SYMMETRIC), Refusal)


def test_a_larger_board_that_only_one_place_fits_is_refused() -> None:
    """With a part hidden it lies on a full one in one way only; but there are circles beside it."""
    larger = Board.of("asymmetric-circles", 5, 11, 0.02)
    smaller = Board.of("asymmetric-circles", 4, 11, 0.02, hidden=[[0, 0, 1, 1]])
    picture = shoot(larger, fill=0.4).counts(60, 120)
    assert isinstance(find_circles(picture, smaller), Refusal)


def test_circles_of_both_polarities_are_no_grid() -> None:
    """Every other circle is brighter than the plate, as no board is."""
    shot = shoot(SYMMETRIC, tilt=(0.0, 0.1))
    picture = np.full(shot.bright.shape, 120, np.uint8)
    for k, (x, y) in enumerate(shot.uv):
        cv2.circle(picture, (round(x), round(y)), 12, 60 if k % 2 else 180, -1, cv2.LINE_AA)
    result = find_circles(picture, SYMMETRIC)
    assert isinstance(result, Refusal), result


def test_circles_of_the_other_polarity_are_left_out() -> None:
    shot = shoot(SYMMETRIC, tilt=(0.0, 0.1), fill=0.6)
    picture = shot.counts(60, 120)
    for k in (16, 18):
        x, y = (round(v) for v in shot.uv[k])
        part = picture[y - 14 : y + 15, x - 14 : x + 15]
        part[part < 178] = 255 - (part[part < 178] // 2)
    result = found(picture, SYMMETRIC)
    assert set(result.ids) == set(range(35)) - {16, 18}


@pytest.mark.parametrize("lost", [0, 6])
def test_the_frames_edge_says_which_column_is_missing(lost: int) -> None:
    """Of 7 columns 6 are there; the one that lies outside the picture is no miss, the one inside would be."""
    uv = SYMMETRIC.points_m[:, :2] / 0.03 * 40 + (60, 40)
    uv[:, 0] -= 80 if lost == 0 else 0
    there = np.arange(35) % 7 != lost
    size = (320, 240) if lost == 0 else (290, 240)
    first = place((uv[there] // 40).astype(np.intp), uv[there], SYMMETRIC, size, 10.0)[0]
    assert (first.hits, first.misses) == (30, 0)
    true = np.flatnonzero(there)
    assert any(np.array_equal(turn[true], first.ids) for turn in SYMMETRIC.symmetries())


def test_known_places_predict_through_a_lens() -> None:
    """A homography alone is off by pixels where the lens bends the picture."""
    xy = ASYMMETRIC.points_m[:, :2]
    centred = (xy - xy.mean(0)) / 0.1
    uv = 300 * centred * (1 - 0.12 * (centred**2).sum(1, keepdims=True)) + (320, 240)
    inner = np.abs(centred).max(1) < 0.9
    known = Known.of(xy, uv, robust=False)
    assert known is not None
    ours, _ = known.predict(xy, without_itself=True)
    plain = np.hypot(*(mapped(known.H, xy) - uv).T)[inner]
    assert np.hypot(*(ours - uv).T)[inner].mean() < 0.6 * plain.mean()
    on_a_line = Known.of(xy[:4], uv[:4], robust=False)
    assert on_a_line is None


@pytest.mark.parametrize("board", [ASYMMETRIC, SYMMETRIC], ids=str)
def test_no_board_where_there_is_none(board: Board) -> None:
    for seed in (0, 1, 2, 3, 4, 5, 10):
        assert isinstance(find_circles(without_board(seed), board), Refusal), seed


def test_no_board_in_real_pictures(shared_data: Path) -> None:
    files = sorted((shared_data / "rgbt_pairs").rglob("*.[jp][pn]g"))[:3]
    assert files
    for file in files:
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        small = cv2.resize(image, (240, 180), interpolation=cv2.INTER_AREA)
        assert isinstance(find_circles(small, SYMMETRIC), Refusal), file


def test_image_is_not_changed() -> None:
    picture = shoot(SYMMETRIC).counts(60, 120)
    before = picture.copy()
    find_circles(picture, SYMMETRIC)
    assert np.array_equal(picture, before)
