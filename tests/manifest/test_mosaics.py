"""Raw mosaics become colour, each filter by the colours of its top-left pixels."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from fusion.errors import FrameError
from fusion.manifest.mosaics import MosaicFiles
from fusion.sources.base import Entry

BGR = (30, 120, 220)


@pytest.mark.parametrize("bayer", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_flat_colour_comes_back(bayer: str, tmp_path: Path) -> None:
    """The mosaic is laid out by hand: pixel (y, x) has the colour of letter 2 * (y % 2) + x % 2."""
    value = dict(zip("bgr", BGR, strict=True))
    tile = np.array([value[letter] for letter in bayer], np.uint8).reshape(2, 2)
    path = tmp_path / "m.png"
    assert cv2.imwrite(str(path), np.tile(tile, (8, 10)))
    image = MosaicFiles("x", [Entry("m", str(path), 7)], bayer).read(0)
    assert image.pixels.shape == (16, 20, 3)
    assert (image.pixels == BGR).all()
    assert (image.stem, image.stamp_ns, image.flags) == ("m", 7, ("rgb-demosaiced",))


@pytest.mark.parametrize("shape", [(8, 8, 3), (1, 8)])
def test_what_is_no_mosaic_is_refused(shape: tuple[int, ...], tmp_path: Path) -> None:
    path = tmp_path / "m.png"
    assert cv2.imwrite(str(path), np.full(shape, 40, np.uint8))
    with pytest.raises(FrameError, match=r"no 8-bit mosaic.*leave that out"):
        MosaicFiles("x", [Entry("m", str(path))], "rggb").read(0)


def test_sixteen_bits_are_refused_and_an_edge_stays_where_it_is(tmp_path: Path) -> None:
    path = tmp_path / "m.png"
    assert cv2.imwrite(str(path), np.full((8, 8), 4000, np.uint16))
    with pytest.raises(FrameError, match="no 8-bit mosaic"):
        MosaicFiles("x", [Entry("m", str(path))], "rggb").read(0)
    step = np.zeros((16, 32), np.uint8)
    step[:, 16:] = 200
    assert cv2.imwrite(str(path), step)
    row = MosaicFiles("x", [Entry("m", str(path))], "bggr").read(0).pixels[8].max(1)
    rises = [k for k, (a, b) in enumerate(pairwise(row.tolist())) if b > a]
    assert rises
    assert min(rises) >= 14
    assert max(rises) <= 16
