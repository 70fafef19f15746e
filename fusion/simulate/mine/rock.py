"""The rock: a drift with a bend, a side drift and a passing bay, blasted rough, its floor worn by traffic.

Everything is one function of space, negative in the air; its zero surface is the rock, so that openings are
open and the whole is closed. World: x along the drift's start, y left, z up, floor near z = 0, metres.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion.simulate.mine.course import Course, Plan
from fusion.simulate.mine.meshes import Floats, Mesh
from fusion.simulate.mine.nets import surface
from fusion.simulate.mine.noise import Facets, Smooth
from fusion.simulate.mine.scene_config import SceneConfig

ROCK, FLOOR, MUCK = 0, 1, 2
WATER_M = -0.065  # level of the water in ruts and hollows
REPOSE = np.tan(np.deg2rad(37.0))  # slope at which loose rock comes to rest

_BAND_M = 0.9  # how far from the drawn outline the rock's face can be
_OUTSIDE = np.float32(1.0)
_BAY_DEPTH_M = 0.8


class Ground:
    """Where rock and floor are, from a plan and a seed."""

    def __init__(self, config: SceneConfig, plan: Plan, seed: int) -> None:
        rng = np.random.default_rng([seed, 1])
        self.config, self.plan = config, plan
        self._smooth = Smooth(rng)
        reach = config.width_m / 2 + 3.0
        track = np.vstack([course.xy for course in plan.courses])
        self._low = np.r_[track.min(0) - reach, -0.6]
        self._high = np.r_[track.max(0) + reach, config.height_m + _BAND_M + 0.3]
        # Rock breaks along a few sets of joints: large blocks, then smaller ones.
        self._large = Facets(rng, self._lattice(1.0), size_m=1.0, step_m=0.13, tilt=0.42)
        self._small = Facets(rng, self._lattice(0.42), size_m=0.42, step_m=0.045, tilt=0.40)

    def _lattice(self, size_m: float) -> Floats:
        """Points every `size_m` metres wherever a block of rock can show, N x 3."""
        x, y, z = (np.arange(a, b, size_m) for a, b in zip(self._low, self._high, strict=True))
        xy = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
        xy = xy[self.plan.distance(xy) < self.config.width_m / 2 + _BAY_DEPTH_M + _BAND_M + 0.5]
        return np.c_[np.repeat(xy, len(z), 0), np.tile(z, len(xy))]

    def mesh(self) -> tuple[Mesh, NDArray[np.uint8]]:
        """The closed surface of rock and floor, and what each triangle is (M uint8: ROCK, FLOOR or MUCK)."""
        cell = self.config.cell_m
        x, y, z = (
            a + cell * np.arange(int((b - a) / cell) + 2) for a, b in zip(self._low, self._high, strict=True)
        )
        mesh = surface(self._field(x, y, z), (x[0], y[0], z[0]), cell)
        centre = mesh.vertices[mesh.triangles].mean(1)
        floor, muck = self.floor(centre[:, :2])
        loose = np.where(muck > 0.05, MUCK, FLOOR)
        near = np.abs(centre[:, 2] - floor) < 0.1
        return mesh, np.where(near & (mesh.normals()[:, 2] > 0.3), loose, ROCK).astype(np.uint8)

    def _field(self, x: Floats, y: Floats, z: Floats) -> NDArray[np.float32]:
        field = np.full((len(x), len(y), len(z)), _OUTSIDE, np.float32)
        xy = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
        near = np.flatnonzero(self.plan.distance(xy) < self.config.width_m / 2 + _BAY_DEPTH_M + _BAND_M)
        air = self._walls(xy[near], z)
        floor = self.floor(xy[near])[0]
        columns = np.maximum(air, floor[:, None] - z)
        field.reshape(-1, len(z))[near] = columns
        return field

    def _walls(self, xy: Floats, z: Floats) -> Floats:
        """Distance outside the rough walls and roof, of columns (C x 2) at heights z: C x len(z)."""
        outside = np.full((len(xy), len(z)), np.inf)
        foot = np.zeros((len(xy), len(z), 3))
        for course in self.plan.courses:
            s, left = course.local(xy)
            distance, at_wall = self._section(course, s[:, None], left[:, None], z)
            nearer = distance < outside
            outside = np.where(nearer, distance, outside)
            foot[nearer] = at_wall[nearer]
        if self.config.roughness:
            band = (outside > -0.3) & (outside < _BAND_M)
            outside[band] -= self.overbreak(foot[band])
        return outside

    def overbreak(self, p: Floats) -> Floats:
        """How far beyond the drawn outline the blast went at N x 3 points of it; metres, mostly > 0."""
        broken = self._large(p) + self._small(p) + 0.18 * self._smooth(p / 3.5) + 0.03 * self._smooth(p / 0.3)
        return self.config.roughness * np.clip(0.2 + broken, -0.12, 0.75)

    def _section(self, course: Course, s: Floats, left: Floats, z: Floats) -> tuple[Floats, Floats]:
        """Distance outside a horseshoe (upright walls, half an ellipse above), and a nearby point on it."""
        main = course is self.plan.main
        spring = 0.5 * self.config.height_m
        rise = self.config.height_m - spring
        half = (
            self.config.width_m / 2 * np.ones_like(s)
            if main
            else 0.47 * self.config.width_m * np.ones_like(s)
        )
        if main:
            half = half + _BAY_DEPTH_M * self.plan.in_bay(s) * (left < 0)
        up = np.maximum(z - spring, 0)
        q = np.maximum(np.hypot(left / half, up / rise), 1e-6)
        across = (q - 1) * np.where(up > 0, rise, half)
        past = np.maximum(-s, s - course.length_m)
        wall = np.stack(np.broadcast_arrays(s, left / q, np.where(z > spring, spring + up / q, z)), -1)
        wall[..., 0] = np.clip(wall[..., 0], 0, course.length_m)
        at_end = past > across
        wall = np.where(at_end[..., None], np.stack(np.broadcast_arrays(wall[..., 0], left, z), -1), wall)
        flat = wall.reshape(-1, 3)
        foot = course.at(flat[:, 0], flat[:, 1], flat[:, 2]).reshape(wall.shape)
        return np.maximum(across, past), foot

    def floor(self, xy: Floats) -> tuple[Floats, Floats]:
        """The floor's height at N x 2 points, and how much of it is a heap of loose rock; metres."""
        flat = np.c_[xy, np.zeros(len(xy))]
        height = 0.05 * self._smooth(flat / 2.4) + 0.025 * self._smooth(flat / 0.5)
        s, left = self.plan.main.local(xy)
        meander = 0.15 * np.sin(s / 5.0) + 0.1 * np.sin(s / 2.1)
        for track in (-0.95, 0.75):
            height -= 0.09 * np.exp(-(((left - track - meander) / 0.2) ** 2))
            height += 0.03 * np.exp(-(((np.abs(left - track - meander) - 0.36) / 0.12) ** 2))
        edge = np.maximum(self.plan.distance(xy) - 0.38 * self.config.width_m, 0)
        height += np.minimum(0.4 * edge, 0.3) * (1 + 0.5 * self._smooth(flat / 0.8))
        heap = np.zeros(len(xy))
        for x, y, top in self.plan.heaps:
            lumps = 0.18 * self._smooth(flat / 0.9) + 0.1 * self._smooth(flat / 0.35)
            heap = np.maximum(heap, top + lumps - REPOSE * np.hypot(xy[:, 0] - x, xy[:, 1] - y))
        return height + heap, heap
