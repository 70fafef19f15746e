"""Stamps with known gaps, pixels with known percentiles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion.frames import PointCloud
from fusion.inspect.base import Looked
from fusion.inspect.measure import PixelTally, freezes_said, points_of, spread, times_of
from fusion.timing.freeze import FreezeFinder

MS = 1_000_000


def test_gaps_jumps_and_doubles_are_where_they_were_put():
    steps = [100] * 10 + [700] + [100] * 5 + [-50] + [100] * 3 + [0] + [100] * 4
    stamps = np.cumsum([0, *steps]) * MS + 1_700_000_000 * 10**9
    listed = [*stamps.tolist(), None]
    times = times_of(listed, "header", Looked(len(listed), len(listed), "messages"))
    assert times is not None
    assert times.rate_hz == pytest.approx(10.0)
    assert times.gap_count == 1
    assert times.gaps_ns == ((int(stamps[10]), int(stamps[11])),)
    assert (times.backwards, times.duplicates, times.without) == (1, 1, 1)
    assert (times.first_ns, times.last_ns) == (int(stamps[0]), int(max(stamps)))


def test_the_longest_gaps_come_first_and_all_are_counted():
    steps = [10] * 20 + [40, 10, 90, 10, 50, 10, 60, 10, 70, 10, 80, 10]
    stamps = np.cumsum([0, *steps]).tolist()
    times = times_of(stamps, "log", Looked(len(stamps), len(stamps), "messages"))
    assert times is not None
    assert times.gap_count == 6
    assert [end - begin for begin, end in times.gaps_ns] == [90, 80, 70, 60, 50]


def test_samples_say_nothing_of_steps():
    times = times_of([0, 10**9, 5 * 10**9], "log", Looked(3, 100, "messages"))
    assert times is not None
    assert times.rate_hz is times.gap_count is times.backwards is times.duplicates is None
    assert times.last_ns == 5 * 10**9


def test_no_stamp_is_no_times():
    assert times_of([], "log", Looked(0, 0, "messages")) is None
    assert times_of([None, None], "header", Looked(2, 2, "messages")) is None


def test_delay_is_log_minus_stamp():
    stamps = [k * 100 * MS for k in range(50)]
    times = times_of(stamps, "header", Looked(50, 50, "messages"), [t + 30 * MS for t in stamps])
    assert times is not None
    assert times.delay_ms == (pytest.approx(30.0), pytest.approx(0.0))


@given(st.lists(st.integers(0, 65535), min_size=1, max_size=60), st.sampled_from([np.uint8, np.uint16]))
def test_percentiles_are_values_that_cut_the_pixels_there(values, dtype):
    pixels = (np.array(values) % (np.iinfo(dtype).max + 1)).astype(dtype).reshape(1, -1)
    tally = PixelTally()
    tally.add(pixels)
    facts = tally.facts()
    assert (facts["least"], facts["most"]) == (pixels.min(), pixels.max())
    for name, part in (("p1", 0.01), ("median", 0.5), ("p99", 0.99)):
        assert facts[name] == np.quantile(pixels, part, method="inverted_cdf")


def test_pictures_add_up():
    tally = PixelTally()
    tally.add(np.full((2, 3), 7, np.uint16))
    tally.add(np.full((2, 3, 3), 9, np.uint8))
    assert tally.facts() == {"least": 7, "p1": 7, "median": 9, "p99": 9, "most": 9}
    assert PixelTally().facts() == {}


def test_points_of_a_cloud():
    xyz = np.array([[3, 4, 0], [0, 0, 2], [-6, 0, 8]], np.float32)
    cloud = PointCloud(xyz, {"ring": np.array([0, 1, 1])}, read=5, dropped={"nan": 2, "zero": 0})
    said = points_of(cloud)
    assert (said["points"], said["valid_points"], said["dropped"]) == (5, 3, {"nan": 2})
    assert said["range_m"] == {"least": 2.0, "median": 5.0, "most": 10.0}
    assert said["extent_m"] == {"x": [-6.0, 3.0], "y": [0.0, 4.0], "z": [0.0, 8.0]}
    assert said["rings"] == 2
    assert "range_m" not in points_of(PointCloud(np.empty((0, 3), np.float32), read=2))


def test_freezes_are_counted_and_placed():
    rng = np.random.default_rng(0)
    frames = [rng.integers(7000, 7400, (32, 40)).astype(np.uint16) for _ in range(12)]
    frames[5] = frames[6] = frames[4]
    finder = FreezeFinder()
    said = freezes_said([finder.add(frame) for frame in frames])
    assert said == {"frozen_frames": 2, "freezes": 1, "frozen_from_to": [[4, 6]]}


@given(st.integers(0, 500), st.integers(2, 30))
def test_spread_has_both_ends(count, most):
    chosen = spread(count, most)
    assert len(chosen) <= most
    assert chosen == sorted(set(chosen))
    if count:
        assert (chosen[0], chosen[-1]) == (0, count - 1)
