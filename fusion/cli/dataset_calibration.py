"""Whether a data set's calibrations can be read, and are of the images that lie beside them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from calib.formats import read_with_notes
from fusion.errors import FusionError

if TYPE_CHECKING:
    from fusion.cli.dataset_checks import Report
    from fusion.manifest import Layout

_MOST = 8  # read, of those that are one a frame or a sequence


def check_calibration(layout: Layout, sizes_wh: dict[str, tuple[int, int]], report: Report) -> None:
    """`sizes_wh` are the images' sizes by camera. What is found goes to `report`."""
    found = layout.calibration
    if found is None:
        report.calibration.append("none with the set")
        return
    if not found.files:
        report.note("calibration", f"no calibration matches '{found.pattern}'")
        return
    if found.form is None:
        report.calibration.append(f"{len(found.files)} files, not read: {found.note}")
        return
    paths = found.readable()
    for path in paths[:_MOST]:
        _read(path, sizes_wh, report)
    more = f"; {len(paths) - _MOST} more not looked at" if len(paths) > _MOST else ""
    report.calibration.append(f"{len(paths)} of form {found.form}, {found.per}: {paths[0]}{more}")


def _read(path: Path, sizes_wh: dict[str, tuple[int, int]], report: Report) -> None:
    """One calibration; its sizes must be the images' (some forms do not say them)."""
    try:
        rig, notes = read_with_notes(path, sizes_wh, any_size=True)
    except FusionError as error:
        report.wrong("calibration", str(error))
        return
    for name, size in sizes_wh.items():
        camera = rig.cameras.get(name)
        if camera is not None and tuple(camera.size_wh) != tuple(size):
            theirs, ours = ("{}x{}".format(*s) for s in (camera.size_wh, size))
            text = f"{path}: it is for {name} images of {theirs}, these are {ours}"
            report.wrong("calibration", text)
    for note in notes:
        report.note("calibration", f"{path}: {note}")
