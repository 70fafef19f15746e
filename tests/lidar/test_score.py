from __future__ import annotations

import numpy as np
import pytest

from fusion.lidar.score import Score, fill_background, mean_score, score


def test_errors_by_hand() -> None:
    truth = np.array([[10.0, 20.0, 0.0, 40.0]], np.float32)
    depth = np.array([[11.0, 18.0, 7.0, 0.0]], np.float32)
    got = score(depth, truth)
    assert got.count == 2
    assert got.coverage == pytest.approx(2 / 3)
    assert got.rmse_mm == pytest.approx(1000 * np.sqrt((1 + 4) / 2))
    assert got.mae_mm == pytest.approx(1500)
    inverse = np.array([1000 / 11 - 100, 1000 / 18 - 50])
    assert got.irmse_1_km == pytest.approx(np.sqrt((inverse**2).mean()))
    assert got.imae_1_km == pytest.approx(np.abs(inverse).mean())


def test_sums_do_not_lose_small_errors() -> None:
    truth = np.full((1000, 1000), 80, np.float32)
    depth = truth.copy()
    depth[0, 0] += 0.5
    assert score(depth, truth).mae_mm == pytest.approx(500 / 1e6, rel=1e-12)


def test_none_is_zero_negative_or_not_finite() -> None:
    truth = np.array([[5.0, 5.0, 5.0, 5.0, 5.0]])
    got = score(np.array([[5.0, 0.0, -1.0, np.nan, np.inf]]), truth)
    assert (got.count, got.coverage, got.rmse_mm) == (1, 0.2, 0.0)


def test_nothing_in_common() -> None:
    got = score(np.zeros((2, 2)), np.ones((2, 2)))
    assert got.count == 0
    assert got.coverage == 0
    assert np.isnan([got.rmse_mm, got.mae_mm, got.irmse_1_km, got.imae_1_km]).all()
    assert score(np.ones((2, 2)), np.zeros((2, 2))).coverage == 0


def test_shapes_must_agree() -> None:
    with pytest.raises(ValueError, match="one shape"):
        score(np.ones((2, 3)), np.ones((3, 2)))


def test_missing_pixels_filled_as_the_benchmark_does() -> None:
    truth, depth = np.full((1, 3), 10.0), np.array([[12.0, 0.0, 9.0]])
    got = score(depth, truth, fill_missing=True)
    assert got.count == 3
    assert got.coverage == pytest.approx(2 / 3)
    assert got.mae_mm == pytest.approx(1000 * (2 + 1 + 1) / 3)


def test_background_by_a_loop_over_pixels() -> None:
    rng = np.random.default_rng(4)
    for _ in range(50):
        shape = tuple(rng.integers(1, 8, 2))
        depth = np.where(rng.random(shape) < 0.3, rng.integers(1, 50, shape), 0).astype(np.float32)
        np.testing.assert_array_equal(fill_background(depth), _slow_background(depth))


def _slow_background(depth: np.ndarray) -> np.ndarray:
    full = depth.copy()
    for y, row in enumerate(depth):
        for x in np.flatnonzero(row == 0):
            ends = [*row[:x][row[:x] > 0][-1:], *row[x + 1 :][row[x + 1 :] > 0][:1]]
            full[y, x] = min(ends, default=0)
    rows = [y for y in range(len(depth)) if (depth[y] > 0).any()]
    for y in range(len(depth)):
        if rows and y not in rows:
            full[y] = full[max([r for r in rows if r < y], default=rows[0])]
    return full


def test_mean_counts_images_alike() -> None:
    mean = mean_score([Score(1, 2, 3, 4, 1.0, 10), Score(3, 4, 5, 6, 0.5, 1000)])
    assert mean == Score(2, 3, 4, 5, 0.75, 1010)


def test_mean_leaves_empty_images_to_the_coverage() -> None:
    nan = float("nan")
    assert mean_score([Score(1, 2, 3, 4, 1.0, 10), Score(nan, nan, nan, nan, 0.0, 0)]) == Score(
        1, 2, 3, 4, 0.5, 10
    )
    with pytest.raises(ValueError, match="at least one"):
        mean_score([])
