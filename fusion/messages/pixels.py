"""Raw images: what ROS's words for encodings mean, and the pixels as the sender's numbers.

The words are those of sensor_msgs/image_encodings.hpp; channels of "8UC3" are B, G, R as in OpenCV.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.codecs import MAX_PIXELS
from fusion.errors import FrameError
from fusion.messages.base import RawImage

_MOST_BYTES_APART = 1 << 31


class Encoding(NamedTuple):
    """`code` brings it to BGR or BGRA, None where it is in that order; `mosaic`: one colour a pixel."""

    dtype: str
    channels: int
    code: int | None = None
    mosaic: bool = False


def _table() -> dict[str, Encoding]:
    orders = {"mono": (1, None), "rgb": (3, cv2.COLOR_RGB2BGR), "bgr": (3, None)}
    orders |= {"rgba": (4, cv2.COLOR_RGBA2BGRA), "bgra": (4, None)}
    table = {
        f"{name}{bits}": Encoding(f"u{bits // 8}", *order)
        for name, order in orders.items()
        for bits in (8, 16)
    }
    numbers = {"8u": "u1", "8s": "i1", "16u": "u2", "16s": "i2", "32s": "i4", "32f": "f4", "64f": "f8"}
    table |= {f"{word}c{n}": Encoding(dtype, n) for word, dtype in numbers.items() for n in (1, 2, 3, 4)}
    mosaics = {
        "rggb": cv2.COLOR_BayerRGGB2BGR,
        "bggr": cv2.COLOR_BayerBGGR2BGR,
        "gbrg": cv2.COLOR_BayerGBRG2BGR,
        "grbg": cv2.COLOR_BayerGRBG2BGR,
    }
    for name, code in mosaics.items():
        table |= {f"bayer_{name}{bits}": Encoding(f"u{bits // 8}", 1, code, True) for bits in (8, 16)}
    return table


ENCODINGS = _table()
# Two bytes a pixel, chroma shared by two: OpenCV's code, and which of the bytes is luma.
_PACKED_YUV = {
    **dict.fromkeys(("yuv422", "uyvy"), (cv2.COLOR_YUV2BGR_UYVY, 1)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv", "yuy2"), (cv2.COLOR_YUV2BGR_YUY2, 0)),
}
_PLANAR_YUV = {"nv12": cv2.COLOR_YUV2BGR_NV12, "nv21": cv2.COLOR_YUV2BGR_NV21, "nv24": cv2.COLOR_YUV2BGR_NV12}
YUV = (*_PACKED_YUV, *_PLANAR_YUV)


def encoding_of(image: RawImage, where: str) -> str:
    """Its word in small letters. Raises `FrameError` for a word that is not read."""
    word = image.encoding.strip().lower()
    if word not in ENCODINGS and word not in YUV:
        hint = "read are mono, rgb, bgr (with a), bayer, 8UC1 and its like, yuv422, nv12, nv21, nv24"
        raise FrameError(f"an image of the encoding {image.encoding[:40]!r}", where=where, hint=hint)
    return word


def numbers_of(image: RawImage, encoding: Encoding, where: str) -> NDArray[Any]:
    """H x W or H x W x C, channels and numbers as sent, in this machine's byte order; a view if it can be."""
    order = ">" if image.big_endian else "<"
    view = _rows(image, image.height, np.dtype(encoding.dtype).newbyteorder(order), encoding.channels, where)
    return view.astype(view.dtype.newbyteorder("="), copy=False)


def colours_of(image: RawImage, where: str) -> NDArray[Any]:
    """H x W, H x W x 3 BGR or H x W x 4 BGRA in the sender's numbers; mosaics (bilinear) and YUV as BGR."""
    word = encoding_of(image, where)
    if word in YUV:
        return bgr_of_yuv(image, where)
    encoding = ENCODINGS[word]
    if encoding.channels == 2:
        what = f"an image of two channels ({image.encoding}) is neither colour nor counts"
        raise FrameError(what, where=where)
    pixels = numbers_of(image, encoding, where)
    if encoding.mosaic and min(pixels.shape) < 3:
        raise FrameError(f"a mosaic of {image.width} x {image.height} pixels", where=where)
    if encoding.code is None:
        return pixels
    return cv2.cvtColor(np.ascontiguousarray(pixels), encoding.code)  # rows at odd places are not taken


def bgr_of_yuv(image: RawImage, where: str) -> NDArray[np.uint8]:
    """H x W x 3 BGR by BT.601 of limited range, as OpenCV converts."""
    word = encoding_of(image, where)
    if word in _PACKED_YUV:
        return np.asarray(cv2.cvtColor(_packed(image, where), _PACKED_YUV[word][0]), np.uint8)
    luma, chroma = _planes(image, word, where)
    if word == "nv24":  # chroma for every pixel: the form for every second one, at twice the size
        luma = np.repeat(np.repeat(luma, 2, 0), 2, 1)
    both = np.vstack([luma, chroma.reshape(-1, luma.shape[1])])
    bgr = cv2.cvtColor(both, _PLANAR_YUV[word])
    return np.ascontiguousarray(bgr[::2, ::2] if word == "nv24" else bgr, np.uint8)


def luma_of_yuv(image: RawImage, where: str) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """H x W luma as it was sent, and all chroma (128 is none)."""
    word = encoding_of(image, where)
    if word in _PACKED_YUV:
        packed, at = _packed(image, where), _PACKED_YUV[word][1]
        return packed[:, :, at], packed[:, :, 1 - at]
    return _planes(image, word, where)


def _packed(image: RawImage, where: str) -> NDArray[Any]:
    if image.width % 2:
        raise FrameError(f"{image.encoding} of odd width {image.width}", where=where)
    return _rows(image, image.height, np.dtype("u1"), 2, where)


def _planes(image: RawImage, word: str, where: str) -> tuple[NDArray[Any], NDArray[Any]]:
    """Luma H x W; chroma below it, in rows of two bytes a pair of pixels (nv24: a pixel)."""
    w, h = image.width, image.height
    if word == "nv24":
        luma = _rows(image, h, np.dtype("u1"), 1, where)
        data = memoryview(image.data)[h * image.step :]
        twice = RawImage(image.header, 2 * w, h, image.encoding, False, 2 * image.step, data)
        return luma, _rows(twice, h, np.dtype("u1"), 1, where)
    if w % 2 or h % 2:
        raise FrameError(f"{image.encoding} of odd size {w} x {h}", where=where)
    both = _rows(image, h + h // 2, np.dtype("u1"), 1, where)
    return both[:h], both[h:]


def _rows(image: RawImage, rows: int, dtype: np.dtype, channels: int, where: str) -> NDArray[Any]:
    """`rows` x width (x channels) as a view; the last row need not be padded. All is checked before."""
    w, size = image.width, dtype.itemsize * channels
    if w <= 0 or image.height <= 0 or w * rows > MAX_PIXELS:
        what = f"an image of {w} x {image.height} pixels"
        raise FrameError(what, where=where, hint=f"1 to {MAX_PIXELS:,} pixels are read")
    if not w * size <= image.step <= _MOST_BYTES_APART:
        what = f"its rows are {image.step} bytes apart, but {w} pixels of {image.encoding} have {w * size}"
        raise FrameError(what, where=where)
    needed = (rows - 1) * image.step + w * size
    if len(image.data) < needed:
        found = f"{needed:,} bytes, it has {len(image.data):,}"
        what = f"{w} x {image.height} pixels of {image.encoding} need {found}"
        raise FrameError(what, where=where, hint="cut off while it was recorded?")
    shape, strides = (rows, w, channels), (image.step, size, dtype.itemsize)
    view: NDArray[Any] = np.ndarray(shape, dtype, buffer=image.data, strides=strides)
    return view[:, :, 0] if channels == 1 else view
