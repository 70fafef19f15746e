"""The head of a picture's file: its form, size and kind of pixels, without decoding it."""

from __future__ import annotations

import struct
from typing import NamedTuple

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
_NO_SIZE = {0x01, *range(0xD0, 0xDA)}  # JPEG markers that stand alone
_MOST_SEGMENTS = 10_000  # a crafted file could hold nothing but empty ones
_FRAME = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_WORDS = {
    (1, 8): "mono8",
    (1, 16): "mono16",
    (3, 8): "bgr8",
    (4, 8): "bgra8",
    (3, 16): "bgr16",
    (4, 16): "bgra16",
}


class Head(NamedTuple):
    """`encoding` is ROS's word for what decoding gives, `form` png, jpeg or webp."""

    form: str
    encoding: str
    size_wh: tuple[int, int] | None


def peek(data: bytes | memoryview) -> Head | None:
    """The head of a PNG or JPEG in memory; None for any other, and for one that is damaged there."""
    start = bytes(data[:33])
    if start.startswith(_PNG) and start[12:16] == b"IHDR" and len(start) == 33:
        width, height, bits, kind = struct.unpack_from(">IIBB", start, 16)
        return Head("png", word_of(_PNG_CHANNELS.get(kind, 0), max(bits, 8)), (width, height))
    if start.startswith(b"\xff\xd8"):
        return _jpeg(data)
    return None


def word_of(channels: int, bits: int) -> str:
    """ROS's word for pixels as decoding gives them."""
    return _WORDS.get((channels, bits), f"{bits}UC{channels}")


def _jpeg(data: bytes | memoryview) -> Head | None:
    at = 2
    for _ in range(_MOST_SEGMENTS):
        if at + 4 > len(data) or data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker in _NO_SIZE or marker == 0xFF:
            at += 1 if marker == 0xFF else 2
            continue
        length = data[at + 2] << 8 | data[at + 3]
        if marker in _FRAME and at + 10 <= len(data):
            bits, height, width, channels = struct.unpack_from(">BHHB", data, at + 4)
            return Head("jpeg", word_of(channels, bits), (width, height))
        at += 2 + max(length, 2)
    return None
