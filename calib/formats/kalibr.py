"""Kalibr's camchain YAML (its wiki, "Yaml formats" and "Supported models").

Pinhole with distortion ``radtan`` (k1 k2 p1 p2), ``equidistant`` (Kannala-Brandt k1 to k4) or ``none``; the
models omni, ds, eucm and the distortion fov are refused. ``T_cn_cnm1`` takes points of the camera before to
this one: camN's is ``T_<camN>_<camN-1>``. ``T_cam_imu`` takes the IMU's points to the camera:
``T_<cam>_imu``. ``timeshift_cam_imu``: t_imu = t_cam + shift.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from calib.formats.common import (
    Asked,
    Notes,
    Read,
    Written,
    known_pose,
    lens,
    losses,
    named,
    order,
    padded,
    rigid,
)
from calib.formats.document import Node, flow, number
from fusion.errors import UsageError
from fusion.geometry import FisheyeCamera, Floats
from fusion.rig import Rig, RigCamera

FORM = "a Kalibr camchain"
_COUNTS = {"radtan": 4, "plumb_bob": 4, "equidistant": 4, "equi": 4, "none": 0}
_READ = {"camera_model", "intrinsics", "distortion_model", "distortion_coeffs", "resolution", "rostopic"}
_READ |= {"T_cn_cnm1", "T_cam_imu", "timeshift_cam_imu", "cam_overlaps"}


def matches(tree: Node) -> bool:
    return any(re.fullmatch(r"cam\d+", key) and "intrinsics" in tree[key] for key in tree.keys)


def read(tree: Node, asked: Asked) -> Read:
    """The rig of a camchain. `UsageError` names the key that is wrong, or not of a model that we have."""
    keys = sorted((k for k in tree.keys if re.fullmatch(r"cam\d+", k)), key=lambda k: int(k[3:]))
    cams = [tree[key] for key in keys]
    names, notes = named([_hint(cam) for cam in cams], asked, tree.path)
    cameras = {name: _camera(cam) for name, cam in zip(names, cams, strict=True)}
    transforms: dict[str, Floats] = {}
    for i, cam in enumerate(cams):
        if i and "T_cn_cnm1" in cam:
            transforms[f"T_{names[i]}_{names[i - 1]}"] = _pose(cam["T_cn_cnm1"])
    notes += _imu(transforms, names, cams)
    shifts = {n: float(c["timeshift_cam_imu"].numbers(1)[0]) for n, c in zip(names, cams, strict=True)
              if "timeshift_cam_imu" in c}  # fmt: skip
    offsets, more = _offsets(shifts, names)
    unread = sorted({key for cam in cams for key in cam.keys} - _READ | set(tree.keys) - set(keys))
    notes += more + ((f"not read: {', '.join(unread)}",) if unread else ())
    return Rig(cameras, transforms, time_offset_s=offsets), notes


def write(rig: Rig, path: Path) -> Written:
    """A camchain of all the rig's cameras, rgb first. `UsageError` for lenses or a chain it cannot say."""
    names = order(rig)
    if not names:
        raise UsageError(f"{FORM} needs a camera", hint="the rig has none")
    text = "".join(_entry(rig, names, i) for i in range(len(names)))
    notes = losses(rig, FORM, names, [*names, "imu"], time=True)
    topics = ", ".join(f"/{name}/image_raw" for name in names)
    return Written({path: text}, (*notes, f"rostopic is made up: {topics}"))


# --- reading


def _hint(cam: Node) -> str:
    return cam["rostopic"].text() if "rostopic" in cam else ""


def _camera(cam: Node) -> RigCamera:
    model, kind = cam["camera_model"].text(), cam["distortion_model"].text()
    if model != "pinhole":
        hint = "of Kalibr's models, pinhole with radtan, equidistant or none is supported: calibrate with one"
        raise cam["camera_model"].error(f"is {model}, which is not supported", hint)
    if kind not in _COUNTS:
        hint = "supported: radtan, equidistant, none"
        raise cam["distortion_model"].error(f"is {kind}, which is not supported", hint)
    D = cam["distortion_coeffs"].numbers(_COUNTS[kind]).tolist() if _COUNTS[kind] else []
    w, h = cam["resolution"].numbers(2).tolist()
    if not (w.is_integer() and h.is_integer()):
        raise cam["resolution"].error("holds no whole numbers of pixels")
    key = cam["intrinsics"]
    return lens((int(w), int(h)), key.numbers(4).tolist(), D, key.key, key.path, fisheye=kind[:4] == "equi")


def _pose(node: Node) -> Floats:
    return rigid(node.matrix((4, 4), (3, 4)), node.key, node.path)


def _imu(transforms: dict[str, Floats], names: tuple[str, ...], cams: list[Node]) -> Notes:
    """Puts T_<cam>_imu of the first camera that has one in, and of others that no chain links to it."""
    notes: Notes = ()
    for name, cam in zip(names, cams, strict=True):
        if "T_cam_imu" not in cam:
            continue
        T = _pose(cam["T_cam_imu"])
        try:
            chained = Rig({}, transforms).pose(name, "imu")
        except UsageError:
            transforms[f"T_{name}_imu"] = T
            continue
        off_m = float(np.abs(chained[:3, 3] - T[:3, 3]).max())
        off_rad = float(np.abs(chained[:3, :3] - T[:3, :3]).max())
        if off_m > 1e-3 or off_rad > 1e-3:
            what = f"contradicts the chain of T_cn_cnm1 by {off_m:.3g} m and {off_rad:.3g} rad"
            raise cam["T_cam_imu"].error(what, "the file was put together from two calibrations")
        notes += (f"{cam.key}.T_cam_imu follows from the chain and is not kept apart",)
    return notes


def _offsets(shifts: dict[str, float], names: tuple[str, ...]) -> tuple[dict[str, float], Notes]:
    """Time offsets to the IMU's clock, where all cameras have one: one alone says nothing of a pair."""
    if len(names) > 1 and len(shifts) == len(names):
        return shifts, ()
    told = ", ".join(f"{name} {shift:g} s" for name, shift in shifts.items())
    return {}, (f"timeshift_cam_imu is not kept, not every camera has one: {told}",) if shifts else ()


# --- writing


def _entry(rig: Rig, names: list[str], i: int) -> str:
    name, camera = names[i], rig.cameras[names[i]]
    fisheye = isinstance(camera, FisheyeCamera)
    lines = [f"cam{i}:"]
    if i:
        lines += ["  T_cn_cnm1:", *_rows(_link(rig, name, names[i - 1]))]
    if (T := known_pose(rig, name, "imu")) is not None:
        lines += ["  T_cam_imu:", *_rows(T)]
    lines += [
        f"  cam_overlaps: [{', '.join(str(k) for k in range(len(names)) if k != i)}]",
        "  camera_model: pinhole",
        f"  distortion_coeffs: {flow(padded(camera, 4, FORM, name))}",
        f"  distortion_model: {'equidistant' if fisheye else 'radtan'}",
        f"  intrinsics: {flow([camera.fx, camera.fy, camera.cx, camera.cy])}",
        f"  resolution: [{camera.size_wh[0]}, {camera.size_wh[1]}]",
        f"  rostopic: /{name}/image_raw",
    ]
    if rig.time_offset_s:
        lines.append(f"  timeshift_cam_imu: {number(rig.time_offset_s.get(name, 0.0))}")
    return "\n".join(lines) + "\n"


def _link(rig: Rig, dst: str, src: str) -> Floats:
    T = known_pose(rig, dst, src)
    if T is None:
        hint = f"add T_{src}_{dst}, or write each camera by itself"
        raise UsageError(f"{FORM} needs how {dst} stands to {src}: the rig does not say", hint=hint)
    return T


def _rows(T: Floats) -> list[str]:
    return [f"  - {flow(row)}" for row in T]
