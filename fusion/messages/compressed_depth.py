"""`compressedDepth`: depth as ROS's compressed_depth_image_transport sends it, PNG or RVL behind a header."""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.codecs import MAX_PIXELS, decode_image
from fusion.errors import FrameError
from fusion.messages.base import CompressedImage
from fusion.messages.rvl_kernels import decode_rvl

_HEADER = struct.Struct("<iff")  # a format that nobody reads, and two parameters of the quantisation
_SIZE = struct.Struct("<ii")  # RVL's: columns, rows
_PNG = b"\x89PNG\r\n\x1a\n"
_LEAST_PER_PIXEL = 1 / 4096  # bytes; a run of zeros is short, but no camera sees nothing at all


class StoredDepth(NamedTuple):
    """H x W uint16: millimetres, or (`inverse`) steps of 1/depth: depth_m = a / (step - b), 0 is none."""

    steps: NDArray[np.uint16]
    inverse: tuple[float, float] | None


def is_compressed_depth(message: CompressedImage) -> bool:
    """Whether its bytes are so: a PNG behind 12 other bytes; RVL, which has no mark, by the sender's word."""
    data = message.data
    if bytes(data[12:20]) == _PNG:
        return True
    return "compresseddepth" in message.format.lower() and bytes(data[:8]) != _PNG


def stored_depth(message: CompressedImage, where: str) -> StoredDepth:
    """What a compressedDepth message holds. Raises `FrameError` where it is damaged or claims too much."""
    data = memoryview(message.data)
    if len(data) <= _HEADER.size:
        raise FrameError(f"{len(data)} bytes are no compressedDepth image", where=where)
    _, a, b = _HEADER.unpack_from(data)
    payload = data[_HEADER.size :]
    steps = decode_image(bytes(payload), where) if bytes(payload[:8]) == _PNG else _rvl(payload, where)
    if steps.ndim != 2 or steps.dtype != np.uint16:
        raise FrameError(f"its PNG holds {steps.shape} {steps.dtype}, not 16-bit depth", where=where)
    if not message.format.strip().lower().startswith("32fc1"):
        return StoredDepth(steps, None)
    if not (np.isfinite(a) and np.isfinite(b) and a > 0):
        raise FrameError(f"its quantisation is none: {a:g}, {b:g}", where=where)
    return StoredDepth(steps, (a, b))


def metres(stored: StoredDepth) -> NDArray[np.float32]:
    """H x W float32 metres, 0 where there is none."""
    if stored.inverse is None:
        return stored.steps.astype(np.float32) * np.float32(0.001)
    a, b = stored.inverse
    with np.errstate(all="ignore"):
        depth_m = (a / (np.arange(1 << 16) - b)).astype(np.float32)
    depth_m[0] = 0
    depth_m[~(np.isfinite(depth_m) & (depth_m > 0))] = 0
    return depth_m[stored.steps]


def _rvl(payload: memoryview, where: str) -> NDArray[np.uint16]:
    if len(payload) < _SIZE.size:
        raise FrameError("its RVL code has no size", where=where)
    w, h = _SIZE.unpack_from(payload)
    code = np.frombuffer(payload[_SIZE.size :], np.uint8)
    if w <= 0 or h <= 0 or w * h > MAX_PIXELS or code.size < w * h * _LEAST_PER_PIXEL:
        what = f"its RVL code of {code.size:,} bytes claims {w} x {h} pixels"
        raise FrameError(what, where=where, hint="compressedDepth with neither PNG nor RVL in it?")
    steps = np.empty(w * h, np.uint16)
    done = decode_rvl(code, steps)
    if done != w * h:
        raise FrameError(f"its RVL code is damaged or cut off: {w} x {h} pixels claimed", where=where)
    return steps.reshape(h, w)
