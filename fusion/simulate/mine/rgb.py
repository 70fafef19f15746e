"""The RGB camera: light that comes back from rock and dust, and what lens and sensor make of it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.errors import UsageError
from fusion.geometry import Floats as Matrix
from fusion.geometry import PinholeCamera
from fusion.simulate.mine import image_kernels, kernels
from fusion.simulate.mine.config import CameraConfig, MineConfig
from fusion.simulate.mine.dust import Fog, extinction_per_m, grains
from fusion.simulate.mine.hits import Floats, Hits, Scene
from fusion.simulate.mine.lights import Lights, Lit, material_table
from fusion.simulate.mine.textures import Bytes, rock_tile

STREAM = 1  # of random numbers
_TOP_DN = 4095
_LONGEST_PX = 40
_GLARE_CELL = 8


def camera_of(config: CameraConfig) -> PinholeCamera:
    """The camera model of its settings."""
    w, h = config.size_wh
    f = w / 2 / np.tan(np.radians(config.fov_deg) / 2)
    dx, dy = config.centre_offset_px
    return PinholeCamera((w, h), f, f, (w - 1) / 2 + dx, (h - 1) / 2 + dy, tuple(config.distortion))


@dataclass(frozen=True, slots=True)
class View:
    """What a camera's rays met at one moment: rays (N x 6), hits, depth (H x W float32 m, 0 none; and 1/256
    m).
    """

    rays: Floats
    hits: Hits
    z_m: Floats
    depth: NDArray[np.uint16]


class Viewer:
    """Casts all rays of one camera; their directions are computed once."""

    def __init__(self, camera: PinholeCamera, scene: Lit) -> None:
        w, h = camera.size_wh
        uv = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).reshape(-1, 2)
        exact = camera.unproject(uv.astype(np.float64))
        if not np.isfinite(exact).all():
            hint = "weaken its distortion, or narrow its field of view"
            raise UsageError("the distortion of the camera leaves pixels without a ray", hint=hint)
        self.camera, self._scene = camera, scene
        self._directions = exact.astype(np.float32)
        self._forward = np.ascontiguousarray(self._directions[:, 2])
        self.x_y = tuple((exact[:, k] / exact[:, 2]).reshape(h, w) for k in (0, 1))

    def at(self, T_world_cam: Matrix, scene: Scene | None = None) -> View:
        """What is seen from a pose (camera frame); `scene` stands in for the one that the viewer was made
        with.
        """
        pose = T_world_cam.astype(np.float32)
        rays = np.empty((len(self._directions), 6), np.float32)
        R, origin = np.ascontiguousarray(pose[:3, :3]), np.ascontiguousarray(pose[:3, 3])
        kernels.turn_rays(self._directions, R, origin, rays)
        hits = (scene or self._scene).cast(rays)
        w, h = self.camera.size_wh
        z, stored = np.empty(w * h, np.float32), np.empty(w * h, np.uint16)
        image_kernels.depths(hits.range_m, self._forward, z, stored)
        return View(rays, hits, z.reshape(h, w), stored.reshape(h, w))


class RgbSensor:
    """Makes BGR pictures of views. Frames are independent: any order, any thread gives the same bytes."""

    def __init__(self, config: MineConfig, scene: Lit, volume: Bytes) -> None:
        self._all, self._config = config, config.rgb
        self.viewer = Viewer(camera_of(config.rgb.camera), scene)
        self._tile = rock_tile(
            np.random.default_rng(np.random.SeedSequence(config.seed, spawn_key=(STREAM,)))
        )
        self._table = material_table(scene, config.rgb.wet_floor)
        self._lights = Lights(config.lamps, scene, config.rgb.shadows)
        self._fog = Fog(config.dust, self.viewer.camera, volume)
        self._light = electrons(config, self.viewer.camera)
        self._curve = tone_curve()

    def picture(
        self,
        view: View,
        index: int,
        time_s: float,
        T_world_body: Matrix,
        T_world_rgb: Matrix,
        moving: tuple[Matrix, Matrix],
        metered: bool = False,
    ) -> NDArray[np.uint8]:
        """H x W x 3 BGR uint8. `moving` is velocity and turning rate in the camera's frame, m/s and rad/s.

        `metered` shortens the exposure for what is printed in view, as a careful photographer of boards does.
        """
        radiance = self._radiance(view, time_s, T_world_body, T_world_rgb)
        share = self._metered(radiance, view) if metered else 1.0
        lens = self._through_lens(radiance, view, index, moving, share)
        return self._develop(lens, index, share)

    def _metered(self, radiance: Floats, view: View) -> float:
        """The share of the exposure that brings what is printed up to 0.6 of saturation, no farther."""
        printed = ~np.isnan(view.hits.printed)
        if not printed.any():
            return 1.0
        electrons = np.percentile(radiance.reshape(-1, 3).max(1)[printed] * self._light[printed], 95)
        top = min(self._config.full_well_e, self._config.gain_e_per_dn * _TOP_DN)
        return float(min(1.0, 0.6 * top / max(electrons, 1.0)))

    def _radiance(self, view: View, time_s: float, T_world_body: Matrix, T_world_rgb: Matrix) -> Floats:
        """What reaches the lens, H x W x 3: surfaces under the lamps, through lit dust."""
        lamps = self._lights.at(T_world_body)
        camera, hits = self.viewer.camera, view.hits
        out = np.empty((len(hits.range_m), 3), np.float32)
        kernels.shade(
            view.rays, hits.range_m, hits.normal, hits.material, hits.printed, self._table,
            self._tile.samples, self._tile.levels, lamps, self._lights.cubes,
            np.float32(self._all.lamps.bounce), np.float32(extinction_per_m(self._all.dust)),
            np.float32(1 / camera.fx), out,
        )  # fmt: skip
        fog = self._fog.over(T_world_rgb, time_s, lamps, self._lights.cubes)
        self._fog.lay(fog, hits.range_m, camera.size_wh[0], out)
        return out.reshape(*view.z_m.shape, 3)

    def _through_lens(
        self, radiance: Floats, view: View, index: int, moving: tuple[Matrix, Matrix], share: float
    ) -> Floats:
        """Motion during the exposure, grains of dust, the lens's own blur and its glare."""
        c, way = self._config, self._way(moving, share * self._config.exposure_ms * 1e-3)
        blurred = np.empty_like(radiance)
        image_kernels.gather(radiance, view.z_m, *way, _LONGEST_PX, blurred)
        rng = np.random.default_rng(np.random.SeedSequence(self._all.seed, spawn_key=(STREAM, index, 1)))
        camera = self.viewer.camera
        image_kernels.splat(
            grains(self._all.dust, rng, camera.size_wh, camera.fx, self._all.lamps.intensity), *way, blurred
        )
        if c.blur_px > 0:
            blurred = cv2.GaussianBlur(blurred, (0, 0), c.blur_px)
        if c.glare > 0:
            h, w = view.z_m.shape
            small = cv2.resize(blurred, (w // _GLARE_CELL, h // _GLARE_CELL), interpolation=cv2.INTER_AREA)
            wide = cv2.GaussianBlur(small, (0, 0), w / _GLARE_CELL / 14)
            spread = cv2.resize(wide, (w, h), interpolation=cv2.INTER_LINEAR)
            blurred = cv2.addWeighted(blurred, 1 - c.glare, spread, c.glare, 0)
        return np.asarray(blurred, np.float32)

    def _way(self, moving: tuple[Matrix, Matrix], span_s: float) -> tuple[object, ...]:
        c = self.viewer.camera
        numbers = (np.float32(x) for x in (c.fx, c.fy, c.cx, c.cy))
        return (*numbers, moving[0].astype(np.float32), moving[1].astype(np.float32), np.float32(span_s))

    def _develop(self, radiance: Floats, index: int, share: float) -> NDArray[np.uint8]:
        c, key = self._config, image_kernels.noise_key(self._all.seed, STREAM, index)
        out = np.empty(radiance.shape, np.uint8)
        image_kernels.develop(
            radiance.reshape(-1, 3), self._light * np.float32(share), np.float32(c.gain_e_per_dn),
            np.float32(c.full_well_e), np.float32(c.read_noise_e), image_kernels.normal_table(), key,
            self._curve, out.reshape(-1, 3),
        )  # fmt: skip
        return out


def electrons(config: MineConfig, camera: PinholeCamera) -> Floats:
    """Electrons a unit of radiance at each pixel (N float32): exposure, sensitivity, vignetting."""
    w, h = camera.size_wh
    v, u = np.mgrid[:h, :w]
    r2 = ((u - camera.cx) ** 2 + (v - camera.cy) ** 2) / ((w / 2) ** 2 + (h / 2) ** 2)
    c = config.rgb
    return (
        (c.exposure_ms * 1e-3 * c.sensitivity_e * (1 - c.vignetting * np.minimum(r2, 1)))
        .astype(np.float32)
        .ravel()
    )


def tone_curve() -> NDArray[np.uint8]:
    """12-bit counts to 8 bit by the transfer function of sRGB (IEC 61966-2-1)."""
    x = np.arange(_TOP_DN + 1) / _TOP_DN
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    return np.floor(255 * encoded + 0.5).astype(np.uint8)
