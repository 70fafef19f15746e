"""Points written as text, one a line (PCD ascii, PLY ascii)."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.errors import FrameError


def read_lines(
    data: bytes, start: int, dtypes: Sequence[np.dtype[Any]], where: str, most: int | None = None
) -> list[NDArray[Any]]:
    """The columns of the lines from byte `start` on, one of each type; blank lines are nothing.

    Reads no more than `most` lines, if given. Raises `FrameError` for a line with another number of values,
    a word that is no number, or a whole number that its type cannot hold.
    """
    if most == 0 or re.compile(rb"\S").search(data, start) is None:
        return [np.empty(0, dtype) for dtype in dtypes]
    # 64-bit integers would lose digits in float64; all others fit, and writers put 12.0 where 12 is meant.
    wide = [dtype if dtype.kind in "iu" and dtype.itemsize == 8 else np.dtype("f8") for dtype in dtypes]
    parsed = np.dtype([(f"c{k}", dtype) for k, dtype in enumerate(wide)])
    stream = io.BytesIO(data)  # shares the bytes
    stream.seek(start)
    try:
        table = np.loadtxt(stream, parsed, comments=None, ndmin=1, max_rows=most, encoding="ascii")
    except (ValueError, OverflowError, Warning) as error:
        why = str(error).split(";")[0]
        raise FrameError(f"a line of its points cannot be read: {why}", where=where) from None
    return [_cast(table[f"c{k}"], dtype, where) for k, dtype in enumerate(dtypes)]


def _cast(values: NDArray[Any], dtype: np.dtype[Any], where: str) -> NDArray[Any]:
    if dtype.kind in "iu" and values.dtype.kind == "f" and values.size:
        limits = np.iinfo(dtype)
        low, high = values.min(), values.max()
        if not (limits.min <= low and high <= limits.max):
            raise FrameError(f"values from {low:g} to {high:g} do not fit the type {dtype}", where=where)
    with np.errstate(over="ignore"):  # 1e300 as float32 is inf, and dropped as such
        return values.astype(dtype)
