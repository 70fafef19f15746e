"""Image files as a source: a folder, a glob pattern, or one file."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from fusion.codecs import decode_image
from fusion.errors import FrameError, InputError
from fusion.frames import Image
from fusion.radiometric.flir import flir_in, shows_temperatures
from fusion.sources.base import Entry, Role, SourceKind
from fusion.sources.roles import FirColour, to_role

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm"})
_LOOKED_FOR = f"looked for {' '.join(sorted(IMAGE_SUFFIXES))}, in any case of letters"


class FileSource:
    """Image files in natural order. `ignored` counts the files beside them that are no images.

    An entry's `where` is the path of its file. Thread-safe: `read` keeps nothing.
    """

    def __init__(
        self,
        name: str,
        entries: Sequence[Entry],
        role: Role,
        *,
        fir_colour: FirColour,
        max_pixels: int,
        ignored: int = 0,
    ) -> None:
        self.name = name
        self.entries = entries
        self.role: Role = role
        self.ignored = ignored
        self._fir_colour: FirColour = fir_colour
        self._max_pixels = max_pixels

    def read(self, index: int) -> Image:
        """Decode entry `index`. Raises `FrameError` when that file cannot be read or used.

        Of a radiometric JPEG the thermal role gets the counts, not the coloured picture (flag
        ``fir-radiometric``); the RGB role gets the picture (flag ``rgb-thermal-preview``).
        """
        entry = self.entries[index]
        data = read_bytes(entry.where)
        if self.role == "fir":
            flir = flir_in(data, entry.where, self._max_pixels, dji=self._fir_colour == "luma")
            if flir is not None:
                return Image(flir.counts, entry.stem, entry.stamp_ns, ("fir-radiometric",))
        pixels = decode_image(data, entry.where, self._max_pixels)
        pixels, flags = to_role(pixels, self.role, entry.where, self._fir_colour)
        if self.role == "rgb" and shows_temperatures(data):
            flags = (*flags, "rgb-thermal-preview")
        return Image(pixels, entry.stem, entry.stamp_ns, flags)

    def close(self) -> None:
        """Nothing stays open."""


def read_bytes(path: str) -> bytes:
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise FrameError(f"cannot be read: {error.strerror or error}", where=path) from error


def natural_key(path: str) -> tuple[object, ...]:
    """Sorts ``img2`` before ``img10``, folder by folder; names that compare equal go by their letters.

    A total order over different posix paths, the same on every machine.
    """
    parts = [
        [int(word) if word.isdecimal() else word for word in re.split(r"(\d+)", part.casefold())]
        for part in path.split("/")
    ]
    return parts, path


def list_folder(folder: str) -> tuple[list[Entry], int]:
    """The images directly in `folder`, in natural order, and the number of other files."""
    try:
        with os.scandir(folder) as found:
            # a link that leads nowhere stays in: reading it fails, and that is counted
            files = [
                item.name for item in found if item.is_file() or (item.is_symlink() and not item.is_dir())
            ]
    except OSError as error:
        raise InputError(f"the folder cannot be read: {error.strerror}", where=folder) from error
    entries, ignored = _entries(folder, files)
    if not entries:
        others = f"; {ignored} other files are there" if ignored else ""
        hint = _LOOKED_FOR + others + _subfolders_with_images(folder)
        raise InputError("no images in this folder", where=folder, hint=hint)
    return entries, ignored


def list_pattern(pattern: str) -> tuple[list[Entry], int]:
    """The images a glob pattern finds, and the number of other files it finds.

    ``**`` stands for any depth. Stems are relative to the part of the pattern that has no wildcard:
    ``rgb/*/img_*.png`` gives ``V000/img_1``.
    """
    prefix, rest = split_pattern(pattern)
    if rest.split("/")[-1] == "**":
        rest += "/*"  # what a trailing ** finds differs between versions of Python
    try:
        found = {path.relative_to(prefix).as_posix() for path in prefix.glob(rest) if not path.is_dir()}
    except (OSError, ValueError, NotImplementedError) as error:
        raise InputError(f"the pattern cannot be followed: {error}", where=pattern) from error
    entries, ignored = _entries(str(prefix), found)
    if not entries:
        others = f"it finds {ignored} files, none an image; " if ignored else ""
        missing = "" if prefix.is_dir() else f"; the folder {prefix} is not there"
        raise InputError("the pattern finds no images", where=pattern, hint=others + _LOOKED_FOR + missing)
    return entries, ignored


def split_pattern(pattern: str) -> tuple[Path, str]:
    """The folder in front of the first wildcard, and the rest of the pattern."""
    parts = Path(pattern).parts
    first = 0
    while first < len(parts) - 1 and (
        not glob.has_magic(parts[first]) or Path(*parts[: first + 1]).exists()  # a name with brackets
    ):
        first += 1
    return Path(*parts[:first]), "/".join(parts[first:])


def _entries(folder: str, names: Iterable[str]) -> tuple[list[Entry], int]:
    """Entries of the images among posix paths relative to `folder`; hidden ones are not looked at."""
    seen = [name for name in names if not any(part.startswith(".") for part in name.split("/"))]
    images = sorted((name for name in seen if _is_image(name)), key=natural_key)
    entries = [Entry(os.path.splitext(name)[0], os.path.join(folder, name)) for name in images]  # noqa: PTH118, PTH122
    for entry in entries:
        _check_name(entry.where)
    return entries, len(seen) - len(images)


def _is_image(name: str) -> bool:
    return os.path.splitext(name)[1].lower() in IMAGE_SUFFIXES  # noqa: PTH122 - 10,000 names, no Path each


def _check_name(path: str) -> None:
    """A name that is no valid text cannot be written into an index or a message."""
    try:
        path.encode()
    except UnicodeEncodeError as error:
        shown = path.encode("utf-8", "backslashreplace").decode()
        raise InputError("the file name is no valid UTF-8", where=shown, hint="rename the file") from error


def _subfolders_with_images(folder: str) -> str:
    """Names up to three subfolders (two levels deep) that hold images, as a suggestion."""
    below = sorted([*Path(folder).glob("*/"), *Path(folder).glob("*/*/")])
    hits = [path for path in below[:200] if path.is_dir() and _holds_image(path)][:3]
    return f"; did you mean {' or '.join(str(path) for path in hits)}?" if hits else ""


def _holds_image(folder: Path) -> bool:
    try:
        with os.scandir(folder) as found:
            return any(_is_image(item.name) and not item.name.startswith(".") for item in found)
    except OSError:
        return False


def _open_folder(spec: str, role: Role, *, fir_colour: FirColour, max_pixels: int) -> FileSource:
    entries, ignored = list_folder(spec)
    return FileSource(spec, entries, role, fir_colour=fir_colour, max_pixels=max_pixels, ignored=ignored)


def _open_image(spec: str, role: Role, *, fir_colour: FirColour, max_pixels: int) -> FileSource:
    _check_name(spec)
    return FileSource(
        spec, [Entry(Path(spec).stem, spec)], role, fir_colour=fir_colour, max_pixels=max_pixels
    )


def _open_glob(spec: str, role: Role, *, fir_colour: FirColour, max_pixels: int) -> FileSource:
    entries, ignored = list_pattern(spec)
    return FileSource(spec, entries, role, fir_colour=fir_colour, max_pixels=max_pixels, ignored=ignored)


FOLDER = SourceKind("a folder of images", lambda spec: Path(spec).is_dir(), _open_folder)
IMAGE = SourceKind(
    "an image file", lambda spec: _is_image(Path(spec).name) and Path(spec).is_file(), _open_image
)
GLOB = SourceKind("a glob pattern in quotes ('rgb/*.png')", glob.has_magic, _open_glob)
