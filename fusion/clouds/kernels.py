"""The loop that neither NumPy nor OpenCV has: LZF, byte by byte."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion.errors import FrameError
from fusion.kernels import compiled, read_only

MOST_EXPANSION = 88  # three bytes of LZF stand for at most 264
_ENDS, _PAST_CLAIM, _BEFORE_START = -1, -2, -3
_WHY = {
    _ENDS: "the block ends in the middle of a run",
    _PAST_CLAIM: "the block expands past the size it claims",
    _BEFORE_START: "the block refers to bytes before its start",
}


def decompress_lzf(block: bytes | memoryview, size: int, where: str) -> NDArray[np.uint8]:
    """The `size` bytes that an LZF block (Lehmann's liblzf, as in PCD files) stands for.

    Raises `FrameError` where it is damaged, or expands to more or fewer bytes; never writes out of bounds,
    and takes no memory for a size that the block cannot reach.
    """
    if size > MOST_EXPANSION * len(block):
        what = f"a compressed block of {len(block):,} bytes cannot hold the {size:,} it claims"
        raise FrameError(what, where=where, hint="cut off while it was written or copied?")
    out = np.empty(size, np.uint8)
    if size == 0 and len(block) == 0:
        return out
    found = int(_expand(read_only(np.frombuffer(block, np.uint8)), out))
    if found != size:
        why = _WHY.get(found, f"the block expands to {found:,} bytes and claims {size:,}")
        raise FrameError(f"the compressed points are damaged: {why}", where=where, hint="copy it again")
    return out


@compiled
def _expand(block, out):
    """How many bytes were written, or one of the reasons above."""
    i = o = 0
    end, room = block.size, out.size
    while i < end:
        control = np.int64(block[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > end:
                return _ENDS
            if o + length > room:
                return _PAST_CLAIM
            for k in range(length):
                out[o + k] = block[i + k]
            i += length
        else:
            length = control >> 5
            if length == 7:
                if i >= end:
                    return _ENDS
                length += np.int64(block[i])
                i += 1
            if i >= end:
                return _ENDS
            start = o - ((control & 31) << 8) - np.int64(block[i]) - 1
            i += 1
            length += 2
            if start < 0:
                return _BEFORE_START
            if o + length > room:
                return _PAST_CLAIM
            for k in range(length):  # in this order: a run may repeat what it has just written
                out[o + k] = out[start + k]
        o += length
    return o
