"""PLY (Stanford, 1994): ascii, binary little and big endian. Only the element `vertex` is read."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.clouds.base import RawCloud, add_column, checked_count, column, wrong_count
from fusion.clouds.text import read_lines
from fusion.errors import FrameError

_LONGEST_HEADER = 1 << 20
_TYPES = {
    name: code
    for code, names in {
        "i1": "char int8",
        "u1": "uchar uint8",
        "i2": "short int16",
        "u2": "ushort uint16",
        "i4": "int int32",
        "u4": "uint uint32",
        "i8": "int64",
        "u8": "uint64",
        "f4": "float float32",
        "f8": "double float64",
    }.items()
    for name in names.split()
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True, slots=True)
class _Property:
    name: str
    dtype: np.dtype[Any]
    length: np.dtype[Any] | None = None  # the type of a list's length


@dataclass(frozen=True, slots=True)
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        return any(p.length is not None for p in self.properties)

    @property
    def step(self) -> int:
        return sum(p.dtype.itemsize for p in self.properties)


def read_ply(data: bytes, where: str) -> RawCloud:
    """Any order and types of properties; other elements are passed over and named in `left_out`.

    Raises `FrameError` where the header is wrong, a vertex has a list, or the file has fewer vertices than
    it claims (or more, if nothing comes after them).
    """
    order, elements, start = _header(data, where)
    names = [element.name for element in elements]
    if names.count("vertex") != 1:
        raise FrameError(f"{names.count('vertex')} elements 'vertex' in the PLY header", where=where)
    at = names.index("vertex")
    vertex = elements[at]
    if vertex.has_lists:
        raise FrameError("its vertices have properties that are lists", where=where, hint="save it without")
    if not vertex.properties:
        raise FrameError("its vertices have no properties", where=where)
    checked_count(vertex.count, where)
    last = at == len(elements) - 1
    for element in elements[:at]:
        start = _after(data, start, element, order, where)
    read = _ascii if order == "" else _binary
    columns = read(data, start, vertex, last, where)
    return RawCloud(columns, tuple(name for name in names if name != "vertex"))


def _header(data: bytes, where: str) -> tuple[str, list[_Element], int]:
    end = data.find(b"end_header", 0, _LONGEST_HEADER)
    body = data.find(b"\n", end) + 1 if end >= 0 else 0
    lines = data[: max(end, 0)].decode("latin-1").split("\n")
    if not lines or lines[0].strip() != "ply":
        raise FrameError("no PLY header", where=where)
    order: str | None = None
    elements: list[_Element] = []
    words: list[str] = []
    try:
        for line in lines[1:]:
            words = line.split()
            if words[:1] == ["format"]:
                order = _ORDERS[words[1]]
            elif words and order is None and words[0] in ("element", "property"):
                raise ValueError("the format comes first")
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], _count(words[2])))
            elif words[:1] == ["property"]:
                elements[-1].properties.append(_property(words, order))
    except (KeyError, IndexError, ValueError) as error:
        raise FrameError(
            f"the PLY header is wrong at {' '.join(words)[:60]!r}: {error}", where=where
        ) from None
    if order is None:
        raise FrameError("the PLY header says no format", where=where)
    return order, elements, body or len(data)


def _count(word: str) -> int:
    if not word.isdecimal() or len(word) > 18:
        raise ValueError("no count")
    return int(word)


def _property(words: list[str], order: str | None) -> _Property:
    order = order or ""
    if words[1] == "list":
        length = np.dtype(order + _TYPES[words[2]])
        if length.kind == "f":
            raise ValueError("a length that is no whole number")
        return _Property(words[4], np.dtype(order + _TYPES[words[3]]), length)
    return _Property(words[2], np.dtype(order + _TYPES[words[1]]))


def _after(data: bytes, start: int, element: _Element, order: str, where: str) -> int:
    """The byte behind an element that is not wanted."""
    if order and not element.has_lists:
        return start + element.count * element.step
    if order and not element.properties:
        return start
    for k in range(element.count):
        end = _after_record(data, start, element) if order else data.find(b"\n", start) + 1
        if not start < end <= len(data):
            raise wrong_count(element.count, k, f"{where}, element {element.name}")
        start = end
    return start


def _after_record(data: bytes, start: int, element: _Element) -> int:
    for p in element.properties:
        items = 1
        if p.length is not None:
            word = data[start : start + p.length.itemsize].ljust(p.length.itemsize, b"\0")
            items = int(np.frombuffer(word, p.length)[0])
            if items < 0:
                return -1
            start += p.length.itemsize
        start += items * p.dtype.itemsize
    return start


def _binary(data: bytes, start: int, vertex: _Element, last: bool, where: str) -> dict[str, NDArray[Any]]:
    found = max(len(data) - start, 0) // vertex.step
    if found < vertex.count or (last and found != vertex.count):
        raise wrong_count(vertex.count, found, where)
    columns: dict[str, NDArray[Any]] = {}
    for p in vertex.properties:
        add_column(columns, p.name, column(data, p.dtype, vertex.count, start, vertex.step))
        start += p.dtype.itemsize
    return columns


def _ascii(data: bytes, start: int, vertex: _Element, last: bool, where: str) -> dict[str, NDArray[Any]]:
    dtypes = [p.dtype for p in vertex.properties]
    values = read_lines(data, start, dtypes, where, None if last else vertex.count)
    if len(values[0]) != vertex.count:
        raise wrong_count(vertex.count, len(values[0]), where)
    columns: dict[str, NDArray[Any]] = {}
    for p, array in zip(vertex.properties, values, strict=True):
        add_column(columns, p.name, array)
    return columns
