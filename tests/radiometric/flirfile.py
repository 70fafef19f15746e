"""Radiometric JPEGs made for tests, byte by byte from published tables, in all the forms cameras write."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

RAW, EMBEDDED, CAMERA, PIP = 0x01, 0x0E, 0x20, 0x2A
CONSTANTS: dict[str, float] = {
    "r1": 15848.854,
    "r2": 0.014533112,
    "b": 1414.9,
    "f": 1.0,
    "o": -4405,
    "emissivity": 0.95,
    "distance_m": 3.0,
    "reflected_k": 294.0,
    "atmosphere_k": 287.0,
    "window_k": 292.0,
    "window_transmission": 0.98,
    "humidity": 0.49,
    "alpha1": 0.006569,
    "alpha2": 0.01262,
    "beta1": -0.002276,
    "beta2": -0.00667,
    "x": 1.9,
}
_PLACES = {
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
Coding = Literal["raw", "png", "swapped-png"]


def png(pixels: NDArray[Any]) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def jpg(pixels: NDArray[Any]) -> bytes:
    return cv2.imencode(".jpg", pixels)[1].tobytes()


def ramp(width: int = 32, height: int = 24, start: int = 12000) -> NDArray[np.uint16]:
    """Counts that rise smoothly, as those of a scene."""
    y, x = np.mgrid[:height, :width]
    return (start + 37 * x + 11 * y).astype(np.uint16)


def scene(width: int = 48, height: int = 36) -> NDArray[np.uint8]:
    y, x = np.mgrid[:height, :width]
    return np.stack([40 + 3 * x, 200 - 3 * y, 90 + x + y], -1).astype(np.uint8)


def raw_record(counts: NDArray[np.uint16], coding: Coding = "raw", order: str = "<") -> bytes:
    height, width = counts.shape
    head = struct.pack(f"{order}HHH26x", 2, width, height)
    if coding == "raw":
        return head + counts.astype(f"{order}u2").tobytes()
    return head + png(counts.byteswap() if coding == "swapped-png" else counts)


def image_record(payload: bytes, size_wh: tuple[int, int], order: str = "<") -> bytes:
    return struct.pack(f"{order}HHH26x", 3, *size_wh) + payload


def camera_record(order: str = "<", stamp_ns: int = 0, **changed: float) -> bytes:
    values = {**CONSTANTS, **changed}
    record = bytearray(2476)
    struct.pack_into(f"{order}H", record, 0, 2)
    for name, at in _PLACES.items():
        struct.pack_into(f"{order}f", record, at, values[name])
    struct.pack_into(f"{order}i", record, 0x308, int(values["o"]))
    for at, text in ((0xD4, b"FLIR T0"), (0x104, b"serial 7"), (0x170, b"FOL9")):
        record[at : at + len(text)] = text
    seconds, rest = divmod(stamp_ns, 10**9)
    struct.pack_into(f"{order}II", record, 0x384, seconds, 0xABCD0000 | rest // 10**6)
    return bytes(record)


def pip_record(ratio: float = 1.4, x: int = 14, y: int = -14) -> bytes:
    return struct.pack("<fhh24x", ratio, x, y)


def block(
    records: Sequence[tuple[int, bytes]], order: str = ">", magic: bytes = b"FFF\x00", free: int = 2
) -> bytes:
    """Header, directory (with `free` places left free), records."""
    count = len(records) + free
    at, entries, body = 64 + 32 * count, b"", b""
    for kind, data in records:
        entries += struct.pack(f"{order}HHIIIIIII", kind, 1, 100, 1, at + len(body), len(data), 0, 0, 0)
        body += data
    head = magic + b"CREATOR".ljust(16, b"\x00") + struct.pack(f"{order}IIII28x", 100, 64, count, 3)
    return head.ljust(64, b"\x00") + entries + bytes(32 * free) + body


def segment(marker: int, payload: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, marker, len(payload) + 2) + payload


def parts(data: bytes, size: int = 600) -> list[bytes]:
    """The FLIR segments of a block cut into parts of `size` bytes, made larger where 256 would not do."""
    size = max(size, -(-len(data) // 250))
    pieces = [data[at : at + size] for at in range(0, len(data), size)]
    return [
        segment(0xE1, b"FLIR\x00" + bytes((1, k, len(pieces) - 1)) + piece) for k, piece in enumerate(pieces)
    ]


def jpeg(segments: Sequence[bytes], picture: NDArray[np.uint8] | None = None) -> bytes:
    """A JPEG of an orange preview (or `picture`) with these segments in front."""
    orange = np.full((16, 16, 3), (30, 120, 230), np.uint8)
    data = jpg(orange if picture is None else picture)
    return data[:2] + b"".join(segments) + data[2:]


def flir_jpeg(
    counts: NDArray[np.uint16] | None = None,
    visible: NDArray[np.uint8] | None = None,
    *,
    coding: Coding = "raw",
    stamp_ns: int = 0,
    **changed: float,
) -> bytes:
    """A whole file: counts and constants, and a visible image as JPEG where one is given."""
    records = [(RAW, raw_record(ramp() if counts is None else counts, coding))]
    records.append((CAMERA, camera_record("<", stamp_ns, **changed)))
    if visible is not None:
        records.append((EMBEDDED, image_record(jpg(visible), visible.shape[1::-1])))
    return jpeg(parts(block(records)))


def dji_jpeg() -> bytes:
    """As DJI's own: its maker in EXIF, raw data in APP3 segments, no FLIR data."""
    exif = segment(0xE1, b"Exif\x00\x00MM\x00*" + bytes(30) + b"DJI\x00ZH20T\x00")
    return jpeg([exif, *(segment(0xE3, bytes(60000)) for _ in range(3))])
