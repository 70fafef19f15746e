"""Blocks find a known shift to a fraction of a pixel; grids say where they lie; candidates overlap."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calib.align.blocks import agree, correlation, field_of, grid_for, on_grid, peaks
from calib.align.channels import Grey
from calib.align.models import project
from calib.align.search import candidates


def _scene(shape: tuple[int, int] = (160, 200), seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 1, shape)
    return cv2.GaussianBlur(noise, (0, 0), 3).astype(np.float32)


def _grey(pixels: np.ndarray) -> Grey:
    span = (pixels - pixels.min()) / np.ptp(pixels)
    return Grey(span.astype(np.float32), np.full(pixels.shape, 255, np.uint8))


SHIFT = np.array([[1, 0, 3.3], [0, 1, -1.4], [0, 0, 1]])  # thermal to RGB


def _pair() -> tuple[Grey, Grey]:
    scene = _scene()
    moved = cv2.warpPerspective(
        scene, SHIFT, (200, 160), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REFLECT
    )
    return _grey(scene), _grey(moved)


def test_blocks_move_by_the_shift_in_x_and_y():
    rgb, fir = _pair()
    grid = grid_for(np.eye(3), rgb.shape, fir.shape, 200)
    assert grid.size_wh == (200, 160)
    field = field_of(*on_grid(rgb, fir, np.eye(3), grid), 6)
    move, weight = peaks(field, np.zeros_like(field.at), 8.0)
    inner = (weight > 0) & (np.abs(field.at - [100, 80]) < [80, 60]).all(axis=1)
    assert inner.sum() > 100
    np.testing.assert_allclose(np.median(move[inner], axis=0), [3.3, -1.4], atol=0.1)


def test_the_map_that_blocks_agree_on_takes_thermal_to_rgb():
    rgb, fir = _pair()
    # A grid that enlarges a part of RGB: whatever it does to coordinates must cancel.
    start = np.array([[0.9, 0, 20.0], [0, 0.9, 10], [0, 0, 1]])
    part = Grey(rgb.pixels[8:, 6:].copy(), rgb.seen[8:, 6:].copy())
    cut = np.array([[1, 0, -6.0], [0, 1, -8], [0, 0, 1]])
    small = np.linalg.inv(start)  # the thermal image as a smaller camera would see it
    fir_small = Grey(
        cv2.warpPerspective(fir.pixels, start, (200, 160)), cv2.warpPerspective(fir.seen, start, (200, 160))
    )
    truth = cut @ SHIFT @ small
    nudged = np.array([[1, 0, 1.7], [0, 1, 2.2], [0, 0, 1]]) @ truth
    grid = grid_for(nudged, part.shape, fir_small.shape, 260)
    found = agree([field_of(*on_grid(part, fir_small, nudged, grid), 8)], "similarity", (8.0, 5.0, 3.0))
    H = np.linalg.inv(grid.matrix) @ found @ grid.matrix @ nudged
    spots = np.array([[60.0, 40], [150, 40], [150, 120], [60, 120]])
    np.testing.assert_allclose(project(H, spots), project(truth, spots), atol=0.35)


def test_a_grid_covers_its_rectangle_from_border_to_border():
    H = np.array([[0.5, 0, 30.0], [0, 0.5, 20], [0, 0, 1]])  # pixels 30 to 79.5 and 20 to 59.5 of RGB
    grid = grid_for(H, (160, 200), (80, 100), 26)
    ends = project(grid.matrix, np.array([[29.5, 19.5], [80.5, 60.5]]))
    np.testing.assert_allclose(ends, [[-0.5, -0.5], [grid.size_wh[0] - 0.5, grid.size_wh[1] - 0.5]])


def test_the_same_image_correlates_fully_and_another_does_not():
    rgb, _ = _pair()
    other = _grey(_scene(seed=7))
    grid = grid_for(np.eye(3), rgb.shape, rgb.shape, 200)
    assert correlation(*on_grid(rgb, rgb, np.eye(3), grid)) == pytest.approx(1)
    assert correlation(*on_grid(rgb, other, np.eye(3), grid)) < 0.2


def test_nothing_seen_by_both_moves_nothing():
    rgb, fir = _pair()
    blind = Grey(fir.pixels, np.zeros_like(fir.seen))
    grid = grid_for(np.eye(3), rgb.shape, fir.shape, 128)
    field = field_of(*on_grid(rgb, blind, np.eye(3), grid), 4)
    assert len(field.at) == 0
    np.testing.assert_array_equal(agree([field], "affine", (4.0,)), np.eye(3))


def test_candidates_overlap_and_exchange_with_the_images():
    rgb, fir = _pair()
    there, back = candidates([rgb], [fir], width=64), candidates([fir], [rgb], width=64)
    np.testing.assert_allclose(there[0].H_rgb_fir @ back[0].H_rgb_fir, np.eye(3), atol=1e-6)
    assert np.linalg.norm(there[0].H_rgb_fir[:2, 2] - SHIFT[:2, 2]) < 4  # within a pixel of the small grid
    for one in there:  # at least 0.45 of the smaller image is seen by both
        seen = cv2.warpPerspective(fir.seen, one.H_rgb_fir, (200, 160), flags=cv2.INTER_NEAREST)
        scale = min(1.0, float(np.linalg.det(one.H_rgb_fir[:2, :2])))
        assert np.count_nonzero(seen) >= 0.42 * 200 * 160 * scale
