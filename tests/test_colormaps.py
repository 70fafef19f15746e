"""Colour maps against independent tables: exact fractions, colorsys, printed MATLAB values, the libraries."""

from __future__ import annotations

import colorsys
import math
import subprocess
import sys
from fractions import Fraction

import cv2
import matplotlib
import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.colormaps import colormap_bgr, colormap_names
from fusion.errors import UsageError

CV_MAPS = sorted(name for name in dir(cv2) if name.startswith("COLORMAP_"))
INDEX = np.arange(256, dtype=np.uint8)


def _exact_bgr(hue: Fraction) -> tuple[int, int, int]:
    """A saturated hue as BGR: each channel is 2 - |distance from its own hue in sixths|, within [0, 1]."""

    def channel(centre: int) -> int:
        distance = abs((6 * hue - centre + 3) % 6 - 3)
        value = min(Fraction(1), max(Fraction(0), 2 - distance))
        return math.floor(255 * value + Fraction(1, 2))

    return channel(4), channel(2), channel(0)


def test_hsv_is_matlabs_by_exact_fractions() -> None:
    expected = [_exact_bgr(Fraction(k, 256)) for k in range(256)]
    assert colormap_bgr("hsv").tolist() == [list(entry) for entry in expected]


def test_hsv_is_matlabs_by_colorsys() -> None:
    rgb = np.array([colorsys.hsv_to_rgb(k / 256, 1.0, 1.0) for k in range(256)])
    np.testing.assert_array_equal(colormap_bgr("hsv")[:, ::-1], np.floor(255 * rgb + 0.5))


@pytest.mark.parametrize(
    ("row", "rgb"),
    [  # MATLAB's printed hsv(128), rows from 0; entry 2r of hsv(256) has the same hue
        (0, (1.0, 0.0, 0.0)),
        (1, (1.0, 0.0469, 0.0)),
        (6, (1.0, 0.2813, 0.0)),
        (21, (1.0, 0.9844, 0.0)),
        (22, (0.9688, 1.0, 0.0)),
        (42, (0.0313, 1.0, 0.0)),
    ],
)
def test_hsv_agrees_with_values_matlab_printed(row: int, rgb: tuple[float, float, float]) -> None:
    printed = 255 * np.array(rgb[::-1])
    # half a grey level of rounding and 255 times half the last printed digit
    assert np.abs(colormap_bgr("hsv")[2 * row] - printed).max() <= 0.5 + 255 * 0.00005


def test_hsv_landmarks() -> None:
    table = colormap_bgr("hsv").tolist()
    assert table[0] == [0, 0, 255]
    assert table[64] == [0, 255, 128]  # hue 1/4: red at 127.5, rounded half up
    assert table[128] == [255, 255, 0]
    assert table[255] == [6, 0, 255]


def test_cold_hot_runs_from_blue_to_red_without_repeating() -> None:
    table = colormap_bgr("hsv-cold-hot")
    expected = [_exact_bgr(Fraction(2, 3) * Fraction(255 - k, 255)) for k in range(256)]
    assert table.tolist() == [list(entry) for entry in expected]
    assert table[0].tolist() == [255, 0, 0]
    assert table[255].tolist() == [0, 0, 255]
    assert len(np.unique(table, axis=0)) == 256


def test_grey_is_the_index() -> None:
    np.testing.assert_array_equal(colormap_bgr("grey"), np.stack([INDEX] * 3, axis=1))


@pytest.mark.parametrize("constant", CV_MAPS)
def test_every_opencv_map(constant: str) -> None:
    ramp = np.tile(INDEX, (3, 1))
    expected = cv2.applyColorMap(ramp, getattr(cv2, constant))[1]
    table = colormap_bgr("cv:" + constant.removeprefix("COLORMAP_").lower())
    assert (table.shape, table.dtype) == ((256, 3), np.uint8)
    np.testing.assert_array_equal(table, expected)


def _as_matplotlib_shows(name: str) -> NDArray[np.uint8]:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    shown = ScalarMappable(Normalize(0, 255), matplotlib.colormaps[name])
    rgba = np.asarray(shown.to_rgba(INDEX[None, :], bytes=True))[0]
    return rgba[:, [2, 1, 0]]


def test_jet_is_matlabs_by_its_definition() -> None:
    """The trapezium u of m/4 rising, m/4 - 1 flat and m/4 falling entries, laid out three times (m = 256)."""
    u = [
        *(Fraction(k, 64) for k in range(1, 65)),
        *[Fraction(1)] * 63,
        *(Fraction(k, 64) for k in range(64, 0, -1)),
    ]
    bgr = [[Fraction(0)] * 3 for _ in range(256)]
    for channel, first in (
        (1, 32),
        (2, 96),
        (0, -32),
    ):  # green from entry 33 of 256, red a quarter later, blue before
        for k, value in enumerate(u):
            if 0 <= first + k < 256:
                bgr[first + k][channel] = value
    expected = [[math.floor(255 * value + Fraction(1, 2)) for value in row] for row in bgr]
    assert colormap_bgr("jet").tolist() == expected


def test_jet_is_close_to_the_librarys() -> None:
    """OpenCV's is the same map drawn with other end points: a few grey levels apart."""
    assert np.abs(colormap_bgr("jet").astype(int) - colormap_bgr("cv:jet")).max() <= 4


def test_every_matplotlib_map_is_what_matplotlib_shows() -> None:
    names = list(matplotlib.colormaps)
    assert len(names) > 100
    for name in names:
        table = colormap_bgr(f"mpl:{name}")
        assert (table.shape, table.dtype) == ((256, 3), np.uint8), name
        np.testing.assert_array_equal(table, _as_matplotlib_shows(name), err_msg=name)


def test_a_map_of_ten_colours_uses_all_ten_evenly() -> None:
    _, counts = np.unique(colormap_bgr("tab10"), axis=0, return_counts=True)
    assert sorted(counts.tolist()) == [25] * 4 + [26] * 6


def test_bare_names_prefer_ours_then_matplotlib_then_opencv() -> None:
    assert not np.array_equal(colormap_bgr("hsv"), colormap_bgr("mpl:hsv"))
    assert not np.array_equal(colormap_bgr("hsv"), colormap_bgr("cv:hsv"))
    assert not np.array_equal(colormap_bgr("jet"), colormap_bgr("mpl:jet"))
    np.testing.assert_array_equal(colormap_bgr("inferno"), colormap_bgr("mpl:inferno"))
    assert not np.array_equal(colormap_bgr("inferno"), colormap_bgr("cv:inferno"))
    assert "parula" not in matplotlib.colormaps
    np.testing.assert_array_equal(colormap_bgr("parula"), colormap_bgr("cv:parula"))


def test_names_are_unique_complete_and_accepted() -> None:
    names = colormap_names()
    assert len(names) == len(set(names)) == 4 + len(list(matplotlib.colormaps)) + len(CV_MAPS)
    assert names[0] == "hsv-cold-hot"
    assert {"hsv", "jet", "grey", "mpl:hsv", "mpl:jet", "mpl:grey", "inferno", "cv:jet"} <= set(names)
    assert all(colormap_bgr(name).shape == (256, 3) for name in names)


def test_tables_are_read_only() -> None:
    for name in ("hsv", "grey", "inferno", "cv:jet"):
        with pytest.raises(ValueError, match="read-only"):
            colormap_bgr(name)[0, 0] = 1


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("infreno", "inferno"),
        ("HSV", "hsv"),
        ("viridis ", "viridis"),
        ("cv:jett", "cv:jet"),
        ("mpl:virids", "mpl:viridis"),
        ("hsv_cold_hot", "hsv-cold-hot"),
        ("parulla", "parula"),
    ],
)
def test_an_unknown_name_names_the_near_misses(name: str, meant: str) -> None:
    with pytest.raises(UsageError, match=r"^--colormap: unknown colour map") as error:
        colormap_bgr(name)
    suggested = error.value.hint.removeprefix("did you mean ").rstrip("?").split(", ")
    assert meant in suggested
    for suggestion in suggested:
        colormap_bgr(suggestion)


@pytest.mark.parametrize("name", ["", "cv:", "mpl:", "mpl:parula", "cv:grey", "§§§§"])
def test_a_hopeless_name_is_refused_with_a_hint(name: str) -> None:
    with pytest.raises(UsageError) as error:
        colormap_bgr(name)
    assert error.value.hint


def test_matplotlib_is_imported_only_when_asked_for() -> None:
    code = (
        "import sys; from fusion.colormaps import colormap_bgr as c; c('hsv'); c('grey'); c('cv:jet'); "
        "assert 'matplotlib' not in sys.modules; c('inferno'); assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
