"""Everything that a user may choose of a simulated mine recording, in one TOML; presets for its look.

Later ones win: the defaults below, a preset, the file, options given by hand. What comes out is effective:
it is what runs, and what `truth/mine.toml` records. Unknown keys are refused at every level.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import tomlkit
from pydantic import Field, ValidationError, model_validator

from fusion.errors import UsageError
from fusion.settings import Group, first_problem, merged, read_settings
from fusion.simulate.mine.scene_config import BoardConfig, FlightConfig, SceneConfig

FORMAT = "fusion-mine/1"
EPOCH_S = 1_700_000_000.0  # so that stamps look like those of real recordings

Preset = Literal["clear", "dark", "dusty", "over-exposed"]
PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "clear": {},
    "dark": {
        "lamps": {"intensity": 2.0, "scene_gain": 0.03, "beam_deg": 45.0},
        "rgb": {"exposure_ms": 16.0, "gain_e_per_dn": 0.4, "read_noise_e": 4.0},
    },
    "dusty": {
        "dust": {"visibility_m": 38.0, "patchiness": 0.8, "particles": 350},
        "rgb": {"exposure_ms": 6.0},
    },
    "over-exposed": {"rgb": {"exposure_ms": 24.0, "gain_e_per_dn": 0.5, "glare": 0.1}},
}

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]
Pixels = Annotated[int, Field(ge=16, le=4096)]
Rate = Annotated[float, Field(gt=0, le=240)]


class ClockConfig(Group):
    """A sensor's own clock: own = true * (1 + drift) + offset; `drift_ppm` is 1e6 drift."""

    offset_s: Annotated[float, Field(ge=0, le=4e9)]
    drift_ppm: Annotated[float, Field(ge=-1000, le=1000)] = 0.0


class MountConfig(Group):
    """Where a sensor sits on the drone: body frame (x forward, y left, z up), metres; degrees around z, y, x.

    Without rotation a camera looks along the body's x axis, upright, and a LiDAR's axes are the body's.
    """

    position_m: Vector
    yaw_pitch_roll_deg: Vector = (0.0, 0.0, 0.0)


class CameraConfig(Group):
    """A pinhole camera with radial-tangential distortion (k1 k2 p1 p2 k3)."""

    size_wh: tuple[Pixels, Pixels]
    fov_deg: Annotated[float, Field(gt=5, lt=140)]
    centre_offset_px: tuple[Finite, Finite] = (0.0, 0.0)
    distortion: tuple[Finite, Finite, Finite, Finite, Finite]


class LampsConfig(Group):
    """Head lamps on the drone; `intensity` is radiant intensity on the beam's axis, in arbitrary units a
    steradian.

    Irradiance falls off with the square of the distance. Beams are 1 / (1 + x^2)^2 of x ~ 1 - cos(angle),
    `beam_deg` wide at half their height, over a floor of `spill`. `bounce` is the share of light that comes
    back from rock.
    """

    intensity: NotNegative = 100.0
    colour_bgr: Vector = (1.06, 1.0, 0.92)
    positions_m: tuple[Vector, ...] = ((0.14, 0.16, -0.05), (0.14, -0.16, -0.05))
    pitch_deg: Annotated[float, Field(ge=-60, le=60)] = 4.0
    toe_out_deg: Annotated[float, Field(ge=-45, le=45)] = 9.0
    beam_deg: Annotated[float, Field(gt=5, lt=170)] = 62.0
    spill: Share = 0.05
    bounce: Share = 0.12
    scene_gain: NotNegative = 1.0  # times the intensities of the scene's own lamps


class DustConfig(Group):
    """Homogeneous extinction from the visual range (Koschmieder: 3.912 / visibility) times drifting dust."""

    visibility_m: Annotated[float, Field(ge=1, le=10_000)] = 900.0
    patchiness: Share = 0.6
    cloud_m: Positive = 2.2  # size of a cloud
    wind_m_s: Vector = (0.35, 0.1, 0.05)
    albedo_bgr: Vector = (0.80, 0.86, 0.92)  # of single scattering
    forward: Annotated[float, Field(ge=-0.9, le=0.9)] = 0.35  # g of Henyey and Greenstein's phase function
    particles: Annotated[int, Field(ge=0, le=5000)] = 12  # large ones close to the lens, a frame
    lidar_false_share: Share = 0.25  # of dimmed pulses that return from dust


class RgbConfig(Group):
    """The RGB camera; noise after EMVA 1288: photon noise, read noise, conversion gain, full well.

    `sensitivity_e` is electrons a second and a unit of radiance; `gain_e_per_dn` belongs to 12-bit counts,
    which saturate at 4095 or at the full well. `glare` is the share of light that the lens spreads widely.
    """

    camera: CameraConfig = CameraConfig(
        size_wh=(640, 480),
        fov_deg=84.0,
        centre_offset_px=(3.4, -5.2),
        distortion=(-0.19, 0.035, 4e-4, -3e-4, 0.0),
    )
    mount: MountConfig = MountConfig(position_m=(0.12, 0.0, 0.0))
    clock: ClockConfig = ClockConfig(offset_s=EPOCH_S)
    rate_hz: Rate = 20.0
    exposure_ms: Annotated[float, Field(gt=0, le=200)] = 8.0
    sensitivity_e: Positive = 450_000.0
    full_well_e: Positive = 10_000.0
    gain_e_per_dn: Positive = 2.44
    read_noise_e: NotNegative = 6.0
    vignetting: Share = 0.35  # light lost in the corners
    blur_px: Annotated[float, Field(ge=0, le=8)] = 0.55
    glare: Share = 0.03
    wet_floor: Share = 0.7
    shadows: bool = True  # of scene lamps
    file: Literal["jpg", "png"] = "jpg"
    quality: Annotated[int, Field(ge=1, le=100)] = 92


class ThermalConfig(Group):
    """The thermal camera: a microbolometer with `time_constant_ms` lag; counts are linear in apparent
    temperature.

    count = kelvin / kelvin_per_count, clipped to 14 bits. NETD is temporal noise; the fixed pattern has a
    column and a pixel part, which grow by `pattern_drift_k_per_min` between flat-field corrections (FFC).
    While the shutter is closed the last picture is repeated.
    """

    camera: CameraConfig = CameraConfig(
        size_wh=(640, 512),
        fov_deg=68.0,
        centre_offset_px=(-4.1, 2.7),
        distortion=(-0.24, 0.07, -5e-4, 6e-4, 0.0),
    )
    mount: MountConfig = MountConfig(position_m=(0.11, -0.075, 0.02), yaw_pitch_roll_deg=(-1.2, 0.8, 0.6))
    clock: ClockConfig = ClockConfig(offset_s=EPOCH_S + 0.037, drift_ppm=25.0)
    rate_hz: Rate = 25.0
    kelvin_per_count: Positive = 0.04
    air_degC: Finite = 10.0  # noqa: N815 - what surfaces reflect, and what the air between radiates
    air_extinction_per_m: NotNegative = 0.002
    dust_share: Share = 0.04  # of the visible extinction that is left in the long-wave infrared
    printed_emissivity: tuple[Share, Share] = (0.95, 0.62)  # of the board's dark and of its bright fields
    blur_px: Annotated[float, Field(ge=0, le=8)] = 0.8
    time_constant_ms: Annotated[float, Field(ge=0, le=100)] = 10.0
    netd_mk: NotNegative = 50.0
    column_pattern_mk: NotNegative = 35.0
    pixel_pattern_mk: NotNegative = 30.0
    pattern_drift_k_per_min: NotNegative = 0.12
    vignetting: Share = 0.05
    ffc_interval_s: Positive = 12.0
    ffc_freeze_s: NotNegative = 0.4


class LidarConfig(Group):
    """A spinning LiDAR: all rings fire at once, one column after the other, from the back, counter-clockwise.

    A return is lost where its power, reflectance * cos(incidence) * exp(-2 extinction range) / range^2, is
    low: half of the pulses are, at `range_10_m`, from a target of 10 % reflectance at normal incidence.
    """

    mount: MountConfig = MountConfig(position_m=(0.05, 0.0, 0.10), yaw_pitch_roll_deg=(0.4, -0.7, 0.3))
    clock: ClockConfig = ClockConfig(offset_s=EPOCH_S + 0.0041, drift_ppm=-8.0)
    rate_hz: Rate = 10.0
    rings: Literal[16, 32, 64, 128] = 64
    columns: Annotated[int, Field(ge=64, le=4096)] = 1024
    fov_up_deg: Annotated[float, Field(gt=-90, lt=90)] = 22.5
    fov_down_deg: Annotated[float, Field(gt=-90, lt=90)] = -22.5
    range_noise_m: NotNegative = 0.015
    min_range_m: NotNegative = 0.4
    max_range_m: Positive = 100.0
    range_10_m: Positive = 45.0
    drop_out: Share = 0.004  # lost whatever they hit

    @model_validator(mode="after")
    def _ordered(self) -> LidarConfig:
        if not (self.fov_down_deg < self.fov_up_deg and self.min_range_m < self.max_range_m):
            raise ValueError("fov_down_deg must lie below fov_up_deg, min_range_m below max_range_m")
        return self


class MineConfig(Group):
    """The effective settings of a recording. `MineConfig.of(preset="dusty", seed=3)` fills in the preset."""

    format: Literal["fusion-mine/1"] = FORMAT
    preset: Preset = "clear"
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    duration_s: Annotated[float, Field(gt=0, le=86_400)] = 10.0
    truth: bool = True  # write the dense truth as well, not poses and clocks alone
    scene: SceneConfig = SceneConfig()
    flight: FlightConfig = FlightConfig()
    board: BoardConfig = BoardConfig()  # of calibration sessions
    lamps: LampsConfig = LampsConfig()
    dust: DustConfig = DustConfig()
    rgb: RgbConfig = RgbConfig()
    thermal: ThermalConfig = ThermalConfig()
    lidar: LidarConfig = LidarConfig()

    @classmethod
    def of(cls, settings: Mapping[str, Any] | None = None, **groups: Any) -> MineConfig:
        """Check settings (nested as in the TOML file) over their preset. Raises `UsageError`."""
        return _validated(merged(settings or {}, groups), where="settings")

    def toml(self) -> str:
        """The text of a file that `load_mine_config` reads back to the same settings."""
        return tomlkit.dumps(self.model_dump(mode="json"))


def load_mine_config(path: Path | None, overrides: Mapping[str, Any] | None = None) -> MineConfig:
    """Read the TOML at `path` (None: none) and lay `overrides`, nested the same way, over it.

    Raises `UsageError` naming the file and the key that is wrong.
    """
    settings = {} if path is None else read_settings(path, FORMAT)
    return _validated(merged(settings, overrides or {}), where="options" if path is None else str(path))


def _validated(settings: Mapping[str, Any], where: str) -> MineConfig:
    preset = settings.get("preset", "clear")
    if not isinstance(preset, str) or preset not in PRESETS:
        raise UsageError(f"unknown preset {preset!r}", where=where, hint=f"one of: {', '.join(PRESETS)}")
    try:
        whole = merged(merged(MineConfig().model_dump(), PRESETS[preset]), settings)
        return MineConfig.model_validate(whole)
    except ValidationError as error:
        raise UsageError(first_problem(error), where=where) from None
