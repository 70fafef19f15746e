"""What makes a run what it is: enough to repeat it, and nothing that changes from run to run."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fusion.rig_warp import DepthWarp
from fusion.warp import Warp

if TYPE_CHECKING:
    from fusion.fusing import FrameFuser
    from fusion.lidar.lane import DepthLane
    from fusion.pipeline import Fuser

DEPTH_LIBRARIES = ("numpy", "opencv-contrib-python-headless", "numba", "scipy")
LIBRARIES = ("numpy", "opencv-contrib-python-headless", "numba", "simplejpeg", "fpng", "isal")


def describe_run(fuser: Fuser) -> dict[str, Any]:
    """Nested, TOML-able: versions, inputs, effective configuration, registration, windows.

    The inputs are known by their paired names, not by their paths, so that a moved data set is still
    the same run; registration files are known by the SHA-256 of their bytes, a rig by its numbers.
    """
    config = fuser.config.model_dump(exclude_none=True)
    del config["strict"]  # changes where a run stops, not what it writes
    for key in ("homography", "points"):
        if key in config["warp"]:
            config["warp"][key] = _file_mark(config["warp"][key])
    for key in ("rig", "depth"):  # the rig is known by its numbers, depth maps by their names
        config["warp"].pop(key, None)
    if "map" in config["pairing"]:
        config["pairing"]["map"] = _file_mark(config["pairing"]["map"])
    return {
        "versions": versions(),
        "inputs": {
            "pairs": len(fuser),
            "unmatched": len(fuser.pairs.pairing.unmatched),
            "names_sha256": digest("\0".join(fuser.pairs.stems(index)) for index in range(len(fuser))),
            **_depth_inputs(fuser),
        },
        "config": plain(config),
        "registration": describe_registration(fuser),
        "window": fuser.windows.record(),
    }


def describe_depth(lane: DepthLane, stems: Sequence[str], given: Mapping[str, bool]) -> dict[str, Any]:
    """The same of a run over clouds: versions, inputs, effective configuration, the camera as it is.

    `given` says what else the run looks at; the rig is known by its numbers.
    """
    config = lane.config.model_dump(exclude_none=True)
    del config["strict"]
    config["camera"].pop("rig", None)
    camera = {"kind": type(lane.camera).__name__, **asdict(lane.camera)}  # type: ignore[call-overload]
    return {
        "versions": versions(DEPTH_LIBRARIES),
        "inputs": {"frames": len(stems), "names_sha256": digest(stems), **given},
        "config": plain(config),
        "camera": plain(camera),
        "T_cam_lidar": lane.T_cam_lidar.tolist(),
        "value": lane.value,
    }


def versions(libraries: Sequence[str] = LIBRARIES) -> dict[str, str]:
    """Of ourselves, Python and the libraries that decide about pixels."""
    own = {"fusion": version("fusionprep"), "python": platform.python_version()}
    return {**own, **{name: _version(name) for name in libraries}}


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:  # fpng and isal have stand-ins; the files' bytes, not their pixels, differ
        return "none"


def digest(names: Iterable[str]) -> str:
    """SHA-256 of names in their order."""
    total = hashlib.sha256()
    for name in names:
        total.update(name.encode("utf-8", "surrogateescape") + b"\n")
    return total.hexdigest()


def _file_mark(path: str) -> str:
    return f"{Path(path).name} sha256:{hashlib.sha256(Path(path).read_bytes()).hexdigest()}"


def _depth_inputs(fuser: Fuser) -> dict[str, Any]:
    from fusion.pipeline import PairsWithDepth

    if not isinstance(fuser.pairs, PairsWithDepth):
        return {}
    names = [fuser.pairs.depth.name(index) for index in range(len(fuser))]
    return {"depth_maps": sum(map(bool, names)), "depth_names_sha256": digest(names)}


def describe_registration(fuser: Fuser | FrameFuser) -> dict[str, Any]:
    """How thermal lies on RGB, in numbers, whatever file they came from; TOML-able."""
    registration, warp = fuser.registration, fuser.warp
    record: dict[str, Any] = {
        **(
            _rig(fuser)
            if registration is None
            else {"kind": registration.kind, "H_rgb_fir": registration.H_rgb_fir.tolist()}
        ),
        "fir_size_wh": list(fuser.sizes[0]),
        "rgb_size_wh": list(fuser.sizes[1]),
        "coverage": round(warp.coverage, 6),
        "border_ltrb": list(warp.border_ltrb),
        "crop_xywh": list(warp.crop_xywh),
    }
    fit = None if registration is None else registration.fit
    if fit is not None:
        record["fit"] = {
            "points": fit.count,
            "inliers": fit.inliers,
            "outlier_pairs": [row + 1 for row in fit.outlier_rows],
            "rms_px": round(fit.rms_px, 6),
            "max_px": round(fit.max_px, 6),
        }
        if fit.leave_one_out_px is not None:
            record["fit"]["leave_one_out_px"] = round(fit.leave_one_out_px, 6)
    return record


def _rig(fuser: Fuser | FrameFuser) -> dict[str, Any]:
    """The numbers of the rig that a warp uses, whatever file they came from."""
    if fuser.rig is None or isinstance(fuser.warp, Warp):
        raise ValueError("expected a warp by a rig")
    cameras = {
        name: {"kind": type(camera).__name__, **asdict(camera)}
        for name, camera in (("rgb", fuser.rig.camera("rgb")), ("fir", fuser.rig.camera("fir")))
    }
    output = fuser.warp.views.output
    record = {
        "kind": "rig",
        "T_rgb_fir": fuser.rig.pose("rgb", "fir").tolist(),
        "cameras": cameras,
        "output": {"kind": type(output).__name__, **asdict(output)},
    }
    if isinstance(fuser.warp, DepthWarp):
        record["value"] = fuser.warp.value
    return plain(record)


def plain(value: Any) -> Any:
    """Tuples as lists, as TOML has them."""
    if isinstance(value, dict):
        return {key: plain(inner) for key, inner in value.items()}
    return [plain(inner) for inner in value] if isinstance(value, list | tuple) else value
