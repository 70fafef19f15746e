"""Clouds seen by cameras: the compiled way against plain numpy, the picture against a dict and Open3D."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion import geometry as geo
from fusion.errors import UsageError
from fusion.frames import PointCloud
from fusion.lidar import project as lane
from fusion.lidar.project import from_image, project, z_buffer
from fusion.lidar.sparse import SparseDepth, Value
from fusion.open3d import load

WIDE = geo.PinholeCamera.of_fov((640, 480), 120)
DISTORTED = geo.PinholeCamera((640, 480), 400, 401, 320, 240, (-0.37, 0.2, 1e-3, 5e-4, -0.07))
TURNED = (
    geo.pose(Rotation.from_euler("xyz", [0.1, -0.3, 0.2]).as_matrix(), (0.3, -0.1, 0.2)) @ geo.T_CAM_LIDAR
)
STEPS = ("read", "finite", "in_front", "in_frame", "in_range")


def scattered(seed: int, count: int, dtype: Any = np.float32) -> PointCloud:
    rng = np.random.default_rng(seed)
    xyz = rng.normal(size=(count, 3)) * (10, 10, 4)
    return PointCloud(xyz.astype(dtype), {"ring": rng.integers(0, 64, count).astype(np.uint16)})


def plainly(
    cloud: PointCloud, camera: geo.Camera, T: NDArray, use_range: bool, limits: tuple[float, float]
) -> tuple[lane.Samples, NDArray[np.int64]]:
    counts = np.zeros(3, np.int64)
    return lane._through_model(cloud.xyz_m, camera, T, use_range, limits, 0, counts), counts


# ---------------------------------------------------------------- the list


@pytest.mark.parametrize("value", ["depth", "range"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("T", [geo.T_CAM_LIDAR, TURNED], ids=["at the origin", "beside it"])
def test_the_compiled_way_is_the_plain_way(value: Value, dtype: Any, T: NDArray) -> None:
    cloud = scattered(1, 20_000, dtype)
    sparse = project(cloud, WIDE, T, value=value, limits_m=(1.0, 25.0))
    (u, v, d, index), counts = plainly(cloud, WIDE, T, value == "range", (1.0, 25.0))
    assert (sparse.index == index).all()
    np.testing.assert_allclose(sparse.u, u, atol=1e-9, rtol=0)
    np.testing.assert_allclose(sparse.v, v, atol=1e-9, rtol=0)
    np.testing.assert_allclose(sparse.value_m, d, rtol=2e-7)
    assert [sparse.counts[name] for name in STEPS] == [20_000, 20_000, *counts]
    assert 20_000 > counts[0] > counts[1] > counts[2] == len(sparse) > 1000


def test_every_sample_is_its_point_through_the_textbook() -> None:
    """One point after the other, in Python's own numbers: what the docstring promises, none left out."""
    cloud = scattered(2, 300)
    sparse = project(cloud, WIDE, TURNED, value="range", limits_m=(2.0, 15.0))
    expected = []
    for i, (x, y, z) in enumerate(cloud.xyz_m.tolist()):
        a, b, c, _ = TURNED @ (x, y, z, 1)
        u, v = WIDE.fx * a / c + 319.5, WIDE.fy * b / c + 239.5
        d = float(np.sqrt(a * a + b * b + c * c))
        if c > 0 and -0.5 <= u < 639.5 and -0.5 <= v < 479.5 and 2 <= d <= 15:
            expected.append((i, u, v, d))
    ours = list(zip(sparse.index, sparse.u, sparse.v, sparse.value_m, strict=True))
    np.testing.assert_allclose(ours, expected, rtol=1e-7, atol=1e-9)
    assert sparse.value == "range"
    assert sparse.size_wh == (640, 480)


@pytest.mark.parametrize(
    "camera",
    [
        DISTORTED,
        geo.FisheyeCamera.of_fov((300, 200), 100),
        geo.CylindricalCamera((300, 200), 360),
        geo.SphericalCamera((300, 200), 360),
    ],
    ids=lambda camera: type(camera).__name__,
)
def test_other_models_keep_what_their_pixels_see(camera: geo.Camera) -> None:
    cloud = scattered(3, 5000)
    sparse = project(cloud, camera, TURNED, value="range")
    at = geo.transform(TURNED, cloud.xyz_m[sparse.index])
    rays = camera.unproject(np.stack([sparse.u, sparse.v], -1))
    np.testing.assert_allclose(rays * sparse.value_m[:, None], at, atol=2e-5)
    left_out = np.setdiff1d(np.arange(5000), sparse.index)
    uv, seen = camera.project(geo.transform(TURNED, cloud.xyz_m[left_out]))
    inside = seen & (uv >= -0.5).all(1) & (uv < np.array(camera.size_wh) - 0.5).all(1)
    assert not inside.any()
    assert 5000 >= sparse.counts["in_front"] >= sparse.counts["in_frame"] == sparse.counts["in_range"] > 100


def test_points_that_distortion_would_fold_back_are_not_in_front() -> None:
    beyond = 1.2 * DISTORTED.valid_radius()
    xyz = np.array([[1, -0.1, 0], [1, -beyond, 0], [1, 0, 1.4 * beyond]], np.float32)
    assert project(PointCloud(xyz), DISTORTED).counts["in_front"] == 1
    uv, _ = DISTORTED.project(geo.transform(geo.T_CAM_LIDAR, xyz))
    assert (uv[1] > 0).all()
    assert (uv[1] < (640, 480)).all()  # it would stand in the picture


def test_range_is_to_the_camera_and_depth_along_its_axis() -> None:
    cloud = PointCloud(np.array([[4.0, 3.0, 0.0]]))
    T = geo.pose(translation_m=(0, 0, 1)) @ geo.T_CAM_LIDAR  # the camera stands 1 m behind the LiDAR
    assert project(cloud, WIDE, T, value="depth").value_m.tolist() == [5]
    assert project(cloud, WIDE, T, value="range").value_m[0] == pytest.approx(34**0.5)


@pytest.mark.parametrize("camera", [WIDE, DISTORTED], ids=["compiled", "plain"])
def test_limits_are_inclusive(camera: geo.Camera) -> None:
    x = np.array([1.999999, 2.0, 3.0, 4.0, 4.000001])
    cloud = PointCloud(np.stack([x, 0 * x, 0 * x], -1))
    sparse = project(cloud, camera, limits_m=(2.0, 4.0))
    assert sparse.index.tolist() == [1, 2, 3]
    assert sparse.value_m.tolist() == [2, 3, 4]
    assert [sparse.counts[name] for name in STEPS] == [5, 5, 5, 5, 3]


@pytest.mark.parametrize("camera", [WIDE, DISTORTED], ids=["compiled", "plain"])
def test_the_farthest_by_default_is_what_a_depth_image_holds(camera: geo.Camera) -> None:
    cloud = PointCloud(np.array([[65535 / 256, 0, 0], [65535.5 / 256, 0, 0]]))
    assert project(cloud, camera).index.tolist() == [0]


@pytest.mark.parametrize("plain", [False, True], ids=["compiled", "plain"])
def test_a_picture_holds_its_left_and_upper_edge_and_not_the_others(plain: bool) -> None:
    camera = geo.PinholeCamera((4, 2), 1, 1, 0, 0)  # u = x and v = y at z = 1: nothing is rounded
    u = np.array([-0.5, np.nextafter(-0.5, -1), 3.5, np.nextafter(3.5, 0), 1, 1, 1, 1])
    v = np.array([0, 0, 0, 0, -0.5, np.nextafter(-0.5, -1), 1.5, np.nextafter(1.5, 0)])
    cloud = PointCloud(np.stack([u, v, np.ones(8)], -1))
    if plain:
        index = plainly(cloud, camera, np.eye(4), False, (0, 9))[0][3]
    else:
        index = project(cloud, camera, np.eye(4)).index
    assert index.tolist() == [0, 3, 4, 7]


def test_samples_keep_the_clouds_order_and_rings() -> None:
    cloud = scattered(4, 3000)
    for camera in (WIDE, DISTORTED):
        sparse = project(cloud, camera)
        assert (np.diff(sparse.index) > 0).all()
        assert sparse.ring is not None
        assert sparse.ring.dtype == np.int32
        assert (sparse.ring == cloud.fields["ring"][sparse.index]).all()
    assert project(PointCloud(cloud.xyz_m), WIDE).ring is None


@pytest.mark.parametrize("camera", [WIDE, DISTORTED], ids=["compiled", "plain"])
def test_a_cloud_of_several_chunks_is_as_one_of_one(camera: geo.Camera, monkeypatch: Any) -> None:
    cloud = scattered(5, (1 << 18) + 1000)
    sparse = project(cloud, camera, TURNED)
    monkeypatch.setattr(lane, "_CHUNK", 1 << 30)
    whole = project(cloud, camera, TURNED)
    for name in ("u", "v", "value_m", "index", "ring"):
        assert (getattr(sparse, name) == getattr(whole, name)).all()
    assert sparse.counts == whole.counts
    assert sparse.index[-1] >= 1 << 18
    monkeypatch.setattr(lane, "_CHUNK", len(cloud))
    assert (project(cloud, camera, TURNED).index == sparse.index).all()


@pytest.mark.parametrize("camera", [WIDE, DISTORTED], ids=["compiled", "plain"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_nothing_little_and_all_behind(camera: geo.Camera, dtype: Any) -> None:
    for xyz, counts in (
        (np.empty((0, 3)), (0, 0, 0, 0, 0)),
        ([[-5, 0, 0], [-1, 1, 1], [0, 1, 0]], (3, 3, 0, 0, 0)),
        ([[1, 9, 0]], (1, 1, 0 if camera is DISTORTED else 1, 0, 0)),
        ([[5, 0, 0]], (1, 1, 1, 1, 1)),
    ):
        cloud = PointCloud(np.array(xyz, dtype), {"ring": np.zeros(len(xyz), np.uint8)})
        sparse = project(cloud, camera)
        assert tuple(sparse.counts[name] for name in STEPS) == counts
        assert len(sparse) == counts[-1]
        assert (sparse.u.dtype, sparse.value_m.dtype, sparse.index.dtype) == ("f8", "f4", "i8")
        assert z_buffer(sparse).any() == (counts[-1] > 0)


def test_how_many_points_the_file_had_is_carried() -> None:
    cloud = PointCloud(np.ones((3, 3)), read=7, dropped={"nan": 4})
    assert [project(cloud, WIDE).counts[name] for name in STEPS[:2]] == [7, 3]


@pytest.mark.parametrize("camera", [WIDE, DISTORTED], ids=["compiled", "plain"])
def test_arrays_as_they_come(camera: geo.Camera) -> None:
    """Read-only, strided, reversed, column-major: the same samples, and the array is as it was."""
    base = scattered(6, 2000)
    expected = project(base, camera)
    padded = np.zeros((2000, 5), np.float32)
    padded[:, 1:4] = base.xyz_m
    backwards = np.ascontiguousarray(base.xyz_m[::-1])
    locked = base.xyz_m.copy()
    locked.flags.writeable = False
    arrays: tuple[Any, ...] = (padded[:, 1:4], backwards[::-1], np.asfortranarray(base.xyz_m), locked)
    for xyz in arrays:
        before = xyz.copy()
        sparse = project(PointCloud(xyz), camera)
        assert (sparse.index == expected.index).all()
        assert (sparse.u == expected.u).all()
        assert (xyz == before).all()
    T = TURNED.copy()
    T.flags.writeable = False
    project(base, camera, T)


def test_integers_in_a_camera_change_nothing() -> None:
    cloud = scattered(7, 500)
    floats = project(cloud, geo.PinholeCamera((640, 480), 300.0, 300.0, 320.0, 240.0))
    w, h = np.array([640, 480])
    integers = project(cloud, geo.PinholeCamera((w, h), 300, 300, 320, 240), limits_m=(0, 255.99609375))
    assert (floats.u == integers.u).all()


def test_what_cannot_be_asked_for() -> None:
    cloud = scattered(8, 10)
    for camera in (geo.CylindricalCamera((9, 9), 90), geo.FisheyeCamera.of_fov((90, 90), 200)):
        with pytest.raises(UsageError, match="use range"):
            project(cloud, camera, value="depth")
        project(cloud, camera, value="range")
    with pytest.raises(UsageError, match=r"T_cam_lidar: .*not rigid"):
        project(cloud, WIDE, np.diag([1.0, 1, 0, 1]))
    with pytest.raises(UsageError, match=r"T_cam_lidar: .*not finite"):
        project(cloud, WIDE, np.full((4, 4), np.nan))
    wrong: Any = "disparity"
    with pytest.raises(ValueError, match="expected depth or range, got 'disparity'"):
        project(cloud, WIDE, value=wrong)


# ---------------------------------------------------------------- the picture


def samples(u: Any, v: Any, value: Any, size_wh: tuple[int, int]) -> SparseDepth:
    u, v = np.array(u, np.float64), np.array(v, np.float64)
    return SparseDepth(size_wh, u, v, np.array(value, np.float32), "depth", np.arange(u.size))


@given(st.integers(1, 12), st.integers(1, 12), st.integers(0, 200), st.integers(0, 2**32))
def test_the_picture_is_the_least_value_of_each_pixel(w: int, h: int, count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-0.5, w - 0.5, count), rng.uniform(-0.5, h - 0.5, count)
    sparse = samples(u, v, rng.uniform(0.1, 80, count), (w, h))
    least: dict[tuple[int, int], float] = {}
    for a, b, d in zip(sparse.u, sparse.v, sparse.value_m, strict=True):
        pixel = int(np.floor(b + 0.5)), int(np.floor(a + 0.5))
        least[pixel] = min(least.get(pixel, np.inf), d)
    expected = np.zeros((h, w), np.float32)
    for pixel, d in least.items():
        expected[pixel] = d
    assert (z_buffer(sparse) == expected).all()


def test_halves_go_up_and_the_edges_belong_to_their_pixels() -> None:
    below = np.nextafter(0.5, 0)  # + 0.5 rounds to 1
    image = z_buffer(samples([-0.5, 0.5, 1.4999, 1.5], [0, 0, 0, 0], [1, 2, 3, 4], (3, 1)))
    assert image.tolist() == [[1, 2, 4]]
    assert z_buffer(samples([below], [below], [5], (1, 1))).tolist() == [[5]]
    assert z_buffer(samples([2.4999999999999996], [-0.5], [5], (3, 2))).tolist() == [[0, 0, 5], [0, 0, 0]]


@pytest.mark.parametrize("bad", [-0.6, 2.5, 3.0, -1e30, 1e30, np.nan, np.inf, -np.inf])
def test_samples_outside_the_picture_are_refused_and_no_memory_is_harmed(bad: float) -> None:
    with pytest.raises(ValueError, match="inside 3x3 pixels, got 1 outside"):
        z_buffer(samples([1, bad], [1, 1], [5, 5], (3, 3)))
    with pytest.raises(ValueError, match="inside 3x3 pixels, got 1 outside"):
        z_buffer(samples([1, 1], [1, bad], [5, 5], (3, 3)))


def test_open3d_draws_the_same_picture() -> None:
    """It rounds halves away from zero, we round them up: the same from 0 on, and -0.3 is 0 for both.

    But it computes in float32: points at a pixel's edge may fall on either side, and are left out before.
    """
    cloud = scattered(9, 30_000)
    uv, _ = WIDE.project(geo.transform(TURNED, cloud.xyz_m))
    with np.errstate(invalid="ignore"):
        clear = (np.abs(uv - np.floor(uv) - 0.5) > 0.02).all(1)
    cloud = PointCloud(cloud.xyz_m[clear])
    o3d = load()
    points = o3d.t.geometry.PointCloud(o3d.core.Tensor(cloud.xyz_m))
    matrices = (o3d.core.Tensor(WIDE.matrix()), o3d.core.Tensor(TURNED))
    theirs = points.project_to_depth_image(640, 480, *matrices, depth_scale=1.0, depth_max=200.0)
    ours = z_buffer(project(cloud, WIDE, TURNED))
    theirs = np.asarray(theirs)[:, :, 0]
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)
    assert np.count_nonzero(ours) > 5000


# ---------------------------------------------------------------- pictures back to lists


def test_a_picture_comes_back_through_its_list() -> None:
    rng = np.random.default_rng(10)
    image = np.where(rng.random((30, 40)) < 0.2, rng.uniform(1, 80, (30, 40)), 0).astype(np.float32)
    sparse = from_image(image, "range")
    assert (z_buffer(sparse) == image).all()
    assert sparse.size_wh == (40, 30)
    assert sparse.value == "range"
    assert (np.diff(sparse.index) > 0).all()
    assert (image.ravel()[sparse.index] == sparse.value_m).all()
    assert {sparse.counts[name] for name in STEPS} == {len(sparse)} == {np.count_nonzero(image)}


def test_pictures_with_nothing_in_them() -> None:
    assert len(from_image(np.zeros((3, 4), np.float32))) == 0
    assert len(from_image(np.array([[np.nan, -1.0, 2.0]]))) == 1
    with pytest.raises(ValueError, match="expected HxW"):
        from_image(np.zeros((3, 4, 1), np.float32))
