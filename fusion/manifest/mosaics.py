"""RGB images that a set stores as the sensor's raw mosaic: one grey channel behind a Bayer filter."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from fusion.codecs import MAX_PIXELS, decode_image
from fusion.errors import FrameError
from fusion.frames import Image
from fusion.sources.base import Entry
from fusion.sources.folders import FileSource, read_bytes

_CODES = {  # by the top-left 2 x 2 pixels, row by row
    "rggb": cv2.COLOR_BayerRGGB2BGR,
    "bggr": cv2.COLOR_BayerBGGR2BGR,
    "gbrg": cv2.COLOR_BayerGBRG2BGR,
    "grbg": cv2.COLOR_BayerGRBG2BGR,
}


class MosaicFiles(FileSource):
    """Mosaics as BGR images, flag ``rgb-demosaiced``. `FrameError` for a picture that is no 8-bit mosaic."""

    def __init__(self, name: str, entries: Sequence[Entry], bayer: str) -> None:
        super().__init__(name, entries, "rgb", fir_colour="refuse", max_pixels=MAX_PIXELS)
        self._code = _CODES[bayer]

    def read(self, index: int) -> Image:
        entry = self.entries[index]
        pixels = decode_image(read_bytes(entry.where), entry.where, MAX_PIXELS)
        if pixels.ndim != 2 or pixels.dtype != np.uint8 or min(pixels.shape) < 2:
            hint = "the manifest says [rgb] bayer: leave that out for images in colour"
            raise FrameError("the picture is no 8-bit mosaic of one channel", where=entry.where, hint=hint)
        bgr = np.asarray(cv2.cvtColor(pixels, self._code), np.uint8)
        return Image(bgr, entry.stem, entry.stamp_ns, ("rgb-demosaiced",))
