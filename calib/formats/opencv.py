"""OpenCV's FileStorage, as YAML or JSON: the keys its samples and everybody's scripts use.

One camera: ``camera_matrix``, ``distortion_coefficients``, ``image_width``, ``image_height`` (also
cameraMatrix, distCoeffs, K, D, mtx, dist, image_size ...). Two: the same with a number or side at the end
(``M1 D1 M2 D2``, ``K_left``). ``R``, ``T`` (metres) are those of `cv2.stereoCalibrate`: they take points of
the first camera to the second, so they are T_<second>_<first>. ``fisheye_model: 1`` is Kannala-Brandt, as
OpenCV's calibration sample says it. What the form has no word for is written as keys of our own, which
FileStorage carries: matrices ``T_dst_src``, ``camera_name``, ``time_offset_s_<sensor>``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
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
    named,
    order,
    padded,
    rigid,
)
from calib.formats.document import Node, number, table
from fusion.errors import UsageError
from fusion.geometry import FisheyeCamera, Floats, pose
from fusion.rig import Rig, RigCamera

FORM = "OpenCV's FileStorage"
_SPELLINGS = {
    "matrix": "cameramatrix cameramat intrinsicmatrix intrinsics k m mtx cm",
    "distortion": "distortioncoefficients distortioncoeffs distcoeffs distcoeff distortion dist d",
    "width": "imagewidth width",
    "height": "imageheight height",
    "size": "imagesize size",
    "fisheye": "fisheyemodel isfisheye",
    "model": "distortionmodel distmodel cameramodel",
    "name": "cameraname",
}
_ROLES = {word: role for role, words in _SPELLINGS.items() for word in words.split()}
_SUFFIX = re.compile(r"(.*?)(\d|left|right)?")
_TRANSFORM = re.compile(r"T_[a-z0-9]+_[a-z0-9]+")
_OFFSET = "time_offset_s_"
_FISHEYE = {"fisheye", "equidistant", "kannalabrandt", "kannala_brandt", "kb4"}
_PINHOLE = {"", "pinhole", "plumb_bob", "radtan", "rational_polynomial", "standard"}

Cameras = Mapping[str, Mapping[str, Node]]  # by suffix, in the file's numbering: what each role's key holds


def matches(tree: Node) -> bool:
    return any("matrix" in roles and "distortion" in roles for roles in _cameras(tree).values())


def read(tree: Node, asked: Asked) -> Read:
    """The rig of a file with one camera or more. Sizes the file does not say are taken from `asked`."""
    found = {s: roles for s, roles in _cameras(tree).items() if {"matrix", "distortion"} <= roles.keys()}
    hints = [roles["name"].text() if "name" in roles else "" for roles in found.values()]
    names, notes = _names(hints, asked, tree.path)
    cameras = {n: _camera(roles, asked, n) for n, roles in zip(names, found.values(), strict=True)}
    transforms = _stereo(tree, names) | {
        key: rigid(tree[key].matrix((4, 4), (3, 4)), key, tree.path)
        for key in tree.keys
        if _TRANSFORM.fullmatch(key)
    }
    if "R" in tree and "T" in tree:
        notes += ("T is taken as metres, which it is if the board was measured in metres",)
    offsets = {k.removeprefix(_OFFSET): float(tree[k].numbers(1)[0]) for k in tree.keys if _OFFSET in k}
    return Rig(cameras, transforms, time_offset_s=offsets), notes + _unread(tree, found, transforms)


def write(rig: Rig, path: Path) -> Written:
    """Everything: OpenCV's own names for one camera, with 1, 2 ... for more; R, T of the first two."""
    names = order(rig)
    if not names:
        raise UsageError(f"{FORM} needs a camera", hint="the rig has none")
    text, notes = "%YAML:1.0\n---\n", losses(rig, FORM, names, _sensors(rig), time=True)
    for i, name in enumerate(names, 1):
        text += _text(name, rig.cameras[name], str(i) if len(names) > 1 else "")
    direct = f"T_{names[1]}_{names[0]}" if len(names) > 1 else ""
    T = known_pose(rig, names[1], names[0]) if direct else None
    if T is not None:
        text += table("R", T[:3, :3], " !!opencv-matrix", "   ", {"dt": "d"})
        text += table("T", T[:3, 3:], " !!opencv-matrix", "   ", {"dt": "d"})
    own = {key: T for key, T in rig.transforms.items() if key != direct}
    text += "".join(table(k, T, " !!opencv-matrix", "   ", {"dt": "d"}) for k, T in own.items())
    text += "".join(f"{_OFFSET}{name}: {number(s)}\n" for name, s in rig.time_offset_s.items())
    extra = [*own, *(f"{_OFFSET}{name}" for name in rig.time_offset_s)]
    if extra:
        notes += (f"written under names that only this package reads by itself: {', '.join(extra)}",)
    return Written({path: text}, notes)


# --- reading


def _cameras(tree: Node) -> dict[str, dict[str, Node]]:
    """Keys by the camera's number or side, and by role; sides and numbers in order."""
    found: dict[str, dict[str, Node]] = {}
    for key in tree.keys:
        plain = re.sub(r"[_\- ]", "", key).lower()
        parts = _SUFFIX.fullmatch(plain)
        stem, suffix = parts.groups() if parts else (plain, None)
        if (role := _ROLES.get(str(stem))) is None:
            continue
        roles = found.setdefault(suffix or "", {})
        if role in roles:
            raise UsageError(f"{key} and {roles[role].key} say the same thing", where=tree.path)
        roles[role] = tree[key]
    shared = ("width", "height", "size", "fisheye", "model")
    common = {role: node for role, node in found.get("", {}).items() if role in shared}
    return {s: (common | found[s]) if s else found[s] for s in sorted(found)}


def _names(hints: list[str], asked: Asked, path: Path) -> tuple[tuple[str, ...], Notes]:
    usable = all(re.fullmatch(r"[a-z0-9]+", hint) for hint in hints) and len(set(hints)) == len(hints)
    if asked.names is None and usable:
        return tuple(hints), ()  # our own files give each camera its name
    return named(hints, asked, path)


def _camera(roles: Mapping[str, Node], asked: Asked, name: str) -> RigCamera:
    matrix, distortion = roles["matrix"], roles["distortion"]
    K = focal(matrix.matrix((3, 3)), matrix.key, matrix.path)
    D = distortion.numbers(0, 1, 4, 5, 8, 12, 14).tolist()
    if len(D) == 1:
        raise distortion.error("has 1 number", "it needs 4 or 5 or 8")
    size = _size(roles) or asked.size(name, matrix.path)
    return lens(size, K, D, distortion.key, distortion.path, fisheye=_is_fisheye(roles))


def _size(roles: Mapping[str, Node]) -> SizeWH | None:
    if "width" in roles and "height" in roles:
        return roles["width"].whole(), roles["height"].whole()
    if "size" not in roles:
        return None
    w, h = roles["size"].numbers(2).tolist()
    return int(w), int(h)


def _is_fisheye(roles: Mapping[str, Node]) -> bool:
    if "fisheye" in roles and roles["fisheye"].text().lower() in ("1", "true"):
        return True
    model = roles["model"].text().lower() if "model" in roles else ""
    if model not in _FISHEYE | _PINHOLE:
        hint = f"supported: {', '.join(sorted(_FISHEYE | _PINHOLE - {''}))}"
        raise roles["model"].error(f"is {model}, which is not supported", hint)
    return model in _FISHEYE


def _stereo(tree: Node, names: tuple[str, ...]) -> dict[str, Floats]:
    if len(names) < 2 or "R" not in tree or "T" not in tree:
        return {}
    R = rigid(pose(tree["R"].matrix((3, 3))), "R", tree.path)[:3, :3]
    return {f"T_{names[1]}_{names[0]}": pose(R, tree["T"].numbers(3))}


def _unread(tree: Node, found: Cameras, transforms: Mapping[str, Floats]) -> Notes:
    read = {node.key for roles in found.values() for node in roles.values()} | set(transforms)
    if len(found) > 1:
        read |= {"R", "T"}
    left = [key for key in tree.keys if key not in read and _OFFSET not in key]
    return (f"not read: {', '.join(left)}",) if left else ()


# --- writing


def _text(name: str, camera: RigCamera, suffix: str) -> str:
    fisheye = isinstance(camera, FisheyeCamera)
    count = 4 if fisheye else len(camera.distortion) or 5
    K = camera_matrix(camera)
    D = np.array([padded(camera, count, FORM, name)])
    w, h = camera.size_wh
    return (
        f"camera_name{suffix}: {name}\nimage_width{suffix}: {w}\nimage_height{suffix}: {h}\n"
        f"fisheye_model{suffix}: {int(fisheye)}\n"
        + table(f"camera_matrix{suffix}", K, " !!opencv-matrix", "   ", {"dt": "d"})
        + table(f"distortion_coefficients{suffix}", D, " !!opencv-matrix", "   ", {"dt": "d"})
    )


def _sensors(rig: Rig) -> set[str]:
    return {sensor for name in rig.transforms for sensor in name.split("_")[1:]}
