"""The per-pixel loops that no single OpenCV call does, compiled; arrays in, arrays out.

They compute in integers, so that a result never depends on processor, thread or vector width, and release
the GIL. Machine code is made at the first call and kept beside this file, or in the user's cache.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from typing import Any

import numba
import numpy as np
from numba.core.caching import FunctionCache
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numpy.typing import DTypeLike, NDArray

_i16, _i32, _u8, _u16, _u32 = np.int16, np.int32, np.uint8, np.uint16, np.uint32

# Pixels worked on at a time, so that what passes between two loops stays in the first-level cache.
_COUNTED = 4032  # fewer than 4096: two tallies share one 32-bit sum
_SAMPLED = 8192
_BLENDED = 4096  # a multiple of 4: four pixels are three 32-bit words

_KEEP = np.where(np.arange(256) > 0, 0xFFFFFF, 0).astype(np.uint32)  # mask -> which bytes of a colour stay

_local = threading.local()


def scratch(name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """A buffer of `shape` and `dtype` with undefined content, owned by the calling thread.

    The next call with the same `name` in the same thread hands out the same memory, so it must never
    be returned to a caller. It grows to the largest size asked for. Names that begin with ``kernels.``
    belong to this module.
    """
    held: dict[str, NDArray[np.uint8]] = _local.__dict__
    size = math.prod(shape) * np.dtype(dtype).itemsize
    buffer = held.get(name)
    if buffer is None or buffer.size < size:
        buffer = held[name] = np.empty(size, np.uint8)
    return buffer[:size].view(dtype).reshape(shape)


def index_counts(
    counts: NDArray[np.uint8] | NDArray[np.uint16], lo: float, hi: float
) -> tuple[NDArray[np.uint8], int, int]:
    """Stretch the window [`lo`, `hi`] to the 256 entries of a colour table (thesis 6.1).

    `counts` is H x W uint8 or uint16; the window is in counts, finite, `lo` < `hi`. Returns a new
    H x W uint8 array, floor(255 s + 1/2) with s = (count - lo) / (hi - lo) clipped to [0, 1], evaluated in
    float64, and how many pixels lie below `lo` and above `hi`. Raises `ValueError`.
    """
    if not (math.isfinite(lo) and math.isfinite(hi) and lo < hi):
        raise ValueError(f"expected a finite window lo < hi, got {lo} and {hi}")
    if counts.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"expected counts of uint8 or uint16, got {counts.dtype}")
    counts = checked("counts", counts, counts.dtype, (None, None))
    first, table = _window_table(float(lo), float(hi), 255 if counts.dtype == np.uint8 else 65535)
    index = np.empty(counts.shape, np.uint8)
    below, above = _look_up_counts(_flat(counts), first, table, index.reshape(-1))
    return index, int(below), int(above)


@lru_cache(maxsize=4)
def _window_table(lo: float, hi: float, top: int) -> tuple[int, NDArray[np.uint32]]:
    """The least count of a table over a window, and the table: index | below << 8 | above << 20.

    It reaches one count beyond the window on either side; all counts further out are as those.
    """
    first = min(max(math.ceil(lo) - 1, 0), top)
    last = min(max(math.floor(hi) + 1, 0), top)
    counts = np.arange(first, last + 1, dtype=np.float64)
    index = np.floor(255 * np.clip((counts - lo) / (hi - lo), 0, 1) + 0.5)
    table = index + (counts < lo) * 2.0**8 + (counts > hi) * 2.0**20
    return first, _flat(table.astype(np.uint32))


def resample(
    image: NDArray[np.uint8],
    offset: NDArray[np.uint32],
    fraction: NDArray[np.uint16],
    out: NDArray[np.uint8] | None = None,
) -> NDArray[np.uint8]:
    """Bilinear values of `image` (h x w uint8) at H x W given positions, in steps of 1/256 pixel.

    `offset` is y0 w + x0 of a position's upper left tap, `fraction` holds fx = 256 (x - x0) in its low byte
    and fy = 256 (y - y0) in its high byte. Taps beyond the last row or column are taken from it. The
    value is (sum of taps times weights + 32768) >> 16, that is, rounded half up. Writes into `out`
    (H x W uint8, contiguous, not overlapping the inputs) or a new array, and returns it. Raises
    `ValueError` where an offset lies outside the image; `out` is then undefined.
    """
    image = checked("image", image, np.uint8, (None, None))
    offset = checked("offset", offset, np.uint32, (None, None))
    fraction = checked("fraction", fraction, np.uint16, offset.shape)
    if image.size >= 1 << 31:
        raise ValueError(f"the image has too many pixels to be addressed: {image.shape}")
    if out is None:
        out = np.empty(offset.shape, np.uint8)
    out = _writable(out, offset.shape, image, offset, fraction)
    taps = scratch("kernels.taps", image.shape, np.uint32)
    pairs = scratch("kernels.pairs", image.shape[1:], np.uint16)
    if not _sample(read_only(image), _flat(offset), _flat(fraction), taps, pairs, out.reshape(-1)):
        raise ValueError(f"an offset lies outside the image of {image.size} pixels: {offset.max()}")
    return out


def blend_indexed(
    bgr: NDArray[np.uint8],
    index: NDArray[np.uint8],
    table_bgr: NDArray[np.uint8],
    alpha: float,
    mask: NDArray[np.uint8] | None = None,
) -> NDArray[np.uint8]:
    """alpha * bgr + (1 - alpha) * table_bgr[index], rounded half up as MATLAB's uint8 (thesis 6.1).

    `bgr` is H x W x 3 uint8, `index` H x W uint8, `table_bgr` 256 x 3 uint8, `alpha` in [0, 1], `mask`
    H x W uint8; where it is zero, `bgr` is kept. Exact for every alpha of at most three decimals; for any
    other a grey level too high only where the true value lies less than 0.0004 below a half. Returns a new
    H x W x 3 uint8 array. Raises `ValueError` for wrong shapes, types or alpha.
    """
    if not 0 <= alpha <= 1:
        raise ValueError(f"expected alpha in [0, 1], got {alpha}")
    bgr = checked("bgr", bgr, np.uint8, (None, None, 3))
    index = checked("index", index, np.uint8, bgr.shape[:2])
    words = np.zeros((256, 4), np.uint8)
    words[:, :3] = checked("table_bgr", table_bgr, np.uint8, (256, 3))
    seen = index if mask is None else checked("mask", mask, np.uint8, bgr.shape[:2])
    out = np.empty(bgr.shape, np.uint8)
    _blend(
        _flat(bgr),
        _flat(index),
        _flat(words.view(np.uint32)),
        _flat(seen),
        _flat(_KEEP if mask is not None else _KEEP[:0]),
        *_digits(alpha),
        scratch("kernels.colours", (_BLENDED * 3 // 4,), np.uint32),
        scratch("kernels.kept", (_BLENDED * 3 // 4,), np.uint32),
        out.reshape(-1),
    )
    return out


def _digits(alpha: float) -> tuple[np.int16, np.int16, np.int16]:
    """`alpha` in units of 2**-21, rounded up, as three digits to the base 128; see `_mix`."""
    units = math.ceil(alpha * (1 << 21))
    return np.int16(units >> 14), np.int16(units >> 7 & 127), np.int16(units & 127)


def checked(name: str, array: NDArray[Any], dtype: DTypeLike, shape: tuple[int | None, ...]) -> NDArray[Any]:
    """`array`, contiguous and aligned, if it has this type and shape (None: any size but 0)."""
    given = array.shape
    fits = len(given) == len(shape) and all(n == m if m else n > 0 for n, m in zip(given, shape, strict=True))
    if array.dtype != dtype or not fits:
        wanted = " x ".join("n" if m is None else str(m) for m in shape)
        raise ValueError(f"{name}: expected {wanted} {np.dtype(dtype)}, got {given} {array.dtype}")
    array = np.ascontiguousarray(array)
    return array if array.flags.aligned else array.copy()


def _writable(out: NDArray[np.uint8], shape: tuple[int, ...], *inputs: NDArray[Any]) -> NDArray[np.uint8]:
    """`out`, if it can be written and overlaps no input: the compiled loops rely on that."""
    if out.shape != shape or out.dtype != np.uint8:
        raise ValueError(f"out: expected {shape} uint8, got {out.shape} {out.dtype}")
    if not (out.flags.c_contiguous and out.flags.writeable):
        raise ValueError("out: expected a contiguous array that may be written")
    if any(np.may_share_memory(out, array) for array in inputs):
        raise ValueError("out: overlaps an input")
    return out


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """A view that may not be written, so that a loop is compiled for one kind of array only."""
    view = array.view(np.ndarray)
    view.flags.writeable = False
    return view


def _flat(array: NDArray[Any]) -> NDArray[Any]:
    """A flat read-only view, so that each loop is compiled for one kind of array only."""
    return read_only(array.reshape(-1))


class _NoAlias(CompilerBase):
    """Numba's compiler, told that the arrays of a call do not overlap.

    LLVM turns look-ups into vector gathers only if it knows that writing the result cannot change
    the table. The functions above keep the promise: they write into arrays of their own, or checked ones.
    """

    def define_pipelines(self) -> list[Any]:
        self.state.flags.noalias = True
        return [DefaultPassBuilder.define_nopython_pipeline(self.state)]


class _MachineCode(FunctionCache):
    """Numba's store of machine code, where a full disk or a damaged file only means to compile again."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # whatever unpickling rubbish may raise: begin anew
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(Exception):
            super().save_overload(sig, data)


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Machine code of a loop over arrays that do not overlap: its callers promise that."""
    loop: Any = numba.njit(function, nogil=True, pipeline_class=_NoAlias)
    with suppress(RuntimeError):  # nowhere to keep machine code: every process compiles for itself
        loop._cache = _MachineCode(function)  # what `cache=True` does, with our store
    return loop


# In the loops below every operation is cast back to its width: Numba widens integers to 64 bits, and
# vectors of those hold a quarter as many. Index arithmetic is unsigned or starts at 0: Numba would
# otherwise test for Python's negative indices, which stops vectorising.


@compiled
def _look_up_counts(counts, first, table, index):
    below = above = 0
    for start in range(0, counts.size, _COUNTED):
        stop = min(start + _COUNTED, counts.size)
        tally = _look_up_block(counts[start:stop], _i32(first), table, index[start:stop])
        below += tally & 0xFFF
        above += tally >> 12
    return below, above


@compiled
def _look_up_block(counts, first, table, index):
    last = _i32(first + _i32(table.size) - 1)
    tally = _u32(0)
    for i in range(counts.size):
        entry = table[_u32(_i32(min(max(_i32(counts[i]), first), last) - first) & 0xFFFF)]
        index[i] = _u8(entry)
        tally = _u32(tally + _u32(entry >> _u32(8)))
    return tally


@compiled
def _sample(image, offset, fraction, taps, pairs, out):
    h, w = image.shape
    flat_taps = taps.reshape(-1)
    gathered = 0
    for start in range(0, out.size, _SAMPLED):
        stop = min(start + _SAMPLED, out.size)
        largest = np.int64(_largest(offset[start:stop]))
        if largest >= image.size:
            return False
        while gathered <= largest // w:  # only as far as needed: the taps are read while in the cache
            _pair_rows(image[gathered], image[min(gathered + 1, h - 1)], pairs)
            _pair_columns(pairs, taps[gathered])
            gathered += 1
        _interpolate(flat_taps, offset[start:stop], fraction[start:stop], out[start:stop])
    return True


@compiled
def _largest(values):
    largest = _u32(0)
    for i in range(values.size):
        largest = max(largest, values[i])
    return largest


@compiled
def _pair_rows(upper, lower, pairs):
    for x in range(pairs.size):
        pairs[x] = _u16(_u16(upper[x]) | _u16(_u16(lower[x]) << _u16(8)))


@compiled
def _pair_columns(pairs, taps):
    """The four taps of a pixel in one word: upper left, lower left, upper right, lower right."""
    last = pairs.size - 1
    for x in range(last):
        taps[x] = _u32(_u32(pairs[x]) | _u32(_u32(pairs[x + 1]) << _u32(16)))
    taps[last] = _u32(_u32(pairs[last]) | _u32(_u32(pairs[last]) << _u32(16)))


@compiled
def _interpolate(taps, offset, fraction, out):
    for i in range(out.size):
        four = taps[_u32(offset[i] & _u32(0x7FFFFFFF))]  # known to fit 31 bits: the faster gather
        fx, fy = _u32(fraction[i] & _u32(255)), _u32(_u32(fraction[i]) >> _u32(8))
        # Down both columns at once, one in each half of the word; differences may wrap, sums wrap back.
        upper, lower = _u32(four & _u32(0xFF00FF)), _u32(_u32(four >> _u32(8)) & _u32(0xFF00FF))
        column = _u32(_u32(upper << _u32(8)) + _u32(_u32(lower - upper) * fy))
        left, right = _u32(column & _u32(0xFFFF)), _u32(column >> _u32(16))
        value = _u32(_u32(left << _u32(8)) + _u32(_u32(right - left) * fx))
        out[i] = _u8(_u32(value + _u32(32768)) >> _u32(16))


@compiled
def _blend(bgr, index, words, mask, keep, high, middle, low, colours, kept, out):
    colour_bytes, kept_bytes = colours.view(np.uint8), kept.view(np.uint8)
    for start in range(0, index.size, _BLENDED):
        stop = min(start + _BLENDED, index.size)
        rgb = bgr[3 * start : 3 * stop]
        _spread(index[start:stop], words, colours)
        if keep.size and _holes(mask[start:stop]):
            _spread(mask[start:stop], keep, kept)
            _replace(colour_bytes, kept_bytes, rgb)
        _mix(rgb, colour_bytes, high, middle, low, out[3 * start : 3 * stop])


@compiled
def _spread(index, words, out):
    """The low three bytes of words[index], one after the other (little-endian, as all our platforms)."""
    last = index.size - 1
    for i in range(index.size // 4):
        j = 4 * i
        a, b, c, d = words[index[j]], words[index[j + 1]], words[index[j + 2]], words[index[j + 3]]
        out[3 * i] = _u32(a | _u32(b << _u32(24)))
        out[3 * i + 1] = _u32(_u32(b >> _u32(8)) | _u32(c << _u32(16)))
        out[3 * i + 2] = _u32(_u32(c >> _u32(16)) | _u32(d << _u32(8)))
    if index.size % 4:
        i = index.size // 4
        a, b, c = words[index[4 * i]], words[index[min(4 * i + 1, last)]], words[index[last]]
        out[3 * i] = _u32(a | _u32(b << _u32(24)))
        out[3 * i + 1] = _u32(_u32(b >> _u32(8)) | _u32(c << _u32(16)))
        out[3 * i + 2] = _u32(c >> _u32(16))


@compiled
def _holes(mask):
    holes = False
    for i in range(mask.size):
        holes |= mask[i] == 0
    return holes


@compiled
def _replace(colour, kept, rgb):
    """RGB in place of colour where thermal was not seen: blended with itself it stays as it is."""
    for i in range(rgb.size):
        colour[i] = _u8(_u8(colour[i] & kept[i]) | _u8(rgb[i] & _u8(~kept[i])))


@compiled
def _mix(rgb, colour, high, middle, low, out):
    """floor(alpha rgb + (1 - alpha) colour + 1/2) in 16-bit integers.

    With n = ceil(2**21 alpha) = high 2**14 + middle 2**7 + low and d = rgb - colour this is
    colour + floor((n d + 2**20 + 2**9) / 2**21), the division done digit by digit (nested floors are exact,
    and no step leaves 16 bits). The error against alpha d + 1/2 lies between 257 and 767 units of
    2**-21, below 1/1000 and never negative: for alpha = p/1000 no value is carried over a whole number.
    """
    for i in range(rgb.size):
        c = _i16(colour[i])
        d = _i16(_i16(rgb[i]) - c)
        t = _i16(_i16(d * low) >> _i16(7))
        t = _i16(_i16(_i16(_i16(d * middle) + t) + _i16(4)) >> _i16(7))
        t = _i16(_i16(_i16(_i16(d * high) + t) + _i16(64)) >> _i16(7))
        out[i] = _u8(_i16(c + t))
