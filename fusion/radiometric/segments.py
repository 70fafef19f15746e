"""The metadata segments of a JPEG file, and the FLIR block that thermal cameras spread over some of them.

Between the JPEG's start and its picture stand segments: 0xFF, a marker, a 16-bit big-endian length that
counts itself, the payload. FLIR's are APP1 with the payload ``FLIR\\0``, a byte 1, the part's number, the
number of the last part, then that part of the block.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from fusion.errors import FrameError

JPEG_START = b"\xff\xd8"
BLOCK_STARTS = (b"FFF\x00", b"AFF\x00")
APP1, APP3 = 0xE1, 0xE3
_FLIR, _FLIR_HEAD = b"FLIR\x00", 8
_PICTURE, _END = 0xDA, 0xD9
_ALONE = {0x01, *range(0xD0, 0xD9)}  # markers that have no length
_LEAST_DJI_BYTES = 1 << 16  # of raw data: 160 x 120 pixels would be 38 kB, DJI's have 640 x 512


class Segment(NamedTuple):
    """A segment's marker (its second byte) and its payload, cut short where the data ends."""

    marker: int
    payload: memoryview


def segments(data: bytes) -> Iterator[Segment]:
    """The segments in front of the picture; ends where `data` ends or is no JPEG any more."""
    view, at = memoryview(data), 2
    if not data.startswith(JPEG_START):
        return
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF or marker in _ALONE:  # a fill byte, or nothing but itself
            at += 1 if marker == 0xFF else 2
            continue
        if marker in (_PICTURE, _END):
            return
        length = int.from_bytes(view[at + 2 : at + 4], "big")
        if length < 2:
            return
        yield Segment(marker, view[at + 4 : at + 2 + length])
        at += 2 + length


def flir_block(data: bytes, where: str) -> bytes | None:
    """The FLIR block of a JPEG file, put together in the order of its parts; None where there is none.

    `data` may be the block itself. Raises `FrameError` where a part is missing, there twice or contradicts
    another, and where none of them begins a block.
    """
    if data.startswith(BLOCK_STARTS):
        return data
    parts: dict[int, memoryview] = {}
    last = None
    for marker, payload in segments(data):
        if marker != APP1 or payload[:5] != _FLIR or len(payload) < _FLIR_HEAD:
            continue
        number, total = payload[6], payload[7]
        if number in parts or number > total or last not in (None, total):
            what = f"part {number} of {total} of its FLIR data is there twice or contradicts another"
            raise FrameError(what, where=where, hint="copy the file again from the camera")
        parts[number], last = payload[_FLIR_HEAD:], total
    if last is None:
        return None
    missing = [str(number) for number in range(last + 1) if number not in parts]
    if missing:
        what = (
            f"{len(missing)} of {last + 1} parts of its FLIR data are missing, the first number {missing[0]}"
        )
        raise FrameError(what, where=where, hint="the file is cut short, or was saved again by an editor")
    return b"".join(parts[number] for number in range(last + 1))


def first_part(data: bytes) -> bytes | None:
    """Part 0 of the FLIR block among the segments of `data`, which may be a file's beginning only.

    None where there is no part at all, empty where there are others.
    """
    if data.startswith(BLOCK_STARTS):
        return data
    found = None
    for marker, payload in segments(data):
        if marker == APP1 and payload[:5] == _FLIR and len(payload) > _FLIR_HEAD:
            if payload[6] == 0:
                return bytes(payload[_FLIR_HEAD:])
            found = b""
    return found


def is_dji(data: bytes) -> bool:
    """Whether this is DJI's own radiometric JPEG: raw data in APP3 segments, without FLIR's block."""
    found = list(segments(data))
    raw = sum(len(payload) for marker, payload in found if marker == APP3)
    made_by = any(m == APP1 and p[:4] == b"Exif" and b"DJI\x00" in bytes(p[:4096]) for m, p in found)
    return made_by and raw >= _LEAST_DJI_BYTES
