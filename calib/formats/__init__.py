"""Calibrations of other tools, read as a `fusion.rig.Rig`. The form is told by content, not by name."""

from __future__ import annotations

import re
from pathlib import Path

from calib.formats import kitti, plain
from calib.formats.plain import FORMS, SizeWH
from fusion.errors import UsageError
from fusion.rig import Rig, load_rig


def read_rig(path: str | Path, size_wh: SizeWH | None = None) -> Rig:
    """The rig that a calibration file, or the folder of a KITTI raw recording, describes.

    `size_wh` is the size of the pictures of camera ``rgb``: required where the form does not say it (KITTI
    object, K D T text). Rotations are made orthonormal (files round them). Raises `UsageError` that names
    file and key for whatever is wrong, another size than the form's included.
    """
    path = Path(path)
    rig = _read(path, size_wh)
    camera = rig.cameras.get("rgb")
    if size_wh is not None and camera is not None and tuple(size_wh) != tuple(camera.size_wh):
        theirs, ours = ("{}x{}".format(*size) for size in (camera.size_wh, size_wh))
        raise UsageError(f"the calibration is for pictures of {theirs} pixels, not {ours}", where=path)
    return rig


def _read(path: Path, size_wh: SizeWH | None) -> Rig:
    if path.is_dir():
        if not any((path / name).exists() for name in (kitti.CAMERAS_FILE, kitti.LIDAR_FILE)):
            raise UsageError("no calibration in this folder", where=path, hint=f"expected {FORMS}")
        return kitti.read_raw(path)
    text = plain.read_text(path)
    if re.search(r"^[ \t]*(\[|[\w.\"'-]+[ \t]*=)", text, re.MULTILINE):
        return load_rig(path)
    lines = plain.entries(text, path)
    if "P_rect_02" in lines or {"R", "T", "delta_f"} <= lines.keys():
        return kitti.read_raw(path.parent)
    if lines.keys() & {"P2", "R0_rect", "Tr_velo_to_cam"}:
        return kitti.read_object(lines, path, size_wh)
    if lines.keys() & {"K", "D"}:
        return plain.read_plain(lines, path, size_wh)
    raise UsageError("no calibration of a known form", where=path, hint=f"expected {FORMS}")
