"""Which RGB image belongs to which thermal image: pure rules on lists of entries, and their report.

Every entry ends in exactly one place: in one pair, or among the unmatched with the reason in words.
What is ambiguous (one key or time stamp borne twice) is never decided by chance: none of it is paired.
Times are integer nanoseconds throughout; no stamp passes through a float.
"""

from __future__ import annotations

import csv
import io
import json
import re
import statistics
import unicodedata
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from fusion.errors import FusionError, InputError, UsageError

if TYPE_CHECKING:
    from fusion.sources.base import Entry

By = Literal["auto", "stem", "index", "stamp", "map", "order"]
Key = tuple[str | None, ...]

_RULES = ("auto", "stem", "index", "stamp", "map", "order")
_SIDES = {"rgb": "RGB", "fir": "thermal"}
_UNIT_NS = {10: 10**9, 13: 10**6, 16: 10**3, 19: 1}
_FILE_NAME = r"([^/]+)$"
_STAMP_FORMS = "10, 13, 16 or 19 digits for s, ms, us or ns, or seconds.fraction"
_MAP_BYTES = 64 * 2**20


@dataclass(frozen=True, slots=True)
class PairingRule:
    """How to pair. Raises `UsageError` when made from parts that cannot work together.

    `rgb_key` and `fir_key` are regular expressions searched in an entry's stem; the key is the tuple
    of their groups, or the whole match where they have none. Without them the key is the stem (`stem`),
    the last number in it (`index`) or the time stamp in it (`stamp`, where the source has no clock).
    `tolerance_ns` belongs to `stamp`; None takes half the median interval of the denser stream.
    `map_file` is a CSV with the header ``rgb,fir`` or a JSON object of RGB name to thermal name.
    `auto`: the map if one is given; time if both sides have a clock or a tolerance is given; order if
    there is one image each; else stem.
    """

    by: By = "auto"
    rgb_key: str | None = None
    fir_key: str | None = None
    tolerance_ns: int | None = None
    map_file: str | None = None

    def __post_init__(self) -> None:
        if self.by not in _RULES:
            raise UsageError(f"no pairing rule '{self.by}'", hint=f"one of {', '.join(_RULES)}")
        n_groups = [_n_groups(self.rgb_key, "rgb_key"), _n_groups(self.fir_key, "fir_key")]
        keyed = self.rgb_key is not None or self.fir_key is not None
        if keyed and (self.by in ("map", "order") or self.map_file is not None):
            raise UsageError("keys have no effect on pairing by map or order", hint="leave them out")
        if keyed and self.by != "stamp" and max(n_groups[0], 1) != max(n_groups[1], 1):
            what = f"rgb_key has {n_groups[0]} groups and fir_key {n_groups[1]}: such keys are never equal"
            raise UsageError(what, hint="give both the same number of groups")
        if (self.map_file is not None) != (self.by == "map") and self.by != "auto":
            what = (
                "pairing by map needs a mapping file (--pair-map)"
                if self.by == "map"
                else "a mapping file needs rule map"
            )
            raise UsageError(what)
        if self.tolerance_ns is not None and self.tolerance_ns < 0:
            raise UsageError(f"tolerance {self.tolerance_ns} ns is negative", hint="zero or more")
        if self.tolerance_ns is not None and (self.by not in ("auto", "stamp") or self.map_file is not None):
            raise UsageError("a tolerance has an effect on pairing by stamp only", hint="leave it out")


class Pair(NamedTuple):
    """Indices into the two entry lists; `dt_ns` is thermal minus RGB stamp, None without clocks."""

    rgb: int
    fir: int
    dt_ns: int | None


class Unmatched(NamedTuple):
    """What was left over: `role` is ``rgb``, ``fir``, or ``map`` for a line of the mapping file."""

    role: Literal["rgb", "fir", "map"]
    where: str
    reason: str


@dataclass(frozen=True, slots=True)
class PairingSummary:
    """Counts, and time differences (thermal minus RGB) in milliseconds: signed median, largest absolute."""

    rule_by: By | Literal["channels"]
    n_rgb: int
    n_fir: int
    n_pairs: int
    n_unmatched_rgb: int
    n_unmatched_fir: int
    n_unmatched_map: int
    tolerance_ms: float | None
    dt_median_ms: float | None
    dt_max_ms: float | None


@dataclass(frozen=True, slots=True)
class Pairing:
    """Pairs in RGB order, what is left over with reasons, and remarks. `rule_by` is never ``auto``."""

    rule_by: By | Literal["channels"]
    pairs: tuple[Pair, ...]
    unmatched: tuple[Unmatched, ...]
    tolerance_ns: int | None
    notes: tuple[str, ...]
    n_rgb: int
    n_fir: int

    @classmethod
    def of_channels(cls, count: int) -> Pairing:
        """`count` files that each hold their own RGB and thermal channels: nothing to look for."""
        return cls("channels", tuple(Pair(k, k, None) for k in range(count)), (), None, (), count, count)

    def summary(self) -> PairingSummary:
        dts = [p.dt_ns for p in self.pairs if p.dt_ns is not None]
        roles = Counter(u.role for u in self.unmatched)
        return PairingSummary(
            self.rule_by,
            self.n_rgb,
            self.n_fir,
            len(self.pairs),
            roles["rgb"],
            roles["fir"],
            roles["map"],
            None if self.tolerance_ns is None else self.tolerance_ns / 1e6,
            statistics.median(dts) / 1e6 if dts else None,
            max(map(abs, dts)) / 1e6 if dts else None,
        )


@dataclass(slots=True)
class _Match:
    """A rule's raw result: pairs, and for each other index of either side the reason."""

    pairs: list[Pair] = field(default_factory=list)
    rgb: dict[int, str] = field(default_factory=dict)
    fir: dict[int, str] = field(default_factory=dict)
    from_map: list[Unmatched] = field(default_factory=list)
    tolerance_ns: int | None = None


def pair(rgb: Sequence[Entry], fir: Sequence[Entry], rule: PairingRule | None = None) -> Pairing:
    """Pair two lists of entries by `rule` (default: auto), in O(n log n).

    One-to-one. By stamp, pairs are mutual nearest neighbours within the tolerance (inclusive), hence in
    the same order on both sides. Raises `InputError` when nothing can be paired; it says what both
    sides look like and which other rule would match.
    """
    rule = rule or PairingRule()
    for entries, role in ((rgb, "rgb"), (fir, "fir")):
        if not entries:
            raise InputError(f"there are no {_SIDES[role]} images to pair")
    by = _choose(rgb, fir, rule)
    match = _RUN[by](rgb, fir, rule)
    if not match.pairs:
        raise _nothing_matches(rgb, fir, by, rule, match)
    notes = _notes(rgb, fir, by, match)
    left = [Unmatched("rgb", rgb[i].where, match.rgb[i]) for i in sorted(match.rgb)]
    left += [Unmatched("fir", fir[j].where, match.fir[j]) for j in sorted(match.fir)]
    pairs = tuple(sorted(match.pairs))
    return Pairing(by, pairs, (*left, *match.from_map), match.tolerance_ns, notes, len(rgb), len(fir))


def report_lines(pairing: Pairing, limit: int = 20) -> list[str]:
    """The pairing report: what matched, time differences, the first `limit` unmatched, remarks."""
    s = pairing.summary()
    lines = [f"{s.n_pairs} pairs by {s.rule_by} of {s.n_rgb} RGB and {s.n_fir} thermal images"]
    if s.dt_median_ms is not None:
        bound = "" if pairing.tolerance_ns is None else f", tolerance {_ms(pairing.tolerance_ns)}"
        lines.append(
            f"thermal minus RGB: median {s.dt_median_ms:+.1f} ms, at most {s.dt_max_ms:.1f} ms{bound}"
        )
    lines += [f"note: {note}" for note in pairing.notes]
    if pairing.unmatched:
        from_map = f", {s.n_unmatched_map} lines of the mapping file" if s.n_unmatched_map else ""
        lines.append(f"unmatched: {s.n_unmatched_rgb} RGB, {s.n_unmatched_fir} thermal{from_map}")
    lines += [f"  {_SIDES.get(u.role, u.role)} {u.where}: {u.reason}" for u in pairing.unmatched[:limit]]
    if len(pairing.unmatched) > limit:
        lines.append(f"  and {len(pairing.unmatched) - limit} more")
    return lines


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


def _n_groups(pattern: str | None, name: str) -> int:
    try:
        return 0 if pattern is None else re.compile(pattern).groups
    except (re.error, RecursionError, OverflowError) as error:
        raise UsageError(f"{name} '{pattern}' is no regular expression: {error}") from None


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


# --- keys: stem and index -------------------------------------------------------------------------


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


def _by_key(by: By) -> Callable[[Sequence[Entry], Sequence[Entry], PairingRule], _Match]:
    def run(rgb: Sequence[Entry], fir: Sequence[Entry], rule: PairingRule) -> _Match:
        match = _Match()
        left = _group(rgb, by, rule.rgb_key, match.rgb)
        right = _group(fir, by, rule.fir_key, match.fir)
        for key, ours in left.items():
            theirs = right.get(key, [])
            if len(ours) == len(theirs) == 1:
                match.pairs.append(_clocked(rgb, fir, ours[0], theirs[0]))
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


def _clocked(rgb: Sequence[Entry], fir: Sequence[Entry], i: int, j: int) -> Pair:
    a, b = rgb[i].stamp_ns, fir[j].stamp_ns
    return Pair(i, j, None if a is None or b is None else b - a)


def _by_order(rgb: Sequence[Entry], fir: Sequence[Entry], rule: PairingRule) -> _Match:  # noqa: ARG001
    if len(rgb) != len(fir):
        what = f"pairing by order needs equal counts, found {len(rgb)} RGB and {len(fir)} thermal images"
        raise InputError(what, hint="remove what is extra, or pair by stem, index, stamp or map")
    return _Match([_clocked(rgb, fir, i, i) for i in range(len(rgb))])


# --- time -----------------------------------------------------------------------------------------


def _by_stamp(rgb: Sequence[Entry], fir: Sequence[Entry], rule: PairingRule) -> _Match:
    match = _Match()
    a, b = _timeline(rgb, rule.rgb_key, match.rgb, "RGB"), _timeline(fir, rule.fir_key, match.fir, "thermal")
    times = [t for t, _ in a], [t for t, _ in b]
    limit = _default_tolerance(*times) if rule.tolerance_ns is None else rule.tolerance_ns
    match.tolerance_ns = limit
    # A tie goes to the earlier thermal and to the later RGB image: pairs cannot cross, and streams that
    # run exactly half an interval apart still pair.
    to_b, to_a = _nearest(*times, later=False), _nearest(times[1], times[0], later=True)
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


def _nearest(times: list[int], others: list[int], *, later: bool) -> list[int]:
    """For each of `times` the index of the nearest of `others` (both ascending, no value twice)."""
    nearest = []
    for t in times:
        k = bisect_left(others, t)
        before = others[k - 1] if k else None
        after = others[k] if k < len(others) else None
        gap = 0 if before is None or after is None else (after - t) - (t - before)
        nearest.append(
            k if before is None or (after is not None and (gap < 0 or (gap == 0 and later))) else k - 1
        )
    return nearest


def _default_tolerance(a: list[int], b: list[int]) -> int:
    """Half the median interval of the denser stream, in whole ns."""
    steps = [[t - s for s, t in pairwise(times)] for times in (a, b) if len(times) > 1]
    if not steps:
        raise UsageError("no tolerance follows from one time stamp each", hint="give --tolerance-ms")
    return min(statistics.median_low(d) + statistics.median_high(d) for d in steps) // 4


def _ms(ns: int, digits: int = 1) -> str:
    return f"{ns / 1e6:.{digits}f} ms"


def _too_far(side: str, gap: int, tolerance: int) -> str:
    digits = 1 if _ms(gap) != _ms(tolerance) else 6
    return f"nearest {side} is {_ms(gap, digits)} away, tolerance {_ms(tolerance, digits)}"


# --- mapping file ---------------------------------------------------------------------------------


def _by_map(rgb: Sequence[Entry], fir: Sequence[Entry], rule: PairingRule) -> _Match:
    match, path = _Match(), Path(rule.map_file or "")
    names = _Names.of(rgb), _Names.of(fir)
    edges: list[tuple[str, int, int]] = []
    for line, rgb_name, fir_name in read_map(path):
        i, j = names[0].find(rgb_name), names[1].find(fir_name)
        if i >= 0 and j >= 0:
            edges.append((line, i, j))
            continue
        said = {-1: "there is no {} image '{}'", -2: "more than one {} image is called '{}'"}
        reason = "; ".join(
            said[k].format(side, name)
            for k, side, name in ((i, "RGB", rgb_name), (j, "thermal", fir_name))
            if k < 0
        )
        match.from_map.append(Unmatched("map", f"{path} {line}", reason))
    uses = Counter(i for _, i, _ in edges), Counter(j for _, _, j in edges)
    for line, i, j in edges:
        if uses[0][i] == uses[1][j] == 1:
            match.pairs.append(_clocked(rgb, fir, i, j))
        else:
            twice = rgb[i].where if uses[0][i] > 1 else fir[j].where
            match.from_map.append(
                Unmatched("map", f"{path} {line}", f"{twice} is named more than once: ambiguous")
            )
    said = (
        "no line of the mapping file pairs it",
        "the mapping file names it or its partner more than once: ambiguous",
    )
    paired = {p.rgb for p in match.pairs}, {p.fir for p in match.pairs}
    match.rgb = {k: said[uses[0][k] > 0] for k in range(len(rgb)) if k not in paired[0]}
    match.fir = {k: said[uses[1][k] > 0] for k in range(len(fir)) if k not in paired[1]}
    return match


def read_map(path: Path) -> list[tuple[str, str, str]]:
    """Rows (line or entry, RGB name, thermal name) of a mapping file. Raises `InputError`."""
    try:
        if not path.is_file():
            raise InputError(
                "no such mapping file", where=path, hint="a CSV with the header rgb,fir or a JSON object"
            )
        if path.stat().st_size > _MAP_BYTES:
            raise InputError("mapping file is over 64 MB", where=path)
        text = path.read_text(encoding="utf-8-sig")
        rows = _json_rows(text) if path.suffix.lower() == ".json" else _csv_rows(text)
    except (OSError, ValueError, RecursionError, csv.Error) as error:
        hint = "a CSV with the header rgb,fir or a JSON object of RGB name to thermal name, in UTF-8"
        raise InputError(f"cannot read the mapping file: {error}", where=path, hint=hint) from None
    if not rows:
        raise InputError("the mapping file has no rows", where=path)
    return rows


def _csv_rows(text: str) -> list[tuple[str, str, str]]:
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    header = [cell.strip().lower() for cell in next(reader, [])]
    if header.count("rgb") != 1 or header.count("fir") != 1:
        raise ValueError(f"its first line is '{','.join(header)[:80]}'")
    a, b, rows = header.index("rgb"), header.index("fir"), []
    for cells in reader:
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header) or not cells[a].strip() or not cells[b].strip():
            raise ValueError(f"line {reader.line_num} does not have one name in each column")
        rows.append((f"line {reader.line_num}", cells[a].strip(), cells[b].strip()))
    return rows


def _json_rows(text: str) -> list[tuple[str, str, str]]:
    table = json.loads(text, object_pairs_hook=tuple)
    if not isinstance(table, tuple) or not all(isinstance(fir, str) for _, fir in table):
        raise ValueError("expected one JSON object of RGB name to thermal name")
    return [(f"entry {k}", rgb, fir) for k, (rgb, fir) in enumerate(table, 1)]


@dataclass(slots=True)
class _Names:
    """Index of an entry by its stem, and by every shorter ending of its path; -2 where it is not one."""

    exact: dict[str, int] = field(default_factory=dict)
    endings: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, entries: Sequence[Entry]) -> _Names:
        names = cls()
        for i, entry in enumerate(entries):
            parts = entry.stem.split("/")
            names.exact[entry.stem] = -2 if entry.stem in names.exact else i
            for ending in ("/".join(parts[k:]) for k in range(1, len(parts))):
                names.endings[ending] = -2 if ending in names.endings else i
        return names

    def find(self, name: str) -> int:
        """The entry that a map's name means, given with more or fewer folders; -1 none, -2 more than one."""
        parts = [p for p in name.replace("\\", "/").split("/") if p not in ("", ".")]
        tails = ["/".join(parts[k:]) for k in range(len(parts))]
        spelt = [spelling for tail in tails for spelling in (tail, re.sub(r"\.[^./]*$", "", tail))]
        shorter = [(self.endings, spelling) for spelling in spelt[:2]]
        tables = [(self.exact, spelling) for spelling in spelt[:2]] + shorter
        tables += [(self.exact, spelling) for spelling in spelt[2:]]
        return next((table[spelling] for table, spelling in tables if spelling in table), -1)


_RUN: dict[str, Callable[[Sequence[Entry], Sequence[Entry], PairingRule], _Match]] = {
    "stem": _by_key("stem"),
    "index": _by_key("index"),
    "stamp": _by_stamp,
    "map": _by_map,
    "order": _by_order,
}


# --- what to say ----------------------------------------------------------------------------------


def _nothing_matches(
    rgb: Sequence[Entry], fir: Sequence[Entry], by: By, rule: PairingRule, match: _Match
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


def _try(rgb: Sequence[Entry], fir: Sequence[Entry], rule: PairingRule) -> _Match:
    try:
        return _RUN[rule.by](rgb, fir, rule)
    except FusionError:
        return _Match()


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


def _notes(rgb: Sequence[Entry], fir: Sequence[Entry], by: By, match: _Match) -> tuple[str, ...]:
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
