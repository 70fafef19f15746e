"""Where the wanted values of a ROS message lie: a plan made once of its definition, walked a message each.

Between two lengths that only the message knows (of a text or an array), everything has its fixed place, so a
plan is a list of steps: one `struct` for the fixed part with its length at the end, then what is so long. CDR
aligns numbers to their size; therefore a step has one `struct` for each of the eight places it may begin at.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from fusion.errors import FrameError, InputError
from fusion.messages.definitions import DUMMY, NUMBERS, SEQUENCE, TEXTS, Definitions, Field

MAX_TEXT = 1 << 16  # bytes of a name; nothing that is wanted is longer
MAX_ITEMS = 1 << 16  # parts of an array that are read, or passed, one by one
_MAX_STEPS = 1 << 20  # walked in one array
_MAX_ARRAYS = 16  # of messages, in a definition
_MAX_NUMBERS = 1 << 10  # that are read from an array of numbers: coefficients
_MAX_FIXED = 1 << 20  # bytes of a fixed array
_MAX_FIELDS = 4096  # of a definition, those of its parts included
_MAX_DEPTH = 32

Tail = Callable[[memoryview, int, list[Any]], int]
Order = str  # "<" or ">"


class Want(NamedTuple):
    """What is wanted of a field. `kind` is one of

    ``number``; ``integer``; ``numbers`` (a tuple, of an array of either kind); ``text``; ``bytes`` (a view);
    ``items`` (of an array of messages the values of each, in the order of `of`); ``records`` (the same of
    fixed size, as `Records`).
    """

    kind: str
    of: Mapping[str, Want] | None = None


@dataclass(frozen=True, slots=True)
class Records:
    """An array of messages of one size: bytes, `step` from one to the next, each field's offset and type."""

    view: memoryview
    count: int
    step: int
    fields: Mapping[str, tuple[int, np.dtype]]


@dataclass(frozen=True, slots=True)
class _Atom:
    """A run of numbers, or what a `tail` reads; `sized` says that its length comes first."""

    letter: str = ""
    count: int = 0
    size: int = 1  # of one number, and in CDR what it is aligned to
    path: str = ""  # of a wanted value, else ""
    tail: Tail | None = None
    sized: bool = True
    loops: bool = False


@dataclass(frozen=True, slots=True)
class Plan:
    """`paths` names the values that `walk` gives, in their order."""

    steps: tuple[tuple[tuple[struct.Struct, ...], Tail | None], ...]
    paths: tuple[str, ...]
    least: int  # bytes that such a message has at least
    loops: bool  # whether walking takes longer for some messages

    def walk(self, view: memoryview, at: int, values: list[Any]) -> int:
        """Appends the wanted values to `values`, returns where the last one ends.

        Raises `struct.error` where the message ends before, `FrameError` where it claims what cannot be.
        """
        for structs, tail in self.steps:
            fixed = structs[at & 7]
            values += fixed.unpack_from(view, at)
            at += fixed.size
            if tail is not None:
                at = tail(view, at, values)
        return at


def plan_of(
    definitions: Definitions,
    type_name: str,
    wanted: Mapping[str, Want],
    *,
    order: Order = "<",
    cdr: bool = False,
) -> Plan:
    """The plan that reads a `type_name` up to the last wanted value; `wanted` is by dotted path.

    Raises `KeyError` with the path of a wanted field that is not there or of another type, and `InputError`
    where a definition is missing, or something before the last wanted field cannot be passed.
    """
    return _Planner(definitions, order, cdr).plan(type_name, wanted, ())


class _Planner:
    def __init__(self, definitions: Definitions, order: Order, cdr: bool) -> None:
        self.definitions, self.order, self.cdr = definitions, order, cdr
        self.fields = 0

    def plan(self, type_name: str, wanted: Mapping[str, Want], inside: tuple[str, ...]) -> Plan:
        return self.steps(self.atoms(type_name, wanted, inside))

    def atoms(self, type_name: str, wanted: Mapping[str, Want], inside: tuple[str, ...]) -> list[_Atom]:
        atoms: list[_Atom] = []
        missing = dict(wanted)
        self.flatten(type_name, "", missing, inside, atoms)
        if missing:
            raise KeyError(next(iter(missing)))
        return atoms

    # --- from a definition to a list of atoms

    def flatten(
        self,
        type_name: str,
        prefix: str,
        missing: dict[str, Want],
        inside: tuple[str, ...],
        atoms: list[_Atom],
    ) -> None:
        """Appends what lies up to the last wanted field; everything, inside of arrays."""
        in_array = "[]" in inside
        for each in self.fields_of(type_name, inside):
            if not missing and not in_array:
                return
            path = prefix + each.name
            if each.count is None and each.type not in NUMBERS and each.type not in TEXTS:
                self.flatten(each.type, path + ".", missing, (*inside, type_name), atoms)
            else:
                want = missing.pop(path, None)
                atoms.append(self.atom(each, path, want, (*inside, type_name)))

    def fields_of(self, type_name: str, inside: tuple[str, ...]) -> tuple[Field, ...]:
        if type_name in inside or len(inside) > _MAX_DEPTH:
            raise InputError(f"the definition of {type_name} holds itself")
        fields = self.definitions.get(type_name)
        if fields is None:
            raise InputError(f"the definition of {type_name} is missing")
        self.fields += len(fields) + 1
        if self.fields > _MAX_FIELDS:
            raise InputError(f"a definition with more than {_MAX_FIELDS} fields")
        return fields or ((Field(DUMMY, "uint8"),) if self.cdr else ())

    def atom(self, each: Field, path: str, want: Want | None, inside: tuple[str, ...]) -> _Atom:
        if each.type in NUMBERS:
            return self.numbers(each, path, want)
        if each.type == "wstring":
            raise InputError(f"its field {path} is a wstring, whose bytes differ between systems")
        if each.type == "string" and each.count is None:
            _check(path, want, "text")
            return _Atom(path=path if want else "", tail=_text if want else _passing(1, 1))
        if each.type == "string":
            _check(path, want)
            return _array(self.steps([_Atom(tail=_passing(1, 1))]), each, "")
        _check(path, want, "items", "records")
        element = self.atoms(each.type, (want and want.of) or {}, (*inside, "[]"))
        if want and want.kind == "records":
            return self.records(element, each, path)
        plan = self.steps(element)
        if want and want.of is not None and plan.paths != tuple(want.of):
            order = [plan.paths.index(name) for name in want.of]
            return _array(plan, each, path, lambda values: tuple(values[k] for k in order))
        return _array(plan, each, path if want else "")

    def numbers(self, each: Field, path: str, want: Want | None) -> _Atom:
        letter = NUMBERS[each.type]
        size = struct.calcsize("=" + letter)
        kept = path if want else ""
        if each.count is None:
            _check(path, want, "number", *([] if letter in "fd" else ["integer"]))
            return _Atom(letter, 1, size, kept)
        if each.count != SEQUENCE:
            _check(path, want, "numbers")
            if each.count * size > _MAX_FIXED:
                raise InputError(f"its field {path} is an array of {each.count} {each.type}")
            if not want:
                return _Atom(letter, each.count, size)
            # read where it lies, as one value
            align = size if self.cdr and each.count else 1
            return _Atom(
                path=kept, tail=_coefficients(self.order + letter, size, align, each.count), sized=False
            )
        align = size if self.cdr else 1
        if not want:
            return _Atom(tail=_passing(size, align))
        _check(path, want, "numbers", *(["bytes"] if size == 1 else []))
        tail = _bytes if want.kind == "bytes" else _coefficients(self.order + letter, size, align, None)
        return _Atom(path=kept, tail=tail)

    def records(self, atoms: list[_Atom], each: Field, path: str) -> _Atom:
        """An array of messages without a length in them, whose fields therefore lie at fixed distances."""
        if each.count != SEQUENCE or any(atom.tail for atom in atoms):
            raise KeyError(path)
        return _Atom(path=path, tail=_records([self.spread(atoms, r) for r in range(8)]))

    def spread(self, atoms: list[_Atom], r: int) -> _Spread | None:
        """How records lie one after the other if the first may begin at a place that is `r` modulo 8."""
        starts: list[tuple[int, ...]] = []
        at = r
        for _ in range(9):
            places: list[int] = []
            for atom in atoms:
                at += -at % atom.size if self.cdr and atom.count else 0
                places.append(at)
                at += atom.count * atom.size
            starts.append(tuple(places))
        steps = {b - a for one, two in pairwise(starts) for a, b in zip(one, two, strict=True)}
        if len(steps) != 1:
            return None
        first = starts[0][0]
        fields = {
            atom.path: (place - first, np.dtype(self.order + atom.letter))
            for atom, place in zip(atoms, starts[0], strict=True)
            if atom.path
        }
        extent = starts[0][-1] + atoms[-1].count * atoms[-1].size - first
        return _Spread(first - r, steps.pop(), extent, fields)

    # --- from atoms to steps

    def steps(self, atoms: list[_Atom]) -> Plan:
        steps = []
        run: list[_Atom] = []
        for atom in atoms:
            run.append(atom)
            if atom.tail is not None:
                steps.append((self.structs(run), atom.tail))
                run = []
        if run:
            steps.append((self.structs(run), None))
        if sum(atom.loops for atom in atoms) > _MAX_ARRAYS:
            raise InputError(f"a definition with more than {_MAX_ARRAYS} arrays of messages")
        paths = tuple(atom.path for atom in atoms if atom.path)
        least = sum(atom.count * atom.size + (4 if atom.tail and atom.sized else 0) for atom in atoms)
        return Plan(tuple(steps), paths, least, any(atom.loops for atom in atoms))

    def structs(self, run: list[_Atom]) -> tuple[struct.Struct, ...]:
        """One for each place modulo 8; numbers that are not wanted are padding."""
        found = []
        for r in range(8):
            text, at = self.order, r
            for atom in run:
                if atom.tail is not None and not atom.sized:
                    continue
                letter, count, size = ("I", 1, 4) if atom.tail else (atom.letter, atom.count, atom.size)
                pad = -at % size if self.cdr and count else 0
                at += pad + count * size
                keep = atom.tail is not None or atom.path
                text += f"{pad}x" + (f"{count}{letter}" if keep else f"{count * size}x")
            found.append(struct.Struct(text))
        return tuple(found)


def _check(path: str, want: Want | None, *kinds: str) -> None:
    if want is not None and want.kind not in kinds:
        raise KeyError(path)


# --- what follows a length: functions that read it, or pass it


def _inside(view: memoryview, at: int, count: int, size: int) -> int:
    """Where `count` things of `size` bytes end, asked before any of them is touched."""
    end = at + count * size
    if end > len(view):
        raise FrameError(f"it claims {count * size:,} bytes where {max(len(view) - at, 0):,} are left")
    return end


def _text(view: memoryview, at: int, values: list[Any]) -> int:
    length = values[-1]
    end = _inside(view, at, length, 1)
    if length > MAX_TEXT:
        raise FrameError(f"it claims a name of {length:,} bytes")
    values[-1] = str(view[at:end], "utf-8", "replace").rstrip("\0")  # CDR's texts end with one
    return end


def _bytes(view: memoryview, at: int, values: list[Any]) -> int:
    end = _inside(view, at, values[-1], 1)
    values[-1] = view[at:end]
    return end


def _passing(size: int, align: int) -> Tail:
    def tail(view: memoryview, at: int, values: list[Any]) -> int:
        count = values.pop()
        return _inside(view, at + (-at % align if count else 0), count, size)

    return tail


def _coefficients(letter: str, size: int, align: int, fixed: int | None) -> Tail:
    def tail(view: memoryview, at: int, values: list[Any]) -> int:
        count = values.pop() if fixed is None else fixed
        at += -at % align if count else 0
        end = _inside(view, at, count, size)
        if count > _MAX_NUMBERS:
            raise FrameError(f"it claims {count:,} coefficients")
        values.append(struct.unpack_from(f"{letter[0]}{count}{letter[1]}", view, at))
        return end

    return tail


def _array(plan: Plan, each: Field, path: str, ordered: Callable[[list[Any]], tuple] = tuple) -> _Atom:
    """An array of parts that are walked one by one, and kept if it has a `path`."""
    if plan.loops:
        raise InputError(f"its field {each.name} is an array of arrays of messages")
    fixed = None if each.count == SEQUENCE else each.count

    def tail(view: memoryview, at: int, values: list[Any]) -> int:
        count = values.pop() if fixed is None else fixed
        if plan.steps:
            _inside(view, at, count, plan.least)
        if plan.steps and (count > MAX_ITEMS or count * len(plan.steps) > _MAX_STEPS):
            raise FrameError(f"it claims {count:,} {each.name}")
        items = []
        for _ in range(count if plan.steps else 0):
            item: list[Any] = []
            at = plan.walk(view, at, item)
            items.append(ordered(item))
        if path:
            values.append(items)
        return at

    return _Atom(path=path, tail=tail, sized=fixed is None, loops=True)


class _Spread(NamedTuple):
    lead: int
    step: int
    extent: int  # bytes of one record, without the padding before the next
    fields: Mapping[str, tuple[int, np.dtype]]


def _records(spreads: list[_Spread | None]) -> Tail:
    def tail(view: memoryview, at: int, values: list[Any]) -> int:
        spread = spreads[at & 7]
        if spread is None:
            raise FrameError("its points lie at uneven distances")
        count = values[-1]
        start = at + spread.lead if count else at
        end = _inside(view, start, 1, (count - 1) * spread.step + spread.extent if count else 0)
        values[-1] = Records(view[start:end], count, spread.step, spread.fields)
        return end

    return tail
