"""16-bit PNG, packed by ISA-L where it is installed: the dense truth is most of what a recording writes.

Format: W3C, Portable Network Graphics (PNG) Specification, 2nd edition; every row has the filter "up".
"""

from __future__ import annotations

import struct
import zlib
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.codecs import encode_png
from fusion.simulate.mine.image_kernels import png_rows

isal_zlib: Any = None
with suppress(ImportError):  # no wheel for this platform: OpenCV encodes them
    from isal import isal_zlib


def encode_png16(samples: NDArray[np.uint16]) -> bytes:
    """A PNG of H x W grey or H x W x 3 uint16, channels in the file's order: red, green, blue."""
    if samples.dtype != np.uint16 or samples.ndim not in (2, 3) or samples.shape[2:] not in ((), (3,)):
        raise ValueError(f"expected HxW or HxWx3 uint16, got {samples.shape} {samples.dtype}")
    if isal_zlib is None:
        return encode_png(samples if samples.ndim == 2 else np.ascontiguousarray(samples[..., ::-1]))
    h, w = samples.shape[:2]
    rows = np.empty((h, 1 + 2 * samples[0].size), np.uint8)
    png_rows(np.ascontiguousarray(samples).reshape(h, -1), rows)
    head = struct.pack(">IIBBBBB", w, h, 16, 0 if samples.ndim == 2 else 2, 0, 0, 0)
    packed = isal_zlib.compress(rows, 1)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", head) + _chunk(b"IDAT", packed) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
