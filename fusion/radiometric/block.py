"""The FLIR block (FFF): a header, a directory of records, and the records that matter here.

Names and places are those of the tag tables in ExifTool's documentation ("FLIR FFF Tags"). Header and
directory are written in either byte order, told by the version number; a record tells its own by its first
number, which is below 256.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.codecs import MAX_PIXELS, decode_image
from fusion.errors import FrameError
from fusion.radiometric.planck import Planck
from fusion.radiometric.segments import BLOCK_STARTS

RAW_DATA, EMBEDDED_IMAGE, CAMERA_INFO, PICTURE_IN_PICTURE = 0x01, 0x0E, 0x20, 0x2A
_ENTRY_BYTES, _HEADER_BYTES, _PIXELS_AT = 32, 64, 32
_MOST_RECORDS = 1024  # cameras write up to 14 places
_LARGEST_EXPONENT_B = 1e5

_CAMERA_FLOATS = {
    "emissivity": 0x20,
    "distance_m": 0x24,
    "reflected_k": 0x28,
    "atmosphere_k": 0x2C,
    "window_k": 0x30,
    "window_transmission": 0x34,
    "humidity": 0x3C,
    "r1": 0x58,
    "b": 0x5C,
    "f": 0x60,
    "alpha1": 0x70,
    "alpha2": 0x74,
    "beta1": 0x78,
    "beta2": 0x7C,
    "x": 0x80,
    "r2": 0x30C,
}
_CAMERA_TEXTS = {"model": (0xD4, 32), "serial": (0x104, 16), "lens": (0x170, 32)}
_PLANCK_O_AT, _CAMERA_LEAST = 0x308, 0x310
_TIME_AT = 0x384


class Record(NamedTuple):
    """One record: its kind, its bytes, and the byte order of its numbers (``<`` or ``>``)."""

    kind: int
    data: memoryview
    order: str


@dataclass(frozen=True, slots=True)
class PictureInPicture:
    """How the camera lays thermal and visible over each other, as it states it.

    `real_to_ir` is the visible image's field of view over the thermal one's; `offset_xy` shifts the thermal
    image, from the visible one's centre.
    """

    real_to_ir: float
    offset_xy: tuple[int, int]


def directory(block: bytes, where: str) -> dict[int, tuple[int, int]]:
    """Where the block's records lie: kind -> (offset, bytes), the first of each kind; kind 0 is a free place.

    Only the block's beginning need be there. Raises `FrameError` where that is no directory.
    """
    if not block.startswith(BLOCK_STARTS) or len(block) < _HEADER_BYTES:
        raise FrameError("its FLIR data do not begin as such data do", where=where, hint=_AGAIN)
    version = {order: struct.unpack_from(f"{order}I", block, 0x14)[0] for order in "><"}
    order = next((order for order, number in version.items() if 100 <= number < 200), None)
    if order is None:
        raise FrameError(f"FLIR data of the unknown version {version['>']}", where=where)
    start, count = struct.unpack_from(f"{order}II", block, 0x18)
    if count > _MOST_RECORDS or start + count * _ENTRY_BYTES > len(block):
        what = f"the directory of its FLIR data claims {count} records from byte {start} of {len(block)}"
        raise FrameError(what, where=where, hint=_AGAIN)
    places: dict[int, tuple[int, int]] = {}
    for at in range(start, start + count * _ENTRY_BYTES, _ENTRY_BYTES):
        kind, offset, length = struct.unpack_from(f"{order}H10xII", block, at)
        places.setdefault(kind, (offset, length))
    return places


def records(block: bytes, where: str) -> dict[int, Record]:
    """The records of a whole block by kind. Raises `FrameError` where one would lie outside."""
    found = {}
    for kind, (offset, length) in directory(block, where).items():
        if kind not in (RAW_DATA, EMBEDDED_IMAGE, CAMERA_INFO, PICTURE_IN_PICTURE):
            continue
        if offset + length > len(block):
            what = (
                f"the record 0x{kind:02x} of its FLIR data claims {length} bytes at {offset} of {len(block)}"
            )
            raise FrameError(what, where=where, hint=_AGAIN)
        data = memoryview(block)[offset : offset + length]
        # the first number of these is small, and says by its place which byte is the low one
        order = ">" if kind != PICTURE_IN_PICTURE and len(data) > 1 and data[0] == 0 < data[1] else "<"
        found[kind] = Record(kind, data, order)
    return found


def raw_counts(record: Record, where: str, max_pixels: int = MAX_PIXELS) -> NDArray[np.uint16]:
    """The sensor's counts, H x W uint16. Raises `FrameError`.

    They lie there as they are, or as a PNG of 16 bits, whose samples most cameras write with the low byte
    first, against the PNG standard. The order that gives the smoother image is taken.
    """
    width, height = _size(record, where, max_pixels)
    payload = record.data[_PIXELS_AT:]
    if payload[:4] == b"\x89PNG":
        counts = decode_image(bytes(payload), f"{where} (thermal PNG)", max_pixels)
        if counts.shape != (height, width) or counts.dtype != np.uint16:
            what = f"its thermal PNG is {counts.shape} {counts.dtype}, its record says {width} x {height}"
            raise FrameError(what, where=where, hint=_AGAIN)
        return min(counts, counts.byteswap(), key=_roughness)
    if len(payload) < 2 * width * height:
        what = f"{len(payload)} bytes of thermal data for {width} x {height} pixels"
        raise FrameError(what, where=where, hint=_AGAIN)
    pixels = np.frombuffer(payload, f"{record.order}u2", width * height)
    return pixels.astype(np.uint16).reshape(height, width)


def _roughness(counts: NDArray[np.uint16]) -> float:
    """How far neighbours in a row differ, on the whole. The wrong byte order puts noise in the high byte."""
    return float(np.abs(np.diff(counts.astype(np.int32), axis=1)).mean()) if counts.shape[1] > 1 else 0.0


def embedded_image(record: Record, where: str, max_pixels: int = MAX_PIXELS) -> NDArray[np.uint8]:
    """The visible image, H x W x 3 BGR uint8, from a JPEG or a PNG. Raises `FrameError` for other data.

    The channels of a PNG are Y, Cb and Cr (ITU-R BT.601, full range), whatever the PNG itself says.
    """
    import cv2

    payload = bytes(record.data[_PIXELS_AT:])
    if payload[:2] != b"\xff\xd8" and payload[:4] != b"\x89PNG":
        raise FrameError("its visible image is neither JPEG nor PNG", where=where, hint=_REPORT)
    pixels = decode_image(payload, f"{where} (visible image)", max_pixels)
    if pixels.dtype != np.uint8 or pixels.ndim not in (2, 3):
        raise FrameError(f"its visible image is {pixels.shape} {pixels.dtype}", where=where, hint=_REPORT)
    if pixels.ndim == 2:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR), np.uint8)
    if payload[:2] == b"\xff\xd8" or pixels.shape[2] != 3:
        return np.ascontiguousarray(pixels[..., :3])
    # decoded to B, G, R: the third is the PNG's first, Y; OpenCV wants Y, Cr, Cb
    ycrcb = np.ascontiguousarray(pixels[..., [2, 0, 1]])
    return np.asarray(cv2.cvtColor(ycrcb, cv2.COLOR_YCrCb2BGR), np.uint8)


def planck(record: Record, where: str) -> Planck:
    """The constants that turn counts into degrees. Raises `FrameError` where they cannot be right."""
    if len(record.data) < _CAMERA_LEAST:
        raise FrameError(f"its camera record has only {len(record.data)} bytes", where=where, hint=_AGAIN)
    values = {
        name: struct.unpack_from(f"{record.order}f", record.data, at)[0]
        for name, at in _CAMERA_FLOATS.items()
    }
    if values["humidity"] > 2:  # some write percent
        values["humidity"] /= 100
    values["o"] = float(struct.unpack_from(f"{record.order}i", record.data, _PLANCK_O_AT)[0])
    try:
        return Planck(**values)
    except ValueError as error:
        raise FrameError(f"its camera constants cannot be right: {error}", where=where, hint=_AGAIN) from None


def camera_texts(record: Record) -> dict[str, str]:
    """`model`, `serial` and `lens` as the camera writes them, "" where it does not."""
    texts = {}
    for name, (at, size) in _CAMERA_TEXTS.items():
        text = bytes(record.data[at : at + size]).partition(b"\x00")[0].decode("latin-1")
        texts[name] = "".join(c for c in text if c.isprintable()).strip()
    return texts


def taken_ns(record: Record) -> int | None:
    """When the image was taken, in nanoseconds since 1970 by the camera's clock; None where it says nothing.

    Seconds of UTC and, in the low half of the next word, milliseconds.
    """
    if len(record.data) < _TIME_AT + 8:
        return None
    seconds, fraction = struct.unpack_from(f"{record.order}II", record.data, _TIME_AT)
    return seconds * 1_000_000_000 + (fraction & 0xFFFF) * 1_000_000 if seconds else None


def picture_in_picture(record: Record) -> PictureInPicture | None:
    """What the record says; None where it is too short or says nothing sensible."""
    if len(record.data) < 8:
        return None
    ratio, x, y = struct.unpack_from("<fhh", record.data, 0)
    return PictureInPicture(ratio, (x, y)) if math.isfinite(ratio) and 0.1 <= ratio <= 20 else None


def _size(record: Record, where: str, max_pixels: int) -> tuple[int, int]:
    if len(record.data) < _PIXELS_AT:
        raise FrameError("its record of thermal data is too short", where=where, hint=_AGAIN)
    width, height = struct.unpack_from(f"{record.order}HH", record.data, 2)
    if not (width and height and width * height <= max_pixels):
        raise FrameError(f"its thermal data claim {width} x {height} pixels", where=where, hint=_AGAIN)
    return width, height


_AGAIN = "the file is damaged: copy it again from the camera"
_REPORT = "blend its counts with RGB images of another source"
