"""What the solve starts from and ends with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calib.observations import CloudView, View
from fusion.geometry import Floats
from fusion.rig import RigCamera


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Cameras by name; where sensors and boards are in the reference camera's frame.

    `T_ref_sensor` has every sensor, the reference with the identity. `T_ref_board` is by moment. `twist` (6,)
    by moment is how the board moves in its own frame, rotation (rad/s) then translation (m/s): a sensor that
    sees it at stamp + offset, s seconds after the moment, sees it at T_ref_board @ exp(s twist); a moment
    that has none stands still. `time_offset_s` by sensor is added to its stamps to give the reference's
    clock.
    """

    reference: str
    cameras: Mapping[str, RigCamera]
    T_ref_sensor: Mapping[str, Floats]
    T_ref_board: Mapping[str, Floats]
    twist: Mapping[str, Floats] = field(default_factory=dict)
    time_offset_s: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The estimate that fits best, and its evidence.

    `names` (P,) and `covariance` (P, P) are of everything but the boards' poses: ``rgb.fx`` (px) ... in the
    order fx fy cx cy and the distortion's; ``T_rgb_fir.rx ry rz`` (rad) and ``.tx ty tz`` (m);
    ``fir.time_offset_s``. A transformation's error is exp([r]) R, t + (tx, ty, tz): to the left of the
    estimate. Parameters that were held fixed have no row. `views` and `clouds` are those that took part;
    `residual_px` the (N, 2) errors, projected minus seen, of each view, `used` (N,) bool which of its points
    counted; `dropped_views` (file or moment, reason) the others. `plane_residual_m` and `edge_residual_m` are
    the same of each cloud. `sigma_px` is the noise of each camera, one coordinate, from the residuals;
    `sigma_m` that of the LiDAR's points on the plane, `sigma_edge_m` of those on the rim. `plane_used` and
    `edge_used` say which points of each cloud counted.
    """

    estimate: Estimate
    names: tuple[str, ...]
    covariance: Floats
    views: tuple[View, ...]
    residual_px: tuple[Floats, ...]
    used: tuple[NDArray[np.bool_], ...]
    sigma_px: Mapping[str, float]
    clouds: tuple[CloudView, ...] = ()
    plane_residual_m: tuple[Floats, ...] = ()
    edge_residual_m: tuple[Floats, ...] = ()
    sigma_m: float | None = None
    dropped_views: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()
    plane_used: tuple[NDArray[np.bool_], ...] = ()
    edge_used: tuple[NDArray[np.bool_], ...] = ()
    sigma_edge_m: float | None = None

    def rms_px(self, camera: str) -> float:
        """Root of the mean squared distance between projected and seen points of a camera that counted."""
        rows = [
            (r[u] ** 2).sum(1)
            for v, r, u in zip(self.views, self.residual_px, self.used, strict=True)
            if v.camera == camera
        ]
        return float(np.sqrt(np.concatenate(rows).mean())) if rows else float("nan")
