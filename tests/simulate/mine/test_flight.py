"""The flight is smooth, its derivatives are its derivatives, and it keeps clear of everything."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion.errors import UsageError
from fusion.simulate.mine.course import Plan
from fusion.simulate.mine.flight import LEAD_S, Flight
from fusion.simulate.mine.scene import build_scene, free_radius
from fusion.simulate.mine.scene_config import FlightConfig, SceneConfig

SCENE = SceneConfig(cell_m=0.3, length_m=60)
WILD = FlightConfig(speed_m_s=2.0, sway_m=0.3, tilt_deg=20, yaw_deg=35, turbulence=1, jerks_per_s=1.0)
CONFIGS = [FlightConfig(), WILD, FlightConfig(speed_m_s=1.0, turbulence=0, jerks_per_s=0)]


@lru_cache
def line() -> NDArray[np.float64]:
    return Plan.of(SceneConfig()).main.at(np.arange(2.5, 68, 0.25), 0, 1.5)


def times(flight: Flight, n: int = 1501) -> NDArray[np.float64]:
    return np.linspace(0, flight.duration_s, n)


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize("seed", [0, 5])
def test_velocities_are_the_derivatives_of_the_poses(config: FlightConfig, seed: int) -> None:
    flight, h = Flight(config, line(), seed), 1e-4
    t = times(flight)
    before, after = flight.pose_at(t - h), flight.pose_at(t + h)
    np.testing.assert_allclose((after - before)[:, :3, 3] / (2 * h), flight.velocity_at(t), atol=1e-5)
    turned = Rotation.from_matrix(before[:, :3, :3]).inv() * Rotation.from_matrix(after[:, :3, :3])
    np.testing.assert_allclose(turned.as_rotvec() / (2 * h), flight.angular_velocity_at(t), atol=1e-4)


@pytest.mark.parametrize("config", CONFIGS)
def test_accelerations_do_not_jump(config: FlightConfig) -> None:
    flight, h = Flight(config, line(), 1), 1e-3
    t = np.arange(0, min(flight.duration_s, 20), h)
    for rate in (flight.velocity_at, flight.angular_velocity_at):
        acceleration = np.diff(rate(t), axis=0) / h
        jump = np.abs(np.diff(acceleration, axis=0)).max()
        assert jump < 0.02 * max(np.abs(acceleration).max(), 1.0)


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize("seed", [0, 3])
def test_speeds_and_rates_stay_within_the_options(config: FlightConfig, seed: int) -> None:
    flight = Flight(config, line(), seed)
    t = np.linspace(-LEAD_S, flight.duration_s + LEAD_S, 8001)
    rate = np.rad2deg(np.linalg.norm(flight.angular_velocity_at(t), axis=1))
    assert rate.max() <= config.max_rate_deg_s
    off = flight.pose_at(t)[:, :3, 3]
    nearest = np.linalg.norm(off[::50, None] - line()[None], axis=2).min(1)
    assert nearest.max() < 1.3 * config.sway_m + 0.2
    along = np.linalg.norm(flight.velocity_at(t), axis=1)
    assert 0.6 * config.speed_m_s < along.min()
    assert abs(along.mean() / config.speed_m_s - 1) < 0.25


def test_a_low_limit_calms_the_drone_and_does_not_stop_it() -> None:
    calm = Flight(WILD.model_copy(update={"max_rate_deg_s": 30.0}), line(), 2)
    t = times(calm)
    rate = np.rad2deg(np.linalg.norm(calm.angular_velocity_at(t), axis=1))
    assert 25 < rate.max() <= 30


def test_attitude_is_jerky() -> None:
    quiet = FlightConfig(tilt_deg=0, yaw_deg=0, turbulence=0, jerks_per_s=0)
    rates = [
        Flight(c, line(), 3).angular_velocity_at(np.linspace(0, 25, 2501)) for c in (quiet, FlightConfig())
    ]
    most = [np.rad2deg(np.linalg.norm(rate, axis=1)).max() for rate in rates]
    assert most[0] < 15  # the bend only
    assert most[1] > 35


def test_poses_are_rigid_and_upright() -> None:
    flight = Flight(WILD, line(), 4)
    T = flight.pose_at(times(flight))
    R = T[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1)
    np.testing.assert_array_equal(T[:, 3], np.broadcast_to((0, 0, 0, 1), (len(T), 4)))
    assert R[:, 2, 2].min() > 0.5
    ahead = flight.velocity_at(times(flight))
    assert (np.einsum("ij,ij->i", R[:, :, 0], ahead) > 0).all()


def test_one_time_gives_one_pose() -> None:
    flight = Flight(FlightConfig(), line(), 4)
    assert flight.pose_at(1.0).shape == (4, 4)
    assert flight.velocity_at(1.0).shape == flight.angular_velocity_at(np.float64(1)).shape == (3,)
    np.testing.assert_array_equal(flight.pose_at([1.0, 2.0])[0], flight.pose_at(1.0))


def test_outside_the_flight_is_an_error() -> None:
    flight = Flight(FlightConfig(), line(), 4)
    flight.pose_at([-LEAD_S, flight.duration_s + LEAD_S])
    for t in (-LEAD_S - 0.01, flight.duration_s + LEAD_S + 0.01, np.nan):
        with pytest.raises(ValueError, match="expected times"):
            flight.pose_at(t)


def test_what_cannot_be_flown_says_so() -> None:
    with pytest.raises(UsageError, match="too short"):
        Flight(FlightConfig(speed_m_s=2), line()[:12], 0)
    with pytest.raises(UsageError, match="turns faster"):
        Flight(FlightConfig(speed_m_s=8, max_rate_deg_s=5), line(), 0)
    with pytest.raises(ValueError, match="finite points"):
        Flight(FlightConfig(), np.full((20, 3), np.nan), 0)


def test_the_same_seed_flies_the_same() -> None:
    a, b, c = (Flight(FlightConfig(), line(), seed).pose_at(np.linspace(0, 20, 50)) for seed in (9, 9, 10))
    assert a.tobytes() == b.tobytes()
    assert np.abs(a - c).max() > 0.05


def test_the_drone_keeps_clear_and_passes_everything() -> None:
    scene = build_scene(SCENE, 11)
    for config in CONFIGS:
        flight = Flight(config, scene.centre_line, 11)
        path = flight.pose_at(np.arange(0, flight.duration_s, 0.5))[:, :3, 3]
        assert free_radius(scene.caster, path).min() > 0.4
        soon = path[: round(60 / config.speed_m_s)]  # 30 m
        for name in ("person", "machine"):
            assert np.linalg.norm(soon - scene.objects[name].centre, axis=1).min() < 3.2
