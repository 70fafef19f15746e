"""Light from lamps, rock and dust to the picture: against laws, and numpy twins of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from small_worlds import Line, Room, small

from fusion.simulate.mine import image_kernels as ik
from fusion.simulate.mine.lights import Lights
from fusion.simulate.mine.motion import mounted
from fusion.simulate.mine.rgb import RgbSensor, Viewer, camera_of, tone_curve
from fusion.simulate.mine.textures import cloud_volume, rock_tile

VOLUME = cloud_volume(np.random.default_rng(0), 16)
N = 200_000


def rel(sigmas: float, n: int) -> float:
    """A tolerance for a standard deviation: its own is 1 / sqrt(2 n) of it."""
    return sigmas / np.sqrt(2 * n)


def linear(bgr: NDArray[np.uint8], gain: float) -> NDArray[np.float64]:
    """Electrons of 8-bit values: the middle of the counts that the tone curve joins."""
    curve = tone_curve()
    return np.array([gain * (np.flatnonzero(curve == value).mean()) for value in bgr.ravel()])


@pytest.mark.parametrize(("e", "gain", "read"), [(3000.0, 2.44, 6.0), (400.0, 0.5, 8.0)])
def test_photon_noise_has_its_variance(e: float, gain: float, read: float) -> None:
    n = N // 3
    out = np.empty((n, 3), np.uint8)
    curve = np.arange(4096, dtype=np.uint16)  # counts as they are
    wide = np.empty((n, 3), np.uint16)
    args = np.full((n, 3), 1.0, np.float32), np.full(n, e, np.float32)
    rest = np.float32(gain), np.float32(1e4), np.float32(read), ik.normal_table(), np.uint64(5)
    ik.develop(*args, *rest, curve, wide)
    measured = np.asarray(wide.astype(float) * gain)
    variance = e + read**2 + gain**2 / 12  # photons, read-out, steps of the converter (EMVA 1288)
    assert measured.mean() == pytest.approx(e, abs=4 * np.sqrt(variance / N))
    assert measured.var() == pytest.approx(variance, rel=2 * rel(4, N))
    channels = wide.astype(float).T
    assert abs(np.corrcoef(channels)[0, 1]) < 4 / np.sqrt(n)
    ik.develop(*args, *rest, tone_curve(), out)
    assert linear(out[:300], gain).mean() == pytest.approx(e, rel=0.03)


def test_full_well_and_converter_clip() -> None:
    bright, out = np.full((64, 3), 1e6, np.float32), np.empty((64, 3), np.uint8)
    one = np.ones(64, np.float32)
    rest = np.float32(0), ik.normal_table(), np.uint64(1), tone_curve(), out
    ik.develop(bright, one, np.float32(2.44), np.float32(1e4), *rest)
    assert (out > 250).all()
    ik.develop(bright, one, np.float32(2.44), np.float32(100.0), *rest)
    assert (out < 60).all()


def test_tone_curve_is_srgb() -> None:
    curve = tone_curve()
    assert (curve[0], curve[-1]) == (0, 255)
    assert curve[round(0.2140 * 4095)] == pytest.approx(128, abs=1)  # the middle grey of IEC 61966-2-1
    assert (np.diff(curve.astype(int)) >= 0).all()


def radiance(room: Room, **groups: Any) -> NDArray[np.float32]:
    config = small(**groups)
    sensor = RgbSensor(config, room, VOLUME)
    T = Line().pose_at(0.0)
    T_rgb = T @ mounted(config.rgb.mount, camera=True)
    return sensor._radiance(sensor.viewer.at(T_rgb), 0.0, T, T_rgb)


CLEAR = {"visibility_m": 10_000, "particles": 0}


def test_lamp_light_falls_with_the_square_of_distance() -> None:
    lamps = {"bounce": 0, "spill": 1.0, "positions_m": ((0.12, 0, 0),), "colour_bgr": (1, 1, 1)}
    near, far = (
        radiance(Room(high=(x + 0.12, 50, 50), low=(-1, -50, -50)), dust=CLEAR, lamps=lamps) for x in (3, 6)
    )
    middle = near[24, 32, 1], far[24, 32, 1]
    assert middle[0] / middle[1] == pytest.approx(4, rel=0.01)
    cosine = camera_of(small().rgb.camera).unproject(np.array([[32.0, 24.0]]))[0, 2]
    assert middle[0] == pytest.approx(
        0.2 / np.pi * 100 / 9 * cosine**3, rel=0.005
    )  # albedo / pi * I cos / r^2


def test_dust_veils_and_scatters_back() -> None:
    room = Room(high=(60, 30, 30), low=(-1, -30, -30))
    clear, dusty = (
        radiance(room, dust={"particles": 0, "patchiness": 0, "visibility_m": v}) for v in (9000.0, 15.0)
    )
    assert dusty.mean() > 20 * clear.mean()  # nothing is lit at 60 m but the dust
    near = Room(high=(3, 50, 50), low=(-1, -50, -50))
    dark = {"intensity": 0.0}
    assert radiance(near, dust={"particles": 0, "visibility_m": 15.0}, lamps=dark).max() == 0
    lit = {"bounce": 0.0, "spill": 1.0}
    no_scatter = {"albedo_bgr": (0, 0, 0), "particles": 0, "patchiness": 0}
    ratio = radiance(near, dust={**no_scatter, "visibility_m": 15.0}, lamps=lit)[24, 32]
    ratio /= radiance(near, dust={**no_scatter, "visibility_m": 10_000.0}, lamps=lit)[24, 32]
    there_and_back = 3.912 / 15 * (2 * 2.88 - 0.35)  # the first 35 cm before the lens are left out
    np.testing.assert_allclose(ratio, np.exp(-there_and_back), rtol=0.03)


def test_motion_blurs_along_the_way_only() -> None:
    image = np.zeros((40, 60, 3), np.float32)
    image[20, 30] = 1.0
    z = np.full((40, 60), 2.0, np.float32)
    numbers = [np.float32(x) for x in (50, 50, 29.5, 19.5)]
    moving = np.array([1.0, 0, 0], np.float32), np.zeros(3, np.float32)
    out = np.empty_like(image)
    ik.gather(image, z, *numbers, *moving, np.float32(0.4), 40, out)  # 50 * 1 / 2 * 0.4 = 10 px
    row = out[20, :, 0]
    assert out[np.arange(40) != 20].max() == 0
    assert np.count_nonzero(row) == pytest.approx(10, abs=2)
    assert np.average(np.arange(60), weights=row) == pytest.approx(30, abs=0.6)
    ik.gather(image, z, *numbers, moving[1], moving[1], np.float32(0.4), 40, out)
    assert np.array_equal(out, image)


def test_bolometer_lags_behind() -> None:
    """The camera moves right, the picture moves left: what was warm leaves its trail on the right."""
    image = np.zeros((40, 60), np.float32)
    image[20, 30] = 1.0
    z = np.full((40, 60), 2.0, np.float32)
    numbers = [np.float32(x) for x in (50, 50, 29.5, 19.5)]
    out, still = np.empty_like(image), np.zeros(3, np.float32)
    right = np.array([1.0, 0, 0], np.float32)
    ik.lag(image, z, *numbers, right, still, np.float32(0.16), ik.exponential_ages(48), out)  # tau is 4 px
    row = out[20]
    assert row[:30].max() == 0
    assert row.sum() == pytest.approx(1, abs=0.35)
    assert np.average(np.arange(60), weights=row) - 30 == pytest.approx(4, abs=1.0)


def test_exponential_ages_have_mean_one() -> None:
    ages = ik.exponential_ages(48)
    assert ages[48].mean() == pytest.approx(1, abs=0.02)
    assert (np.diff(ages[48]) > 0).all()


def test_texture_has_unit_deviation_and_repeats() -> None:
    tile = rock_tile(np.random.default_rng(1), 64)
    top = tile.samples[: 64 * 64].reshape(64, 64, 4)
    np.testing.assert_allclose(top.std((0, 1)), 1, rtol=1e-3)
    seam = np.abs(top[0] - top[-1]).mean((0, 1)) / np.abs(np.diff(top, axis=0)).mean((0, 1, 2))
    assert seam < 1.5
    assert tile.levels.tolist()[:2] == [[0, 64], [4096, 32]]


def moved_px(K: list[Any], z_m: float, velocity: Any, rate: Any, span_s: float) -> NDArray[Any]:
    """Twin: how far still points at depth `z_m` move in the picture (40 x 60 x 2), by a small step."""
    fx, fy, cx, cy = (float(x) for x in K)
    c, r = np.meshgrid(np.arange(60), np.arange(40))
    xyz = np.stack([(c - cx) / fx, (r - cy) / fy, np.ones_like(c)], -1) * z_m
    step = 1e-5
    after = xyz - step * (velocity + np.cross(rate, xyz))
    there = np.stack([fx * after[..., 0] / after[..., 2] + cx, fy * after[..., 1] / after[..., 2] + cy], -1)
    return (there - np.stack([c, r], -1)) / step * span_s


@pytest.mark.parametrize("seed", range(4))
def test_blur_and_lag_follow_the_projected_motion(seed: int) -> None:
    """On a ramp the lag is the mean way itself; on its square the blur adds way^2 / 12."""
    rng = np.random.default_rng(seed)
    velocity, rate = rng.normal(0, 1.0, 3), rng.normal(0, 1.0, 3)
    K = [np.float32(x) for x in (50, 55, 28.5, 21.5)]
    z, inner = np.full((40, 60), 2.0, np.float32), (slice(18, 22), slice(27, 33))
    way = moved_px(K, 2.0, velocity, rate, 0.05)
    assert 1 < np.abs(way[inner]).max() < 12
    ramps = [np.array(a, np.float32) for a in np.meshgrid(np.arange(60), np.arange(40))]
    rest = z, *K, velocity.astype(np.float32), rate.astype(np.float32), np.float32(0.05)
    for axis, ramp in enumerate(ramps):
        out = np.empty_like(ramp)
        ik.lag(ramp, *rest, ik.exponential_ages(48), out)
        assert np.abs(out - ramp - way[..., axis])[inner].max() < 0.35 + 0.1 * np.abs(way[inner]).max()
        for at in ((20, 30), (12, 47), (27, 14)):
            square = np.repeat(((ramp - ramp[at]) ** 2)[..., None], 3, -1)
            blurred = np.empty((40, 60, 3), np.float32)
            ik.gather(square, *rest, 40, blurred)
            expected = way[at][axis] ** 2 / 12
            assert blurred[at][1] == pytest.approx(expected, abs=0.4 + 0.15 * expected)


def test_turning_moves_what_is_far_as_well() -> None:
    """Depth 0 stands for nothing met: only turning moves it; about the axis ahead, in circles."""
    K = [np.float32(x) for x in (50, 50, 29.5, 19.5)]
    ramp = np.array(np.meshgrid(np.arange(60), np.arange(40))[0], np.float32)
    roll, forward = np.array([0, 0, 2.0], np.float32), np.array([0, 0, 5.0], np.float32)
    z, out = np.zeros((40, 60), np.float32), np.empty((40, 60), np.float32)
    ik.lag(ramp, z, *K, forward, roll, np.float32(0.1), ik.exponential_ages(48), out)
    for row in (9, 30):
        assert out[row, 30] - ramp[row, 30] == pytest.approx(2.0 * 0.1 * (row - 19.5), abs=0.5)


def test_light_scattered_once_is_the_integral_along_the_ray() -> None:
    """Twin: a fine sum along the ray of one pixel, from where scattering is counted to its end."""
    room, sigma, g = Room(low=(-np.inf,) * 3, high=(np.inf,) * 3), 3.912 / 20, 0.3
    lamp = np.array([0.14, 0.5, -0.2])
    lamps = {"positions_m": (lamp.tolist(),), "spill": 1.0, "colour_bgr": (1, 1, 1), "intensity": 10.0}
    dust = {"visibility_m": 20, "patchiness": 0, "particles": 0, "albedo_bgr": (0.5, 0.8, 1.0), "forward": g}
    seen = radiance(room, dust=dust, lamps=lamps)[24, 32]
    pixel = camera_of(small().rgb.camera).unproject(np.array([[32.0, 24.0]]))[0]
    way = mounted(small().rgb.mount, camera=True)[:3, :3] @ pixel
    edges = np.geomspace(0.35, 60, 20_001)
    s, ds = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    at = np.array([0.12, 0, 0]) + s[:, None] * way
    d = np.linalg.norm(at - lamp, axis=1)
    cosine = ((at - lamp) / d[:, None]) @ -way  # of the angle by which light is turned
    phase = (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)
    light = 10.0 / d**2 * np.exp(-sigma * d) * phase * sigma * np.exp(-sigma * (s - 0.35))
    np.testing.assert_allclose(seen, (light * ds).sum() * np.array([0.5, 0.8, 1.0]), rtol=0.08)


def test_head_lamps_turn_with_the_drone() -> None:
    config = small(lamps={"positions_m": ((0.2, 0.1, 0.0),), "pitch_deg": 0, "toe_out_deg": 0}).lamps
    T_world_body = Line((1, 0, 0), turn=np.pi / 2).pose_at(1.0)  # at x = 1, facing y
    (row,) = Lights(config, Room(), shadows=False).at(T_world_body)
    np.testing.assert_allclose(row[:6], [0.9, 0.2, 0, 0, 1, 0], atol=1e-6)


class LampRoom(Room):
    """A lamp before a screen that shades all of the far wall from it."""

    lamps = np.array([[1.0, 2.5, 0.0]])
    lamp_bgr = np.array([[20.0, 20.0, 20.0]])


def test_scene_lamps_cast_shadows() -> None:
    room = LampRoom(screen=3.0)
    dark = {"intensity": 0.0, "bounce": 0.0}
    shadowed, lit = (
        radiance(room, dust=CLEAR, lamps=dark, rgb={"shadows": s})[..., 1] for s in (True, False)
    )
    mount = small().rgb.mount
    view = Viewer(camera_of(small().rgb.camera), room).at(mounted(mount, camera=True))
    x = (view.rays[:, 0] + view.hits.range_m * view.rays[:, 3]).reshape(shadowed.shape)
    far, screen = x > 8.9, np.abs(x - 3) < 0.01
    assert far.sum() > 50
    assert lit[far].min() > 10 * shadowed[far].max()
    same = np.abs(shadowed[screen] - lit[screen]) < 0.01 * lit[screen]
    assert same.mean() > 0.98  # but for the screen's own rim


@pytest.mark.parametrize(("bump", "spread"), [(0.5, 0.0), (0.0, 0.4)])
def test_texture_tilts_normals_and_varies_albedo(bump: float, spread: float) -> None:
    room: Any = Room()
    smooth = radiance(room, dust=CLEAR)
    room.materials = tuple(replace(m, bump=bump, albedo_spread=spread) for m in Room.materials)
    ratio = (radiance(room, dust=CLEAR) / smooth)[..., 1]
    assert 0.03 < ratio.std() < 0.6
    assert ratio.mean() == pytest.approx(1, abs=0.2)


def test_every_frame_has_noise_of_its_own() -> None:
    config, room = small(dust=CLEAR, rgb={"shadows": False}), Room()
    sensor, body = RgbSensor(config, room, VOLUME), Line().pose_at(0.0)
    T = body @ mounted(config.rgb.mount, camera=True)
    view, still = sensor.viewer.at(T), (np.zeros(3), np.zeros(3))
    one, again, other = (sensor.picture(view, k, 0.0, body, T, still) for k in (1, 1, 2))
    assert np.array_equal(one, again)
    assert (one != other).mean() > 0.2
