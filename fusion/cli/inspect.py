"""`fusion inspect`: what is in a file or folder, and what command comes next."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

if TYPE_CHECKING:
    from fusion.inspect.base import InspectKind

INSPECT_HELP = (
    "Say what a recording, folder, cloud, image, video, calibration or output holds.\n\n"
    "Counts, rates, gaps, clocks, sizes, encodings, ranges and faults; which topic could be RGB, thermal or"
    " LiDAR, and why; and the command that comes next. Large things are sampled, and it says so;"
    " --full reads all."
)
INSPECT_EXAMPLES = """Examples:
  fusion inspect flight.mcap
  fusion inspect flight.bag --full --html flight.html
  fusion inspect rosbag2_2025_04_21/ --json
  fusion inspect rgb/
  fusion inspect FLIR_0001.jpg
  fusion inspect rig.toml"""


def inspect(
    path: Annotated[
        str,
        Parameter(help="A recording (or its URL), folder, cloud, image, video, calibration or output."),
    ],
    /,
    *,
    full: Annotated[bool, Parameter(help="Read everything: exact gaps, frozen frames, ranges.")] = False,
    json: Annotated[bool, Parameter(help="Print JSON for machines.")] = False,
    html: Annotated[Path | None, Parameter(help="Write a page with pictures to this file.")] = None,
    overwrite: Annotated[bool, Parameter(help="Replace the page where it is there already.")] = False,
    quiet: Annotated[bool, Parameter(help="No progress.")] = False,
) -> None:
    """Say what is in `path`."""
    from fusion.cli.running import progress_bar, quiet_libraries, refuse_existing
    from fusion.files import replace_file
    from fusion.inspect import inspect as look
    from fusion.inspect.page import page_of
    from fusion.inspect.record import json_of
    from fusion.inspect.text import text_of

    if html is not None:
        refuse_existing(html, overwrite)
    with progress_bar("inspect", quiet) as progress, quiet_libraries():
        finding = look(
            path, full=full, pictures=html is not None, progress=progress, also=(_calibration_kind(),)
        )
    if html is not None:
        replace_file(html, page_of(finding))
    print(json_of(finding) if json else "\n".join(text_of(finding)))


def _calibration_kind() -> InspectKind:
    """Calibrations of other tools: `calib` reads them, and of fusion only the command line imports it."""
    from calib.formats import read_with_notes
    from calib.formats.plain import FORMS
    from fusion.errors import FusionError, InputError
    from fusion.inspect.base import Asked, Finding, InspectKind
    from fusion.inspect.rigs import finding_of

    def accepts(path: Path) -> bool:
        if path.is_dir():
            return (path / "calib_cam_to_cam.txt").is_file()
        return path.suffix.lower() in (".yaml", ".yml", ".json", ".txt", ".toml")

    def look(path: Path, _: Asked) -> Finding:
        try:
            rig, notes = read_with_notes(path)
        except FusionError as error:
            try:  # forms that do not say how large the pictures are: whatever size we say is then not told
                rig, notes = read_with_notes(path, (1, 1))
            except FusionError:
                raise InputError(error.what, where=path, hint=error.hint) from None
            return finding_of(
                path, rig, "a calibration that does not say the size of pictures", notes, sizes=False
            )
        return finding_of(path, rig, "a calibration", notes)

    return InspectKind(f"a calibration ({FORMS})", accepts, look)
