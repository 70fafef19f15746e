"""What runs along a drift and holds it up: pipe, duct, cables, timber and steel, bolts, lamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion.simulate.mine.course import Course, Plan
from fusion.simulate.mine.meshes import Floats, Mesh, box, copies, frame, join, rod, tube
from fusion.simulate.mine.parts import Floor, Part, Reach
from fusion.simulate.mine.scene_config import SceneConfig

_PIPE_R, _DUCT_R = 0.09, 0.34
LAMP_BGR = (14.0, 19.0, 24.0)  # radiant intensity of a lit lamp: irradiance at one metre


@dataclass(frozen=True, slots=True)
class Fitter:
    """Hangs things on the rock of one drift as it is found there."""

    config: SceneConfig
    plan: Plan
    reach: Reach
    floor: Floor
    seed: int

    def fittings(self) -> list[Part]:
        """Everything but stones, machine and person."""
        return [
            *self._pipe(),
            *self._duct(),
            *self._cables(),
            *self._timber(),
            *self._arches(),
            *self._bolts(),
        ]

    def _rng(self, part: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, 2, part])

    def _wall(self, s: Floats, z: float) -> Floats:
        """How far the left wall is from the axis at each s: the least over 1.5 m either way."""
        return self._least(s, 0.0, z, np.array([0.0, 1.0, 0.0]))

    def _least(self, s: Floats, left: float, z: float, across: Floats) -> Floats:
        """The least distance to rock over 1.5 m either way, from (left, z), along (forward, left, up)."""
        around = s[:, None] + np.linspace(-1.5, 1.5, 13)
        start = self.plan.main.at(around.ravel(), left, z)
        heading = np.array([self.plan.main.heading_at(v) for v in around.ravel()])
        c, n = np.cos(heading), np.sin(heading)
        way = np.c_[c * across[0] - n * across[1], n * across[0] + c * across[1], np.full(len(c), across[2])]
        return self.reach(start, way).reshape(around.shape).min(1)

    def _stations(self, every_m: float) -> Floats:
        return np.arange(0.4, self.plan.main.length_m - 4.0, every_m)

    def _pipe(self) -> list[Part]:
        main, s, z = self.plan.main, self._stations(3.0), 1.30
        wall = self._wall(s, z)
        left = wall - _PIPE_R - 0.12
        points = main.at(s, left, z)
        flanges = [_ring(p, main.heading_at(v), 1.65 * _PIPE_R) for p, v in zip(points, s, strict=True)]
        arms = [
            rod(p - (0, 0, _PIPE_R), q, 0.02, sides=6)
            for p, q in zip(points, main.at(s, wall + 0.5, z - 0.2), strict=True)
        ]
        return [
            Part("pipe", "pipe", tube(points, _PIPE_R, 16)),
            Part("pipe", "flange", join(flanges)),
            Part("pipe hangers", "steel", join(arms)),
        ]

    def _duct(self) -> list[Part]:
        main, left = self.plan.main, 0.25 * self.config.width_m * 0.8
        s = self._stations(1.6)
        roof = 1.8 + self._least(s, left, 1.8, np.array([0.0, 0.0, 1.0]))
        z = np.clip(roof - _DUCT_R - 0.10, 2.6, 0.78 * self.config.height_m)
        hung = main.at(s, left, z)
        fine = np.arange(s[0], s[-1], 0.2)
        sag = 0.05 * (1 - np.cos(2 * np.pi * (fine - s[0]) / 1.6)) / 2
        bulge = _DUCT_R * (0.94 + 0.06 * np.sqrt(np.abs(np.sin(np.pi * (fine - s[0]) / 0.8))))
        hose = tube(main.at(fine, left, np.interp(fine, s, z) - sag), bulge, 18)
        straps = [_hanger(p, 0.9 * _DUCT_R, 1.6, 0.012) for p in hung]
        return [Part("duct", "duct", hose), Part("duct hangers", "steel", join(straps))]

    def _cables(self) -> list[Part]:
        rng, main, s = self._rng(1), self.plan.main, self._stations(2.3)
        cables = []
        for z, radius in ((2.05, 0.03), (2.2, 0.022), (2.33, 0.035)):
            left = self._wall(s, z) - radius - 0.03
            fine = np.linspace(s[0], s[-1], 9 * (len(s) - 1) + 1)
            u = (fine - s[0]) / 2.3
            depth = rng.uniform(0.08, 0.30, len(s))[np.minimum(u.astype(int), len(s) - 1)]
            drop = 4 * depth * (u % 1) * (1 - u % 1)
            cables.append(tube(main.at(fine, np.interp(fine, s, left), z - drop), radius, 7))
        return [Part("cables", "cable", join(cables))]

    def _timber(self) -> list[Part]:
        """Round posts under split head boards, at both walls."""
        rng, posts = self._rng(2), []
        for s in self.plan.sets_s:
            for sign in (1, -1):
                left = sign * 0.375 * self.config.width_m + rng.uniform(-0.05, 0.05)
                foot = self.plan.main.at(s, left, 0.0)[0]
                foot[2] = self.floor(foot[None, :2])[0] - 0.1
                start = np.array([[foot[0], foot[1], 1.5]])
                top = 1.5 + self.reach(start, np.array([[0, 0, 1.0]]))[0]
                lean = foot + np.array([*rng.uniform(-0.06, 0.06, 2), 0])
                head = box((-0.28, -0.13, -0.1), (0.28, 0.13, 0.08)).moved(
                    frame((*lean[:2], top), rng.uniform(0, 3))
                )
                posts += [rod(foot, (*lean[:2], top), 0.115, 0.095, 14), head]
        return [Part("timber", "timber", join(posts))]

    def _arches(self) -> list[Part]:
        """Steel arches at either side of the side drift's mouth, on three feet of rail section."""
        arches = []
        for s in (self.plan.junction_s - 4.2, self.plan.junction_s - 3.0, self.plan.junction_s + 5.6):
            half, spring = 0.46 * self.config.width_m, 0.5 * self.config.height_m
            rise = 0.94 * self.config.height_m - spring
            angle = np.linspace(0, np.pi, 25)
            left = np.r_[half, half * np.cos(angle), -half]
            up = np.r_[-0.1, spring + rise * np.sin(angle), -0.1]
            flange = [
                self._rib(s + off, left * scale, up * scale, r)
                for off, scale, r in ((0, 1.0, 0.05), (0, 0.965, 0.05))
            ]
            arches += [*flange, self._rib(s, 0.982 * left, 0.982 * up, 0.035)]
        return [Part("arches", "steel", join(arches))]

    def _rib(self, s: float, left: Floats, up: Floats, radius: float) -> Mesh:
        return tube(self.plan.main.at(s, left, up), radius, 6)

    def _bolts(self) -> list[Part]:
        """Rows of rock bolts with their plates, square to the rock around them."""
        rng = self._rng(3)
        courses = [(c, s) for c in self.plan.courses for s in np.arange(1.0, c.length_m - 2.0, 1.45)]
        placed = [self._bolt_row(c, s + rng.uniform(-0.2, 0.2), rng) for c, s in courses]
        T = np.concatenate(placed)
        plate = join(
            [box((-0.09, -0.09, 0), (0.09, 0.09, 0.012)), rod((0, 0, 0), (0, 0, 0.09), 0.014, sides=6)]
        )
        nut = rod((0, 0, 0.01), (0, 0, 0.045), 0.03, sides=6)
        return [Part("bolts", "plate", copies([join([plate, nut])], np.zeros(len(T), np.int64), T))]

    def _bolt_row(self, course: Course, s: float, rng: np.random.Generator) -> Floats:
        angle = np.deg2rad(np.array([-8.0, 22, 50, 78, 102, 130, 158, 188]) + rng.uniform(-7, 7, 8))
        heading = course.heading_at(s)
        start = np.repeat(course.at(s, 0.0, 1.9), 8, 0)
        sideways = np.array([-np.sin(heading), np.cos(heading), 0.0])
        way = np.cos(angle)[:, None] * sideways + np.sin(angle)[:, None] * (0, 0, 1.0)
        nudge = 0.08 * np.array([np.cos(heading), np.sin(heading), 0.0])
        here, along = self.reach(start, way), self.reach(start + nudge, way)
        point = start + way * here[:, None]
        ahead = start + nudge + way * along[:, None] - point
        beside = np.cross(way, ahead)
        inward = np.cross(ahead, beside)
        inward *= -np.sign(np.einsum("ij,ij->i", inward, way))[:, None]
        axes = [
            a / np.linalg.norm(a, axis=1, keepdims=True) for a in (ahead, np.cross(inward, ahead), inward)
        ]
        T = np.tile(np.eye(4), (8, 1, 1))
        T[:, :3, :3], T[:, :3, 3] = np.stack(axes, -1), point
        smooth = np.abs(along - here) < 0.05
        return T[smooth & (here < 0.75 * self.config.width_m)]

    def lamps(self) -> tuple[list[Part], Floats, Floats]:
        """Bulkhead lamps under the roof, some dead: parts; where the lit ones are; their intensity."""
        rng, main = self._rng(4), self.plan.main
        s = np.arange(6.5, main.length_m - 8.0, 9.0)
        left = -0.16 * self.config.width_m
        z = 1.8 + self._least(s, left, 1.8, np.array([0.0, 0.0, 1.0])) - 0.08
        at = main.at(s, left, z)
        lit = rng.uniform(size=len(s)) < 0.55
        poses = [frame(p, main.heading_at(v)) for p, v in zip(at, s, strict=True)]
        case = box((-0.32, -0.07, -0.02), (0.32, 0.07, 0.05))
        glass = box((-0.28, -0.045, -0.06), (0.28, 0.045, -0.02))
        cases = [case.moved(T) for T in poses] + [_hanger(p, 0.0, 1.2, 0.01) for p in at]
        burning = ["lamp" if on else "glass" for on in lit]
        bulbs = [Part("lamps", what, glass.moved(T)) for what, T in zip(burning, poses, strict=True)]
        parts = [Part("lamps", "steel", join(cases)), *bulbs]
        return parts, at[lit] - (0, 0, 0.12), np.tile(LAMP_BGR, (int(lit.sum()), 1))


def _hanger(at: Floats, low: float, high: float, radius: float) -> Mesh:
    return rod(at + np.array([0, 0, low]), at + np.array([0, 0, high]), radius, sides=5)


def _ring(centre: Floats, heading: float, radius: float) -> Mesh:
    way = 0.03 * np.array([np.cos(heading), np.sin(heading), 0.0])
    return rod(centre - way, centre + way, radius, sides=18)
