"""YAML and JSON as trees of text, lists and mappings: nothing is executed, nothing is guessed.

Numbers stay text until a key asks for them, so that every digit is read by Python's `float`, whatever a
dialect takes for a number. Tags (but OpenCV's of a matrix), anchors, aliases, keys that return and deep
nesting are refused.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fusion.errors import UsageError
from fusion.geometry import Floats

Tree = str | list[Any] | dict[str, Any]
_DEEPEST = 16
_MATRIX_TAG = "tag:yaml.org,2002:opencv-matrix"
_NOT_FINITE = {".nan", ".inf", "+.inf", "-.inf"}


@dataclass(frozen=True, slots=True)
class Node:
    """A place in a tree: `key` is the way there (``cam0.intrinsics``), `path` the file. Errors name both."""

    value: Tree
    path: Path
    key: str = ""

    def error(self, what: str, hint: str = "") -> UsageError:
        return UsageError(f"{self.key or 'the file'} {what}", where=self.path, hint=hint)

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys of a mapping; none of anything else."""
        return tuple(self.value) if isinstance(self.value, dict) else ()

    def __contains__(self, key: str) -> bool:
        return key in self.keys

    def __getitem__(self, key: str) -> Node:
        """What stands below `key`. `UsageError` that lists the keys there are."""
        way = f"{self.key}.{key}" if self.key else key
        if not isinstance(self.value, dict):
            raise self.error("is no table of keys", f"it needs {key}")
        if key not in self.value:
            hint = f"it has {', '.join(self.value) or 'nothing'}"
            raise UsageError(f"{way} is missing", where=self.path, hint=hint[:300])
        return Node(self.value[key], self.path, way)

    def text(self) -> str:
        """A word. `UsageError` for a list or a table."""
        if not isinstance(self.value, str):
            raise self.error("must be one word")
        return self.value

    def numbers(self, *counts: int) -> Floats:
        """The numbers of a list, of rows of them, or of a table's ``data``, in reading order.

        Raises `UsageError` if they are not finite numbers, or not one of `counts` many.
        """
        inner = self["data"] if isinstance(self.value, dict) else self
        return finite_numbers(_words(inner.value), self.key, self.path, counts)

    def matrix(self, *shapes: tuple[int, int]) -> Floats:
        """A matrix of one of `shapes`: rows of numbers, or a table of rows, cols and data."""
        values = self.numbers(*sorted({r * c for r, c in shapes}))
        said = self._shape(values.size)
        shape = next((s for s in shapes if s == said or (said is None and s[0] * s[1] == values.size)), None)
        if shape is None:
            wanted = " or ".join(f"{r}x{c}" for r, c in shapes)
            raise self.error(f"is no matrix of {wanted}", f"it has {said}")
        return values.reshape(shape)

    def whole(self) -> int:
        """A whole number. `UsageError` for anything else."""
        (number,) = self.numbers(1).tolist()
        if not number.is_integer():
            raise self.error(f"must be a whole number, not {number:g}")
        return int(number)

    def _shape(self, size: int) -> tuple[int, int] | None:
        """What the file says of rows and columns; None where it does not (a flat list)."""
        if isinstance(self.value, dict):
            if "rows" not in self.value or "cols" not in self.value:
                return None
            return self["rows"].whole(), self["cols"].whole()
        if isinstance(self.value, list) and self.value and isinstance(self.value[0], list):
            return len(self.value), size // len(self.value)
        return None


def finite_numbers(words: Sequence[str], key: str, path: Path, counts: Sequence[int]) -> Floats:
    """`words` as float64. `UsageError` if one is no finite number, or they are not one of `counts` many."""
    if any(word.lower() in _NOT_FINITE for word in words):
        raise UsageError(f"{key} holds a number that is not finite", where=path)
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise UsageError(f"{key} holds something that is no number", where=path) from None
    if not all(map(math.isfinite, values)):
        raise UsageError(f"{key} holds a number that is not finite", where=path)
    if counts and len(values) not in counts:
        hint = f"it needs {' or '.join(map(str, counts))}"
        raise UsageError(f"{key} has {len(values)} numbers", where=path, hint=hint)
    return np.array(values, np.float64)


def _words(value: Tree) -> list[str]:
    if isinstance(value, list):
        return [word for part in value for word in _words(part)]
    return [value] if isinstance(value, str) else [""]


def parse_json(text: str, path: Path) -> Node:
    """The tree of a JSON text. `UsageError` for broken ones, NaN, and keys that return."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            twice = next(k for i, (k, _) in enumerate(pairs) if k in dict(pairs[:i]))
            raise UsageError(f"{twice} stands twice", where=path)
        return found

    try:
        value = json.loads(text, parse_float=str, parse_int=str, parse_constant=str, object_pairs_hook=unique)
        return Node(_plain(value, path, 0), path)
    except RecursionError:
        raise UsageError("nested too deeply for a calibration", where=path) from None
    except ValueError as error:
        raise UsageError(f"no JSON: {error}", where=path) from None


def _plain(value: Any, path: Path, depth: int) -> Tree:
    """A JSON value with nothing in it but text, lists and mappings."""
    if depth > _DEEPEST:
        raise UsageError("nested too deeply for a calibration", where=path)
    if isinstance(value, list):
        return [_plain(part, path, depth + 1) for part in value]
    if isinstance(value, dict):
        return {key: _plain(part, path, depth + 1) for key, part in value.items()}
    return value if isinstance(value, str) else str(value).lower()  # true, false, none


def parse_yaml(text: str, path: Path) -> Node:
    """The tree of a YAML text's first document; OpenCV's header ``%YAML:1.0`` is known.

    `UsageError` for broken ones, and for tags, anchors, aliases, keys that return, and a second document.
    """
    import yaml

    loader = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
    text = re.sub(r"\A%YAML:\S*", "", text)
    try:
        return Node(_Builder(yaml.parse(text, Loader=loader), path).document(), path)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f"line {mark.line + 1}: " if mark is not None else ""
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise UsageError(f"no YAML: {line}{problem}", where=path) from None


class _Builder:
    """Builds the tree from a parser's events; PyYAML's own would follow tags and aliases."""

    def __init__(self, events: Iterator[Any], path: Path) -> None:
        self._events, self._path = events, path

    def document(self) -> Tree:
        names = ("StreamStartEvent", "DocumentStartEvent")
        first = next(e for e in self._events if type(e).__name__ not in names)
        if type(first).__name__ == "StreamEndEvent":
            raise UsageError("the calibration is empty", where=self._path)
        tree = self._tree(first, 0)
        for event in self._events:
            name = type(event).__name__
            if name.startswith(("Scalar", "Sequence", "Mapping", "Alias")) and getattr(event, "value", "x"):
                raise self._refuse("a second document", event)
        return tree

    def _refuse(self, what: str, event: Any) -> UsageError:
        line = event.start_mark.line + 1
        return UsageError(f"{what} (line {line}): refused in a calibration", where=self._path)

    def _tree(self, event: Any, depth: int) -> Tree:
        name = type(event).__name__
        if name == "AliasEvent" or event.anchor is not None:
            raise self._refuse("a YAML anchor or alias", event)
        if event.tag not in (None, "!", _MATRIX_TAG):
            raise self._refuse(f"the YAML tag {event.tag}", event)
        if depth > _DEEPEST:
            raise self._refuse("nesting this deep", event)
        if name == "ScalarEvent":
            return str(event.value)
        if name == "SequenceStartEvent":
            return [self._tree(e, depth + 1) for e in self._until("SequenceEndEvent")]
        return self._mapping(depth)

    def _until(self, end: str) -> Iterator[Any]:
        for event in self._events:
            if type(event).__name__ == end:
                return
            yield event

    def _mapping(self, depth: int) -> dict[str, Tree]:
        found: dict[str, Tree] = {}
        for event in self._until("MappingEndEvent"):
            key = self._tree(event, depth + 1)
            if not isinstance(key, str):
                raise self._refuse("a key that is no word", event)
            if key in found:
                raise UsageError(f"{key} stands twice (line {event.start_mark.line + 1})", where=self._path)
            found[key] = self._tree(next(self._events), depth + 1)
        return found


def flow(values: Any) -> str:
    """Numbers as YAML and JSON write a list: to the last digit, and floats to every reader of YAML 1.1."""
    return f"[{', '.join(number(x) for x in np.ravel(values))}]"


def number(x: float) -> str:
    """A float to the last digit; ``1e-05`` as ``1.0e-05``, for YAML 1.1 takes the former for text."""
    text = repr(float(x))
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def table(name: str, matrix: Floats, tag: str = "", indent: str = "  ", extra: Mapping[str, str] = {}) -> str:
    """A matrix as ROS and OpenCV write it: rows, cols, data."""
    rows, cols = matrix.shape
    lines = [f"{name}:{tag}", f"{indent}rows: {rows}", f"{indent}cols: {cols}"]
    lines += [f"{indent}{key}: {value}" for key, value in extra.items()]
    return "\n".join([*lines, f"{indent}data: {flow(matrix)}", ""])
