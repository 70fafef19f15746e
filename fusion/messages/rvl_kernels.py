"""RVL, a run-length code of depth images (Wilson, Fast Lossless Depth Image Compression, 2017), compiled."""

from __future__ import annotations

import numpy as np

from fusion.kernels import compiled

_MOST_BITS = 30  # of a number: three a nibble; a size or a difference needs no more


@compiled
def _number(nibbles, at, last):
    """One number, three bits a nibble, least first, as long as the fourth is set. -1 where the code ends."""
    value, shift = np.int64(0), 0
    while at < last and shift < _MOST_BITS:
        # 32-bit words, least byte first, are read from the top
        word = np.int64(nibbles[(at >> 3) * 4 + 3 - ((at & 7) >> 1)])
        nibble = (word >> 4) if at & 1 == 0 else (word & 15)
        at += 1
        value |= (nibble & 7) << shift
        if nibble < 8:
            return value, at
        shift += 3
    return np.int64(-1), at


@compiled
def decode_rvl(nibbles, out):
    """Fills `out` (flat uint16) from `nibbles` (flat uint8); returns how many pixels it gave, -1 if it lies.

    A code is: how many zeros, how many others, then the difference of each to the one before, zigzag.
    """
    at, last = 0, nibbles.size // 4 * 8
    done, previous = 0, np.int64(0)
    while done < out.size:
        zeros, at = _number(nibbles, at, last)
        others, at = _number(nibbles, at, last)
        if zeros < 0 or others < 0:
            return done
        if zeros + others > out.size - done or zeros + others == 0:
            return -1
        for _ in range(zeros):
            out[done] = 0
            done += 1
        for _ in range(others):
            code, at = _number(nibbles, at, last)
            if code < 0:
                return done
            previous = (previous + ((code >> 1) ^ -(code & 1))) & 0xFFFF
            out[done] = previous
            done += 1
    return done
