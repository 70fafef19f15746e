"""KITTI's files as we write them: read by the devkit's own arithmetic, and by programs that count lines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.formats import convert, read_rig, write_rig
from fusion.geometry import T_CAM_LIDAR, PinholeCamera, pose, transform
from fusion.rig import Rig

CAMERA = PinholeCamera((1242, 375), 700.1, 690.2, 601.5, 180.25)
T = pose(
    Rotation.from_euler("xyz", [0.01, -0.02, 0.03]).as_matrix() @ T_CAM_LIDAR[:3, :3], (1e-5, -0.08, -0.27)
)
IMU = pose(Rotation.from_euler("xyz", [0.2, 0.1, -0.3]).as_matrix(), (-0.8, 0.3, -0.7))
RIG = Rig({"rgb": CAMERA}, {"T_rgb_lidar": T, "T_lidar_imu": IMU})


def table(path: Path) -> dict[str, np.ndarray]:
    lines = [line.partition(":") for line in path.read_text().splitlines() if line.strip()]
    return {key: np.array(rest.split(), float) for key, _, rest in lines if key != "calib_time"}


def test_the_devkits_product_is_our_projection(tmp_path: Path) -> None:
    write_rig(tmp_path / "000000.txt", RIG, "kitti")
    write_rig(tmp_path / "raw", RIG, "kitti-raw")
    xyz = np.random.default_rng(0).uniform((3, -5, -2), (40, 5, 2), (100, 3))
    expected = CAMERA.project(transform(T, xyz))[0]
    found = table(tmp_path / "000000.txt")
    cameras = table(tmp_path / "raw" / "calib_cam_to_cam.txt")
    lidar = table(tmp_path / "raw" / "calib_velo_to_cam.txt")
    velo = np.column_stack([lidar["R"].reshape(3, 3), lidar["T"]])
    for P, rect, to_cam in (
        (found["P2"], found["R0_rect"], found["Tr_velo_to_cam"].reshape(3, 4)),
        (cameras["P_rect_02"], cameras["R_rect_00"], velo),
    ):
        at = rect.reshape(3, 3) @ (to_cam[:, :3] @ xyz.T + to_cam[:, 3:])
        u, v, w = P.reshape(3, 4) @ np.vstack([at, np.ones(len(xyz))])
        np.testing.assert_allclose(np.column_stack([u / w, v / w]), expected, atol=1e-9)
    assert (cameras["S_rect_02"] == (1242, 375)).all()
    np.testing.assert_allclose(found["Tr_imu_to_velo"].reshape(3, 4), IMU[:3], atol=1e-15)


def test_lines_stand_where_programs_count_them(tmp_path: Path) -> None:
    notes = write_rig(tmp_path / "000000.txt", Rig(RIG.cameras, {"T_rgb_lidar": T}), "kitti")
    lines = (tmp_path / "000000.txt").read_text().split("\n")
    keys = ["P0", "P1", "P2", "P3", "R0_rect", "Tr_velo_to_cam", "Tr_imu_to_velo"]
    assert [line.partition(":")[0] for line in lines[:7]] == keys
    assert "Tr_imu_to_velo is the identity" in notes[0]
    assert "give 1242x375" in notes[1]


def test_real_kitti_goes_through_every_form_with_a_lidar(shared_data: Path, tmp_path: Path) -> None:
    rig = read_rig(shared_data / "kitti_depth")
    path = shared_data / "kitti_depth"
    for i, name in enumerate(("rig.toml", "calib.json", "kdt.txt", "000001.txt", "out")):
        form = "kitti-raw" if name == "out" else None
        convert(path, tmp_path / f"{i}" / name, form, size_wh=(1242, 375))
        path = tmp_path / f"{i}" / name
    back = read_rig(path)
    assert back.camera("rgb").size_wh == (1242, 375)
    assert back.camera("rgb").fx == rig.camera("rgb").fx
    np.testing.assert_allclose(back.pose("rgb", "lidar"), rig.pose("rgb", "lidar"), rtol=0, atol=1e-14)


def test_a_size_that_is_not_given_stops_it(tmp_path: Path) -> None:
    write_rig(tmp_path / "000000.txt", RIG, "kitti")
    with pytest.raises(Exception, match=r"000000.txt: .*how large the pictures are"):
        convert(tmp_path / "000000.txt", tmp_path / "rig.toml")
    assert not (tmp_path / "rig.toml").exists()
