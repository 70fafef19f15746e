"""What one homography can do for two cameras that stand apart: fit one distance."""

from __future__ import annotations

import cv2
import numpy as np

from fusion.geometry import transform
from fusion.registration import Registration
from fusion.rig import Rig

STEPS = 16  # thermal pixels that are looked at, each way


def homography_at(rig: Rig, depth_m: float) -> Registration:
    """H_rgb_fir that fits best what lies `depth_m` before the RGB camera, along its axis.

    Least squares over a grid of thermal pixels whose points the RGB camera has in its picture. Things nearer
    and farther are off by parallax, and lenses bend what a homography keeps straight.
    """
    fir, rgb, T_rgb_fir = rig.camera("fir"), rig.camera("rgb"), rig.pose("rgb", "fir")
    (w, h), (rgb_w, rgb_h) = fir.size_wh, rgb.size_wh
    u, v = np.meshgrid(np.linspace(0, w - 1, STEPS), np.linspace(0, h - 1, STEPS))
    fir_xy = np.stack([u.ravel(), v.ravel()], -1)
    ray = fir.unproject(fir_xy) @ T_rgb_fir[:3, :3].T
    along = (depth_m - T_rgb_fir[2, 3]) / ray[:, 2]
    rgb_xy, seen = rgb.project(transform(T_rgb_fir, fir.unproject(fir_xy) * along[:, None]))
    seen &= (rgb_xy >= 0).all(1) & (rgb_xy[:, 0] < rgb_w) & (rgb_xy[:, 1] < rgb_h)
    H, _ = cv2.findHomography(fir_xy[seen], rgb_xy[seen], 0)
    return Registration(np.asarray(H, np.float64), "homography", fir.size_wh, rgb.size_wh)
