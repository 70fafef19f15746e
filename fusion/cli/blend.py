"""`fusion blend`: two folders of images in, fused frames out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Group, Parameter

PAIRING = Group("Pairing", sort_key=1)
THERMAL = Group("Thermal", sort_key=2)
WARP = Group("Warp", sort_key=3)
BLEND = Group("Blend and output", sort_key=4)
RUN = Group("Run", sort_key=5)


def blend(
    rgb: Annotated[
        str, Parameter(help="Folder, glob pattern, video or image; 4-channel RGB+T files without FIR.")
    ],
    fir: Annotated[str | None, Parameter(help="The same for thermal.")] = None,
    /,
    *,
    out: Annotated[Path | None, Parameter(name=["--out", "-o"], help="Folder for the fused frames.")] = None,
    dataset: Annotated[
        str | None, Parameter(help="RGB is the root of this data set (see: fusion datasets list).")
    ] = None,
    config: Annotated[
        Path | None, Parameter(help="TOML with any of these settings; options win over it.")
    ] = None,
    preset: Annotated[Literal["auto", "thesis"] | None, Parameter(help="Default: auto.")] = None,
    pair: Annotated[
        Literal["auto", "stem", "index", "stamp", "map", "order"] | None,
        Parameter(group=PAIRING, help="What makes two images a pair."),
    ] = None,
    rgb_key: Annotated[
        str | None, Parameter(group=PAIRING, help="Regular expression: the key in an RGB name.")
    ] = None,
    fir_key: Annotated[str | None, Parameter(group=PAIRING, help="The same in a thermal name.")] = None,
    pair_map: Annotated[str | None, Parameter(group=PAIRING, help="CSV (rgb,fir) or JSON of pairs.")] = None,
    tolerance_ms: Annotated[
        float | None, Parameter(group=PAIRING, help="Largest time difference of a pair.")
    ] = None,
    window: Annotated[
        tuple[float, float] | None, Parameter(group=THERMAL, help="LO HI, stretched to all colours.")
    ] = None,
    window_unit: Annotated[
        Literal["fraction", "counts", "celsius", "percentile"] | None,
        Parameter(
            group=THERMAL, help="Unit of --window. Default with --window: fraction of the type's range."
        ),
    ] = None,
    window_over: Annotated[
        Literal["frame", "sequence", "running"] | None,
        Parameter(group=THERMAL, help="What percentiles are taken over. Default: sequence."),
    ] = None,
    celsius_per_count: Annotated[
        float | None, Parameter(group=THERMAL, help="Scale of the counts, e.g. 0.04.")
    ] = None,
    celsius_at_zero: Annotated[
        float | None, Parameter(group=THERMAL, help="Temperature of count 0, e.g. -273.15.")
    ] = None,
    clahe: Annotated[
        float | None, Parameter(group=THERMAL, help="Local contrast: clip limit, e.g. 2. Default: off.")
    ] = None,
    colormap: Annotated[
        str | None,
        Parameter(group=THERMAL, help="hsv, hsv-cold-hot, grey, or any of OpenCV's and matplotlib's."),
    ] = None,
    fir_colour: Annotated[
        Literal["refuse", "luma"] | None, Parameter(group=THERMAL, help="What to do with thermal in colour.")
    ] = None,
    homography: Annotated[
        str | None, Parameter(group=WARP, help="File with the 3x3 matrix from thermal to RGB pixels.")
    ] = None,
    points: Annotated[
        str | None, Parameter(group=WARP, help="CSV of matching points: fir_x,fir_y,rgb_x,rgb_y.")
    ] = None,
    align: Annotated[
        bool | None, Parameter(group=WARP, help="Find where thermal lies from the scene alone; no board.")
    ] = None,
    rig: Annotated[
        str | None, Parameter(group=WARP, help="Calibration of both cameras: rig.toml, or another tool's.")
    ] = None,
    warp: Annotated[
        Literal["infinity", "distance", "depth"] | None,
        Parameter(group=WARP, help="With --rig: where things are. Default: by what else is given."),
    ] = None,
    distance: Annotated[
        float | None,
        Parameter(group=WARP, help="Metres along RGB's axis; with --depth: where a map has none."),
    ] = None,
    depth: Annotated[
        str | None, Parameter(group=WARP, help="Depth maps of the RGB camera, by `fusion depth --rig`.")
    ] = None,
    undistort: Annotated[
        bool | None, Parameter(group=WARP, help="With --rig: the frames are those of an ideal pinhole.")
    ] = None,
    outside: Annotated[
        Literal["crop", "keep", "fill"] | None, Parameter(group=WARP, help="Where thermal does not reach.")
    ] = None,
    fill_bgr: Annotated[
        tuple[int, int, int] | None, Parameter(group=WARP, help="Colour for --outside fill.")
    ] = None,
    method: Annotated[str | None, Parameter(group=BLEND, help="alpha or laplacian.")] = None,
    alpha: Annotated[float | None, Parameter(group=BLEND, help="Weight of RGB. Default: 0.85.")] = None,
    format: Annotated[
        Literal["png", "jpg"] | None, Parameter(group=BLEND, help="png is lossless. Default: png.")
    ] = None,
    quality: Annotated[int | None, Parameter(group=BLEND, help="JPEG quality 1 to 100. Default: 90.")] = None,
    workers: Annotated[
        int | None, Parameter(group=RUN, help="Threads. Default: one a core; the output is the same.")
    ] = None,
    strict: Annotated[
        bool | None, Parameter(group=RUN, help="Stop at the first unmatched or unusable frame.")
    ] = None,
    overwrite: Annotated[
        bool, Parameter(group=RUN, help="Replace the frames of another run in OUT.")
    ] = False,
    dry_run: Annotated[
        bool, Parameter(group=RUN, help="Only report the pairing (with --preview: and draw it).")
    ] = False,
    preview: Annotated[
        bool, Parameter(group=RUN, help="Write OUT/preview.png, a contact sheet of every step.")
    ] = False,
    quiet: Annotated[bool, Parameter(group=RUN, help="No progress, no table.")] = False,
) -> None:
    """Fuse RGB and thermal images into a folder of frames."""
    options = dict(locals())
    from fusion.cli import blending

    blending.run_blend(
        blending.settings_of(config, options),
        [path for path in (rgb, fir) if path is not None],
        out,
        dataset=dataset,
        workers=workers,
        overwrite=overwrite,
        dry_run=dry_run,
        preview=preview,
        quiet=quiet,
    )
