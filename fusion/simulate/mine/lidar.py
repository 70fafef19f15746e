"""A spinning LiDAR: raw points, each in the sensor's frame at its own instant, with noise and losses."""

from __future__ import annotations

import numpy as np

from fusion.frames import PointCloud
from fusion.geometry import Floats as Matrix
from fusion.simulate.mine import kernels
from fusion.simulate.mine.config import DustConfig, LidarConfig, MineConfig
from fusion.simulate.mine.dust import extinction_per_m
from fusion.simulate.mine.hits import Floats, Hits, Scene
from fusion.simulate.mine.motion import Path, mounted
from fusion.simulate.mine.textures import Bytes

STREAM = 3
_SLOPE = 6.0  # of the share of returns over the logarithm of their power


class LidarSensor:
    """Makes scans. They are independent: any order, any thread gives the same bytes."""

    def __init__(self, config: MineConfig, scene: Scene, volume: Bytes) -> None:
        self._all, self._config, self._dust = config, config.lidar, config.dust
        self._scene, self._volume = scene, volume
        self._reflectance = np.array([m.lidar_reflectance for m in scene.materials], np.float32)
        self._directions = directions(config.lidar)
        self.T_body_lidar = mounted(config.lidar.mount, camera=False)

    def times_s(self) -> Matrix:
        """Seconds of every column (float64) after the scan's stamp."""
        c = self._config
        return np.arange(c.columns) / c.columns / c.rate_hz

    def scan(self, path: Path, start_s: float, index: int, scene: Scene | None = None) -> PointCloud:
        """The scan that begins at the true time `start_s`, columns in the order of time, rings upwards in
        each.

        `scene` stands in for the one that the sensor was made with. Fields: intensity (float32, 0 to 255),
        ring (uint16, 0 the lowest), time_s (float32, after the start).
        """
        after_s = self.times_s() / (1 + self._config.clock.drift_ppm * 1e-6)
        T = path.pose_at(start_s + after_s) @ self.T_body_lidar
        rays = self._rays(T[:, :3, :3], T[:, :3, 3])
        rng = np.random.default_rng(np.random.SeedSequence(self._all.seed, spawn_key=(STREAM, index)))
        measured_m, intensity = self._measured((scene or self._scene).cast(rays), rays, start_s, rng)
        kept = np.flatnonzero(measured_m > 0)
        ring = (kept % self._config.rings).astype(np.uint16)
        xyz = self._directions[kept] * measured_m[kept, None]
        time_s = self.times_s().astype(np.float32)[kept // self._config.rings]
        fields = {"intensity": intensity[kept], "ring": ring, "time_s": time_s}
        return PointCloud(xyz, fields)

    def _rays(self, R: Matrix, p: Matrix) -> Floats:
        """Columns x rings, each from the pose of its own instant."""
        c = self._config
        fans = self._directions.reshape(c.columns, c.rings, 3)
        rays = np.empty((c.columns, c.rings, 6), np.float32)
        rays[..., :3] = p[:, None, :]
        rays[..., 3:] = fans @ R.astype(np.float32).transpose(0, 2, 1)
        return rays.reshape(-1, 6)

    def _measured(
        self, hits: Hits, rays: Floats, time_s: float, rng: np.random.Generator
    ) -> tuple[Floats, Floats]:
        """Measured range (0: no return) and intensity of every ray."""
        c, sigma = self._config, np.float32(extinction_per_m(self._dust))
        r = np.minimum(hits.range_m, np.float32(1e4))
        cosine = np.abs(np.einsum("ij,ij->i", hits.normal, rays[:, 3:]))
        rho = self._reflectance[hits.material]
        rho = np.where(np.isnan(hits.printed), rho, hits.printed)
        back = rho * cosine * np.exp(-2 * sigma * r)
        power = back / (np.float32(0.1) * (r / np.float32(c.range_10_m)) ** 2 + np.float32(1e-9))
        odds = np.minimum(power, np.float32(30)) ** np.float32(_SLOPE)
        lost = rng.random(len(r), np.float32) * (1 + odds) >= odds
        lost |= (rng.random(len(r), np.float32) < c.drop_out) | (r > c.max_range_m) | (r < c.min_range_m)
        measured = np.maximum(
            r + np.float32(c.range_noise_m) * rng.standard_normal(len(r), np.float32), np.float32(1e-3)
        )
        intensity = np.minimum(255 * np.sqrt(back), 255)
        measured[lost] = 0
        self._false_returns(measured, intensity, r, rays, time_s, rng)
        return measured, intensity.astype(np.float32)

    def _false_returns(
        self,
        measured: Floats,
        intensity: Floats,
        r: Floats,
        rays: Floats,
        time_s: float,
        rng: np.random.Generator,
    ) -> None:
        """Put returns from dust in front of some surfaces, more of them where it is dense; in place."""
        c, dust = self._config, self._dust
        twice = np.float32(2 * extinction_per_m(dust))  # extinction there and back
        chance, where = rng.random((2, len(r)), np.float32)
        dimmed = 1 - np.exp(-twice * np.maximum(r - np.float32(c.min_range_m), 0))
        near = np.float32(c.min_range_m) - np.log1p(-where * dimmed) / twice
        density = density_at(dust, self._volume, rays[:, :3] + near[:, None] * rays[:, 3:], time_s)
        false = (chance < dust.lidar_false_share * dimmed**2 * density) & (near < r) & (r > c.min_range_m)
        measured[false] = near[false]
        intensity[false] = 255 * np.sqrt(np.float32(0.02)) * where[false]


def directions(config: LidarConfig) -> Floats:
    """Unit directions, (columns * rings) x 3 float32: from the back, counter-clockwise, rings upwards."""
    azimuth = np.pi + 2 * np.pi * np.arange(config.columns) / config.columns
    elevation = np.radians(np.linspace(config.fov_down_deg, config.fov_up_deg, config.rings))
    a, e = np.meshgrid(azimuth, elevation, indexing="ij")
    xyz = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1)
    return xyz.reshape(-1, 3).astype(np.float32)


def density_at(config: DustConfig, volume: Bytes, xyz_m: Floats, time_s: float) -> Floats:
    """The dust's density over its mean at N x 3 points of the world, N float32."""
    cells = (xyz_m - np.asarray(config.wind_m_s, np.float32) * np.float32(time_s)) * np.float32(
        8 / config.cloud_m
    )
    out = np.empty(len(cells), np.float32)
    kernels.volume_values(volume, np.ascontiguousarray(cells), out)
    return np.maximum(1 + np.float32(config.patchiness) * out, np.float32(0.05))
