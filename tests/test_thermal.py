"""Windows against numpy, and against what METHOD section 1 and MATLAB's imadjust say."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tomlkit
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from fusion.errors import FrameError, InputError, UsageError
from fusion.frames import Window
from fusion.kernels import index_counts
from fusion.thermal import AUTO, THESIS, Unit, WindowRule, clip_advice, equalise, plan_windows

Read = Callable[[int], NDArray[np.uint16]]


def noise(i: int, *, level: int = 7000, size: tuple[int, int] = (40, 50)) -> NDArray[np.uint16]:
    return np.random.default_rng(i).normal(level, 30, size).astype(np.uint16)


def every_value(dtype: type[np.uint8] | type[np.uint16]) -> NDArray[Any]:
    side = 16 if dtype is np.uint8 else 256
    return np.arange(side * side, dtype=np.uint32).astype(dtype).reshape(side, side)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_thesis_window_is_imadjust_on_every_value(dtype: type[np.uint8] | type[np.uint16]) -> None:
    counts = every_value(dtype)
    window = plan_windows(THESIS, 1, lambda _: counts).window(0, counts)
    top = int(np.iinfo(dtype).max)
    stretched = np.clip((counts / top - 0.3) / (0.6 - 0.3), 0, 1)  # imadjust on [0, 1]
    exact = 255 * stretched
    index, below, above = index_counts(counts, window.lo, window.hi)
    assert np.abs(index - exact).max() <= 0.5 + 1e-9
    assert (below, above) == ((counts < 0.3 * top).sum(), (counts > 0.6 * top).sum())


@given(
    arrays(np.uint16, st.tuples(st.integers(1, 9), st.integers(1, 9))),
    st.floats(0, 99).flatmap(lambda lo: st.tuples(st.just(lo), st.floats(lo, 100))),
)
def test_frame_percentiles_are_numpys(counts: NDArray[np.uint16], limits: tuple[float, float]) -> None:
    lo, hi = limits
    if lo >= hi:
        return
    window = plan_windows(WindowRule(lo, hi, "percentile", "frame"), 1, lambda _: counts).window(0, counts)
    expected = np.percentile(counts.astype(np.float64), [lo, hi])
    if expected[1] - expected[0] < 1e-3:
        middle = expected.mean()
        assert (window.lo, window.hi) == pytest.approx((middle - 0.5, middle + 0.5))
    else:
        assert (window.lo, window.hi) == pytest.approx(tuple(expected), rel=1e-12, abs=1e-6)


def test_auto_pools_32_frames_spread_over_the_sequence() -> None:
    asked: list[int] = []

    def read(i: int) -> NDArray[np.uint16]:
        asked.append(i)
        return noise(i, level=7000 + i)

    plan = plan_windows(AUTO, 320, read)
    assert asked == list(range(5, 320, 10))
    pooled = np.percentile(np.concatenate([noise(i, level=7000 + i).ravel() for i in asked]), [1, 99])
    window = plan.window(17, noise(17))
    assert (window.lo, window.hi) == pytest.approx(tuple(pooled), rel=1e-12)
    assert plan.window(300, noise(3)) == window
    assert plan.record()["sample_frames"] == asked


@pytest.mark.parametrize("count", [1, 5, 32])
def test_auto_reads_all_of_a_short_sequence(count: int) -> None:
    asked: list[int] = []
    plan_windows(AUTO, count, lambda i: asked.append(i) or noise(i))
    assert asked == list(range(count))


def test_fixed_windows_read_nothing() -> None:
    def read(i: int) -> NDArray[np.uint16]:
        raise AssertionError(i)

    assert plan_windows(WindowRule(7000, 7400, "counts"), 9, read).window(3, noise(3)) == Window(7000, 7400)
    rule = WindowRule(20, 36, "celsius", celsius_per_count=0.04, celsius_at_zero=-273.15)
    window = plan_windows(rule, 9, read).window(3, noise(3))
    assert (window.lo, window.hi) == pytest.approx((293.15 / 0.04, 309.15 / 0.04))


def test_unreadable_samples_are_passed_over_and_named() -> None:
    def read(i: int) -> NDArray[np.uint16]:
        if i % 2:
            raise FrameError("half a file", where=f"fir/{i}.png")
        return noise(i)

    plan = plan_windows(AUTO, 6, read)
    assert plan.skipped == ("fir/1.png: half a file", "fir/3.png: half a file", "fir/5.png: half a file")
    assert plan.window(1, noise(1)) == plan_windows(AUTO, 3, lambda i: noise(2 * i)).window(0, noise(0))
    with pytest.raises(InputError, match="none of the 2"):
        plan_windows(AUTO, 2, lambda i: read(2 * i + 1))


def test_types_are_not_mixed() -> None:
    with pytest.raises(InputError, match=r"uint16.*uint8"):
        plan_windows(AUTO, 2, lambda i: noise(i) if i == 0 else every_value(np.uint8))
    plan = plan_windows(AUTO, 2, noise)
    with pytest.raises(FrameError, match="uint8"):
        plan.window(1, every_value(np.uint8))


def blinking(i: int) -> NDArray[np.uint16]:
    """A steady scene in which a hot and a cold plate come and go from one frame to the next."""
    counts = noise(0).copy()
    if i % 2:
        counts[:10], counts[-10:] = 8000, 6000
    return counts


def largest_step(rule: WindowRule, read: Read, count: int = 101) -> float:
    plan = plan_windows(rule, count, read)
    windows = [plan.window(i, read(i)) for i in range(count)]
    return float(np.abs(np.diff([(w.lo, w.hi) for w in windows], axis=0)).max())


def test_a_running_window_does_not_flicker() -> None:
    """Key values alternate by 1000 counts; smoothed, all lie in the middle, but the ends: 250 away."""

    def irregular(i: int) -> NDArray[np.uint16]:
        return blinking(i // 10 if i % 10 == 0 else i)  # key frames, too, are now hot and now not

    spread = 1000
    assert largest_step(WindowRule(1, 99, "percentile", "frame"), irregular) > 0.9 * spread
    assert 0 < largest_step(WindowRule(1, 99, "percentile", "running"), irregular) <= 0.03 * spread
    assert largest_step(WindowRule(1, 99, "percentile", "sequence"), irregular) == 0


def test_a_running_window_follows_a_drift_and_rests_on_a_constant() -> None:
    running = WindowRule(1, 99, "percentile", "running")
    drift = plan_windows(running, 201, lambda i: noise(0, level=7000 + 5 * i))
    assert drift.window(100, noise(0)).lo - drift.window(50, noise(0)).lo == pytest.approx(250, abs=1)
    steady = plan_windows(running, 47, lambda _: noise(0))
    windows = {steady.window(i, noise(0)) for i in range(47)}
    assert len(windows) == 1


@pytest.mark.parametrize("count", [1, 2, 9, 10, 11, 14, 15, 16, 31])
def test_a_running_window_is_the_same_in_any_order(count: int) -> None:
    rule = WindowRule(2, 98, "percentile", "running")
    plan = plan_windows(rule, count, lambda i: noise(i, level=7000 + 20 * i))
    forward = [plan.window(i, noise(i)) for i in range(count)]
    assert [plan.window(i, noise(i)) for i in reversed(range(count))] == forward[::-1]
    assert all(window.lo < window.hi for window in forward)


@pytest.mark.parametrize(
    ("limits", "named"),
    [
        ((0.6, 0.3), "--window"),
        ((0.3, 0.3), "--window"),
        ((-0.1, 0.5), "--window"),
        ((0.3, 1.2), "--window"),
        ((float("nan"), 0.5), "--window"),
        ((0, float("inf"), "counts"), "--window"),
        ((70000, 80000, "counts"), "16-bit"),
        ((5, 101, "percentile"), "--window"),
        ((20, 30, "celsius"), "--celsius-per-count"),
        ((0.1, 0.2, "kelvin"), "--window-unit"),
        ((0.1, 0.2, "fraction", "frame"), "--window-over"),
        ((-300, 20, "celsius", "sequence", 0.04, -273.15), "-273.15"),
        ((20, 30, "celsius", "sequence", 0.0, -273.15), "--celsius-per-count"),
    ],
)
def test_windows_that_cannot_be_meant_name_the_option(limits: tuple[float, ...], named: str) -> None:
    with pytest.raises(UsageError) as refusal:
        WindowRule(*limits)  # type: ignore[arg-type]
    assert named in str(refusal.value)


def test_a_window_outside_the_type_is_the_frames_fault() -> None:
    plan = plan_windows(WindowRule(7000, 7400, "counts"), 1, noise)
    with pytest.raises(FrameError, match="uint8"):
        plan.window(0, every_value(np.uint8))


def test_clahe_raises_local_contrast_and_leaves_its_input_alone() -> None:
    rng = np.random.default_rng(0)
    dim = np.hstack([rng.integers(40, 60, (64, 64)), rng.integers(180, 200, (64, 64))]).astype(np.uint8)
    before = dim.copy()
    equal = equalise(dim, 4.0)
    assert np.array_equal(dim, before)
    assert equal[:, :48].std() > 1.5 * dim[:, :48].std()
    assert np.array_equal(equal, equalise(dim, 4.0))
    with pytest.raises(UsageError, match="--clahe"):
        equalise(dim, 0)


def test_advice_comes_above_a_third_and_names_a_better_option() -> None:
    assert clip_advice(0.2, 0.13, THESIS) is None
    advice = clip_advice(0.9, 0.05, THESIS)
    assert advice is not None
    assert "95%" in advice
    assert "--preset auto" in advice
    narrow = clip_advice(0.3, 0.3, WindowRule(30, 70, "percentile"))
    assert narrow is not None
    assert "--window 1 99 --window-unit percentile" in narrow


def level_change(i: int) -> NDArray[np.uint16]:
    """Flat frames, 7000 counts before frame 40 and 8000 from there on."""
    return np.full((2, 2), 7000 if i < 40 else 8000, np.uint16)


def key_twin(count: int, read: Read, i: int) -> tuple[float, float]:
    """A running 1..99 window in numpy alone: keys, smoothing as a convolution, linear in between."""
    keys = [k for k in range(0, count, 10) if k == 0 or count - 1 - k >= 5 or k == count - 1]
    keys = keys if keys[-1] == count - 1 else [*keys, count - 1]
    limits = np.array([np.percentile(read(k), [1, 99]) for k in keys])
    smooth = [np.convolve(np.pad(side, 1, "edge"), [0.25, 0.5, 0.25], "valid") for side in limits.T]
    return float(np.interp(i, keys, smooth[0])), float(np.interp(i, keys, smooth[1]))


@pytest.mark.parametrize("count", [1, 3, 6, 11, 14, 16, 41, 58])
def test_a_running_window_is_its_numpy_twin(count: int) -> None:
    def read(i: int) -> NDArray[np.uint16]:
        return noise(i, level=7000 + i * i)

    plan = plan_windows(WindowRule(1, 99, "percentile", "running"), count, read)
    for i in range(count):
        window = plan.window(i, noise(0))
        assert (window.lo, window.hi) == pytest.approx(key_twin(count, read, i), rel=1e-12)


@pytest.mark.parametrize("count", [42, 43, 44, 45, 46, 51])
def test_a_jump_near_the_end_moves_a_running_window_by_a_tenth_at_most(count: int) -> None:
    """Half the spread between two smoothed keys, and keys at least five frames apart: 1000 / 2 / 5."""
    assert 0 < largest_step(WindowRule(1, 99, "percentile", "running"), level_change, count) <= 100 + 1e-9


def test_unreadable_key_frames_leave_their_neighbours_in_charge() -> None:
    def read(i: int) -> NDArray[np.uint16]:
        if i in (0, 20, 40):
            raise FrameError("half a file", where=f"fir/{i}.png")
        return noise(i, level=7000 + 10 * i)

    plan = plan_windows(WindowRule(1, 99, "percentile", "running"), 41, read)
    assert plan.keys == plan.samples == (10, 30)
    assert plan.window(0, noise(0)) == plan.window(10, noise(0))
    assert plan.window(40, noise(0)) == plan.window(30, noise(0))
    assert plan.window(10, noise(0)).lo < plan.window(20, noise(0)).lo < plan.window(30, noise(0)).lo
    assert len(plan.skipped) == 3


def test_a_flat_sequence_gets_one_count_around_its_value() -> None:
    flat = np.full((4, 4), 7000, np.uint16)
    for over in ("frame", "sequence", "running"):
        plan = plan_windows(WindowRule(1, 99, "percentile", over), 3, lambda _: flat)
        assert plan.window(1, flat) == Window(6999.5, 7000.5)


def test_pixels_that_are_no_counts_are_passed_over_by_planning_and_refused_by_the_frame() -> None:
    wrong = [np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.float32), np.zeros((0, 4), np.uint8)]
    plan = plan_windows(AUTO, 4, lambda i: wrong[i] if i < 3 else noise(i))  # type: ignore[arg-type]
    assert plan.samples == (3,)
    assert len(plan.skipped) == 3
    for pixels in wrong:
        with pytest.raises(FrameError, match="frame 7: expected HxW uint8 or uint16"):
            plan_windows(THESIS, 9, noise).window(7, pixels)  # type: ignore[arg-type]


@pytest.mark.parametrize("rule", [THESIS, AUTO, WindowRule(1, 99, "percentile", "frame")])
def test_no_frames_is_an_input_error(rule: WindowRule) -> None:
    with pytest.raises(InputError, match="no thermal frames"):
        plan_windows(rule, 0, noise)


@pytest.mark.parametrize(
    ("lo", "hi", "unit", "said"),
    [
        (0.3, 0.3 + 1e-15, "fraction", "too narrow"),  # the same number once scaled to counts
        (7000, 7000 + 1e-9, "counts", "too narrow"),
        (-1e308, 1e308, "counts", "out of reach"),  # its width is infinite
        (-9, 0, "counts", "out of reach"),
    ],
)
def test_windows_that_break_arithmetic_are_refused(lo: float, hi: float, unit: Unit, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        WindowRule(lo, hi, unit)


def test_the_record_repeats_the_plan_and_survives_toml() -> None:
    running = WindowRule(2, 98, "percentile", "running")
    celsius = WindowRule(20, 36, "celsius", celsius_per_count=0.04, celsius_at_zero=-273.15)
    for rule in (THESIS, AUTO, running, celsius):
        plan = plan_windows(rule, 25, lambda i: noise(i, level=7000 + 9 * i))
        record = plan.record()
        assert tomllib.loads(tomlkit.dumps(record)) == record
        stated = {name: record[name] for name in WindowRule.__dataclass_fields__ if name in record}
        assert WindowRule(**stated) == rule  # type: ignore[arg-type]
    record = plan_windows(running, 25, lambda i: noise(i, level=7000 + 9 * i)).record()
    assert record["key_frames"] == record["sample_frames"] == [0, 10, 24]
    assert record["dtype"] == "uint16"
    plan = plan_windows(running, 25, lambda i: noise(i, level=7000 + 9 * i))
    for name, side in (("key_lo_counts", "lo"), ("key_hi_counts", "hi")):
        assert record[name] == [getattr(plan.window(i, noise(0)), side) for i in (0, 10, 24)]


def test_clahe_works_in_tiles_and_refuses_absurd_ones() -> None:
    ramp = np.tile(np.arange(128, dtype=np.uint8), (128, 1))
    assert not np.array_equal(equalise(ramp, 4.0, tiles=1), equalise(ramp, 4.0, tiles=8))
    assert equalise(np.zeros((1, 3), np.uint8), 2.0).shape == (1, 3)
    for limit, tiles in ((float("nan"), 8), (-1.0, 8), (2.0, 0), (2.0, 65)):
        with pytest.raises(UsageError, match="--clahe"):
            equalise(ramp, limit, tiles)


def test_clahe_from_several_threads_is_clahe() -> None:
    images = [np.random.default_rng(i).integers(0, 256, (60, 80), dtype=np.uint8) for i in range(24)]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda image: equalise(image, 3.0), images))
    assert all(np.array_equal(a, equalise(b, 3.0)) for a, b in zip(together, images, strict=True))


@pytest.mark.parametrize(
    ("rule", "option"),
    [
        (WindowRule(7000, 7010, "counts"), "--preset auto"),
        (AUTO, "--window-over running"),
        (WindowRule(1, 99, "percentile", "running"), "--window-over frame"),
    ],
)
def test_advice_never_names_what_is_already_in_use(rule: WindowRule, option: str) -> None:
    assert clip_advice(1 / 3, 0.0, rule) is None
    advice = clip_advice(0.2, 0.14, rule)
    assert advice is not None
    assert option in advice
    assert (rule.unit == "percentile") != ("--preset auto" in advice)


def test_presets_on_real_pairs(shared_data: Path) -> None:
    """METHOD section 1's remark: the thesis's constants clip most of MSRS, the default next to none."""
    files = sorted((shared_data / "rgbt_pairs" / "MSRS" / "ir").glob("*.png"))
    assert files
    frames = [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files]
    for rule, least, most in ((THESIS, 0.5, 1.0), (AUTO, 0.0, 0.05)):
        plan = plan_windows(rule, len(frames), lambda i: frames[i])  # type: ignore[arg-type, return-value]
        for i, counts in enumerate(frames):
            assert counts is not None
            window = plan.window(i, counts)  # type: ignore[arg-type]
            clipped = float(((counts < window.lo) | (counts > window.hi)).mean())
            assert least <= clipped <= most
