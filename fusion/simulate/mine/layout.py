"""Where things lie in a simulated recording, and the small files of its truth: written here, read here."""

from __future__ import annotations

import csv
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from fusion.errors import InputError, OutputError
from fusion.files import output_error, replace_file
from fusion.geometry import Floats, checked_pose, pose, quat_of_rotation, rotation_of_quat
from fusion.simulate.mine.motion import Clock

SENSORS = ("rgb", "fir", "lidar")
CLOCKS_FORMAT = "fusion-mine-clocks/1"
DEPTH_PER_M = 256
FLOW_PER_PX, FLOW_ZERO = 64, 1 << 15
KELVIN_PER_STEP = 0.01


def claim(out: Path) -> None:
    """Refuse a folder that holds something, or a path that is no folder. Raises `OutputError`."""
    try:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            hint = "choose a new folder, or delete this one"
            raise OutputError("exists already and is not empty", where=out, hint=hint)
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise output_error(error, out) from None


def write_clocks(path: Path, clocks: Mapping[str, Clock]) -> None:
    """clocks.toml: own = true * (1 + drift) + offset_s, for every sensor."""
    table: dict[str, Any] = {"format": CLOCKS_FORMAT}
    table |= {name: {"offset_s": clock.offset_s, "drift": clock.drift} for name, clock in clocks.items()}
    replace_file(path, tomlkit.dumps(table).encode())


def read_clocks(path: Path) -> dict[str, Clock]:
    """What `write_clocks` wrote. Raises `InputError`."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        if table.pop("format", None) != CLOCKS_FORMAT:
            raise InputError("no clocks of a simulated mine", where=path)
        return {name: Clock(float(row["offset_s"]), float(row["drift"])) for name, row in table.items()}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise unreadable(path, error) from None


def write_tum(path: Path, times_s: Sequence[float], poses: Iterable[Floats]) -> None:
    """A trajectory in TUM's form: time x y z qx qy qz qw; true seconds, T_world_sensor."""
    lines = []
    for t, T in zip(times_s, poses, strict=True):
        w, x, y, z = quat_of_rotation(T[:3, :3])
        lines.append(" ".join([repr(float(t)), *(f"{v:.12g}" for v in (*T[:3, 3], x, y, z, w))]))
    replace_file(path, ("\n".join(lines) + "\n").encode())


def read_tum(path: Path) -> tuple[Floats, list[Floats]]:
    """Times (N, seconds) and T_world_sensor (4 x 4 each) of a file in TUM's form. Raises `InputError`."""
    try:
        text = [line.split() for line in path.read_text(encoding="utf-8").splitlines()]
        rows = np.array([line for line in text if line and not line[0].startswith("#")], np.float64).reshape(
            -1, 8
        )
        poses = [pose(rotation_of_quat(row[[7, 4, 5, 6]]), row[1:4]) for row in rows]
        return rows[:, 0], [checked_pose(T, path) for T in poses]
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from None


def write_rows(path: Path, names: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """A CSV with a head line."""
    lines = [",".join(names), *(",".join(str(v) for v in row) for row in rows)]
    replace_file(path, ("\n".join(lines) + "\n").encode())


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV with a head line. Raises `InputError`."""
    try:
        return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
    except (OSError, ValueError, csv.Error) as error:
        raise unreadable(path, error) from None


def unreadable(path: Path, error: Exception) -> InputError:
    """One line for a file of the truth that is missing or damaged."""
    missing = isinstance(error, FileNotFoundError)
    reason = "is not there" if missing else f"cannot be read: {getattr(error, 'strerror', None) or error}"
    hint = "make the recording again with `fusion simulate mine`"
    return InputError(f"this part of the truth {reason}", where=path, hint=hint)
