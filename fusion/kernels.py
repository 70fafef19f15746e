"""Draft: correct, plain numpy; the compiled forms follow."""

from __future__ import annotations

import math
import threading

import numpy as np
from numpy.typing import DTypeLike, NDArray

_local = threading.local()


def scratch(name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray:
    """A buffer of this thread, reused by the next call with the same name, shape and dtype."""
    held = _local.__dict__.setdefault("buffers", {})
    buffer = held.get(name)
    if buffer is None or buffer.shape != shape or buffer.dtype != dtype:
        buffer = held[name] = np.empty(shape, dtype)
    return buffer


def index_counts(counts: NDArray, lo: float, hi: float) -> tuple[NDArray[np.uint8], int, int]:
    s = np.clip((counts.astype(np.float64) - lo) / (hi - lo), 0, 1)
    index = np.floor(255 * s + 0.5).astype(np.uint8)
    return index, int((counts < lo).sum()), int((counts > hi).sum())


def resample(image, offset, fraction, out=None):
    h, w = image.shape
    y0, x0 = np.divmod(offset.astype(np.int64), w)
    y1, x1 = np.minimum(y0 + 1, h - 1), np.minimum(x0 + 1, w - 1)
    fx, fy = fraction.astype(np.int64) & 255, fraction.astype(np.int64) >> 8
    im = image.astype(np.int64)
    t = im[y0, x0] * (256 - fx) + im[y0, x1] * fx
    u = im[y1, x0] * (256 - fx) + im[y1, x1] * fx
    res = ((t * (256 - fy) + u * fy + 32768) >> 16).astype(np.uint8)
    if out is None:
        return res
    out[:] = res
    return out


def blend_indexed(bgr, index, table_bgr, alpha, mask=None):
    A, B = math.ceil(alpha * 2**20), math.ceil((1 - alpha) * 2**20)
    out = ((A * bgr.astype(np.int64) + B * table_bgr[index].astype(np.int64) + 2**19) >> 20).astype(np.uint8)
    return out if mask is None else np.where(mask[..., None] > 0, out, bgr)
