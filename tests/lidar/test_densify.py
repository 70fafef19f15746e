"""What holds for every method: gaps, hull, limits, support, extrapolation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay, KDTree

from fusion.errors import FrameError, UsageError
from fusion.lidar.densify import DENSIFIERS, GAP_OF_SPACING, Demand, densifier, densify
from fusion.lidar.project import FARTHEST_M
from fusion.lidar.sparse import SparseDepth

W, H = 40, 30
METHODS = [name for name in DENSIFIERS if name != "guided"]


def samples(u: Any, v: Any, value_m: Any, size_wh: tuple[int, int] = (W, H)) -> SparseDepth:
    u, v = np.asarray(u, np.float64), np.asarray(v, np.float64)
    index = np.arange(len(u), dtype=np.int64)
    return SparseDepth(size_wh, u, v, np.asarray(value_m, np.float32), "depth", index)


def spread(count: int = 60, seed: int = 0) -> SparseDepth:
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(4, W - 5, count), rng.uniform(4, H - 5, count)
    return samples(u, v, 1 / (0.2 + 0.002 * u + 0.003 * v))


def distance_px(sparse: SparseDepth) -> NDArray[np.float64]:
    """From every pixel to the nearest pixel that holds a sample, by search."""
    held = np.stack([np.floor(sparse.u + 0.5), np.floor(sparse.v + 0.5)], -1)
    pixels = np.stack(np.meshgrid(np.arange(W), np.arange(H)), -1).reshape(-1, 2)
    return KDTree(held).query(pixels)[0].reshape(H, W)


def guide() -> NDArray[np.uint8]:
    return np.full((H, W, 3), 90, np.uint8)


def demand(method: str, **asked: Any) -> Demand:
    return Demand(guide_bgr=guide() if method == "guided" else None, **asked)


@pytest.mark.parametrize("method", DENSIFIERS)
def test_support_is_where_samples_stand_behind_a_value(method: str) -> None:
    sparse = spread()
    dense = densify(sparse, method, demand(method, max_gap_px=3.0))
    assert dense.value_m.shape == (H, W)
    assert dense.value == "depth"
    np.testing.assert_array_equal(dense.support, dense.value_m > 0)
    assert distance_px(sparse)[dense.support].max() <= 3.0 + 1e-4
    near = np.stack([np.floor(sparse.u + 0.5), np.floor(sparse.v + 0.5)], -1).astype(int)
    corners = near[ConvexHull(near).vertices]
    inside = Delaunay(corners).find_simplex(np.stack(np.nonzero(dense.support)[::-1], -1)) >= 0
    outside = np.count_nonzero(~inside)  # a pixel may touch the hull without its centre lying in it
    assert outside <= len(corners) * 4
    if method != "scan":
        assert (
            dense.support[H // 2 - 4 : H // 2 + 4].sum()
            > 0.5 * (distance_px(sparse) <= 3)[H // 2 - 4 : H // 2 + 4].sum()
        )


@pytest.mark.parametrize("method", METHODS)
def test_values_lie_within_those_of_the_samples(method: str) -> None:
    sparse = spread()
    value = densify(sparse, method).value_m
    assert value[value > 0].min() >= 0.8 * sparse.value_m.min()
    assert value.max() <= 1.2 * sparse.value_m.max()


def test_the_default_gap_follows_the_spacing() -> None:
    """That of the pixels inside the hull: here a crowd, and one sample far from it."""
    rng = np.random.default_rng(0)
    u, v = rng.uniform(2, 20, 300), rng.uniform(2, 28, 300)
    far = samples([*u, W - 1.4], [*v, H / 2], np.full(301, 5.0))
    away = distance_px(far)
    dense = densify(far, "linear")
    everywhere = densify(far, "linear", Demand(max_gap_px=1e9))
    gap = GAP_OF_SPACING * float(np.median(away[everywhere.support]))
    assert gap < away[everywhere.support].max()
    np.testing.assert_array_equal(dense.support, everywhere.support & (away <= gap + 1e-4))


@pytest.mark.parametrize("method", METHODS)
def test_limits_hold_for_what_is_filled_in(method: str) -> None:
    sparse = spread()
    lo, hi = (float(x) for x in np.quantile(sparse.value_m, [0.3, 0.7]))
    dense = densify(sparse, method, Demand(limits_m=(lo, hi)))
    value = dense.value_m[dense.support]
    assert len(value)
    assert value.min() >= lo
    assert value.max() <= hi


@pytest.mark.parametrize("method", METHODS)
def test_nearest_extrapolation_fills_all_and_leaves_the_support_alone(method: str) -> None:
    sparse = spread()
    plain, full = densify(sparse, method), densify(sparse, method, Demand(extrapolate="nearest"))
    np.testing.assert_array_equal(plain.support, full.support)
    np.testing.assert_array_equal(plain.value_m[plain.support], full.value_m[plain.support])
    assert (full.value_m > 0).all()
    beyond = np.argwhere(~full.support)
    _, nearest = KDTree(np.stack([sparse.v, sparse.u], -1)).query(beyond)
    np.testing.assert_array_equal(full.value_m[~full.support], sparse.value_m[nearest])


@pytest.mark.parametrize("method", ["linear", "natural"])
def test_linear_extrapolation_goes_on_with_a_plane(method: str) -> None:
    rng = np.random.default_rng(1)
    u, v = rng.uniform(10, 30, 80), rng.uniform(8, 22, 80)
    sparse = samples(u, v, 3 + 0.05 * u + 0.04 * v)
    full = densify(sparse, method, Demand(extrapolate="linear", max_gap_px=1e9))
    vv, uu = np.mgrid[:H, :W]
    np.testing.assert_allclose(full.value_m, 3 + 0.05 * uu + 0.04 * vv, atol=1e-5)
    hull = Delaunay(np.stack([u, v], -1)).find_simplex(np.stack([uu, vv], -1)) >= 0
    np.testing.assert_array_equal(full.support, hull)


@pytest.mark.parametrize("method", ["plane", "scan", "natural-discrete", "guided"])
def test_methods_without_slopes_refuse_to_extrapolate_linearly(method: str) -> None:
    with pytest.raises(UsageError, match="--extrapolate"):
        densify(spread(), method, demand(method, extrapolate="linear"))


@pytest.mark.parametrize(("u", "v"), [(0.0, 0.0), (-0.5, -0.5), (np.nextafter(W - 0.5, 0), H - 0.51)])
@pytest.mark.parametrize("method", ["plane", "natural-discrete", "scan"])
def test_a_single_sample_is_kept_in_every_corner(method: str, u: float, v: float) -> None:
    dense = densify(samples([u], [v], [4.0]), method)
    assert np.argwhere(dense.support).tolist() == [[int(np.floor(v + 0.5)), int(np.floor(u + 0.5))]]
    assert dense.value_m[dense.support] == pytest.approx(4)


@pytest.mark.parametrize("method", METHODS)
def test_samples_on_one_line_give_their_line_or_a_refusal(method: str) -> None:
    sparse = samples(np.arange(5, 35, 2), np.full(15, 10), np.full(15, 3.0))
    if method in ("linear", "natural"):
        with pytest.raises(FrameError, match="one line"):
            densify(sparse, method)
        return
    dense = densify(sparse, method)
    rows = np.unique(np.nonzero(dense.support)[0])
    assert rows.tolist() in ([10], [])
    np.testing.assert_allclose(dense.value_m[dense.support], 3, rtol=1e-5)


def test_the_farthest_value_that_a_file_holds_is_kept() -> None:
    rng = np.random.default_rng(3)
    sparse = samples(rng.uniform(0, W - 1, 50), rng.uniform(0, H - 1, 50), np.full(50, FARTHEST_M))
    assert densify(sparse, "nearest").support.mean() > 0.5


def test_more_samples_than_can_be_triangulated_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion.lidar.densify.MOST_TRIANGULATED", 59)
    for method in ("linear", "natural"):
        with pytest.raises(FrameError, match=r"60 samples are too many.*--voxel"):
            densify(spread(60), method)
    assert densify(spread(60), "nearest").support.any()
    assert densify(spread(59), "linear").support.any()


def test_no_sample_and_no_such_method() -> None:
    with pytest.raises(FrameError, match="no sample"):
        densify(samples([], [], []), "nearest")
    with pytest.raises(UsageError, match=r"unknown method 'poisson' \(one of: plane, plane-fast, natural"):
        densifier("poisson")
    with pytest.raises(UsageError, match="--guide"):
        densify(spread(), "guided")


@pytest.mark.parametrize("method", METHODS)
def test_threads_change_nothing_and_the_samples_stay_as_they_were(method: str) -> None:
    sparse = spread()
    before = [a.copy() for a in (sparse.u, sparse.v, sparse.value_m)]
    one, two = (densify(sparse, method, Demand(threads=n)).value_m for n in (1, 2))
    np.testing.assert_array_equal(one, two)
    for a, b in zip(before, (sparse.u, sparse.v, sparse.value_m), strict=True):
        np.testing.assert_array_equal(a, b)
