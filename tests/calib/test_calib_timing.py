"""Clocks that differ, from a board moved by hand: 30 and 25 images a second, 0.1 px of noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.boards import Board
from calib.moments import Shot, pair
from calib.observations import Detection, Refusal
from calib.rigging import calibrate_rig
from calib.scenes import MODELS, T_RGB_FIR
from calib.solve import exp_motion
from calib.timing import Track, estimate_offset, motion_of, speeds
from fusion.errors import InputError, UsageError
from fusion.geometry import Floats, invert, pose, transform

BOARD = Board.of("chessboard", 5, 4, 0.12)
CAMERAS = {"rgb": MODELS["pinhole5"], "fir": MODELS["thermal5"]}
POSES = {"rgb": np.eye(4), "fir": T_RGB_FIR}
RATES = {"rgb": (30, 0.0), "fir": (25, 0.0113)}


def hand(seed: int) -> Callable[[float], Floats]:
    """A board turned by some 20 degrees and moved by some 20 cm, at up to 0.7 Hz."""
    rng = np.random.default_rng(seed)
    rate, phase = rng.uniform(0.1, 0.7, (6, 4)), rng.uniform(0, 6.28, (6, 4))
    size = np.array([0.25, 0.25, 0.12, 0.15, 0.1, 0.18])[:, None] * rng.uniform(0.5, 1, (6, 4))

    def T_rgb_board(t: float) -> Floats:
        x = (size * np.sin(2 * np.pi * rate * t + phase)).sum(1)
        R = Rotation.from_rotvec(x[:3]).as_matrix()
        return pose(R, x[3:] + np.array([0, 0, 1.2]) - R @ BOARD.points_m.mean(0))

    return T_rgb_board


def record(
    way: Callable[[float], Floats], seconds: float, offset_s: float, drift: float = 0.0
) -> dict[str, list[Shot]]:
    """fir's clock shows `offset_s` less than rgb's, and falls back by `drift`."""
    rng, streams = np.random.default_rng(9), {}
    for name, (rate, phase) in RATES.items():
        shots, camera = [], CAMERAS[name]
        for k in range(int(seconds * rate)):
            t = phase + k / rate
            uv, ok = camera.project(transform(invert(POSES[name]) @ way(t), BOARD.points_m))
            ids = np.flatnonzero(ok & ((uv > 0) & (uv < np.array(camera.size_wh) - 1)).all(1))
            stamp = t - (offset_s + drift * t if name == "fir" else 0)
            noisy = uv[ids] + rng.normal(0, 0.1, (len(ids), 2))
            found = Detection(ids, noisy, "test") if len(ids) > 9 else Refusal("cut")
            shots.append(Shot(f"{k}", f"{name}/{k}", 10**18 + round(stamp * 1e9), camera.size_wh, found))
        streams[name] = shots
    return streams


def track(
    way: Callable[[float], Floats], rate: float, seconds: float, offset_s: float = 0.0, T=None
) -> Track:
    """Exact, seen from a sensor at T_rgb_sensor."""
    t = np.arange(0, seconds, 1 / rate)
    T = np.eye(4) if T is None else T
    return Track(t - offset_s, np.array([invert(T) @ way(s) for s in t]), ())


def test_offset_and_pose_of_two_free_running_cameras():
    offset_s = 0.8  # 0.037 in the next test
    found = solve(record(hand(1), 5, offset_s))
    assert found.estimate.time_offset_s["fir"] == pytest.approx(offset_s, abs=0.0005)  # the gate is 3 ms
    off = found.estimate.T_ref_sensor["fir"] @ invert(T_RGB_FIR)
    assert Rotation.from_matrix(off[:3, :3]).magnitude() < 0.5e-3
    assert np.linalg.norm((found.estimate.T_ref_sensor["fir"] - T_RGB_FIR)[:3, 3]) < 1e-3
    assert found.rms_px("fir") == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
    assert any("moments that the cameras share take part" in note for note in found.notes)


def solve(streams, **options):
    pairing = pair(streams)
    return calibrate_rig(
        BOARD, pairing.views, known=CAMERAS, timing="offset", moment_ns=pairing.moment_ns, **options
    )


def test_labels_turned_at_random_do_not_matter():
    streams, half, rng = record(hand(2), 4, 0.037), BOARD.symmetries()[1], np.random.default_rng(0)
    for name, shots in streams.items():
        streams[name] = [
            replace(s, found=replace(s.found, ids=half[s.found.ids]))
            if isinstance(s.found, Detection) and rng.random() < 0.3
            else s
            for s in shots
        ]
    found = solve(streams).estimate
    assert found.time_offset_s["fir"] == pytest.approx(0.037, abs=0.001)
    assert np.abs(found.T_ref_sensor["fir"] - T_RGB_FIR).max() < 1e-3


@pytest.mark.parametrize("offset_s", [-1.7, 0.004])
def test_correlation_alone_finds_the_offset(offset_s):
    """Exact tracks of two frames, 10 s: the speeds are the same, and so are their peaks."""
    found = estimate_offset(BOARD, track(hand(3), 30, 10), track(hand(3), 25, 10, offset_s, T_RGB_FIR))
    assert found.seconds == pytest.approx(offset_s, abs=0.001)
    assert found.score > 0.99
    assert not found.notes


def test_a_board_that_only_slides_is_enough():
    def slide(t: float) -> Floats:
        return pose(np.eye(3), (0.2 * np.sin(2 * t) + 0.1 * np.sin(3.3 * t), 0.1 * np.cos(t * 1.7), 1.5))

    found = estimate_offset(BOARD, track(slide, 30, 10), track(slide, 25, 10, 0.3, T_RGB_FIR))
    assert found.seconds == pytest.approx(0.3, abs=0.002)


def test_clocks_that_drift_apart_are_noticed():
    a, b = track(hand(4), 30, 16), track(hand(4), 25, 16)
    late = Track(b.time_s * (1 - 1e-3), b.T, ())  # 1 ms a second
    found = estimate_offset(BOARD, a, late)
    assert found.drift == pytest.approx(1e-3, rel=0.2)
    assert "one offset is too few" in found.notes[0]
    steady = estimate_offset(BOARD, a, b)
    assert not steady.notes
    assert abs(steady.drift) < 1e-4


def test_no_motion_no_offset():
    still = hand(1)(0.0)
    with pytest.raises(InputError, match="no offset can be estimated: the board stands still"):
        solve(record(lambda _: still, 2, 0.037))


def test_recordings_of_different_times():
    with pytest.raises(InputError, match=r"no offset within 2 s makes the board move alike"):
        estimate_offset(BOARD, track(hand(1), 30, 10), track(hand(5), 25, 10))
    with pytest.raises(InputError, match=r"no offset within 2 s"):
        estimate_offset(BOARD, track(hand(1), 30, 12), track(hand(1), 25, 12, 3.0))


def test_too_slow_streams_and_streams_without_stamps():
    with pytest.raises(InputError, match=r"followed in 40 images, never for long \(record at 10 images/s"):
        estimate_offset(BOARD, track(hand(1), 30, 10), track(hand(1), 4, 10))
    streams = {c: [replace(s, stamp_ns=None) for s in shots] for c, shots in record(hand(1), 1, 0).items()}
    with pytest.raises(UsageError, match="needs time stamps"):
        solve(streams)


def test_a_steady_motion_is_its_twist():
    """T exp(s twist) by definition; and with a bend, the motion that arrives ahead is not the slope."""
    twist, T = np.array([0.4, -0.3, 0.2, 0.1, -0.2, 0.3]), hand(0)(0.0)
    times = np.arange(30) / 30
    steady = Track(times, T @ exp_motion(times[:, None] * twist), ())
    found, sigma = motion_of(steady, np.array([0.51, 0.02]))
    np.testing.assert_allclose(found[0], twist, atol=1e-6)
    assert sigma[0].max() < 1e-6
    assert np.isnan(found[1]).all()  # too near the beginning
    way = hand(0)
    bent = Track(times, np.array([way(t) for t in times]), ())
    at, ahead = np.array([times[14]]), 0.02
    slope, _ = motion_of(bent, at)
    chord, _ = motion_of(bent, at, ahead)
    there = way(times[14] + ahead)
    missed = [np.abs(way(times[14]) @ exp_motion(ahead * x[0]) - there).max() for x in (slope, chord)]
    assert missed[1] < 0.2 * missed[0]


def test_speeds_are_those_of_the_boards_middle_in_any_frame():
    """Against finite differences of where the middle is, seen from another sensor."""
    way, seen = hand(2), track(hand(2), 30, 2, 0.0, T_RGB_FIR)
    twist, _ = motion_of(seen, seen.time_s[25:26])
    t, middle = seen.time_s[25], BOARD.points_m.mean(0, keepdims=True)
    step = transform(way(t + 1e-4), middle) - transform(way(t - 1e-4), middle)
    turn = Rotation.from_matrix(way(t - 1e-4)[:3, :3].T @ way(t + 1e-4)[:3, :3]).magnitude()
    expected = np.array([turn, np.linalg.norm(step)]) / 2e-4
    np.testing.assert_allclose(speeds(BOARD, twist)[0], expected, rtol=0.01)
