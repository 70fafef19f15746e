"""Streams matched in time: against brute force, in windows as in the whole, and with every kind of bad
stamp.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion.timing.match import (
    BACK,
    JUMP_NS,
    LATEST_NS,
    NO_STAMP,
    NOT_A_TIME,
    TWICE,
    Matched,
    default_tolerance_ns,
    default_tolerances_ns,
    margin_ns,
    match_streams,
)

TIMES = st.lists(st.integers(-40, 40), max_size=12)


def brute(
    stamps: Mapping[str, Sequence[int]], lead: str, tolerance: Mapping[str, int]
) -> list[dict[str, int]]:
    """Sets of stamps by their definition: each other's nearest; ties to the earlier other and the later
    leader.
    """
    unique = {role: sorted(set(times)) for role, times in stamps.items()}
    sets = []
    for t in unique[lead]:
        chosen = {lead: t}
        for role in stamps:
            if role == lead or not unique[role]:
                continue
            u = min(unique[role], key=lambda x: (abs(x - t), x))
            back = min(unique[lead], key=lambda x: (abs(x - u), -x))
            if back == t and abs(u - t) <= tolerance[role]:
                chosen[role] = u
        sets.append(chosen)
    return [chosen for chosen in sets if len(chosen) == len(stamps)]


def in_stamps(stamps: Mapping[str, Sequence[int]], got: Matched) -> list[dict[str, int]]:
    return [{role: stamps[role][i] for role, i in chosen.items()} for chosen in got.sets]


def assert_partition(stamps: Mapping[str, Sequence[int | None]], got: Matched) -> None:
    """Every message is in one set or lost once."""
    for role, times in stamps.items():
        used = [chosen[role] for chosen in got.sets if role in chosen]
        lost = [each.index for each in got.lost if each.role == role]
        assert sorted(used + lost) == list(range(len(times)))
    assert sum(got.counts().values()) == len(got.lost)
    assert all(each.reason for each in got.lost)


@given(TIMES, TIMES, TIMES, st.integers(0, 20), st.integers(0, 20))
def test_sets_are_those_of_the_definition_and_never_cross(
    rgb: list[int], fir: list[int], lidar: list[int], a: int, b: int
) -> None:
    stamps = {"rgb": rgb, "fir": fir, "lidar": lidar}
    tolerance = {"fir": a, "lidar": b}
    got = match_streams(stamps, "rgb", tolerance)
    assert in_stamps(stamps, got) == brute(stamps, "rgb", tolerance)
    assert_partition(stamps, got)
    for one, two in pairwise(in_stamps(stamps, got)):
        assert all(one[role] < two[role] for role in stamps)


@given(TIMES, TIMES, TIMES)
def test_an_optional_role_takes_nothing_from_the_others(
    rgb: list[int], fir: list[int], lidar: list[int]
) -> None:
    stamps = {"rgb": rgb, "fir": fir, "lidar": lidar}
    with_it = match_streams(stamps, "rgb", {"fir": 6, "lidar": 9}, frozenset({"lidar"}))
    without = match_streams({"rgb": rgb, "fir": fir}, "rgb", {"fir": 6})
    assert [{k: v for k, v in chosen.items() if k != "lidar"} for chosen in with_it.sets] == list(
        without.sets
    )
    assert_partition(stamps, with_it)


def test_the_lidar_may_lead_and_reasons_say_what_was_missing() -> None:
    stamps = {"rgb": [0, 50, 100, 150, 200, 260], "fir": [1, 41, 81, 121, 161], "lidar": [0, 100, 200, 900]}
    got = match_streams(stamps, "lidar", {"rgb": 20, "fir": 20})
    assert in_stamps(stamps, got) == [{"lidar": 0, "rgb": 0, "fir": 1}, {"lidar": 100, "rgb": 100, "fir": 81}]
    assert got.counts() == {
        "lidar: no fir within the tolerance": 1,
        "lidar: no rgb within the tolerance": 1,
        "rgb: its lidar has no fir": 1,
        "rgb: no lidar within the tolerance": 3,
        "fir: no lidar within the tolerance": 3,
    }
    assert_partition(stamps, got)


def test_a_nearer_rival_is_named_and_half_an_interval_apart_still_pairs() -> None:
    got = match_streams({"rgb": [0, 30, 100], "fir": [20, 29, 95, 98]}, "rgb", {"fir": 25})
    assert [(each.role, each.index, each.reason) for each in got.lost] == [
        ("fir", 0, "another fir is nearer to its rgb"),
        ("fir", 2, "another fir is nearer to its rgb"),
        ("rgb", 0, "another rgb is nearer to its fir"),
    ]
    apart = {"rgb": [0, 100, 200, 300], "fir": [50, 150, 250]}
    assert in_stamps(apart, match_streams(apart, "rgb", {"fir": 50})) == [
        {"rgb": 100, "fir": 50},
        {"rgb": 200, "fir": 150},
        {"rgb": 300, "fir": 250},
    ]


def test_bad_stamps_are_lost_with_their_reason_and_cost_nobody_else() -> None:
    fine = list(range(0, 10**10, 10**8))
    bad: list[int | None] = [*fine[:50], None, fine[49], 2**63 + 5, 10**17, *fine[50:]]
    got = match_streams({"rgb": fine, "fir": bad}, "rgb", {"fir": 10**7})
    assert len(got.sets) == len(fine)
    assert Counter(each.reason for each in got.lost) == {NO_STAMP: 1, TWICE: 1, NOT_A_TIME: 1, BACK: 1}
    assert_partition({"rgb": fine, "fir": bad}, got)


def test_small_disorder_is_sorted_and_of_a_clock_set_back_the_longer_part_stays() -> None:
    fine = list(range(0, 10**10, 10**8))
    mixed = [fine[k ^ 1] for k in range(len(fine))]
    got = match_streams({"rgb": fine, "fir": mixed}, "rgb", {"fir": 10**7})
    assert [chosen["fir"] for chosen in got.sets] == [k ^ 1 for k in range(len(fine))]
    assert not got.lost
    back = [*range(10**12, 10**12 + 30 * 10**8, 10**8), *fine]
    got = match_streams({"rgb": fine, "fir": back}, "rgb", {"fir": 10**7})
    assert [chosen["fir"] for chosen in got.sets] == list(range(30, 130))
    assert got.counts() == {f"fir: {BACK}": 30}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("optional", [frozenset(), frozenset({"lidar"})])
def test_windows_with_their_margin_give_what_the_whole_gives(seed: int, optional: frozenset[str]) -> None:
    rng = np.random.default_rng(seed)
    tolerance = {"fir": int(rng.integers(5, 60)), "lidar": int(rng.integers(5, 60))}
    stamps = {role: np.cumsum(rng.integers(0, 2 * step, 900)) for role, step in (("rgb", 50), ("fir", 40))}
    stamps["lidar"] = np.cumsum(rng.integers(0, 140, 650))
    whole = _by_stamp(stamps, match_streams(stamps, "rgb", tolerance, optional))
    margin = margin_ns(tolerance)
    parts: list[tuple[object, ...]] = []
    for begin in range(0, 50_000, 1_777):
        end = begin + 1_777
        rows = {r: (t >= begin - margin) & (t < end + margin) for r, t in stamps.items()}
        window = {role: t[rows[role]] for role, t in stamps.items()}
        made = _by_stamp(window, match_streams(window, "rgb", tolerance, optional))
        parts += [each for each in made if begin <= each[0] < end]  # type: ignore[operator]
    assert sorted(map(repr, parts)) == sorted(map(repr, whole))
    assert len({each[1] for each in whole}) > 4  # sets and losses of several kinds


def _by_stamp(stamps: Mapping[str, np.ndarray], got: Matched) -> list[tuple[object, ...]]:
    """Sets at their leader's stamp, losses at their own."""
    sets = [
        (int(stamps["rgb"][s["rgb"]]), "set", sorted((r, int(stamps[r][i])) for r, i in s.items()))
        for s in got.sets
    ]
    return [*sets, *((int(stamps[x.role][x.index]), f"{x.role}: {x.reason}") for x in got.lost)]


def test_a_stream_that_is_empty_and_arguments_that_cannot_be() -> None:
    assert match_streams({"rgb": [], "fir": [1]}, "rgb", {"fir": 9}).counts() == {
        "fir: no rgb within the tolerance": 1
    }
    assert len(match_streams({"rgb": [1, 2], "fir": []}, "rgb", {"fir": 9}, frozenset({"fir"})).sets) == 2
    for lead, tolerance, optional in (
        ("lidar", {"fir": 1}, frozenset[str]()),
        ("rgb", {}, frozenset[str]()),
        ("rgb", {"fir": -1}, frozenset[str]()),
        ("rgb", {"fir": 1}, frozenset({"rgb"})),
    ):
        with pytest.raises(ValueError, match="expected"):
            match_streams({"rgb": [1], "fir": [1]}, lead, tolerance, optional)


def test_extreme_stamps_and_tolerances_do_not_overflow() -> None:
    stamps = {"rgb": [1 - LATEST_NS, LATEST_NS - 1], "fir": [LATEST_NS - 1]}
    got = match_streams(stamps, "rgb", {"fir": 10**30})
    assert in_stamps(stamps, got) == [{"rgb": LATEST_NS - 1, "fir": LATEST_NS - 1}]
    assert JUMP_NS < LATEST_NS


@given(TIMES, TIMES)
def test_the_default_tolerance_is_half_the_denser_median_interval(rgb: list[int], fir: list[int]) -> None:
    halves = [np.median(np.diff(sorted(set(t)))) / 2 for t in (rgb, fir) if len(set(t)) > 1]
    wanted = int(min(halves)) if halves else 0
    assert default_tolerances_ns({"rgb": rgb, "fir": fir}, "rgb") == {"fir": wanted}
    assert (default_tolerance_ns(*(np.array(sorted(set(t))) for t in (rgb, fir))) or 0) == wanted
