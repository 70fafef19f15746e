"""Where the drifts run and where in them things stand: the plan that rock, fittings and flight share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion.simulate.mine.meshes import Floats
from fusion.simulate.mine.scene_config import SceneConfig

_STEP_M = 0.05
_SIDE_LENGTH_M, _SIDE_TURN_DEG = 15.0, -62.0


@dataclass(frozen=True, slots=True)
class Course:
    """The axis of a drift on the floor, every 5 cm: `xy` N x 2 metres, `heading` N radians."""

    xy: Floats
    heading: Floats

    @classmethod
    def of(cls, start: Floats, heading: float, pieces: list[tuple[float, float]]) -> Course:
        """From `start`, along pieces of (length in metres, turn in radians; positive is left)."""
        turn = np.concatenate([np.full(round(n / _STEP_M), a / round(n / _STEP_M)) for n, a in pieces])
        headings = heading + np.concatenate([[0.0], np.cumsum(turn)])
        middle = (headings[1:] + headings[:-1]) / 2
        steps = _STEP_M * np.c_[np.cos(middle), np.sin(middle)]
        return cls(start + np.vstack([np.zeros((1, 2)), np.cumsum(steps, 0)]), headings)

    @property
    def length_m(self) -> float:
        return (len(self.xy) - 1) * _STEP_M

    def at(self, s: Floats | float, left: Floats | float = 0.0, z: Floats | float = 0.0) -> Floats:
        """N x 3 world points at `s` metres along, `left` of the axis, at height `z`; clamped to its ends."""
        s, left, z = np.broadcast_arrays(*(np.atleast_1d(np.asarray(a, np.float64)) for a in (s, left, z)))
        station = np.arange(len(self.xy)) * _STEP_M
        x, y, angle = (np.interp(s, station, a) for a in (*self.xy.T, self.heading))
        return np.stack([x - left * np.sin(angle), y + left * np.cos(angle), z], -1)

    def heading_at(self, s: float) -> float:
        return float(np.interp(s, np.arange(len(self.xy)) * _STEP_M, self.heading))

    def local(self, xy: Floats) -> tuple[Floats, Floats]:
        """Metres along the axis and to its left of N x 2 points; straight on before and past its ends."""
        from scipy.spatial import KDTree

        k = KDTree(self.xy).query(xy)[1]
        off = xy - self.xy[k]
        c, s = np.cos(self.heading[k]), np.sin(self.heading[k])
        return k * _STEP_M + off[:, 0] * c + off[:, 1] * s, off[:, 1] * c - off[:, 0] * s


@dataclass(frozen=True, slots=True)
class Plan:
    """The main drift and the side drift; `_s` are metres along the main one.

    `heaps` are cones of loose rock (x, y, height), `bay_s` is where the right wall stands back for a machine.
    """

    main: Course
    side: Course | None
    junction_s: float
    bay_s: tuple[float, float]
    person_s: float
    sets_s: tuple[float, ...]
    heaps: tuple[tuple[float, float, float], ...]

    @classmethod
    def of(cls, config: SceneConfig) -> Plan:
        """The plan that a configuration asks for."""
        length, bend = config.length_m, np.deg2rad(config.bend_deg)
        before, arc = 0.53 * length, max(9.0 * bend, 0.5)
        main = Course.of(np.zeros(2), 0.0, [(before, 0.0), (arc, bend), (length - before - arc, 0.0)])
        junction = 0.28 * length
        side, heaps = None, [(*main.at(length - 0.3)[0, :2], 2.6)]
        if config.side_drift:
            turn = np.deg2rad(_SIDE_TURN_DEG)
            side = Course.of(np.array([junction, 0.0]), turn, [(_SIDE_LENGTH_M, 0.0)])
            heaps.append((*side.at(_SIDE_LENGTH_M - 5.0, -0.7)[0, :2], 1.7))
        sets = (0.10 * length, 0.10 * length + 1.6, 0.10 * length + 3.2)
        bay = (0.41 * length, 0.41 * length + 8.6)
        return cls(main, side, junction, bay, 0.20 * length, sets, tuple(heaps))

    @property
    def courses(self) -> tuple[Course, ...]:
        return (self.main,) if self.side is None else (self.main, self.side)

    def distance(self, xy: Floats) -> Floats:
        """How far N x 2 points are from the nearest axis, metres; inf beyond 8 m."""
        from scipy.spatial import KDTree

        track = np.vstack([course.xy for course in self.courses])
        return KDTree(track).query(xy, distance_upper_bound=8.0)[0]

    def in_bay(self, s: Floats) -> Floats:
        """1 in the passing bay, 0 elsewhere, over 2 m from the one to the other."""
        step = np.clip(np.minimum(s - self.bay_s[0], self.bay_s[1] - s) / 2.0 + 0.5, 0, 1)
        return step * step * (3 - 2 * step)
