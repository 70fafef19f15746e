"""Maps fitted to matched spots, against maps that made them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calib.align.models import Matches, corner_gap, fit, justified, project, robust_fit

SIMILARITY = np.array([[1.1, -0.2, 5.0], [0.2, 1.1, -3.0], [0, 0, 1]])
AFFINE = np.array([[1.1, -0.1, 5.0], [0.25, 0.95, -3.0], [0, 0, 1]])
HOMOGRAPHY = np.array([[1.1, -0.1, 5.0], [0.25, 0.95, -3.0], [2e-4, -3e-4, 1]])
KINDS = [("similarity", SIMILARITY), ("affine", AFFINE), ("homography", HOMOGRAPHY)]


def _matches(H: np.ndarray, noise_px: float, seed: int = 0, count: int = 600) -> Matches:
    rng = np.random.default_rng(seed)
    fir = rng.uniform([0, 0], [640, 480], (count, 2))
    rgb = cv2.perspectiveTransform(fir[None], H)[0] + rng.normal(0, noise_px, (count, 2))
    return Matches(rgb, fir, np.ones(count))


@pytest.mark.parametrize(("model", "H"), KINDS)
def test_exact_points_give_back_their_map(model, H):
    matches = _matches(H, 0)
    found = fit(matches.fir_xy, matches.rgb_xy, matches.weight, model)
    np.testing.assert_allclose(found, H, atol=1e-9)


def test_projects_as_opencv_does():
    xy = np.array([[0.0, 0], [639, 0], [17.5, 400.25]])
    np.testing.assert_allclose(project(HOMOGRAPHY, xy), cv2.perspectiveTransform(xy[None], HOMOGRAPHY)[0])


def test_corner_gap_of_a_shift_is_its_length():
    assert corner_gap(np.array([[1, 0, 3.0], [0, 1, 4], [0, 0, 1]]), np.eye(3), (480, 640)) == pytest.approx(
        5
    )


@pytest.mark.parametrize(("model", "H"), KINDS)
def test_a_third_of_wild_matches_moves_the_map_by_less_than_a_pixel(model, H):
    good = _matches(H, 0.5)
    rgb = good.rgb_xy.copy()
    rgb[::3] += np.random.default_rng(1).uniform(-60, 60, rgb[::3].shape)
    found = robust_fit(Matches(rgb, good.fir_xy, good.weight), model, 2.0)
    # 400 good matches of 0.5 px: 0.5 * sqrt(8 / 400) is 0.07 px on the average, some times that at a corner.
    assert corner_gap(found, H, (480, 640)) < 0.6


def test_matches_of_no_weight_do_not_count():
    good = _matches(SIMILARITY, 0)
    rgb, weight = good.rgb_xy.copy(), good.weight.copy()
    rgb[:200] += 1.0
    weight[:200] = 0
    found = robust_fit(Matches(rgb, good.fir_xy, weight), "similarity", 2.0)
    assert corner_gap(found, SIMILARITY, (480, 640)) < 1e-6


@pytest.mark.parametrize(("model", "H"), KINDS)
def test_the_smallest_map_that_explains_the_matches_is_taken(model, H):
    assert justified(_matches(H, 1.0, count=300), 2.0) == model


def test_few_matches_justify_no_more_than_a_similarity():
    assert justified(_matches(HOMOGRAPHY, 0.1, count=40), 2.0) == "similarity"


def test_too_few_points_are_refused():
    three = Matches(np.eye(3, 2), np.eye(3, 2), np.ones(3))
    with pytest.raises(ValueError, match="3 matches determine no affine"):
        robust_fit(three, "affine", 1.0)
    with pytest.raises(ValueError, match="2 points determine no affine"):
        fit(np.eye(2), np.eye(2), np.ones(2), "affine")


def test_shapes_that_do_not_belong_together_are_refused():
    with pytest.raises(ValueError, match="expected"):
        Matches(np.zeros((3, 2)), np.zeros((2, 2)), np.ones(3))
