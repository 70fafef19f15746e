"""calib.json of direct_visual_lidar_calibration (Koide et al. 2023, arXiv 2302.05094).

``camera.camera_model`` plumb_bob (k1 k2 p1 p2 k3) or fisheye/equidistant (Kannala-Brandt),
``camera.intrinsics`` fx fy cx cy, and ``results.T_lidar_camera`` x y z qx qy qz qw, which takes the camera's
points to the LiDAR (its issue 46): ``T_lidar_rgb``. Where only a first guess is there
(``init_T_lidar_camera``), that is read, and said. The file does not say how large the pictures are. atan,
omnidir and equirectangular are refused.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from calib.formats.common import (
    Asked,
    Notes,
    Read,
    Written,
    lens,
    losses,
    named,
    needed,
    padded,
    without_size,
)
from calib.formats.document import Node
from fusion.errors import UsageError
from fusion.geometry import FisheyeCamera, Floats, pose, quat_of_rotation, rotation_of_quat
from fusion.rig import Rig

FORM = "koide3's calib.json"
_PINHOLE, _FISHEYE = {"plumb_bob", "rational_polynomial"}, {"fisheye", "equidistant"}
_RESULTS = ("T_lidar_camera", "init_T_lidar_camera", "init_T_lidar_camera_auto")


def matches(tree: Node) -> bool:
    return "camera" in tree and "camera_model" in tree["camera"]


def read(tree: Node, asked: Asked) -> Read:
    """The rig of a calib.json. `UsageError` names the key."""
    topic = tree["meta"] if "meta" in tree else Node({}, tree.path)
    hint = topic["image_topic"].text() if "image_topic" in topic else ""
    names, notes = named([hint], asked, tree.path)
    camera = tree["camera"]
    model, K, D = camera["camera_model"], camera["intrinsics"], camera["distortion_coeffs"]
    if model.text() not in _PINHOLE | _FISHEYE:
        raise model.error(f"is {model.text()}, which is not supported", "supported: plumb_bob, fisheye")
    fisheye = model.text() in _FISHEYE
    coefficients = D.numbers(*((0, 4) if fisheye else (0, 4, 5, 8))).tolist()
    size = asked.size(names[0], tree.path)
    lenses = {names[0]: lens(size, K.numbers(4).tolist(), coefficients, D.key, tree.path, fisheye=fisheye)}
    T, more = _result(tree)
    return Rig(lenses, {} if T is None else {f"T_lidar_{names[0]}": T}), notes + more


def write(rig: Rig, path: Path) -> Written:
    """Camera rgb, and how the LiDAR stands to it as far as the rig says."""
    camera = needed(rig, "rgb", FORM)
    fisheye = isinstance(camera, FisheyeCamera)
    content: dict[str, object] = {
        "camera": {
            "camera_model": "fisheye" if fisheye else "plumb_bob",
            "distortion_coeffs": list(padded(camera, 4 if fisheye else 5, FORM, "rgb")),
            "intrinsics": [float(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy)],
        }
    }
    notes = losses(rig, FORM, ["rgb"], ["rgb", "lidar"])
    try:
        T = rig.pose("lidar", "rgb")
    except UsageError:
        notes += ("the rig does not say how lidar stands to rgb: no results are written",)
    else:
        w, x, y, z = quat_of_rotation(T[:3, :3]).tolist()
        content["results"] = {"T_lidar_camera": [*T[:3, 3].tolist(), x, y, z, w]}
    return Written({path: json.dumps(content, indent=2) + "\n"}, notes + without_size(FORM, camera))


def _result(tree: Node) -> tuple[Floats | None, Notes]:
    results = tree["results"] if "results" in tree else Node({}, tree.path)
    key = next((key for key in _RESULTS if key in results), None)
    if key is None:
        return None, ("no results in the file: intrinsics only",)
    node = results[key]
    x, y, z, *xyzw = node.numbers(7).tolist()
    if abs(np.linalg.norm(xyzw) - 1) > 1e-3:
        raise node.error("holds no unit quaternion", "x y z qx qy qz qw")
    T = pose(rotation_of_quat([xyzw[3], *xyzw[:3]]), (x, y, z))
    return T, () if key == _RESULTS[0] else (f"only a first guess, {node.key}: it was not refined",)
