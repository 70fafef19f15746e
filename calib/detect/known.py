"""Where on the image a place of the board must be, from places that are known."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from fusion.geometry import Floats

_NEIGHBOURS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """Places on the board `xy` (N, 2) whose pixels `uv` (N, 2) are known, and their homography `H`."""

    xy: Floats
    uv: Floats
    H: Floats

    @classmethod
    def of(cls, xy: Floats, uv: Floats, *, robust: bool) -> Known | None:
        """From at least four places; `robust` leaves out those that contradict the others (RANSAC).

        None where they lie on a line or have no homography.
        """
        if len(xy) < 4 or np.linalg.matrix_rank(xy - xy.mean(0), 1e-6 * np.abs(xy).max()) < 2:
            return None
        gap = float(np.linalg.norm(np.ptp(uv, axis=0)) / 50 + 2.0)  # room for a lens's distortion
        H, mask = cv2.findHomography(xy, uv, cv2.RANSAC if robust else 0, gap)
        if H is None or not np.isfinite(H).all() or abs(np.linalg.det(H)) < 1e-12:
            return None
        keep = np.ravel(mask).astype(bool) if robust else np.ones(len(xy), bool)
        return cls(xy[keep], uv[keep], np.asarray(H, np.float64)) if keep.sum() >= 4 else None

    def predict(self, xy: Floats, *, without_itself: bool = False) -> tuple[Floats, Floats]:
        """Pixels (K, 2) of places (K, 2), and how far the nearest known place is (K,).

        The homography, corrected by the plane through its errors at the nearest places: so it follows a
        lens's distortion. `without_itself` leaves out, for each place, the known one that is nearest to it.
        """
        away = np.linalg.norm(xy[:, None] - self.xy[None], axis=2)
        near = np.argsort(away, axis=1, kind="stable")[:, int(without_itself) : _NEIGHBOURS]
        gaps = np.take_along_axis(away, near, 1)
        error = (self.uv - mapped(self.H, self.xy))[near]
        reach = gaps[:, -1:] + 1e-12
        w = 1 / (gaps / reach + 0.1)
        slope = (self.xy[near] - xy[:, None]) / reach[..., None]
        plane = np.concatenate([np.ones((*near.shape, 1)), slope], 2)
        square = np.einsum("kni,kn,knj->kij", plane, w, plane) + np.diag([0, 0.3, 0.3])
        part = np.linalg.solve(square, np.einsum("kni,kn,knj->kij", plane, w, error))
        return mapped(self.H, xy) + part[:, 0], gaps[:, 0]


def mapped(H: Floats, xy: Floats) -> Floats:
    """(N, 2) through a homography."""
    p = xy @ H[:, :2].T + H[:, 2]
    return p[:, :2] / p[:, 2:]
