"""A recording of `fusion simulate mine`: its sensors' folders, and what its truth says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fusion.errors import FusionError
from fusion.inspect.base import Asked, Finding, InspectKind, steps_of
from fusion.inspect.folder import look_at_folder, streams_of
from fusion.messages.roles import roles_of

_SENSORS = ("rgb", "fir", "lidar")


def look_at_mine(path: Path, asked: Asked) -> Finding:
    """The sensors' streams, and the truth: how many frames it says are frozen, the clocks, the rig."""
    folders = [path / name for name in _SENSORS if (path / name).is_dir()]
    parts = streams_of(path, folders, asked)
    if not parts:
        return look_at_folder(path, asked)
    facts, faults = _truth(path)
    rig = ["--rig", path / "truth" / "rig.toml"]
    steps: list[tuple[list[object], str]] = []
    names = {part.stream.name for part in parts}
    if {"rgb", "fir"} <= names:
        words = ["fusion", "blend", path / "rgb", path / "fir", *rig, "-o", "OUT"]
        steps.append((words, "fuse RGB and thermal by the true rig"))
        steps.append((["fusion", "preprocess", "mine", path, *rig, "-o", "OUT"], "all of it, with depth"))
    if "lidar" in names:
        steps.append(
            (["fusion", "depth", path / "lidar", *rig, "-o", "OUT"], "dense depth of the RGB camera")
        )
    return Finding(
        str(path),
        "mine",
        "a recording of the simulated mine",
        facts,
        tuple(part.stream for part in parts),
        roles_of([part.seen for part in parts]),
        faults=(*faults, *(fault for part in parts for fault in part.faults)),
        steps=steps_of(*steps),
        pictures=tuple(picture for part in parts for picture in part.pictures),
    )


def _truth(path: Path) -> tuple[dict[str, Any], list[str]]:
    from fusion.simulate.mine.truth import Truth

    facts: dict[str, Any] = {}
    faults: list[str] = []
    truth = Truth(path)
    for read in (_clocks, _freezes):
        try:
            facts |= read(truth)
        except FusionError as error:
            faults.append(str(error))
    return facts, faults


def _clocks(truth: Any) -> dict[str, Any]:
    clocks = truth.clocks
    own = clocks["rgb"].offset_s if "rgb" in clocks else 0.0
    later = {name: round((clock.offset_s - own) * 1e3, 6) for name, clock in clocks.items()}
    return {"true_clock_after_rgb_ms": later}


def _freezes(truth: Any) -> dict[str, Any]:
    return {"truly_frozen_frames": sum(shown != own for own, shown in truth.freezes.items())}


MINE = InspectKind(
    "a folder of fusion simulate mine",
    lambda path: path.is_dir() and (path / "truth" / "mine.toml").is_file(),
    look_at_mine,
)
