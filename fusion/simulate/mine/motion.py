"""When sensors look, by which clock, from where, and how fast they move."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from fusion.geometry import T_CAM_LIDAR, Floats, pose
from fusion.simulate.mine.config import ClockConfig, MountConfig

_STEP_S = 1e-3


class Path(Protocol):
    """Anything that moves the drone's body frame (x forward, y left, z up)."""

    def pose_at(self, t_s: ArrayLike) -> Floats:
        """T_world_body at true times in seconds: 4 x 4 for one, N x 4 x 4 for N."""
        ...


@dataclass(frozen=True, slots=True)
class Clock:
    """own = true * (1 + drift) + offset; true time is seconds since the recording's beginning."""

    offset_s: float
    drift: float = 0.0

    @classmethod
    def of(cls, config: ClockConfig) -> Clock:
        return cls(config.offset_s, config.drift_ppm * 1e-6)

    def stamp_ns(self, true_s: float) -> int:
        """The stamp that this clock shows, integer nanoseconds, rounded half up."""
        return int(np.floor(true_s * (1 + self.drift) * 1e9 + 0.5)) + round(self.offset_s * 1e9)

    def true_s(self, stamp_ns: int) -> float:
        """The true time of a stamp, in seconds."""
        return (stamp_ns - round(self.offset_s * 1e9)) * 1e-9 / (1 + self.drift)


def instants(clock: Clock, rate_hz: float, first_s: float, duration_s: float) -> list[float]:
    """True times of a sensor that its own clock triggers at `rate_hz`, from `first_s` on, inside the
    duration.
    """
    period = 1 / rate_hz / (1 + clock.drift)
    return [first_s + k * period for k in range(max(int(np.ceil((duration_s - first_s) / period - 1e-9)), 0))]


def mounted(mount: MountConfig, camera: bool) -> Floats:
    """T_body_sensor of a mount; a camera's own axes are x right, y down, z forward."""
    yaw, pitch, roll = np.radians(mount.yaw_pitch_roll_deg)
    R = _about(2, yaw) @ _about(1, pitch) @ _about(0, roll)
    return pose(R @ T_CAM_LIDAR[:3, :3].T if camera else R, mount.position_m)


def twist(path: Path, t_s: float, T_body_sensor: Floats) -> tuple[Floats, Floats]:
    """Velocity (m/s) and angular velocity (rad/s) of a sensor in its own frame, from poses 1 ms to either
    side.
    """
    before, now, after = path.pose_at(t_s + _STEP_S * np.array([-1, 0, 1])) @ T_body_sensor
    R = now[:3, :3].T
    turn = R @ after[:3, :3] @ before[:3, :3].T @ R.T
    axis = (
        np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    )  # sin of it
    return R @ (after - before)[:3, 3] / (2 * _STEP_S), axis / (2 * _STEP_S)


def _about(axis: int, angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[j, j] = R[k, k] = c
    R[k, j], R[j, k] = s, -s
    return R
