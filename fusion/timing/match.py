"""Streams of stamps become sets: one of each, one to one, monotone, nearest in time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple


class Lost(NamedTuple):
    """A message that belongs to no set: which, and why, in words that a report can count."""

    role: str
    index: int
    reason: str


@dataclass(frozen=True, slots=True)
class Matched:
    """`sets` holds, per set, the index of each role's message (absent: an optional role had none), in the order of
    the leader; `lost` every message in no set.
    """

    sets: tuple[Mapping[str, int], ...]
    lost: tuple[Lost, ...]


def match_streams(
    stamps_ns: Mapping[str, Sequence[int | None]],
    lead: str,
    tolerance_ns: Mapping[str, int],
    optional: frozenset[str] = frozenset(),
) -> Matched:
    """Match every other stream to the stream `lead`: mutual nearest neighbours within that role's tolerance."""
    raise NotImplementedError
