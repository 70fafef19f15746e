"""PCD, the Point Cloud Library's format, version 0.7 and before: ascii, binary and binary_compressed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.clouds.base import RawCloud, add_column, checked_count, column, wrong_count
from fusion.clouds.text import read_lines
from fusion.errors import FrameError

_LONGEST_HEADER = 1 << 20
_KINDS = {"F": (2, 4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_STANDS_STILL = (0, 0, 0, 1, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class _Field:
    name: str
    dtype: np.dtype[Any]
    count: int

    @property
    def size(self) -> int:
        return self.dtype.itemsize * self.count

    def parts(self) -> list[str]:
        return [self.name] if self.count == 1 else [f"{self.name}_{k}" for k in range(self.count)]


@dataclass(frozen=True, slots=True)
class _Header:
    fields: tuple[_Field, ...]
    points: int
    data: str
    start: int
    viewpoint: tuple[float, ...] | None

    @property
    def step(self) -> int:
        return sum(field.size for field in self.fields)


def read_pcd(data: bytes, where: str) -> RawCloud:
    """Any types, sizes and counts; a field of k values becomes `name_0` … `name_<k-1>`; padding (`_`) is
    left out.

    An organised cloud is read row by row. Points stay as they are stored: VIEWPOINT says where the sensor
    stood, and is handed on, not applied. Raises `FrameError` where the header is no PCD header, POINTS is
    not WIDTH x HEIGHT, the file has fewer or more points than it claims, or a compressed block is damaged.
    """
    header = _header(data, where)
    if header.data == "ascii":
        columns = _ascii(data, header, where)
    elif header.data == "binary":
        columns = _binary(data, header, where)
    else:
        columns = _compressed(data, header, where)
    return RawCloud(columns, viewpoint=header.viewpoint)


def _header(data: bytes, where: str) -> _Header:
    said: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in said:
        end = data.find(b"\n", start, _LONGEST_HEADER)
        line = data[start : end if end >= 0 else _LONGEST_HEADER]
        words = line.decode("latin-1").split()
        if words and not words[0].startswith("#"):
            said.setdefault(words[0].upper(), words[1:])
        start = end + 1
        if end < 0:
            break
    if not said.get("DATA"):
        raise FrameError("no PCD header: it has no line DATA", where=where)
    try:
        points, fields = _points(said, where), _fields(said)
        viewpoint = tuple(float(word) for word in said.get("VIEWPOINT", _STANDS_STILL))
    except ValueError as error:
        raise FrameError(f"the PCD header is wrong: {error}", where=where) from None
    kind = said["DATA"][0].lower()
    if kind not in ("ascii", "binary", "binary_compressed"):
        hint = "ascii, binary or binary_compressed"
        raise FrameError(f"PCD data of the unknown kind {kind[:40]!r}", where=where, hint=hint)
    return _Header(
        fields, points, kind, start or len(data), None if viewpoint == _STANDS_STILL else viewpoint
    )


def _points(said: dict[str, list[str]], where: str) -> int:
    numbers = {key: _whole(key, said[key]) for key in ("WIDTH", "HEIGHT", "POINTS") if key in said}
    area = numbers["WIDTH"] * numbers.get("HEIGHT", 1) if "WIDTH" in numbers else None
    points = numbers.get("POINTS", area)
    if points is None:
        raise ValueError("it says neither POINTS nor WIDTH")
    if area is not None and points != area:
        raise ValueError(
            f"POINTS {points} is not WIDTH {numbers['WIDTH']} x HEIGHT {numbers.get('HEIGHT', 1)}"
        )
    return checked_count(points, where)


def _whole(key: str, words: list[str]) -> int:
    if len(words) != 1 or not words[0].isdecimal() or len(words[0]) > 18:
        raise ValueError(f"{key} {' '.join(words)[:40]!r} is no count")
    return int(words[0])


def _fields(said: dict[str, list[str]]) -> tuple[_Field, ...]:
    names = said.get("FIELDS") or said.get("COLUMNS") or []
    if not names:
        raise ValueError("it names no FIELDS")
    lists = {
        key: said.get(key, [default] * len(names))
        for key, default in (("TYPE", "F"), ("SIZE", "4"), ("COUNT", "1"))
    }
    for key, words in lists.items():
        if len(words) != len(names):
            raise ValueError(f"{len(names)} FIELDS, but {len(words)} words in {key}")
    fields = []
    for name, kind, size, count in zip(names, *lists.values(), strict=True):
        if _whole("SIZE", [size]) not in _KINDS.get(kind.upper(), ()):
            raise ValueError(f"field {name!r} has TYPE {kind} SIZE {size}: there is no such number")
        fields.append(_Field(name, np.dtype(f"<{kind.lower()}{int(size)}"), _whole("COUNT", [count])))
    if sum(field.count for field in fields) > 1 << 16:
        raise ValueError("a point of more than 65,536 values")
    return tuple(fields)


def _binary(data: bytes, header: _Header, where: str) -> dict[str, NDArray[Any]]:
    found = (len(data) - header.start) // max(header.step, 1)
    if found != header.points:  # what is left over of less than a point is a line's end, or padding
        raise wrong_count(header.points, found, where)
    columns: dict[str, NDArray[Any]] = {}
    offset = header.start
    for field in header.fields:
        _add(columns, field, data, header.points, offset, header.step)
        offset += field.size
    return columns


def _compressed(data: bytes, header: _Header, where: str) -> dict[str, NDArray[Any]]:
    from fusion.clouds.kernels import (
        decompress_lzf,
    )  # it takes time to import, and most files have no need of it

    sizes = np.frombuffer(data[header.start : header.start + 8].ljust(8, b"\0"), "<u4")
    packed, size, begin = int(sizes[0]), int(sizes[1]), header.start + 8
    if size != header.points * header.step:
        raise wrong_count(header.points, math.floor(size / max(header.step, 1)), where)
    if packed > max(len(data) - begin, 0):
        what = f"the compressed points claim {packed:,} bytes, the file has {max(len(data) - begin, 0):,}"
        raise FrameError(what, where=where, hint="cut off while it was written or copied?")
    buffer = decompress_lzf(memoryview(data)[begin : begin + packed], size, where)
    columns: dict[str, NDArray[Any]] = {}
    offset = 0
    for field in header.fields:  # all values of the first field, then all of the next
        _add(columns, field, buffer, header.points, offset, field.size)
        offset += field.size * header.points
    return columns


def _add(
    columns: dict[str, NDArray[Any]],
    field: _Field,
    data: bytes | NDArray[np.uint8],
    points: int,
    offset: int,
    step: int,
) -> None:
    if field.name != "_":
        for k, name in enumerate(field.parts()):
            at = offset + k * field.dtype.itemsize
            add_column(columns, name, column(data, field.dtype, points, at, step))


def _ascii(data: bytes, header: _Header, where: str) -> dict[str, NDArray[Any]]:
    named = [(name, field.dtype) for field in header.fields for name in field.parts()]
    padding = {name for field in header.fields if field.name == "_" for name in field.parts()}
    values = read_lines(data, header.start, [dtype for _, dtype in named], where)
    if len(values[0]) != header.points:
        raise wrong_count(header.points, len(values[0]), where)
    columns: dict[str, NDArray[Any]] = {}
    for (name, _), array in zip(named, values, strict=True):
        if name not in padding:
            add_column(columns, name, array)
    return columns
