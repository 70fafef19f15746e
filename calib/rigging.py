"""Several cameras, and the LiDAR, from shared views of a board."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from calib.boards import Board
from calib.initial import spread_views
from calib.intrinsics import calibrate_camera, check_mirrored
from calib.links import join_views
from calib.observations import View
from calib.solve import Estimate, Solution, solve
from calib.solve.descent import Progress
from calib.timing import with_offsets
from fusion.errors import InputError
from fusion.geometry import Floats
from fusion.rig import RigCamera

Timing = Literal["synchronised", "offset", "static"]
_ALONE = 60  # views from which a lens alone is started: the joint solve has them all


def loop_closure(T_a_b: Floats, T_b_c: Floats, T_c_a: Floats) -> tuple[float, float]:
    """How far three pairs, each solved alone, miss closing the loop: radians, metres."""
    T = T_a_b @ T_b_c @ T_c_a
    return float(Rotation.from_matrix(T[:3, :3]).magnitude()), float(np.linalg.norm(T[:3, 3]))


def calibrate_rig(
    board: Board,
    views: Sequence[View],
    *,
    models: Mapping[str, str] | None = None,
    known: Mapping[str, RigCamera] | None = None,
    refine_known: bool = False,
    reference: str = "rgb",
    timing: Timing = "synchronised",
    moment_ns: Mapping[str, int] | None = None,
    progress: Progress | None = None,
) -> Solution:
    """Lenses, poses of all sensors in the reference camera's frame, and with timing "offset" the clocks.

    `models` by camera (pinhole where it is not said); `known` cameras are held, or refined. "offset"
    estimates one offset to the reference's clock for each other camera from how the board moves; it needs
    `moment_ns`, the stamps of the moments (`Pairing.moment_ns`). The other timings take the board to stand
    still in each moment. A LiDAR comes after it: `calib.lidar.lidar_start`, then `solve`. Raises `InputError`
    where cameras are not connected, contradict each other, are mirrored or swapped; `UsageError` for what
    cannot be meant.
    """
    models, known = models or {}, known or {}
    by_camera = _by_camera(board, views, models, known, reference)
    cameras, dropped, notes = _lenses(board, by_camera, models, known, progress)
    if timing == "offset":
        timed = with_offsets(board, cameras, views, moment_ns or {}, reference)
        views, twist, offset_s = timed.views, timed.twist, timed.offset_s
        notes += timed.notes
    else:
        views, twist, offset_s = [replace(view, lag_s=0.0) for view in views], {}, {}
    joined = join_views(board, cameras, views, reference, moment_ns or {})
    boards, poses = joined.T_ref_board, dict(joined.T_ref_sensor)
    notes += joined.notes
    start = Estimate(reference, cameras, poses, boards, twist, offset_s)
    fixed = () if refine_known else tuple(name for name in known if name in cameras)
    solution = solve(board, joined.views, start=start, fixed=fixed, progress=progress)
    gone = _once((*dropped, *joined.dropped, *solution.dropped_views))
    return replace(solution, dropped_views=gone, notes=(*notes, *solution.notes))


def _once(dropped: Sequence[tuple[str, str]]) -> tuple[tuple[str, str], ...]:
    first: dict[str, str] = {}
    for file, reason in dropped:
        first.setdefault(file, reason)
    return tuple(first.items())


# --- each camera alone


def _by_camera(
    board: Board,
    views: Sequence[View],
    models: Mapping[str, str],
    known: Mapping[str, RigCamera],
    reference: str,
) -> dict[str, list[View]]:
    if not views:
        raise InputError("no board in any image of any camera", hint="check the board's columns and rows")
    by_camera: dict[str, list[View]] = {reference: []}
    for view in views:
        by_camera.setdefault(view.camera, []).append(view)
    for name in dict.fromkeys((reference, *models)):
        if not by_camera.get(name):
            found = ", ".join(f"{len(v)} of {c}" for c, v in by_camera.items() if v)
            raise InputError("no board in any image", where=name, hint=f"boards were found in: {found}")
    for name, seen in by_camera.items():
        check_mirrored(board, seen)
        if name in known:
            _check_size(name, seen, by_camera, known)
    return by_camera


def _check_size(
    name: str, seen: Sequence[View], by_camera: Mapping[str, Sequence[View]], known: Mapping[str, RigCamera]
) -> None:
    """Raises `InputError` where images do not have the size that the known camera has."""
    size, expected = seen[0].size_wh, known[name].size_wh
    if size == expected:
        return
    swapped = [o for o, v in by_camera.items() if o != name and o in known and v and v[0].size_wh == expected]
    hint = (
        f"the images of {name} and {swapped[0]} look swapped"
        if swapped
        else "the rig is another camera's, or scaled"
    )
    what = f"images of {size[0]}x{size[1]}, but the rig's camera has {expected[0]}x{expected[1]}"
    raise InputError(what, where=name, hint=hint)


def _lenses(
    board: Board,
    by_camera: Mapping[str, Sequence[View]],
    models: Mapping[str, str],
    known: Mapping[str, RigCamera],
    progress: Progress | None,
) -> tuple[dict[str, RigCamera], list[tuple[str, str]], list[str]]:
    cameras: dict[str, RigCamera] = {}
    dropped: list[tuple[str, str]] = []
    notes: list[str] = []
    for name, views in by_camera.items():
        if name in known:
            cameras[name] = known[name]
            continue
        few = spread_views(views, _ALONE)
        if len(few) < len(views):
            notes.append(f"{name}: its lens starts from {len(few)} of {len(views)} views")
        alone = calibrate_camera(board, few, models.get(name, "pinhole"), progress=progress)
        cameras[name] = alone.estimate.cameras[name]
        dropped += alone.dropped_views  # its notes are superseded by those of the joint solve
    return cameras, dropped, notes
