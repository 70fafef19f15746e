"""Refinement on scenes made here: boxes at several depths, seen by a camera and by a LiDAR a little beside
it.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib.lidar.refine import SceneFrame, refine_on_scene
from calib.lidar.score import Lifted, edge_score, lift, orientation_fields, scene_edges
from fusion.errors import InputError
from fusion.geometry import T_CAM_LIDAR, Floats, PinholeCamera, invert, pose

CAMERA = PinholeCamera((320, 240), 230, 230, 160, 119)
TRUE = pose(Rotation.from_rotvec([0.02, -0.03, 0.01]).as_matrix(), (0.06, -0.1, -0.05)) @ T_CAM_LIDAR


def scene(seed: int) -> Floats:
    """Boxes facing the camera: y0, y1, z0, z1 (across, up), x away, grey; the last is the wall behind."""
    rng = np.random.default_rng(seed)
    middle, half = rng.uniform((-3, -2), (3, 2), (14, 2)), rng.uniform(0.15, 0.5, (14, 2))
    box = [
        middle[:, 0] - half[:, 0],
        middle[:, 0] + half[:, 0],
        middle[:, 1] - half[:, 1],
        middle[:, 1] + half[:, 1],
    ]
    grey = rng.permutation(np.linspace(20, 235, 14))
    boxes = np.stack([*box, rng.uniform(2, 5, 14), grey], 1)
    return np.vstack([boxes, [-99, 99, -99, 99, 8, 120]])


def cast(boxes: Floats, origin: Floats, rays: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Distance and box of each ray (unit, N x 3, LiDAR frame)."""
    best, which = np.full(len(rays), np.inf), np.zeros(len(rays), np.intp)
    for k, (y0, y1, z0, z1, x, _) in enumerate(boxes):
        with np.errstate(divide="ignore"):
            r = (x - origin[0]) / rays[:, 0]
        y, z = (origin + rays * r[:, None])[:, 1:].T
        nearer = (r > 0) & (r < best) & (y > y0) & (y < y1) & (z > z0) & (z < z1)
        best[nearer], which[nearer] = r[nearer], k
    return best, which


def frame(seed: int, *, thermal: bool = False, picture_of: int | None = None) -> SceneFrame:
    boxes = scene(seed)
    w, h = CAMERA.size_wh
    u, v = np.meshgrid(np.arange(w), np.arange(h))
    out = CAMERA.unproject(np.stack([u.ravel(), v.ravel()], 1).astype(np.float64))
    T = invert(TRUE)
    seen = boxes if picture_of is None else scene(picture_of)
    _, which = cast(seen, T[:3, 3], out @ T[:3, :3].T)
    grey = cv2.GaussianBlur(seen[which, 5].reshape(h, w).astype(np.float32), (0, 0), 0.8)
    grey += np.random.default_rng(seed).normal(0, 2, grey.shape).astype(np.float32)
    image = (20000 - 10 * grey).astype(np.uint16) if thermal else np.clip(grey, 0, 255).astype(np.uint8)
    a, e = np.meshgrid(np.radians(np.arange(45, -45, -0.4)), np.radians(np.arange(-30, 30, 0.6)))
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1).reshape(-1, 3)
    r, _ = cast(boxes, np.zeros(3), rays)
    r += np.random.default_rng(seed + 100).normal(0, 0.01, len(r))
    return SceneFrame(image, rays * r[:, None], name=f"{seed}")


def off(T: Floats) -> tuple[float, float]:
    turn = np.linalg.norm(Rotation.from_matrix(T[:3, :3] @ TRUE[:3, :3].T).as_rotvec())
    return float(np.degrees(turn)), float(np.linalg.norm(invert(T)[:3, 3] - invert(TRUE)[:3, 3]))


def started(rotvec_deg: tuple[float, float, float], shift: tuple[float, float, float] = (0, 0, 0)) -> Floats:
    return pose(Rotation.from_rotvec(np.radians(rotvec_deg)).as_matrix(), shift) @ TRUE


@pytest.fixture(scope="module")
def frames() -> list[SceneFrame]:
    return [frame(1)]


def test_the_score_is_highest_at_the_truth(frames: list[SceneFrame]) -> None:
    f = frames[0]
    lifted, _ = lift(scene_edges(np.asarray(f.xyz_m, np.float64), None), CAMERA, TRUE)
    field = orientation_fields(f.image, (2.0,), 1.0)[0]
    here = edge_score(lifted, CAMERA, TRUE, field)
    for axis in range(2):
        for turn in (-1.0, 1.0):
            other = started((turn, 0, 0) if axis == 0 else (0, turn, 0))
            assert edge_score(lifted, CAMERA, other, field) < 0.8 * here
    across = Lifted(lifted.xyz_m, np.roll(lifted.weights, 2, 1))  # edges that run the other way
    assert edge_score(across, CAMERA, TRUE, field) < 0.5 * here
    diagonal = Lifted(lifted.xyz_m, np.roll(lifted.weights, 1, 1))
    assert edge_score(diagonal, CAMERA, TRUE, field) < 0.85 * here
    # Chance is 0: a picture of something else.
    foreign = orientation_fields(frame(1, picture_of=9).image, (2.0,), 1.0)[0]
    assert abs(edge_score(lifted, CAMERA, TRUE, foreign)) < 0.4 * here


def test_edges_lie_on_the_rim_of_what_is_nearer(frames: list[SceneFrame]) -> None:
    edges = scene_edges(np.asarray(frames[0].xyz_m, np.float64), None)
    boxes = scene(1)[:-1]
    off_rim = np.full(len(edges.xyz_m), np.inf)
    for y0, y1, z0, z1, x, _ in boxes:
        p = edges.xyz_m
        rim = np.abs(
            np.maximum(np.maximum(y0 - p[:, 1], p[:, 1] - y1), np.maximum(z0 - p[:, 2], p[:, 2] - z1))
        )
        off_rim = np.minimum(off_rim, np.hypot(rim, np.abs(p[:, 0] - x)))
    # Rays are 0.4 to 0.6 degrees apart, boxes at most 5 m away: half a step is at most 26 mm, noise 1 cm.
    assert np.median(off_rim) < 0.02
    assert np.percentile(off_rim, 90) < 0.06


@pytest.mark.parametrize("thermal", [False, True])
def test_a_start_that_is_off_is_brought_back(frames: list[SceneFrame], thermal: bool) -> None:
    shown = [frame(2, thermal=True)] if thermal else frames
    start = started((1.0, -0.9, 0.6), (0.02, -0.02, 0.01))
    found = refine_on_scene(CAMERA, shown, start)
    assert found.kept == "refined", found.note
    assert found.score_after > found.score_before
    assert off(found.T_cam_lidar)[0] < 0.25  # a pixel
    assert off(found.T_cam_lidar)[1] < 0.05
    assert found.moved_rad == pytest.approx(np.radians(1.47), rel=0.2)


def test_the_truth_is_not_made_worse(frames: list[SceneFrame]) -> None:
    found = refine_on_scene(CAMERA, frames, TRUE)
    assert off(found.T_cam_lidar)[0] < 0.15
    assert off(found.candidate)[0] < 0.3
    if found.kept == "start":
        np.testing.assert_allclose(found.T_cam_lidar, TRUE, atol=1e-12)
        assert found.note


def test_pictures_of_something_else_leave_the_start_and_say_why() -> None:
    found = refine_on_scene(CAMERA, [frame(1, picture_of=8)], started((0.5, 0, 0)))
    assert found.kept == "start"
    assert found.agreement_rad > np.radians(0.5)
    assert "disagree" in found.note or "it moved" in found.note
    np.testing.assert_allclose(found.T_cam_lidar, started((0.5, 0, 0)), atol=1e-12)


def test_a_start_far_off_is_refused(frames: list[SceneFrame]) -> None:
    found = refine_on_scene(CAMERA, frames, started((4.5, 2.0, 0)))
    assert found.kept == "start"
    assert found.moved_rad > np.radians(4)
    assert "it moved" in found.note


def test_frames_without_edges_and_wrong_sizes_are_refused(frames: list[SceneFrame]) -> None:
    f = frames[0]
    with pytest.raises(InputError, match="in none of 1 frames"):
        refine_on_scene(CAMERA, [SceneFrame(f.image, np.full((50, 3), np.nan))], TRUE)
    with pytest.raises(InputError, match="320x240"):
        refine_on_scene(CAMERA, [SceneFrame(f.image[:100], f.xyz_m)], TRUE)
    with pytest.raises(InputError, match="no frames"):
        refine_on_scene(CAMERA, [], TRUE)


def test_the_cloud_keeps_its_points_and_invalid_ones_do_not_count(frames: list[SceneFrame]) -> None:
    f = frames[0]
    xyz = np.vstack([f.xyz_m, np.full((300, 3), np.nan), np.zeros((300, 3))])
    before = xyz.copy()
    found = refine_on_scene(CAMERA, [SceneFrame(f.image, xyz)], TRUE)
    np.testing.assert_array_equal(xyz, before)
    assert off(found.T_cam_lidar)[0] < 0.15


def test_reflectance_steps_on_a_flat_wall_are_edges() -> None:
    a, e = np.meshgrid(np.radians(np.arange(20, -20, -0.4)), np.radians(np.arange(-15, 15, 0.6)))
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1).reshape(-1, 3)
    wall = rays * (4 / rays[:, 0])[:, None]
    bright = (wall[:, 1] > 0.33).astype(np.float64) + 0.01 * np.random.default_rng(0).standard_normal(
        len(wall)
    )
    edges = scene_edges(wall, bright)
    assert not edges.depth.any()
    assert len(edges.xyz_m) > 20
    assert np.abs(edges.xyz_m[:, 1] - 0.33).max() < 0.03
    assert not len(scene_edges(wall, None).xyz_m)
