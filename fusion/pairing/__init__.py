"""Which RGB image belongs to which thermal image: pure rules on lists of entries, and their report.

Every entry ends in exactly one place: in one pair, or among the unmatched with the reason in words.
What is ambiguous (one key or time stamp borne twice) is never decided by chance: none of it is paired.
Times are integer nanoseconds throughout; no stamp passes through a float.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from fusion.errors import FusionError, InputError
from fusion.pairing.keys import by_key, by_order
from fusion.pairing.maps import by_map
from fusion.pairing.rule import (
    SIDES,
    By,
    Match,
    Pair,
    Pairing,
    PairingRule,
    PairingSummary,
    Unmatched,
    report_lines,
)
from fusion.pairing.times import by_stamp, stamp_in_name, stamps_of

if TYPE_CHECKING:
    from fusion.sources.base import Entry

__all__ = [
    "Pair",
    "Pairing",
    "PairingRule",
    "PairingSummary",
    "Unmatched",
    "pair",
    "report_lines",
    "stamp_in_name",
    "stamps_of",
]

_FILE_NAME = r"([^/]+)$"

_RUN: dict[str, Callable[[Sequence[Entry], Sequence[Entry], PairingRule], Match]] = {
    "stem": by_key("stem"),
    "index": by_key("index"),
    "stamp": by_stamp,
    "map": by_map,
    "order": by_order,
}


def pair(rgb: Sequence[Entry], fir: Sequence[Entry], rule: PairingRule | None = None) -> Pairing:
    """Pair two lists of entries by `rule` (default: auto), in O(n log n).

    One-to-one. By stamp, pairs are mutual nearest neighbours within the tolerance (inclusive), hence in
    the same order on both sides. Raises `InputError` when nothing can be paired; it says what both
    sides look like and which other rule would match.
    """
    rule = rule or PairingRule()
    for entries, role in ((rgb, "rgb"), (fir, "fir")):
        if not entries:
            raise InputError(f"there are no {SIDES[role]} images to pair")
    by = _choose(rgb, fir, rule)
    match = _RUN[by](rgb, fir, rule)
    if not match.pairs:
        raise _nothing_matches(rgb, fir, by, rule, match)
    notes = _notes(rgb, fir, by, match)
    left = [Unmatched("rgb", rgb[i].where, match.rgb[i]) for i in sorted(match.rgb)]
    left += [Unmatched("fir", fir[j].where, match.fir[j]) for j in sorted(match.fir)]
    pairs = tuple(sorted(match.pairs))
    return Pairing(by, pairs, (*left, *match.from_map), match.tolerance_ns, notes, len(rgb), len(fir))


def _choose(rgb: Sequence[Entry], fir: Sequence[Entry], rule: PairingRule) -> By:
    if rule.by != "auto":
        return rule.by
    if rule.map_file is not None:
        return "map"
    keyed = rule.rgb_key is not None or rule.fir_key is not None
    clocked = all(e.stamp_ns is not None for side in (rgb, fir) for e in side)
    alone = len(rgb) == len(fir) == 1
    if rule.tolerance_ns is not None or (clocked and not keyed and not alone):
        return "stamp"
    return "order" if alone and not keyed else "stem"


def _nothing_matches(
    rgb: Sequence[Entry], fir: Sequence[Entry], by: By, rule: PairingRule, match: Match
) -> InputError:
    looks = [
        ", ".join(f"'{e.stem}'" for e in side[:3]) + (", ..." if len(side) > 3 else "") for side in (rgb, fir)
    ]
    what = f"no pair by {by} among {len(rgb)} RGB ({looks[0]}) and {len(fir)} thermal images ({looks[1]})"
    causes = [*match.rgb.values(), *match.fir.values(), *(u.reason for u in match.from_map)]
    first = f"first reason: {causes[0]}" if causes else ""
    folded = _fold_hint(rgb, fir) if by == "stem" else ""
    wider = _wider_tolerance(rgb, fir, rule) if by == "stamp" else ""
    return InputError(what, hint="; ".join(h for h in (first, folded, wider, *_others(rgb, fir, by)) if h))


def _try(rgb: Sequence[Entry], fir: Sequence[Entry], rule: PairingRule) -> Match:
    try:
        return _RUN[rule.by](rgb, fir, rule)
    except FusionError:
        return Match()


def _others(rgb: Sequence[Entry], fir: Sequence[Entry], by: By, more_than: int = 0) -> list[str]:
    """The other rules that would match, with how many."""
    n = min(len(rgb), len(fir))
    rules = {
        f"--pair {other}": PairingRule(by=other)
        for other in ("stem", "index", "stamp", "order")
        if other != by
    }
    rules[f"--rgb-key '{_FILE_NAME}' and the same --fir-key"] = PairingRule("stem", _FILE_NAME, _FILE_NAME)
    counts = {name: len(_try(rgb, fir, rule).pairs) for name, rule in rules.items()}
    return [f"{name} would match {k} of {n}" for name, k in counts.items() if k > more_than]


def _fold(entry: Entry) -> str:
    return unicodedata.normalize("NFC", entry.stem).casefold()


def _fold_hint(rgb: Sequence[Entry], fir: Sequence[Entry]) -> str:
    n = len({_fold(e) for e in rgb} & {_fold(e) for e in fir})
    return f"{n} names would match but for upper and lower case or Unicode form" if n else ""


def _wider_tolerance(rgb: Sequence[Entry], fir: Sequence[Entry], rule: PairingRule) -> str:
    sides = stamps_of(rgb, rule.rgb_key), stamps_of(fir, rule.fir_key)
    a, b = ([t for t in side if t is not None] for side in sides)
    apart = max(min(a), min(b)) - min(max(a), max(b))
    if apart > 0 and min(len(a), len(b)) > 1:
        return f"the two sides do not overlap in time, they are {apart / 1e9:.3f} s apart: is it one clock?"
    pairs = _try(rgb, fir, replace(rule, by="stamp", tolerance_ns=2**63)).pairs
    need = max((abs(p.dt_ns or 0) for p in pairs), default=0)
    return f"--tolerance-ms {need / 1e6:.6f} would match {len(pairs)}" if pairs else ""


def _notes(rgb: Sequence[Entry], fir: Sequence[Entry], by: By, match: Match) -> tuple[str, ...]:
    notes = []
    stems: dict[str, list[str]] = {}
    for p in match.pairs:
        stems.setdefault(rgb[p.rgb].stem.casefold(), []).append(rgb[p.rgb].stem)
    twins = [names for names in stems.values() if len(names) > 1]
    if twins:
        example = " and ".join(f"'{name}'" for name in twins[0][:2])
        notes.append(
            f"{sum(map(len, twins))} RGB names differ only in upper and lower case, such as {example}: "
            "their outputs would collide on a disk that ignores case"
        )
    if by in ("stem", "index") and 2 * len(match.pairs) < min(len(rgb), len(fir)):
        notes += [f"few matched: {other}" for other in _others(rgb, fir, by, more_than=len(match.pairs))]
    return tuple(notes)
