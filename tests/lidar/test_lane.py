"""From a cloud to a dense map: every point accounted for, and its cause when little is left."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.errors import FrameError, UsageError
from fusion.frames import PointCloud
from fusion.geometry import PinholeCamera, pose
from fusion.lidar.config import CloudConfig, DepthConfig
from fusion.lidar.lane import DepthLane, cleaned, likely_cause
from fusion.rig import Rig

SIZE = {"size_wh": (64, 48)}


def config(**groups: Any) -> DepthConfig:
    plain: dict[str, Any] = {
        "camera": SIZE,
        "samples": {"visibility": "none"},
        "dense": {"method": "nearest", "max_gap_px": 1e9},
    }
    return DepthConfig.of({**plain, **groups})


def wall(count: int = 400, seed: int = 0, x_m: float = 5.0) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    return np.stack([np.full(count, x_m), rng.uniform(-6, 6, count), rng.uniform(-4, 4, count)], -1)


def test_every_point_is_counted_step_by_step() -> None:
    xyz = wall()
    xyz[:50, 0] = -5  # behind
    xyz[50:70, 1] = 60  # beside
    xyz[70:80] *= 10  # too far, seen where it was
    lane = DepthLane(config(samples={"visibility": "none", "limits_m": (1.0, 20.0)}))
    cloud = PointCloud(xyz, stem="c", read=405, dropped={"nan": 5})
    frame = lane.of_cloud(cloud)
    f = 32 / math.tan(math.radians(60))
    u, v = -xyz[:, 1] / xyz[:, 0] * f + 31.5, -xyz[:, 2] / xyz[:, 0] * f + 23.5
    front = xyz[:, 0] > 0
    seen = front & (u >= -0.5) & (u < 63.5) & (v >= -0.5) & (v < 47.5)
    near = seen & (xyz[:, 0] <= 20)
    np.testing.assert_array_equal(frame.sparse.index, np.flatnonzero(near))
    np.testing.assert_allclose(frame.sparse.u, u[near], atol=1e-9)
    counts = frame.counts
    steps = ("read", "finite", "in_front", "in_frame", "in_range", "visible")
    expected = [405, 400, *(int(k.sum()) for k in (front, seen, near, near))]
    assert [counts[name] for name in steps] == expected
    assert counts["covered"] == np.count_nonzero(frame.dense.value_m)
    assert counts["supported"] == np.count_nonzero(frame.dense.support)
    assert (frame.stem, frame.flags, frame.dropped) == ("c", (), {"nan": 5})


def test_value_follows_the_camera_unless_it_is_said() -> None:
    assert DepthLane(config()).value == "depth"
    assert DepthLane(config(camera={**SIZE, "model": "spherical"})).value == "range"
    assert DepthLane(config(camera={**SIZE, "model": "fisheye", "fov_deg": 300})).value == "range"
    range_m = DepthLane(config(samples={"value": "range", "visibility": "none"})).of_cloud(PointCloud(wall()))
    assert range_m.dense.value == "range"
    assert range_m.sparse.value_m.max() > 6
    with pytest.raises(UsageError, match="looks all round"):
        DepthLane(config(camera={**SIZE, "model": "cylindrical"}, samples={"value": "depth"}))


def test_what_a_method_cannot_do_is_known_before_the_first_cloud() -> None:
    with pytest.raises(UsageError, match="--extrapolate"):
        DepthLane(config(dense={"method": "scan", "extrapolate": "linear"}))
    with pytest.raises(UsageError, match="unknown method"):
        DepthLane(config(dense={"method": "poisson"}))


@pytest.mark.parametrize(
    ("xyz", "groups", "words"),
    [
        (np.zeros((0, 3)), {}, ["it has no points"]),
        (wall(x_m=-5), {}, ["behind the camera", "--look"]),
        (wall() + np.array([0, 500, 0]), {}, ["outside the picture", "--fov"]),
        (wall(), {"samples": {"limits_m": (10, 20)}}, ["outside the limits", "0 of", "--limits"]),
        (wall(), {"cloud": {"range_m": (50, 60)}}, ["invalid or cut away"]),
        (wall(), {"cloud": {"voxel_m": 1e-15}}, ["larger voxels"]),
        (wall(1), {}, ["1 sample", "--extrapolate nearest"]),
    ],
)
def test_nothing_left_says_why(xyz: NDArray[np.float64], groups: dict[str, Any], words: list[str]) -> None:
    if len(xyz) == 1:
        xyz = xyz * (1, 0.01, 0.01) + (0, 0.011, 0.012)  # off its pixel's centre: no pixel lies in its hull
    with pytest.raises(FrameError) as refused:
        DepthLane(config(**groups)).of_cloud(PointCloud(xyz, stem="frame 7"))
    for word in ("frame 7", *words):
        assert word in str(refused.value)


def test_little_left_is_flagged_and_still_made() -> None:
    xyz = np.concatenate([wall(8), wall(500, 1, -5.0)])
    frame = DepthLane(config()).of_cloud(PointCloud(xyz))
    assert frame.flags == ("few-points",)
    assert "behind the camera (8 of 508 left" in likely_cause(frame.counts)
    assert likely_cause({"read": 100, "finite": 100, "in_front": 3}) == ""
    assert likely_cause({"read": 100, "finite": 100, "in_front": 2}) != ""


def test_cleaning_keeps_its_order_and_counts_all() -> None:
    xyz = np.concatenate([wall(300), [[0.5, 0, 0], [30, 0, 0], [5, 0, 9]]])
    rules = CloudConfig(range_m=(1, 20), box_m=(0, -10, -5, 10, 10, 5), voxel_m=0.5)
    clean = cleaned(PointCloud(xyz), rules)
    distance = np.linalg.norm(xyz, axis=1)
    inside = (distance >= 1) & (distance < 20)
    boxed = inside & (np.abs(xyz[:, 2]) < 5)
    kept = xyz[boxed]
    cells = {tuple(c) for c in np.floor((kept - (kept.min(0) - 0.25)) / 0.5).astype(int).tolist()}
    assert len(clean) == len(cells)
    assert clean.dropped == {"range": 2, "box": 1, "voxel": len(kept) - len(cells)}
    alone = cleaned(PointCloud(xyz), CloudConfig(outliers=(8, 2.0)))
    assert 0 < alone.dropped["outlier"] < 30
    assert len(alone) == 303 - alone.dropped["outlier"]


def test_a_rig_gives_camera_and_pose() -> None:
    camera = PinholeCamera((64, 48), 50, 50, 31.5, 23.5)
    T = pose([[0, -1, 0], [0, 0, -1], [1, 0, 0]], (0.1, 0.2, 0.3))
    rig = Rig({"rgb": camera}, {"T_rgb_lidar": T})
    lane = DepthLane(config(camera={"rig": "r.toml"}), rig)
    assert lane.camera == camera
    frame = lane.of_cloud(PointCloud(wall()))
    xyz = wall()[frame.sparse.index] @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(frame.sparse.u, 50 * xyz[:, 0] / xyz[:, 2] + 31.5, atol=1e-9)
    with pytest.raises(UsageError, match="rgb stands to lidar"):
        DepthLane(config(camera={"rig": "r.toml"}), Rig({"rgb": camera}))
    with pytest.raises(UsageError, match="no camera 'fir'"):
        DepthLane(config(camera={"rig": "r.toml", "sensor": "fir"}), rig)


def scanned(rings: int = 16, columns: int = 120) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """A wall at 8 m behind a post at 3 m, from 0.5 m above the origin."""
    azimuth, elevation = np.radians(np.linspace(-50, 50, columns)), np.radians(np.linspace(-12, 12, rings))
    az, el = np.meshgrid(azimuth, elevation)
    d = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], -1).reshape(-1, 3)
    post = np.abs(d[:, 1] / d[:, 0] * 3) < 0.3
    xyz = d * np.where(post, 3 / d[:, 0], 8 / d[:, 0])[:, None] + (0, 0, 0.5)
    return xyz, np.repeat(np.arange(rings, dtype=np.int32), columns)


def test_visibility_as_told_or_as_the_cloud_is() -> None:
    xyz, ring = scanned()
    beside = {**SIZE, "position_m": (0.0, 1.0, 0.5)}  # from here the post hides wall that the scanner saw

    def left(visibility: str, cloud: PointCloud) -> set[int]:
        lane = DepthLane(config(camera=beside, samples={"visibility": visibility}))
        return set(lane.of_cloud(cloud).sparse.index.tolist())

    scan, bare = (
        PointCloud(xyz, {"ring": ring}),
        PointCloud(xyz[np.random.default_rng(0).permutation(len(xyz))]),
    )
    all_of_it = left("none", scan)
    assert left("auto", scan) == left("scan", scan) < all_of_it
    assert left("auto", bare) == left("map", bare)
    gone = np.array(sorted(all_of_it - left("scan", scan)))
    assert (xyz[gone, 0] > 7).all()  # never the post


def test_a_sparse_picture_in_metres_goes_the_same_way() -> None:
    rng = np.random.default_rng(0)
    depth = np.where(rng.random((48, 64)) < 0.2, rng.uniform(2, 30, (48, 64)), 0).astype(np.float32)
    lane = DepthLane(config(samples={"visibility": "none", "limits_m": (5.0, 20.0)}))
    frame = lane.of_image(depth, "p")
    rows, columns = np.nonzero((depth >= 5) & (depth <= 20))
    np.testing.assert_array_equal(frame.sparse.v, rows)
    np.testing.assert_array_equal(frame.sparse.u, columns)
    np.testing.assert_array_equal(frame.sparse.value_m, depth[rows, columns])
    assert frame.counts["read"] == np.count_nonzero(depth)
    assert frame.counts["in_range"] == frame.counts["visible"] == len(rows)
    np.testing.assert_array_equal(frame.dense.value_m[rows, columns], depth[rows, columns])
    with pytest.raises(FrameError, match="no points"):
        lane.of_image(np.zeros((48, 64), np.float32), "p")
    with pytest.raises(FrameError, match="no map"):
        DepthLane(config(samples={"visibility": "map"})).of_image(depth)


def test_a_guide_of_another_size_is_refused_by_frame() -> None:
    lane = DepthLane(config(dense={"method": "guided"}))
    with pytest.raises(FrameError, match=r"f1: the guide is 32x48, the depth 64x48"):
        lane.of_cloud(PointCloud(wall(), stem="f1"), guide_bgr=np.zeros((48, 32, 3), np.uint8))


def test_the_cloud_stays_as_it_was() -> None:
    xyz, ring = scanned()
    before = xyz.copy()
    cloud = PointCloud(xyz, {"ring": ring})
    DepthLane(config(cloud={"voxel_m": 0.2, "range_m": (1, 50)})).of_cloud(cloud)
    np.testing.assert_array_equal(xyz, before)
    assert len(cloud) == len(before)


def test_too_large_a_map_is_refused_before_its_normals_are_sought(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion.lidar.lane.MOST_IN_MAP", 3)
    xyz = np.random.default_rng(0).uniform((2, -1, -1), (3, 1, 1), (9, 3)).astype(np.float32)
    lane = DepthLane(DepthConfig.of(samples={"visibility": "map"}))
    with pytest.raises(FrameError, match="9 points are too many"):
        lane.of_cloud(PointCloud(xyz))
