"""Dust: what it takes from the light, what it throws back of the lamps' beams, and grains near the lens.

Light that is scattered once is integrated along rays of a coarse grid over the image, through slices that are
dense near the lens; every pixel looks up its share by its range. Density is a mean times clouds that drift.
"""

from __future__ import annotations

import numpy as np

from fusion.geometry import Camera
from fusion.geometry import Floats as Matrix
from fusion.simulate.mine import kernels
from fusion.simulate.mine.config import DustConfig
from fusion.simulate.mine.hits import Floats
from fusion.simulate.mine.textures import Bytes

CELL_PX = 16
SLICES = 24
NEAR_M, BEND_M, FAR_M = 0.35, 2.5, 60.0
_GRAIN_M2 = 1.2e-8  # a large grain's cross-section for scattering, a steradian
_GRAINS_M = (0.10, 1.1)  # where grains are seen one by one
_APERTURE_M = 0.0022  # of the lens: how large grains out of focus look


def extinction_per_m(config: DustConfig) -> float:
    """The mean extinction coefficient (Koschmieder 1924: contrast falls to 2 % at the visual range)."""
    return 3.912 / config.visibility_m


class Fog:
    """The dust as one camera sees it; `directions` of its grid are computed once."""

    def __init__(self, config: DustConfig, camera: Camera, volume: Bytes) -> None:
        w, h = camera.size_wh
        columns, rows = np.arange(0, w + CELL_PX, CELL_PX), np.arange(0, h + CELL_PX, CELL_PX)
        nodes = np.stack(np.meshgrid(np.minimum(columns, w - 1), np.minimum(rows, h - 1)), -1).reshape(-1, 2)
        self.grid_w, self.sigma = len(columns), np.float32(extinction_per_m(config))
        self._directions = camera.unproject(nodes.astype(np.float64)).astype(np.float32)
        share = np.arange(SLICES + 1) / SLICES * FAR_M / (FAR_M + BEND_M)
        self._at = np.maximum(BEND_M * share / (1 - share), NEAR_M).astype(np.float32)
        self._config, self._volume = config, volume

    def over(self, T_world_cam: Matrix, time_s: float, lamps: Floats, cubes: Floats) -> Floats:
        """Scattered light and transmittance: rays x (slices + 1) x 4, cumulated from the lens on."""
        c = self._config
        fog = np.empty((len(self._directions), SLICES + 1, 4), np.float32)
        shift = np.asarray(c.wind_m_s, np.float32) * np.float32(time_s)
        pose = T_world_cam.astype(np.float32)
        kernels.fill_fog(
            self._directions, np.ascontiguousarray(pose[:3, :3]), np.ascontiguousarray(pose[:3, 3]), self._at,
            self.sigma, np.asarray(c.albedo_bgr, np.float32), np.float32(c.forward), lamps, cubes,
            self._volume, shift, np.float32(8 / c.cloud_m), np.float32(c.patchiness), fog,
        )  # fmt: skip
        return fog

    def lay(self, fog: Floats, range_m: Floats, width: int, radiance: Floats) -> None:
        """Veil `radiance` (N x 3, in place) of an image `width` pixels wide."""
        kernels.veil(
            fog, self.grid_w, CELL_PX, np.float32(BEND_M), np.float32(FAR_M), range_m, width, radiance
        )


def grains(
    config: DustConfig, rng: np.random.Generator, size_wh: tuple[int, int], f_px: float, power: float
) -> Floats:
    """Grains near the lens: N x 5 float32, column, row (px), depth (m), radius (px), radiance * px."""
    n = int(rng.poisson(config.particles)) if config.particles else 0
    near, far = _GRAINS_M
    depth = np.cbrt(rng.uniform(near**3, far**3, n))
    column, row = (rng.uniform(-20, side + 20, n) for side in size_wh)
    radius = np.maximum(f_px * _APERTURE_M / depth * rng.uniform(0.7, 1.3, n), 0.8)
    size = _GRAIN_M2 * np.exp(rng.normal(0, 1.1, n))
    light = power / (depth**2 + 0.03) * size * f_px**2 / depth**2
    return np.stack([column, row, depth, radius, light], -1).astype(np.float32)
