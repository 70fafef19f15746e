"""What is said of stamps: against streams made with known faults."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion.timing.rates import LISTED, Delay, Gap, Jump, RateMeter, StreamRates

S, MS = 10**9, 10**6


def rates(stamps: Iterable[int | None], logs: Iterable[int | None] | None = None) -> StreamRates:
    meter = RateMeter()
    stamps = list(stamps)
    for stamp, log in zip(stamps, logs or [None] * len(stamps), strict=True):
        meter.add(stamp, log)
    return meter.rates()


def test_a_clean_stream() -> None:
    got = rates(range(5 * S, 15 * S, 40 * MS))
    assert (got.count, got.n_unstamped, got.first_ns, got.last_ns) == (250, 0, 5 * S, 15 * S - 40 * MS)
    assert (got.rate_hz, got.interval_ns, got.jitter_ns) == (25.0, 40 * MS, 0)
    assert (got.gaps, got.jumps, got.n_same, got.delay) == ((), (), 0, None)


def test_every_fault_is_counted_where_it_is() -> None:
    stamps: list[int | None] = [100 * MS * k for k in range(50)]
    stamps[10:13] = [None, 2**70, stamps[9]]
    del stamps[20:24]
    stamps[30] = 100 * MS
    got = rates(stamps)
    assert got.n_unstamped == 2
    assert got.n_same == 1
    assert got.gaps == (
        Gap(12, 900 * MS, 400 * MS, 3),
        Gap(19, 1900 * MS, 500 * MS, 4),
        Gap(30, 100 * MS, 3400 * MS, 33),
    )
    assert got.jumps == (Jump(30, 100 * MS, 3200 * MS),)
    assert (got.n_gaps, got.n_jumps, got.first_ns, got.last_ns) == (3, 1, 0, 4900 * MS)


def test_jitter_is_the_sigma_of_intervals_and_gaps_do_not_move_it() -> None:
    rng = np.random.default_rng(0)
    steps = rng.normal(40 * MS, 2 * MS, 4000)
    steps[50::100] = 3 * S
    got = rates(np.cumsum(steps).astype(int).tolist())
    assert got.jitter_ns == pytest.approx(2 * MS, rel=0.1)
    assert got.rate_hz == pytest.approx(25, rel=0.01)
    assert got.n_gaps == 40


def test_the_delay_its_spread_and_drift_in_spite_of_late_messages() -> None:
    rng = np.random.default_rng(1)
    stamps = np.arange(0, 600 * S, 50 * MS)
    delays = 30 * MS + stamps * 50e-6 + rng.uniform(-1, 1, len(stamps)) * MS
    delays[rng.random(len(stamps)) < 0.02] += 2 * S
    got = rates(stamps.tolist(), (stamps + delays.astype(int)).tolist()).delay
    assert got is not None
    assert got.drift == pytest.approx(50e-6, abs=1e-6)
    assert got.median_ns == pytest.approx(45 * MS, abs=MS)
    assert got.spread_ns == pytest.approx(0.9 * 31 * MS, rel=0.1)


def test_without_a_log_time_for_all_there_is_no_delay() -> None:
    assert rates([1, 2], [5, None]).delay is None
    assert rates([7], [10]).delay == Delay(3, 0, 0.0)


def test_lists_are_bounded_and_keep_the_longest() -> None:
    steps = np.full(3000, 10 * MS)
    steps[5::10] = np.arange(300) * MS + 100 * MS
    got = rates(np.cumsum(steps).tolist())
    assert got.n_gaps == 300
    assert len(got.gaps) == LISTED
    assert min(gap.length_ns for gap in got.gaps) == (100 + 200) * MS
    assert [gap.index for gap in got.gaps] == sorted(gap.index for gap in got.gaps)


def test_nothing_and_one_and_always_the_same() -> None:
    for stamps, count in (([], 0), ([None], 1), ([5], 1), ([5, 5, 5], 3), ([9, 5], 2)):
        got = rates(stamps)
        assert (got.count, got.rate_hz, got.gaps) == (count, None, ())


@given(st.lists(st.one_of(st.none(), st.integers(-(2**66), 2**66)), max_size=30))
def test_any_integers_are_taken(stamps: list[int | None]) -> None:
    got = rates(stamps, [1] * len(stamps))
    known = [s for s in stamps if s is not None and abs(s) < 2**62]
    assert got.n_unstamped == len(stamps) - len(known)
    assert got.n_jumps == sum(b < a for a, b in pairwise(known))
