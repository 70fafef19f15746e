"""Lamps as a table that the kernels read: head lamps move with the drone, others hang and cast shadows."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from fusion.geometry import Floats as Matrix
from fusion.simulate.mine import kernels as k
from fusion.simulate.mine.config import LampsConfig
from fusion.simulate.mine.hits import Floats, Scene

REACH_M = 16.0
NEAREST = 6  # scene lamps that light one frame
_SIDE = 128  # of a shadow cube's face
_START_M = 0.3  # nothing this close to a lamp casts a shadow: that is its own housing
_FACES = (
    ((1, 0, 0), 1, 2),
    ((-1, 0, 0), 1, 2),
    ((0, 1, 0), 0, 2),
    ((0, -1, 0), 0, 2),
    ((0, 0, 1), 0, 1),
    ((0, 0, -1), 0, 1),
)


class Lit(Scene, Protocol):
    """A scene that has lamps: L x 3 positions in the world (metres) and radiant intensities, BGR."""

    @property
    def lamps(self) -> Any: ...

    @property
    def lamp_bgr(self) -> Any: ...


class Lights:
    """All lamps of a recording. `at` gives the table for one pose of the drone, `cubes` the shadows."""

    def __init__(self, config: LampsConfig, scene: Lit, shadows: bool = True) -> None:
        self._config = config
        self._positions = np.asarray(scene.lamps, np.float64).reshape(-1, 3)
        colours = config.scene_gain * np.asarray(scene.lamp_bgr, np.float64).reshape(-1, 3)
        if config.scene_gain == 0:
            self._positions = self._positions[:0]
        hung = zip(self._positions, colours, strict=False)
        self._scene_rows = [self._hung(p, c, j if shadows else -1) for j, (p, c) in enumerate(hung)]
        cubes = [shadow_cube(scene, p) for p in self._positions] if shadows else []
        self.cubes: Floats = np.stack(cubes) if cubes else np.full((1, 6, 2, 2), np.inf, np.float32)

    def at(self, T_world_body: Matrix) -> Floats:
        """The table (lamps x 14 float32): the nearest scene lamps, then the head lamps."""
        away = np.linalg.norm(self._positions - T_world_body[:3, 3], axis=1)
        near = np.argsort(away, kind="stable")[:NEAREST]
        rows = [self._scene_rows[j] for j in near if away[j] < REACH_M + 25]
        rows += [self._carried(p, T_world_body) for p in self._config.positions_m]
        return np.array(rows or [self._dark()], np.float32)

    @staticmethod
    def _hung(position: Matrix, colour: Matrix, cube: int) -> Matrix:
        return np.array([*position, 0, 0, -1, *colour, 1e6, 1, cube, REACH_M**2, 0])

    def _carried(self, position: tuple[float, float, float], T_world_body: Matrix) -> Matrix:
        c = self._config
        down, out = np.radians(c.pitch_deg), np.radians(c.toe_out_deg) * np.sign(position[1])
        axis = np.array([np.cos(down) * np.cos(out), np.cos(down) * np.sin(out), -np.sin(down)])
        colour = c.intensity * np.array(c.colour_bgr)
        width = (1 - np.cos(np.radians(c.beam_deg) / 2)) / np.sqrt(np.sqrt(2) - 1)
        at, ahead = T_world_body[:3, :3] @ position + T_world_body[:3, 3], T_world_body[:3, :3] @ axis
        return np.array([*at, *ahead, *colour, width, c.spill, -1, 1e12, 1])

    @staticmethod
    def _dark() -> Matrix:
        return np.array([0, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0, -1, 0, 1])


def shadow_cube(scene: Scene, position: Matrix, side: int = _SIDE) -> Floats:
    """Distances (6 x side x side) from a lamp to what it lights, towards +x -x +y -y +z -z."""
    at = (np.arange(side) + 0.5) / side * 2 - 1
    v, u = np.meshgrid(at, at, indexing="ij")
    directions = np.zeros((6, side, side, 3))
    for face, (forward, column, row) in enumerate(_FACES):
        directions[face] += forward
        directions[face, ..., column] += u
        directions[face, ..., row] += v
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    rays = np.concatenate([position + _START_M * directions, directions], -1).reshape(-1, 6)
    return (scene.cast(rays.astype(np.float32)).range_m + _START_M).astype(np.float32).reshape(6, side, side)


def material_table(scene: Scene, wet_floor: float) -> Floats:
    """The scene's materials as the kernels read them (M x 13 float32). Only what is called a floor can be
    wet.
    """
    rows = []
    for m in scene.materials:
        wet = wet_floor if "floor" in m.name else 0.0
        look = (*m.albedo_bgr, m.albedo_spread, m.bump, 1 / m.texture_m, *m.emits_bgr, wet)
        rows.append((*look, m.temperature_degC, m.temperature_spread_degC, m.emissivity))
    table = np.array(rows, np.float32)
    if table.shape[1] != k.EMISSIVITY + 1:
        raise ValueError(f"expected {k.EMISSIVITY + 1} columns, got {table.shape[1]}")
    return table
