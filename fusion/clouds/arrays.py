"""NumPy's own files: NPY and NPZ. Nothing is ever unpickled."""

from __future__ import annotations

import io
import math
import zipfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.clouds.base import RawCloud, add_column, checked_count, wrong_count
from fusion.errors import FrameError

_NAMES = ("x", "y", "z", "intensity", "ring")
_POINTS = ("xyz_m", "xyz", "points", "arr_0")
_MOST_COLUMNS = 16


def read_npy(data: bytes, where: str) -> RawCloud:
    """N x 3 to N x 16 numbers (x y z, then intensity, ring, `column_5` …), or N records with named fields.

    An organised array (H x W x k) is read row by row. Raises `FrameError` for objects, other shapes, or a
    header that claims more or fewer numbers than there are.
    """
    columns: dict[str, NDArray[Any]] = {}
    left_out: list[str] = []
    _add_array(columns, left_out, _array(data, where), where)
    return RawCloud(columns, tuple(left_out))


def read_npz(data: bytes, where: str) -> RawCloud:
    """Points under `xyz_m`, `xyz`, `points` or `arr_0` (as in an NPY), or x, y, z one by one; other keys
    are fields.

    Keys that hold something else than one number for every point are named in `left_out`. Raises
    `FrameError` where the archive is damaged or has no points.
    """
    members = _members(data, where)
    columns: dict[str, NDArray[Any]] = {}
    left_out: list[str] = []
    key = next((key for key in _POINTS if key in members), None)
    if key is not None:
        _add_array(columns, left_out, members.pop(key), where)
    elif not {"x", "y", "z"} <= {name.lower() for name in members}:
        hint = "np.savez(..., xyz=points), or x=, y=, z="
        raise FrameError(f"no points under its keys {', '.join(members)[:200]}", where=where, hint=hint)
    sizes = [len(a) for a in columns.values()] or [a.size for n, a in members.items() if n.lower() == "x"]
    for name, values in members.items():
        if values.shape == tuple(sizes[:1]) and values.dtype.kind in "iufb":
            _add(columns, name, values)
        else:
            left_out.append(name)
    return RawCloud(columns, tuple(left_out))


def _members(data: bytes, where: str) -> dict[str, NDArray[Any]]:
    found = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            for info in archive.infolist():
                if info.filename.endswith(".npy"):
                    found[info.filename[:-4]] = _member(archive, info, where)
    except FrameError:
        raise
    except Exception as error:  # a damaged archive raises whatever the layer that stumbles over it raises
        raise FrameError(f"the archive is damaged: {error or type(error).__name__}", where=where) from None
    return found


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, where: str) -> NDArray[Any]:
    where = f"{where}, {info.filename}"
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # others expand without bounds
        raise FrameError("it is compressed in a way that NumPy does not write", where=where)
    with archive.open(info) as stream:
        _layout(stream.read(1 << 16), where, info.file_size)  # the sizes must agree before all is unpacked
    return _array(archive.read(info), where)


def _array(data: bytes, where: str) -> NDArray[Any]:
    shape, fortran, dtype, start = _layout(data, where, len(data))
    values: NDArray[Any] = (
        np.frombuffer(data, dtype, math.prod(shape), start) if math.prod(shape) else np.empty(0, dtype)
    )
    return values.reshape(shape, order="F" if fortran else "C")


def _layout(data: bytes, where: str, size: int) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """Shape, order, type and begin of an NPY of `size` bytes that begins with `data`."""
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        read = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, fortran, dtype = read(stream)
    except Exception as error:  # it is parsed as a Python literal, and may stumble in many ways
        raise FrameError(f"no NPY header: {str(error)[:100]}", where=where) from None
    if dtype.itemsize == 0:
        raise FrameError(f"its numbers have no size: {dtype}", where=where)
    if dtype.hasobject:
        raise FrameError(
            "it holds Python objects, which are never unpickled", where=where, hint="save numbers"
        )
    count = checked_count(math.prod(shape[:1]), where) if min(shape, default=1) >= 0 else -1
    claimed, found = math.prod(shape) * dtype.itemsize, size - stream.tell()
    if count < 0 or claimed != found:
        per_row = max(math.prod(shape[1:]) * dtype.itemsize, 1)
        raise wrong_count(count, found // per_row, where)
    return shape, fortran, dtype, stream.tell()


def _add_array(
    columns: dict[str, NDArray[Any]], left_out: list[str], array: NDArray[Any], where: str
) -> None:
    if array.dtype.names is not None:
        for name in array.dtype.names:
            _add_field(columns, left_out, name, array[name].reshape(-1, *array.dtype[name].shape))
        return
    if array.ndim < 2 or not 3 <= array.shape[-1] <= _MOST_COLUMNS or array.dtype.kind not in "iuf":
        hint = (
            "3 x N is written N x 3: save points.T" if array.ndim == 2 and array.shape[0] in (3, 4, 5) else ""
        )
        what = (
            f"expected N x 3 to N x {_MOST_COLUMNS} numbers, or named fields, not {array.shape} {array.dtype}"
        )
        raise FrameError(what, where=where, hint=hint)
    rows = array.reshape(-1, array.shape[-1])
    checked_count(len(rows), where)
    for k in range(rows.shape[1]):
        add_column(columns, _NAMES[k] if k < len(_NAMES) else f"column_{k}", rows[:, k])


def _add_field(
    columns: dict[str, NDArray[Any]], left_out: list[str], name: str, values: NDArray[Any]
) -> None:
    if (
        values.dtype.kind not in "iufb"
        or values.ndim > 2
        or (values.ndim == 2 and values.shape[1] > _MOST_COLUMNS)
    ):
        left_out.append(name)
    elif values.ndim == 1:
        _add(columns, name, values)
    else:
        split = name in _POINTS or name == "position"
        for k in range(values.shape[1]):
            _add(columns, "xyz"[k] if split and k < 3 else f"{name}_{k}", values[:, k])


def _add(columns: dict[str, NDArray[Any]], name: str, values: NDArray[Any]) -> None:
    add_column(columns, name, values.view(np.uint8) if values.dtype.kind == "b" else values)
