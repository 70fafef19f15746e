"""Frozen frames: every run found, none where a scene merely stands still."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from drawn import Clock, pictures, times, wobble
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from fusion.simulate.mine.config import ThermalConfig
from fusion.simulate.mine.thermal import Shutter
from fusion.timing.freeze import AROUND, FreezeFinder, Run, Step, frozen, frozen_runs, picture_digest, repeats

Frames = Sequence[NDArray[np.uint8] | NDArray[np.uint16]]
STILL = wobble(0, 0.0)


def steps_of(frames: Frames) -> list[Step]:
    finder = FreezeFinder()
    return [finder.add(pixels) for pixels in frames]


def live(length_s: float, seed: int, *, moving: bool = True) -> list[NDArray[np.uint16]]:
    path = wobble(seed, 5.0) if moving else STILL
    made = pictures(path, times(25, length_s), seed, thermal=True, size_wh=(96, 80))
    return [pixels.astype(np.uint16) for pixels in made]


def agc(frames: Frames, seed: int = 0) -> list[NDArray[np.uint8]]:
    """8 bits of the counts' range."""
    low, high = np.percentile(np.stack(frames[:10]), [1, 99])
    return [np.clip((f - low) * (220 / (high - low)) + 15, 0, 255).astype(np.uint8) for f in frames]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("moving", [True, False])
def test_the_shutter_of_the_mine_is_found_exactly(seed: int, moving: bool) -> None:
    true_s = times(25, 7)
    shutter = Shutter.of(ThermalConfig(ffc_interval_s=1.5 + seed, ffc_freeze_s=0.11 * (seed + 1)), seed, 7.0)
    frames = live(7, seed, moving=moving)
    shown = shutter.shown(true_s.tolist())
    seen = [frames[k] for k in shown]
    truth = np.array([k != s for k, s in enumerate(shown)])
    assert truth.sum() > 5
    assert (frozen(steps_of(seen)) == truth).all()
    assert (repeats(map(picture_digest, seen)) == truth).all()
    assert (frozen(steps_of(agc(seen))) == truth).all()


@pytest.mark.parametrize("moving", [True, False])
def test_live_frames_are_not_frozen_in_16_or_8_bits_or_jpeg(moving: bool) -> None:
    frames = live(6, 7, moving=moving)
    assert not frozen(steps_of(frames)).any()
    assert not frozen(steps_of(agc(frames))).any()
    coded = [cv2.imdecode(cv2.imencode(".jpg", f, [1, 90])[1], 0) for f in agc(frames)]
    assert not frozen(steps_of(np.asarray(coded, np.uint8))).any()  # type: ignore[arg-type]


def test_a_flight_that_comes_to_rest_is_not_frozen() -> None:
    frames = live(8, 3)
    rest = list(pictures(STILL, times(25, 3), 3, thermal=True, size_wh=(96, 80)))
    assert not frozen(steps_of([*frames, *rest, *frames])).any()  # type: ignore[list-item]


@pytest.mark.parametrize("share", [0.3, 0.9, 0.98])
def test_clipped_pictures_are_judged_by_what_is_left(share: float) -> None:
    frames = live(6, 5, moving=False)
    level = np.quantile(np.stack(frames[:5]), share)
    clipped = [np.maximum(f, np.uint16(level)) for f in frames]
    clipped[60:66] = [clipped[59]] * 6
    assert frozen_runs(frozen(steps_of(clipped))) == [Run(59, 66)]
    for k, pixels in enumerate(clipped):
        clipped[k] = pixels.copy()
        clipped[k][40, 48] = 9000 + k
    assert frozen_runs(frozen(steps_of(clipped))) == [Run(59, 66)]


def test_flat_frames_repeat_each_other() -> None:
    black = np.zeros((80, 96), np.uint16)
    frames = [*live(1, 1), black, black.copy(), black + np.uint16(9)]
    found = frozen(steps_of(frames))
    assert np.flatnonzero(found).tolist() == [len(frames) - 2]


def test_telemetry_that_counts_on_hides_no_freeze() -> None:
    frames = [f.copy() for f in live(4, 2)]
    frames[40:50] = [frames[39].copy() for _ in range(10)]
    for k, pixels in enumerate(frames):
        pixels[:2] = k * 7 % 1000
        pixels[-1] = k
    assert frozen_runs(repeats(map(picture_digest, frames))) == [Run(39, 50)]
    assert frozen_runs(frozen(steps_of(frames))) == [Run(39, 50)]


@pytest.mark.parametrize("moving", [True, False])
def test_a_repeated_picture_that_was_encoded_again_is_found(moving: bool) -> None:
    frames = agc(live(8, 4, moving=moving))
    frames[120:132] = [frames[119]] * 12
    rng = np.random.default_rng(0)
    coded = []
    for k, pixels in enumerate(frames):
        again = pixels.astype(np.int16)
        again[rng.random(again.shape) < 0.06] += 1  # what a coder leaves differs in few pixels
        again[30:36, 20:60] = 255 * (k % 2)  # and a clock in the picture goes on
        coded.append(np.clip(again, 0, 255).astype(np.uint8))
    steps = steps_of(coded)
    assert not any(step.same for step in steps)
    assert frozen_runs(frozen(steps)) == [Run(119, 132)]


def test_parts_of_a_recording_agree_with_the_whole() -> None:
    frames = live(24, 6)
    frames[310:318] = [frames[309]] * 8
    frames[451] = frames[450]
    steps = steps_of(frames)
    calm = {100, *range(200, 205)}  # a single one is chance
    noisy = [Step(s.same, 0.05 if k in calm else s.changed) for k, s in enumerate(steps)]
    whole = frozen(noisy)
    assert frozen_runs(whole) == [Run(199, 205), Run(309, 318), Run(450, 452)]
    for begin in range(AROUND, 450, 90):
        part = frozen(noisy[begin - AROUND : begin + 90 + AROUND])
        assert (part[AROUND : AROUND + 90] == whole[begin : begin + 90]).all()


@given(st.lists(st.booleans(), max_size=30))
def test_runs_are_those_of_a_loop(flags: list[bool]) -> None:
    flags = [False, *flags]
    runs, first = [], 0
    for k, repeats_it in enumerate([*flags[1:], False], 1):
        if not repeats_it:
            runs.append(Run(first, k))
            first = k
    found = frozen_runs(np.array(flags))
    assert found == [run for run in runs if run.end - run.first >= 2]
    assert frozen_runs(np.array(flags), 4) == [run for run in runs if run.end - run.first >= 4]


def test_digests_tell_shape_and_type_apart_and_few_rows_work() -> None:
    a = np.zeros((4, 6), np.uint16)
    others = [a.reshape(6, 4), a.astype(np.uint8), a + np.uint16(1), np.zeros((4, 12), np.uint8)]
    assert picture_digest(a) not in [picture_digest(np.asarray(o)) for o in others]  # type: ignore[arg-type]
    assert picture_digest(a) == picture_digest(np.zeros((6, 4), np.uint16).T)
    for shape in ((1, 1), (2, 3), (1, 200), (200, 1)):
        rng = np.random.default_rng(1)
        frames = [rng.integers(0, 9999, shape).astype(np.uint16) for _ in range(4)]
        assert not frozen(steps_of(frames)).any()
    with pytest.raises(ValueError, match="H x W"):
        picture_digest(np.zeros(5, np.uint16))


def test_a_change_of_size_begins_anew() -> None:
    steps = steps_of([np.zeros((20, 30), np.uint16), np.zeros((30, 20), np.uint16)])
    assert [step.same for step in steps] == [False, False]
    assert frozen([]).tolist() == []
    assert Clock().stamps(np.array([1.0]))[0] == 1_700_000_001 * 10**9
