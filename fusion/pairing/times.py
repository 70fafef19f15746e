"""Pairing by time: mutual nearest neighbours, in exact integer nanoseconds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fusion.errors import InputError, UsageError
from fusion.pairing.rule import Match, Pair, PairingRule, ms
from fusion.timing.match import default_tolerance_ns, nearest

if TYPE_CHECKING:
    from fusion.sources.base import Entry

_Stamps = NDArray[np.object_]

_UNIT_NS = {10: 10**9, 13: 10**6, 16: 10**3, 19: 1}
_STAMP_FORMS = "10, 13, 16 or 19 digits for s, ms, us or ns, or seconds.fraction"


def stamps_of(entries: Sequence[Entry], key: str | None = None) -> list[int | None]:
    """Time stamps in ns: from the container's clock, or, without one or with a `key`, from the names."""
    if key is None and any(e.stamp_ns is not None for e in entries):
        return [e.stamp_ns for e in entries]
    return [stamp_in_name(e.stem, key) for e in entries]


def stamp_in_name(stem: str, key: str | None = None) -> int | None:
    """The time stamp that a name carries, in exact ns; None where it carries none that is certain.

    The last run of 10, 13, 16 or 19 digits is s, ms, us or ns. Ten digits and a fraction (``.`` and 1 to
    9 digits, or ``_`` and 6 or 9, since ``_`` is also written before unpadded numbers) are seconds.
    `key` narrows the search to its match or its one group; two groups are seconds and their fraction.
    """
    if key is None:
        return _read_stamp(stem)
    found = re.search(key, stem)
    if found is None:
        return None
    groups = [g or "" for g in found.groups()]
    if len(groups) == 2:
        digits = all(re.fullmatch("[0-9]{1,10}", g) for g in groups) and len(groups[1]) <= 9
        return int(groups[0]) * 10**9 + int(groups[1].ljust(9, "0")) if digits else None
    return _read_stamp(groups[0] if groups else found[0])


def _read_stamp(text: str) -> int | None:
    decimal = re.search(r"(?<![0-9])([0-9]{10})([._])([0-9]+)[^0-9]*$", text)
    if decimal is not None:
        seconds, mark, fraction = decimal.groups()
        if len(fraction) in ((6, 9) if mark == "_" else range(1, 10)):
            return int(seconds) * 10**9 + int(fraction.ljust(9, "0"))
        if mark == ".":
            return None
    runs = re.findall("[0-9]+", text)
    unit = _UNIT_NS.get(len(runs[-1])) if runs else None
    return None if unit is None else int(runs[-1]) * unit


def by_stamp(rgb: Sequence[Entry], fir: Sequence[Entry], rule: PairingRule) -> Match:
    match = Match()
    a, b = _timeline(rgb, rule.rgb_key, match.rgb, "RGB"), _timeline(fir, rule.fir_key, match.fir, "thermal")
    b = [(t + rule.fir_offset_ns, j) for t, j in b]
    # stamps in names may be longer than 64 bits
    times = np.array([t for t, _ in a], object), np.array([t for t, _ in b], object)
    limit = _default_tolerance(*times) if rule.tolerance_ns is None else rule.tolerance_ns
    match.tolerance_ns = limit
    # A tie goes to the earlier thermal and to the later RGB image: pairs cannot cross, and streams that
    # run exactly half an interval apart still pair.
    to_b, to_a = nearest(*times, later=False).tolist(), nearest(times[1], times[0], later=True).tolist()
    for k, (t, i) in enumerate(a):
        u, j = b[to_b[k]]
        if to_a[to_b[k]] == k and abs(u - t) <= limit:
            match.pairs.append(Pair(i, j, u - t))
    _explain_times(rgb, a, to_b, fir, b, to_a, limit, "thermal", match.rgb)
    _explain_times(fir, b, to_a, rgb, a, to_b, limit, "RGB", match.fir)
    return match


def _explain_times(
    entries: Sequence[Entry],
    line: list[tuple[int, int]],
    nearest: list[int],
    others: Sequence[Entry],
    other_line: list[tuple[int, int]],
    nearest_back: list[int],
    limit: int,
    other_side: str,
    why: dict[int, str],
) -> None:
    for k, (t, i) in enumerate(line):
        u, j = other_line[nearest[k]]
        rival = nearest_back[nearest[k]]
        if abs(u - t) > limit:
            why[i] = _too_far(other_side, abs(u - t), limit)
        elif rival != k:
            nearer = entries[line[rival][1]].where
            why[i] = f"its nearest {other_side} image {others[j].where} is nearer to {nearer}"


def _timeline(
    entries: Sequence[Entry], key: str | None, why: dict[int, str], side: str
) -> list[tuple[int, int]]:
    """(stamp, index) in time order, without entries that have no stamp or share one (noted in `why`)."""
    at: dict[int, list[int]] = {}
    for i, stamp in enumerate(stamps_of(entries, key)):
        if stamp is None:
            why[i] = f"no time stamp in its name ({_STAMP_FORMS})"
        else:
            at.setdefault(stamp, []).append(i)
    if not at:
        what = f"no {side} image has a time stamp, neither a clock nor one in a name like '{entries[0].stem}'"
        hint = f"a stamp is {_STAMP_FORMS}; --rgb-key and --fir-key can point at it"
        raise InputError(what, hint=hint)
    for members in (m for m in at.values() if len(m) > 1):
        for i in members:
            twin = entries[members[1] if i == members[0] else members[0]].where
            why[i] = f"same time stamp as {twin}: ambiguous"
    line = sorted((stamp, members[0]) for stamp, members in at.items() if len(members) == 1)
    if not line:
        raise InputError(
            f"every time stamp of the {side} images occurs more than once", where=entries[0].where
        )
    return line


def _default_tolerance(a: _Stamps, b: _Stamps) -> int:
    tolerance = default_tolerance_ns(a, b)
    if tolerance is None:
        raise UsageError("no tolerance follows from one time stamp each", hint="give --tolerance-ms")
    return tolerance


def _too_far(side: str, gap: int, tolerance: int) -> str:
    digits = 1 if ms(gap) != ms(tolerance) else 6
    return f"nearest {side} is {ms(gap, digits)} away, tolerance {ms(tolerance, digits)}"
