"""Clouds out, as binary PCD 0.7: the same cloud always gives the same bytes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.files import replace_file
from fusion.frames import PointCloud

_FIRST = ("intensity", "ring", "time_s")


def write_pcd(path: str | Path, cloud: PointCloud) -> None:
    """Write `cloud` to `path`, whole or not at all; see `pcd_bytes`. Raises `OutputError`, `ValueError`."""
    replace_file(Path(path), pcd_bytes(cloud))


def pcd_bytes(cloud: PointCloud) -> bytes:
    """A binary PCD with x y z (the cloud's float type), intensity, ring, time_s, then the other fields by
    name.

    Numbers keep their types, bool becomes one byte, ring 16 bits where they suffice. `read_cloud` gives the
    same cloud back, but for `stamp_ns`, which PCD has no place for: put it into the file's name. Raises
    `ValueError` for a field that PCD cannot name or number.
    """
    names = [name for name in _FIRST if name in cloud.fields]
    names += sorted(name for name in cloud.fields if name not in _FIRST)
    columns = {name: _writable(name, cloud.fields[name]) for name in names}
    xyz = np.dtype((cloud.xyz_m.dtype.newbyteorder("<"), (3,)))
    records = np.dtype([("xyz", xyz), *((name, values.dtype) for name, values in columns.items())])
    head = _header(records, len(cloud))
    out = bytearray(len(head) + len(cloud) * records.itemsize)
    out[: len(head)] = head
    rows = np.frombuffer(out, records, len(cloud), len(head))
    rows["xyz"] = cloud.xyz_m
    for name, values in columns.items():
        rows[name] = values
    return bytes(out)


def _writable(name: str, values: NDArray[Any]) -> NDArray[Any]:
    fits = values.dtype.kind in "iub" or (values.dtype.kind == "f" and values.dtype.itemsize in (4, 8))
    if (
        not fits
        or name == "_"
        or name in ("x", "y", "z", "xyz")
        or len(name.split()) != 1
        or not name.isascii()
    ):
        raise ValueError(
            f"expected a field of numbers with a name of one word, got {name!r} of {values.dtype}"
        )
    if values.dtype.kind == "b":
        return values.view(np.uint8)
    if (
        name == "ring"
        and values.dtype.kind == "i"
        and values.size
        and values.min() >= 0
        and values.max() < 1 << 16
    ):
        return values.astype("<u2")
    return values.astype(values.dtype.newbyteorder("<"), copy=False)


def _header(records: np.dtype[Any], points: int) -> bytes:
    columns = [(axis, records["xyz"].base) for axis in "xyz"]
    columns += [(name, records[name]) for name in records.names or () if name != "xyz"]
    lines = (
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(name for name, _ in columns)}",
        f"SIZE {' '.join(str(dtype.itemsize) for _, dtype in columns)}",
        f"TYPE {' '.join(dtype.kind.upper() for _, dtype in columns)}",
        f"COUNT {' '.join('1' for _ in columns)}",
        f"WIDTH {points}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {points}",
        "DATA binary",
    )
    return ("\n".join(lines) + "\n").encode("ascii")
