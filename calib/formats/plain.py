"""Calibrations as text of lines ``KEY: numbers``: reading them, and the plain K, D, T form.

K: fx 0 cx 0 fy cy 0 0 1         the camera's matrix, row by row
D: k1 k2 p1 p2 [k3 [k4 k5 k6]]   OpenCV's distortion
T: 12 numbers                    camera from LiDAR, 3 x 4, row by row
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from calib.formats.common import (
    Asked,
    Read,
    Written,
    focal,
    lens,
    losses,
    needed,
    padded,
    rigid,
    without_size,
)
from calib.formats.document import finite_numbers, number
from fusion.errors import UsageError
from fusion.geometry import FisheyeCamera, Floats
from fusion.rig import Rig

FORM = "K, D, T text"
Entries = Mapping[str, str]  # what stands after the colon of each line
FORMS = (
    "rig.toml, a KITTI object calibration (P2, R0_rect, Tr_velo_to_cam), a KITTI raw folder "
    "(calib_cam_to_cam.txt, calib_velo_to_cam.txt), a Kalibr camchain, "
    "ROS camera YAML (a file or a folder of them), OpenCV's FileStorage as YAML, "
    "koide3's calib.json, or K, D, T as text"
)
LARGEST_BYTES = 1 << 20


def read_text(path: Path) -> str:
    """The text of a calibration file. `UsageError` if unreadable, empty, no text, or above 1 MiB."""
    try:
        with path.open("rb") as file:
            data = file.read(LARGEST_BYTES + 1)
    except OSError as error:
        raise UsageError(f"the calibration cannot be read: {error.strerror or error}", where=path) from None
    if len(data) > LARGEST_BYTES:
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
    for at, line in enumerate(text.splitlines(), 1):
        key, colon, rest = line.partition(":")
        key = key.strip()
        if not line.strip():
            continue
        if not (colon and key.isidentifier()):
            raise UsageError(f"line {at} is not KEY: numbers", where=path, hint=f"expected {FORMS}")
        if key in found:
            raise UsageError(f"{key} stands twice (line {at})", where=path)
        found[key] = rest
    return found


def numbers(lines: Entries, key: str, path: Path, *counts: int) -> Floats:
    """The numbers of a key. `UsageError` if missing, not finite numbers, or not one of `counts` many."""
    if key not in lines:
        raise UsageError(f"{key} is missing", where=path, hint=f"it has {', '.join(lines)}")
    return finite_numbers(lines[key].split(), key, path, counts)


def read_plain(lines: Entries, path: Path, asked: Asked) -> Read:
    """The rig of a K, D, T text: camera ``rgb``, distorted, of the size asked for, and ``T_rgb_lidar``."""
    name = asked.names[0] if asked.names else "rgb"
    K = focal(numbers(lines, "K", path, 9).reshape(3, 3), "K", path)
    distortion = numbers(lines, "D", path, 4, 5, 8).tolist()
    T = rigid(numbers(lines, "T", path, 12).reshape(3, 4), "T", path)
    camera = lens(asked.size(name, path), K, distortion, "D", path)
    return Rig({name: camera}, {f"T_{name}_lidar": T}), ()


def write(rig: Rig, path: Path) -> Written:
    """Camera rgb and ``T_rgb_lidar``, without both of which there is no such file."""
    camera = needed(rig, "rgb", FORM)
    if isinstance(camera, FisheyeCamera):
        raise UsageError(f"{FORM} has no fisheye: its D would be read as k1 k2 p1 p2", hint="write rig.toml")
    T = rig.pose("rgb", "lidar")
    D = padded(camera, max(4, len(camera.distortion)), FORM, "rgb")
    K = (camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1)
    text = f"K: {words(K)}\nD: {words(D)}\nT: {words(T[:3])}\n"
    notes = losses(rig, FORM, ["rgb"], ["rgb", "lidar"])
    return Written({path: text}, notes + without_size(FORM, camera))


def words(values: object) -> str:
    """Numbers to the last digit, with spaces between."""
    return " ".join(number(x) for x in np.ravel(np.asarray(values, np.float64)))
