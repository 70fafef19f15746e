"""What lies on the floor: stones along the walls, blocks on the heaps, water in the hollows."""

from __future__ import annotations

import numpy as np

from fusion.simulate.mine.course import Course, Plan
from fusion.simulate.mine.meshes import Floats, Mesh, copies, frame, stone
from fusion.simulate.mine.parts import Floor, Part
from fusion.simulate.mine.rock import REPOSE, WATER_M
from fusion.simulate.mine.scene_config import SceneConfig

_KINDS = 20


def loose(config: SceneConfig, plan: Plan, floor: Floor, seed: int) -> list[Part]:
    """Stones, blocks and water of all drifts."""
    rng = np.random.default_rng([seed, 3])
    kinds = [stone(rng) for _ in range(_KINDS)]
    gravel = [_gravel(config, course, floor, kinds, rng) for course in plan.courses]
    blocks = [_blocks(heap, floor, kinds, rng) for heap in plan.heaps]
    return [
        *(Part("gravel", "stone", mesh) for mesh in gravel),
        *(Part("muck pile", "muck", mesh) for mesh in blocks),
        Part("water", "water", _sheet(plan.main, 0.42 * config.width_m)),
    ]


def _gravel(
    config: SceneConfig, course: Course, floor: Floor, kinds: list[Mesh], rng: np.random.Generator
) -> Mesh:
    """Small stones, most of them at the foot of the walls where no wheel goes."""
    n = round(15 * course.length_m)
    side = rng.choice((-1.0, 1.0), n) * (1 - rng.beta(1.1, 3.0, n)) * 0.5 * config.width_m
    xy = course.at(rng.uniform(0.3, course.length_m - 0.3, n), side)[:, :2]
    size = np.clip(0.05 * rng.lognormal(0.0, 0.55, n), 0.03, 0.30) * (
        0.5 + 0.7 * np.abs(side) / config.width_m * 2
    )
    return _scatter(xy, floor(xy) + 0.12 * size, size, kinds, rng)


def _blocks(
    heap: tuple[float, float, float], floor: Floor, kinds: list[Mesh], rng: np.random.Generator
) -> Mesh:
    """Blasted rock of all sizes over a cone; the big ones have rolled to its foot."""
    x, y, top = heap
    n = round(230 * top)
    away = top / REPOSE * np.sqrt(rng.uniform(0, 1.3, n))
    angle = rng.uniform(0, 2 * np.pi, n)
    xy = np.c_[x + away * np.cos(angle), y + away * np.sin(angle)]
    size = np.clip(0.17 * rng.lognormal(0.0, 0.6, n), 0.06, 0.8) * (0.7 + 0.5 * away * REPOSE / top)
    return _scatter(xy, floor(xy) + 0.05 * size, size, kinds, rng)


def _scatter(xy: Floats, z: Floats, size: Floats, kinds: list[Mesh], rng: np.random.Generator) -> Mesh:
    turn = rng.uniform(0, 2 * np.pi, (len(xy), 3)) * (1, 0.15, 0.15)
    T = np.stack([frame((*p, h), *angles) for p, h, angles in zip(xy, z, turn, strict=True)])
    T[:, :3, :3] *= size[:, None, None]
    return copies(kinds, rng.integers(0, len(kinds), len(xy)), T)


def _sheet(course: Course, half_m: float) -> Mesh:
    """The water table: a level ribbon under the whole floor, seen where the floor is lower."""
    s = np.arange(0.0, course.length_m, 1.0)
    left, right = course.at(s, half_m, WATER_M), course.at(s, -half_m, WATER_M)
    k = np.arange(len(s) - 1)
    a, b, n = k, k + 1, len(s)
    return Mesh(
        np.vstack([left, right]), np.stack([np.c_[a, n + a, n + b], np.c_[a, n + b, b]], 1).reshape(-1, 3)
    )
