"""The flight of a small drone along a drift: six degrees of freedom, jerky yet smooth.

Position and attitude are sums of splines, sines with random phases and bumps that are three times
continuously differentiable; velocities are their exact derivatives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion.errors import UsageError
from fusion.simulate.mine.scene_config import FlightConfig

Floats = NDArray[np.float64]

LEAD_S = 0.5  # the flight is defined so much before 0 and after `duration_s`: sensors integrate and predict
_SLOW_HZ, _FAST_HZ = (0.08, 0.5), (0.8, 2.4)
_PACE = 0.35  # share by which speed varies
_CHECK_HZ = 100.0
_SMOOTHING_M = 1.0


@dataclass(frozen=True, slots=True)
class Wobble:
    """A sum of sines, bounded by `amplitude`, and bumps (1 - u^2)^4 of `bump_width_s` to either side."""

    amplitude: float
    weights: Floats
    hz: Floats
    phase: Floats
    bump_s: Floats
    bump_size: Floats
    bump_width_s: Floats

    @classmethod
    def of(cls, rng: np.random.Generator, amplitude: float, fast: float) -> Wobble:
        """Seven sines of random phase, those of the fast band with a share of `fast`."""
        hz = np.r_[rng.uniform(*_SLOW_HZ, 4), rng.uniform(*_FAST_HZ, 3)]
        weights = np.r_[np.full(4, 1.0), np.full(3, 0.45 * fast)] * rng.uniform(0.6, 1.0, 7)
        none = np.empty(0)
        return cls(amplitude, weights / weights.sum(), hz, rng.uniform(0, 2 * np.pi, 7), none, none, none)

    def with_bumps(self, rng: np.random.Generator, times_s: Floats, size: float) -> Wobble:
        """The same with a bump of up to `size`, either way, at each of the times."""
        sizes = size * rng.uniform(0.4, 1.0, len(times_s)) * rng.choice((-1.0, 1.0), len(times_s))
        widths = rng.uniform(0.25, 0.6, len(times_s))
        return Wobble(self.amplitude, self.weights, self.hz, self.phase, times_s, sizes, widths)

    def __call__(self, t: Floats) -> tuple[Floats, Floats]:
        """Values and derivatives (1/s) at N times."""
        w = 2 * np.pi * self.hz
        angle = w * t[:, None] + self.phase
        u = np.clip((t[:, None] - self.bump_s) / self.bump_width_s, -1, 1)
        bell = 1 - u * u
        value = self.amplitude * _times(np.sin(angle), self.weights) + _times(bell**4, self.bump_size)
        slope = self.amplitude * _times(np.cos(angle), w * self.weights)
        return value, slope - _times(8 * u * bell**3, self.bump_size / self.bump_width_s)


def _times(a: Floats, b: Floats) -> Floats:
    """N x M times M. A library's product rounds differently for one row and for many; this one does not."""
    return np.einsum("ij,j->i", a, b)


class Flight:
    """Where the drone is at any time of `[-LEAD_S, duration_s + LEAD_S]`.

    `centre_line` is N x 3 metres in the world's frame, level or nearly so. Frames: world as the scene's; body
    x forward, y left, z up. The drone stays within 1.3 `sway_m` of the line (smoothed over about a metre) and
    never turns faster than `max_rate_deg_s`. Raises `UsageError` if the line alone turns faster, or is too
    short for a flight at this speed.
    """

    def __init__(self, config: FlightConfig, centre_line: ArrayLike, seed: int) -> None:
        rng = np.random.default_rng([seed, 4])
        self.config = config
        self._line, length = _smooth_line(np.asarray(centre_line, np.float64))
        v = config.speed_m_s
        fast = config.turbulence
        pace = self._pace = Wobble.of(rng, _PACE, 0.0)
        gained_s = 2 * _PACE * float((pace.weights / pace.hz).sum()) / (2 * np.pi)  # at most, over even speed
        self._start_m = (1 + _PACE) * LEAD_S * v
        self.duration_s = (length - self._start_m) / v - LEAD_S - gained_s
        if self.duration_s <= 0:
            what = f"{length:.1f} m are too short for a flight at {v:g} m/s"
            raise UsageError(what, where="flight", hint="fly slower or take a longer drift")
        self._sideways, self._up = (Wobble.of(rng, a, fast) for a in (config.sway_m, 0.8 * config.sway_m))
        amplitudes = np.deg2rad([config.yaw_deg, config.tilt_deg, config.tilt_deg])
        hits = np.sort(rng.uniform(0, self.duration_s, rng.poisson(config.jerks_per_s * self.duration_s)))
        self._turns = [Wobble.of(rng, a, fast).with_bumps(rng, hits, a) for a in amplitudes]
        self._calm = 1.0
        self._calm = self._calm_enough(np.deg2rad(config.max_rate_deg_s))

    def pose_at(self, t_s: ArrayLike) -> Floats:
        """T_world_body at one time in seconds (4 x 4) or at N. Raises `ValueError` outside the flight."""
        t, one = self._checked(t_s)
        yaw, pitch, roll = (value for value, _ in self._angles(t))
        T = np.tile(np.eye(4), (len(t), 1, 1))
        T[:, :3, :3] = _rotations(yaw, pitch, roll)
        T[:, :3, 3] = self._motion(t)[0]
        return T[0] if one else T

    def velocity_at(self, t_s: ArrayLike) -> Floats:
        """Velocity of the body's origin in the world's frame, m/s: 3 or N x 3. Raises as `pose_at`."""
        t, one = self._checked(t_s)
        velocity = self._motion(t)[1]
        return velocity[0] if one else velocity

    def angular_velocity_at(self, t_s: ArrayLike) -> Floats:
        """Angular velocity in the body's frame, rad/s: 3 or N x 3. Raises as `pose_at`."""
        t, one = self._checked(t_s)
        rates = self._rates(t)
        return rates[0] if one else rates

    def _checked(self, t_s: ArrayLike) -> tuple[Floats, bool]:
        t = np.asarray(t_s, np.float64)
        if t.ndim > 1 or not np.all((t >= -LEAD_S) & (t <= self.duration_s + LEAD_S)):
            raise ValueError(f"expected times from {-LEAD_S} to {self.duration_s + LEAD_S:.3f} s, got {t_s}")
        return np.atleast_1d(t), t.ndim == 0

    def _along(self, t: Floats) -> tuple[Floats, Floats]:
        """Metres along the line and their rate: even speed and the pace's wobble, integrated."""
        v, pace = self.config.speed_m_s, self._pace
        w = 2 * np.pi * pace.hz
        value, _ = pace(t)
        passed = np.cos(pace.phase) - np.cos(w * t[:, None] + pace.phase)
        ahead = pace.amplitude * _times(passed, pace.weights / w)
        return self._start_m + v * (t + ahead), v * (1 + value)

    def _motion(self, t: Floats) -> tuple[Floats, Floats]:
        s, pace = self._along(t)
        (side, side_rate), (up, up_rate) = self._sideways(t), self._up(t)
        ahead, left, turn = self._axes(s)
        point = self._line(s) + side[:, None] * left
        velocity = pace[:, None] * self._line(s, 1) + side_rate[:, None] * left
        velocity -= (side * turn * pace)[:, None] * ahead
        point[:, 2] += up
        velocity[:, 2] += up_rate
        return point, velocity

    def _axes(self, s: Floats) -> tuple[Floats, Floats, Floats]:
        """Level unit vectors along and left of the line, and its turn in radians a metre."""
        d, dd = self._line(s, 1), self._line(s, 2)
        level = np.hypot(d[:, 0], d[:, 1])
        c, n, zero = d[:, 0] / level, d[:, 1] / level, np.zeros(len(s))
        turn = (d[:, 0] * dd[:, 1] - d[:, 1] * dd[:, 0]) / level**2
        return np.c_[c, n, zero], np.c_[-n, c, zero], turn

    def _angles(self, t: Floats) -> list[tuple[Floats, Floats]]:
        """Yaw, pitch (nose down) and roll with their rates."""
        s, pace = self._along(t)
        ahead, _, turn = self._axes(s)
        yaw, pitch, roll = ((self._calm * a, self._calm * b) for a, b in (turns(t) for turns in self._turns))
        heading = np.arctan2(ahead[:, 1], ahead[:, 0])
        return [(heading + yaw[0], turn * pace + yaw[1]), pitch, roll]

    def _rates(self, t: Floats) -> Floats:
        (_, yaw_rate), (pitch, pitch_rate), (roll, roll_rate) = self._angles(t)
        x = roll_rate - yaw_rate * np.sin(pitch)
        y = pitch_rate * np.cos(roll) + yaw_rate * np.cos(pitch) * np.sin(roll)
        z = yaw_rate * np.cos(pitch) * np.cos(roll) - pitch_rate * np.sin(roll)
        return np.c_[x, y, z]

    def _calm_enough(self, limit: float) -> float:
        """The share of the attitude's wobble that keeps the turning rate below the limit at all times."""
        t = np.arange(-LEAD_S, self.duration_s + LEAD_S, 1 / _CHECK_HZ)

        def fastest(calm: float) -> float:
            self._calm = calm
            return float(np.linalg.norm(self._rates(t), axis=1).max())

        if fastest(0.0) > 0.97 * limit:
            hint = "fly slower, or allow faster turns"
            raise UsageError("the bend alone turns faster than max_rate_deg_s", where="flight", hint=hint)
        if fastest(1.0) <= 0.97 * limit:
            return 1.0
        low, high = 0.0, 1.0
        for _ in range(8):
            middle = (low + high) / 2
            low, high = (middle, high) if fastest(middle) <= 0.97 * limit else (low, middle)
        return low


def _smooth_line(xyz: Floats) -> tuple[Callable[..., Any], float]:
    """A spline of fifth degree near the points, by metres along it, and its length; the ends stay."""
    from scipy.interpolate import make_interp_spline
    from scipy.ndimage import gaussian_filter1d

    if xyz.ndim != 2 or xyz.shape[1] != 3 or len(xyz) < 8 or not np.isfinite(xyz).all():
        raise ValueError(f"expected at least 8 finite points N x 3, got {xyz.shape}")
    s = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(xyz, axis=0), axis=1))]
    even = np.linspace(0, s[-1], max(round(s[-1] / 0.25), 7) + 1)
    dense = np.stack([np.interp(even, s, a) for a in xyz.T], -1)
    step = even[1]
    # Odd reflection about the ends keeps them where they are.
    pad = min(round(4 * _SMOOTHING_M / step), len(dense) - 1)
    padded = np.vstack([2 * dense[0] - dense[pad:0:-1], dense, 2 * dense[-1] - dense[-2 : -pad - 2 : -1]])
    soft = gaussian_filter1d(padded, _SMOOTHING_M / step, axis=0)[pad : pad + len(dense)]
    length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(soft, axis=0), axis=1))]
    return make_interp_spline(length, soft, k=5), float(length[-1])


def _rotations(yaw: Floats, pitch: Floats, roll: Floats) -> Floats:
    """N x 3 x 3: around z, then y, then x."""
    (cz, sz), (cy, sy), (cx, sx) = ((np.cos(a), np.sin(a)) for a in (yaw, pitch, roll))
    rows = (
        (cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx),
        (sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx),
        (-sy, cy * sx, cy * cx),
    )
    return np.stack([np.stack(row, -1) for row in rows], -2)
