"""Point clouds from files: PCD, PLY, KITTI and nuScenes `.bin`, LAS and LAZ, NPY and NPZ."""

from __future__ import annotations

import pkgutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fusion.clouds.base import READERS, SUFFIXES, CloudReader, RawCloud
from fusion.clouds.filters import crop_box, crop_range, statistical_outliers, voxel
from fusion.clouds.find import CloudFiles, clouds_in, stem_of
from fusion.clouds.pcd_write import pcd_bytes, write_pcd
from fusion.clouds.tidy import cloud_of
from fusion.errors import FrameError, UsageError
from fusion.frames import PointCloud
from fusion.tables import lookup

__all__ = [
    "READERS",
    "SUFFIXES",
    "CloudFiles",
    "CloudReader",
    "RawCloud",
    "clouds_in",
    "crop_box",
    "crop_range",
    "pcd_bytes",
    "read_cloud",
    "read_raw",
    "statistical_outliers",
    "voxel",
    "write_pcd",
]


def read_cloud(path: str | Path, form: str | None = None, stem: str | None = None) -> PointCloud:
    """Read one cloud: its valid points, in the file's frame, metres.

    `form` (a row of `READERS`) forces a reader; else the suffix decides. `stem` is the cloud's name, by
    default the file's without its suffix.

    `xyz_m` is float32 where the file's own numbers fit into it, else float64. Points that are NaN or
    infinite, or exactly (0, 0, 0), are dropped and counted under ``nan`` and ``zero``; `read` is how many
    the file has. A cloud of which nothing is left is empty, and no error here.

    Fields are ``intensity`` (the file's type and scale), ``ring`` (int32, as the file numbers its lasers;
    ``ring_as_stored`` where they are no whole numbers from 0 to 65535), ``time_s`` (float64 seconds since
    the earliest point of the file, the dropped ones not counted) and all others under the file's own names
    and types. Where the file's times count from 1970, `stamp_ns` is the earliest; else the stamp in the
    file's name, if it is a certain one. How units are told apart: `fusion.clouds.tidy.seconds`. A field
    ``time_s`` is taken as it is.

    Memory: the file and what it unpacks to, and about the same again for the cloud; more than 500 million
    points are refused. Raises `FrameError` where the file cannot be read or used, `UsageError` for an
    unknown form.
    """
    from fusion.pairing.times import stamp_in_name

    path = Path(path)
    stem = stem_of(path.name) if stem is None else stem
    raw = read_raw(path, form)
    with _enough_memory(path):
        return cloud_of(raw, str(path), stem, stamp_in_name(stem))


def read_raw(path: str | Path, form: str | None = None) -> RawCloud:
    """All that the file says, nothing dropped or renamed; parameters and errors as `read_cloud`."""
    path = Path(path)
    reader = _reader(path, form)
    with _enough_memory(path):
        try:
            data = path.read_bytes()
        except OSError as error:
            raise FrameError(f"cannot be read: {error.strerror or error}", where=path) from error
        return reader(data, str(path))


@contextmanager
def _enough_memory(path: Path) -> Iterator[None]:
    try:
        yield
    except MemoryError:
        raise FrameError("there is not enough memory for it", where=path, hint="cut it into tiles") from None


def _reader(path: Path, form: str | None) -> CloudReader:
    name = path.name.lower()
    suffix = next((suffix for suffix in SUFFIXES if name.endswith(suffix)), None)
    chosen = form or (SUFFIXES[suffix] if suffix else path.suffix.lower()[1:] or "none")
    try:
        found: Any = lookup(READERS, "fusion.clouds", chosen, "form of point cloud")
    except UsageError as error:
        raise UsageError(error.what, where=path, hint=error.hint) from None
    return pkgutil.resolve_name(found) if isinstance(found, str) else found
