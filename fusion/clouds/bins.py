"""Bare little-endian float32 records: KITTI's `.bin` (x y z intensity), nuScenes' `.pcd.bin` (… ring)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.clouds.base import RawCloud, checked_count
from fusion.errors import FrameError

_LOOKED_AT = 65_536  # points that decide whether a file has a fifth column
_MOST_RINGS = 256


def read_kitti(data: bytes, where: str) -> RawCloud:
    """x, y, z in metres and intensity, 16 bytes a point. Raises `FrameError` for any other size."""
    return _columns(data, ("x", "y", "z", "intensity"), where)


def read_nuscenes(data: bytes, where: str) -> RawCloud:
    """x, y, z in metres, intensity and ring, 20 bytes a point. Raises `FrameError` for any other size."""
    return _columns(data, ("x", "y", "z", "intensity", "ring"), where)


def read_bin(data: bytes, where: str) -> RawCloud:
    """Whichever of the two it is: nuScenes if its size allows, and a fifth column would be whole numbers 0
    to 255.

    In a file of four columns that one would be made of coordinates. Raises `FrameError` where neither form
    fits.
    """
    if len(data) % 20 == 0:
        fifth = np.frombuffer(data, "<f4", min(len(data) // 4, 5 * _LOOKED_AT))[4::5]
        if _is_ring(fifth) or _is_ring(fifth.byteswap()):  # swapped bytes are refused later, by name
            return read_nuscenes(data, where)
    if len(data) % 16 == 0:
        return read_kitti(data, where)
    hint = "cut off, or of another form: nuscenes and others can be forced"
    if len(data) % 20 == 0:
        raise FrameError(
            "it has the size of five float32 a point, but the fifth is no ring", where=where, hint=hint
        )
    what = f"{len(data):,} bytes are no whole number of points of four or five float32"
    raise FrameError(what, where=where, hint=hint)


def _is_ring(values: NDArray[Any]) -> bool:
    with np.errstate(invalid="ignore"):
        return bool(((values >= 0) & (values < _MOST_RINGS) & (values == np.floor(values))).all())


def _columns(data: bytes, names: tuple[str, ...], where: str) -> RawCloud:
    size = 4 * len(names)
    if len(data) % size:
        what = f"{len(data):,} bytes are no whole number of points of {len(names)} float32 ({size} bytes)"
        raise FrameError(
            what, where=where, hint="cut off while it was written or copied, or of another form?"
        )
    checked_count(len(data) // size, where)
    rows = np.frombuffer(data, "<f4").reshape(-1, len(names))
    return RawCloud({name: rows[:, k] for k, name in enumerate(names)})
