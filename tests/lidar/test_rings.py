"""Rings: the file's own, from the order, from the elevation, and none where there are none."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.clouds import read_cloud
from fusion.frames import PointCloud
from fusion.lidar.rings import angular_spacing, rings_of

GENERATOR = np.random.default_rng(5)


def a_scan(
    rings=64, columns=512, ring_major=False, noise_m=0.02, drop=0.1, jitter_deg=0.0, wobble_deg=0.0, seed=0
):
    """A scan of a box-shaped room and the true ring of each point. Range noise moves points along their ray
    only.
    """
    rng = np.random.default_rng(seed)
    elevation = np.radians(np.linspace(-22.5, 15, rings))
    azimuth = np.radians(np.arange(columns) * 360 / columns)
    grid = np.meshgrid(np.arange(rings), np.arange(columns), indexing="ij")
    ring, column = (a.ravel() if ring_major else a.T.ravel() for a in grid)
    e = elevation[ring] + np.radians(jitter_deg) * rng.standard_normal(ring.size)
    e += np.radians(wobble_deg) * np.sin(azimuth[column])
    rays = np.stack([np.cos(e) * np.cos(azimuth[column]), np.cos(e) * np.sin(azimuth[column]), np.sin(e)], -1)
    with np.errstate(divide="ignore"):
        far = (np.where(rays > 0, (20, 4, 3), (10, 5, 1.5)) / np.abs(rays)).min(1)
    kept = rng.random(ring.size) >= drop
    xyz = rays * (far + noise_m * rng.standard_normal(far.size))[:, None]
    return PointCloud(xyz[kept].astype(np.float32)), ring[kept]


def shuffled(cloud, ring, seed=1):
    order = np.random.default_rng(seed).permutation(len(cloud))
    return PointCloud(cloud.xyz_m[order]), ring[order]


@pytest.mark.parametrize("rings", [16, 32, 64, 128])
@pytest.mark.parametrize("order", ["rings", "columns", "shuffled"])
def test_rings_are_recovered_in_any_order(rings, order):
    cloud, truth = a_scan(rings, ring_major=order == "rings", jitter_deg=0.01)
    if order == "shuffled":
        cloud, truth = shuffled(cloud, truth)
    found = rings_of(cloud)
    assert found is not None
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, truth)


@pytest.mark.parametrize(("rings", "jitter_deg"), [(16, 0.2), (32, 0.1), (64, 0.06), (128, 0.03)])
def test_shaking_beams_cost_few_points(rings, jitter_deg):
    cloud, truth = shuffled(*a_scan(rings, columns=1024, jitter_deg=jitter_deg))
    found = rings_of(cloud)
    assert found is not None
    assert found.max() == rings - 1
    assert np.mean(found == truth) > 0.995


@pytest.mark.parametrize("first_deg", [0, 40.6, 170])
def test_order_tells_rings_that_overlap_in_elevation(first_deg):
    # As KITTI's: a ring's elevation swings by more than the spacing, each ring begins where the last one
    # ended.
    cloud, truth = a_scan(64, columns=1800, ring_major=True, wobble_deg=0.6)
    turn = np.radians(first_deg)
    R = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    found = rings_of(PointCloud((cloud.xyz_m @ R.T).astype(np.float32)))
    assert found is not None
    assert found.max() == 63
    assert np.mean(found == truth) > 0.99
    assert rings_of(shuffled(cloud, truth)[0]) is None  # nothing left to tell them by


def test_the_other_sense_and_top_first():
    cloud, truth = a_scan(32, columns=900, ring_major=True, wobble_deg=1.0)
    found = rings_of(PointCloud(cloud.xyz_m[::-1].copy()))
    assert found is not None
    assert np.mean(found == truth[::-1]) > 0.99


def test_the_own_field_is_used_and_counted_from_below():
    cloud, truth = a_scan(16)
    scrambled = np.random.default_rng(2).permutation(16)
    for label in (truth, 15 - truth, 100 + 2 * truth, scrambled[truth]):
        found = rings_of(PointCloud(cloud.xyz_m, {"ring": label.astype(np.uint16)}))
        assert found is not None
        np.testing.assert_array_equal(found, truth)


def test_a_ring_in_the_sky_does_not_exchange_its_neighbours():
    # Ring 20's returns lie where it swings low: its median is below ring 19's, its label is not.
    cloud, truth = a_scan(32, columns=900, ring_major=True, wobble_deg=3.0, drop=0)
    kept = ~((cloud.xyz_m[:, 1] > 0) & (truth == 20))
    xyz, ring = cloud.xyz_m[kept], truth[kept]
    elevation = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
    assert np.median(elevation[ring == 20]) < np.median(elevation[ring == 19])
    np.testing.assert_array_equal(rings_of(PointCloud(xyz, {"ring": ring})), ring)
    np.testing.assert_array_equal(rings_of(PointCloud(xyz, {"ring": 31 - ring})), ring)


@pytest.mark.parametrize("field", [np.zeros, np.arange, lambda n: np.full(n, np.nan)])
def test_a_field_that_says_nothing_is_passed_over(field):
    cloud, truth = a_scan(16)
    np.testing.assert_array_equal(rings_of(PointCloud(cloud.xyz_m, {"ring": field(len(cloud))})), truth)


@pytest.mark.parametrize(
    "xyz",
    [
        GENERATOR.uniform(-10, 10, (20_000, 3)),
        GENERATOR.normal(0, 3, (500, 3)),
        np.floor(GENERATOR.uniform(-20, 20, (20_000, 3))) * 0.5 + 0.25,  # voxels
        np.ones((1, 3)),
        np.ones((50, 3)),
        np.zeros((0, 3)),
        np.linspace(1, 2, 30)[:, None] * (1, 2, 3),
        np.array([[0, 0, 1.0], [0, 0, 2.0], [0, 0, -1.0]]),
    ],
    ids=["volume", "few", "voxels", "one", "same", "none", "line", "poles"],
)
def test_clouds_without_rings(xyz):
    assert rings_of(PointCloud(xyz.astype(np.float32))) is None


def test_spacing():
    cloud, truth = a_scan(32, columns=720, drop=0.05)
    spacing = angular_spacing(cloud, truth.astype(np.int32))
    assert np.degrees(spacing.azimuth_rad) == pytest.approx(0.5, rel=1e-3)
    assert np.degrees(spacing.elevation_rad) == pytest.approx(37.5 / 31, rel=1e-3)
    lonely = angular_spacing(PointCloud(np.ones((1, 3), np.float32)), np.zeros(1, np.int32))
    assert np.isnan(lonely).all()


def test_nothing_is_changed():
    cloud, truth = a_scan(16, ring_major=True)
    label = truth.copy()
    xyz = cloud.xyz_m.copy()
    rings_of(PointCloud(cloud.xyz_m, {"ring": label}))
    rings_of(cloud)
    np.testing.assert_array_equal(label, truth)
    np.testing.assert_array_equal(cloud.xyz_m, xyz)


def test_kitti_has_64_rings(shared_data):
    xyz = (
        np.fromfile(shared_data / "kitti_object/velodyne/000000.bin", np.float32).reshape(-1, 4)[:, :3].copy()
    )
    found = rings_of(PointCloud(xyz))
    assert found is not None
    assert found.max() == 63
    count = np.bincount(found)
    assert count.min() > 1000
    # In the file the topmost comes first, and azimuth comes round to 0 where a ring ends.
    assert np.mean(np.diff(found) <= 0) > 0.999
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    seams = np.flatnonzero((azimuth[:-1] < 0) & (azimuth[1:] >= 0) & (azimuth[:-1] > -0.1))
    assert np.mean(found[seams] != found[seams + 1]) > 0.9


@pytest.mark.parametrize("name", ["1", "2"])
def test_recovery_agrees_with_the_file(shared_data, name):
    cloud = read_cloud(shared_data / "lidar_camera" / name / "calib.pcd")
    own = rings_of(cloud)
    np.testing.assert_array_equal(own, cloud.fields["ring"])
    np.testing.assert_array_equal(rings_of(PointCloud(cloud.xyz_m)), own)


def test_a_map_has_none(shared_data):
    assert rings_of(read_cloud(next((shared_data / "mine_lidar").glob("*.pcd")))) is None
