"""What a blend run may be told, checked as soon as it is read.

The same settings come from three places, later ones winning: a preset, a TOML file, the command
line. `load_config` merges them into one `BlendConfig`, whose every value is effective: what it
holds is what runs, and what `run.toml` records.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from fusion.errors import UsageError
from fusion.pairing import PairingRule
from fusion.thermal import WindowRule

FORMAT = "fusion-blend/1"
MAX_CONFIG_BYTES = 1 << 20

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


class _Group(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class PairingConfig(_Group):
    """Which thermal image belongs to which RGB image; keys are regular expressions on the stems."""

    by: Literal["auto", "stem", "index", "stamp", "map", "order"] = "auto"
    rgb_key: str | None = None
    fir_key: str | None = None
    map: str | None = None
    tolerance_ms: float | None = Field(default=None, gt=0)

    def rule(self) -> PairingRule:
        tolerance_ns = None if self.tolerance_ms is None else round(self.tolerance_ms * 1e6)
        return PairingRule(self.by, self.rgb_key, self.fir_key, tolerance_ns, self.map)


class ThermalConfig(_Group):
    """The window that is stretched, and the colours it is given."""

    window: tuple[float, float]
    window_unit: Literal["fraction", "counts", "celsius", "percentile"] = "fraction"
    window_over: Literal["frame", "sequence", "running"] = "sequence"
    celsius_per_count: float | None = None
    celsius_at_zero: float | None = None
    clahe: float = Field(default=0.0, ge=0, le=100)
    colormap: str
    fir_colour: Literal["refuse", "luma"] = "refuse"

    def rule(self) -> WindowRule:
        return WindowRule(
            *self.window, self.window_unit, self.window_over, self.celsius_per_count, self.celsius_at_zero
        )


class WarpConfig(_Group):
    """How thermal comes onto the RGB grid, and what happens where it does not reach."""

    homography: str | None = None
    points: str | None = None
    outside: Literal["crop", "keep", "fill"]
    fill_bgr: tuple[Level, Level, Level] = (0, 0, 0)


class BlendingConfig(_Group):
    method: str = "alpha"
    alpha: float = Field(default=0.85, ge=0, le=1)


class OutputConfig(_Group):
    format: Literal["png", "jpg"] = "png"
    quality: int = Field(default=90, ge=1, le=100)


class BlendConfig(_Group):
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
    settings = {} if path is None else _read_toml(path)
    return _validated(_merged(settings, overrides), where="options" if path is None else str(path))


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > MAX_CONFIG_BYTES:
            raise UsageError("too large for a configuration", where=path)
        settings = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(f"cannot be read as TOML: {error}", where=path) from None
    if settings.get("format") != FORMAT:
        raise UsageError(
            "no configuration of ours", where=path, hint=f'its first line must be format = "{FORMAT}"'
        )
    for group, key in (("warp", "homography"), ("warp", "points"), ("pairing", "map")):
        table = settings.get(group)
        if isinstance(table, dict) and isinstance(table.get(key), str):
            table[key] = str(path.parent / table[key])
    return settings


def _validated(settings: Mapping[str, Any], where: str) -> BlendConfig:
    preset = settings.get("preset", "auto")
    if preset not in PRESETS:
        raise UsageError(f"unknown preset {preset!r}", where=where, hint=f"one of: {', '.join(PRESETS)}")
    thermal = settings.get("thermal", {})
    if isinstance(thermal, Mapping) and "window" in thermal and "window_unit" not in thermal:
        # a window given by hand is MATLAB's, whatever unit the preset's own window has
        settings = _merged(settings, {"thermal": {"window_unit": "fraction"}})
    try:
        config = BlendConfig.model_validate(_merged(PRESETS[preset], settings))
    except ValidationError as error:
        raise UsageError(_first_problem(error), where=where) from None
    if config.warp.homography and config.warp.points:
        raise UsageError("homography and points exclude each other", where=where, hint="give one of them")
    config.thermal.rule()
    return config


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        known = merged.get(key)
        merged[key] = (
            _merged(known, value) if isinstance(known, Mapping) and isinstance(value, Mapping) else value
        )
    return merged


def _first_problem(error: ValidationError) -> str:
    problem = error.errors(include_url=False)[0]
    key = ".".join(str(part) for part in problem["loc"])
    more = error.error_count() - 1
    return f"{key}: {problem['msg'].lower()}" + (f" (and {more} more)" if more else "")
