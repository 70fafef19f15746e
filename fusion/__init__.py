"""RGB, thermal and LiDAR recordings become fused frames and metric depth that a tracker can live on.

    from fusion import Fuser, open_pairs

    for frame in Fuser(open_pairs("rgb/", "fir/")):
        print(frame.stem, frame.bgr.shape, frame.window)

Names are imported when first used, so that importing the package costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fusion.batch import run
    from fusion.clouds import read_cloud
    from fusion.colormaps import colormap_bgr
    from fusion.config import BlendConfig
    from fusion.errors import FrameError, FusionError, InputError, OutputError, UsageError
    from fusion.frames import FrameSet, FusedFrame, Image, PointCloud, Window
    from fusion.lidar.config import DepthConfig
    from fusion.lidar.lane import DepthLane
    from fusion.pairing import PairingRule
    from fusion.pipeline import Fuser
    from fusion.provenance import describe_run
    from fusion.rig import Rig, load_rig, save_rig
    from fusion.rig_warp import DepthWarp, RigWarp, parallax_px
    from fusion.sinks.folder import FolderSink
    from fusion.sync import open_pairs
    from fusion.thermal import WindowRule
    from fusion.warp import Warp

__all__ = [
    "BlendConfig",
    "DepthConfig",
    "DepthLane",
    "DepthWarp",
    "FolderSink",
    "FrameError",
    "FrameSet",
    "FusedFrame",
    "Fuser",
    "FusionError",
    "Image",
    "InputError",
    "OutputError",
    "PairingRule",
    "PointCloud",
    "Rig",
    "RigWarp",
    "UsageError",
    "Warp",
    "Window",
    "WindowRule",
    "colormap_bgr",
    "describe_run",
    "load_rig",
    "open_pairs",
    "parallax_px",
    "read_cloud",
    "run",
    "save_rig",
]

_HOMES = {
    "batch": ("run",),
    "clouds": ("read_cloud",),
    "colormaps": ("colormap_bgr",),
    "config": ("BlendConfig",),
    "errors": ("FrameError", "FusionError", "InputError", "OutputError", "UsageError"),
    "frames": ("FrameSet", "FusedFrame", "Image", "PointCloud", "Window"),
    "lidar.config": ("DepthConfig",),
    "lidar.lane": ("DepthLane",),
    "pairing": ("PairingRule",),
    "pipeline": ("Fuser",),
    "provenance": ("describe_run",),
    "rig": ("Rig", "load_rig", "save_rig"),
    "rig_warp": ("DepthWarp", "RigWarp", "parallax_px"),
    "sinks.folder": ("FolderSink",),
    "sync": ("open_pairs",),
    "thermal": ("WindowRule",),
    "warp": ("Warp",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> object:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'fusion' has no attribute {name!r}")
    value = getattr(import_module(f"fusion.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
