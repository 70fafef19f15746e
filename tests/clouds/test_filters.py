"""Crops against plain comparisons, voxels and outliers against Open3D and brute force."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fusion.clouds import crop_box, crop_range, statistical_outliers, voxel
from fusion.errors import UsageError
from fusion.frames import PointCloud
from fusion.open3d import load


def cloud(n: int = 500, dtype: str = "f4", seed: int = 0) -> PointCloud:
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 4, (n, 3)).astype(dtype)
    fields = {"intensity": rng.random(n), "ring": np.arange(n, dtype=np.int32)}
    return PointCloud(points, fields, "s", 7, n + 5, {"nan": 5})


def frozen(source: PointCloud) -> PointCloud:
    for array in (source.xyz_m, *source.fields.values()):
        array.flags.writeable = False
    return source


def check_kept(source: PointCloud, result: PointCloud, keep: np.ndarray, why: str) -> None:
    np.testing.assert_array_equal(result.xyz_m, source.xyz_m[keep])
    assert result.xyz_m.dtype == source.xyz_m.dtype
    for name, values in source.fields.items():
        np.testing.assert_array_equal(result.fields[name], values[keep])
    assert dict(result.dropped) == {"nan": 5, why: int((~keep).sum())}
    assert (result.read, result.stem, result.stamp_ns) == (source.read, "s", 7)


@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_crop_range(dtype: str) -> None:
    source = frozen(cloud(dtype=dtype))
    distance = np.linalg.norm(source.xyz_m.astype(np.float64), axis=1)
    check_kept(source, crop_range(source, 2, 7), (distance >= 2) & (distance < 7), "range")
    check_kept(source, crop_range(source), np.ones(500, bool), "range")


def test_ranges_are_half_open() -> None:
    source = PointCloud(np.array([[3, 4, 0], [0, 0, 10], [6, 8, 0.0]]))
    assert crop_range(source, 5, 10).xyz_m.tolist() == [[3, 4, 0]]
    assert crop_box(source, (3, 0, 0), (6, 9, 9)).xyz_m.tolist() == [[3, 4, 0]]


def test_crop_box() -> None:
    source = frozen(cloud())
    lo, hi = (-1, -2, -np.inf), (5, 3, 1.5)
    keep = np.array(
        [all(a <= v < b for a, v, b in zip(lo, point, hi, strict=True)) for point in source.xyz_m]
    )
    check_kept(source, crop_box(source, lo, hi), keep, "box")


def test_the_same_reason_twice_adds_up() -> None:
    once = crop_range(cloud(), 0, 6)
    twice = crop_range(once, 3, 6)
    assert twice.dropped["range"] == 500 - len(twice)


@pytest.mark.parametrize("size_m", [0.3, 1.0, 5.0, 100.0])
def test_voxels_are_open3ds(size_m: float) -> None:
    source = frozen(cloud(2000))
    result = voxel(source, size_m)
    o3d: Any = load()
    theirs = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(source.xyz_m.astype(np.float64)))
    theirs = np.asarray(theirs.voxel_down_sample(size_m).points)
    assert len(result) == len(theirs)
    np.testing.assert_allclose(ordered(result.xyz_m), ordered(theirs), atol=1e-5)
    assert dict(result.dropped) == {"nan": 5, "voxel": 2000 - len(result)}
    assert result.read == source.read


def ordered(points: np.ndarray) -> np.ndarray:
    return points[np.lexsort(np.round(points, 4).T)]


def test_voxels_keep_fields_of_the_point_nearest_to_the_mean() -> None:
    source = cloud(400)
    size_m = 1.5
    result = voxel(source, size_m)
    least = source.xyz_m.min(axis=0).astype(np.float64) - size_m / 2
    cells = [tuple(cell) for cell in np.floor((source.xyz_m - least) / size_m).astype(int)]
    for k, cell in enumerate(dict.fromkeys(cells)):  # in the order of their first points
        inside = np.array([i for i, other in enumerate(cells) if other == cell])
        mean = source.xyz_m[inside].astype(np.float64).mean(axis=0)
        np.testing.assert_allclose(result.xyz_m[k], mean, atol=1e-5)
        nearest = inside[np.argmin(((source.xyz_m[inside] - mean) ** 2).sum(axis=1))]
        assert result.fields["ring"][k] == source.fields["ring"][nearest]
        assert result.fields["intensity"][k] == source.fields["intensity"][nearest]
    assert result.fields["ring"].dtype == np.int32


def test_voxels_of_large_coordinates_keep_their_digits() -> None:
    points = np.array([[674_000.25, 5_400_000.5, 300.125], [674_000.75, 5_400_000.5, 300.125]])
    np.testing.assert_array_equal(voxel(PointCloud(points), 2.0).xyz_m, [[674_000.5, 5_400_000.5, 300.125]])


def test_stragglers_go_as_open3d_and_brute_force_say() -> None:
    source = frozen(cloud(300))
    points = source.xyz_m.astype(np.float64)
    distances = np.sort(np.linalg.norm(points[:, None] - points, axis=2), axis=1)[:, :10].mean(axis=1)
    keep = distances < distances.mean() + 1.5 * distances.std(ddof=1)
    assert 0 < (~keep).sum() < 60
    check_kept(source, statistical_outliers(source, 10, 1.5), keep, "outlier")


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_few_points_pass(n: int) -> None:
    source = PointCloud(np.arange(1.0, 3 * n + 1).reshape(n, 3), {"ring": np.arange(n)})
    for result in (
        voxel(source, 0.1),
        statistical_outliers(source),
        crop_range(source),
        crop_box(source, (-99,) * 3, (99,) * 3),
    ):
        np.testing.assert_array_equal(result.xyz_m, source.xyz_m)
        np.testing.assert_array_equal(result.fields["ring"], source.fields["ring"])


def test_arguments_that_cannot_be() -> None:
    source = cloud(10)
    for lo, hi in ((-1, 5), (5, 5), (6, 5), (np.nan, 5), (0, np.nan)):
        with pytest.raises(UsageError, match="a range from"):
            crop_range(source, lo, hi)
    for a, b in (((0, 0, 0), (1, 1, 0)), ((0, 0), (1, 1)), ((0, 0, np.nan), (1, 1, 1))):
        with pytest.raises(UsageError, match="a box from"):
            crop_box(source, a, b)
    for size_m in (0, -1, np.nan, np.inf):
        with pytest.raises(UsageError, match="voxels of"):
            voxel(source, size_m)
    with pytest.raises(UsageError, match="too many for the cloud's extent"):
        voxel(source, 1e-9)
    for neighbours, ratio in ((1, 2.0), (20, 0.0), (20, -1.0), (20, np.nan)):
        with pytest.raises(UsageError, match="neighbours"):
            statistical_outliers(source, neighbours, ratio)
