"""`fusion depth`: clouds or sparse depth pictures in, dense depth out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Group, Parameter

CLOUD = Group("Cloud", sort_key=1)
CAMERA = Group("Camera", sort_key=2)
SAMPLES = Group("Samples and gaps", sort_key=3)
PICTURE = Group("Pictures and truth", sort_key=4)
RUN = Group("Run", sort_key=5)

Three = tuple[float, float, float]


def depth(
    *inputs: Annotated[str, Parameter(help="Clouds: files, folders or glob patterns.")],
    out: Annotated[Path | None, Parameter(name=["--out", "-o"], help="Folder for the depth maps.")] = None,
    config: Annotated[
        Path | None, Parameter(help="TOML with any of these settings; options win over it.")
    ] = None,
    preset: Annotated[Literal["auto", "thesis"] | None, Parameter(help="Default: auto.")] = None,
    sparse: Annotated[
        str | None, Parameter(group=CLOUD, help="Sparse depth PNGs (metres x 256) in place of clouds.")
    ] = None,
    form: Annotated[
        str | None, Parameter(group=CLOUD, help="Read clouds as pcd, ply, kitti, nuscenes, las, npy or npz.")
    ] = None,
    range: Annotated[
        tuple[float, float] | None, Parameter(group=CLOUD, help="LEAST MOST metres from the cloud's origin.")
    ] = None,
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        Parameter(group=CLOUD, help="Keep X0 Y0 Z0 X1 Y1 Z1, metres of the cloud's frame."),
    ] = None,
    voxel: Annotated[
        float | None, Parameter(group=CLOUD, help="Down-sample to one point a cube, metres.")
    ] = None,
    outliers: Annotated[
        tuple[int, float] | None,
        Parameter(group=CLOUD, help="NEIGHBOURS RATIO: drop points far from their neighbours, e.g. 20 2."),
    ] = None,
    camera: Annotated[
        Literal["pinhole", "fisheye", "cylindrical", "spherical"] | None,
        Parameter(group=CAMERA, help="The virtual camera. Default: pinhole."),
    ] = None,
    fov: Annotated[
        float | None, Parameter(group=CAMERA, help="Horizontal field of view, degrees. Default: 120.")
    ] = None,
    size: Annotated[
        tuple[int, int] | None, Parameter(group=CAMERA, help="WIDTH HEIGHT. Default: 640 480.")
    ] = None,
    position: Annotated[
        Three | None, Parameter(group=CAMERA, help="X Y Z of the camera in the cloud's frame, metres.")
    ] = None,
    look: Annotated[
        Three | None,
        Parameter(group=CAMERA, help="YAW PITCH ROLL, degrees: left, down, clockwise. Default: along +x."),
    ] = None,
    rig: Annotated[
        str | None, Parameter(group=CAMERA, help="A real camera: rig.toml, or a KITTI calibration.")
    ] = None,
    sensor: Annotated[
        str | None, Parameter(group=CAMERA, help="Which camera of --rig. Default: rgb.")
    ] = None,
    value: Annotated[
        Literal["auto", "depth", "range"] | None,
        Parameter(
            group=SAMPLES, help="Along the axis, or from the camera's centre. Default: depth if it can."
        ),
    ] = None,
    limits: Annotated[
        tuple[float, float] | None, Parameter(group=SAMPLES, help="LEAST MOST value that is kept, metres.")
    ] = None,
    visibility: Annotated[
        Literal["auto", "scan", "map", "none"] | None,
        Parameter(group=SAMPLES, help="How hidden points are found. Default: as the cloud is."),
    ] = None,
    method: Annotated[
        str | None,
        Parameter(
            group=SAMPLES,
            help="plane, plane-fast, scan, natural-discrete, natural, linear, nearest, guided.",
        ),
    ] = None,
    extrapolate: Annotated[
        Literal["none", "nearest", "linear"] | None,
        Parameter(group=SAMPLES, help="What lies beyond the samples. Default: none."),
    ] = None,
    max_gap: Annotated[
        float | None,
        Parameter(group=SAMPLES, help="Farthest pixel from a sample, pixels. Default: by spacing."),
    ] = None,
    guide: Annotated[
        str | None, Parameter(group=SAMPLES, help="RGB image, or folder of them, for --method guided.")
    ] = None,
    colormap: Annotated[str | None, Parameter(group=PICTURE, help="Default: jet.")] = None,
    show: Annotated[
        tuple[float, float] | None, Parameter(group=PICTURE, help="LEAST MOST of the colours. Default: 1 10.")
    ] = None,
    overlay: Annotated[
        str | None, Parameter(group=PICTURE, help="RGB image, or folder of them, to draw the points over.")
    ] = None,
    score: Annotated[
        str | None, Parameter(group=PICTURE, help="True depth PNGs: print the errors, as KITTI counts them.")
    ] = None,
    workers: Annotated[
        int | None, Parameter(group=RUN, help="Threads. Default: one a core; the output is the same.")
    ] = None,
    strict: Annotated[bool | None, Parameter(group=RUN, help="Stop at the first unusable cloud.")] = None,
    overwrite: Annotated[bool, Parameter(group=RUN, help="Replace the maps of another run in OUT.")] = False,
    quiet: Annotated[bool, Parameter(group=RUN, help="No progress, no table.")] = False,
) -> None:
    """Turn clouds into dense depth."""
    options = dict(locals())
    from fusion.cli import depthing

    depthing.run_depth(
        depthing.settings_of(config, options),
        depthing.Given(inputs, sparse, guide, overlay, score),
        out,
        workers=workers,
        overwrite=overwrite,
        quiet=quiet,
    )
