"""A pose from pairs: truth first, OpenCV as an oracle, and what fixes no pose."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.lidar.points import from_points, read_pairs
from fusion.errors import InputError, UsageError
from fusion.geometry import T_CAM_LIDAR, Camera, FisheyeCamera, Floats, PinholeCamera, invert, pose, transform

TRUE = pose(Rotation.from_rotvec([0.05, -0.1, 0.03]).as_matrix(), (0.1, -0.2, 0.05)) @ T_CAM_LIDAR
PINHOLE = PinholeCamera((640, 480), 400, 402, 322, 237, (-0.2, 0.05, 0.001, -0.001, 0.0))
FISHEYE = FisheyeCamera((800, 800), 230, 231, 399, 401, (0.01, -0.002, 0.0, 0.0))  # 100 degrees off the axis


def pairs(camera: Camera, count: int, noise_px: float = 0.0, seed: int = 0) -> tuple[Floats, Floats]:
    """Pixels all over the picture, 2 to 8 m away."""
    rng = np.random.default_rng(seed)
    w, h = camera.size_wh
    uv = rng.uniform((0.1 * w, 0.1 * h), (0.9 * w, 0.9 * h), (count, 2))
    xyz = camera.unproject(uv) * rng.uniform(2, 8, (count, 1))
    return transform(invert(TRUE), xyz), uv + noise_px * rng.standard_normal(uv.shape)


def off(T: Floats) -> tuple[float, float]:
    turn = np.linalg.norm(Rotation.from_matrix(T[:3, :3] @ TRUE[:3, :3].T).as_rotvec())
    return float(turn), float(np.linalg.norm(T[:3, 3] - TRUE[:3, 3]))


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE])
@pytest.mark.parametrize("count", [4, 5, 6, 20])
def test_perfect_pairs_give_the_truth(camera: Camera, count: int) -> None:
    found = from_points(camera, *pairs(camera, count))
    assert max(off(found.T_cam_lidar)) < 1e-6
    assert found.inliers.all()
    assert found.rms_px < 1e-5


def test_rays_that_look_back_count() -> None:
    xyz, uv = pairs(FISHEYE, 30)
    behind = transform(TRUE, xyz)[:, 2] < 0
    assert behind.any()
    found = from_points(FISHEYE, xyz, uv)
    assert found.inliers[behind].all()


def test_wrong_pairs_are_left_out_and_do_not_move_it() -> None:
    xyz, uv = pairs(PINHOLE, 40, 0.5)
    clean = from_points(PINHOLE, xyz, uv)
    wrong = uv.copy()
    wrong[::4] += np.random.default_rng(3).uniform(30, 90, (10, 2))
    found = from_points(PINHOLE, xyz, wrong)
    assert set(np.flatnonzero(~found.inliers)) == set(range(0, 40, 4))
    assert "pair 1, 5, 9" in " ".join(found.notes)
    sigma = np.sqrt(np.diag(clean.covariance))
    x = np.r_[off(found.T_cam_lidar)]
    assert x[0] < 4 * np.linalg.norm(sigma[:3])
    assert x[1] < 4 * np.linalg.norm(sigma[3:])


def test_least_squares_agrees_with_opencv() -> None:
    xyz, uv = pairs(PINHOLE, 25, 0.3)
    found = from_points(PINHOLE, xyz, uv)
    _, r, t = cv2.solvePnP(xyz, uv, PINHOLE.matrix(), np.array(PINHOLE.distortion))
    theirs = pose(cv2.Rodrigues(r)[0], t.ravel())
    # A soft loss against squares: apart by less than the noise moves either.
    np.testing.assert_allclose(found.T_cam_lidar[:3, :3], theirs[:3, :3], atol=2e-4)
    np.testing.assert_allclose(found.T_cam_lidar, theirs, atol=1e-3)


def test_the_covariance_is_what_repetition_shows() -> None:
    errors, stated = [], []
    for seed in range(24):
        xyz, _ = pairs(PINHOLE, 12)
        uv, _ = PINHOLE.project(transform(TRUE, xyz))
        noise = 0.5 * np.random.default_rng(seed).standard_normal(uv.shape)
        found = from_points(PINHOLE, xyz, uv + noise)
        R = found.T_cam_lidar[:3, :3] @ TRUE[:3, :3].T
        errors.append(np.r_[Rotation.from_matrix(R).as_rotvec(), found.T_cam_lidar[:3, 3] - TRUE[:3, 3]])
        stated.append(np.diag(found.covariance))
    seen, said = np.std(errors, 0), np.sqrt(np.mean(stated, 0))
    assert (np.abs(np.log(seen / said)) < 0.6).all()  # 24 runs: +-15 % each, one sigma


def test_the_covariance_of_the_shift_is_that_of_opencvs_derivatives() -> None:
    xyz, uv = pairs(PINHOLE, 9, 0.5)
    found = from_points(PINHOLE, xyz, uv)
    T = found.T_cam_lidar
    r, distortion = cv2.Rodrigues(T[:3, :3])[0], np.array(PINHOLE.distortion)
    _, J = cv2.projectPoints(xyz, r, T[:3, 3], PINHOLE.matrix(), distortion)[:2]
    sigma2 = (found.error_px**2).sum() / (2 * 9 - 6)
    theirs = sigma2 * np.linalg.inv(J[:, :6].T @ J[:, :6])
    np.testing.assert_allclose(found.covariance[3:, 3:], theirs[3:, 3:], rtol=1e-3)


def test_a_fisheye_that_sees_the_points_far_off_its_axis_only() -> None:
    rng = np.random.default_rng(6)
    angle, around = rng.uniform(1.1, 1.7, 24), rng.uniform(-0.6, 0.6, 24)
    axis = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], 1)
    xyz = axis * rng.uniform(2, 8, (24, 1))
    uv, seen = FISHEYE.project(xyz)
    assert seen.all()
    uv[::3] += rng.uniform(40, 80, (8, 2))
    away = np.array([30.0, -20.0, 10.0])  # points of a map: its origin is far off, which a wrong pose shows
    found = from_points(FISHEYE, transform(invert(TRUE), xyz) + away, uv)
    np.testing.assert_allclose(found.T_cam_lidar, TRUE @ pose(translation_m=-away), atol=1e-4)
    assert set(np.flatnonzero(~found.inliers)) == set(range(0, 24, 3))


def test_pairs_that_fix_no_pose_are_refused_in_words() -> None:
    xyz, uv = pairs(PINHOLE, 12)
    line = np.linspace(0, 1, 12)[:, None] * [0.5, 1, 0.2] + [4, -0.5, 0]
    on_line, _ = PINHOLE.project(transform(TRUE, line))
    for points, pixels, words in (
        (xyz[:3], uv[:3], "3 pairs"),
        (line, on_line, "one line"),
        (np.ones((8, 3)), uv[:8], "one place"),
        (xyz, np.roll(uv, 5, 0), "agree|no pose"),
        (np.where(xyz == xyz[0], np.nan, xyz), uv, "not finite"),
    ):
        with pytest.raises(InputError, match=words):
            from_points(PINHOLE, points, pixels)


def test_points_far_away_in_a_small_part_of_the_picture_are_refused() -> None:
    rng = np.random.default_rng(2)
    uv = np.array([320, 240]) + rng.uniform(-2, 2, (10, 2))
    xyz = transform(invert(TRUE), PINHOLE.unproject(uv) * rng.uniform(30, 31, (10, 1)))
    with pytest.raises(InputError, match="fix the pose to"):
        from_points(PINHOLE, xyz, uv)


def test_a_flat_set_is_said_to_be_flat_and_still_right() -> None:
    rng = np.random.default_rng(4)
    on_wall = np.stack([np.full(12, 5.0), rng.uniform(-2, 2, 12), rng.uniform(-1, 1, 12)], 1)
    uv, seen = PINHOLE.project(transform(TRUE, on_wall))
    assert seen.all()
    found = from_points(PINHOLE, on_wall, uv)
    assert max(off(found.T_cam_lidar)) < 1e-5
    assert any("one plane" in note for note in found.notes)


def test_pairs_are_read_by_name(tmp_path: Path) -> None:
    file = tmp_path / "pairs.csv"
    file.write_text("note, u_px,v_px,z_m,y_m,x_m\na,1,2,3,4,5\n\nb,6,7,8,9,10\n")
    xyz, uv = read_pairs(file)
    np.testing.assert_array_equal(xyz, [[5, 4, 3], [10, 9, 8]])
    np.testing.assert_array_equal(uv, [[1, 2], [6, 7]])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x_m,y_m,z_m,u_px\n1,2,3,4\n", "v_px"),
        ("", "x_m"),
        ("x_m,y_m,z_m,u_px,v_px\n1,2,3,4,5\n1,2,three,4,5\n", "line 3: z_m is 'three'"),
        ("x_m,y_m,z_m,u_px,v_px\n1,2,3,4\n", "line 2: v_px is ''"),
        ("x_m,y_m,z_m,u_px,v_px\n1,2,nan,4,5\n", "line 2: z_m is not finite"),
    ],
)
def test_a_wrong_list_names_its_line(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "pairs.csv"
    file.write_text(text)
    with pytest.raises(UsageError, match=words):
        read_pairs(file)
    with pytest.raises(UsageError, match="cannot be read"):
        read_pairs(tmp_path / "none.csv")
