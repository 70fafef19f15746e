"""The thermal camera: what surfaces radiate, and what a microbolometer and its shutter make of it."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.geometry import Floats as Matrix
from fusion.simulate.mine import image_kernels, kernels
from fusion.simulate.mine.config import MineConfig, ThermalConfig
from fusion.simulate.mine.dust import extinction_per_m
from fusion.simulate.mine.hits import Floats
from fusion.simulate.mine.lights import Lit, material_table
from fusion.simulate.mine.rgb import View, Viewer, camera_of
from fusion.simulate.mine.textures import Bytes

STREAM = 2
ZERO_DEGC_KELVIN = 273.15
_LONGEST_PX = 48


@dataclass(frozen=True, slots=True)
class Shutter:
    """When the flat-field corrections begin, and how long the picture then stands still; true seconds."""

    begins_s: tuple[float, ...]
    freeze_s: float

    @classmethod
    def of(cls, config: ThermalConfig, seed: int, duration_s: float) -> Shutter:
        """About one an interval, the first somewhere in the first interval's second quarter."""
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STREAM, 0, 7)))
        begins, at = [], config.ffc_interval_s * rng.uniform(0.25, 0.5)
        while at < duration_s and config.ffc_freeze_s > 0:
            begins.append(float(at))
            at += config.ffc_interval_s * rng.uniform(0.9, 1.1)
        return cls(tuple(begins), config.ffc_freeze_s)

    def shown(self, times_s: Sequence[float]) -> list[int]:
        """For every frame the index of the frame whose picture it shows: its own, unless the shutter is
        closed.
        """
        shown: list[int] = []
        for k, t in enumerate(times_s):
            closed = any(begin <= t < begin + self.freeze_s for begin in self.begins_s)
            shown.append(shown[-1] if closed and shown else k)
        return shown

    def since(self, time_s: float) -> tuple[int, float]:
        """How many corrections there were, and the seconds since the last (the camera's own, before the
        first).
        """
        done = [begin for begin in self.begins_s if begin <= time_s]
        return len(done), time_s - (done[-1] if done else -10.0)


class ThermalSensor:
    """Makes 14-bit counts of views. Frames are independent: any order, any thread gives the same bytes."""

    def __init__(self, config: MineConfig, scene: Lit, volume: Bytes) -> None:
        self._all, self._config, self._volume = config, config.thermal, volume
        self.viewer = Viewer(camera_of(config.thermal.camera), scene)
        self.shutter = Shutter.of(config.thermal, config.seed, config.duration_s)
        self._table = material_table(scene, 0.0)
        self._lock = threading.Lock()
        self._patterns: tuple[int, Floats, Floats] | None = None
        w, h = self.viewer.camera.size_wh
        v, u = np.mgrid[-1 : 1 : h * 1j, -1 : 1 : w * 1j]
        self._gain = (1 - config.thermal.vignetting * (u * u + v * v) / 2).astype(np.float32).ravel()

    def picture(
        self, view: View, index: int, time_s: float, moving: tuple[Matrix, Matrix]
    ) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """Counts, and surface temperatures in centikelvin (0 where there is none), both H x W uint16."""
        surface, seen = self._apparent(view)
        c = self._config
        image = seen if c.blur_px == 0 else np.asarray(cv2.GaussianBlur(seen, (0, 0), c.blur_px), np.float32)
        image = self._lagging(image, view, moving)
        return self._counts(image, index, time_s), np.floor(100 * surface + np.float32(0.5)).astype(np.uint16)

    def _apparent(self, view: View) -> tuple[Floats, Floats]:
        c, hits, shape = self._config, view.hits, view.z_m.shape
        surface, seen = np.empty(shape, np.float32), np.empty(shape, np.float32)
        extinction = c.air_extinction_per_m + c.dust_share * extinction_per_m(self._all.dust)
        kernels.warm(
            view.rays, hits.range_m, hits.material, hits.printed, self._table, self._volume,
            np.asarray(c.printed_emissivity, np.float32), np.float32(c.air_degC + ZERO_DEGC_KELVIN),
            np.float32(extinction), surface.reshape(-1), seen.reshape(-1),
        )  # fmt: skip
        return surface, seen

    def _lagging(self, image: Floats, view: View, moving: tuple[Matrix, Matrix]) -> Floats:
        if self._config.time_constant_ms == 0:
            return image
        camera = self.viewer.camera
        numbers = (np.float32(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy))
        velocity, rate = (np.asarray(a, np.float32) for a in moving)
        out = np.empty_like(image)
        tau_s = np.float32(self._config.time_constant_ms * 1e-3)
        image_kernels.lag(
            image, view.z_m, *numbers, velocity, rate, tau_s, image_kernels.exponential_ages(_LONGEST_PX), out
        )
        return out

    def _counts(self, kelvin: Floats, index: int, time_s: float) -> NDArray[np.uint16]:
        c = self._config
        out = np.empty(kelvin.shape, np.uint16)
        housing = np.float32(c.air_degC + ZERO_DEGC_KELVIN + 12)  # electronics keep it warmer than the air
        image_kernels.count(
            kelvin.reshape(-1), self._gain, self.fixed_pattern(time_s).reshape(-1), housing,
            np.float32(c.netd_mk * 1e-3), np.float32(1 / c.kelvin_per_count), image_kernels.normal_table(),
            image_kernels.noise_key(self._all.seed, STREAM, index), out.reshape(-1),
        )  # fmt: skip
        return out

    def fixed_pattern(self, time_s: float) -> Floats:
        """The pattern at a true time, kelvin (H x W): what the last correction left, and its growth since."""
        done, since_s = self.shutter.since(time_s)
        with self._lock:
            if self._patterns is None or self._patterns[0] != done:
                self._patterns = (done, *self._drawn(done))
            _, left, growth = self._patterns
        grown = self._config.pattern_drift_k_per_min * since_s / 60
        return np.asarray(left + np.float32(grown) * growth, np.float32)

    def _drawn(self, done: int) -> tuple[Floats, Floats]:
        """Of one interval between corrections: the pattern at its beginning (K), and the unit pattern that
        grows.
        """
        c, (w, h) = self._config, self.viewer.camera.size_wh
        rng = np.random.default_rng(np.random.SeedSequence(self._all.seed, spawn_key=(STREAM, done, 8)))
        columns, pixels = rng.standard_normal((2, w), np.float32), rng.standard_normal((2, h, w), np.float32)
        coarse = rng.standard_normal((5, 6), np.float32)
        smooth = np.asarray(cv2.resize(coarse, (w, h), interpolation=cv2.INTER_CUBIC), np.float32)
        left = (
            np.float32(c.column_pattern_mk * 1e-3) * columns[0]
            + np.float32(c.pixel_pattern_mk * 1e-3) * pixels[0]
        )
        growth = np.float32(0.6) * columns[1] + np.float32(0.5) * pixels[1] + np.float32(0.6) * smooth
        return left, growth
