"""A calibration: cameras, how sensors stand to each other, clocks."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fusion.errors import InputError, UsageError
from fusion.geometry import PinholeCamera
from fusion.inspect.base import Asked, Finding, InspectKind, steps_of
from fusion.rig import FORMAT, Rig, RigCamera, load_rig

_HEAD_BYTES = 1 << 24


def format_of(path: Path) -> str | None:
    """The ``format`` line of a TOML file; None where it is none, or has none."""
    if path.suffix.lower() != ".toml" or not path.is_file() or path.stat().st_size > _HEAD_BYTES:
        return None
    try:
        said = tomllib.loads(path.read_bytes().decode("utf-8-sig")).get("format")
    except (OSError, ValueError, RecursionError):
        return None
    return said if isinstance(said, str) else None


def look_at_rig(path: Path, _: Asked) -> Finding:
    try:
        return finding_of(path, load_rig(path), "a rig")
    except UsageError as error:
        raise InputError(error.what, where=path, hint=error.hint) from None


def finding_of(path: Path, rig: Rig, title: str, notes: Sequence[str] = (), *, sizes: bool = True) -> Finding:
    """What a rig says, whatever file it came from; without `sizes` its cameras' are not known, and not
    told.
    """
    facts: dict[str, Any] = {
        f"camera_{name}": _camera(camera, sizes) for name, camera in sorted(rig.cameras.items())
    }
    for name, T in sorted(rig.transforms.items()):
        angle = math.degrees(math.acos(float(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1))))
        facts[name] = {
            "metres_apart": round(float(np.linalg.norm(T[:3, 3])), 4),
            "turned_deg": round(angle, 3),
        }
    if rig.time_offset_s:
        facts["clock_offset_s"] = dict(rig.time_offset_s)
    facts["evidence"] = bool(rig.evidence)
    return Finding(str(path), "rig", title, facts, notes=tuple(notes), steps=_steps(path, rig))


def _camera(camera: RigCamera, sizes: bool) -> dict[str, Any]:
    said: dict[str, Any] = {"model": "pinhole" if isinstance(camera, PinholeCamera) else "fisheye"}
    if sizes:
        said["size"] = "x".join(map(str, camera.size_wh))
    said |= {"fx": round(camera.fx, 3), "fy": round(camera.fy, 3)}
    said |= {"cx": round(camera.cx, 3), "cy": round(camera.cy, 3), "coefficients": len(camera.distortion)}
    if sizes and isinstance(camera, PinholeCamera):
        said["view_deg"] = round(2 * math.degrees(math.atan(camera.size_wh[0] / 2 / camera.fx)), 2)
    return said


def _steps(path: Path, rig: Rig) -> Any:
    steps: list[tuple[list[object], str]] = [
        (["fusion", "calibrate", "check", path], "is it plausible? (cameras, axes, links)")
    ]
    if {"rgb", "fir"} <= rig.cameras.keys():
        steps.append(
            (["fusion", "blend", "RGB", "FIR", "--rig", path, "-o", "OUT"], "fuse images by this rig")
        )
    if rig.cameras and any("lidar" in name for name in rig.transforms):
        steps.append((["fusion", "depth", "CLOUDS", "--rig", path, "-o", "OUT"], "depth for its camera"))
    return steps_of(*steps)


RIG = InspectKind("a rig.toml", lambda path: format_of(path) == FORMAT, look_at_rig)
