"""What a blend run may be told, checked as soon as it is read.

The same settings come from three places, later ones winning: a preset, a TOML file, the command
line. `load_config` merges them into one `BlendConfig`, whose every value is effective: what it
holds is what runs, and what `run.toml` records.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError

from fusion.errors import UsageError
from fusion.pairing import PairingRule
from fusion.settings import Group, first_problem, merged, read_settings
from fusion.thermal import WindowRule

FORMAT = "fusion-blend/1"
PATHS = (
    ("warp", "homography"),
    ("warp", "points"),
    ("warp", "rig"),
    ("warp", "depth"),
    ("pairing", "map"),
)

PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "auto": {
        "thermal": {"window": (1.0, 99.0), "window_unit": "percentile", "colormap": "hsv-cold-hot"},
        "warp": {"outside": "keep"},
    },
    "thesis": {  # METHOD section 1, thesis section 6.1
        "thermal": {"window": (0.3, 0.6), "window_unit": "fraction", "colormap": "hsv"},
        "warp": {"outside": "crop"},
    },
}

Level = Annotated[int, Field(ge=0, le=255)]


class PairingConfig(Group):
    """Which thermal image belongs to which RGB image; keys are regular expressions on the stems."""

    by: Literal["auto", "stem", "index", "stamp", "map", "order"] = "auto"
    rgb_key: str | None = None
    fir_key: str | None = None
    map: str | None = None
    tolerance_ms: float | None = Field(default=None, gt=0)

    def rule(self) -> PairingRule:
        tolerance_ns = None if self.tolerance_ms is None else round(self.tolerance_ms * 1e6)
        return PairingRule(self.by, self.rgb_key, self.fir_key, tolerance_ns, self.map)


class ThermalConfig(Group):
    """The window that is stretched, and the colours it is given."""

    window: tuple[float, float]
    window_unit: Literal["fraction", "counts", "celsius", "percentile"] = "fraction"
    window_over: Literal["frame", "sequence", "running"] = "sequence"
    celsius_per_count: float | None = None
    celsius_at_zero: float | None = None
    clahe: float = Field(default=0.0, ge=0, le=100)
    colormap: str
    fir_colour: Literal["refuse", "luma"] = "refuse"

    @property
    def by_camera(self) -> bool:
        """Whether degrees are turned into counts by what the thermal files say of their camera."""
        return self.window_unit == "celsius" and self.celsius_per_count is self.celsius_at_zero is None

    def rule(self) -> WindowRule:
        return WindowRule(
            *self.window, self.window_unit, self.window_over, self.celsius_per_count, self.celsius_at_zero
        )


class WarpConfig(Group):
    """How thermal comes onto the RGB grid, and what happens where it does not reach."""

    homography: str | None = None
    points: str | None = None
    align: bool = False
    rig: str | None = None
    mode: Literal["infinity", "distance", "depth"] | None = None  # of a rig; None: by what is given
    distance_m: float | None = Field(default=None, gt=0)
    depth: str | None = None
    undistort: bool = False
    outside: Literal["crop", "keep", "fill"]
    fill_bgr: tuple[Level, Level, Level] = (0, 0, 0)


class BlendingConfig(Group):
    method: str = "alpha"
    alpha: float = Field(default=0.85, ge=0, le=1)


class OutputConfig(Group):
    format: Literal["png", "jpg"] = "png"
    quality: int = Field(default=90, ge=1, le=100)


class BlendConfig(Group):
    """The effective settings of one run. `BlendConfig.of(preset="thesis")` fills in a preset."""

    format: Literal["fusion-blend/1"] = FORMAT
    preset: Literal["auto", "thesis"] = "auto"
    strict: bool = False
    pairing: PairingConfig = PairingConfig()
    thermal: ThermalConfig
    warp: WarpConfig
    blend: BlendingConfig = BlendingConfig()
    output: OutputConfig = OutputConfig()

    @classmethod
    def of(cls, settings: Mapping[str, Any] | None = None, **groups: Any) -> BlendConfig:
        """Check settings (nested as in the TOML file) over their preset. Raises `UsageError`."""
        return _validated({**(settings or {}), **groups}, where="settings")


def load_config(path: Path | None, overrides: Mapping[str, Any]) -> BlendConfig:
    """Read the TOML file at `path` (None: none) and lay `overrides` over it; see `docs/configuration`.

    Paths inside the file count from the file's own folder. Raises `UsageError` naming the key.
    """
    settings = {} if path is None else read_settings(path, FORMAT, PATHS)
    return _validated(merged(settings, overrides), where="options" if path is None else str(path))


def _validated(settings: Mapping[str, Any], where: str) -> BlendConfig:
    preset = settings.get("preset", "auto")
    if not isinstance(preset, str) or preset not in PRESETS:
        raise UsageError(f"unknown preset {preset!r}", where=where, hint=f"one of: {', '.join(PRESETS)}")
    thermal = settings.get("thermal", {})
    if isinstance(thermal, Mapping) and "window" in thermal and "window_unit" not in thermal:
        # a window given by hand is MATLAB's, whatever unit the preset's own window has
        settings = merged(settings, {"thermal": {"window_unit": "fraction"}})
    try:
        config = BlendConfig.model_validate(merged(PRESETS[preset], settings))
    except ValidationError as error:
        raise UsageError(first_problem(error), where=where) from None
    warp = _checked_warp(config.warp, where)
    if not config.thermal.by_camera:
        config.thermal.rule()
    return config.model_copy(update={"warp": warp})


def _checked_warp(warp: WarpConfig, where: str) -> WarpConfig:
    """One way of registering, whole, its mode said."""
    given = [name for name in ("homography", "points", "align", "rig") if getattr(warp, name)]
    if len(given) > 1:
        raise UsageError(
            f"{given[0]} and {given[1]} exclude each other", where=where, hint="give one of them"
        )
    if warp.rig is None:
        for name in ("mode", "distance_m", "depth", "undistort"):
            if getattr(warp, name):
                hint = "give --rig FILE, the calibration of both cameras"
                raise UsageError(f"warp.{name} means nothing without a rig", where=where, hint=hint)
        return warp
    fallback = "depth" if warp.depth else "distance" if warp.distance_m else "infinity"
    mode = warp.mode or fallback
    if mode == "distance" and warp.distance_m is None:
        raise UsageError("a warp at a distance has no distance", where=where, hint="give --distance METRES")
    if mode == "depth" and warp.depth is None:
        hint = "give --depth FOLDER, as `fusion depth --rig` writes it"
        raise UsageError("a warp by depth has no depth", where=where, hint=hint)
    for name, modes in (("distance_m", ("distance", "depth")), ("depth", ("depth",))):
        if getattr(warp, name) and mode not in modes:
            hint = "leave one of them out"
            raise UsageError(f"warp.{name} means nothing with mode {mode}", where=where, hint=hint)
    return warp.model_copy(update={"mode": mode})
