"""`fusion calibrate`: from images of a board, or from the scene alone, to a rig and a verdict."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Group, Parameter

BOARD = Group("Board", sort_key=1)
MODEL = Group("Model", sort_key=2)
PAIRS = Group("Which views belong together", sort_key=3)
OUTPUT = Group("Output", sort_key=4)
RUN = Group("Run", sort_key=5)

LensModel = Literal["pinhole", "radtan", "rational", "fisheye"]

BoardFile = Annotated[
    Path, Parameter(name="--board", group=BOARD, help="TOML of the board, or Kalibr's target YAML.")
]
Out = Annotated[Path, Parameter(name=["--out", "-o"], group=OUTPUT, help="The rig to write, rig.toml.")]
Overwrite = Annotated[bool, Parameter(group=OUTPUT, help="Replace OUT where it is there already.")]
Debug = Annotated[
    bool,
    Parameter(group=OUTPUT, help="Write a picture an image: what was tried, found, and why it was refused."),
]
Report = Annotated[
    bool, Parameter(group=OUTPUT, negative="--no-report", help="Write OUT_evidence/report.html. Default.")
]
Workers = Annotated[int | None, Parameter(group=RUN, help="Threads. Default: one a core.")]
Quiet = Annotated[bool, Parameter(group=RUN, help="No progress, no tables; the verdict is in OUT.")]
Tolerance = Annotated[
    float | None, Parameter(group=PAIRS, help="Largest time difference of what belongs together, ms.")
]
PairBy = Annotated[
    Literal["auto", "stamp", "stem", "order"] | None,
    Parameter(
        group=PAIRS, help="By time stamps, by equal names, or the first with the first. Default: auto."
    ),
]
Refine = Annotated[
    bool | None,
    Parameter(
        group=MODEL,
        negative="--hold",
        help="Refine the cameras of --rig, or hold them. Default: held where they are from more views.",
    ),
]
_MODEL_HELP = (
    "pinhole (5 coefficients), radtan (4, as Kalibr has), rational (8), or fisheye (Kannala-Brandt, 4)."
)


def calibrate_board(
    out: Annotated[Path, Parameter(help="board.pdf or board.svg; board.toml is written beside it.")],
    /,
    *,
    board: Annotated[
        Path | None, Parameter(group=BOARD, help="Print this board (TOML, or Kalibr's target YAML).")
    ] = None,
    kind: Annotated[
        Literal["chessboard", "charuco", "aprilgrid", "circles", "asymmetric-circles"] | None,
        Parameter(group=BOARD, help="What is printed on it. Default: chessboard."),
    ] = None,
    cols: Annotated[
        int | None,
        Parameter(
            group=BOARD,
            help="chessboard: inner corners a row; charuco: squares; else tags or circles. Default: 9.",
        ),
    ] = None,
    rows: Annotated[int | None, Parameter(group=BOARD, help="The same, down. Default: 6.")] = None,
    spacing_mm: Annotated[
        float | None,
        Parameter(group=BOARD, help="From one corner, circle or tag to the next. Default: 30."),
    ] = None,
    marker_mm: Annotated[
        float | None, Parameter(group=BOARD, help="Side of a code's square. Default: 0.75 of the spacing.")
    ] = None,
    dictionary: Annotated[
        str | None, Parameter(group=BOARD, help="Of charuco. Default: DICT_5X5_100.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Print a board to scale."""
    from fusion.cli import calibration_files as files

    made = files.Made(kind, cols, rows, spacing_mm, marker_mm, dictionary)
    files.run_board(out, board, made, overwrite=overwrite)


def calibrate_intrinsics(
    images: Annotated[str, Parameter(help="Folder, glob pattern or video of a board, one camera.")],
    /,
    *,
    board: BoardFile,
    out: Out,
    camera: Annotated[
        Literal["rgb", "fir"], Parameter(group=MODEL, help="What the camera is called in the rig.")
    ] = "rgb",
    model: Annotated[LensModel, Parameter(group=MODEL, help=_MODEL_HELP)] = "pinhole",
    rig: Annotated[Path | None, Parameter(group=OUTPUT, help="A rig whose other sensors are kept.")] = None,
    overwrite: Overwrite = False,
    report: Report = True,
    debug: Debug = False,
    workers: Workers = None,
    quiet: Quiet = False,
) -> None:
    """One camera from images of a board."""
    from fusion.cli import calibrating

    asked = calibrating.Asked(board, out, rig, overwrite, report, debug, workers, quiet)
    calibrating.run_intrinsics(asked, images, camera, model)


def calibrate_stereo(
    rgb: Annotated[str, Parameter(help="Folder, glob pattern or video of the board in RGB.")],
    fir: Annotated[str, Parameter(help="The same for thermal.")],
    /,
    *,
    board: BoardFile,
    out: Out,
    rgb_model: Annotated[LensModel, Parameter(group=MODEL, help=_MODEL_HELP)] = "pinhole",
    fir_model: Annotated[LensModel, Parameter(group=MODEL, help="The same for thermal.")] = "pinhole",
    rig: Annotated[Path | None, Parameter(group=MODEL, help="Cameras that are known already.")] = None,
    refine: Refine = None,
    pair: PairBy = None,
    tolerance_ms: Tolerance = None,
    timing: Annotated[
        Literal["synchronised", "offset", "static"],
        Parameter(
            group=PAIRS,
            help="offset: estimate how far the clocks are apart; static: use standing boards only.",
        ),
    ] = "synchronised",
    overwrite: Overwrite = False,
    report: Report = True,
    debug: Debug = False,
    workers: Workers = None,
    quiet: Quiet = False,
) -> None:
    """RGB and thermal: both cameras, and how they stand to each other."""
    from fusion.cli import calibrating

    asked = calibrating.Asked(board, out, rig, overwrite, report, debug, workers, quiet)
    together = calibrating.Together(pair or "auto", tolerance_ms, timing)
    calibrating.run_stereo(
        asked, {"rgb": rgb, "fir": fir}, {"rgb": rgb_model, "fir": fir_model}, together, refine
    )


def calibrate_lidar(
    rgb: Annotated[str, Parameter(help="Folder, glob pattern or image: RGB.")],
    clouds: Annotated[str, Parameter(help="Folder, glob pattern or file: LiDAR clouds.")],
    /,
    *,
    out: Out,
    rig: Annotated[Path, Parameter(group=MODEL, help="The rig with its cameras, from stereo or intrinsics.")],
    board: Annotated[
        Path | None,
        Parameter(name="--board", group=BOARD, help="The board that both see. Without: the scene itself."),
    ] = None,
    fir: Annotated[
        str | None, Parameter(group=MODEL, help="Thermal images of the same board, for the joint solve.")
    ] = None,
    points: Annotated[
        Path | None, Parameter(group=BOARD, help="CSV of matching points instead: x_m,y_m,z_m,u_px,v_px.")
    ] = None,
    camera: Annotated[
        Literal["rgb", "fir"], Parameter(group=MODEL, help="Which camera of the rig the images are from.")
    ] = "rgb",
    refine: Refine = None,
    pair: PairBy = None,
    tolerance_ms: Tolerance = None,
    overwrite: Overwrite = False,
    report: Report = True,
    debug: Debug = False,
    workers: Workers = None,
    quiet: Quiet = False,
) -> None:
    """LiDAR to camera: from a board, from given points, or refined on the scene."""
    from fusion.cli import calibrating, calibrating_lidar

    asked = calibrating.Asked(board, out, rig, overwrite, report, debug, workers, quiet)
    together = calibrating.Together(pair or "auto", tolerance_ms, "synchronised")
    calibrating_lidar.run_lidar(asked, camera, rgb, clouds, fir, points, together, refine)


def calibrate_align(
    rgb: Annotated[str, Parameter(help="Folder, glob pattern, video or image.")],
    fir: Annotated[str, Parameter(help="The same for thermal.")],
    /,
    *,
    out: Annotated[
        Path, Parameter(name=["--out", "-o"], group=OUTPUT, help="The homography to write, H.toml.")
    ],
    model: Annotated[
        Literal["auto", "similarity", "affine", "homography"],
        Parameter(group=MODEL, help="What may change. Default: as much as the frames justify."),
    ] = "auto",
    frames: Annotated[int, Parameter(group=RUN, help="How many pairs, evenly spread, are pooled.")] = 8,
    matcher: Annotated[
        str, Parameter(group=MODEL, help="channels, or one that another package brings.")
    ] = "channels",
    pair: Annotated[
        Literal["auto", "stem", "index", "stamp", "order"] | None,
        Parameter(group=PAIRS, help="What makes two images a pair."),
    ] = None,
    tolerance_ms: Tolerance = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Thermal onto RGB from the scene alone: one homography for `fusion blend --homography`."""
    from fusion.cli import aligning

    aligning.run_align(
        rgb, fir, out, model, matcher, frames, pair, tolerance_ms, overwrite=overwrite, quiet=quiet
    )


def calibrate_check(
    rig: Annotated[Path, Parameter(help="rig.toml, or a calibration of another tool.")],
    /,
    *,
    rgb: Annotated[str | None, Parameter(help="Images of the RGB camera: is it their size?")] = None,
    fir: Annotated[str | None, Parameter(help="The same for thermal.")] = None,
) -> None:
    """What can be wrong with a calibration, without any board."""
    from fusion.cli import calibration_files as files

    files.run_check(rig, {"rgb": rgb, "fir": fir})


def calibrate_convert(
    source: Annotated[Path, Parameter(help="rig.toml, Kalibr, ROS, OpenCV, KITTI or koide3 calibration.")],
    out: Annotated[Path, Parameter(help="What to write; its form is told by its name, or by --form.")],
    /,
    *,
    form: Annotated[
        str | None, Parameter(help="rig, kalibr, ros, opencv, kitti (object), kitti-raw, koide, plain.")
    ] = None,
    size: Annotated[
        tuple[int, int] | None,
        Parameter(help="Width and height of RGB images, where the source does not say."),
    ] = None,
    names: Annotated[
        tuple[str, ...] | None, Parameter(help="What the source's cameras are called here, in its order.")
    ] = None,
    force: Annotated[
        bool, Parameter(help="KITTI's forms: leave the distortion out; the images must be undistorted too.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """A calibration in another tool's form."""
    from fusion.cli import calibration_files as files

    files.run_convert(source, out, form, size, names, force=force, overwrite=overwrite)
