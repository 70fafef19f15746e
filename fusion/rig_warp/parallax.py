"""How far off thermal lies where a distance was assumed and things are at another."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fusion.geometry import Floats, invert
from fusion.rig import Rig
from fusion.rig_warp.views import Views, inside

PARALLAX_M = (0.5, 1.0, 2.0, 5.0, 10.0, math.inf)


def parallax_px(
    rig: Rig, at_m: float, distances_m: Sequence[float] = PARALLAX_M, undistort: bool = False
) -> Floats:
    """How far off, in RGB pixels, thermal lies for things at `distances_m` where `at_m` is assumed.

    The median over the RGB pixels whose thing both cameras see; NaN where there is none. inf is infinity, as
    the distance of things and as the assumed one.
    """
    views = Views.of(rig, rig.camera("fir").size_wh, rig.camera("rgb").size_wh, undistort)
    W, H = views.output.size_wh
    u, v = np.meshgrid(np.linspace(0, W - 1, 33), np.linspace(0, H - 1, 25))
    uv = np.stack([u.ravel(), v.ravel()], -1)
    rays = views.rays(uv)
    found = []
    for metres in distances_m:
        xy, seen = views.thermal_px(rays, metres)
        drawn, there = _drawn_at(views, xy, at_m)
        off = np.linalg.norm(drawn - uv, axis=1)[seen & there & inside(xy, views.fir.size_wh)]
        found.append(float(np.median(off)) if off.size else math.nan)
    return np.array(found)


def _drawn_at(views: Views, fir_xy: Floats, at_m: float) -> tuple[Floats, NDArray[np.bool_]]:
    """Where on the output grid a warp that assumes `at_m` draws thermal pixels N x 2."""
    T = invert(views.T_fir_rgb)
    ray, centre = views.fir.unproject(fir_xy) @ T[:3, :3].T, T[:3, 3]
    if math.isinf(at_m):
        points = ray
    elif views.value == "depth":
        points = centre + ray * ((at_m - centre[2]) / ray[:, 2])[:, None]
    else:  # the sphere around the RGB camera, from within
        along = ray @ centre
        points = centre + ray * (np.sqrt(along**2 - centre @ centre + at_m**2) - along)[:, None]
    with np.errstate(invalid="ignore", over="ignore"):
        return views.output.project(points)
