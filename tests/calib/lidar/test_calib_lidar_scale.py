"""A board whose spacing is stated wrongly shows against the LiDAR, a right one does not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.lidar.scale import board_scale, spacing_note
from calib.observations import CloudView
from fusion.geometry import Floats, invert, pose, transform


def turn(*angles_deg: float) -> Floats:
    return Rotation.from_euler("xyz", angles_deg, degrees=True).as_matrix()


def clouds_of(T_ref_lidar: Floats, boards: dict[str, Floats], noise_m: float) -> list[CloudView]:
    rng, found = np.random.default_rng(5), []
    for moment, T in boards.items():
        flat = np.column_stack([rng.uniform(0, 0.6, (80, 2)), rng.normal(0, noise_m, 80)])
        found.append(CloudView(moment, transform(invert(T_ref_lidar) @ T, flat)))
    return found


def tilted(count: int, spread_deg: float, scale: float = 1.0) -> dict[str, Floats]:
    rng = np.random.default_rng(6)
    return {
        f"{k}": pose(
            turn(*rng.uniform(-spread_deg, spread_deg, 3)), scale * rng.uniform((-1, -1, 1), (0, 0, 4))
        )
        for k in range(count)
    }


@pytest.mark.parametrize("stated", [1.0, 1.05, 0.9])
def test_a_wrong_spacing_shows_as_a_scale(stated: float) -> None:
    T, true = pose(turn(0, 0, 90), (0.1, -0.2, 0.05)), tilted(15, 30)
    believed = {m: pose(board[:3, :3], stated * board[:3, 3]) for m, board in true.items()}
    scale, sigma = board_scale(believed, T, clouds_of(T, true, 0.003))
    assert scale == pytest.approx(1 / stated, abs=0.01)
    assert bool(spacing_note(scale, sigma)) == (stated != 1)


def test_few_boards_say_nothing() -> None:
    seen = tilted(5, 30)
    assert board_scale(seen, np.eye(4), clouds_of(pose(), seen, 0.0)) == (1.0, float("inf"))
    assert spacing_note(1.3, float("inf")) == ""
