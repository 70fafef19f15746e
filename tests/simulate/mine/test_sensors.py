"""The sensors' noise has the size that its parameters say; geometry agrees with analytic worlds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from small_worlds import Line, Room, small

from fusion.errors import UsageError
from fusion.geometry import transform
from fusion.simulate.mine import image_kernels as ik
from fusion.simulate.mine.config import PRESETS, CameraConfig, MineConfig, load_mine_config
from fusion.simulate.mine.lidar import LidarSensor, directions
from fusion.simulate.mine.motion import Clock, instants, mounted, twist
from fusion.simulate.mine.rgb import Viewer, camera_of
from fusion.simulate.mine.textures import cloud_volume
from fusion.simulate.mine.thermal import Shutter, ThermalSensor

VOLUME = cloud_volume(np.random.default_rng(0), 16)
N = 200_000


def rel(sigmas: float, n: int) -> float:
    """A tolerance for a standard deviation: its own is 1 / sqrt(2 n) of it."""
    return sigmas / np.sqrt(2 * n)


# --- configuration


@pytest.mark.parametrize("preset", PRESETS)
def test_config_survives_its_file(tmp_path, preset: str) -> None:
    config = MineConfig.of(preset=preset, seed=7, dust={"visibility_m": 33.0})
    (tmp_path / "mine.toml").write_text(config.toml())
    assert load_mine_config(tmp_path / "mine.toml") == config
    assert load_mine_config(tmp_path / "mine.toml", {"seed": 8}).seed == 8


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"colour": 1}, "colour"),
        ({"rgb": {"expsure_ms": 3}}, "rgb.expsure_ms"),
        ({"rgb": {"camera": {"fov": 3}}}, "rgb.camera.fov"),
        ({"rgb": {"exposure_ms": float("nan")}}, "rgb.exposure_ms"),
        ({"lidar": {"fov_up_deg": -30}}, "fov_down_deg"),
        ({"preset": "foggy"}, "over-exposed"),
        ({"format": "fusion-mine/2"}, "format"),
    ],
)
def test_config_refuses(settings: dict, said: str) -> None:
    with pytest.raises(UsageError, match=said) as caught:
        MineConfig.of(settings)
    assert "\n" not in str(caught.value)


def test_config_file_needs_its_format(tmp_path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("seed = 1")
    with pytest.raises(UsageError, match="fusion-mine/1"):
        load_mine_config(path)
    with pytest.raises(UsageError, match="gone"):
        load_mine_config(tmp_path / "gone.toml")


def test_presets_change_what_they_say_only_by_default() -> None:
    assert MineConfig.of(preset="dark").lamps.intensity < MineConfig().lamps.intensity
    assert MineConfig.of(preset="dark", lamps={"intensity": 50}).lamps.intensity == 50


# --- clocks and motion


def test_clock_goes_there_and_back() -> None:
    clock = Clock(1000.037, 25e-6)
    assert clock.stamp_ns(2.0) == 1_000_037_000_000 + 2_000_050_000
    assert clock.true_s(clock.stamp_ns(123.456)) == pytest.approx(123.456, abs=1e-9)


def test_own_clock_triggers_evenly() -> None:
    clock = Clock(5.0, 200e-6)
    times = instants(clock, 20.0, 0.1, 10.0)
    steps = np.diff([clock.stamp_ns(t) for t in times])
    assert np.abs(steps - 50_000_000).max() <= 1
    assert times[0] == 0.1
    assert times[-1] < 10.0 <= times[-1] + 0.05


def test_mounted_camera_looks_ahead() -> None:
    T = mounted(MineConfig().rgb.mount.model_copy(update={"yaw_pitch_roll_deg": (0, 0, 0)}), camera=True)
    np.testing.assert_allclose(T[:3, :3] @ np.eye(3), [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-15)
    down = MineConfig().rgb.mount.model_copy(update={"yaw_pitch_roll_deg": (0, 10, 0)})
    assert mounted(down, camera=True)[2, 2] < -0.17  # positive pitch: nose down


def test_twist_of_a_turning_flight() -> None:
    mount = mounted(MineConfig().rgb.mount, camera=True)  # 12 cm ahead of the body
    velocity, rate = twist(Line((1.0, 0, 0), turn=0.5), 0.0, mount)
    np.testing.assert_allclose(rate, [0, -0.5, 0], atol=1e-6)  # world's up is the camera's -y
    np.testing.assert_allclose(velocity, [-0.06, 0, 1.0], atol=1e-6)


# --- depth


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_depth_of_a_box_room(yaw: float) -> None:
    config, room = small(), Room()
    viewer = Viewer(camera_of(config.rgb.camera), room)
    T = Line(turn=yaw).pose_at(1.0) @ mounted(config.rgb.mount, camera=True)
    view = viewer.at(T)
    w, h = viewer.camera.size_wh
    uv = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).reshape(-1, 2).astype(float)
    way = viewer.camera.unproject(uv)
    world = way @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        steps = np.where(world > 0, (room.high - T[:3, 3]) / world, (room.low - T[:3, 3]) / world)
    expected = (steps.min(1) * way[:, 2]).reshape(h, w)
    np.testing.assert_allclose(view.z_m, expected, rtol=3e-6)
    np.testing.assert_allclose(view.depth / 256, expected, atol=0.5 / 256 + 1e-4)


def test_depth_is_nothing_where_rays_end_nowhere() -> None:
    room = Room(high=(np.inf, np.inf, np.inf))
    view = Viewer(camera_of(small().rgb.camera), room).at(mounted(small().rgb.mount, camera=True))
    assert (view.depth == 0).any()
    assert np.array_equal(view.depth == 0, view.z_m == 0)


# --- thermal


def thermal(settings: dict, room: Room | None = None) -> tuple[NDArray[Any], NDArray[Any], ThermalSensor]:
    config = small(thermal={**settings, "camera": {"size_wh": (160, 128)}})
    sensor = ThermalSensor(config, room or Room(), VOLUME)
    view = sensor.viewer.at(mounted(config.thermal.mount, camera=True))
    still = np.zeros(3), np.zeros(3)
    counts, kelvin = sensor.picture(view, 3, 0.1, still)
    return counts * config.thermal.kelvin_per_count, kelvin * 0.01, sensor


QUIET = dict.fromkeys(
    (
        "netd_mk",
        "column_pattern_mk",
        "pixel_pattern_mk",
        "pattern_drift_k_per_min",
        "vignetting",
        "blur_px",
        "time_constant_ms",
        "air_extinction_per_m",
        "dust_share",
    ),
    0,
)


def test_ideal_thermal_camera_shows_emitted_and_reflected_heat() -> None:
    seen, surface, _ = thermal({**QUIET, "kelvin_per_count": 0.02})
    warm = surface > 300
    assert 20 < warm.sum() < warm.size / 4
    np.testing.assert_allclose(surface[~warm], 285.15, atol=0.006)
    np.testing.assert_allclose(seen[~warm], 285.15, atol=0.011)
    expected = (0.9 * 313.15**4 + 0.1 * 283.15**4) ** 0.25
    np.testing.assert_allclose(seen[warm], expected, atol=0.011)


def test_netd_is_the_temporal_deviation() -> None:
    config = small(
        thermal={**QUIET, "netd_mk": 80, "kelvin_per_count": 0.02, "camera": {"size_wh": (160, 128)}}
    )
    sensor = ThermalSensor(config, Room(), VOLUME)
    view = sensor.viewer.at(mounted(config.thermal.mount, camera=True))
    still = np.zeros(3), np.zeros(3)
    a, b = (sensor.picture(view, k, 0.1, still)[0] * 0.02 for k in (1, 2))
    assert (a - b).std() / np.sqrt(2) == pytest.approx(np.hypot(0.08, 0.02 / np.sqrt(12)), rel=rel(4, a.size))
    assert np.array_equal(sensor.picture(view, 1, 0.1, still)[0] * 0.02, a)


def test_fixed_pattern_stands_still_and_grows_until_a_correction() -> None:
    settings = {**QUIET, "column_pattern_mk": 60, "pixel_pattern_mk": 40, "pattern_drift_k_per_min": 0.6}
    *_, sensor = thermal({**settings, "ffc_interval_s": 0.8})
    begin = sensor.shutter.begins_s[0]
    fresh, later = sensor.fixed_pattern(begin), sensor.fixed_pattern(begin + 60.0)
    columns = fresh.mean(0)
    assert columns.std() == pytest.approx(0.06, rel=rel(4, fresh.shape[1]) + 0.02)
    assert (fresh - columns).std() == pytest.approx(0.04, rel=rel(4, fresh.size) + 0.02)
    assert np.array_equal(fresh, sensor.fixed_pattern(begin))
    assert later.std() > 4 * fresh.std()
    assert abs(np.corrcoef(fresh.ravel(), sensor.fixed_pattern(begin - 0.01).ravel())[0, 1]) < 0.5


def test_counts_stay_in_14_bits() -> None:
    hot = np.full(8, 900.0, np.float32)
    out, zero = np.empty(8, np.uint16), np.zeros(8, np.float32)
    one = np.ones(8, np.float32)
    ik.count(
        hot, one, zero, np.float32(280), np.float32(0), np.float32(25), ik.normal_table(), np.uint64(1), out
    )
    assert (out == 16383).all()


def test_shutter_repeats_the_frame_before() -> None:
    shutter = Shutter((1.0, 2.5), 0.3)
    times = np.arange(0, 3, 0.1).tolist()
    shown = shutter.shown(times)
    assert shown[9:15] == [9, 9, 9, 9, 13, 14] or shown[9:15] == [9, 9, 9, 12, 13, 14]
    assert [s for s, t in zip(shown, times, strict=True) if t < 0.95] == list(range(10))
    assert Shutter((0.0,), 0.5).shown([0.0, 0.1, 0.6]) == [0, 0, 2]


# --- noise itself


def test_normal_table_is_normal() -> None:
    scipy_stats = pytest.importorskip("scipy.stats")
    table = ik.normal_table()
    assert table.mean(dtype=float) == pytest.approx(0, abs=1e-6)
    assert table.std(dtype=float) == pytest.approx(1, abs=1e-5)
    assert scipy_stats.kstest(table.astype(float), "norm").statistic < 2e-4


def test_keys_differ_by_seed_sensor_and_frame() -> None:
    keys = {int(ik.noise_key(s, a, b)) for s in (0, 1) for a in (1, 2) for b in range(5)}
    assert len(keys) == 20


# --- LiDAR

STILL = {"range_noise_m": 0, "drop_out": 0, "range_10_m": 1e4, "rings": 16, "columns": 128}
NO_DUST = {"visibility_m": 10_000, "lidar_false_share": 0}


def test_directions_go_round_and_up() -> None:
    config = small(lidar=STILL).lidar
    fan = directions(config).reshape(128, 16, 3)
    np.testing.assert_allclose(np.linalg.norm(fan, axis=-1), 1, atol=1e-6)
    assert fan[0, 0, 0] < -0.9
    assert fan[64, 8, 0] > 0.9
    assert fan[1, 0, 1] < 0  # from the back over the right-hand side
    np.testing.assert_allclose(np.degrees(np.arcsin(fan[0, [0, -1], 2])), [-22.5, 22.5], atol=1e-4)


def test_scan_is_taken_column_by_column_from_a_moving_sensor() -> None:
    """Every raw point, put where the sensor was at the point's own instant, lies on a wall of the room."""
    config, room, path = (
        small(lidar=STILL, dust=NO_DUST),
        Room(),
        Line((4.0, 1.0, 0.5), turn=2.0, start=(-1, 0, 0)),
    )
    sensor = LidarSensor(config, room, VOLUME)
    cloud = sensor.scan(path, 0.2, 0)
    assert len(cloud) == 16 * 128
    time_s, ring = cloud.fields["time_s"], cloud.fields["ring"]
    assert np.array_equal(np.unique(ring), np.arange(16))
    assert time_s.max() == pytest.approx(127 / 128 / 10)
    up = np.array([cloud.xyz_m[ring == k, 2].mean() for k in range(16)])
    assert (np.diff(up) > 0).all()
    own_to_true = 1 + config.lidar.clock.drift_ppm * 1e-6
    T = path.pose_at(0.2 + time_s.astype(float) / own_to_true) @ sensor.T_body_lidar
    world = np.einsum("nij,nj->ni", T[:, :3, :3], cloud.xyz_m.astype(float)) + T[:, :3, 3]
    off = np.minimum(np.abs(world - room.low), np.abs(world - room.high)).min(1)
    assert off.max() < 2e-5
    raw = transform(T[0], cloud.xyz_m)  # as if all were taken at once: smeared
    assert np.minimum(np.abs(raw - room.low), np.abs(raw - room.high)).min(1).max() > 0.1


def test_range_noise_has_its_deviation() -> None:
    settings = {**STILL, "columns": 512}
    clean = LidarSensor(small(lidar=settings, dust=NO_DUST), Room(), VOLUME).scan(Line(), 0.1, 0)
    noisy = LidarSensor(small(lidar={**settings, "range_noise_m": 0.03}, dust=NO_DUST), Room(), VOLUME)
    error = np.linalg.norm(noisy.scan(Line(), 0.1, 0).xyz_m, axis=1) - np.linalg.norm(clean.xyz_m, axis=1)
    assert error.std() == pytest.approx(0.03, rel=rel(4, len(error)))
    assert abs(error.mean()) < 4 * 0.03 / np.sqrt(len(error))
    other = noisy.scan(Line(), 0.1, 1)
    assert not np.array_equal(other.xyz_m, noisy.scan(Line(), 0.1, 0).xyz_m)


def test_weak_returns_are_lost_half_of_them_at_the_stated_range() -> None:
    room = Room(low=(-300, -300, -300), high=(300, 300, 300))
    sensor = LidarSensor(
        small(lidar={**STILL, "max_range_m": 1000, "range_10_m": 45.0}, dust=NO_DUST), room, VOLUME
    )
    n = 20_000
    ways = np.tile(np.array([1.0, 0, 0], np.float32), (n, 1))
    rays = np.hstack([np.zeros((n, 3), np.float32), ways])
    hits = room.cast(rays)
    r = np.float32(
        45.0 * np.sqrt(0.5 / 0.1)
    )  # where a target of 50 % reflectance is as weak as one of 10 % at 45 m
    at = type(hits)(np.full(n, r, np.float32), hits.normal, np.zeros(n, np.uint8), hits.printed)
    measured, _ = sensor._measured(at, rays, 0.0, np.random.default_rng(1))
    share = (measured > 0).mean()
    dimmed = np.exp(-2 * 3.912 / 10_000 * r) ** 6
    assert share == pytest.approx(dimmed / (1 + dimmed), abs=4 * np.sqrt(0.25 / n))


def test_dust_returns_lie_in_front_and_grow_with_dust() -> None:
    clean = LidarSensor(small(lidar=STILL, dust=NO_DUST), Room(), VOLUME).scan(Line(), 0.1, 0)
    shares = []
    for visibility in (60.0, 12.0):
        dust = {"visibility_m": visibility, "lidar_false_share": 0.5}
        cloud = LidarSensor(small(lidar=STILL, dust=dust), Room(), VOLUME).scan(Line(), 0.1, 0)
        assert len(cloud) == len(clean)
        nearer = np.linalg.norm(clean.xyz_m, axis=1) - np.linalg.norm(cloud.xyz_m, axis=1)
        assert nearer.min() > -1e-4
        shares.append((nearer > 0.01).mean())
    assert 0 < shares[0] < 0.5 * shares[1]


def test_drop_out_is_its_share() -> None:
    cloud = LidarSensor(small(lidar={**STILL, "drop_out": 0.2}, dust=NO_DUST), Room(), VOLUME).scan(
        Line(), 0.1, 0
    )
    n = 16 * 128
    assert len(cloud) / n == pytest.approx(0.8, abs=4 * np.sqrt(0.16 / n))


def test_distortion_that_folds_is_refused() -> None:
    folded = CameraConfig(size_wh=(64, 48), fov_deg=100, distortion=(-0.8, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(UsageError, match="distortion"):
        Viewer(camera_of(folded), Room())
