"""Recordings: rosbag1, rosbag2, MCAP, all with one face (`fusion.recordings.base.Recording`)."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path

from fusion.errors import InputError, UsageError
from fusion.recordings.base import RECORDINGS, Recording, RecordingKind

__all__ = ["is_recording", "open_recording"]


def open_recording(path: str | Path) -> Recording:
    """The recording at a path or fsspec URL (``s3://bucket/flight.mcap``); close it when done.

    Opening reads what the recording says about itself; where that is missing or damaged, it goes through all
    of it. Raises `InputError` where nothing is there, it is no recording, or none of it can be read; what can
    be read of a damaged one is read, and `faults` says the rest.
    """
    from fusion.recordings.files import exists, first_bytes

    text = str(path)
    if not exists(text):
        raise InputError("no such file or folder", where=text, hint="give a recording: " + _expected())
    for kind in _kinds():
        if kind.accepts(text):
            return kind.open(text)
    head = first_bytes(text, 12)
    found = f"it begins with {head!r}" if head else "it is empty, or a folder without any"
    raise InputError(f"is no recording: {found}", where=text, hint="known: " + _expected())


def is_recording(path: str | Path) -> bool:
    """Whether a path looks like a recording; reads a few bytes. `open_recording` may still refuse it."""
    from fusion.recordings.files import exists

    try:
        return exists(str(path)) and any(kind.accepts(str(path)) for kind in _kinds())
    except (InputError, OSError, ValueError):
        return False


def _expected() -> str:
    return ", ".join(_loaded(target).expects for target in RECORDINGS.values())


def _kinds() -> Iterator[RecordingKind]:
    """Our own first; installed ones are imported only where none of ours accepts."""
    for target in RECORDINGS.values():
        yield _loaded(target)
    for point in sorted(entry_points(group="fusion.recordings"), key=lambda point: point.name):
        if point.name in RECORDINGS:
            continue
        try:
            kind = point.load()
        except Exception as error:
            hint = "repair or uninstall the package that offers it"
            raise UsageError(
                f"{point.value} cannot be loaded: {error}", where=point.name, hint=hint
            ) from error
        yield kind


def _loaded(target: str) -> RecordingKind:
    module, _, name = target.partition(":")
    return getattr(import_module(module), name)
