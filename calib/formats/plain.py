"""Calibrations as text of lines ``KEY: numbers``: reading them, and the plain K, D, T form.

K: fx 0 cx 0 fy cy 0 0 1         the camera's matrix, row by row
D: k1 k2 p1 p2 [k3 [k4 k5 k6]]   OpenCV's distortion
T: 12 numbers                    camera from LiDAR, 3 x 4, row by row
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from fusion.errors import UsageError
from fusion.geometry import Floats, PinholeCamera, checked_pose
from fusion.rig import Rig

Entries = Mapping[str, str]  # what stands after the colon of each line
SizeWH = tuple[int, int]
FORMS = (
    "rig.toml, a KITTI object calibration (P2, R0_rect, Tr_velo_to_cam), a KITTI raw folder "
    "(calib_cam_to_cam.txt, calib_velo_to_cam.txt), or K, D, T as text"
)
_LARGEST_BYTES = 1 << 20


def read_text(path: Path) -> str:
    """The text of a calibration file. `UsageError` if unreadable, empty, no text, or above 1 MiB."""
    try:
        with path.open("rb") as file:
            data = file.read(_LARGEST_BYTES + 1)
    except OSError as error:
        raise UsageError(f"the calibration cannot be read: {error.strerror or error}", where=path) from None
    if len(data) > _LARGEST_BYTES:
        raise UsageError("too large for a calibration", where=path, hint="at most 1 MiB")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise UsageError("the calibration is not text", where=path)
    if not text.strip():
        raise UsageError("the calibration is empty", where=path)
    return text


def entries(text: str, path: Path) -> Entries:
    """Lines ``KEY: rest`` by key. `UsageError` for a line without key, and for a key that returns."""
    found: dict[str, str] = {}
    for number, line in enumerate(text.splitlines(), 1):
        key, colon, rest = line.partition(":")
        key = key.strip()
        if not line.strip():
            continue
        if not (colon and key.isidentifier()):
            raise UsageError(f"line {number} is not KEY: numbers", where=path, hint=f"expected {FORMS}")
        if key in found:
            raise UsageError(f"{key} stands twice (line {number})", where=path)
        found[key] = rest
    return found


def numbers(lines: Entries, key: str, path: Path, *counts: int) -> Floats:
    """The numbers of a key. `UsageError` if missing, not finite numbers, or not one of `counts` many."""
    if key not in lines:
        raise UsageError(f"{key} is missing", where=path, hint=f"it has {', '.join(lines)}")
    try:
        values = [float(word) for word in lines[key].split()]
    except ValueError:
        raise UsageError(f"{key} holds something that is no number", where=path) from None
    if not all(map(math.isfinite, values)):
        raise UsageError(f"{key} holds a number that is not finite", where=path)
    if len(values) not in counts:
        hint = f"it needs {' or '.join(map(str, counts))}"
        raise UsageError(f"{key} has {len(values)} numbers", where=path, hint=hint)
    return np.array(values, np.float64)


def rigid(matrix: ArrayLike, key: str, path: Path) -> Floats:
    """A 4 x 4 rigid transformation out of a key's numbers, its rotation made orthonormal."""
    try:
        return checked_pose(matrix)
    except UsageError as error:
        raise UsageError(f"{key}: {error.what}", where=path, hint=error.hint) from None


def pinhole(
    K: Floats, key: str, path: Path, size_wh: SizeWH | None, distortion: tuple[float, ...] = ()
) -> PinholeCamera:
    """The camera of a 3 x 3 matrix. `UsageError` if it has skew, or the size of its pictures is unknown."""
    if K[0, 1] != 0 or K[1, 0] != 0 or tuple(K[2]) != (0, 0, 1):
        hint = "fx 0 cx, 0 fy cy, 0 0 1"
        raise UsageError(f"{key} is no camera matrix without skew", where=path, hint=hint)
    if size_wh is None:
        hint = "say their width and height (size_wh)"
        raise UsageError("the calibration does not say how large the pictures are", where=path, hint=hint)
    try:
        fx, fy, cx, cy = (float(k) for k in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        return PinholeCamera(size_wh, fx, fy, cx, cy, distortion)
    except UsageError as error:
        raise UsageError(f"{key}: {error.what}", where=path, hint=error.hint) from None


def read_plain(lines: Entries, path: Path, size_wh: SizeWH | None) -> Rig:
    """The rig of a K, D, T text: camera ``rgb``, distorted, of `size_wh` pixels, and ``T_rgb_lidar``."""
    K = numbers(lines, "K", path, 9).reshape(3, 3)
    distortion = tuple(numbers(lines, "D", path, 4, 5, 8).tolist())
    T = rigid(numbers(lines, "T", path, 12).reshape(3, 4), "T", path)
    return Rig({"rgb": pinhole(K, "K", path, size_wh, distortion)}, {"T_rgb_lidar": T})
