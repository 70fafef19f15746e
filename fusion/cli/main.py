"""The command `fusion`: one error boundary; each command is imported only when it is called."""

from __future__ import annotations

import os
import sys
from importlib.metadata import version

from cyclopts import App, CycloptsError, Parameter

from fusion.cli.inspect import INSPECT_EXAMPLES, INSPECT_HELP
from fusion.errors import FusionError

BLEND_HELP = (
    "Fuse RGB and thermal images into a folder of frames.\n\n"
    "Thermal is paired with RGB, windowed, warped onto the RGB grid, coloured and blended in."
    " OUT gets fused/, mask/ (where thermal does not cover the frame), frames.csv and run.toml."
    " The same command run again keeps finished frames."
)
BLEND_EXAMPLES = """Examples:
  fusion blend rgb/ fir/ -o out/ --preview
  fusion blend rgb/ fir/ --dry-run
  fusion blend rgb/ fir/ -o out/ --points points.csv --outside crop
  fusion blend rgb/ fir/ -o out/ --align
  fusion blend rgb/ fir/ -o out/ --rig rig.toml --depth depth/
  fusion blend rgb/ fir/ -o out/ --window 7000 7400 --window-unit counts --colormap inferno
  fusion blend 'day/*_eo-*.jpg' 'day/*_thermal-*.tiff' -o out/ --pair index
  fusion blend rgb.mp4 fir.mkv -o out/ --tolerance-ms 20 --format jpg
  fusion blend MFNet/images/ -o out/ --preset thesis
  fusion blend MSRS/ -o out/ --dataset msrs"""

DEPTH_HELP = (
    "Turn LiDAR clouds into dense depth maps.\n\n"
    "A cloud is cleaned, projected onto a virtual 120-degree camera (or a real one of a rig), freed of"
    " points that the camera cannot see, and the gaps between them are filled. OUT gets depth/ (uint16,"
    " metres x 256), support/, sparse/, picture/, frames.csv and run.toml. The same command run again keeps"
    " finished maps."
)
DEPTH_EXAMPLES = """Examples:
  fusion depth scans/ -o out/
  fusion depth map.pcd -o out/ --position 12 0.5 1.4 --look 30 0 0
  fusion depth scans/ -o out/ --preset thesis
  fusion depth 000000.bin -o out/ --rig calib/000000.txt --overlay image_2/000000.png --show 1 60
  fusion depth --sparse velodyne_raw/ -o out/ --score groundtruth/
  fusion depth --sparse sparse/ --guide rgb/ --method guided -o out/"""

PREPROCESS_HELP = (
    "Turn a data set or a recording into fused frames with depth.\n\n"
    "Streams are matched in time, thermal is warped onto RGB by the LiDAR's own depth (or as the options say)"
    " and blended in. OUT gets fused/, mask/, fir/ (counts on the RGB grid), depth/, support/, sparse/,"
    " frames.csv, lost.csv and run.toml; --to mcap and --to video add one file each. The work is done in"
    " chunks: the same command run again does what is left."
)
PREPROCESS_EXAMPLES = """Examples:
  fusion preprocess flight.mcap -o out/ --rig rig.toml
  fusion preprocess flight.bag -o out/ --rgb /cam/image --fir /thermal/image --homography H.toml
  fusion preprocess mine mine/ -o out/ --to folder --to mcap --to video
  fusion preprocess s3://flights/one.mcap -o s3://fused/one --rig rig.toml --scheduler tcp://head:8786"""

MINE_EXAMPLES = """Examples:
  fusion simulate mine mine/
  fusion simulate mine dusty/ --preset dusty --seed 3 --duration 20
  fusion simulate mine fast/ --speed 3 --max-rate 200 --rings 16"""

RECORD_EXAMPLES = """Examples:
  fusion simulate record mine/ mine.bag --form rosbag1
  fusion simulate record mine/ mine.mcap --form mcap-protobuf --compression zstd
  fusion simulate record mine/ bag/ --form rosbag2 --split-mb 100"""

CALIBRATE_EXAMPLES = """Examples:
  fusion calibrate board board.pdf --kind chessboard --cols 9 --rows 6 --spacing-mm 80
  fusion calibrate stereo rgb/ fir/ --board board.toml -o cameras.toml
  fusion calibrate lidar rgb/ lidar/ --board board.toml --rig cameras.toml -o rig.toml
  fusion blend rgb/ fir/ -o out/ --rig rig.toml --distance 5
  fusion calibrate align rgb/ fir/ -o H.toml
  fusion calibrate check rig.toml
  fusion calibrate convert rig.toml camchain.yaml"""
_CALIBRATE = {
    "board": (
        "Print a board to scale, and describe it.",
        """Examples:
  fusion calibrate board board.pdf
  fusion calibrate board board.svg --kind charuco --cols 8 --rows 6 --spacing-mm 40
  fusion calibrate board tags.pdf --board kalibr_target.yaml""",
    ),
    "intrinsics": (
        "Calibrate one camera from images of a board.",
        """Examples:
  fusion calibrate intrinsics rgb/ --board board.toml -o rgb.toml
  fusion calibrate intrinsics fir/ --board board.toml -o fir.toml --camera fir --debug
  fusion calibrate intrinsics gopro.mp4 --board board.toml -o wide.toml --model fisheye""",
    ),
    "stereo": (
        "Calibrate RGB and thermal: both cameras, and how they stand to each other.",
        """Examples:
  fusion calibrate stereo rgb/ fir/ --board board.toml -o rig.toml
  fusion calibrate stereo rgb/ fir/ --board board.toml -o rig.toml --pair order
  fusion calibrate stereo rgb/ fir/ --board board.toml -o rig.toml --timing offset""",
    ),
    "lidar": (
        "Calibrate a LiDAR to a camera: by a board, by given points, or by the scene.",
        """Examples:
  fusion calibrate lidar rgb/ lidar/ --board board.toml --rig cameras.toml -o rig.toml
  fusion calibrate lidar rgb/ lidar/ --fir fir/ --board board.toml --rig cameras.toml -o rig.toml --refine
  fusion calibrate lidar rgb.png scan.pcd --points points.csv --rig cameras.toml -o rig.toml
  fusion calibrate lidar rgb/ lidar/ --rig rig.toml -o better.toml""",
    ),
    "align": (
        "Lay thermal onto RGB from the scene alone.",
        """Examples:
  fusion calibrate align rgb/ fir/ -o H.toml
  fusion calibrate align rgb.png fir.png -o H.toml --model affine
  fusion blend rgb/ fir/ -o out/ --homography H.toml""",
    ),
    "check": (
        "Check a calibration without any board.",
        """Examples:
  fusion calibrate check rig.toml
  fusion calibrate check camchain.yaml --rgb rgb/ --fir fir/""",
    ),
    "convert": (
        "Write a calibration in another tool's form.",
        """Examples:
  fusion calibrate convert rig.toml camchain.yaml
  fusion calibrate convert calib.json rig.toml
  fusion calibrate convert rig.toml rgb.yaml --form ros""",
    ),
}

app = App(
    name="fusion",
    help="Fused RGB-thermal frames for trackers. Start with: fusion blend RGB FIR -o OUT --preview",
    version=lambda: version("fusionprep"),
    help_format="plaintext",
    default_parameter=Parameter(negative=()),
    suppress_keyboard_interrupt=False,  # ours says how to go on
)
app.command("fusion.cli.blend:blend", name="blend", help=BLEND_HELP, help_epilogue=BLEND_EXAMPLES)
app.command("fusion.cli.inspect:inspect", name="inspect", help=INSPECT_HELP, help_epilogue=INSPECT_EXAMPLES)
app.command(
    "fusion.cli.preprocess:preprocess",
    name="preprocess",
    help=PREPROCESS_HELP,
    help_epilogue=PREPROCESS_EXAMPLES,
)
app.command("fusion.cli.depth:depth", name="depth", help=DEPTH_HELP, help_epilogue=DEPTH_EXAMPLES)
datasets = App(name="datasets", help="List, show and check the data sets whose layout is known.")
datasets.command("fusion.cli.datasets:list_datasets", name="list", help="List the known data sets.")
datasets.command(
    "fusion.cli.datasets:show_dataset",
    name="show",
    help="Show one data set: layout, licence, where to get it.",
)
datasets.command(
    "fusion.cli.datasets:check_dataset",
    name="check",
    help="Hold a data set's files against what is known of it.",
)
app.command(datasets)
simulate = App(name="simulate", help="Make sample data with the truth beside it.")
simulate.command(
    "fusion.cli.simulate:simulate_mine",
    name="mine",
    help="Fly through a synthetic mine: RGB, thermal, LiDAR, and the truth beside them.",
    help_epilogue=MINE_EXAMPLES,
)
simulate.command(
    "fusion.cli.simulate:simulate_session",
    name="session",
    help="Show a heated board to all three sensors of the synthetic mine, for calibration.",
)
simulate.command(
    "fusion.cli.simulate:simulate_pairs",
    name="pairs",
    help="Draw unregistered RGB-thermal pairs of a mine, with their truth.",
)
simulate.command(
    "fusion.cli.record:simulate_record",
    name="record",
    help="Write a simulated mine as a robot's recorder would have written it.",
    help_epilogue=RECORD_EXAMPLES,
)
app.command(simulate)
calibrate = App(
    name="calibrate",
    help="Calibrate a rig of RGB, thermal and LiDAR, from a board or from the scene; check and convert it.",
    help_epilogue=CALIBRATE_EXAMPLES,
)
for _name, (_help, _examples) in _CALIBRATE.items():
    calibrate.command(
        f"fusion.cli.calibrate:calibrate_{_name}", name=_name, help=_help, help_epilogue=_examples
    )
app.command(calibrate)

USAGE, INTERRUPTED, INTERNAL = 2, 130, 70


def main() -> None:
    """Run the command line and exit: 0 done, 1 input or output is at fault, 2 the options are."""
    sys.exit(_guarded())


def _guarded() -> int:
    try:
        app(sys.argv[1:], exit_on_error=False, print_error=False)
    except CycloptsError as error:
        return _complain(f"{' '.join(str(error).split())} (fusion COMMAND --help shows the options)", USAGE)
    except FusionError as error:
        return _complain(str(error), error.exit_code)
    except KeyboardInterrupt as stopped:
        goes_on = "the same command goes on where this one stopped"
        return _complain(f"interrupted; {stopped.args[0] if stopped.args else goes_on}", INTERRUPTED)
    except MemoryError:
        return _complain("out of memory (try fewer --workers)", 1)
    except BrokenPipeError:
        os.dup2(
            os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno()
        )  # whoever read us has left: say no more
        return 0
    except OSError as error:
        return _complain(f"{error.filename or 'system'}: {error.strerror or error}", 1)
    except Exception as error:
        if os.environ.get("FUSION_DEBUG"):
            raise
        what = f"{type(error).__name__}: {error}".splitlines()[0]
        return _complain(
            f"a fault of fusion's own: {what} (please report it; FUSION_DEBUG=1 shows more)", INTERNAL
        )
    return 0


def _complain(text: str, exit_code: int) -> int:
    print(f"fusion: {text}", file=sys.stderr)
    return exit_code
