"""Small analytic worlds for the sensors' tests: a box room and two walls, cast in plain numpy float64."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion.geometry import Floats, pose
from fusion.simulate.mine.config import MineConfig
from fusion.simulate.mine.hits import Hits, Material

GREY = Material("rock", (0.2, 0.2, 0.2), 0.0, 0.0, 1.0, 12.0, 0.0, 1.0, lidar_reflectance=0.5)
WARM = Material("pipe", (0.3, 0.2, 0.2), 0.0, 0.0, 1.0, 40.0, 0.0, 0.9, lidar_reflectance=0.5)


class Room:
    """The inside of a box from `low` to `high`, a warm patch on its far wall; optionally a screen at x =
    `screen`.

    The screen is the plane x = `screen`, for y above 0 only.
    """

    materials = (GREY, WARM)
    lamps = np.zeros((0, 3))
    lamp_bgr = np.zeros((0, 3))

    def __init__(
        self, low: ArrayLike = (-4, -3, -2), high: ArrayLike = (9, 3, 2), screen: float | None = None
    ) -> None:
        self.low, self.high, self.screen = np.asarray(low, float), np.asarray(high, float), screen

    def cast(self, rays: NDArray[np.float32], **options: Any) -> Hits:
        origin, way = rays[:, :3].astype(np.float64), rays[:, 3:].astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.where(way > 0, (self.high - origin) / way, (self.low - origin) / way)
        t = np.where(np.isnan(t) | (way == 0), np.inf, t)
        axis, r = t.argmin(1), t.min(1)
        normal = np.zeros_like(origin)
        normal[np.arange(len(r)), axis] = -np.sign(way[np.arange(len(r)), axis])
        if self.screen is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                s = (self.screen - origin[:, 0]) / way[:, 0]
            ahead = (s > 0) & (s < r) & (origin[:, 1] + s * way[:, 1] > 0)
            r = np.where(ahead, s, r)
            normal[ahead] = -np.sign(way[ahead, :1]) * (1, 0, 0)
        end = origin + r[:, None] * way
        warm = (axis == 0) & (end[:, 0] > 0) & (np.abs(end[:, 1]) < 0.6) & (np.abs(end[:, 2]) < 0.6)
        material = warm.astype(np.uint8)
        nothing = np.full(len(r), np.nan, np.float32)
        return Hits(r.astype(np.float32), normal.astype(np.float32), material, nothing)


class Line:
    """A straight flight that turns evenly: position = start + velocity t, yaw = turn t."""

    def __init__(
        self, velocity: ArrayLike = (0, 0, 0), turn: float = 0.0, start: ArrayLike = (0, 0, 0)
    ) -> None:
        self.velocity, self.turn, self.start = np.asarray(velocity, float), turn, np.asarray(start, float)

    def pose_at(self, t_s: ArrayLike) -> Floats:
        t = np.asarray(t_s, float)
        T = np.stack([self._one(x) for x in t.ravel()])
        return T.reshape(*t.shape, 4, 4)

    def _one(self, t: float) -> Floats:
        c, s = np.cos(self.turn * t), np.sin(self.turn * t)
        return pose([[c, -s, 0], [s, c, 0], [0, 0, 1]], self.start + self.velocity * t)


def small(settings: dict[str, Any] | None = None, **groups: Any) -> MineConfig:
    """A configuration of small pictures and few points, that runs in a blink."""
    base: dict[str, Any] = {
        "duration_s": 0.5,
        "rgb": {"camera": {"size_wh": (64, 48)}, "rate_hz": 10},
        "thermal": {
            "camera": {"size_wh": (64, 48)},
            "rate_hz": 20,
            "ffc_interval_s": 0.8,
            "ffc_freeze_s": 0.16,
        },
        "lidar": {"rings": 16, "columns": 64},
    }
    for name, values in {**(settings or {}), **groups}.items():
        base[name] = {**base.get(name, {}), **values} if isinstance(values, dict) else values
    return MineConfig.of(base)
