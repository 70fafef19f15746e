"""A recording of the mine, written as folders with the truth beside it, one picture at a time.

rgb/STAMP.jpg (or png), fir/STAMP.png (uint16 counts), lidar/STAMP.pcd; truth/ as `truth.Truth` reads it.
Stamps are nanoseconds of each sensor's own clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fusion.clouds import write_pcd
from fusion.codecs import encode_jpeg, encode_png
from fusion.errors import UsageError
from fusion.files import replace_file
from fusion.geometry import Floats, invert
from fusion.registration import write_homography
from fusion.rig import Rig, save_rig
from fusion.simulate.mine import image_kernels, layout
from fusion.simulate.mine.config import MineConfig
from fusion.simulate.mine.hits import Floats as Depths
from fusion.simulate.mine.lidar import LidarSensor
from fusion.simulate.mine.lights import Lit
from fusion.simulate.mine.motion import Clock, instants, mounted, twist
from fusion.simulate.mine.motion import Path as Flown
from fusion.simulate.mine.plane_at import homography_at
from fusion.simulate.mine.rgb import RgbSensor
from fusion.simulate.mine.textures import cloud_volume
from fusion.simulate.mine.thermal import ThermalSensor

FIRST_S = {"rgb": 0.1, "fir": 0.1137, "lidar": 0.1}
THREADS = 2
Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class World:
    """What is filmed, and how the drone moves through it."""

    scene: Lit
    path: Flown


@dataclass(frozen=True, slots=True)
class Report:
    """How much was written: pictures, scans and their points, and how many thermal frames stand still."""

    rgb: int
    fir: int
    lidar: int
    points: int
    frozen: int


def make_mine(
    out: Path,
    config: MineConfig,
    *,
    progress: Progress | None = None,
    threads: int = THREADS,
    world: World | None = None,
) -> Report:
    """Write a recording of `config` into the folder `out`, which must be new or empty.

    The same configuration gives the same bytes, whatever `threads`. `progress(done, all)` is called after
    each picture and scan. `world` replaces the mine and the flight of the configuration. Raises
    `OutputError`, and `UsageError` where the recording is shorter than a scan or longer than the flight.
    """
    shortest_s = max(FIRST_S.values()) + 1 / config.lidar.rate_hz
    if config.duration_s <= shortest_s:
        hint = f"more than {shortest_s:g} s: one scan must fit"
        raise UsageError(
            f"a recording of {config.duration_s:g} s is too short", where="duration_s", hint=hint
        )
    layout.claim(out)
    return _Recorder(out, config, world or world_of(config)).run(
        threads, progress or (lambda _done, _all: None)
    )


def world_of(config: MineConfig) -> World:
    """The mine and the flight that the configuration describes. Raises `UsageError` where the flight is too
    short.
    """
    from fusion.simulate.mine.flight import Flight
    from fusion.simulate.mine.scene import build_scene

    scene = build_scene(config.scene, config.seed)
    flight = Flight(config.flight, scene.centre_line, config.seed)
    if config.duration_s > flight.duration_s:
        hint = "ask for less, fly slower or take a longer drift"
        raise UsageError(
            f"the drift ends after {flight.duration_s:.1f} s of flight", where="duration_s", hint=hint
        )
    return World(scene, flight)


@dataclass(frozen=True, slots=True)
class _Seen:
    """What the flow to the next frame needs of an RGB frame."""

    stamp_ns: int
    z_m: Depths
    T_world_rgb: Floats


class _Recorder:
    def __init__(self, out: Path, config: MineConfig, world: World) -> None:
        self._out, self._config, self._path = out, config, world.path
        volume = cloud_volume(np.random.default_rng(np.random.SeedSequence(config.seed, spawn_key=(0,))))
        self._rgb = RgbSensor(config, world.scene, volume)
        self._fir = ThermalSensor(config, world.scene, volume)
        self._lidar = LidarSensor(config, world.scene, volume)
        groups = {"rgb": config.rgb, "fir": config.thermal, "lidar": config.lidar}
        self._clocks = {name: Clock.of(group.clock) for name, group in groups.items()}
        self._mounts = {name: mounted(group.mount, name != "lidar") for name, group in groups.items()}
        ends = {"rgb": 0.0, "fir": 0.0, "lidar": 1 / config.lidar.rate_hz}
        self._times = {
            name: instants(self._clocks[name], group.rate_hz, FIRST_S[name], config.duration_s - ends[name])
            for name, group in groups.items()
        }
        self._shown = self._fir.shutter.shown(self._times["fir"])

    def run(self, threads: int, progress: Progress) -> Report:
        self._write_small()
        jobs = list(self._jobs())
        total, points, done = len(jobs), 0, 0
        waiting: deque[Future[Any]] = deque()
        last: _Seen | None = None
        with ThreadPoolExecutor(threads) as pool:
            try:
                for job in [*jobs, None]:
                    if job is not None:
                        waiting.append(pool.submit(*job))
                    while waiting and (job is None or len(waiting) > 2 * threads):
                        made = waiting.popleft().result()
                        if made is None:
                            continue  # a flow
                        done += 1
                        progress(done, total)
                        if isinstance(made, _Seen):
                            if last is not None and self._config.truth:
                                waiting.append(pool.submit(self._flow, last, made))
                            last = made
                        else:
                            points += made
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        counts = {name: len(times) for name, times in self._times.items()}
        frozen = sum(shown != k for k, shown in enumerate(self._shown))
        return Report(counts["rgb"], counts["fir"], counts["lidar"], points, frozen)

    def _jobs(self) -> Iterator[tuple[Callable[[int], _Seen | int], int]]:
        """What is to be made, in the order of time."""
        makers = {"rgb": self._make_rgb, "fir": self._make_fir, "lidar": self._make_scan}
        every = [(t, name, k) for name, times in self._times.items() for k, t in enumerate(times)]
        for _, name, k in sorted(every):
            yield makers[name], k

    def _stamp(self, sensor: str, k: int) -> int:
        return self._clocks[sensor].stamp_ns(self._times[sensor][k])

    def _pose(self, sensor: str, k: int) -> Floats:
        return self._path.pose_at(self._times[sensor][k]) @ self._mounts[sensor]

    def _truth(self, kind: str, stamp_ns: int, data: bytes) -> None:
        replace_file(self._out / "truth" / kind / f"{stamp_ns}.png", data)

    def _make_rgb(self, k: int) -> _Seen:
        c, t, stamp = self._config.rgb, self._times["rgb"][k], self._stamp("rgb", k)
        T_world_body, T_world_rgb = self._path.pose_at(t), self._pose("rgb", k)
        view = self._rgb.viewer.at(T_world_rgb)
        bgr = self._rgb.picture(
            view, k, t, T_world_body, T_world_rgb, twist(self._path, t, self._mounts["rgb"])
        )
        data = encode_jpeg(bgr, c.quality) if c.file == "jpg" else encode_png(bgr)
        replace_file(self._out / "rgb" / f"{stamp}.{c.file}", data)
        if self._config.truth:
            self._truth("depth_rgb", stamp, encode_png(view.depth))
        return _Seen(stamp, view.z_m, T_world_rgb)

    def _flow(self, this: _Seen, following: _Seen) -> None:
        x, y = self._rgb.viewer.x_y
        c = self._rgb.viewer.camera
        h, w = this.z_m.shape
        out, hidden = np.empty((h, w, 3), np.uint16), np.empty((h, w), np.uint8)
        K = np.array([c.fx, c.fy, c.cx, c.cy, *c.distortion])
        T_next_this = invert(following.T_world_rgb) @ this.T_world_rgb
        image_kernels.flow(x, y, this.z_m, T_next_this, K, following.z_m, out, hidden)
        self._truth("flow_rgb", this.stamp_ns, encode_png(out[..., ::-1]))
        self._truth("occluded_rgb", this.stamp_ns, encode_png(hidden))

    def _make_fir(self, k: int) -> int:
        """Frame k; a frame that stands still is written with the one whose picture it repeats."""
        if self._shown[k] == k or self._config.truth:
            view = self._fir.viewer.at(self._pose("fir", k))
            t = self._times["fir"][k]
            counts, kelvin = self._fir.picture(view, k, t, twist(self._path, t, self._mounts["fir"]))
            if self._shown[k] == k:
                data = encode_png(counts)
                for same in range(k, len(self._shown)):
                    if self._shown[same] != k:
                        break
                    replace_file(self._out / "fir" / f"{self._stamp('fir', same)}.png", data)
            if self._config.truth:
                self._truth("depth_fir", self._stamp("fir", k), encode_png(view.depth))
                self._truth("temperature_fir", self._stamp("fir", k), encode_png(kelvin))
        return 0

    def _make_scan(self, k: int) -> int:
        cloud = self._lidar.scan(self._path, self._times["lidar"][k], k)
        write_pcd(self._out / "lidar" / f"{self._stamp('lidar', k)}.pcd", cloud)
        return len(cloud)

    def _write_small(self) -> None:
        truth = self._out / "truth"
        replace_file(truth / "mine.toml", self._config.toml().encode())
        save_rig(truth / "rig.toml", self.rig())
        write_homography(truth / "homography_5m.toml", homography_at(self.rig(), 5.0))
        layout.write_clocks(truth / "clocks.toml", self._clocks)
        for name, times in self._times.items():
            layout.write_tum(
                truth / f"poses_{name}.tum", times, [self._pose(name, k) for k in range(len(times))]
            )
        still = [(self._stamp("fir", k), self._stamp("fir", s)) for k, s in enumerate(self._shown) if s != k]
        layout.write_rows(truth / "freezes.csv", ("stamp_ns", "shown_stamp_ns"), still)

    def rig(self) -> Rig:
        """How the sensors stand: both cameras, T_rgb_fir and T_rgb_lidar."""
        T_rgb_body = invert(self._mounts["rgb"])
        transforms = {f"T_rgb_{name}": T_rgb_body @ self._mounts[name] for name in ("fir", "lidar")}
        return Rig({"rgb": self._rgb.viewer.camera, "fir": self._fir.viewer.camera}, transforms)
