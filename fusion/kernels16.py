"""The resampling of `fusion.kernels` for 16-bit counts: the same positions, weights and rounding.

A sum of taps times weights is below 2**32, so integers of 32 bits hold it exactly.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion.kernels import checked, compiled, read_only, scratch

_u16, _u32 = np.uint16, np.uint32
_SAMPLED = 8192  # pixels worked on at a time, as in `fusion.kernels`


def resample_counts(
    counts: NDArray[np.uint8] | NDArray[np.uint16],
    offset: NDArray[np.uint32],
    fraction: NDArray[np.uint16],
    mask: NDArray[np.uint8],
) -> NDArray[np.uint16]:
    """Bilinear values of `counts` (h x w uint8 or uint16) at H x W given positions; 0 where `mask` is 0.

    `offset` and `fraction` (H x W) are as in `fusion.kernels.resample`: y0 w + x0 of the upper left tap, and
    fy << 8 | fx in 1/256 px; taps beyond the last row or column are taken from it. Returns a new H x W
    uint16 array, (sum of taps times weights + 32768) >> 16. Raises `ValueError` for wrong shapes and types,
    and where an offset lies outside the image.
    """
    if counts.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"expected counts of uint8 or uint16, got {counts.dtype}")
    counts = checked("counts", counts, counts.dtype, (None, None)).astype(np.uint16, copy=False)
    offset = checked("offset", offset, np.uint32, (None, None))
    fraction = checked("fraction", fraction, np.uint16, offset.shape)
    mask = checked("mask", mask, np.uint8, offset.shape)
    if counts.size >= 1 << 31:
        raise ValueError(f"the image has too many pixels to be addressed: {counts.shape}")
    h, w = counts.shape
    out = np.empty(offset.shape, np.uint16)
    pairs = scratch("kernels16.pairs", ((h + 1) * w,), np.uint32)
    flat = (read_only(array.reshape(-1)) for array in (offset, fraction, mask))
    if not _sample_counts(read_only(counts), *flat, pairs, out.reshape(-1)):
        raise ValueError(f"an offset lies outside the image of {counts.size} pixels: {offset.max()}")
    return out


# As in `fusion.kernels`: every operation is cast back to its width, or the loops would not vectorise.


@compiled
def _sample_counts(counts, offset, fraction, mask, pairs, out):
    h, w = counts.shape
    gathered = 0
    for start in range(0, out.size, _SAMPLED):
        stop = min(start + _SAMPLED, out.size)
        largest = np.int64(_largest(offset[start:stop]))
        if largest >= counts.size:
            return False
        while gathered <= min(largest // w + 1, h):  # the last row is there twice
            _pair_columns(counts[min(gathered, h - 1)], pairs[gathered * w : (gathered + 1) * w])
            gathered += 1
        _interpolate(
            pairs, _u32(w), offset[start:stop], fraction[start:stop], mask[start:stop], out[start:stop]
        )
    return True


@compiled
def _largest(values):
    largest = _u32(0)
    for i in range(values.size):
        largest = max(largest, values[i])
    return largest


@compiled
def _pair_columns(row, pairs):
    """Each count and its right neighbour in one word."""
    last = row.size - 1
    for x in range(last):
        pairs[x] = _u32(_u32(row[x]) | _u32(_u32(row[x + 1]) << _u32(16)))
    pairs[last] = _u32(_u32(row[last]) | _u32(_u32(row[last]) << _u32(16)))


@compiled
def _interpolate(pairs, w, offset, fraction, mask, out):
    for i in range(out.size):
        at = _u32(offset[i] & _u32(0x7FFFFFFF))  # known to fit 31 bits: the faster gather
        upper, lower = pairs[at], pairs[_u32(_u32(at + w) & _u32(0x7FFFFFFF))]
        fx, fy = _u32(fraction[i] & _u32(255)), _u32(_u32(fraction[i]) >> _u32(8))
        # Sums of products wrap at 32 bits nowhere; differences do, and their sums wrap back.
        left, right = _u32(upper & _u32(0xFFFF)), _u32(upper >> _u32(16))
        above = _u32(_u32(left << _u32(8)) + _u32(_u32(right - left) * fx))
        left, right = _u32(lower & _u32(0xFFFF)), _u32(lower >> _u32(16))
        below = _u32(_u32(left << _u32(8)) + _u32(_u32(right - left) * fx))
        value = _u32(_u32(above << _u32(8)) + _u32(_u32(below - above) * fy))
        seen = _u32(0) if mask[i] == 0 else _u32(0xFFFF)
        out[i] = _u16(_u32(_u32(value + _u32(32768)) >> _u32(16)) & seen)
