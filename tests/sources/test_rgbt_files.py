"""RGB and thermal in one file."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from fusion.errors import FrameError, InputError
from fusion.sources.channels import open_rgbt

PIXELS = np.random.default_rng(4).integers(0, 256, (9, 12, 4), np.uint8)


def write(path: Path, pixels: np.ndarray) -> Path:
    path.write_bytes(cv2.imencode(path.suffix, pixels)[1].tobytes())
    return path


@pytest.mark.parametrize("form", ["folder", "glob", "file"])
def test_channels_are_parted(tmp_path: Path, form: str) -> None:
    for name in ("00010D.png", "00002N.png"):
        write(tmp_path / name, PIXELS)
    (tmp_path / "list.txt").write_text("x")
    spec = {"folder": str(tmp_path), "glob": f"{tmp_path}/*", "file": str(tmp_path / "00010D.png")}[form]
    files = open_rgbt(spec)
    assert [entry.stem for entry in files.entries] == (["00010D"] if form == "file" else ["00002N", "00010D"])
    assert files.ignored == (0 if form == "file" else 1)
    frame = files.read(len(files.entries) - 1)
    assert (frame.rgb.pixels == PIXELS[:, :, :3]).all()
    assert (frame.fir.pixels == PIXELS[:, :, 3]).all()
    assert frame.rgb.stem == frame.fir.stem == "00010D"
    assert frame.fir.pixels.flags.c_contiguous


def test_transparent_pixels_keep_their_colour(tmp_path: Path) -> None:
    pixels = PIXELS.copy()
    pixels[:, :, 3] = 0
    assert (open_rgbt(write(tmp_path / "a.png", pixels)).read(0).rgb.pixels == pixels[:, :, :3]).all()


def test_16_bit_keeps_its_counts(tmp_path: Path) -> None:
    pixels = PIXELS.astype(np.uint16) * 257
    pixels[:, :, 3] = np.arange(108).reshape(9, 12) * 500 + 3
    frame = open_rgbt(write(tmp_path / "a.png", pixels)).read(0)
    assert frame.fir.pixels.dtype == np.uint16
    assert (frame.fir.pixels == pixels[:, :, 3]).all()
    assert (frame.rgb.pixels == PIXELS[:, :, :3]).all()
    assert frame.rgb.flags == ("rgb-16bit-to-8",)


@pytest.mark.parametrize(("pixels", "found"), [(PIXELS[:, :, 0], 1), (PIXELS[:, :, :3], 3)])
def test_other_channel_counts(tmp_path: Path, pixels: np.ndarray, found: int) -> None:
    files = open_rgbt(write(tmp_path / "a.png", pixels))
    with pytest.raises(FrameError, match=f"expected 4 channels.*found {found}"):
        files.read(0)


def test_nothing_there(tmp_path: Path) -> None:
    for spec in (tmp_path, tmp_path / "gone.png", f"{tmp_path}/*.png"):
        with pytest.raises(InputError):
            open_rgbt(spec)


def test_size_limit(tmp_path: Path) -> None:
    data = bytearray(write(tmp_path / "a.png", PIXELS).read_bytes())
    data[16:24] = struct.pack(">II", 100_000, 100_000)
    (tmp_path / "a.png").write_bytes(bytes(data))
    with pytest.raises(FrameError, match="100000 x 100000"):
        open_rgbt(tmp_path).read(0)
