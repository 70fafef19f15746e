"""Depth guided by a picture: against a dense solve, and on scenes whose colours tell the depth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fusion.errors import FrameError
from fusion.lidar.guided import FLOOR, SIGMA, guided
from fusion.lidar.sparse import SparseDepth


def samples_of(u, v, value, size_wh):
    u, v = np.asarray(u, np.float64), np.asarray(v, np.float64)
    return SparseDepth(size_wh, u, v, np.asarray(value, np.float32), "depth", np.arange(len(u)))


def drawn(truth, count, seed=0):
    rng = np.random.default_rng(seed)
    h, w = truth.shape
    at = rng.permutation(h * w)[:count]
    return samples_of(at % w, at // w, truth.ravel()[at], (w, h))


def three_surfaces(h=96, w=128):
    """Left 3 m and dark, right 9 m and bright, a red disc at 1.5 m: grey values by depth."""
    v, u = np.mgrid[:h, :w]
    truth = np.where(u < w // 2, 3.0, 9.0)
    disc = (u - 60) ** 2 + (v - 40) ** 2 < 20**2
    truth[disc] = 1.5
    bgr = np.repeat(np.where(u < w // 2, 40, 200)[..., None], 3, 2).astype(np.uint8)
    bgr[disc] = (20, 20, 180)
    return truth, bgr


def test_surfaces_of_one_colour_get_their_depth():
    truth, bgr = three_surfaces()
    got = guided(drawn(truth, 40), bgr)
    off = np.abs(got / truth - 1)
    assert got.dtype == np.float32
    assert got.shape == truth.shape
    assert (off < 0.03).mean() > 0.9  # the rest: pixels of the half-size picture that an edge runs through
    plain = np.abs(guided(drawn(truth, 40), np.zeros_like(bgr)) / truth - 1)
    assert (plain < 0.03).mean() < 0.7


def test_as_a_dense_solve():
    rng = np.random.default_rng(4)
    h, w = 8, 10
    bgr = np.repeat(np.repeat(rng.integers(0, 60, (4, 5, 3)), 2, 0), 2, 1).astype(np.uint8)
    cells = rng.permutation(20)[:6]
    u, v = 2 * (cells % 5) + 0.5, 2 * (cells // 5) + 0.5  # the centres of 2 x 2 blocks
    value = rng.uniform(1, 20, 6)
    small = bgr[::2, ::2].reshape(-1, 3).astype(float)
    A, b = np.zeros((20, 20)), np.zeros(20)
    for i in range(20):
        for j in [i + 1] * (i % 5 < 4) + [i + 5] * (i < 15):
            weight = np.exp(-np.sum((small[i] - small[j]) ** 2) / (2 * SIGMA**2)) + FLOOR
            A[i, i] += weight
            A[j, j] += weight
            A[i, j] -= weight
            A[j, i] -= weight
    A[cells, cells] += 1
    b[cells] = np.log(value.astype(np.float32))
    expected = np.exp(np.linalg.solve(A, b)).reshape(4, 5)
    got = guided(samples_of(u, v, value, (w, h)), bgr)
    # The centre of a block lies between its four pixels.
    logs = np.log(got)
    middle = (logs[::2, ::2] + logs[1::2, ::2] + logs[::2, 1::2] + logs[1::2, 1::2]) / 4
    inner = np.log(expected)
    padded = np.pad(inner, 1, "edge")
    blurred = sum(
        np.array([0.125, 0.75, 0.125])[i] * np.array([0.125, 0.75, 0.125])[j] * padded[i : i + 4, j : j + 5]
        for i in range(3)
        for j in range(3)
    )
    np.testing.assert_allclose(middle, blurred, atol=2e-5)


def test_one_sample_is_everywhere():
    bgr = np.random.default_rng(0).integers(0, 255, (30, 41, 3)).astype(np.uint8)
    np.testing.assert_allclose(guided(samples_of([7.3], [29.4], [4.5], (41, 30)), bgr), 4.5, rtol=1e-5)


def test_no_sample():
    assert not guided(samples_of([], [], [], (41, 30)), np.zeros((30, 41, 3), np.uint8)).any()


@pytest.mark.parametrize("size_wh", [(1, 1), (1, 9), (9, 1), (3, 2)])
def test_small_pictures(size_wh):
    w, h = size_wh
    got = guided(samples_of([0, w - 0.6], [0, h - 0.6], [2, 8], size_wh), np.zeros((h, w, 3), np.uint8))
    assert got.shape == (h, w)
    assert got.min() >= 2 * 0.9999
    assert got.max() <= 8 * 1.0001


def test_values_stay_between_the_samples():
    truth, bgr = three_surfaces()
    got = guided(drawn(truth, 5, seed=3), bgr)
    values = drawn(truth, 5, seed=3).value_m
    assert got.min() >= values.min() * 0.9999
    assert got.max() <= values.max() * 1.0001


def test_many_samples_in_one_pixel():
    got = guided(samples_of([4.0] * 50, [4.0] * 50, [3.0] * 50, (12, 12)), np.zeros((12, 12, 3), np.uint8))
    np.testing.assert_allclose(got, 3, rtol=1e-5)


def test_a_picture_of_another_size():
    samples = samples_of([1.0], [1.0], [1.0], (12, 9))
    with pytest.raises(FrameError, match=r"9x12 pixels, the samples 12x9 \(give the picture"):
        guided(samples, np.zeros((12, 9, 3), np.uint8))
    wrong: list[Any] = [np.zeros((9, 12), np.uint8), np.zeros((9, 12, 3))]
    for guide in wrong:
        with pytest.raises(ValueError, match="HxWx3 uint8"):
            guided(samples, guide)


def test_nothing_is_changed():
    truth, bgr = three_surfaces()
    samples, before = drawn(truth, 20), bgr.copy()
    value = samples.value_m.copy()
    guided(samples, bgr)
    np.testing.assert_array_equal(bgr, before)
    np.testing.assert_array_equal(samples.value_m, value)


def test_an_indoor_scene(shared_data):
    """The gate of the issue, 1.77 m with 1000 samples; and better than without the picture."""
    import cv2

    folder = shared_data / "depth_dense"
    truth, given = np.load(folder / "gt.npy"), np.load(folder / "sparse_1000.npy")
    bgr = cv2.imread(str(folder / "image.png"))
    assert bgr is not None
    v, u = np.nonzero(given)
    samples = samples_of(u, v, given[v, u], given.shape[::-1])
    known = truth > 0

    def rmse(guide):
        return np.sqrt(np.mean((guided(samples, guide) - truth)[known] ** 2))

    with_picture = rmse(np.asarray(bgr, np.uint8))
    assert with_picture <= 1.77
    assert with_picture < rmse(np.zeros_like(bgr, np.uint8))
