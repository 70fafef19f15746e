"""The seam between the scene, which knows where rays end, and the sensors, which know what is seen there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Material:
    """What a surface is made of.

    `albedo_bgr` is its linear reflectance, `albedo_spread` how far texture makes it vary (as a share),
    `bump` how strongly texture tilts its normals (0 is smooth), `texture_m` the length of a texture tile.
    `temperature_degC` is its mean surface temperature, `temperature_spread_degC` the deviation of the slow
    variation over it, `emissivity` in long-wave infrared. `emits_bgr` is linear radiance of its own (lamps,
    reflectors), `lidar_reflectance` in [0, 1] at 905 nm.
    """

    name: str
    albedo_bgr: tuple[float, float, float]
    albedo_spread: float
    bump: float
    texture_m: float
    temperature_degC: float  # noqa: N815 - units as the conventions write them
    temperature_spread_degC: float  # noqa: N815
    emissivity: float
    emits_bgr: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lidar_reflectance: float = 0.3


@dataclass(frozen=True, slots=True)
class Hits:
    """Where N rays ended. All in the world's frame: x along the drift, y left, z up, metres.

    `range_m` (N float32) is the length of each unit ray, inf where it met nothing; `normal` (N x 3 float32,
    unit) is the geometric normal, turned towards the ray's origin; `material` (N uint8) indexes the scene's
    `materials`; `printed` (N float32) is NaN, except on the board: there the reflectance of its pattern.
    """

    range_m: Floats
    normal: Floats
    material: NDArray[np.uint8]
    printed: Floats


class Scene(Protocol):
    """Anything that rays can be cast into."""

    @property
    def materials(self) -> tuple[Material, ...]: ...

    def cast(self, rays: Floats, **options: Any) -> Hits:
        """N x 6 float32 rays (origin, unit direction; world frame, metres) to where they end."""
        ...
