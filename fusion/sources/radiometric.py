"""Radiometric JPEGs as a source: the thermal counts of a file, and the visible image in it as RGB."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from fusion.codecs import MAX_PIXELS
from fusion.errors import FrameError, InputError
from fusion.frames import FrameSet, Image
from fusion.radiometric import FlirImage, Planck, read_flir
from fusion.radiometric.flir import HEAD_BYTES, Holds, glance, read_planck, why_no_counts
from fusion.sources.base import Entry
from fusion.sources.folders import GLOB, IMAGE, list_folder, list_pattern, read_bytes

FLAG = "fir-radiometric"

_TWO_SOURCES = "give RGB images and these as two sources: fusion blend RGB FLIR -o OUT"


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A file that is no pair: which role it could play, its path, and why it is none."""

    role: Literal["rgb", "fir"]
    where: str
    reason: str


class RadiometricFiles:
    """Radiometric JPEGs that hold a visible image too: each is a whole pair, not registered.

    `entries` are those, in natural order; `left_out` names every other image with its reason, `ignored`
    counts what is no image. `read` may be called from several threads.
    """

    def __init__(
        self, name: str, entries: Sequence[Entry], left_out: Sequence[LeftOut], ignored: int, max_pixels: int
    ) -> None:
        self.name = name
        self.entries = entries
        self.left_out = left_out
        self.ignored = ignored
        self._max_pixels = max_pixels

    def read(self, index: int) -> FrameSet:
        """The visible image as RGB and the counts as thermal, both under the file's stem and camera's time.

        Raises `FrameError` where the file is damaged or holds no visible image after all.
        """
        entry, image = self.entries[index], self.flir(index)
        if image.visible_bgr is None:
            raise FrameError("the file holds no visible image", where=entry.where, hint=_TWO_SOURCES)
        stamp = entry.stamp_ns if entry.stamp_ns is not None else image.stamp_ns
        return FrameSet(
            Image(image.visible_bgr, entry.stem, stamp), Image(image.counts, entry.stem, stamp, (FLAG,))
        )

    def read_fir(self, index: int) -> Image:
        """The counts alone."""
        entry, image = self.entries[index], self.flir(index, visible=False)
        stamp = entry.stamp_ns if entry.stamp_ns is not None else image.stamp_ns
        return Image(image.counts, entry.stem, stamp, (FLAG,))

    def flir(self, index: int, *, visible: bool = True) -> FlirImage:
        """All that file `index` holds. Raises `FrameError`."""
        where = self.entries[index].where
        return read_flir(read_bytes(where), where, max_pixels=self._max_pixels, visible=visible)

    def close(self) -> None:
        """Nothing stays open."""


def open_radiometric_files(spec: str | Path, *, max_pixels: int = MAX_PIXELS) -> RadiometricFiles:
    """Open a folder, a glob pattern or one file of radiometric JPEGs with visible images.

    Of each file the beginning is looked at, nothing is decoded. Raises `InputError` where nothing is there or
    no file is a pair.
    """
    found, ignored = _listed(str(spec))
    entries, left_out = [], []
    for entry in found:
        reason = _why_left_out(_head(entry.where))
        if reason is None:
            entries.append(entry)
        else:
            left_out.append(LeftOut(reason[0], entry.where, reason[1]))
    if not entries:
        first = left_out[0]
        what = f"none of {len(left_out)} images holds both thermal counts and a visible image"
        raise InputError(what, where=spec, hint=f"the first: {first.where}: {first.reason}; {_TWO_SOURCES}")
    return RadiometricFiles(str(spec), entries, left_out, ignored, max_pixels)


def is_radiometric(spec: str | Path) -> bool:
    """Whether a folder, a pattern or a file has radiometric JPEGs in it (also DJI's, to be refused as such).

    Raises `InputError` where nothing is there.
    """
    entries, _ = _listed(str(spec))
    jpegs = (entry.where for entry in entries if entry.where.lower().endswith((".jpg", ".jpeg")))
    return any(glance(head) is not None or why_no_counts(head) is not None for head in map(_head, jpegs))


def common_planck(paths: Iterable[str]) -> Planck:
    """The constants that all these radiometric files share, so that a window in degrees is one in counts.

    Files that cannot be read are passed over: reading their frames says why. Raises `InputError` where two
    differ, naming both and the first constant that does, or where none can be read.
    """
    first: tuple[str, Planck] | None = None
    error: FrameError | None = None
    for path in paths:
        try:
            planck = read_planck(read_bytes(path), path)
        except FrameError as fault:
            error = error or fault
            continue
        first = first or (path, planck)
        if planck != first[1]:
            raise _differ(first, (path, planck))
    if first is None:
        what = "no thermal file tells degrees"
        raise InputError(what, hint=f"the first: {error}" if error else "there are none")
    return first[1]


def _why_left_out(head: bytes) -> tuple[Literal["rgb", "fir"], str] | None:
    refusal = why_no_counts(head)
    if refusal is not None:
        return "fir", f"{refusal.what} ({refusal.hint})"
    match glance(head):
        case None if head:
            return "rgb", "no radiometric data in it"
        case Holds(counts=False):
            return "rgb", "a visible image only: its FLIR data hold no thermal counts"
        case Holds(visible=False):
            return "fir", "no visible image in it"
    return None


def _head(path: str) -> bytes:
    """The beginning of a file; empty where it cannot be read, which reading it will say."""
    with suppress(OSError), Path(path).open("rb") as file:
        return file.read(HEAD_BYTES)
    return b""


def _listed(spec: str) -> tuple[list[Entry], int]:
    if Path(spec).is_dir():
        return list_folder(spec)
    if IMAGE.accepts(spec):
        return [Entry(Path(spec).stem, spec)], 0
    if GLOB.accepts(spec):
        return list_pattern(spec)
    raise InputError("no images found", where=spec, hint="give a folder, a glob pattern or a file")


def _differ(first: tuple[str, Planck], other: tuple[str, Planck]) -> InputError:
    names = [f.name for f in fields(Planck) if getattr(first[1], f.name) != getattr(other[1], f.name)]
    a, b = (getattr(planck, names[0]) for _, planck in (first, other))
    what = f"counts mean other degrees in each file: {names[0]} is {a:g} in {first[0]}, {b:g} in {other[0]}"
    return InputError(what, hint="give the window in counts or percentiles, or one camera setting a folder")
