"""What of the mine's shape, of the flight through it and of the board session a user may choose."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from fusion.settings import Group

_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class SceneConfig(Group):
    """The drift. Lengths in metres; the floor is at z = 0, the drift starts at the origin along +x."""

    length_m: Annotated[float, Field(ge=60, le=120)] = 75.0
    width_m: Annotated[float, Field(ge=4.0, le=7.0)] = 4.6
    height_m: Annotated[float, Field(ge=3.8, le=6.0)] = 4.0
    bend_deg: Annotated[float, Field(ge=0, le=40)] = 32.0
    side_drift: bool = True
    roughness: Annotated[float, Field(ge=0, le=1.5)] = 1.0  # 1: blasted rock, 0: as drawn
    cell_m: Annotated[float, Field(ge=0.08, le=0.3)] = 0.15  # length of a rock facet's side
    machine: bool = True
    person: bool = True


class FlightConfig(Group):
    """A small drone along the drift, 1.5 m above its floor. Amplitudes are bounds; so is `max_rate_deg_s`."""

    speed_m_s: _Positive = 1.5
    sway_m: Annotated[float, Field(ge=0, le=0.35)] = 0.2
    tilt_deg: Annotated[float, Field(ge=0, le=25)] = 8.0
    yaw_deg: Annotated[float, Field(ge=0, le=45)] = 14.0
    max_rate_deg_s: Annotated[float, Field(ge=5, le=300)] = 90.0
    turbulence: Annotated[float, Field(ge=0, le=1)] = 0.5  # share of fast motion
    jerks_per_s: Annotated[float, Field(ge=0, le=2)] = 0.15  # sudden attitude bumps


class BoardConfig(Group):
    """The calibration board and how it is moved.

    `cols` x `rows` are inner corners, or circles as OpenCV counts them. `square_m` is the side of a
    chessboard's field, or the distance of an asymmetric grid's rows, half that of its circles in a row.
    """

    kind: Literal["chessboard", "circles"] = "chessboard"
    cols: Annotated[int, Field(ge=3, le=20)] = 9
    rows: Annotated[int, Field(ge=3, le=20)] = 6
    square_m: Annotated[float, Field(ge=0.02, le=0.3)] = 0.08
    heated_degC: Annotated[float, Field(ge=-20, le=120)] = 42.0  # noqa: N815 - units as the conventions write them
    dark: Annotated[float, Field(ge=0, le=1)] = 0.05  # reflectance of its fields
    bright: Annotated[float, Field(ge=0, le=1)] = 0.80
    footprint_rad: Annotated[float, Field(ge=0, le=0.05)] = (
        0.0022  # angle over which a ray averages the pattern
    )
    poses: Annotated[int, Field(ge=1, le=500)] = 30
    distance_m: tuple[_Positive, _Positive] = (1.0, 4.0)
    tilt_deg: Annotated[float, Field(ge=0, le=60)] = 38.0
    azimuth_deg: Annotated[float, Field(ge=0, le=60)] = 24.0
    elevation_deg: Annotated[float, Field(ge=0, le=45)] = 15.0

    @classmethod
    def circles(cls) -> BoardConfig:
        """An asymmetric circle grid of 4 x 11, OpenCV's usual one."""
        return cls(kind="circles", cols=4, rows=11, square_m=0.07)
