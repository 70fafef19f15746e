"""`fusion blend`: two folders of images in, fused frames out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Group, Parameter

from fusion.cli import options
from fusion.cli.options import RUN

PAIRING = Group("Pairing", sort_key=1)


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
    window: options.Window = None,
    window_unit: options.WindowUnit = None,
    window_over: options.WindowOver = None,
    celsius_per_count: options.CelsiusPerCount = None,
    celsius_at_zero: options.CelsiusAtZero = None,
    clahe: options.Clahe = None,
    colormap: options.Colormap = None,
    fir_colour: options.FirColour = None,
    homography: options.Homography = None,
    points: options.Points = None,
    align: options.Align = None,
    rig: options.Rig = None,
    warp: options.Warp = None,
    distance: options.Distance = None,
    depth: options.Depth = None,
    undistort: options.Undistort = None,
    outside: options.Outside = None,
    fill_bgr: options.FillBgr = None,
    method: options.Method = None,
    alpha: options.Alpha = None,
    format: options.Format = None,
    quality: options.Quality = None,
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
    given = dict(locals())
    from fusion.cli import blending

    blending.run_blend(
        blending.settings_of(config, given),
        [path for path in (rgb, fir) if path is not None],
        out,
        dataset=dataset,
        workers=workers,
        overwrite=overwrite,
        dry_run=dry_run,
        preview=preview,
        quiet=quiet,
    )
