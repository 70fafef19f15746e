"""ROS's camera YAML (camera_calibration_parsers), one camera a file, and ``ros2 topic echo`` of a CameraInfo.

``plumb_bob`` (k1 k2 p1 p2 k3), ``rational_polynomial`` (... k4 k5 k6) and ``equidistant`` (Kannala-Brandt;
also ``fisheye``). Rectification and projection describe images after rectification, of which a rig knows
nothing: they are told and left out. K[0] = 0 is ROS's sign of an uncalibrated camera.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calib.formats.common import (
    Asked,
    Notes,
    Read,
    Written,
    camera_matrix,
    focal,
    lens,
    losses,
    named,
    order,
    padded,
)
from calib.formats.document import Node, table
from fusion.errors import UsageError
from fusion.geometry import FisheyeCamera
from fusion.rig import Rig, RigCamera

FORM = "ROS camera YAML"
_FISHEYE = {"equidistant", "fisheye"}
_PINHOLE = {"plumb_bob", "rational_polynomial", "plumb_bob_to_rational_polynomial", "radtan"}
_FILE = {"w": "image_width", "h": "image_height", "K": "camera_matrix", "D": "distortion_coefficients",
         "R": "rectification_matrix", "P": "projection_matrix"}  # fmt: skip
_ECHO2 = {"w": "width", "h": "height", "K": "k", "D": "d", "R": "r", "P": "p"}
_ECHO1 = {**_ECHO2, "K": "K", "D": "D", "R": "R", "P": "P"}
_IDENTITY = np.eye(3)


def matches(tree: Node) -> bool:
    return _keys(tree) is not None and bool({"distortion_model", "camera_model"} & set(tree.keys))


def read(tree: Node, asked: Asked) -> Read:
    """The rig of one camera: no transformations. `UsageError` names the key."""
    names, notes = named([f"{_name(tree)} {tree.path.stem}"], asked, tree.path)
    camera, more = read_camera(tree)
    return Rig({names[0]: camera}), notes + more


def read_several(trees: list[Node], asked: Asked, folder: Path) -> Read:
    """The rig of a folder's files: their cameras, without transformations."""
    names, notes = named([f"{_name(tree)} {tree.path.stem}" for tree in trees], asked, folder)
    found = [read_camera(tree) for tree in trees]
    notes += tuple(f"{name}: {note}" for name, (_, more) in zip(names, found, strict=True) for note in more)
    return Rig({name: camera for name, (camera, _) in zip(names, found, strict=True)}), notes


def _name(tree: Node) -> str:
    return tree["camera_name"].text() if "camera_name" in tree else ""


def read_camera(tree: Node) -> tuple[RigCamera, Notes]:
    """One camera, and what is not kept of its file."""
    key = _keys(tree) or _FILE
    K = focal(tree[key["K"]].matrix((3, 3)), key["K"], tree.path)
    model = tree["distortion_model" if "distortion_model" in tree else "camera_model"]
    if model.text() not in _FISHEYE | _PINHOLE and model.text() != "":
        hint = "supported: plumb_bob, rational_polynomial, equidistant"
        raise model.error(f"is {model.text()}, which is not supported", hint)
    D = _distortion(tree, key["D"])
    size = tree[key["w"]].whole(), tree[key["h"]].whole()
    camera = lens(size, K, D, key["D"], tree.path, fisheye=model.text() in _FISHEYE)
    return camera, _rectified(tree, key, camera) + _binned(tree)


def write(rig: Rig, path: Path) -> Written:
    """One file if the rig has one camera and `path` a suffix; else a folder of <camera>.yaml."""
    names = order(rig)
    if not names:
        raise UsageError(f"{FORM} needs a camera", hint="the rig has none")
    if len(names) > 1 and path.suffix:
        what = f"{FORM} holds one camera a file; the rig has {', '.join(names)}"
        raise UsageError(what, where=path, hint="give a folder: a file of each camera's name is written")
    files = {path if path.suffix else path / f"{name}.yaml": _text(name, rig.cameras[name]) for name in names}
    return Written(files, losses(rig, FORM, names, []))


def _keys(tree: Node) -> dict[str, str] | None:
    return next((k for k in (_FILE, _ECHO2, _ECHO1) if k["K"] in tree and k["w"] in tree), None)


def _distortion(tree: Node, key: str) -> list[float]:
    node = tree[key]
    inner = (node["data"] if "data" in node.keys else node).value
    return node.numbers(4, 5, 8, 12, 14).tolist() if inner not in ("", []) else []


def _rectified(tree: Node, key: dict[str, str], camera: RigCamera) -> Notes:
    lost = []
    if key["R"] in tree and not np.array_equal(tree[key["R"]].matrix((3, 3)), _IDENTITY):
        lost.append(f"{key['R']} (a turn)")
    if key["P"] in tree:
        P = tree[key["P"]].matrix((3, 4))
        if not np.array_equal(P[:, :3], camera_matrix(camera)):
            lost.append(f"{key['P']} (fx {P[0, 0]:g}, fy {P[1, 1]:g})")
        if P[0, 3] != 0 and P[0, 0] != 0:
            lost.append(f"the baseline in {key['P']}, {-P[0, 3] / P[0, 0]:g} m")
    return (f"of rectified images only, not kept: {', '.join(lost)}",) if lost else ()


def _binned(tree: Node) -> Notes:
    binned = [k for k in ("binning_x", "binning_y") if k in tree and tree[k].whole() > 1]
    offset = "roi" in tree and any(
        tree["roi"][k].whole() for k in ("x_offset", "y_offset", "width", "height") if k in tree["roi"]
    )
    said = binned + ["roi"] * offset
    return (f"{', '.join(said)} not applied: the rig is of the whole, unbinned image",) if said else ()


def _text(name: str, camera: RigCamera) -> str:
    rational = any(camera.distortion[5:])
    model, count = ("rational_polynomial", 8) if rational else ("plumb_bob", 5)
    if isinstance(camera, FisheyeCamera):
        model, count = "equidistant", 4
    D, K = np.array([padded(camera, count, FORM, name)]), camera_matrix(camera)
    w, h = camera.size_wh
    return (
        f"image_width: {w}\nimage_height: {h}\ncamera_name: {name}\n"
        + table("camera_matrix", K)
        + f"distortion_model: {model}\n"
        + table("distortion_coefficients", D)
        + table("rectification_matrix", _IDENTITY)
        + table("projection_matrix", np.column_stack([K, np.zeros(3)]))
    )
