"""Clocks that are apart by a known offset and drift: found, with an honest sigma, or refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn import Clock, motion, pictures, times, wobble

from fusion.codecs import decode_image
from fusion.errors import InputError
from fusion.simulate.mine.config import MineConfig
from fusion.simulate.mine.recording import make_mine
from fusion.timing.clock import LAG, ClockEstimate, estimate_clock
from fusion.timing.motion import Motion, MotionMeter


def errors_ms(found: ClockEstimate, clock: Clock, motion: Motion) -> tuple[float, float]:
    """At the middle, and the larger of both ends."""
    stamps = (found.at_ns, int(motion.stamps_ns[0]), int(motion.stamps_ns[-1]))
    middle, *ends = ((found.offset_at(s) - clock.to_true_ns(s)) / 1e6 for s in stamps)
    return abs(middle), max(map(abs, ends))


@pytest.mark.parametrize(
    ("rates_hz", "clock"),
    [
        ((20, 25), Clock(0.0371, 25e-6)),
        ((30, 10), Clock(-1.9437, -100e-6)),
        ((10, 30), Clock(1.9873, 100e-6)),
        ((15, 9), Clock(-0.6, 60e-6)),
    ],
)
def test_offset_and_drift_of_a_long_recording(rates_hz: tuple[int, int], clock: Clock) -> None:
    path = wobble(rates_hz[0])
    rgb = motion(path, times(rates_hz[0], 300), Clock(), seed=1)
    fir = motion(path, times(rates_hz[1], 300, 0.1137), clock, seed=2)
    found = estimate_clock(rgb, fir, time_constant_s=0)
    assert found.drift == pytest.approx(1 / (1 + clock.drift) - 1, abs=8e-6)
    middle, end = errors_ms(found, clock, fir)
    assert middle < 1.0
    assert end < 2.0
    assert found.lag_ns == 0
    assert found.confidence > 0.9


def test_a_drift_that_blurs_the_whole_is_found_as_well() -> None:
    path, clock = wobble(12), Clock(0.25, 280e-6)  # a third of a second in the end
    rgb, fir = motion(path, times(10, 1200), Clock()), motion(path, times(12, 1200), clock)
    found = estimate_clock(rgb, fir, time_constant_s=0)
    assert found.score > 0.9
    assert errors_ms(found, clock, fir)[1] < 2.0


def test_the_sign_is_that_of_a_rig_and_a_rough_offset_may_be_far() -> None:
    path, far = wobble(5), Clock(5000.25)
    rgb, fir = motion(path, times(20, 30), Clock()), motion(path, times(25, 30), far)
    found = estimate_clock(rgb, fir, around_ns=-5_000 * 10**9, time_constant_s=0)
    assert found.offset_ns / 1e9 == pytest.approx(-5000.25, abs=0.003)  # the thermal clock is ahead
    assert errors_ms(found, far, fir)[0] < 3


def test_cameras_may_stand_at_any_angle_and_differ_in_focal_length() -> None:
    path, clock = wobble(6), Clock(0.31)
    rgb = motion(path, times(20, 30), Clock())
    fir = motion(lambda t: path(t) @ np.array([[0.2, -1.7], [1.7, 0.2]]), times(25, 30), clock)
    assert errors_ms(estimate_clock(rgb, fir, time_constant_s=0), clock, fir)[0] < 3


def test_the_sigma_covers_the_error_of_short_and_noisy_ones() -> None:
    ratios = []
    for seed in range(12):
        path, clock = wobble(seed), Clock(0.1 * seed - 0.6, 1e-5 * (seed - 6))
        rgb = motion(path, times(20, 15), Clock(), 0.4, seed=2 * seed)
        fir = motion(path, times(25, 15), clock, 0.4, seed=2 * seed + 1)
        found = estimate_clock(rgb, fir, time_constant_s=0)
        true_drift = 1 / (1 + clock.drift) - 1
        ratios.append(errors_ms(found, clock, fir)[0] / (found.offset_sigma_ns / 1e6))
        assert abs(found.drift - true_drift) < 4 * found.drift_sigma
    assert max(ratios) < 3
    assert float(np.mean(ratios)) > 0.1


def test_holes_and_freezes_in_the_motion_do_no_harm() -> None:
    path, clock = wobble(8), Clock(-0.45, 40e-6)
    rgb = motion(path, times(20, 60), Clock())
    true_s = times(25, 60)
    kept = np.array([k % 125 not in range(60, 75) for k in range(len(true_s))])
    fir = motion(path, true_s[kept], clock)
    shift = rgb.shift_px.copy()
    shift[300:320] = np.nan
    found = estimate_clock(Motion(rgb.stamps_ns, shift), fir, time_constant_s=0)
    assert errors_ms(found, clock, fir)[0] < 2
    unknown_s = 12 * (16 / 25 + 0.2) + 1 + 0.2  # each hole, and the span around it
    assert found.overlap_s == pytest.approx(59.5 - unknown_s, abs=1.0)


@pytest.mark.parametrize("seed", range(6))
def test_unrelated_motion_is_refused(seed: int) -> None:
    rgb = motion(wobble(seed), times(20, 30), Clock())
    with pytest.raises(InputError, match="cannot be compared"):
        estimate_clock(rgb, motion(wobble(seed + 50), times(25, 30), Clock()))


def test_no_motion_little_time_and_a_beat_are_refused() -> None:
    still = motion(wobble(1, 0.05), times(20, 30), Clock(), 0.005)
    with pytest.raises(InputError, match="hardly moves"):
        estimate_clock(still, still)
    short = motion(wobble(1), times(20, 7), Clock())
    with pytest.raises(InputError, match="in common"):
        estimate_clock(short, short)
    nothing = Motion(np.zeros(0, np.int64), np.zeros((0, 2)))
    with pytest.raises(InputError, match="too few"):
        estimate_clock(short, nothing)
    later = motion(wobble(1), times(20, 30), Clock(1000))
    with pytest.raises(InputError, match="in common"):
        estimate_clock(motion(wobble(1), times(20, 30), Clock()), later)
    beat = lambda t: 5 * np.stack([np.sin(2 * np.pi * t), np.cos(2 * np.pi * t)], -1)  # noqa: E731
    with pytest.raises(InputError, match="not certain"):
        estimate_clock(motion(beat, times(20, 30), Clock()), motion(beat, times(25, 30), Clock(0.2)))


def test_at_the_edge_of_the_search_nothing_is_certain() -> None:
    path = wobble(3)
    rgb, fir = motion(path, times(20, 40), Clock()), motion(path, times(25, 40), Clock(0.64))
    with pytest.raises(InputError, match=r"cannot be compared"):
        estimate_clock(rgb, fir, limit_s=0.5)


def metered(stamps: np.ndarray, frames: list[np.ndarray]) -> Motion:
    meter = MotionMeter()
    for stamp, pixels in zip(stamps.tolist(), frames, strict=True):
        meter.add(stamp, pixels)
    return meter.motion()


def test_from_pictures_with_freezes_and_changing_exposure() -> None:
    path, clock = wobble(9, 5.0), Clock(-1.234, 80e-6)
    true_rgb, true_fir = times(15, 14), times(20, 14, 0.1137)
    rgb = metered(Clock().stamps(true_rgb), list(pictures(path, true_rgb, 1, thermal=False)))
    frames = list(pictures(path, true_fir, 2, thermal=True))
    frames[100:112] = [frames[99]] * 12
    fir = metered(clock.stamps(true_fir), frames)
    assert fir.n_repeats == 12
    found = estimate_clock(rgb, fir, time_constant_s=0)
    assert errors_ms(found, clock, fir)[0] < 5
    assert (
        found.offset_ns + round(LAG * 0.01 * 1e9) == estimate_clock(rgb, fir, time_constant_s=0.01).offset_ns
    )


def test_shifts_are_those_of_the_pictures() -> None:
    path = wobble(4, 5.0)
    true_s = times(20, 2.5)
    frames = list(pictures(path, true_s, 3, thermal=True))
    other = list(pictures(wobble(40, 9.0), true_s, 30, thermal=True))
    for pixels, drawn in zip(frames, other, strict=True):
        pixels[:48, :64] = drawn[:48, :64]  # something moves by itself in a quarter of the picture
    found = metered(Clock().stamps(true_s), frames).shift_px
    # the scene moves against the camera
    assert float(np.median(np.abs(found + np.diff(path(true_s), axis=0)))) < 0.15


def test_a_meter_skips_what_is_no_new_picture() -> None:
    frames = list(pictures(wobble(4), times(20, 0.6), 3, thermal=True))
    meter = MotionMeter()
    for stamp, k in ((10, 0), (20, 0), (30, 1), (25, 2), (40, 3)):
        meter.add(stamp, frames[k])
    meter.add(50, frames[4], repeat=True)
    meter.add(60, np.full_like(frames[0], 7))
    got = meter.motion()
    assert got.stamps_ns.tolist() == [10, 30, 40, 60]
    assert (got.n_repeats, got.n_back) == (2, 1)
    assert np.isnan(got.shift_px).all(1).tolist() == [False, False, True]
    with pytest.raises(ValueError, match="ascending"):
        Motion(np.array([2, 1]), np.zeros((1, 2)))


def test_the_simulated_mine(tmp_path: Path) -> None:
    cv2.setNumThreads(1)
    config = MineConfig.of(
        seed=11,
        duration_s=10.5,
        truth=False,
        scene={"cell_m": 0.3, "machine": False, "person": False, "side_drift": False},
        rgb={"rate_hz": 10, "camera": {"size_wh": [80, 60]}, "shadows": False},
        thermal={
            "rate_hz": 12,
            "camera": {"size_wh": [80, 64]},
            "clock": {"offset_s": 1.7e9 + 0.62, "drift_ppm": 50.0},
            "ffc_interval_s": 5.0,
        },
        lidar={"rate_hz": 0.1, "rings": 16, "columns": 64},
    )
    make_mine(tmp_path / "mine", config)
    motions = {}
    for role in ("rgb", "fir"):
        files = sorted((tmp_path / "mine" / role).iterdir())
        frames = [decode_image(file.read_bytes(), file.name) for file in files]
        motions[role] = metered(np.array([int(file.stem) for file in files]), frames)
    found = estimate_clock(motions["rgb"], motions["fir"])
    assert motions["fir"].n_repeats == len((tmp_path / "mine/truth/freezes.csv").read_text().split()) - 1 > 0
    # 10 s of 80 pixels; the bar is for longer ones and stands in docs/timing.md
    assert errors_ms(found, Clock(0.62, 50e-6), motions["fir"])[0] < 10
