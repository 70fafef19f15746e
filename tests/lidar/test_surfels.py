"""What a camera sees of a map, against rays and planes: two walls with a door, a ball, edges of the frame."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.frames import PointCloud
from fusion.geometry import (
    T_CAM_LIDAR,
    FisheyeCamera,
    PinholeCamera,
    SphericalCamera,
    invert,
    pose,
    transform,
)
from fusion.lidar.surfels import Surfels, surfels_of, visible_in_map

CAMERA = PinholeCamera.of_fov((321, 241), 100)


def wall(x, ys, zs, spacing, seed):
    """Points strewn over a rectangle at x, a little off it."""
    rng = np.random.default_rng(seed)
    n = int((ys[1] - ys[0]) * (zs[1] - zs[0]) / spacing**2)
    return np.stack(
        [x + 0.003 * rng.standard_normal(n), rng.uniform(ys[0], ys[1], n), rng.uniform(zs[0], zs[1], n)], -1
    )


def house(spacing=0.08):
    """A wall at x = 3 with a door of 1 x 2 m, another at 6 m, a floor at -1. Frame: LiDAR."""
    front = wall(3, (-4, 4), (-1, 3), spacing, 1)
    front = front[~in_door(front)]
    back = wall(6, (-6, 6), (-1, 4), spacing, 2)
    floor = wall(-1, (-5, 5), (0.5, 6), spacing, 3)[:, [2, 1, 0]]
    return front, back, floor


def in_door(xyz, grown=0.0):
    return (np.abs(xyz[:, 1] - 0.5) < 0.5 + grown) & (xyz[:, 2] < 1 + grown)


def seen_from(cloud, surfels, T_cam_lidar, camera):
    return visible_in_map(
        transform(T_cam_lidar, cloud), camera, surfels.normal @ T_cam_lidar[:3, :3].T, surfels.radius_m
    )


def framed(cloud, T, camera):
    uv, seen = camera.project(transform(T, cloud))
    return seen & ((uv >= -0.5) & (uv < np.subtract(camera.size_wh, 0.5))).all(1)


def moved(eye, yaw_deg=0.0):
    a = np.radians(yaw_deg)
    turn = ((np.cos(a), -np.sin(a), 0), (np.sin(a), np.cos(a), 0), (0, 0, 1))
    return T_CAM_LIDAR @ invert(pose(turn, eye))


@pytest.fixture(scope="module")
def world():
    parts = house()
    cloud = np.concatenate(parts)
    part = np.repeat([0, 1, 2], [len(p) for p in parts])
    return cloud, part, surfels_of(PointCloud(cloud))


def truly_visible(cloud, part, eye, grown):
    """By where the ray to a point crosses the front wall's plane; `grown` moves the door's frame."""
    t = (3 - eye[0]) / (cloud[:, 0] - eye[0])
    crossing = eye + t[:, None] * (cloud - eye)
    through = in_door(crossing, grown) | (crossing[:, 2] > 3 - grown) | (np.abs(crossing[:, 1]) > 4 - grown)
    return (part == 0) | (cloud[:, 0] < 2.9) | through


@pytest.mark.parametrize(
    "camera",
    [CAMERA, FisheyeCamera.of_fov((240, 240), 170), SphericalCamera((400, 160), 200)],
    ids=["pinhole", "fisheye", "spherical"],
)
@pytest.mark.parametrize(("eye", "yaw_deg"), [((0, 0, 0), 0), ((0.5, -2, 0.4), 20)])
def test_through_a_door(world, camera, eye, yaw_deg):
    cloud, part, surfels = world
    T = moved(eye, yaw_deg)
    frame = framed(cloud, T, camera)
    found = seen_from(cloud, surfels, T, camera)
    sure = truly_visible(cloud, part, np.array(eye, float), -0.3)
    never = ~truly_visible(cloud, part, np.array(eye, float), 0.1)
    assert not found[~frame].any()
    never &= cloud[:, 0] > 3.3  # what lies at the foot of the wall, behind it, is not told from it
    assert found[frame & sure].mean() > 0.97
    assert found[frame & never].mean() < 0.02
    assert (frame & never).sum() > 200
    assert (frame & sure & (part == 1)).sum() > 20


def test_all_of_a_single_surface_is_seen_even_at_grazing_incidence():
    floor = wall(-1, (-4, 4), (0.5, 15), 0.1, 4)[:, [2, 1, 0]]
    surfels = surfels_of(PointCloud(floor))
    frame = framed(floor, T_CAM_LIDAR, CAMERA)
    assert seen_from(floor, surfels, T_CAM_LIDAR, CAMERA)[frame].mean() > 0.98


def test_a_ball_hides_its_far_side():
    rng = np.random.default_rng(8)
    out = rng.standard_normal((6000, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    ball = out + np.array([4.0, 0, 0])
    found = seen_from(ball, surfels_of(PointCloud(ball)), T_CAM_LIDAR, CAMERA)
    towards = -(out * ball).sum(1) / np.linalg.norm(ball, axis=1)
    assert found[towards > 0.2].mean() > 0.98
    assert found[towards < -0.3].mean() < 0.02


def test_discs_reach_into_the_frame_from_outside_it():
    # One large disc at 2 m whose centre is left of the frame covers its left edge; a point behind is hidden.
    camera = PinholeCamera.of_fov((100, 100), 90)
    xyz = np.array([[-2.2, 0, 2.0], [-3.9, 0, 4.0], [0, 0, 4.0]])
    normal = np.tile((0.0, 0, 1), (3, 1))
    np.testing.assert_array_equal(visible_in_map(xyz, camera, normal, np.array([0.5, 0.1, 0.1])), [0, 0, 1])


def test_a_tilted_disc_is_met_where_it_is():
    # A disc of 1 m radius, tilted by 45 degrees: its left is nearer. Points on it are seen, points behind
    # are not.
    camera = PinholeCamera.of_fov((101, 101), 90)
    across = np.linspace(-0.6, 0.6, 13)
    on = np.stack([across, np.zeros(13), 3 + across], -1)
    for behind, seen in ((-0.3, True), (0.0, True), (0.15, True), (0.5, False)):
        xyz = np.r_[[[0, 0, 3.0]], on + np.array([0, 0, behind])]
        normal = np.tile((0.5**0.5, 0, -(0.5**0.5)), (14, 1))
        radius = np.r_[1.0, np.full(13, 0.2)]
        found = visible_in_map(xyz, camera, normal, radius)[1:]
        assert found.all() if seen else not found.any()


def test_the_least_is_seen_of_the_least():
    camera = PinholeCamera.of_fov((10, 10), 90)
    none = np.zeros((0, 3))
    assert visible_in_map(none, camera, none, np.zeros(0)).shape == (0,)
    one = np.array([[0, 0, 2.0], [0, 0, -2.0], [9, 0, 1.0], [0, 0, 0]])
    up = np.tile((0.0, 1, 0), (4, 1))  # edge on
    np.testing.assert_array_equal(visible_in_map(one, camera, up, np.ones(4)), [1, 0, 0, 0])
    np.testing.assert_array_equal(
        visible_in_map(one[:1], PinholeCamera.of_fov((1, 1), 90), up[:1], np.ones(1)), [1]
    )


@pytest.mark.parametrize(
    ("xyz", "normal", "radius"), [((4, 2), (4, 2), 4), ((4, 3), (3, 3), 4), ((4, 3), (4, 3), 3)]
)
def test_wrong_shapes(xyz, normal, radius):
    with pytest.raises(ValueError, match="expected Nx3"):
        visible_in_map(np.ones(xyz), CAMERA, np.ones(normal), np.ones(radius))


@pytest.mark.parametrize("n", [0, 1, 2, 3, 5, 20])
def test_discs_of_few_points(n):
    cloud = PointCloud(np.random.default_rng(n).uniform(1, 2, (n, 3)).astype(np.float32))
    surfels = surfels_of(cloud)
    assert surfels.normal.shape == (n, 3)
    assert np.isfinite(surfels.normal).all()
    assert (surfels.radius_m >= 0).all()
    assert (surfels.radius_m > 0).all() == (n == 0 or n >= 3)


def test_discs_fit_the_surface():
    cloud = wall(0, (-2, 2), (-2, 2), 0.1, 5)
    surfels = surfels_of(PointCloud(cloud))
    assert np.abs(surfels.normal[:, 0]).min() > 0.98
    np.testing.assert_allclose(np.linalg.norm(surfels.normal, axis=1), 1, rtol=1e-5)
    inner = (np.abs(cloud[:, 1:]) < 1.5).all(1)
    # Eight of N random points a square metre lie within sqrt(8 / (pi N)).
    assert np.median(surfels.radius_m[inner]) == pytest.approx(np.sqrt(8 / np.pi) * 0.1, rel=0.1)
    far = surfels_of(PointCloud(cloud + 1e6))  # as in a map of a country
    np.testing.assert_allclose(far.radius_m, surfels.radius_m, rtol=1e-3)


def test_stray_points_and_cables_are_no_walls():
    cloud = wall(4, (-4, 4), (-3, 3), 0.1, 5)
    cable = np.stack([np.full(80, 2.0), np.linspace(-4, 4, 80), np.full(80, 0.3)], -1)
    stray = np.array([[1.5, 0.4, -0.4], [1.5, -0.6, 0.1], [40, 0, 0]])
    every = np.concatenate([cloud, cable, stray])
    surfels = surfels_of(PointCloud(every))
    assert surfels.radius_m.max() <= 4.001 * np.median(surfels.radius_m)
    found = seen_from(every, surfels, T_CAM_LIDAR, CAMERA)
    frame = framed(every, T_CAM_LIDAR, CAMERA)
    # Were strays and cables whole discs, 0.72.
    assert found[: len(cloud)][frame[: len(cloud)]].mean() > 0.9


def test_wrong_discs():
    with pytest.raises(ValueError, match="Nx3 normals"):
        Surfels(np.ones((3, 3), np.float32), np.ones(2, np.float32))
