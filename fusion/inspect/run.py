"""The output of a run: `frames.csv` and `run.toml` of fusion blend, depth or preprocess."""

from __future__ import annotations

import csv
import io
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

from fusion.codecs import decode_image
from fusion.errors import FusionError, InputError
from fusion.inspect.base import Asked, Finding, InspectKind, Picture, steps_of
from fusion.inspect.measure import spread
from fusion.inspect.pictures import thumbnail
from fusion.inspect.rigs import format_of
from fusion.sinks.run_folder import RUN_FORMAT
from fusion.sources.folders import read_bytes

INDEX, RECORD, _MOST_BYTES = "frames.csv", "run.toml", 1 << 29
_FOLDERS = ("fused", "mask", "depth", "support", "sparse", "picture", "overlay", "fir")
_REASONS = 10
_DONE = ("fused", "made")  # the status of what is there


def look_at_run(path: Path, asked: Asked) -> Finding:
    """What a run made, what it skipped and why, and whether its files are there."""
    record = _record(path / RECORD)
    rows = _rows(path / INDEX)
    done = [row for row in rows if row.get("status") in _DONE]
    skipped = [row for row in rows if row.get("status") not in _DONE]
    facts: dict[str, Any] = {"frames": len(done), "skipped": len(skipped)}
    versions, inputs = record.get("versions"), record.get("inputs")
    if isinstance(versions, dict):
        facts["made_by_fusion"] = str(versions.get("fusion", "unknown"))
    if isinstance(inputs, dict):
        facts["inputs"] = {k: v for k, v in inputs.items() if type(v) is int}
    folders = [name for name in _FOLDERS if (path / name).is_dir()]
    facts["files"] = {name: sum(1 for item in (path / name).rglob("*") if item.is_file()) for name in folders}
    facts |= _spans(done)
    facts |= {"lost": lost} if (lost := _lost(path / "lost.csv")) else {}
    faults = [
        f"{len(missing)} of {len(done)} frames have no file" for missing in [_missing(path, done)] if missing
    ]
    if (path / ".partial").exists() or not (path / INDEX).is_file():
        faults.append("the run is under way, or was stopped: run the same command again to finish it")
    reasons = Counter(row.get("reason", "") for row in skipped)
    notes = [f"skipped {count}: {reason}" for reason, count in reasons.most_common(_REASONS)]
    return Finding(
        str(path),
        "run",
        f"the output of a fusion run, {len(done):,} frames",
        facts,
        notes=tuple(notes),
        faults=tuple(faults),
        steps=steps_of(*_steps(path, folders)),
        pictures=_pictures(path, done, folders) if asked.pictures else (),
    )


def _record(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise InputError("too large for the record of a run", where=path)
        record = tomllib.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"the record of the run cannot be read: {error}", where=path) from None
    if record.get("format") != RUN_FORMAT:
        hint = "it was written by another version of fusion, or by another tool"
        raise InputError(f"not of the form {RUN_FORMAT}", where=path, hint=hint)
    return record


def _rows(path: Path) -> list[dict[str, str]]:
    """A CSV by its header; empty where it is not there. Columns without a header are left out."""
    if not path.is_file():
        return []
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise InputError("too large for an index", where=path)
        text = path.read_text("utf-8", "surrogateescape")
        return [{k: v or "" for k, v in row.items() if k} for row in csv.DictReader(io.StringIO(text))]
    except (OSError, csv.Error, AttributeError) as error:
        raise InputError(f"the index of the run cannot be read: {error}", where=path) from None


def _lost(path: Path) -> list[str]:
    """What belongs to no frame, by role and reason, as preprocess counts it."""
    rows = _rows(path)[:_REASONS]
    return [f"{row.get('count', '?')} {row.get('role', '?')}: {row.get('reason', '?')}" for row in rows]


def _spans(rows: list[dict[str, str]]) -> dict[str, Any]:
    """Least and greatest of what the index says of its frames."""
    facts: dict[str, Any] = {}
    for column, key in (
        ("coverage", "coverage_share"),
        ("window_lo", "window_lo"),
        ("window_hi", "window_hi"),
    ):
        values = _numbers(rows, column)
        facts |= {key: [min(values), max(values)]} if values else {}
    least, most = _numbers(rows, "least_m"), _numbers(rows, "most_m")
    facts |= {"depth_m": [min(least), max(most)]} if least and most else {}
    stamps = [int(row[c]) for row in rows for c in ("rgb_stamp_ns", "stamp_ns") if row.get(c, "").isdecimal()]
    if stamps:
        facts["first_ns"], facts["last_ns"] = min(stamps), max(stamps)
        facts["duration_s"] = (max(stamps) - min(stamps)) / 1e9
    return facts


def _numbers(rows: list[dict[str, str]], column: str) -> list[float]:
    values = []
    for row in rows:
        try:
            values.append(float(row.get(column, "")))
        except ValueError:
            continue
    return values


def _missing(path: Path, rows: list[dict[str, str]]) -> list[str]:
    """Stems without a file in the run's main folder."""
    main = next((path / name for name in ("fused", "depth") if (path / name).is_dir()), None)
    if main is None:
        return []
    there = {item.relative_to(main).with_suffix("").as_posix() for item in main.rglob("*") if item.is_file()}
    return [row["stem"] for row in rows if row.get("stem") and row["stem"] not in there]


def _steps(path: Path, folders: list[str]) -> list[tuple[list[object], str]]:
    if "fused" in folders:
        return [(["fusion", "inspect", path / "fused", "--full"], "look at every fused frame")]
    if "depth" in folders:
        words = ["fusion", "blend", "RGB", "FIR", "--rig", "RIG", "--depth", path / "depth", "-o", "OUT"]
        return [(words, "warp thermal by this depth")]
    return []


def _pictures(path: Path, rows: list[dict[str, str]], folders: list[str]) -> tuple[Picture, ...]:
    made = []
    for index in spread(len(rows), 2):
        for name in ("fused", "mask", "picture"):
            stem = rows[index].get("stem", "")
            if name not in folders or not stem or ".." in stem.split("/") or stem.startswith("/"):
                continue
            made += _picture(path / name, stem)
    return tuple(made)


def _picture(folder: Path, stem: str) -> list[Picture]:
    for suffix in (".png", ".jpg"):
        file = folder / f"{stem}{suffix}"
        if file.is_file():
            try:
                return [
                    thumbnail(f"{folder.name}/{file.name}", decode_image(read_bytes(str(file)), str(file)))
                ]
            except FusionError:
                return []
    return []


RUN = InspectKind(
    "the output folder of a run",
    lambda path: path.is_dir() and format_of(path / RECORD) == RUN_FORMAT,
    look_at_run,
)
