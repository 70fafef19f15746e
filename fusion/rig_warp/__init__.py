"""The thermal image on the RGB grid by a calibrated rig: as if all were infinitely far, at one distance, or
at the depth that each pixel has. Undistortion is part of the one resampling.

A fixed map is computed once. With depth each RGB pixel's point is placed into the thermal image, and a
z-buffer on the thermal grid tells which points something nearer hides from the thermal camera.
"""

from __future__ import annotations

from typing import Literal

from fusion.rig_warp.depth import DepthWarp, Warped
from fusion.rig_warp.fixed import RigWarp
from fusion.rig_warp.parallax import PARALLAX_M, parallax_px
from fusion.rig_warp.views import Sampling, Value, Views

Mode = Literal["infinity", "distance", "depth"]

__all__ = [
    "PARALLAX_M",
    "DepthWarp",
    "Mode",
    "RigWarp",
    "Sampling",
    "Value",
    "Views",
    "Warped",
    "parallax_px",
]
