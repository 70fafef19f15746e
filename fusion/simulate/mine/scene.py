"""The mine that rays are cast into: rock, what stands in it, where lamps hang and where a drone can fly."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.kernels import read_only
from fusion.open3d import load
from fusion.simulate.mine.cast_kernels import look_up
from fusion.simulate.mine.course import Plan
from fusion.simulate.mine.fittings import Fitter
from fusion.simulate.mine.hits import Floats, Hits, Material
from fusion.simulate.mine.loose import loose
from fusion.simulate.mine.machine import machine
from fusion.simulate.mine.materials import INDEX, MATERIALS
from fusion.simulate.mine.meshes import Floats as Points
from fusion.simulate.mine.meshes import Mesh, frame, join
from fusion.simulate.mine.parts import Part
from fusion.simulate.mine.person import person
from fusion.simulate.mine.rock import FLOOR, MUCK, ROCK, Ground
from fusion.simulate.mine.scene_config import SceneConfig

_KINDS = {ROCK: "rock", FLOOR: "floor", MUCK: "muck"}
_FLIGHT_M = 1.5  # height of the line along which free space is measured


class Caster:
    """Rays against one mesh whose triangles each have a material."""

    def __init__(self, mesh: Mesh, materials: NDArray[np.uint8]) -> None:
        o3d = load()
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(mesh.vertices.astype(np.float32), mesh.triangles.astype(np.uint32))
        self._normals = read_only(mesh.normals().astype(np.float32))
        self._materials = read_only(np.ascontiguousarray(materials, np.uint8))

    def cast(self, rays: Floats, nthreads: int = 0) -> Hits:
        """See `hits.Scene.cast`. `nthreads` is how many threads Open3D may use; 0 leaves it to Open3D."""
        rays = np.ascontiguousarray(rays, np.float32)
        if rays.ndim != 2 or rays.shape[1] != 6:
            raise ValueError(f"expected N x 6 rays (origin, unit direction), got {rays.shape}")
        normal, material = np.empty((len(rays), 3), np.float32), np.empty(len(rays), np.uint8)
        if not len(rays):
            return Hits(np.empty(0, np.float32), normal, material, np.empty(0, np.float32))
        found = self._scene.cast_rays(rays, nthreads=nthreads)
        look_up(found["primitive_ids"].numpy(), rays, self._normals, self._materials, normal, material)
        return Hits(found["t_hit"].numpy(), normal, material, np.full(len(rays), np.nan, np.float32))

    def reach(self, points: Points, directions: Points) -> Points:
        """How far N x 3 unit directions go from N x 3 points, N metres; inf where they meet nothing."""
        rays = np.hstack([points, directions]).astype(np.float32)
        return self._scene.cast_rays(rays)["t_hit"].numpy().astype(np.float64)


@dataclass(frozen=True, slots=True)
class Box:
    """The axis-parallel box around an object, in the world's frame, metres."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @property
    def centre(self) -> tuple[float, float, float]:
        a, b = np.array(self.low), np.array(self.high)
        x, y, z = ((a + b) / 2).tolist()
        return x, y, z


@dataclass(frozen=True, slots=True)
class MineScene:
    """A mine; its world is x along the drift's start, y left, z up, floor near z = 0, metres.

    `mesh` is all there is as one mesh, `triangle_materials` (M uint8) what each triangle is made of: an index
    into `materials`. `centre_line` (N x 3) is where a drone can fly, every 25 cm, `free_radius` (N) how far
    the nearest thing is from each of its points, all ways. `objects` names what stands in the mine. `lamps`
    (L x 3) are the lamps that are lit, `lamp_bgr` (L x 3) their radiant intensities: irradiance at one metre.
    """

    materials: tuple[Material, ...]
    mesh: Mesh
    triangle_materials: NDArray[np.uint8]
    centre_line: Points
    free_radius: Points
    objects: dict[str, Box]
    lamps: Points
    lamp_bgr: Points
    caster: Caster = field(repr=False)

    def cast(self, rays: Floats, **options: Any) -> Hits:
        """N x 6 float32 rays to where they end; option `nthreads` as in `Caster.cast`, no other counts."""
        return self.caster.cast(rays, int(options.get("nthreads", 0)))


def build_scene(config: SceneConfig, seed: int) -> MineScene:
    """The mine of a configuration and a seed; the same two give the same mine to the last bit."""
    plan = Plan.of(config)
    ground = Ground(config, plan, seed)
    rock, kinds = ground.mesh()
    bare = Caster(rock, kinds)
    fitter = Fitter(config, plan, bare.reach, lambda xy: ground.floor(xy)[0], seed)
    lamp_parts, lamp_xyz, lamp_bgr = fitter.lamps()
    parts = [
        *fitter.fittings(),
        *lamp_parts,
        *loose(config, plan, fitter.floor, seed),
        *_guests(config, plan, fitter),
    ]
    meshes = [rock, *(part.mesh for part in parts)]
    names = np.array([INDEX[_KINDS[k]] for k in sorted(_KINDS)], np.uint8)
    materials = [names[kinds], *(np.full(len(p.mesh.triangles), INDEX[p.material], np.uint8) for p in parts)]
    mesh, triangle_materials = join(meshes), np.concatenate(materials)
    caster = Caster(mesh, triangle_materials)
    line, free = _flyable(plan, caster)
    return MineScene(
        MATERIALS, mesh, triangle_materials, line, free, _boxes(parts), lamp_xyz, lamp_bgr, caster
    )


def _guests(config: SceneConfig, plan: Plan, fitter: Fitter) -> list[Part]:
    parts: list[Part] = []
    if config.person:
        at = plan.main.at(plan.person_s, 0.30 * config.width_m)
        at[0, 2] = fitter.floor(at[:, :2])[0]
        parts += person(frame(at[0], plan.main.heading_at(plan.person_s) + np.pi - 0.35))
    if config.machine:
        s = sum(plan.bay_s) / 2
        at = plan.main.at(s, -0.44 * config.width_m)
        parts += machine(frame(at[0], plan.main.heading_at(s) - 0.03))
    return parts


def _flyable(plan: Plan, caster: Caster) -> tuple[Points, Points]:
    s = np.arange(2.5, plan.main.length_m - 7.0, 0.25)
    line = plan.main.at(s, 0.0, _FLIGHT_M)
    return line, free_radius(caster, line)


def free_radius(caster: Caster, points: Points, directions: int = 400) -> Points:
    """How far the nearest thing is from N x 3 points, over directions spread evenly (Fibonacci); N metres."""
    k = np.arange(directions) + 0.5
    z, turn = 1 - 2 * k / directions, np.pi * (1 + np.sqrt(5)) * k
    way = np.c_[np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z]
    reach = caster.reach(np.repeat(points, directions, 0), np.tile(way, (len(points), 1)))
    return reach.reshape(len(points), directions).min(1)


def _boxes(parts: list[Part]) -> dict[str, Box]:
    owners = dict.fromkeys(part.owner for part in parts)
    every = {owner: np.vstack([p.mesh.vertices for p in parts if p.owner == owner]) for owner in owners}
    return {owner: Box(tuple(v.min(0).tolist()), tuple(v.max(0).tolist())) for owner, v in every.items()}
