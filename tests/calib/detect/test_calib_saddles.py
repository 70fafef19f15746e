"""Saddle points and the fit of corners, against exact truth and against another optimiser."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.special import erf

from calib.detect.saddles import Surface, alternates, find_saddles, fit_corners, look_up, normalised
from fusion.geometry import Floats

HALF_PX = 12


def _corner(
    at: tuple[float, float], angles: tuple[float, float], blur: float, glow: tuple[float, float]
) -> Floats:
    """A corner of amplitude 20 on a slope, whose centre is `at` from the middle pixel."""
    y, x = np.mgrid[-HALF_PX : HALF_PX + 1, -HALF_PX : HALF_PX + 1] - np.array(at)[::-1, None, None]
    edge = [erf((np.cos(a) * y - np.sin(a) * x) / (np.sqrt(2) * blur)) for a in angles]
    return 100 + glow[0] * x + glow[1] * y + 20 * edge[0] * edge[1]


@pytest.mark.parametrize("blur", [0.6, 1.3, 2.2])
@pytest.mark.parametrize("angles", [(0.1, 1.6), (0.4, 1.3), (-0.5, 0.6)])
def test_a_corner_of_the_model_is_found_exactly_whatever_the_glow(
    blur: float, angles: tuple[float, float]
) -> None:
    for at, glow in (((0.3, -0.4), (0.0, 0.0)), ((-0.45, 0.2), (6.0, -3.0)), ((0.1, 0.49), (-9.0, 5.0))):
        image = _corner(at, angles, blur, glow).astype(np.float32)
        start = np.array([[HALF_PX, HALF_PX]], float)
        xy, height = fit_corners(image, start, np.array([angles]) + 0.1, np.array([7.0]))
        np.testing.assert_allclose(xy[0] - HALF_PX, at, atol=2e-3)
        np.testing.assert_allclose(height, 20, rtol=0.01)


def test_the_glow_moves_the_saddle_point_but_not_the_fit() -> None:
    image = _corner((0, 0), (0.0, np.pi / 2), 1.5, (2.0, 0.0)).astype(np.float32)
    start = np.array([[HALF_PX, HALF_PX]], float)
    saddle, good = Surface(image, 1.0).saddles_from(start, 3.0)
    assert good.all()
    assert np.hypot(*(saddle.xy - start).T)[0] > 0.1
    fitted, _ = fit_corners(image, start, np.array([[0.0, np.pi / 2]]), np.array([7.0]))
    assert np.hypot(*(fitted - start).T)[0] < 1e-3


def test_the_fit_is_the_least_squares_solution_that_scipy_finds() -> None:
    rng = np.random.default_rng(3)
    image = (_corner((0.2, -0.3), (0.2, 1.5), 1.2, (1.0, 1.0)) + rng.normal(0, 3, (25, 25))).astype(
        np.float32
    )
    radius = 6.0
    y, x = np.mgrid[-HALF_PX : HALF_PX + 1, -HALF_PX : HALF_PX + 1]
    weight = np.maximum(1 - (x**2 + y**2) / radius**2, 0)

    def rest(p: Floats) -> Floats:
        dx, dy = x - p[0], y - p[1]
        edge = [erf((np.cos(a) * dy - np.sin(a) * dx) / (np.sqrt(2) * np.exp(p[4]))) for a in p[2:4]]
        return (weight * (p[5] + p[6] * x + p[7] * y + p[8] * edge[0] * edge[1] - image)).ravel()

    truth = least_squares(rest, [0, 0, 0.2, 1.5, 0.2, 100, 0, 0, 10]).x
    xy, height = fit_corners(image, np.full((1, 2), 12.0), np.array([[0.2, 1.5]]), np.array([radius]))
    np.testing.assert_allclose(xy[0] - HALF_PX, truth[:2], atol=3e-3)
    np.testing.assert_allclose(height[0], truth[8], rtol=0.01)


def test_a_fit_that_runs_away_or_starts_outside_is_nan_or_inside() -> None:
    flat = np.random.default_rng(0).normal(0, 1, (40, 40)).astype(np.float32)
    flat[:, 20:] += 500  # an edge, no corner
    start = np.array([[20.0, 20.0], [-5.0, 3.0], [200.0, 100.0]])
    xy, height = fit_corners(flat, start, np.tile([0.0, 1.5], (3, 1)), np.full(3, 5.0))
    gone = np.isnan(xy).all(1)
    assert (gone == np.isnan(height)).all()
    assert (np.abs(xy[~gone] - np.clip(start, 0, 39)[~gone]) <= 5 / 3 + 1e-9).all()
    empty, none = fit_corners(flat, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    assert empty.shape == (0, 2)
    assert none.shape == (0,)


@pytest.mark.parametrize("invert", [False, True])
def test_saddles_are_the_corners_and_tell_where_it_is_bright(invert: bool) -> None:
    y, x = np.mgrid[:96, :120]
    dark = ((x + 0.5) // 24 + (y + 0.5) // 24) % 2  # corners at 23.5, 47.5, ...
    image = cv2.GaussianBlur(((1 - dark) if invert else dark).astype(np.float32) * 50 + 20, (0, 0), 0.8)
    found = find_saddles(Surface(normalised(image), 1.5), 3.5)
    truth = {(23.5 + 24 * i, 23.5 + 24 * j) for i in range(4) for j in range(3)}
    assert {tuple(p) for p in np.round(2 * found.xy) / 2} == truth
    np.testing.assert_allclose(
        found.half, np.pi / 4, atol=0.2
    )  # edges lie 45 degrees from the bright diagonal
    way = 5 * np.stack([np.cos(found.bright), np.sin(found.bright)], 1)
    across = way[:, ::-1] * (-1, 1)
    assert (look_up(image, found.xy + way) > look_up(image, found.xy + across)).all()


def test_normalisation_takes_off_glow_and_gain_and_leaves_the_input() -> None:
    rng = np.random.default_rng(1)
    pattern = rng.normal(0, 30, (120, 160))
    pattern = cv2.GaussianBlur(pattern, (0, 0), 2)
    y, x = np.mgrid[:120, :160]
    glow = 20000 + 30.0 * x + 20 * y
    counts = np.round(glow + 40 * pattern).astype(np.uint16)
    before = counts.copy()
    one, two = normalised(counts), normalised(40 * pattern)
    assert (counts == before).all()
    assert np.corrcoef(one[20:-20, 20:-20].ravel(), two[20:-20, 20:-20].ravel())[0, 1] > 0.99
    assert np.abs(normalised(np.full((80, 90), 7, np.uint8))).max() < 1e-3


def test_look_up_is_bilinear_for_any_shape() -> None:
    image = np.arange(12, dtype=np.float32).reshape(3, 4)
    at = np.array([[[0.0, 0.0], [1.5, 0.5]], [[3.0, 2.0], [9.0, 9.0]]])
    np.testing.assert_allclose(look_up(image, at), [[0, 3.5], [11, 11]], atol=0.02)
    assert look_up(image, np.zeros((0, 2))).shape == (0,)
    many = np.zeros((40000, 2))
    assert (look_up(image + 1, many) == 1).all()


def test_only_where_four_squares_meet_does_a_ring_alternate() -> None:
    y, x = np.mgrid[-HALF_PX : HALF_PX + 1, -HALF_PX : HALF_PX + 1]
    shapes = {
        "four squares": (x > 0) ^ (y > 0),
        "an edge": x > 0,
        "the corner of one square": (x > 0) & (y > 0),
        "a line": np.abs(x) < 2,
        "six wedges": np.floor(np.arctan2(y, x) / (np.pi / 3)) % 2 > 0,
    }
    middle = np.full((1, 2), float(HALF_PX))
    seen = {
        name: bool(alternates(Surface(shape.astype(np.float32), 1.0), middle + 0.2, 4.0)[0])
        for name, shape in shapes.items()
    }
    assert seen == {name: name == "four squares" for name in shapes}
