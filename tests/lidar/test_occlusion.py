from __future__ import annotations

from math import ceil
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.lidar.occlusion import COLUMNS, ROWS, occluded, spacing_px, visible_in_scan
from fusion.lidar.project import from_image, z_buffer
from fusion.lidar.sparse import SparseDepth

Floats = NDArray[np.float64]


def _sparse(u: Floats, v: Floats, value: Floats, size_wh: tuple[int, int]) -> SparseDepth:
    return SparseDepth(size_wh, u, v, value.astype(np.float32), "depth", np.arange(len(u)))


def test_nothing_hides_an_empty_or_single_sample() -> None:
    none = np.zeros(0)
    assert occluded(_sparse(none, none, none, (4, 3))).shape == (0,)
    assert not occluded(_sparse(np.ones(1), np.ones(1), np.ones(1), (4, 3))).any()


def _rings(columns: int, rows: int, size_wh: tuple[int, int]) -> NDArray[np.float32]:
    image = np.zeros(size_wh[::-1], np.float32)
    image[::rows, ::columns] = 10
    return image


def test_spacing_of_rings_and_columns() -> None:
    spacing = spacing_px(from_image(_rings(3, 8, (300, 200))))
    assert (spacing.x, spacing.y) == (3, 8)


def test_spacing_is_even_where_samples_are_far_apart() -> None:
    image = _rings(150, 150, (600, 600))
    assert spacing_px(from_image(image)) == pytest.approx((150, 150))


def _slow(sparse: SparseDepth) -> NDArray[np.bool_]:
    image, spacing = z_buffer(sparse), spacing_px(sparse)
    reach_x, reach_y = ceil(COLUMNS * spacing.x), ceil(ROWS * spacing.y)
    rows, columns = np.nonzero(image)
    hidden = []
    for u, v, z in zip(np.rint(sparse.u), np.rint(sparse.v), sparse.value_m, strict=True):
        near = (abs(columns - u) <= reach_x) & (abs(rows - v) <= reach_y)
        near &= image[rows, columns] < z - (0.3 + 0.05 * z)
        left, right, above = near & (columns < u), near & (columns > u), near & (rows < v)
        hidden.append(left.any() and right.any() and above.any())
    return np.array(hidden)


@pytest.mark.parametrize("seed", range(6))
def test_as_a_loop_over_all_pairs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, size = int(rng.integers(50, 500)), (60, 40)
    u, v = rng.uniform(-0.5, size[0] - 0.5, n), rng.uniform(-0.5, size[1] - 0.5, n)
    sparse = _sparse(u, v, rng.uniform(2, 12, n), size)
    kept = [a.copy() for a in (sparse.u, sparse.v, sparse.value_m)]
    got = occluded(sparse)
    np.testing.assert_array_equal(got, _slow(sparse))
    assert got.any()
    assert not got.all()
    for before, after in zip(kept, (sparse.u, sparse.v, sparse.value_m), strict=True):
        np.testing.assert_array_equal(before, after)


def _two_layers(rings: int) -> tuple[SparseDepth, NDArray[np.bool_]]:
    """A slanted board 8 m away before a wall at 25 m, scanned from 0.3 m above the camera; what it hides."""
    elevation = np.radians(np.linspace(-12, 3, rings))
    azimuth = np.radians(np.arange(-35, 35, 0.18))
    e, a = (grid.ravel() for grid in np.meshgrid(elevation, azimuth, indexing="ij"))
    rays = np.stack([np.tan(a), -np.tan(e) / np.cos(a), np.ones_like(a)])  # camera axes, depth 1
    origin = np.array([0.0, -0.3, 0.0])[:, None]
    xyz = np.where(_on_board(origin, rays), origin + _board_m(rays) * rays, origin + 25 * rays)
    focal, size = 700.0, (900, 300)
    u, v = focal * xyz[0] / xyz[2] + 449.5, focal * xyz[1] / xyz[2] + 149.5
    inside = (u > -0.5) & (u < size[0] - 0.5) & (v > -0.5) & (v < size[1] - 0.5)
    hidden = (xyz[2] == 25) & _on_board(0 * origin, xyz / 25)
    return _sparse(u[inside], v[inside], xyz[2][inside], size), hidden[inside]


def _board_m(rays: Floats) -> Floats:
    return 8 / (1 - 0.5 * rays[0])


def _on_board(origin: Floats, rays: Floats) -> NDArray[np.bool_]:
    x, y, _ = origin + _board_m(rays) * rays
    return (abs(x) < 1.5) & (abs(y - 0.4) < 0.9)


@pytest.mark.parametrize("rings", [64, 32])
def test_what_a_board_hides_from_the_camera(rings: int) -> None:
    sparse, hidden = _two_layers(rings)
    found = occluded(sparse)
    assert hidden.sum() > 100
    assert (found & hidden).sum() >= 0.55 * hidden.sum()
    assert (found & hidden).sum() >= 0.98 * found.sum()


def test_what_stands_free_is_kept() -> None:
    image = _rings(3, 5, (300, 200))
    image[image > 0] = 25
    image[:, 150:][image[:, 150:] > 0] = 8  # a wall's vertical edge hides nothing beside it
    assert visible_in_scan(image)[image > 0].all()


def test_kitti_loses_few_samples_most_of_them_wrong(shared_data: Path) -> None:
    for path in sorted((shared_data / "kitti_depth" / "velodyne_raw").glob("*.png")):
        sparse_m, truth_m = (
            np.asarray(np.asarray(cv2.imread(str(p), cv2.IMREAD_UNCHANGED)) / 256, np.float32)
            for p in (path, path.parents[1] / "groundtruth" / path.name)
        )
        seen = visible_in_scan(sparse_m)
        known = (sparse_m > 0) & (truth_m > 0)
        wrong = known & (sparse_m > 1.05 * truth_m + 0.3)
        taken = known & ~seen
        assert 0 < (sparse_m > 0).sum() - seen.sum() < 0.02 * (sparse_m > 0).sum()
        assert wrong[taken].mean() > 20 * wrong[known & seen].mean()
