"""KITTI's calibrations (Geiger et al. 2013, section IV): of the object benchmark, and of raw recordings.

Both give the rectified colour camera 2 as ``rgb``: a pinhole without distortion. Its projection matrix is
K [I | t]; t, its place beside camera 0 (the file holds K t), goes into ``T_rgb_lidar``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calib.formats.plain import Entries, SizeWH, entries, numbers, pinhole, read_text, rigid
from fusion.errors import UsageError
from fusion.geometry import Floats, pose
from fusion.rig import Rig

CAMERAS_FILE, LIDAR_FILE = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt"


def read_object(lines: Entries, path: Path, size_wh: SizeWH | None) -> Rig:
    """The rig of an object-benchmark file (P2, R0_rect, Tr_velo_to_cam), of pictures of `size_wh`."""
    R = rigid(pose(numbers(lines, "R0_rect", path, 9).reshape(3, 3)), "R0_rect", path)
    T = rigid(numbers(lines, "Tr_velo_to_cam", path, 12).reshape(3, 4), "Tr_velo_to_cam", path)
    return _rectified(lines, "P2", path, size_wh, R @ T)


def read_raw(folder: Path) -> Rig:
    """The rig of a raw recording's folder (its calib_cam_to_cam.txt and calib_velo_to_cam.txt)."""
    path = folder / CAMERAS_FILE
    lines = entries(read_text(path), path)
    lidar_path = folder / LIDAR_FILE
    lidar = entries(read_text(lidar_path), lidar_path)
    R, t = numbers(lidar, "R", lidar_path, 9).reshape(3, 3), numbers(lidar, "T", lidar_path, 3)
    T = rigid(pose(R, t), "R", lidar_path)
    R_rect = rigid(pose(numbers(lines, "R_rect_00", path, 9).reshape(3, 3)), "R_rect_00", path)
    return _rectified(lines, "P_rect_02", path, _size(lines, "S_rect_02", path), R_rect @ T)


def _rectified(lines: Entries, key: str, path: Path, size_wh: SizeWH | None, T_cam0_lidar: Floats) -> Rig:
    P = numbers(lines, key, path, 12).reshape(3, 4)
    camera = pinhole(P[:, :3], key, path, size_wh)
    T_rgb_cam0 = pose(translation_m=np.linalg.solve(P[:, :3], P[:, 3]))
    return Rig({"rgb": camera}, {"T_rgb_lidar": T_rgb_cam0 @ T_cam0_lidar})


def _size(lines: Entries, key: str, path: Path) -> SizeWH:
    w, h = numbers(lines, key, path, 2).tolist()
    if not (w.is_integer() and h.is_integer()):
        raise UsageError(f"{key} holds no whole numbers of pixels", where=path)
    return int(w), int(h)
