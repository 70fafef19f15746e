"""Options that several commands have, with one name and one meaning each."""

from __future__ import annotations

from typing import Annotated, Literal

from cyclopts import Group, Parameter

THERMAL = Group("Thermal", sort_key=2)
WARP = Group("Warp", sort_key=3)
BLEND = Group("Blend and output", sort_key=4)
RUN = Group("Run", sort_key=5)

Window = Annotated[
    tuple[float, float] | None, Parameter(group=THERMAL, help="LO HI, stretched to all colours.")
]
WindowUnit = Annotated[
    Literal["fraction", "counts", "celsius", "percentile"] | None,
    Parameter(group=THERMAL, help="Unit of --window. Default with --window: fraction of the type's range."),
]
WindowOver = Annotated[
    Literal["frame", "sequence", "running"] | None,
    Parameter(group=THERMAL, help="What percentiles are taken over. Default: sequence."),
]
CelsiusPerCount = Annotated[float | None, Parameter(group=THERMAL, help="Scale of the counts, e.g. 0.04.")]
CelsiusAtZero = Annotated[
    float | None, Parameter(group=THERMAL, help="Temperature of count 0, e.g. -273.15.")
]
Clahe = Annotated[
    float | None, Parameter(group=THERMAL, help="Local contrast: clip limit, e.g. 2. Default: off.")
]
Colormap = Annotated[
    str | None,
    Parameter(group=THERMAL, help="hsv, hsv-cold-hot, grey, or any of OpenCV's and matplotlib's."),
]
FirColour = Annotated[
    Literal["refuse", "luma"] | None, Parameter(group=THERMAL, help="What to do with thermal in colour.")
]
Homography = Annotated[
    str | None, Parameter(group=WARP, help="File with the 3x3 matrix from thermal to RGB pixels.")
]
Points = Annotated[str | None, Parameter(group=WARP, help="CSV of matching points: fir_x,fir_y,rgb_x,rgb_y.")]
Align = Annotated[
    bool | None, Parameter(group=WARP, help="Find where thermal lies from the scene alone; no board.")
]
Rig = Annotated[
    str | None, Parameter(group=WARP, help="Calibration of both cameras: rig.toml, or another tool's.")
]
Warp = Annotated[
    Literal["infinity", "distance", "depth"] | None,
    Parameter(group=WARP, help="With --rig: where things are. Default: by what else is given."),
]
Distance = Annotated[
    float | None,
    Parameter(group=WARP, help="Metres along RGB's axis; with --depth: where a map has none."),
]
Depth = Annotated[
    str | None, Parameter(group=WARP, help="Depth maps of the RGB camera, by `fusion depth --rig`.")
]
Undistort = Annotated[
    bool | None, Parameter(group=WARP, help="With --rig: the frames are those of an ideal pinhole.")
]
Outside = Annotated[
    Literal["crop", "keep", "fill"] | None, Parameter(group=WARP, help="Where thermal does not reach.")
]
FillBgr = Annotated[tuple[int, int, int] | None, Parameter(group=WARP, help="Colour for --outside fill.")]
Method = Annotated[str | None, Parameter(group=BLEND, help="alpha or laplacian.")]
Alpha = Annotated[float | None, Parameter(group=BLEND, help="Weight of RGB. Default: 0.85.")]
Format = Annotated[
    Literal["png", "jpg"] | None, Parameter(group=BLEND, help="png is lossless. Default: png.")
]
Quality = Annotated[int | None, Parameter(group=BLEND, help="JPEG quality 1 to 100. Default: 90.")]
