"""A solution and its evidence as a `Rig`: what stands in rig.toml."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from calib.boards import Board
from calib.evidence.linear import with_held
from calib.evidence.verdict import Evidence
from calib.solve.estimate import Solution
from fusion.geometry import Floats
from fusion.rig import Rig

_LIBRARIES = ("fusionprep", "numpy", "scipy", "opencv-contrib-python-headless")


def rig_of(
    solution: Solution, evidence: Evidence, board: Board, inputs: Iterable[str], *, known: Rig | None = None
) -> Rig:
    """The rig: cameras, transformations from the reference, clocks, and the evidence.

    `inputs` are the files that took part; their hashes are kept. What `known` says of sensors that the
    solution knows nothing of is kept, figures included.
    """
    estimate = solution.estimate
    transforms = {
        f"T_{estimate.reference}_{sensor}": T
        for sensor, T in estimate.T_ref_sensor.items()
        if sensor != estimate.reference
    }
    known = known or Rig()
    mine = {name for name in known.transforms if set(name.split("_")[1:]) <= set(estimate.T_ref_sensor)}
    kept = {name: T for name, T in known.transforms.items() if name not in mine}
    return Rig(
        {**known.cameras, **estimate.cameras},
        {**kept, **transforms},
        {**known.time_offset_s, **{k: v for k, v in estimate.time_offset_s.items() if v != 0}},
        _tables(solution, evidence, board, inputs, known),
    )


def known_covariance(rig: Rig) -> tuple[tuple[str, ...], Floats]:
    """The names (K,) and the covariance (K, K) that a rig's evidence has; empty where it has none that
    makes sense."""
    table = rig.evidence.get("covariance")
    table = table if isinstance(table, dict) else {}
    names, rows = table.get("names", []), table.get("matrix", [])
    try:
        matrix = np.array(rows, np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros((0, 0))
    sound = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if (
        not sound
        or matrix.shape != (len(names), len(names))
        or not np.isfinite(matrix).all()
        or not len(names)
    ):
        return (), np.zeros((0, 0))
    return tuple(names), matrix


def views_behind(rig: Rig, camera: str) -> int:
    """From how many views a rig says that a camera was calibrated; 0 where it does not say."""
    cameras = rig.evidence.get("cameras")
    entry = cameras.get(camera) if isinstance(cameras, dict) else None
    views = entry.get("views") if isinstance(entry, dict) else None
    return views if isinstance(views, int) else 0


def _tables(
    solution: Solution, evidence: Evidence, board: Board, inputs: Iterable[str], known: Rig
) -> dict[str, Any]:
    verdict = evidence.verdict
    sensors = {f"{src}_to_{dst}": maps for (dst, src), maps in evidence.transfer.items()}
    names, covariance = known_covariance(known)
    whole = with_held(solution, names, covariance, everything=True)
    return {
        "made": datetime.now(UTC).date().isoformat(),
        "verdict": verdict.grade,
        "good_for": list(verdict.good_for),
        "not_for": list(verdict.not_for),
        "record_next": list(verdict.record_next),
        "cameras": {
            **_kept(known, "cameras"),
            **{name: _camera(solution, evidence, name) for name in evidence.coverage},
        },
        "uncertainty_px": {
            **_kept(known, "uncertainty_px"),
            **{
                name: {f"{d:g}_m": _number(m.median_px) for d, m in maps.items()}
                for name, maps in sensors.items()
            },
        },
        **_closure(evidence),
        "left_out": [{"what": what, "why": why} for what, why in solution.dropped_views],
        "covariance": {
            "names": list(whole.names),
            "matrix": [[float(x) for x in row] for row in whole.covariance],
        },
        "board": {"kind": board.kind, "cols": board.cols, "rows": board.rows, "spacing_m": board.spacing_m},
        "inputs": [{"file": Path(file).name, "sha256": _hash(file)} for file in inputs],
        "versions": _versions(),
    }


def _kept(known: Rig, key: str) -> Mapping[str, Any]:
    table = known.evidence.get(key)
    return table if isinstance(table, dict) else {}


def _camera(solution: Solution, evidence: Evidence, name: str) -> dict[str, Any]:
    used = [u for v, u in zip(solution.views, solution.used, strict=True) if v.camera == name]
    return {
        "views": len(used),
        "points": sum(int(u.sum()) for u in used),
        "points_left_out": sum(int((~u).sum()) for u in used),
        "rms_px": _number(solution.rms_px(name)),
        "noise_px": _number(solution.sigma_px[name]),
        "held_out_px": _number(evidence.held_out.own_px.get(name, math.nan)),
        "seen_share": _number(evidence.coverage[name].share),
        "uncertainty_px": _number(evidence.projection[name].median_px),
        "uncertainty_worst_px": _number(evidence.projection[name].worst_px),
    }


def _closure(evidence: Evidence) -> Mapping[str, Any]:
    if evidence.closure is None:
        return {}
    turn, shift = evidence.closure
    return {"loop_closure": {"rotation_rad": _number(turn), "translation_m": _number(shift)}}


def _number(value: float) -> float:
    """Six digits: these are figures to read, not to compute with."""
    return float(f"{np.float64(value):.6g}")


def _hash(file: str) -> str:
    try:
        with Path(file).open("rb") as opened:
            return hashlib.file_digest(opened, "sha256").hexdigest()
    except OSError:
        return ""


def _versions() -> dict[str, str]:
    found = {}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found
