"""Colours to the grey level, the scale's rows, and dots where samples are."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.lidar.sparse import SparseDepth
from fusion.report.depth_picture import (
    BAR_GAP,
    BAR_WIDTH,
    FONT_PX,
    INK,
    NONE_GREY,
    PAPER,
    _ticks,
    coloured,
    depth_picture,
    overlay,
)


def matlab_jet(k: int) -> list[int]:
    """BGR of entry k of MATLAB's jet(256), from its ramps of 64 steps."""
    ramp = [*np.arange(1, 65) / 64, *np.ones(63), *np.arange(64, 0, -1) / 64]  # 191 entries
    table = np.zeros((256, 3))
    for column, first in ((0, -32), (1, 32), (2, 96)):  # blue, green, red
        for n, value in enumerate(ramp):
            if 0 <= first + n < 256:
                table[first + n, column] = value
    return [int(np.floor(255 * x + 0.5)) for x in table[k]]


def entry(value_m: float, lo: float, hi: float) -> int:
    return int(np.floor(255 * min(max((value_m - lo) / (hi - lo), 0), 1) + 0.5))


METRES = [0.01, 1.0, 1.02, 2.2, 3.1415, 5.5, 7.77, 9.99, 10.0, 10.5, 200.0]


def test_jet_over_1_to_10_m_is_matlabs() -> None:
    bgr = coloured(np.array([METRES], np.float32), "jet", (1.0, 10.0))
    assert bgr[0].tolist() == [matlab_jet(entry(m, 1, 10)) for m in METRES]
    assert bgr[0, 0].tolist() == bgr[0, 1].tolist()  # nearer than the map: its first colour
    assert bgr[0, -1].tolist() == [0, 0, 128]  # beyond it: its last, dark red


@pytest.mark.parametrize("name", ["jet", "turbo", "viridis"])
def test_matplotlibs_maps_are_matplotlibs(name: str) -> None:
    shown = coloured(np.array([METRES], np.float32), f"mpl:{name}", (0.5, 20.0))
    exact = [mpl.colormaps[name](entry(m, 0.5, 20), bytes=True)[2::-1] for m in METRES]
    assert shown[0].tolist() == [[int(c) for c in bgr] for bgr in exact]


def test_no_value_is_grey_and_no_colour_of_the_map_is() -> None:
    bgr = coloured(np.array([[0.0, 5.0]], np.float32), "jet", (1, 10))
    assert bgr[0, 0].tolist() == [NONE_GREY] * 3
    assert NONE_GREY not in bgr[0, 1]


@pytest.mark.parametrize("height", [480, 120, 40])
def test_the_bar_runs_from_most_on_top_to_least(height: int) -> None:
    value_m = np.full((height, 64), 4.0, np.float32)
    picture = depth_picture(value_m)
    full = max(height, 120)
    assert picture.shape[0] == full
    assert (picture[:height, :64] == matlab_jet(entry(4, 1, 10))).all()
    assert (picture[height:, :64] == PAPER).all()
    bar = picture[:, 64 + BAR_GAP : 64 + BAR_GAP + BAR_WIDTH]
    top, last = FONT_PX, full - FONT_PX - 1
    assert (bar[:top] == PAPER).all()
    assert (bar[last + 1 :] == PAPER).all()
    assert (bar == bar[:, :1]).all()
    n = last - top + 1
    for row in range(top, last + 1):
        value = 10 - (row - top + 0.5) / n * 9
        assert bar[row, 0].tolist() == matlab_jet(entry(value, 1, 10)), row
    if n >= 256:
        assert bar[top, 0].tolist() == matlab_jet(255)
        assert bar[last, 0].tolist() == matlab_jet(0)


def tick_rows(picture: NDArray[np.uint8], width: int) -> list[int]:
    column = picture[:, width + BAR_GAP + BAR_WIDTH + 2]
    return np.flatnonzero((column == INK).all(-1)).tolist()


def test_ticks_stand_at_their_metres() -> None:
    picture = depth_picture(np.ones((480, 100), np.float32))
    n = 480 - 2 * FONT_PX
    assert tick_rows(picture, 100) == sorted(
        round(FONT_PX + (10 - metres) / 9 * n - 0.5) for metres in range(1, 11)
    )


@pytest.mark.parametrize("show_m", [(0.0, 255.99), (1.0, 10.0), (0.5, 20.0), (100.0, 123.45)])
def test_labels_fit(show_m: tuple[float, float]) -> None:
    picture = depth_picture(np.ones((200, 50), np.float32), show_m=show_m)
    assert (picture[:, -1] == PAPER).all()
    assert (picture[:2] == PAPER)[:, 50:].all()
    assert (picture[-2:] == PAPER)[:, 50:].all()
    assert len(tick_rows(picture, 50)) >= 2


@pytest.mark.parametrize(
    ("lo", "hi", "most", "ticks"),
    [
        (1, 10, 9, [1, 2, 3, 4, 5, 6, 7, 8, 9, 10]),
        (1, 10, 3, [1, 5, 10]),
        (0, 80, 4, [0, 20, 40, 60, 80]),
        (0.5, 20, 5, [0.5, 5, 10, 15, 20]),
        (0, 1, 0, [0, 1]),
        (3, 3.001, 2, [3, 3.0005, 3.001]),
    ],
)
def test_ticks_are_round_and_end_at_both_ends(lo: float, hi: float, most: int, ticks: list[float]) -> None:
    assert _ticks(lo, hi, most) == pytest.approx(ticks)


@pytest.mark.parametrize("show_m", [(1.0, 1.0000000001), (0.0, 1e6), (1e5, 1e6), (0.0, 1e-9)])
def test_absurd_scales_are_drawn_all_the_same(show_m: tuple[float, float]) -> None:
    picture = depth_picture(np.linspace(0, 300, 600, dtype=np.float32).reshape(20, 30), show_m=show_m)
    assert picture.dtype == np.uint8


def sparse(u: list[float], v: list[float], value_m: list[float]) -> SparseDepth:
    n = np.arange(len(u), dtype=np.int64)
    return SparseDepth((64, 48), np.array(u), np.array(v), np.array(value_m, np.float32), "depth", n)


def test_dots_lie_on_their_pixels_and_the_nearer_covers_the_farther() -> None:
    image = np.full((48, 64, 3), 77, np.uint8)
    picture = overlay(image, sparse([10.4, 10.0, 63.4, -0.5], [20.0, 20.4, 47.4, -0.5], [9.0, 2.0, 5.0, 5.0]))
    assert picture[20, 10].tolist() == matlab_jet(entry(2, 1, 10))
    assert picture[47, 63].tolist() == picture[0, 0].tolist() == matlab_jet(entry(5, 1, 10))
    changed = np.argwhere((picture != image).any(-1))
    near = [np.abs(changed - at).max(1) <= 1 for at in ((20, 10), (47, 63), (0, 0))]
    assert np.logical_or.reduce(near).all()
    assert (image == 77).all()


def test_an_image_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match=r"\(64, 48\)"):
        overlay(np.zeros((64, 48, 3), np.uint8), sparse([1.0], [1.0], [1.0]))
