"""Which image of a folder goes with which cloud: by name, else by time, or the only one with the only one."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

from fusion.errors import FrameError, InputError
from fusion.frames import Image
from fusion.pairing import stamp_in_name
from fusion.sources import Source

SLACK_NS = 50_000_000  # half the turn of a scanner at ten a second


class Partners:
    """The images of `source` that belong to frames called `stems`; `option` is how messages call them.

    By stem where any agree; else by the time stamps in the names, the nearest within 50 ms. Raises
    `InputError` where nothing belongs together.
    """

    def __init__(self, option: str, source: Source, stems: Sequence[str]) -> None:
        self.option, self._source = option, source
        self._index = _matched(stems, source)
        found = sum(index is not None for index in self._index)
        if not found:
            ours, theirs = stems[0], source.entries[0].stem
            hint = f"names must agree, or carry time stamps; {ours!r} and {theirs!r} do not"
            raise InputError(
                "no image belongs to any of the inputs", where=f"{option} {source.name}", hint=hint
            )
        lost = len(stems) - found
        self.notes = [f"{option}: {lost} of {len(stems)} inputs have no image there"] if lost else []

    def file(self, index: int) -> str:
        """The file of the partner, "" where there is none."""
        partner = self._index[index]
        if partner is None:
            return ""
        entry = self._source.entries[partner]
        return entry.file or entry.where

    def has(self, index: int) -> bool:
        return self._index[index] is not None

    def read(self, index: int) -> Image:
        """The partner itself. Raises `FrameError` where there is none, or it cannot be read."""
        partner = self._index[index]
        if partner is None:
            raise FrameError(f"no image in {self.option} belongs to it")
        return self._source.read(partner)


def _matched(stems: Sequence[str], source: Source) -> list[int | None]:
    if len(stems) == len(source.entries) == 1:
        return [0]
    by_stem = {entry.stem: number for number, entry in enumerate(source.entries)}
    matched = [by_stem.get(stem) for stem in stems]
    return matched if any(index is not None for index in matched) else _by_time(stems, source)


def _by_time(stems: Sequence[str], source: Source) -> list[int | None]:
    times = sorted(
        (stamp, number)
        for number, entry in enumerate(source.entries)
        if (stamp := entry.stamp_ns or stamp_in_name(entry.stem)) is not None
    )
    return [_nearest(stamp_in_name(stem), times) for stem in stems]


def _nearest(stamp: int | None, times: list[tuple[int, int]]) -> int | None:
    if stamp is None or not times:
        return None
    at = bisect_left(times, (stamp, 0))
    when, number = min(times[max(at - 1, 0) : at + 1], key=lambda time: abs(time[0] - stamp))
    return number if abs(when - stamp) <= SLACK_NS else None
