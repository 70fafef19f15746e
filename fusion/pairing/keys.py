"""Pairing by what names have in common, and by order."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from fusion.errors import InputError
from fusion.pairing.rule import By, Match, Pair, PairingRule

if TYPE_CHECKING:
    from fusion.sources.base import Entry

Key = tuple[str | None, ...]


def _key_of(stem: str, by: By, pattern: str | None) -> Key | None:
    """The entry's key; numbers lose leading zeros and stay text, so no digit count is too large."""
    if pattern is None and by == "stem":
        return (stem,)
    found = re.search(r"([0-9]+)[^0-9]*$" if pattern is None else pattern, stem)
    if found is None:
        return None
    key = found.groups() or (found[0],)
    if by != "index":
        return key
    return tuple((g.lstrip("0") or "0") if g and re.fullmatch("[0-9]+", g) else g for g in key)


def _group(
    entries: Sequence[Entry], by: By, pattern: str | None, why: dict[int, str]
) -> dict[Key, list[int]]:
    groups: dict[Key, list[int]] = {}
    for i, entry in enumerate(entries):
        key = _key_of(entry.stem, by, pattern)
        if key is None:
            why[i] = "no number in its name" if pattern is None else f"its name does not match '{pattern}'"
        else:
            groups.setdefault(key, []).append(i)
    return groups


def by_key(by: By) -> Callable[[Sequence[Entry], Sequence[Entry], PairingRule], Match]:
    def run(rgb: Sequence[Entry], fir: Sequence[Entry], rule: PairingRule) -> Match:
        match = Match()
        left = _group(rgb, by, rule.rgb_key, match.rgb)
        right = _group(fir, by, rule.fir_key, match.fir)
        for key, ours in left.items():
            theirs = right.get(key, [])
            if len(ours) == len(theirs) == 1:
                match.pairs.append(clocked(rgb, fir, ours[0], theirs[0]))
        taken = {p.rgb for p in match.pairs}, {p.fir for p in match.pairs}
        _explain(rgb, left, fir, right, taken[0], "thermal", match.rgb)
        _explain(fir, right, rgb, left, taken[1], "RGB", match.fir)
        return match

    return run


def _explain(
    entries: Sequence[Entry],
    groups: dict[Key, list[int]],
    others: Sequence[Entry],
    other_groups: dict[Key, list[int]],
    taken: set[int],
    other_side: str,
    why: dict[int, str],
) -> None:
    """Write into `why` the reason for each grouped entry that is not taken."""
    for key, members in groups.items():
        text = "/".join(g or "" for g in key)
        theirs = other_groups.get(key, [])
        for i in (m for m in members if m not in taken):
            if len(members) > 1:
                twin = entries[members[1] if i == members[0] else members[0]].where
                why[i] = f"same key '{text}' as {twin}: ambiguous"
            elif theirs:
                first, second = others[theirs[0]].where, others[theirs[1]].where
                why[i] = f"its key '{text}' belongs to {len(theirs)} {other_side} images ({first}, {second})"
            else:
                why[i] = f"no {other_side} image with key '{text}'"


def clocked(rgb: Sequence[Entry], fir: Sequence[Entry], i: int, j: int) -> Pair:
    a, b = rgb[i].stamp_ns, fir[j].stamp_ns
    return Pair(i, j, None if a is None or b is None else b - a)


def by_order(rgb: Sequence[Entry], fir: Sequence[Entry], rule: PairingRule) -> Match:  # noqa: ARG001
    if len(rgb) != len(fir):
        what = f"pairing by order needs equal counts, found {len(rgb)} RGB and {len(fir)} thermal images"
        raise InputError(what, hint="remove what is extra, or pair by stem, index, stamp or map")
    return Match([clocked(rgb, fir, i, i) for i in range(len(rgb))])
