"""What every reader of point clouds offers, and the one table that names the readers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

from fusion.errors import FrameError

MAX_POINTS = 500_000_000


@dataclass(frozen=True, slots=True)
class RawCloud:
    """What a file holds, before anything is dropped, renamed or judged.

    `columns` has N values for every name that the file gives, of the file's own types (they may be
    read-only views of its bytes, of either byte order). `left_out` names what the file holds beside them
    that is not one number for every point. `viewpoint` is a PCD's pose of the sensor (x y z, qw qx qy qz),
    if it is not the identity.
    """

    columns: Mapping[str, NDArray[Any]]
    left_out: tuple[str, ...] = ()
    viewpoint: tuple[float, ...] | None = None


class CloudReader(Protocol):
    """Reads the bytes of a file, which messages call `where`. Raises `FrameError` where they are wrong."""

    def __call__(self, data: bytes, where: str) -> RawCloud: ...


# Form -> "module:function" of its `CloudReader`. Other packages add forms under the entry points of the group
# "fusion.clouds". Text, so that naming a form imports none.
READERS: dict[str, str] = {
    "pcd": "fusion.clouds.pcd:read_pcd",
    "ply": "fusion.clouds.ply:read_ply",
    "bin": "fusion.clouds.bins:read_bin",
    "kitti": "fusion.clouds.bins:read_kitti",
    "nuscenes": "fusion.clouds.bins:read_nuscenes",
    "las": "fusion.clouds.las:read_las",
    "npy": "fusion.clouds.arrays:read_npy",
    "npz": "fusion.clouds.arrays:read_npz",
}
# Suffix -> form; a suffix that is not here is looked up as a form of its own.
SUFFIXES: dict[str, str] = {
    ".pcd.bin": "nuscenes",
    ".pcd": "pcd",
    ".ply": "ply",
    ".bin": "bin",
    ".las": "las",
    ".laz": "las",
    ".npy": "npy",
    ".npz": "npz",
}


def checked_count(points: int, where: str) -> int:
    """`points`, if so many may be read; asked before memory is taken."""
    if points < 0:
        raise FrameError(f"the header claims {points} points", where=where)
    if points > MAX_POINTS:
        hint = "cut it into tiles, or thin it out first"
        raise FrameError(
            f"{points:,} points are more than the {MAX_POINTS:,} that are read", where=where, hint=hint
        )
    return points


def wrong_count(claimed: int, found: int, where: str) -> FrameError:
    """The header and the file disagree: which points are real cannot be known."""
    hint = "cut off while it was written or copied?" if found < claimed else "written by a tool that lies?"
    return FrameError(f"the header claims {claimed:,} points, the file has {found:,}", where=where, hint=hint)


def column(
    data: bytes | NDArray[np.uint8], dtype: DTypeLike, count: int, offset: int, step: int
) -> NDArray[Any]:
    """A read-only view of `count` values, `step` bytes apart. The caller has checked that they are there."""
    if count == 0:
        return np.empty(0, dtype)
    view: NDArray[Any] = np.ndarray((count,), dtype, buffer=data, offset=offset, strides=(step,))
    view.flags.writeable = False
    return view


def add_column(columns: dict[str, NDArray[Any]], name: str, values: NDArray[Any]) -> None:
    """A name that is borne twice gets a number, so that neither is lost."""
    free, number = name, 2
    while free in columns:
        free, number = f"{name}_{number}", number + 1
    columns[free] = values
