"""What every source of images offers, and the one table that names the sources."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from fusion.frames import Image

Role = Literal["rgb", "fir"]


@dataclass(frozen=True, slots=True)
class Entry:
    """One image of a source, not read yet.

    `stem` is its posix path relative to the source, without suffix; `where` is what messages call it
    (a path, or ``clip.mp4 frame 12``); `stamp_ns` is its time where the container itself has a clock;
    `file` is the file that it lies in, where `where` is not that itself.
    """

    stem: str
    where: str
    stamp_ns: int | None = None
    file: str = ""


@runtime_checkable
class Source(Protocol):
    """A finite, ordered set of images with random access. `read` may be called from several threads."""

    name: str
    entries: Sequence[Entry]
    ignored: int  # how many other files were there and left alone

    def read(self, index: int) -> Image:
        """Decode entry `index`. Raises `FrameError` when that one image cannot be used."""
        ...

    def close(self) -> None: ...


class OpenSource(Protocol):
    """Opens what a spec names. Raises `InputError` when nothing in it can be used."""

    def __call__(
        self, spec: str, role: Role, *, fir_colour: Literal["refuse", "luma"], max_pixels: int
    ) -> Source: ...


@dataclass(frozen=True, slots=True)
class SourceKind:
    """One row of the table: what it `expects` in words, whether it `accepts` a spec, how to `open` it."""

    expects: str
    accepts: Callable[[str], bool]
    open: OpenSource


# Name -> "module:attribute" of its `SourceKind`, tried in this order; the entry points of the group
# "fusion.sources" have the same form and come after them. Text, so that naming a source imports none.
SOURCES: dict[str, str] = {
    "folder": "fusion.sources.folders:FOLDER",
    "image": "fusion.sources.folders:IMAGE",
    "video": "fusion.sources.video:VIDEO",
    "glob": "fusion.sources.folders:GLOB",
}
