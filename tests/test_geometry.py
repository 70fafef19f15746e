"""Poses against SciPy, cameras against OpenCV and closed forms, and what neither may show."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion import geometry as geo
from fusion.errors import UsageError

SIZE = (640, 480)
FINITE = {"allow_nan": False, "allow_infinity": False}
KITTI = (-0.3691481, 0.1968681, 1.353473e-03, 5.677587e-04, -0.06770705)  # raw camera 02
PINHOLE_DISTORTIONS = [
    (),
    (-0.31, 0.12, 0.002, -0.001),
    KITTI,
    (0.4, -0.2, 0.001, -0.003, 0.05, 0.5, -0.1, 0.02),
]
FISHEYE_DISTORTIONS = [(), (-0.02, 0.01, -0.005, 0.001), (0.3, -0.1, 0.05, 0.0)]


def pinhole(distortion: tuple[float, ...]) -> geo.PinholeCamera:
    return geo.PinholeCamera(SIZE, 510.0, 505.5, 322.2, 236.7, distortion)


def fisheye(distortion: tuple[float, ...]) -> geo.FisheyeCamera:
    return geo.FisheyeCamera(SIZE, 250.0, 255.0, 322.2, 236.7, distortion)


def directions(rng: np.random.Generator, count: int, most_rad: float) -> NDArray[np.float64]:
    """Unit vectors up to `most_rad` off the axis, the same number for each angle."""
    angle, turn = rng.uniform(0, most_rad, count), rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], -1)


def brute_force_turn(radius: Any, largest: float) -> float:
    """The first place where a radius stops growing or leaps: coarse steps, then finer ones around it."""
    low, high = 0.0, largest
    for _ in range(5):
        at = np.linspace(low, high, 200_001)
        with np.errstate(all="ignore"):
            falling = np.flatnonzero(~(np.diff(radius(at)) > 0))
        if not falling.size:
            return math.inf
        low, high = at[max(falling[0] - 1, 0)], at[min(falling[0] + 2, at.size - 1)]
        if high - low < 1e-5:
            break
    return float(low + high) / 2


# ---------------------------------------------------------------- poses


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4), st.floats(1e-3, 1e3))
def test_quaternions_are_scipys(wxyz: list[float], length: float) -> None:
    q = np.array(wxyz)
    assume(np.linalg.norm(q) > 1e-3)
    theirs = Rotation.from_quat(np.roll(q, -1))
    R = geo.rotation_of_quat(q * length)
    np.testing.assert_allclose(R, theirs.as_matrix(), atol=1e-14)
    back = geo.quat_of_rotation(R)
    assert back[0] >= 0
    np.testing.assert_allclose(np.linalg.norm(back), 1, atol=1e-14)
    assert min(np.abs(back - s * q / np.linalg.norm(q)).max() for s in (1, -1)) < 1e-12


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), -np.eye(3), [[0.6, 0, -0.8]]]).tolist())
def test_half_turns_are_no_special_case(axis: list[float]) -> None:
    R = Rotation.from_rotvec(np.pi * np.array(axis)).as_matrix()
    np.testing.assert_allclose(geo.rotation_of_quat(geo.quat_of_rotation(R)), R, atol=1e-14)


def test_many_quaternions_at_once() -> None:
    q = np.random.default_rng(0).normal(size=(2, 3, 4))
    R = geo.rotation_of_quat(q)
    assert R.shape == (2, 3, 3, 3)
    np.testing.assert_allclose(R[1, 2], geo.rotation_of_quat(q[1, 2]), atol=1e-15)


@pytest.mark.parametrize("quat", [[0, 0, 0, 0], [math.nan, 0, 0, 1], [math.inf, 0, 0, 0]])
def test_quaternions_that_are_none(quat: list[float]) -> None:
    with pytest.raises(ValueError, match="finite length"):
        geo.rotation_of_quat(quat)


def test_a_transformation_takes_src_to_dst_and_back() -> None:
    rotation = Rotation.from_euler("xyz", [0.3, -1.1, 2.0])
    T = geo.pose(rotation.as_matrix(), (1.0, -2.0, 3.0))
    points = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    expected = rotation.apply(points.astype(np.float64)) + np.array([1.0, -2.0, 3.0])
    np.testing.assert_allclose(geo.transform(T, points), expected, atol=1e-14)
    np.testing.assert_allclose(geo.invert(T), np.linalg.inv(T), atol=1e-15)
    assert geo.transform(T, np.empty((0, 3))).shape == (0, 3)


def test_a_camera_on_a_lidar_looks_forward_and_upright() -> None:
    forward, left, up = geo.transform(geo.T_CAM_LIDAR, np.eye(3))
    assert (forward == (0, 0, 1)).all()
    assert (left == (-1, 0, 0)).all()
    assert (up == (0, -1, 0)).all()


R0 = Rotation.from_euler("zyx", [1.0, 0.2, -0.4]).as_matrix()


def test_a_rounded_rotation_becomes_the_nearest_one() -> None:
    rounded = np.round(geo.pose(R0, (1, 2, 3)), 5)
    T = geo.checked_pose(rounded)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-15)
    assert np.abs(T - rounded).max() < 1e-5
    # The orthogonal polar factor is the nearest rotation: W (W^T W)^(-1/2).
    values, vectors = np.linalg.eigh(rounded[:3, :3].T @ rounded[:3, :3])
    polar = rounded[:3, :3] @ vectors @ np.diag(values**-0.5) @ vectors.T
    np.testing.assert_allclose(T[:3, :3], polar, atol=1e-14)
    assert (T[:3, 3] == (1, 2, 3)).all()


def test_what_is_rigid_stays_to_the_last_bit_and_three_rows_will_do() -> None:
    T = geo.checked_pose(geo.pose(R0, (0.1, 0.2, 0.3)))
    assert (geo.checked_pose(T) == T).all()
    assert (geo.checked_pose(T[:3]) == T).all()
    assert (geo.checked_pose(T.tolist()) == T).all()


def test_a_checked_pose_is_a_copy() -> None:
    T = geo.pose(R0)
    geo.checked_pose(T)[0, 3] = 9
    assert T[0, 3] == 0


HUGE = geo.pose([[1e200, 1e200, 0], [1e200, -1e200, 0], [0, 0, 1]])
BAD_POSES = {
    "singular": (geo.pose(np.diag([1, 1, 0])), "not rigid"),
    "zero": (np.zeros((4, 4)), "not rigid"),
    "scaled": (geo.pose(1.001 * R0), "not rigid"),
    "sheared": (geo.pose([[1, 0.01, 0], [0, 1, 0], [0, 0, 1]]), "not rigid"),
    "huge": (HUGE, "not rigid"),
    "projective": (np.vstack([np.eye(4)[:3], [0, 0, 1e-6, 1]]), "not rigid"),
    "mirrored": (geo.pose(np.diag([1, -1, 1])), "mirrors"),
    "mirrored, turned": (geo.pose(-R0), "mirrors"),
    "nan": (geo.pose(R0, (0, np.nan, 0)), "not finite"),
    "inf": (geo.pose(R0, (0, np.inf, 0)), "not finite"),
    "rotation only": (R0, "4x4 or 3x4"),
    "flat": (np.eye(4).ravel(), "4x4 or 3x4"),
}


@pytest.mark.parametrize("name", BAD_POSES)
def test_transformations_that_are_none_are_refused(name: str) -> None:
    T, message = BAD_POSES[name]
    with pytest.raises(UsageError, match=message) as error:
        geo.checked_pose(T, where="calib.txt")
    assert str(error.value).startswith("calib.txt: ")


# ---------------------------------------------------------------- pinhole and fisheye


@pytest.mark.parametrize("distortion", PINHOLE_DISTORTIONS, ids=len)
def test_pinhole_is_opencvs(distortion: tuple[float, ...]) -> None:
    camera = pinhole(distortion)
    xyz = directions(np.random.default_rng(2), 500, 0.7) * np.linspace(0.1, 80, 500)[:, None]
    uv, seen = camera.project(xyz)
    rest = (np.zeros(3), np.zeros(3), camera.matrix(), np.array(distortion))
    theirs = cv2.projectPoints(xyz[:, None], *rest)[0]
    np.testing.assert_allclose(uv, theirs[:, 0], atol=1e-9)
    assert seen.all()


@pytest.mark.parametrize("distortion", FISHEYE_DISTORTIONS, ids=str)
def test_fisheye_is_opencvs(distortion: tuple[float, ...]) -> None:
    camera = fisheye(distortion)
    xyz = directions(np.random.default_rng(3), 500, 1.5) * np.linspace(0.1, 80, 500)[:, None]
    uv, seen = camera.project(xyz)
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    coefficients = np.array(distortion or (0.0,) * 4)
    theirs, _ = cv2.fisheye.projectPoints(xyz[:, None], np.zeros(3), np.zeros(3), K, coefficients)
    np.testing.assert_allclose(uv, theirs[:, 0], atol=1e-9)
    assert seen.all()


def test_opencv_agrees_on_the_way_back_as_well() -> None:
    camera = pinhole(KITTI)
    uv = np.random.default_rng(4).uniform((60, 20), (580, 450), (200, 2))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    theirs = cv2.undistortPoints(uv[:, None], camera.matrix(), np.array(KITTI), None, None, None, criteria)
    ours = camera.unproject(uv)
    np.testing.assert_allclose(ours[:, :2] / ours[:, 2:], theirs[:, 0], atol=1e-9)


@pytest.mark.parametrize("camera", [pinhole(()), pinhole(KITTI)], ids=["plain", "distorted"])
def test_a_pinhole_sees_nothing_beside_or_behind_it(camera: geo.PinholeCamera) -> None:
    xyz = np.array([[0.1, 0.1, -1], [0, 0, -1], [1, 0, 0], [0, 0, 0], [0.1, 0, np.nan], [0, 0, 1e-30]])
    assert camera.project(xyz)[1].tolist() == [False, False, False, False, False, True]


def test_no_warning_however_near_the_plane_of_the_camera() -> None:
    xyz = np.array([[1, 1, 1e-300], [1e5, 0, 1e-45], [1, 0, 5e-324]])
    for distortion in PINHOLE_DISTORTIONS:
        uv, seen = pinhole(distortion).project(xyz)
        assert not (seen & (np.abs(uv) < 1e6).all(1)).any()


def coefficients(count: int, most: float) -> st.SearchStrategy[tuple[float, ...]]:
    return st.lists(st.floats(-most, most), min_size=count, max_size=count).map(tuple)


@settings(max_examples=60)
@given(st.one_of(coefficients(4, 0.5), coefficients(5, 0.5), coefficients(8, 0.5)), st.integers(0, 2**32))
def test_pixels_of_a_pinhole_come_back(distortion: tuple[float, ...], seed: int) -> None:
    # Weak tangential distortion: with a strong one, the map folds elsewhere than on a circle.
    distortion = (*distortion[:2], distortion[2] / 100, distortion[3] / 100, *distortion[4:])
    camera = pinhole(distortion)
    reach = min(0.9 * camera.valid_radius(), 3.0)
    # Without it, radii must still grow well: where they hardly do, even a weak one folds.
    r = np.linspace(0, reach, 200)
    k1, k2, k3, k4, k5, k6 = (*distortion[:2], *distortion[4:], *(0,) * 4)[:6]
    bend = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    assume(np.gradient(r * bend, r).min() > 0.05)
    xyz = directions(np.random.default_rng(seed), 100, math.atan(reach))
    uv, seen = camera.project(xyz)
    assert seen.all()
    back = camera.unproject(uv)
    found = ~np.isnan(back).any(1)
    again, _ = camera.project(back[found])
    np.testing.assert_allclose(again, uv[found], atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(back[found], axis=1), 1, atol=1e-12)
    assert found.all()


@settings(max_examples=40)
@given(st.one_of(st.just(()), coefficients(4, 0.3)), st.integers(0, 2**32))
def test_pixels_of_a_fisheye_come_back(distortion: tuple[float, ...], seed: int) -> None:
    camera = fisheye(distortion)
    xyz = directions(np.random.default_rng(seed), 100, 0.999 * camera.valid_angle())
    uv, seen = camera.project(xyz)
    assert seen.all()
    back = camera.unproject(uv)
    np.testing.assert_allclose(camera.project(back)[0], uv, atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), 1, atol=1e-12)
    assert (np.einsum("ij,ij->i", back, xyz) > 1 - 1e-6).all()


def test_no_direction_falls_where_the_radius_never_comes() -> None:
    barrel = pinhole((-0.3, 0.0, 0.0, 0.0))  # r - 0.3 r^3 is 0.703 at most
    far, near = [322.2 + 510 * 0.71, 236.7], [322.2 + 510 * 0.70, 236.7]
    assert np.isnan(barrel.unproject(np.array([far, near]))).all(1).tolist() == [True, False]
    bowl = fisheye((-0.3, 0.0, 0.0, 0.0))  # the same, of the angle
    far, near = [322.2 + 250 * 0.71, 236.7], [322.2 + 250 * 0.70, 236.7]
    assert np.isnan(bowl.unproject(np.array([far, near]))).all(1).tolist() == [True, False]
    assert np.isnan(barrel.unproject(np.array([[np.nan, 0]]))).all()
    assert np.isnan(bowl.unproject(np.array([[np.nan, 0]]))).all()


# ---------------------------------------------------------------- folding back


def test_a_cubic_folds_where_calculus_says() -> None:
    for k1 in (-0.3, -0.05, -1e-3, -1e-6):  # d/dr (r + k1 r^3) = 0
        assert pinhole((k1, 0, 0, 0)).valid_radius() == pytest.approx(math.sqrt(-1 / (3 * k1)), rel=1e-9)
    for distortion in ((), (0.1, 0, 0, 0), (0.0,) * 8, (0, 0, 0.01, 0.01, 0)):
        assert pinhole(distortion).valid_radius() == math.inf
    assert pinhole((0, 0, 0, 0, 0, -0.04, 0, 0)).valid_radius() == pytest.approx(
        5
    )  # the pole of r/(1-r^2/25)
    assert fisheye((-0.3, 0, 0, 0)).valid_angle() == pytest.approx(math.sqrt(1 / 0.9), rel=1e-9)
    assert fisheye(()).valid_angle() == fisheye((0.1, 0, 0, 0)).valid_angle() == math.pi


@settings(max_examples=25)
@given(st.one_of(coefficients(4, 0.6), coefficients(5, 0.6), coefficients(8, 0.6)))
def test_the_valid_radius_is_the_first_turn_that_a_search_finds(distortion: tuple[float, ...]) -> None:
    k1, k2, _, _, k3, k4, k5, k6 = (*distortion, *([0.0] * (8 - len(distortion))))

    def radius(r: NDArray) -> NDArray:
        s = r * r
        return r * (1 + k1 * s + k2 * s**2 + k3 * s**3) / (1 + k4 * s + k5 * s**2 + k6 * s**3)

    ours, searched = pinhole(distortion).valid_radius(), brute_force_turn(radius, 20.0)
    if math.isinf(searched):
        # or at a pole that the numerator cancels: too careful there, never wrong
        assert ours > 19.9 or abs(1 + k4 * ours**2 + k5 * ours**4 + k6 * ours**6) < 1e-6
    elif abs(ours - searched) > 1e-3:  # a turn too flat for the search: growth stops, nearly, at ours
        at = np.linspace(0.999, 1.001, 3) * ours
        assert ours < searched
        assert abs(radius(at)[2] - radius(at)[0]) < 1e-6 * abs(radius(at)[1])


@pytest.mark.parametrize("k", [-0.4, -0.1, -1e-3])
def test_points_beyond_the_turn_do_not_fold_back(k: float) -> None:
    camera = pinhole((k, 0.0, 0.0, 0.0))
    turn = math.sqrt(-1 / (3 * k))
    r = turn * np.array([0.5, 0.999, 1.001, 1.2, 1.6, 1.73, 3.0])
    uv, seen = camera.project(np.stack([r, 0 * r, 1 + 0 * r], -1))
    assert seen.tolist() == [True, True, False, False, False, False, False]
    folded = (np.abs(uv[:, 0] - SIZE[0] / 2) < SIZE[0] / 2) & (r > turn)
    assert folded.any()  # without the test they would stand in the picture


def test_points_beyond_the_turn_of_a_fisheye_do_not_fold_back() -> None:
    camera = fisheye((-0.3, 0.0, 0.0, 0.0))
    t = camera.valid_angle() * np.array([0.5, 0.999, 1.001, 1.5])
    seen = camera.project(np.stack([np.sin(t), 0 * t, np.cos(t)], -1))[1]
    assert seen.tolist() == [True, True, False, False]


@pytest.mark.parametrize(
    "camera",
    [
        pinhole(KITTI),
        geo.PinholeCamera((1392, 512), 959.8, 956.9, 696.0, 224.2, KITTI),
        geo.PinholeCamera((1920, 1200), 2152.8, 2155.5, 971.3, 605.9, (-0.1192, 0.162, 0.00073985, 0.0014)),
        pinhole((-0.6, 0.1, 0.0, 0.0)),
        geo.PinholeCamera(SIZE, 300.0, 300.0, 320.0, 240.0, (-0.3, 0.05, 5e-3, -5e-3)),
        fisheye((-0.1, 0.01, -0.02, 0.0)),
    ],
    ids=["kitti, wide", "kitti raw", "lidar_camera", "barrel", "tangential", "fisheye"],
)
def test_who_is_in_the_picture_is_where_its_pixel_looks(camera: geo.Camera) -> None:
    """From all directions: whatever is seen in frame lies on its pixel's ray, nothing from elsewhere."""
    xyz = directions(np.random.default_rng(5), 20_000, np.pi)
    uv, seen = camera.project(xyz)
    inside = seen & (uv >= -0.5).all(1) & (uv < np.array(camera.size_wh) - 0.5).all(1)
    assert inside.sum() > 200
    np.testing.assert_allclose(camera.unproject(uv[inside]), xyz[inside], atol=1e-6)


def test_tangential_distortion_turns_over_elsewhere_than_on_the_circle() -> None:
    """All of the circle is in this picture: what is seen comes back, and what comes back is seen."""
    camera = geo.PinholeCamera((1000, 1000), 400.0, 401.0, 500.0, 500.0, KITTI)
    xyz = directions(np.random.default_rng(6), 20_000, math.atan(camera.valid_radius()))
    uv, seen = camera.project(xyz)
    np.testing.assert_allclose(camera.unproject(uv[seen]), xyz[seen], atol=1e-6)
    assert 0.98 < seen.mean() < 1  # the circle but for its rim, on one side
    columns, rows = np.meshgrid(np.linspace(60, 940, 300), np.linspace(60, 940, 300))
    grid = np.stack([columns.ravel(), rows.ravel()], -1)
    rays = camera.unproject(grid)
    found = ~np.isnan(rays[:, 0])
    again, seen = camera.project(rays[found])
    assert seen.all()
    np.testing.assert_allclose(again, grid[found], atol=1e-5)
    assert 0.2 < found.mean() < 0.95


# ---------------------------------------------------------------- cylinder and sphere


def test_cylinder_and_sphere_have_closed_forms() -> None:
    azimuth, elevation = np.deg2rad([[0, 30, -80, 179], [0, 20, -45, 60]])
    xyz = 7 * np.stack(
        [np.cos(elevation) * np.sin(azimuth), -np.sin(elevation), np.cos(elevation) * np.cos(azimuth)], -1
    )
    per_degree = 720 / 360
    u = 359.5 + per_degree * np.rad2deg(azimuth)
    uv, seen = geo.SphericalCamera((720, 300), 360).project(xyz)
    np.testing.assert_allclose(uv, np.stack([u, 149.5 - per_degree * np.rad2deg(elevation)], -1), atol=1e-9)
    assert seen.all()
    uv, seen = geo.CylindricalCamera((720, 300), 360).project(xyz)
    rows = 149.5 - 720 / (2 * np.pi) * np.tan(elevation)
    np.testing.assert_allclose(uv, np.stack([u, rows], -1), atol=1e-9)
    assert seen.all()


@given(st.integers(1, 2000), st.integers(1, 2000), st.floats(1, 360), st.integers(0, 2**32))
def test_pixels_all_round_come_back(w: int, h: int, fov_deg: float, seed: int) -> None:
    uv = np.random.default_rng(seed).uniform((-0.5, -0.5), (w - 0.5, h - 0.5), (50, 2))
    for camera in (geo.CylindricalCamera((w, h), fov_deg), geo.SphericalCamera((w, h), fov_deg)):
        back = camera.unproject(uv)
        there = ~np.isnan(back).any(1)
        again, seen = camera.project(back[there])
        assert seen.all()
        scale = camera.f * (h / camera.f) ** 2 + 1  # far up a cylinder a tiny angle is many pixels
        np.testing.assert_allclose(again, uv[there], atol=1e-11 * scale + 1e-9 * camera.f)
        np.testing.assert_allclose(np.linalg.norm(back[there], axis=1), 1, atol=1e-12)


def test_a_sphere_ends_at_its_poles() -> None:
    camera = geo.SphericalCamera((360, 200), 360)  # 200 rows of a degree: ten too many above and below
    rows = np.array([[10, 9.4], [10, 9.6], [10, 189.4], [10, 189.6]])
    assert np.isnan(camera.unproject(rows)).all(1).tolist() == [True, False, False, True]
    assert camera.project(np.array([[0, 1.0, 0], [0, 0, 0], [0, np.nan, 1]]))[1].tolist() == [
        True,
        False,
        False,
    ]
    seen = geo.CylindricalCamera((360, 400), 360).project(np.array([[0, 1.0, 0], [0, 1, 1]]))[1]
    assert seen.tolist() == [False, True]


@pytest.mark.parametrize("kind", [geo.CylindricalCamera, geo.SphericalCamera])
def test_the_seam_behind_is_in_frame_from_both_sides(kind: Any) -> None:
    behind = np.array([[0.0, 0, -1], [-0.0, 0, -1], [1e-18, 0, -1], [-1e-18, 0, -1]])
    for w in range(1, 800):
        u = kind((w, 10), 360).project(behind)[0][:, 0]
        assert ((u >= -0.5) & (u < w - 0.5)).all(), w
    narrow = kind((100, 10), 350).project(behind)[0][:, 0]
    assert (np.abs(narrow - 49.5) > 50).all()


# ---------------------------------------------------------------- half pixels, fields of view, refusals


@pytest.mark.parametrize("fov_deg", [1.0, 60.0, 120.0, 179.0])
@pytest.mark.parametrize("size_wh", [(640, 480), (641, 3), (1, 1)])
def test_the_left_edge_is_half_the_field_of_view_off_the_axis(
    fov_deg: float, size_wh: tuple[int, int]
) -> None:
    w, h = size_wh
    for camera in (
        geo.PinholeCamera.of_fov(size_wh, fov_deg),
        geo.FisheyeCamera.of_fov(size_wh, fov_deg),
        geo.CylindricalCamera(size_wh, fov_deg),
        geo.SphericalCamera(size_wh, fov_deg),
    ):
        edges = np.array([[-0.5, (h - 1) / 2], [w - 0.5, (h - 1) / 2], [(w - 1) / 2, (h - 1) / 2]])
        x, y, z = camera.unproject(edges).T
        half = fov_deg / 2
        np.testing.assert_allclose(np.rad2deg(np.arctan2(x, z)), [-half, half, 0], atol=1e-9)
        np.testing.assert_allclose(y, 0, atol=1e-12)


@pytest.mark.parametrize("fov_deg", [0.0, -1.0, math.nan, math.inf, 360.0001, 1e-320])
def test_fields_of_view_no_camera_has(fov_deg: float) -> None:
    makers = [geo.PinholeCamera.of_fov, geo.FisheyeCamera.of_fov, geo.CylindricalCamera, geo.SphericalCamera]
    for make in makers[:2] if fov_deg == 1e-320 else makers:
        with pytest.raises(UsageError):
            make(SIZE, fov_deg)


def test_which_fields_of_view_end_where() -> None:
    with pytest.raises(UsageError, match=r"of 180 degrees .*less than 180"):
        geo.PinholeCamera.of_fov(SIZE, 180)
    with pytest.raises(UsageError, match=r"of 360 degrees .*less than 360"):
        geo.FisheyeCamera.of_fov(SIZE, 360)
    with pytest.raises(UsageError, match=r"of 361 degrees .*at most 360"):
        geo.SphericalCamera(SIZE, 361)
    assert geo.CylindricalCamera(SIZE, 360).f == pytest.approx(640 / (2 * math.pi))
    assert geo.FisheyeCamera.of_fov(SIZE, 200).fx > 0


@pytest.mark.parametrize("size_wh", [(0, 480), (640, -1), (640, 1 << 16), (640.5, 480)])
def test_sizes_no_picture_has(size_wh: Any) -> None:
    for make in (
        geo.PinholeCamera.of_fov,
        geo.FisheyeCamera.of_fov,
        geo.CylindricalCamera,
        geo.SphericalCamera,
    ):
        with pytest.raises(UsageError, match="an image of"):
            make(size_wh, 90)


@pytest.mark.parametrize("kind", [geo.PinholeCamera, geo.FisheyeCamera])
def test_intrinsics_that_cannot_be(kind: Any) -> None:
    for focal in (0.0, -500.0, math.nan, math.inf):
        with pytest.raises(UsageError, match="focal lengths"):
            kind(SIZE, focal, 500, 320, 240)
        with pytest.raises(UsageError, match="focal lengths"):
            kind(SIZE, 500, focal, 320, 240)
    for centre in ((math.nan, 240), (320, math.inf)):
        with pytest.raises(UsageError, match="centre"):
            kind(SIZE, 500, 500, *centre)
    for wrong in ((math.nan, 0, 0, 0), (0, math.inf, 0, 0), (1e300, 0, 0, 0)):
        with pytest.raises(UsageError, match="out of all bounds"):
            kind(SIZE, 500, 500, 320, 240, wrong)
    for count in (1, 2, 3, 6, 7, 9, *([5, 8] if kind is geo.FisheyeCamera else [])):
        with pytest.raises(UsageError, match=f"^{count} "):
            kind(SIZE, 500, 500, 320, 240, (0.0,) * count)


def test_only_cameras_that_look_forward_have_an_axis() -> None:
    assert pinhole(()).has_axis
    assert not geo.CylindricalCamera(SIZE, 90).has_axis
    assert not geo.SphericalCamera(SIZE, 90).has_axis
    # Equidistant: the corner of a square is sqrt(2) farther off than its edge.
    assert geo.FisheyeCamera.of_fov((100, 100), 180 / math.sqrt(2) - 0.1).has_axis
    assert not geo.FisheyeCamera.of_fov((100, 100), 180 / math.sqrt(2) + 0.1).has_axis
    assert not geo.FisheyeCamera(
        (100, 100), 50.0, 50.0, 20.0, 49.5
    ).has_axis  # the right side looks 90 degrees
    assert fisheye((-0.3, 0, 0, 0)).has_axis  # sees 60 degrees off the axis, whatever its corners
