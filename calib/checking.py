"""Is a rig plausible? Lenses, sizes, axes, links, baselines and overlap, each finding in one line.

Nothing here measures accuracy: it finds what is wrong by kind (millimetres, inverted matrices, axes of
another convention, a calibration of another picture size), and says which reading would make sense.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from calib.formats import SizeWH, read_with_notes
from fusion.errors import UsageError
from fusion.geometry import T_CAM_LIDAR, FisheyeCamera, Floats, invert, transform
from fusion.rig import Rig, RigCamera

Severity = Literal["error", "warning", "note"]
_DISTANCES_M = (1.0, 5.0, 50.0)
_LARGEST_BASELINE_M = {"camera": 2.0, "lidar": 5.0}
_UPRIGHT_DEG = 50.0  # a camera tilted by more than this against the LiDAR is more often a mix-up than a mount
_CLOSURE_M, _CLOSURE_DEG = 2e-3, 0.1
_OLD_DAYS = 365
_IDENTITY = np.eye(4)
# Reading each other way that files are mixed up: what it is, and what the true transformation would then be.
_LIDAR_MIX_UPS = (
    ("inverted", lambda T: invert(T)),
    ("without the rotation to the camera's axes (x right, y down, z forward)", lambda T: T_CAM_LIDAR @ T),
    ("inverted and without the rotation to the camera's axes", lambda T: T_CAM_LIDAR @ invert(T)),
    ("that of a camera hanging upside down", lambda T: np.diag([-1.0, -1, 1, 1]) @ T),
    ("of camera axes y up, z backward (OpenGL's)", lambda T: np.diag([1.0, -1, -1, 1]) @ T),
)
_CAMERA_MIX_UPS = (
    ("from body axes (x forward, y left, z up) on the right", lambda T: T @ invert(T_CAM_LIDAR)),
    ("to body axes (x forward, y left, z up) on the left", lambda T: T_CAM_LIDAR @ T),
    ("that of a camera hanging upside down", lambda T: np.diag([-1.0, -1, 1, 1]) @ T),
)


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing noticed: how bad it is, what it is, what to do next."""

    severity: Severity
    what: str
    hint: str = ""

    def __str__(self) -> str:
        return f"{self.severity}: {self.what}" + (f" ({self.hint})" if self.hint else "")


def check_file(
    path: str | Path,
    *,
    size_wh: Mapping[str, SizeWH] | None = None,
    names: Sequence[str] | None = None,
    now: datetime | None = None,
) -> list[Finding]:
    """`check_rig` of a calibration file of any form; one that cannot be read is an error, not an exception.

    `size_wh` are the sizes of the pictures that the calibration is wanted for, by camera.
    """
    try:
        rig, notes = read_with_notes(path, size_wh, names, any_size=True)
    except UsageError as error:
        return [Finding("error", f"{error.where}: {error.what}" if error.where else error.what, error.hint)]
    return check_rig(rig, size_wh=size_wh, now=now) + [Finding("note", note) for note in notes]


def check_rig(
    rig: Rig, *, size_wh: Mapping[str, SizeWH] | None = None, now: datetime | None = None
) -> list[Finding]:
    """What is wrong or worth knowing of a rig: errors first, then warnings, then notes.

    `size_wh` are the sizes of the pictures it is wanted for, by camera; `now` (default: the clock) dates the
    evidence. A rotation that is no rotation does not come this far: `Rig` refuses it.
    """
    found = [f for name, camera in rig.cameras.items() for f in _lens(name, camera)]
    found += [f for name, size in (size_wh or {}).items() for f in _size(rig, name, size)]
    found += [*_links(rig), *_closures(rig), *_pairs(rig)]
    found += [*_overlaps(rig), *_evidence(rig.evidence, now or datetime.now(UTC))]
    if not rig.cameras:
        found.append(Finding("error", "the rig has no camera"))
    return sorted(found, key=lambda f: ("error", "warning", "note").index(f.severity))


# --- lenses and sizes


def _lens(name: str, camera: RigCamera) -> Iterator[Finding]:
    w = camera.size_wh[0]
    fov_deg = _fov_deg(camera)
    if camera.fx < w / 12:
        hint = "is it in millimetres? f_px = f_mm / pixel pitch in mm"
        yield Finding("error", f"{name}: a focal length of {camera.fx:.4g} px for {w} px of width", hint)
    elif not 3 <= fov_deg <= (220 if isinstance(camera, FisheyeCamera) else 140):
        yield Finding("warning", f"{name}: a field of view of {fov_deg:.3g} degrees", "check fx and the size")
    if abs(math.log(camera.fx / camera.fy)) > 0.05:
        hint = "a picture stretched in one direction, or too few views"
        yield Finding(
            "warning", f"{name}: fx and fy differ by {100 * abs(camera.fx / camera.fy - 1):.0f} %", hint
        )
    yield from _centre(name, camera)
    blind = _blind_share(camera)
    if blind > 0:
        what = f"{name}: {100 * blind:.0f} % of the picture has no direction, its distortion turns over there"
        hint = "boards never reached the corners, or too many coefficients: recalibrate"
        yield Finding("warning", what, hint)
    if not any(camera.distortion) and not isinstance(camera, FisheyeCamera):
        yield Finding("note", f"{name}: no distortion: right for undistorted images only")


def _fov_deg(camera: RigCamera) -> float:
    across = camera.size_wh[0] / camera.fx
    return math.degrees(across if isinstance(camera, FisheyeCamera) else 2 * math.atan(across / 2))


def _centre(name: str, camera: RigCamera) -> Iterator[Finding]:
    w, h = camera.size_wh
    off = max(abs(camera.cx - (w - 1) / 2) / w, abs(camera.cy - (h - 1) / 2) / h)
    what = f"{name}: the principal point ({camera.cx:.1f}, {camera.cy:.1f}) of {w}x{h} pixels"
    if off > 0.5:
        yield Finding("error", f"{what} lies outside", "a calibration of another picture size?")
    elif off > 0.15:
        hint = "right for a cropped picture; else too few tilted boards"
        yield Finding("warning", f"{what} is {100 * off:.0f} % of the picture off its middle", hint)


def _blind_share(camera: RigCamera) -> float:
    """The share of the picture, corners included, whose pixels no direction falls on."""
    uv = _grid(camera, 25, 19)
    rays = camera.unproject(uv)
    known = np.asarray(np.isfinite(rays).all(1), bool)
    back, seen = camera.project(rays[known])
    known[known] = seen & (np.abs(back - uv[known]).max(1) < 0.5)
    return float(1 - known.mean())


def _grid(camera: RigCamera, columns: int, rows: int) -> Floats:
    w, h = camera.size_wh
    u, v = np.meshgrid(np.linspace(0, w - 1, columns), np.linspace(0, h - 1, rows))
    return np.column_stack([u.ravel(), v.ravel()])


def _size(rig: Rig, name: str, size: SizeWH) -> Iterator[Finding]:
    if name not in rig.cameras:
        hint = f"it has {', '.join(rig.cameras) or 'none'}"
        yield Finding("error", f"{name}: pictures, but no camera of that name in the rig", hint)
        return
    w, h = rig.cameras[name].size_wh
    W, H = size
    if tuple(size) == (w, h):
        return
    what = f"{name}: the calibration is of {w}x{h} pixels, the pictures are {W}x{H}"
    if abs(W / w - H / h) < 0.01 * W / w:
        hint = f"a pure rescale by {W / w:.4g}: so are fx, fy, and (cx + 0.5), (cy + 0.5)"
    elif tuple(size) == (h, w):
        hint = "turned by 90 degrees: turn the pictures back"
    elif w >= W and h >= H:
        hint = "a crop? then cx, cy move by what was cut at the left and the top; the focal length stays"
    else:
        hint = "neither a rescale nor a crop: the calibration of another camera or mode"
    yield Finding("error", what, hint)


# --- links


def _sensors(rig: Rig) -> list[str]:
    linked = [sensor for name in rig.transforms for sensor in name.split("_")[1:]]
    return list(dict.fromkeys([*rig.cameras, *linked]))


def _known(rig: Rig, dst: str, src: str) -> Floats | None:
    try:
        return rig.pose(dst, src)
    except UsageError:
        return None


def _links(rig: Rig) -> Iterator[Finding]:
    sensors = _sensors(rig)
    groups: list[list[str]] = []
    for sensor in sensors:
        group = next((g for g in groups if _known(rig, g[0], sensor) is not None), None)
        groups.append([sensor]) if group is None else group.append(sensor)
    if len(groups) > 1:
        told = " | ".join(", ".join(group) for group in groups)
        hint = f"calibrate a pair across, such as {groups[0][0]} and {groups[1][0]}"
        yield Finding("warning", f"sensors are not connected: {told}", hint)
    bare = [s for s in sensors if s not in rig.cameras and s not in ("lidar", "imu")]
    if bare:
        what = f"a transformation names {', '.join(bare)}, which is no camera of the rig"
        yield Finding("note", what, f"it has {', '.join(rig.cameras) or 'none'}")


def _closures(rig: Rig) -> Iterator[Finding]:
    """Transformations that the others contradict."""
    for name, T in rig.transforms.items():
        rest = Rig({}, {other: X for other, X in rig.transforms.items() if other != name})
        dst, src = name.split("_")[1:]
        chained = _known(rest, dst, src)
        if chained is None:
            continue
        off = invert(chained) @ T
        off_m, off_deg = float(np.linalg.norm(off[:3, 3])), _angle_deg(off)
        if off_m > _CLOSURE_M or off_deg > _CLOSURE_DEG:
            what = f"{name} and the way round the other transformations differ by {_length(off_m)}"
            yield Finding(
                "warning", f"{what} and {off_deg:.3g} degrees", "one of them is of another calibration"
            )
            return  # every transformation of the loop would say the same


def _pairs(rig: Rig) -> Iterator[Finding]:
    """Of the transformations as they stand: what follows from one that is wrong would say the same again."""
    for name, T in rig.transforms.items():
        a, b = name.split("_")[1:]
        both = a in rig.cameras and b in rig.cameras
        yield from _baseline(a, b, T, "camera" if both else "lidar")
        if both:
            yield from _two_cameras(a, b, T)
        elif b == "lidar" and a in rig.cameras:
            yield from _camera_lidar(a, T)
        elif a == "lidar" and b in rig.cameras:
            yield from _camera_lidar(b, invert(T))


def _baseline(a: str, b: str, T: Floats, kind: str) -> Iterator[Finding]:
    length_m, limit = float(np.linalg.norm(T[:3, 3])), _LARGEST_BASELINE_M[kind]
    if np.array_equal(T, _IDENTITY):
        yield Finding(
            "warning", f"{a} and {b} stand at the same place, not turned: T_{a}_{b} was never measured"
        )
    elif length_m > limit:
        inch = 0.005 <= length_m / 1000 <= limit
        hint = (
            f"millimetres? Then divide by 1000: {_length(length_m / 1000)}" if inch else "lengths are metres"
        )
        yield Finding("error" if inch else "warning", f"{a} and {b} are {length_m:.4g} m apart", hint)
    else:
        yield Finding("note", f"{a} and {b} are {_length(length_m)} apart")


def _length(metres: float) -> str:
    return f"{metres:.3g} m" if metres >= 1 else f"{1000 * metres:.3g} mm"


def _angle_deg(T: Floats) -> float:
    """How far a transformation turns."""
    R = T[:3, :3]
    sine = np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return math.degrees(math.atan2(float(sine), float(np.trace(R)) - 1))


def _two_cameras(a: str, b: str, T: Floats) -> Iterator[Finding]:
    apart = _angle_deg(T)
    if apart <= _UPRIGHT_DEG:
        return
    best = min(_CAMERA_MIX_UPS, key=lambda mix: _angle_deg(mix[1](T)))
    left = _angle_deg(best[1](T))
    hint = f"read as {best[0]}, it would be {left:.3g}" if left < _UPRIGHT_DEG / 2 else "check the rotation"
    yield Finding("warning", f"{a} and {b} are turned {apart:.3g} degrees to each other", hint)


def _camera_lidar(camera: str, T: Floats) -> Iterator[Finding]:
    """T_camera_lidar: the LiDAR's up (z) should be up in the picture (-y), its forward (x) mostly forward."""
    tilt, aside = _tilt_deg(T), _aside_deg(T)
    if tilt <= _UPRIGHT_DEG:
        if aside > 60:
            what = f"{camera} looks {aside:.3g} degrees off the LiDAR's forward (x)"
            yield Finding("note", what, "right for a camera to the side or back")
        return
    what = f"T_{camera}_lidar has the LiDAR's up {tilt:.3g} degrees off the picture's up"
    off = [(_angle_deg(mended(T) @ invert(T_CAM_LIDAR)), way) for way, mended in _LIDAR_MIX_UPS]
    best, way = min(off, key=lambda pair: pair[0])
    if best < _UPRIGHT_DEG:
        others = [w for angle, w in off if w != way and abs(angle - best) < 0.1]
        ways = " or ".join([way, *others])
        yield Finding("error", what, f"it makes sense as {ways}: then {best:.3g} degrees off straight ahead")
    else:
        hint = "LiDAR: x forward, y left, z up; camera: x right, y down, z forward"
        yield Finding("warning", f"{what}, and no usual mix-up explains it", hint)


def _tilt_deg(T: Floats) -> float:
    return math.degrees(math.acos(float(np.clip(-T[1, 2], -1, 1))))


def _aside_deg(T: Floats) -> float:
    return math.degrees(math.acos(float(np.clip(T[2, 0], -1, 1))))


# --- overlap


def _overlaps(rig: Rig) -> Iterator[Finding]:
    rgb = rig.cameras.get("rgb")
    if rgb is None:
        return
    fir, T_fir_rgb = rig.cameras.get("fir"), _known(rig, "fir", "rgb")
    if fir is not None and T_fir_rgb is not None:
        shares = [overlap(rgb, fir, T_fir_rgb, at) for at in _DISTANCES_M]
        told = ", ".join(f"{100 * s:.0f} % at {m:g} m" for s, m in zip(shares, _DISTANCES_M, strict=True))
        thin = max(shares[1:]) < 0.1
        hint = "the cameras do not look the same way, or the transformation is wrong" if thin else ""
        yield Finding("error" if thin else "note", f"of rgb's picture, fir sees {told}", hint)
    T_lidar_rgb = _known(rig, "lidar", "rgb")
    if T_lidar_rgb is not None:
        share = _near_horizon(rgb, T_lidar_rgb, 15.0)
        what = f"of rgb's picture, {100 * share:.0f} % is within 15 degrees of the LiDAR's horizon at 10 m"
        hint = "a LiDAR of few rings would hardly be seen" if share < 0.1 else ""
        yield Finding("warning" if share < 0.1 else "note", what, hint)


def overlap(rgb: RigCamera, fir: RigCamera, T_fir_rgb: Floats, distance_m: float) -> float:
    """The share [0, 1] of `rgb`'s picture that `fir` sees too, of a world `distance_m` away (range)."""
    rays = rgb.unproject(_grid(rgb, 48, 36))
    known = np.isfinite(rays).all(1)
    uv, seen = fir.project(transform(T_fir_rgb, distance_m * rays[known]))
    w, h = fir.size_wh
    inside = seen & (uv >= -0.5).all(1) & (uv[:, 0] <= w - 0.5) & (uv[:, 1] <= h - 0.5)
    return float(inside.sum() / len(rays))


def _near_horizon(rgb: RigCamera, T_lidar_rgb: Floats, limit_deg: float) -> float:
    rays = rgb.unproject(_grid(rgb, 48, 36))
    x, y, z = transform(T_lidar_rgb, 10.0 * rays[np.isfinite(rays).all(1)]).T
    return float((np.abs(np.degrees(np.arctan2(z, np.hypot(x, y)))) <= limit_deg).sum() / len(rays))


# --- evidence


def _evidence(evidence: Mapping[str, Any], now: datetime) -> Iterator[Finding]:
    if not evidence:
        yield Finding("note", "the file says nothing of how good it is", "calibrate here for a verdict")
        return
    days = [(now.date() - day).days for day in _dates(evidence)]
    if days and min(days) > _OLD_DAYS:
        yield Finding("warning", f"the calibration is {min(days)} days old", "check it on a new recording")


def _dates(value: Any) -> Iterator[date]:
    """All dates in tables and lists of TOML, as its own type or as text."""
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for part in value:
            yield from _dates(part)
    elif isinstance(value, datetime):
        yield value.date()
    elif isinstance(value, date):
        yield value
    elif isinstance(value, str) and len(value) <= 40:
        try:
            yield datetime.fromisoformat(value).date()
        except ValueError:
            return
