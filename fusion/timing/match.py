"""Streams of stamps become sets: one of each, one to one, monotone, nearest in time.

Two messages pair where each is the other's nearest, within the tolerance. That is decided by their
neighbours in time alone, so a part of a recording, with `margin_ns` more on each side, gives the sets that
the whole gives.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

JUMP_NS = 10**9  # stamps are sorted; one that lies further back than this is a clock that was set, or broken
LATEST_NS = 2**62  # differences of stamps then fit into 64 bits; the year 2116

NO_STAMP = "no stamp"
NOT_A_TIME = "stamp out of range"
TWICE = "same stamp as an earlier message"
BACK = "stamp jumps back or far ahead"

Stamps = Sequence[int | None] | NDArray[np.int64]
Indices = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Lost:
    """A message that belongs to no set: which, and why, in words that a report can count."""

    role: str
    index: int
    reason: str


@dataclass(frozen=True, slots=True)
class Matched:
    """`sets` holds, per set, the index of each role's message (absent: an optional role had none), in the
    order of the leader's stamps; `lost` every message in no set, by role and index.
    """

    sets: tuple[Mapping[str, int], ...]
    lost: tuple[Lost, ...]

    def counts(self) -> dict[str, int]:
        """``role: reason`` -> how many messages were lost to it."""
        return dict(Counter(f"{each.role}: {each.reason}" for each in self.lost))


def match_streams(
    stamps_ns: Mapping[str, Stamps],
    lead: str,
    tolerance_ns: Mapping[str, int],
    optional: frozenset[str] = frozenset(),
) -> Matched:
    """Match every other stream to the stream `lead`: mutual nearest neighbours within that role's tolerance.

    `stamps_ns` are in the order of arrival, on one clock; None where a message has none. A message without a
    stamp, with one beyond `LATEST_NS`, with the stamp of an earlier one, or out of order by more than
    `JUMP_NS` is lost. A set needs a message of every role that is not `optional`. A tie goes to the earlier
    of the others and to the later leader: streams half an interval apart still pair, and sets never cross.
    Raises `ValueError` where `lead` is no stream or optional, or a tolerance is missing or negative.
    """
    _check(stamps_ns, lead, tolerance_ns, optional)
    lost: list[Lost] = []
    lines = {role: _timeline(role, stamps, lost) for role, stamps in stamps_ns.items()}
    links = {
        role: _link(lines[lead].times, lines[role].times, min(tolerance_ns[role], LATEST_NS))
        for role in stamps_ns
        if role != lead
    }
    missing = _first_missing(
        {role: link for role, link in links.items() if role not in optional}, lines[lead]
    )
    lost += _lost_leaders(lead, lines[lead], links, missing)
    for role, link in links.items():
        lost += _lost_others(role, lead, lines[role], link, missing)
    lost.sort(key=lambda each: (each.role, each.index))
    return Matched(tuple(_sets(lead, lines, links, missing)), tuple(lost))


def margin_ns(tolerance_ns: Mapping[str, int]) -> int:
    """How much more of every stream, before and after a stretch of time, gives the stretch's sets and losses.

    A message's fate hangs on leaders within a tolerance, what is near those, and what is nearer to that:
    three tolerances. It holds where no stamp jumps by more than `JUMP_NS`.
    """
    return 3 * max(tolerance_ns.values(), default=0) + 1


def default_tolerance_ns(*streams: NDArray[Any]) -> int | None:
    """Half the median interval of the densest stream (ascending stamps), in whole ns; None where none has
    two.
    """
    steps = [np.sort(np.diff(times)) for times in streams if len(times) > 1]
    return min((int(s[(len(s) - 1) // 2] + s[len(s) // 2]) // 4 for s in steps), default=None)


def default_tolerances_ns(stamps_ns: Mapping[str, Stamps], lead: str) -> dict[str, int]:
    """By role other than `lead`: half the median interval of the denser of both; 0 where nothing tells it."""
    times = {role: _timeline(role, stamps, []).times for role, stamps in stamps_ns.items()}
    return {role: default_tolerance_ns(times[lead], times[role]) or 0 for role in times if role != lead}


def nearest(times: NDArray[Any], others: NDArray[Any], *, later: bool) -> Indices:
    """For each of `times` the index of the nearest of `others`, the `later` or the earlier in a tie.

    Both ascending, no value twice, `others` not empty; int64 (below `LATEST_NS`), or Python's integers of
    any size.
    """
    after = np.searchsorted(others, times)
    right, left = np.minimum(after, len(others) - 1), np.maximum(after - 1, 0)
    to_right, to_left = np.abs(others[right] - times), np.abs(times - others[left])
    return np.where(to_right <= to_left if later else to_right < to_left, right, left)


class _Line(NamedTuple):
    """A stream in the order of time: stamps that differ, and the messages they belong to."""

    times: NDArray[np.int64]
    rows: Indices


class _Link(NamedTuple):
    """How a stream hangs on the leader, positions in their lines; `to_*` is the nearest, -1 beyond the
    tolerance.
    """

    partner: Indices  # of each leader, -1 for none
    back: Indices  # of each other, -1 for none
    to_other: Indices
    to_lead: Indices


def _check(
    stamps_ns: Mapping[str, Stamps], lead: str, tolerance_ns: Mapping[str, int], optional: frozenset[str]
) -> None:
    if lead not in stamps_ns or lead in optional:
        raise ValueError(f"expected a leader among {sorted(set(stamps_ns) - optional)}, got {lead!r}")
    for role in stamps_ns:
        if role != lead and tolerance_ns.get(role, -1) < 0:
            raise ValueError(f"expected a tolerance of zero or more for {role}, got {tolerance_ns.get(role)}")


def _timeline(role: str, stamps: Stamps, lost: list[Lost]) -> _Line:
    """The stream sorted; what has no place in it is added to `lost`."""
    index, times = _known(role, stamps, lost)
    if len(times) and int(np.diff(times).min(initial=0)) < -JUMP_NS:
        keep = _longest_in_order(times)
        lost += [Lost(role, int(i), BACK) for i in index[~keep]]
        index, times = index[keep], times[keep]
    order = np.argsort(times, kind="stable")
    index, times = index[order], times[order]
    first = np.ones(len(times), bool)
    first[1:] = times[1:] != times[:-1]
    lost += [Lost(role, int(i), TWICE) for i in index[~first]]
    return _Line(times[first], index[first])


def _known(role: str, stamps: Stamps, lost: list[Lost]) -> tuple[Indices, NDArray[np.int64]]:
    values = stamps.tolist() if isinstance(stamps, np.ndarray) else stamps
    kept: list[int] = []
    for i, stamp in enumerate(values):
        if stamp is not None and -LATEST_NS < stamp < LATEST_NS:
            kept.append(i)
        else:
            lost.append(Lost(role, i, NO_STAMP if stamp is None else NOT_A_TIME))
    return np.array(kept, np.intp), np.array([values[i] for i in kept], np.int64)


def _longest_in_order(times: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which to keep so that the most are kept and none lies further back than `JUMP_NS`.

    Between jumps back stamps are sorted; of the whole, the longest subsequence that ascends (by its lowest
    tails) stays: one stamp from the future costs itself, and of a clock that was set back the longer part is
    kept.
    """
    starts = np.flatnonzero(np.diff(times) < -JUMP_NS) + 1
    runs = np.split(np.arange(len(times)), starts)
    order = np.concatenate([run[np.argsort(times[run], kind="stable")] for run in runs])
    tails: list[int] = []
    ends: list[int] = []  # where in `order` the best subsequence of each length ends
    before = np.full(len(order), -1, np.intp)
    for k, t in enumerate(times[order].tolist()):
        at = bisect_right(tails, t)
        before[k] = ends[at - 1] if at else -1
        tails[at : at + 1], ends[at : at + 1] = [t], [k]
    keep = np.zeros(len(order), bool)
    k = ends[-1]
    while k >= 0:
        keep[order[k]] = True
        k = int(before[k])
    return keep


def _link(lead: NDArray[np.int64], other: NDArray[np.int64], tolerance_ns: int) -> _Link:
    if not len(lead) or not len(other):
        none = np.full(len(lead), -1, np.intp), np.full(len(other), -1, np.intp)
        return _Link(*none, *none)
    to_other, to_lead = nearest(lead, other, later=False), nearest(other, lead, later=True)
    to_other = np.where(np.abs(other[to_other] - lead) <= tolerance_ns, to_other, -1)
    to_lead = np.where(np.abs(lead[to_lead] - other) <= tolerance_ns, to_lead, -1)
    mutual = (to_other >= 0) & (to_lead[to_other] == np.arange(len(lead)))
    back = np.full(len(other), -1, np.intp)
    back[to_other[mutual]] = np.flatnonzero(mutual)
    return _Link(np.where(mutual, to_other, -1), back, to_other, to_lead)


def _first_missing(needed: Mapping[str, _Link], lead: _Line) -> list[str]:
    """For each leader the first role that it needs and has not; "" where it has all."""
    missing = [""] * len(lead.times)
    for role, link in needed.items():
        for k in np.flatnonzero(link.partner < 0).tolist():
            missing[k] = missing[k] or role
    return missing


def _lost_leaders(lead: str, line: _Line, links: Mapping[str, _Link], missing: Sequence[str]) -> list[Lost]:
    return [
        Lost(lead, i, _why(lead, role, links[role].to_other[k] >= 0))
        for k, (i, role) in enumerate(zip(line.rows.tolist(), missing, strict=True))
        if role
    ]


def _lost_others(role: str, lead: str, line: _Line, link: _Link, missing: Sequence[str]) -> list[Lost]:
    lost = []
    for k, (i, leader) in enumerate(zip(line.rows.tolist(), link.back.tolist(), strict=True)):
        if leader < 0:
            lost.append(Lost(role, i, _why(role, lead, link.to_lead[k] >= 0)))
        elif missing[leader]:
            lost.append(Lost(role, i, f"its {lead} has no {missing[leader]}"))
    return lost


def _why(role: str, other: str, rival: bool) -> str:
    return f"another {role} is nearer to its {other}" if rival else f"no {other} within the tolerance"


def _sets(
    lead: str, lines: Mapping[str, _Line], links: Mapping[str, _Link], missing: Sequence[str]
) -> list[dict[str, int]]:
    sets: list[dict[str, int]] = [{lead: i} for i in lines[lead].rows.tolist()]
    for role, link in links.items():
        index = lines[role].rows.tolist()
        for chosen, k in zip(sets, link.partner.tolist(), strict=True):
            if k >= 0:
                chosen[role] = index[k]
    return [chosen for chosen, role in zip(sets, missing, strict=True) if not role]
