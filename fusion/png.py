"""The common kind of PNG, decoded faster than libpng with zlib does it.

Inflating decides, and ISA-L inflates faster than zlib. Only whole, plain files are decoded here (grey or
RGB of 8 or 16 bits, not interlaced, no palette or transparency); for everything else, and at the first sign
of damage, the answer is None and OpenCV is asked, which also knows what to say. Format: W3C, Portable
Network Graphics (PNG) Specification, 2nd edition: chunks in section 5, filters in section 9.
"""

from __future__ import annotations

import struct
from contextlib import suppress
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

isal_zlib: Any = None
with suppress(ImportError):  # no wheel for this platform: OpenCV decodes them all
    from isal import isal_zlib

SIGNATURE = b"\x89PNG\r\n\x1a\n"
_SAMPLES = {0: 1, 2: 3}  # colour type -> samples a pixel
_SKIPPED = frozenset(
    {b"pHYs", b"tIME", b"sBIT", b"bKGD", b"tEXt", b"gAMA", b"sRGB", b"cHRM", b"iCCP", b"eXIf"}
)


def decode_plain(data: bytes, max_pixels: int) -> NDArray[Any] | None:
    """H x W grey or H x W x 3 BGR, uint8 or uint16, as stored; None where this is not a plain, whole PNG.

    Checks every chunk's CRC and the pixel data's Adler-32; takes memory for no more than `max_pixels`.
    """
    least = 57  # signature, IHDR, an empty IDAT, IEND
    if isal_zlib is None or len(data) < least or not data.startswith(SIGNATURE + b"\x00\x00\x00\x0dIHDR"):
        return None
    width, height, bits, colour, *rest = struct.unpack_from(">IIBBBBB", data, 16)
    plain = bits in (8, 16) and colour in _SAMPLES and rest == [0, 0, 0]
    if not plain or not 0 < width * height <= max_pixels:
        return None
    row_bytes = width * _SAMPLES[colour] * bits // 8
    raw = _inflated(_pixel_chunks(data), height * (row_bytes + 1))
    if raw is None:
        return None
    filtered = np.frombuffer(raw, np.uint8).reshape(height, row_bytes + 1)
    if filtered[:, 0].max() > 4:
        return None
    from fusion.unfilter import unfilter  # compiled code: loaded with the first image

    samples = unfilter(filtered, _SAMPLES[colour] * bits // 8)
    if bits == 16:
        samples = samples.view(">u2").astype(np.uint16)
    if colour == 0:
        return samples
    return np.asarray(cv2.cvtColor(samples.reshape(height, width, 3), cv2.COLOR_RGB2BGR))


def _pixel_chunks(data: bytes) -> bytes | None:
    """The IDAT chunks put together, or None: a chunk is cut off, damaged, or one that changes pixels."""
    parts, at = [], len(SIGNATURE)
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 12 + length
        if end > len(data) or isal_zlib.crc32(data[at + 4 : end - 4]) != _number(data[end - 4 : end]):
            return None
        if kind == b"IEND":
            return b"".join(parts)
        if kind == b"IDAT":
            parts.append(data[at + 8 : end - 4])
        elif kind != b"IHDR" and kind not in _SKIPPED:
            return None
        at = end
    return None


def _inflated(packed: bytes | None, size: int) -> bytes | None:
    """Exactly `size` bytes, or None. Never more memory than that, whatever the data says."""
    if packed is None:
        return None
    stream = isal_zlib.decompressobj()
    try:
        raw = stream.decompress(packed, size + 1)
    except isal_zlib.error:
        return None
    return raw if len(raw) == size and stream.eof else None


def _number(four_bytes: bytes) -> int:
    return int.from_bytes(four_bytes, "big")
