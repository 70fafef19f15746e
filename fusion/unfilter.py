"""PNG's row filters, undone: the loop that inflating leaves to do."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion.kernels import checked, compiled, read_only

_i32, _u8 = np.int32, np.uint8


def unfilter(filtered: NDArray[np.uint8], pixel_bytes: int) -> NDArray[np.uint8]:
    """Undo PNG's row filters (PNG specification, section 9): H x n uint8 from H x (1 + n).

    The first byte of a row says its filter, 0 to 4; `pixel_bytes` is how far back "left" is. Raises
    `ValueError` for a `filtered` of another shape.
    """
    filtered = checked("filtered", filtered, np.uint8, (None, None))
    out = np.empty((filtered.shape[0], filtered.shape[1] - 1), np.uint8)
    if pixel_bytes < 1 or out.shape[1] % pixel_bytes or out.size == 0:
        raise ValueError(f"rows of {out.shape[1]} bytes are no pixels of {pixel_bytes}")
    _unfilter(read_only(filtered), pixel_bytes, out)
    return out


@compiled
def _unfilter(filtered, back, out):
    above = np.zeros(out.shape[1], np.uint8)
    for y in range(out.shape[0]):
        kind, row, line = filtered[y, 0], filtered[y, 1:], out[y]
        if kind == 0:
            line[:] = row
        elif kind == 1 and back == 1:
            _add_left_of_one(row, line)
        elif kind == 1 and back == 2:
            _add_left_of_two(row, line)
        elif kind == 1 and back == 3:
            _add_left_of_three(row, line)
        elif kind == 1:
            _add_left(row, back, line)
        elif kind == 2:
            _add_above(row, above, line)
        else:
            _add_predicted(row, above, back, kind == 4, line)
        above = line


@compiled
def _add_left(row, back, line):
    line[:back] = row[:back]
    for i in range(back, row.size):
        line[i] = _u8(row[i] + line[i - back])


# The usual pixels keep their running sums in registers. Each has a function: together they are slower.


@compiled
def _add_left_of_one(row, line):
    a = _u8(0)
    for i in range(row.size):
        a = _u8(a + row[i])
        line[i] = a


@compiled
def _add_left_of_two(row, line):
    a = b = _u8(0)
    for i in range(0, row.size, 2):
        a, b = _u8(a + row[i]), _u8(b + row[i + 1])
        line[i], line[i + 1] = a, b


@compiled
def _add_left_of_three(row, line):
    a = b = c = _u8(0)
    for i in range(0, row.size, 3):
        a, b, c = _u8(a + row[i]), _u8(b + row[i + 1]), _u8(c + row[i + 2])
        line[i], line[i + 1], line[i + 2] = a, b, c


@compiled
def _add_above(row, above, line):
    for i in range(row.size):
        line[i] = _u8(row[i] + above[i])


@compiled
def _add_predicted(row, above, back, paeth, line):
    """Filters 3 (the mean of left and above) and 4 (Paeth's choice of left, above and above left)."""
    for i in range(row.size):
        left = _i32(line[i - back]) if i >= back else _i32(0)
        up = _i32(above[i])
        if paeth:
            corner = _i32(above[i - back]) if i >= back else _i32(0)
            from_left, from_up, from_corner = (
                abs(up - corner),
                abs(left - corner),
                abs(left + up - 2 * corner),
            )
            nearest = up if from_up <= from_corner else corner
            guess = left if from_left <= from_up and from_left <= from_corner else nearest
        else:
            guess = (left + up) >> 1
        line[i] = _u8(row[i] + guess)
