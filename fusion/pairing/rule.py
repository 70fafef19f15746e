"""What a pairing rule is, what it yields, and how that is reported."""

from __future__ import annotations

import re
import statistics
from collections import Counter
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from fusion.errors import UsageError

By = Literal["auto", "stem", "index", "stamp", "map", "order"]

_RULES = ("auto", "stem", "index", "stamp", "map", "order")
SIDES = {"rgb": "RGB", "fir": "thermal"}


@dataclass(frozen=True, slots=True)
class PairingRule:
    """How to pair. Raises `UsageError` when made from parts that cannot work together.

    `rgb_key` and `fir_key` are regular expressions searched in an entry's stem; the key is the tuple
    of their groups, or the whole match where they have none. Without them the key is the stem (`stem`),
    the last number in it (`index`) or the time stamp in it (`stamp`, where the source has no clock).
    `tolerance_ns` belongs to `stamp`; None takes half the median interval of the denser stream.
    `fir_offset_ns` is added to thermal stamps to give RGB's clock, as a rig says it.
    `map_file` is a CSV with the header ``rgb,fir`` or a JSON object of RGB name to thermal name.
    `auto`: the map if one is given; time if both sides have a clock or a tolerance is given; order if
    there is one image each; else stem.
    """

    by: By = "auto"
    rgb_key: str | None = None
    fir_key: str | None = None
    tolerance_ns: int | None = None
    map_file: str | None = None
    fir_offset_ns: int = 0

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
class Match:
    """A rule's raw result: pairs, and for each other index of either side the reason."""

    pairs: list[Pair] = field(default_factory=list)
    rgb: dict[int, str] = field(default_factory=dict)
    fir: dict[int, str] = field(default_factory=dict)
    from_map: list[Unmatched] = field(default_factory=list)
    tolerance_ns: int | None = None


def report_lines(pairing: Pairing, limit: int = 20) -> list[str]:
    """The pairing report: what matched, time differences, the first `limit` unmatched, remarks."""
    s = pairing.summary()
    lines = [f"{s.n_pairs} pairs by {s.rule_by} of {s.n_rgb} RGB and {s.n_fir} thermal images"]
    if s.dt_median_ms is not None:
        bound = "" if pairing.tolerance_ns is None else f", tolerance {ms(pairing.tolerance_ns)}"
        lines.append(
            f"thermal minus RGB: median {s.dt_median_ms:+.1f} ms, at most {s.dt_max_ms:.1f} ms{bound}"
        )
    lines += [f"note: {note}" for note in pairing.notes]
    if pairing.unmatched:
        from_map = f", {s.n_unmatched_map} lines of the mapping file" if s.n_unmatched_map else ""
        lines.append(f"unmatched: {s.n_unmatched_rgb} RGB, {s.n_unmatched_fir} thermal{from_map}")
    lines += [f"  {SIDES.get(u.role, u.role)} {u.where}: {u.reason}" for u in pairing.unmatched[:limit]]
    if len(pairing.unmatched) > limit:
        lines.append(f"  and {len(pairing.unmatched) - limit} more")
    return lines


def ms(ns: int, digits: int = 1) -> str:
    return f"{ns / 1e6:.{digits}f} ms"


def _n_groups(pattern: str | None, name: str) -> int:
    try:
        return 0 if pattern is None else re.compile(pattern).groups
    except (re.error, RecursionError, OverflowError) as error:
        raise UsageError(f"{name} '{pattern}' is no regular expression: {error}") from None
