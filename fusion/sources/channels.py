"""RGB and thermal in one file of four channels, the form of the MFNet data set."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fusion.codecs import MAX_PIXELS, decode_image
from fusion.errors import FrameError, InputError
from fusion.frames import FrameSet, Image
from fusion.sources.base import Entry
from fusion.sources.folders import GLOB, IMAGE, list_folder, list_pattern, read_bytes
from fusion.sources.roles import to_role

_TWO_SOURCES = "give RGB and thermal as two sources; a single one holds 4 channels, or radiometric JPEGs"


class RgbtFiles:
    """Four-channel images: red, green, blue, and thermal where alpha would be.

    Each entry is a whole pair. `ignored` counts the other files. `read` may be called from several
    threads.
    """

    def __init__(self, name: str, entries: Sequence[Entry], ignored: int, max_pixels: int) -> None:
        self.name = name
        self.entries = entries
        self.ignored = ignored
        self._max_pixels = max_pixels

    def read(self, index: int) -> FrameSet:
        """Decode entry `index` into its RGB and thermal image, both under the same stem.

        A 16-bit file keeps its thermal counts and gives 8-bit BGR (flag ``rgb-16bit-to-8``). Raises
        `FrameError` when the file cannot be read or has not four channels.
        """
        entry = self.entries[index]
        pixels = decode_image(read_bytes(entry.where), entry.where, self._max_pixels)
        channels = 1 if pixels.ndim == 2 else pixels.shape[2]
        if channels != 4:
            what = f"expected 4 channels (R, G, B, thermal), found {channels}"
            raise FrameError(what, where=entry.where, hint=_TWO_SOURCES)
        bgr, flags = to_role(np.ascontiguousarray(pixels[:, :, :3]), "rgb", entry.where, "refuse")
        fir = np.ascontiguousarray(pixels[:, :, 3])
        return FrameSet(Image(bgr, entry.stem, entry.stamp_ns, flags), Image(fir, entry.stem, entry.stamp_ns))

    def close(self) -> None:
        """Nothing stays open."""


def open_rgbt(spec: str | Path, *, max_pixels: int = MAX_PIXELS) -> RgbtFiles:
    """Open a folder, a glob pattern or one file of four-channel PNG or TIFF images.

    Raises `InputError` when nothing is there. What a file holds shows when it is read.
    """
    text = str(spec)
    if Path(text).is_dir():
        return RgbtFiles(text, *list_folder(text), max_pixels)
    if IMAGE.accepts(text):
        return RgbtFiles(text, [Entry(Path(text).stem, text)], 0, max_pixels)
    if GLOB.accepts(text):
        return RgbtFiles(text, *list_pattern(text), max_pixels)
    hint = "give a folder, a glob pattern or a file of 4-channel images"
    raise InputError("no RGB+T images found", where=text, hint=hint)
