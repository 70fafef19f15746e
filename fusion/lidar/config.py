"""What `fusion depth` may be told: a preset, a TOML file and options become one effective `DepthConfig`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from fusion.codecs import MAX_PIXELS
from fusion.errors import UsageError
from fusion.geometry import (
    T_CAM_LIDAR,
    Camera,
    CylindricalCamera,
    FisheyeCamera,
    Floats,
    PinholeCamera,
    SphericalCamera,
    checked_pose,
    invert,
    pose,
)
from fusion.lidar.project import FARTHEST_M
from fusion.settings import Group, first_problem, merged, read_settings

FORMAT = "fusion-depth/1"
FARTHEST_SHOWN_M = 1e6  # of the colours: beyond it float32 no longer tells them apart
PATHS = (("camera", "rig"),)

PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "auto": {"samples": {"value": "auto", "visibility": "auto"}, "dense": {"method": "plane"}},
    "thesis": {  # METHOD section 2, thesis section 6.2: scatteredInterpolant as it comes
        "samples": {"value": "range", "visibility": "none"},
        "dense": {"method": "linear", "extrapolate": "linear", "max_gap_px": math.hypot(1 << 15, 1 << 15)},
    },
}

Positive = Annotated[float, Field(gt=0)]
Side = Annotated[int, Field(ge=1, le=1 << 15)]
Triple = tuple[float, float, float]
_Row = tuple[float, float, float, float]


class CloudConfig(Group):
    """What of a cloud is used; all off by default."""

    form: str | None = None
    range_m: tuple[float, float] | None = None
    box_m: tuple[float, float, float, float, float, float] | None = None
    voxel_m: Positive | None = None
    outliers: tuple[Annotated[int, Field(ge=2, le=1000)], Positive] | None = None


class CameraConfig(Group):
    """The camera that looks at the cloud: a virtual one, or one of a rig."""

    model: Literal["pinhole", "fisheye", "cylindrical", "spherical"] = "pinhole"
    fov_deg: float = 120.0
    size_wh: tuple[Side, Side] = (640, 480)
    position_m: Triple | None = None
    look_deg: Triple | None = None
    T_cam_lidar: tuple[_Row, _Row, _Row] | tuple[_Row, _Row, _Row, _Row] | None = None
    rig: str | None = None
    sensor: str = "rgb"

    def virtual(self) -> Camera:
        """The virtual camera. Raises `UsageError` for a field of view that it cannot have."""
        if self.model == "pinhole":
            return PinholeCamera.of_fov(self.size_wh, self.fov_deg)
        if self.model == "fisheye":
            return FisheyeCamera.of_fov(self.size_wh, self.fov_deg)
        kind = CylindricalCamera if self.model == "cylindrical" else SphericalCamera
        return kind(self.size_wh, self.fov_deg)

    def pose(self) -> Floats:
        """T_cam_lidar: as given, or from where it stands and looks; by default at the origin, along +x."""
        if self.T_cam_lidar is not None:
            return checked_pose(self.T_cam_lidar, where="camera.T_cam_lidar")
        return T_CAM_LIDAR @ invert(pose(_turned(self.look_deg or (0, 0, 0)), self.position_m or (0, 0, 0)))


class SamplesConfig(Group):
    """Which points become samples, and what of them is kept."""

    value: Literal["auto", "depth", "range"] = "auto"
    limits_m: tuple[float, float] = (0.0, FARTHEST_M)
    visibility: Literal["auto", "scan", "map", "none"] = "auto"


class DenseConfig(Group):
    """How the gaps between samples are filled."""

    method: str = "plane"
    extrapolate: Literal["none", "nearest", "linear"] = "none"
    max_gap_px: Positive | None = None


class PictureConfig(Group):
    """How depth is painted."""

    colormap: str = "jet"
    show_m: tuple[float, float] = (1.0, 10.0)


class DepthConfig(Group):
    """The effective settings of one run. `DepthConfig.of(preset="thesis")` fills in a preset."""

    format: Literal["fusion-depth/1"] = FORMAT
    preset: Literal["auto", "thesis"] = "auto"
    strict: bool = False
    cloud: CloudConfig = CloudConfig()
    camera: CameraConfig = CameraConfig()
    samples: SamplesConfig
    dense: DenseConfig
    picture: PictureConfig = PictureConfig()

    @classmethod
    def of(cls, settings: Mapping[str, Any] | None = None, **groups: Any) -> DepthConfig:
        """Check settings (nested as in the TOML file) over their preset. Raises `UsageError`."""
        return _validated({**(settings or {}), **groups}, where="settings")


def load_depth_config(path: Path | None, overrides: Mapping[str, Any]) -> DepthConfig:
    """Read the TOML file at `path` (None: none) and lay `overrides` over it; see `docs/depth`.

    Paths inside the file count from the file's own folder. Raises `UsageError` naming the key.
    """
    settings = {} if path is None else read_settings(path, FORMAT, PATHS)
    for group in (
        "cloud",
        "camera",
        "samples",
        "dense",
        "picture",
    ):  # else an option would replace what it is
        if not isinstance(settings.get(group, {}), Mapping):
            raise UsageError(f"{group} is no table", where=str(path), hint=f"write [{group}], then its keys")
    return _validated(merged(settings, overrides), where="options" if path is None else str(path))


def _validated(settings: Mapping[str, Any], where: str) -> DepthConfig:
    preset = settings.get("preset", "auto")
    if not isinstance(preset, str) or preset not in PRESETS:
        raise UsageError(f"unknown preset {preset!r}", where=where, hint=f"one of: {', '.join(PRESETS)}")
    try:
        config = DepthConfig.model_validate(merged(PRESETS[preset], settings))
    except ValidationError as error:
        raise UsageError(first_problem(error), where=where) from None
    _check_spans(config, where)
    _check_camera(config.camera, where)
    return config


def _check_spans(config: DepthConfig, where: str) -> None:
    for name, span, most in (
        ("cloud.range_m", config.cloud.range_m, math.inf),
        ("samples.limits_m", config.samples.limits_m, FARTHEST_M),
        ("picture.show_m", config.picture.show_m, FARTHEST_SHOWN_M),
    ):
        if span is not None and not 0 <= span[0] < span[1] <= most:
            hint = "LEAST MOST, metres" + (
                f", at most {math.floor(most * 1000) / 1000:.10g}" if most < math.inf else ""
            )
            raise UsageError(f"{name}: {span[0]:g} to {span[1]:g} is no range", where=where, hint=hint)
    box = config.cloud.box_m
    if box is not None and not all(lo < hi for lo, hi in zip(box[:3], box[3:], strict=True)):
        corners = f"({box[0]:g}, {box[1]:g}, {box[2]:g}) to ({box[3]:g}, {box[4]:g}, {box[5]:g})"
        hint = "X0 Y0 Z0 X1 Y1 Z1, the lower corner first"
        raise UsageError(f"cloud.box_m: {corners} is no box", where=where, hint=hint)


def _check_camera(camera: CameraConfig, where: str) -> None:
    w, h = camera.size_wh
    if w * h > MAX_PIXELS:
        hint = f"at most {MAX_PIXELS} pixels"
        raise UsageError(f"camera.size_wh: {w}x{h} is too large a picture", where=where, hint=hint)
    virtual = sorted(camera.model_fields_set & {"model", "fov_deg", "size_wh"})
    if camera.rig is not None and virtual:
        hint = "they are for virtual cameras; leave them out"
        raise UsageError(f"camera.{virtual[0]} beside a rig, which says it", where=where, hint=hint)
    if camera.rig is None and "sensor" in camera.model_fields_set:
        raise UsageError(
            "camera.sensor without a rig", where=where, hint="give the rig that it is a camera of"
        )
    placed = camera.position_m is not None or camera.look_deg is not None
    if sum((placed, camera.T_cam_lidar is not None, camera.rig is not None)) > 1:
        hint = "give one of rig, T_cam_lidar, or position_m with look_deg"
        raise UsageError("the camera is placed twice", where=where, hint=hint)


def _turned(look_deg: Triple) -> Floats:
    """Yaw to the left, then pitch down, then roll to the right (right-handed about z, y, x of the LiDAR)."""
    yaw, pitch, roll = np.radians(look_deg)
    cz, sz, cy, sy, cx, sx = (
        np.cos(yaw),
        np.sin(yaw),
        np.cos(pitch),
        np.sin(pitch),
        np.cos(roll),
        np.sin(roll),
    )
    Rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    Ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    Rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    return Rz @ Ry @ Rx
