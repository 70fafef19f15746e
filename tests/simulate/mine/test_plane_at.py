"""The homography of one distance: exact without lenses' distortion, wrong by parallax elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.geometry import PinholeCamera, pose, transform
from fusion.rig import Rig
from fusion.simulate.mine.plane_at import homography_at

FIR, RGB = PinholeCamera((64, 48), 60, 61, 30, 25), PinholeCamera((80, 60), 55, 55, 41, 28)


def rig() -> Rig:
    angle = 0.03
    R = ((np.cos(angle), 0, np.sin(angle)), (0, 1, 0), (-np.sin(angle), 0, np.cos(angle)))
    return Rig({"rgb": RGB, "fir": FIR}, {"T_rgb_fir": pose(R, (0.08, -0.02, 0.01))})


@pytest.mark.parametrize(("depth_m", "exact"), [(5.0, True), (4.0, False)])
def test_points_at_the_distance_meet_and_no_others(depth_m: float, exact: bool) -> None:
    H = homography_at(rig(), 5.0).H_rgb_fir
    points = np.random.default_rng(0).uniform((-1.5, -1, depth_m), (1.5, 1, depth_m), (50, 3))
    rgb_xy, _ = RGB.project(points)
    fir_xy, _ = FIR.project(transform(rig().pose("fir", "rgb"), points))
    mapped = np.c_[fir_xy, np.ones(50)] @ H.T
    off = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - rgb_xy, axis=1)
    if exact:
        assert off.max() < 1e-6
    else:  # parallax: baseline x focal length x difference of inverse depths
        expected = 55 * np.hypot(0.08, 0.02) * abs(1 / 4.0 - 1 / 5.0)
        assert np.median(off) == pytest.approx(expected, rel=0.15)
