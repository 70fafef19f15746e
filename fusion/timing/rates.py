"""What the stamps of a stream are like: rate, jitter, gaps, jumps back, and how they lie to the log's
times.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.timing.match import LATEST_NS

GAP = 2.5  # median intervals
LISTED = 100  # gaps and jumps that are told one by one, the longest
_PARTS = 50  # of a recording, whose medians tell the drift


@dataclass(frozen=True, slots=True)
class Gap:
    """Nothing came for `length_ns` after message `index`, of stamp `start_ns`; about `missing` messages."""

    index: int
    start_ns: int
    length_ns: int
    missing: int


@dataclass(frozen=True, slots=True)
class Jump:
    """Message `index` is `back_ns` older than the one before it."""

    index: int
    stamp_ns: int
    back_ns: int


@dataclass(frozen=True, slots=True)
class Delay:
    """Log time minus stamp: its median, how far apart the 5th and 95th percentile are, and its growth a
    second.
    """

    median_ns: int
    spread_ns: int
    drift: float


@dataclass(frozen=True, slots=True)
class StreamRates:
    """A stream's stamps in the order of arrival; nanoseconds.

    `interval_ns` is the median of the steps forward, None for less than two different stamps, as `rate_hz`;
    `jitter_ns` is 1.4826 times the median distance of the steps from it (a normal deviation's sigma). `gaps`
    are steps of more than `GAP` intervals, `jumps` steps back: the `LISTED` longest of each in the order of
    arrival, `n_gaps` and `n_jumps` all of them. `n_same` counts stamps that repeat the one before,
    `n_unstamped` messages without a stamp or with an absurd one.
    """

    count: int
    n_unstamped: int
    first_ns: int | None
    last_ns: int | None
    rate_hz: float | None
    interval_ns: int | None
    jitter_ns: int | None
    n_gaps: int
    gaps: tuple[Gap, ...]
    n_jumps: int
    jumps: tuple[Jump, ...]
    n_same: int
    delay: Delay | None


class RateMeter:
    """Takes stamps one by one, in the order of arrival; 24 bytes a message."""

    def __init__(self) -> None:
        self._index, self._stamps, self._logs = array("q"), array("q"), array("q")
        self._count = 0
        self._logged = True

    def add(self, stamp_ns: int | None, log_ns: int | None = None) -> None:
        """One message. Without a log time for all of them there is no `delay`."""
        if stamp_ns is not None and abs(stamp_ns) < LATEST_NS:
            logged = log_ns is not None and abs(log_ns) < LATEST_NS
            self._logged &= logged
            self._index.append(self._count)
            self._stamps.append(stamp_ns)
            self._logs.append(log_ns if logged and log_ns is not None else 0)
        self._count += 1

    def rates(self) -> StreamRates:
        """Of all that was added so far."""
        index, stamps, logs = (np.array(a, np.int64) for a in (self._index, self._stamps, self._logs))
        return _rates(self._count, index, stamps, logs if self._logged and len(logs) else None)


def _rates(
    count: int, index: NDArray[np.int64], stamps: NDArray[np.int64], logs: NDArray[np.int64] | None
) -> StreamRates:
    steps = np.diff(stamps)
    forward = steps[steps > 0]
    interval = int(np.median(forward)) if len(forward) else None
    wide = np.flatnonzero(steps > GAP * interval) if interval else np.zeros(0, np.intp)
    back = np.flatnonzero(steps < 0)
    return StreamRates(
        count,
        count - len(stamps),
        int(stamps.min()) if len(stamps) else None,
        int(stamps.max()) if len(stamps) else None,
        1e9 / interval if interval else None,
        interval,
        round(1.4826 * float(np.median(np.abs(forward - interval)))) if interval else None,
        len(wide),
        tuple(
            Gap(int(index[k]), int(stamps[k]), int(steps[k]), round(steps[k] / (interval or 1)) - 1)
            for k in _longest(wide, steps[wide])
        ),
        len(back),
        tuple(
            Jump(int(index[k + 1]), int(stamps[k + 1]), -int(steps[k])) for k in _longest(back, -steps[back])
        ),
        int((steps == 0).sum()),
        None if logs is None else _delay(stamps, logs),
    )


def _longest(where: NDArray[np.intp], lengths: NDArray[np.int64]) -> list[int]:
    return sorted(where[np.argsort(-lengths, kind="stable")[:LISTED]].tolist())


def _delay(stamps: NDArray[np.int64], logs: NDArray[np.int64]) -> Delay:
    """The drift is Theil's and Sen's slope through the medians of parts: single late messages do not move
    it.
    """
    delays = logs - stamps
    low, middle, high = np.percentile(delays, [5, 50, 95])
    at, value = [], []
    for part in np.array_split(np.arange(len(delays)), min(_PARTS, len(delays))):
        at.append(float(np.median(logs[part] - logs[0])))
        value.append(float(np.median(delays[part] - delays[0])))
    return Delay(round(float(middle)), round(float(high - low)), _slope(np.array(at), np.array(value)))


def _slope(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    i, j = np.triu_indices(len(x), 1)
    apart = x[i] != x[j]
    i, j = i[apart], j[apart]
    return float(np.median((y[j] - y[i]) / (x[j] - x[i]))) if len(i) else 0.0
