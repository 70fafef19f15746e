"""Every encoding, byte order and padding against numpy; mosaics and YUV against pictures that are known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.errors import FrameError
from fusion.messages.base import Header, RawImage
from fusion.messages.images import image_of
from fusion.messages.pixels import ENCODINGS, YUV, colours_of

W, H = 6, 4
ORDER = {"rgb": (2, 1, 0), "bgr": (0, 1, 2), "rgba": (2, 1, 0, 3), "bgra": (0, 1, 2, 3), "mono": (0,)}
PLAIN = [word for word in ENCODINGS if not word.startswith("bayer")]
MOSAICS = {"rggb": "rggb", "bggr": "bggr", "gbrg": "gbrg", "grbg": "grbg"}


def message(data: bytes, encoding: str, w: int = W, h: int = H, step: int = W, big: bool = False) -> RawImage:
    return RawImage(Header(), w, h, encoding, big, step, memoryview(data))


def packed(rows: NDArray, padding: int) -> bytes:
    """Rows with bytes of 0xEE behind each but the last."""
    parts = [row.tobytes() for row in rows]
    return (b"\xee" * padding).join(parts)


@pytest.mark.parametrize("encoding", PLAIN)
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("padding", [0, 1, 8])
def test_plain_encodings(encoding: str, big: bool, padding: int) -> None:
    row = ENCODINGS[encoding]
    dtype = np.dtype(row.dtype).newbyteorder(">" if big else "<")
    shape = (H, W, row.channels) if row.channels > 1 else (H, W)
    sent = np.random.default_rng(5).integers(0, 127, (*shape, dtype.itemsize), np.uint8).view(dtype)[..., 0]
    step = W * row.channels * dtype.itemsize + padding
    there = message(packed(sent, padding), encoding.upper(), step=step, big=big)
    if row.channels == 2:
        with pytest.raises(FrameError, match="two channels"):
            colours_of(there, "a")
        return
    order = ORDER.get(encoding.rstrip("0123456789"), tuple(range(row.channels)))
    expected = sent[..., order] if row.channels > 1 else sent
    got = colours_of(there, "a")
    assert got.dtype == dtype.newbyteorder("=")
    assert np.array_equal(got, expected)


def test_the_table_has_every_word_of_ros() -> None:
    """From sensor_msgs/image_encodings.hpp."""
    words = [f"{name}{bits}" for name in ("mono", "rgb", "bgr", "rgba", "bgra") for bits in (8, 16)]
    words += [f"bayer_{name}{bits}" for name in MOSAICS for bits in (8, 16)]
    words += [f"{kind}C{n}" for kind in ("8U", "8S", "16U", "16S", "32S", "32F", "64F") for n in (1, 2, 3, 4)]
    words += ["yuv422", "yuv422_yuy2", "uyvy", "yuyv", "nv21", "nv24", "nv12"]
    assert [word for word in words if word.lower() not in (*ENCODINGS, *YUV)] == []


def scene(top: int, w: int = 32, h: int = 24) -> NDArray:
    """A picture whose colours are ramps, each another way: bilinear interpolation gives it back exactly."""
    x, y = np.meshgrid(np.arange(w), np.arange(h))
    blue, green, red = x * 4, 200 - y * 4, 20 + x * 2 + y * 2
    return np.stack([blue, green, red], -1) * top // 255


@pytest.mark.parametrize("name", MOSAICS)
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("big", [False, True])
def test_mosaics_give_the_picture_back(name: str, bits: int, big: bool) -> None:
    """Which colour is at (0, 0), (1, 0), (0, 1), (1, 1) is what the word says."""
    bgr = scene(255 if bits == 8 else 65280)
    mosaic = np.empty(bgr.shape[:2], f"{'>' if big else '<'}u{bits // 8}")
    for k, letter in enumerate(name):
        mosaic[k // 2 :: 2, k % 2 :: 2] = bgr[k // 2 :: 2, k % 2 :: 2, "bgr".index(letter)]
    step = mosaic.strides[0] + 2
    there = message(packed(mosaic, 2), f"bayer_{name}{bits}", 32, 24, step, big)
    got = colours_of(there, "a").astype(int)
    error = np.abs(got - bgr)[2:-2, 2:-2]
    assert error.max() <= (1 if bits == 8 else 256)


def bt601(y: NDArray, u: NDArray, v: NDArray) -> NDArray:
    """ITU-R BT.601, luma 16 to 235, in floats."""
    y, u, v = 1.164383 * (y - 16.0), u - 128.0, v - 128.0
    bgr = np.stack([y + 2.017232 * u, y - 0.391762 * u - 0.812968 * v, y + 1.596027 * v], -1)
    return bgr.clip(0, 255)


@pytest.mark.parametrize("encoding", YUV)
@pytest.mark.parametrize("padding", [0, 4])
def test_yuv(encoding: str, padding: int) -> None:
    random = np.random.default_rng(1)
    y = random.integers(16, 236, (H, W), np.uint8)
    if encoding == "nv24":
        u, v = random.integers(90, 170, (2, H, W), np.uint8)
        rows = [*y, *np.stack([u, v], -1).reshape(2 * H, W)]
    elif encoding.startswith("nv"):
        u, v = random.integers(90, 170, (2, H // 2, W // 2), np.uint8)
        pair = (u, v) if encoding == "nv12" else (v, u)
        rows = [*y, *np.stack(pair, -1).reshape(H // 2, W)]
        u, v = (np.repeat(np.repeat(c, 2, 0), 2, 1) for c in (u, v))
    else:
        u, v = random.integers(90, 170, (2, H, W // 2), np.uint8)
        luma_first = encoding in ("yuv422_yuy2", "yuyv", "yuy2")
        chroma = np.stack([u, v], -1).reshape(H, W)
        pair = (y, chroma) if luma_first else (chroma, y)
        rows = [*np.stack(pair, -1).reshape(H, 2 * W)]
        u, v = (np.repeat(c, 2, 1) for c in (u, v))
    step = (2 * W if not encoding.startswith("nv") else W) + padding
    if encoding == "nv24":  # two rows of chroma bytes are one row of pixels: padded as one
        data = packed(np.array(rows[:H]), padding) + b"\xee" * padding
        data += packed(np.array(rows[H:]).reshape(H, 2 * W), 2 * padding)
    else:
        data = packed(np.array(rows), padding)
    got = colours_of(message(data, encoding, step=step), "a").astype(float)
    assert np.abs(got - bt601(y, u, v)).max() <= 2
    grey = image_of(message(data, encoding, step=step), "fir", stem="", where="a", fir_colour="luma")
    assert np.array_equal(grey.pixels, y)
    assert grey.flags == ("fir-colour-to-luma",)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"w": 0}, "0 x 4"),
        ({"h": 0}, "6 x 0"),
        ({"w": 1 << 31, "step": 1 << 31}, "2147483648 x 4"),
        ({"h": (1 << 32) - 1, "step": 6}, "6 x 4294967295"),
        ({"step": 5}, "5 bytes apart, but 6 pixels of mono8 have 6"),
        ({"step": 0}, "0 bytes apart"),
        ({"step": (1 << 64) - 1, "h": 1}, "18446744073709551615 bytes apart"),
        ({"data": bytes(23)}, "need 24 bytes, it has 23"),
        ({"step": 8, "data": bytes(29)}, "need 30 bytes, it has 29"),
        ({"encoding": ""}, "encoding ''"),
        ({"encoding": "h264"}, "encoding 'h264'"),
        ({"encoding": "bayer_rggb8", "w": 2}, "a mosaic of 2 x 4"),
        ({"encoding": "yuv422", "w": 5, "step": 10}, "odd width 5"),
        ({"encoding": "nv12", "h": 3}, "odd size 6 x 3"),
        ({"encoding": "nv12"}, "need 36 bytes"),
        ({"encoding": "nv24"}, "need 48 bytes, it has 0"),
    ],
)
def test_what_does_not_fit_is_refused(change: dict, words: str) -> None:
    values = {"data": bytes(24), "encoding": "mono8"} | change
    with pytest.raises(FrameError) as raised:
        colours_of(message(**values), "topic 3")
    assert words in str(raised.value)
    assert str(raised.value).startswith("topic 3: ")


def test_longer_data_is_no_harm() -> None:
    there = message(bytes(range(24)) + b"more", "mono8")
    assert np.array_equal(colours_of(there, "a"), np.arange(24).reshape(4, 6))
