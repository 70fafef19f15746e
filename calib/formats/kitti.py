"""KITTI's calibrations (Geiger et al. 2013, section IV): of the object benchmark, and of raw recordings.

Both give the rectified colour camera 2 as ``rgb``: a pinhole without distortion. Its projection matrix is
K [I | t]; t, its place beside camera 0 (the file holds K t), goes into ``T_rgb_lidar``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calib.formats.common import (
    Asked,
    Notes,
    Read,
    SizeWH,
    Written,
    camera_matrix,
    focal,
    known_pose,
    lens,
    losses,
    needed,
    rigid,
    without_size,
)
from calib.formats.plain import Entries, entries, numbers, read_text, words
from fusion.errors import UsageError
from fusion.geometry import FisheyeCamera, Floats, pose
from fusion.rig import Rig, RigCamera

CAMERAS_FILE, LIDAR_FILE = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt"
OBJECT, RAW = "KITTI's object calibration", "KITTI's raw calibration"


def read_object(lines: Entries, path: Path, asked: Asked) -> Read:
    """The rig of an object-benchmark file (P2, R0_rect, Tr_velo_to_cam), of the size asked for."""
    R = rigid(pose(numbers(lines, "R0_rect", path, 9).reshape(3, 3)), "R0_rect", path)
    T = rigid(numbers(lines, "Tr_velo_to_cam", path, 12).reshape(3, 4), "Tr_velo_to_cam", path)
    return _rectified(lines, "P2", path, None, R @ T, asked)


def read_raw(folder: Path, asked: Asked) -> Read:
    """The rig of a raw recording's folder (its calib_cam_to_cam.txt and calib_velo_to_cam.txt)."""
    path = folder / CAMERAS_FILE
    lines = entries(read_text(path), path)
    lidar_path = folder / LIDAR_FILE
    lidar = entries(read_text(lidar_path), lidar_path)
    R, t = numbers(lidar, "R", lidar_path, 9).reshape(3, 3), numbers(lidar, "T", lidar_path, 3)
    T = rigid(pose(R, t), "R", lidar_path)
    R_rect = rigid(pose(numbers(lines, "R_rect_00", path, 9).reshape(3, 3)), "R_rect_00", path)
    return _rectified(lines, "P_rect_02", path, _size(lines, "S_rect_02", path), R_rect @ T, asked)


def write_object(rig: Rig, path: Path) -> Written:
    """All seven lines, as readers count them; rgb, without distortion, is every camera."""
    camera, T_rgb_lidar, notes = _said(rig, OBJECT)
    P = words(np.column_stack([camera_matrix(camera), np.zeros(3)]))
    T_lidar_imu = known_pose(rig, "lidar", "imu")
    lines = [*(f"P{i}: {P}" for i in range(4)), f"R0_rect: {words(np.eye(3))}"]
    lines += [f"Tr_velo_to_cam: {words(T_rgb_lidar[:3])}"]
    lines += [f"Tr_imu_to_velo: {words((np.eye(4) if T_lidar_imu is None else T_lidar_imu)[:3])}", "", ""]
    made_up = ", and Tr_imu_to_velo is the identity" if T_lidar_imu is None else ""
    notes += (f"P0, P1 and P3 repeat P2{made_up}: programs count the lines",)
    return Written({path: "\n".join(lines)}, notes + without_size(OBJECT, camera))


def write_raw(rig: Rig, path: Path) -> Written:
    """Both files in the folder `path`; rgb, without distortion, is cameras 0 and 2."""
    camera, T, notes = _said(rig, RAW)
    K, size = camera_matrix(camera), words(camera.size_wh)
    eye, none, time = words(np.eye(3)), words(np.zeros(3)), "calib_time: 01-Jan-1970 00:00:00"
    lines = [time, "corner_dist: 0.0"]
    for i in ("00", "02"):
        lines += [f"S_{i}: {size}", f"K_{i}: {words(K)}", f"D_{i}: {words(np.zeros(5))}"]
        lines += [f"R_{i}: {eye}", f"T_{i}: {none}", f"S_rect_{i}: {size}", f"R_rect_{i}: {eye}"]
        lines += [f"P_rect_{i}: {words(np.column_stack([K, np.zeros(3)]))}"]
    lidar = [time, f"R: {words(T[:3, :3])}", f"T: {words(T[:3, 3])}"]
    lidar += [f"delta_f: {words((0, 0))}", f"delta_c: {words((0, 0))}", ""]
    files = {path / CAMERAS_FILE: "\n".join([*lines, ""]), path / LIDAR_FILE: "\n".join(lidar)}
    return Written(files, (*notes, "camera 00 repeats camera 02, and calib_time is made up"))


def _said(rig: Rig, form: str) -> tuple[RigCamera, Floats, Notes]:
    """What both forms say: a camera rgb of undistorted images, and ``T_rgb_lidar``."""
    camera = needed(rig, "rgb", form)
    if isinstance(camera, FisheyeCamera):
        hint = "write rig.toml, or Kalibr's camchain"
        raise UsageError(f"{form} describes undistorted images; rgb is a fisheye", hint=hint)
    if any(camera.distortion):
        hint = "undistort the images keeping the camera matrix, then force it; or write another form"
        raise UsageError(f"{form} describes undistorted images; rgb has distortion", hint=hint)
    sensors = ["rgb", "lidar"] + ["imu"] * (form == OBJECT)
    return camera, rig.pose("rgb", "lidar"), losses(rig, form, ["rgb"], sensors)


def _rectified(
    lines: Entries, key: str, path: Path, size_wh: SizeWH | None, T_cam0_lidar: Floats, asked: Asked
) -> Read:
    name = asked.names[0] if asked.names else "rgb"
    P = numbers(lines, key, path, 12).reshape(3, 4)
    K = focal(P[:, :3], key, path)
    camera = lens(size_wh or asked.size(name, path), K, (), key, path)
    T_rgb_cam0 = pose(translation_m=np.linalg.solve(P[:, :3], P[:, 3]))
    return Rig({name: camera}, {f"T_{name}_lidar": T_rgb_cam0 @ T_cam0_lidar}), ()


def _size(lines: Entries, key: str, path: Path) -> SizeWH:
    w, h = numbers(lines, key, path, 2).tolist()
    if not (w.is_integer() and h.is_integer()):
        raise UsageError(f"{key} holds no whole numbers of pixels", where=path)
    return int(w), int(h)
