"""Whether LiDAR and camera agree on how large the board is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from calib.lidar.plate import fit_plane
from calib.observations import CloudView
from fusion.geometry import Floats

FEWEST = 6


def board_scale(
    T_ref_board: Mapping[str, Floats], T_ref_lidar: Floats, clouds: Sequence[CloudView]
) -> tuple[float, float]:
    """By how much the LiDAR's boards are farther than the camera's, and that number's standard deviation.

    A camera tells how far a board is by the spacing that the board's file states, a LiDAR by itself: a wrong
    spacing shows as a number that is not 1. The LiDAR's place is free in it, its turn is not. 1 and inf for
    fewer than six boards.
    """
    shared = [
        (T_ref_board[c.moment], fit_plane(c.plane_m).centre_m) for c in clouds if c.moment in T_ref_board
    ]
    if len(shared) < FEWEST:
        return 1.0, float("inf")
    into = np.array([T[:3, 2] for T, _ in shared])
    d = np.array([T[:3, 2] @ T[:3, 3] for T, _ in shared])
    along = (into * (np.array([middle for _, middle in shared]) @ T_ref_lidar[:3, :3].T)).sum(1)
    A = np.column_stack([into, -d])  # along + into . t = scale d
    x, *_ = np.linalg.lstsq(A, -along, rcond=None)
    noise = np.linalg.norm(A @ x + along) / np.sqrt(len(d) - 4)
    return float(x[3]), float(noise * np.sqrt(np.linalg.pinv(A.T @ A)[3, 3]))


def spacing_note(scale: float, sigma: float) -> str:
    """What to say of a scale; empty where it is 1, to 2 % and four deviations."""
    if abs(scale - 1) <= max(0.02, 4 * sigma):
        return ""
    share = f"{100 * scale:.1f} %"
    seen = f"the LiDAR sees the board at {share} of the distance that the cameras do"
    return f"{seen}: is its spacing_m {share} of what the board's file says?"
