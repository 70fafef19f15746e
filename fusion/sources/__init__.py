"""Sources of images: folders, single files, patterns, videos, and what other packages add."""

from __future__ import annotations

import pkgutil
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Literal

from fusion.errors import InputError
from fusion.sources.base import SOURCES, Entry, Role, Source, SourceKind

__all__ = ["SOURCES", "Entry", "Role", "Source", "SourceKind", "open_source"]


def open_source(
    spec: str | Path,
    role: Role,
    *,
    fir_colour: Literal["refuse", "luma"] = "refuse",
    max_pixels: int = 2**27,
) -> Source:
    """Open a folder of images, an image file, a video file or a glob pattern as the `role` camera.

    `fir_colour` says what happens to thermal images that are truly coloured: ``refuse`` (a `FrameError`
    when such a frame is read) or ``luma`` (BT.601 luma, flagged). `max_pixels` bounds width x height of
    one image. Raises `InputError` when nothing is there, nothing in it can be used, or no source
    knows the spec.
    """
    text = str(spec)
    if not text.strip():
        raise InputError("no source given", hint="give a folder, an image, a video or a glob pattern")
    expected = []
    for kind in _kinds():
        if _accepts(kind, text):
            return kind.open(text, role, fir_colour=fir_colour, max_pixels=max_pixels)
        expected.append(kind.expects)
    if not Path(text).exists():
        hint = f"give {', '.join(expected)}; {_nearest_folder(Path(text))}"
        raise InputError("no such file or folder", where=text, hint=hint)
    raise InputError("not a source of images", where=text, hint=f"give {', '.join(expected)}")


def _kinds() -> Iterator[SourceKind]:
    """The built-in kinds, then those of other packages, which are looked up only when it comes to them."""
    for target in SOURCES.values():
        yield pkgutil.resolve_name(target)
    for point in metadata.entry_points(group="fusion.sources"):
        yield point.load()


def _accepts(kind: SourceKind, text: str) -> bool:
    try:
        return kind.accepts(text)
    except (OSError, ValueError) as error:  # no permission, a name too long, a zero byte
        raise InputError(f"cannot be looked up: {error}", where=text) from error


def _nearest_folder(path: Path) -> str:
    """Says up to where a path that is not there does exist."""
    there = next((parent for parent in path.absolute().parents if parent.is_dir()), Path("/"))
    try:
        names = sorted(p.name for p in there.iterdir() if not p.name.startswith("."))[:5]
    except OSError:
        return f"{there} cannot be listed"
    return f"{there} holds {', '.join(names)}" if names else f"{there} is empty"
