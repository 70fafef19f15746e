"""`fusion preprocess`: a data set or a recording in, fused frames with depth out, resumable."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Group, Parameter

from fusion.cli import options
from fusion.cli.options import RUN

STREAMS = Group("Streams", sort_key=1)


def preprocess(
    source: Annotated[
        str,
        Parameter(
            help="A recording (bag, rosbag2 folder, MCAP; a path or a URL), or the name of a data set."
        ),
    ],
    root: Annotated[Path | None, Parameter(help="Where the data set lies.")] = None,
    /,
    *,
    out: Annotated[
        str | None, Parameter(name=["--out", "-o"], help="Folder, or a URL such as s3://bucket/run.")
    ] = None,
    config: Annotated[
        Path | None, Parameter(help="TOML with any of these settings; options win over it.")
    ] = None,
    preset: Annotated[Literal["auto", "thesis"] | None, Parameter(help="Default: auto.")] = None,
    rgb: Annotated[
        str | None, Parameter(group=STREAMS, help="Topic. Default: the only one that can be it.")
    ] = None,
    fir: Annotated[str | None, Parameter(group=STREAMS, help="The same for thermal.")] = None,
    lidar: Annotated[str | None, Parameter(group=STREAMS, help="The same for clouds; '' uses none.")] = None,
    lead: Annotated[
        Literal["rgb", "lidar"] | None,
        Parameter(group=STREAMS, help="Whose messages make a frame each. Default: rgb."),
    ] = None,
    stamp: Annotated[
        Literal["header", "log"] | None,
        Parameter(group=STREAMS, help="The sender's stamps, or when it was recorded. Default: header."),
    ] = None,
    tolerance_ms: Annotated[
        float | None, Parameter(group=STREAMS, help="Largest time difference of thermal to RGB.")
    ] = None,
    lidar_tolerance_ms: Annotated[
        float | None, Parameter(group=STREAMS, help="The same of clouds. Default: 50.")
    ] = None,
    fir_offset_ms: Annotated[
        float | None, Parameter(group=STREAMS, help="Added to thermal stamps. Default: as the rig says.")
    ] = None,
    fir_drift_ppm: Annotated[
        float | None, Parameter(group=STREAMS, help="And by how much that grows with time.")
    ] = None,
    estimate_clock: Annotated[
        bool | None, Parameter(group=STREAMS, help="Find offset and drift from how the pictures move.")
    ] = None,
    keep_frozen: Annotated[
        bool | None, Parameter(group=STREAMS, help="Use thermal frames that repeat the one before.")
    ] = None,
    begin: Annotated[
        float | None, Parameter(group=STREAMS, help="Seconds from the recording's first message.")
    ] = None,
    end: Annotated[float | None, Parameter(group=STREAMS, help="The same, where to stop.")] = None,
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
    undistort: options.Undistort = None,
    outside: options.Outside = None,
    fill_bgr: options.FillBgr = None,
    densify: Annotated[
        str | None, Parameter(group=options.WARP, help="How depth is filled, as `fusion depth --method`.")
    ] = None,
    method: options.Method = None,
    alpha: options.Alpha = None,
    to: Annotated[
        tuple[str, ...] | None,
        Parameter(group=options.BLEND, help="folder, mcap, video; more than one: --to folder --to mcap."),
    ] = None,
    format: options.Format = None,
    quality: options.Quality = None,
    chunk_s: Annotated[
        float | None, Parameter(group=RUN, help="Seconds of a recording that are done as one. Default: 20.")
    ] = None,
    workers: Annotated[
        int | None, Parameter(group=RUN, help="Threads (or processes of the cluster). Default: one a core.")
    ] = None,
    cluster: Annotated[
        Literal["local"] | None, Parameter(group=RUN, help="Start Dask workers on this machine.")
    ] = None,
    scheduler: Annotated[
        str | None, Parameter(group=RUN, help="Address of a Dask scheduler, tcp://host:port.")
    ] = None,
    wait_s: Annotated[
        float | None, Parameter(group=RUN, help="How long to wait for a first Dask worker. Default: 600.")
    ] = None,
    strict: Annotated[bool | None, Parameter(group=RUN, help="A frame that cannot be used fails.")] = None,
    overwrite: Annotated[
        bool, Parameter(group=RUN, help="Replace the frames of another run in OUT.")
    ] = False,
    dry_run: Annotated[
        bool, Parameter(group=RUN, help="Only say what would be done: streams, clocks, registration.")
    ] = False,
    quiet: Annotated[bool, Parameter(group=RUN, help="No progress, no table.")] = False,
) -> None:
    """Turn a data set or a recording into fused frames with depth."""
    given = dict(locals())
    from fusion.cli import preprocessing

    preprocessing.run_preprocess(
        preprocessing.settings_of(config, given),
        source,
        root,
        out,
        route=preprocessing.route_of(workers, cluster, scheduler, wait_s),
        overwrite=overwrite,
        dry_run=dry_run,
        quiet=quiet,
    )
