"""What a campaign may be told: a TOML file and options become one effective `PreprocessConfig`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError

from fusion.config import BlendConfig
from fusion.errors import UsageError
from fusion.lidar.config import DepthConfig
from fusion.settings import Group, first_problem, merged, read_settings
from fusion.sinks.base import OUTPUTS

FORMAT = "fusion-preprocess/1"
PATHS = (("fuse", "rig"),)
OWN_DEPTH = "lidar"  # what stands for a folder of maps where depth is made on the way
WITHOUT_DEPTH_M = 5.0  # how far things are taken to be where no scan tells


class StreamsConfig(Group):
    """Which streams, and how their messages find each other; `fusion.timing.match` has the rule.

    `rgb`, `fir` and `lidar` are topics of a recording (None: the only one that can be it; lidar "": none).
    A stamp is the message's own (``header``) or when it was recorded (``log``). `fir_offset_ms` and
    `fir_drift_ppm` bring thermal stamps to RGB's clock: own + offset + drift * (own - first).
    """

    rgb: str | None = None
    fir: str | None = None
    lidar: str | None = None
    lead: Literal["rgb", "lidar"] = "rgb"
    stamp: Literal["header", "log"] = "header"
    tolerance_ms: float | None = Field(default=None, gt=0)
    lidar_tolerance_ms: float | None = Field(default=None, gt=0)
    fir_offset_ms: float | None = None
    fir_drift_ppm: float = Field(default=0.0, ge=-1000, le=1000)
    estimate_clock: bool = False
    keep_frozen: bool = False
    begin_s: float | None = Field(default=None, ge=0)
    end_s: float | None = Field(default=None, gt=0)


class OutputsConfig(Group):
    """Where frames go (`fusion.sinks.base.OUTPUTS`), and what of them is kept."""

    kinds: tuple[str, ...] = Field(default=("folder",), min_length=1)
    counts: bool = True
    depth: bool = True


class PreprocessConfig(Group):
    """The settings of a campaign: `fuse` as `fusion blend` takes them, `depth` as `fusion depth`.

    A warp by depth means the depth that is made on the way.
    """

    format: Literal["fusion-preprocess/1"] = FORMAT
    chunk_s: float = Field(default=20.0, ge=0.1, le=3600)
    streams: StreamsConfig = StreamsConfig()
    outputs: OutputsConfig = OutputsConfig()
    fuse: BlendConfig
    depth: DepthConfig

    @classmethod
    def of(cls, settings: Mapping[str, Any] | None = None, **groups: Any) -> PreprocessConfig:
        """Check settings (nested as in the TOML file). Raises `UsageError`."""
        return _validated({**(settings or {}), **groups}, "settings")


def load_preprocess_config(path: Path | None, overrides: Mapping[str, Any]) -> PreprocessConfig:
    """Read the TOML file at `path` (None: none) and lay `overrides` over it. Raises `UsageError`."""
    settings = {} if path is None else read_settings(path, FORMAT)
    warp = settings.get("fuse", {}).get("warp", {}) if isinstance(settings.get("fuse"), dict) else {}
    for key in ("rig", "homography", "points"):
        if path is not None and isinstance(warp, dict) and isinstance(warp.get(key), str):
            warp[key] = str(path.parent / warp[key])
    return _validated(merged(settings, overrides), "options" if path is None else str(path))


def _validated(settings: Mapping[str, Any], where: str) -> PreprocessConfig:
    groups = dict(settings)
    fuse, depth = groups.pop("fuse", {}), groups.pop("depth", {})
    for name, group in (("fuse", fuse), ("depth", depth)):
        if not isinstance(group, Mapping):
            raise UsageError(f"{name} is no table", where=where, hint=f"write [{name}.…], then its keys")
    camera = depth.get("camera", {})
    if isinstance(camera, Mapping) and camera.get("rig"):
        raise UsageError("depth.camera.rig", where=where, hint="the rig is given once: fuse.warp.rig, --rig")
    try:
        config = PreprocessConfig.model_validate(
            {**groups, "fuse": BlendConfig.of(_by_own_depth(fuse)), "depth": DepthConfig.of(depth)}
        )
    except ValidationError as error:
        raise UsageError(first_problem(error), where=where) from None
    streams = config.streams
    if streams.estimate_clock and (streams.fir_offset_ms is not None or streams.fir_drift_ppm):
        hint = "give one of estimate_clock and fir_offset_ms, fir_drift_ppm"
        raise UsageError("the clock is given and to be estimated", where=where, hint=hint)
    if streams.begin_s is not None and streams.end_s is not None and streams.begin_s >= streams.end_s:
        raise UsageError(f"{streams.begin_s:g} to {streams.end_s:g} s is no time range", where=where)
    unknown = [kind for kind in config.outputs.kinds if kind not in OUTPUTS]
    if unknown:
        hint = f"one or more of: {', '.join(OUTPUTS)}"
        raise UsageError(f"unknown output {unknown[0]!r}", where=where, hint=hint)
    return config


def _by_own_depth(fuse: Mapping[str, Any]) -> Mapping[str, Any]:
    """With a rig thermal is warped by the depth made on the way, unless something else is asked for."""
    warp = fuse.get("warp", {})
    if not isinstance(warp, Mapping) or not warp.get("rig") or warp.get("mode", "depth") != "depth":
        return fuse
    distance_m = warp.get("distance_m") or WITHOUT_DEPTH_M
    return merged(fuse, {"warp": {"mode": "depth", "depth": OWN_DEPTH, "distance_m": distance_m}})
