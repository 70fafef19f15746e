"""What `fusion calibrate lidar` does: by a board, by given points, or by the scene itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.lidar.scale import board_scale, spacing_note
from calib.lidar.start import lidar_start
from calib.moments import Pairing, Shot, pair
from calib.observations import Detection, View
from calib.rigging import calibrate_rig, loop_closure
from calib.solve import Solution, solve
from fusion.cli.calibrating import Asked, Desk, Together, finish, hold, say_held
from fusion.cli.running import progress_bar, warn
from fusion.clouds import CloudFiles, clouds_in, read_cloud
from fusion.errors import FrameError, FusionError, InputError, UsageError
from fusion.geometry import Floats, invert
from fusion.pairing import stamp_in_name

LIDAR = "lidar"


@dataclass(frozen=True, slots=True)
class Clouds:
    """The clouds that were read, by moment: points, rings where the file has them, and the file."""

    xyz_m: Mapping[str, NDArray[Any]]
    rings: Mapping[str, NDArray[Any]]
    files: Mapping[str, str]


def run_lidar(
    asked: Asked,
    camera: str,
    images: str,
    clouds: str,
    fir: str | None,
    points: Path | None,
    together: Together,
    refine: bool | None,
) -> None:
    if points is not None and asked.board is not None:
        raise UsageError("either points or a board", where="--points", hint="leave one out")
    if asked.board is None:
        if fir is not None:
            raise UsageError("thermal images serve only with a board", where="--fir", hint="give --board")
        from fusion.cli import calibrating_scene as scene

        if points is not None:
            scene.run_points(asked, camera, points)
        else:
            scene.run_scene(asked, camera, images, clouds, together)
        return
    specs = {camera: images, **({"fir": fir} if fir is not None else {})}
    _by_board(asked, specs, clouds_in(clouds), together, refine)


def _by_board(
    asked: Asked, specs: Mapping[str, str], files: CloudFiles, together: Together, refine: bool | None
) -> None:
    rig = asked.known()
    known, options = {name: rig.camera(name) for name in specs}, together.options()
    with Desk(asked) as desk:
        for camera, spec in specs.items():
            desk.look(camera, spec)
        streams = {**desk.shots, LIDAR: _cloud_shots(files)}
        pairing = pair(streams, **options, offset_s=rig.time_offset_s)
        if not asked.quiet:
            print(pairing.table())
        warn(pairing.notes)
        views = [view for view in pairing.views if view.camera != LIDAR]
        clouds = _read(pairing)
        held = tuple(known) if hold(rig, views, list(specs), refine) else ()
        say_held(asked, known, bool(held))
        with progress_bar("solving", asked.quiet) as progress:
            alone = calibrate_rig(
                desk.board,
                views,
                known=known,
                refine_known=not held,
                reference=next(iter(specs)),
                progress=progress,
            )
            solution = _with_lidar(desk, alone, clouds, _rough(rig, alone), held)
        closure = _closure(desk, solution, clouds) if len(specs) > 1 else None
        finish(desk, solution, fixed=held, closure=closure, inputs=list(clouds.files.values()))


def _cloud_shots(files: CloudFiles) -> list[Shot]:
    """Clouds as images are told apart: whether the board is in them is not known yet."""
    nothing = Detection(np.zeros(0, np.intp), np.zeros((0, 2)), "")
    return [
        Shot(stem, str(path), stamp_in_name(stem), (1, 1), nothing)
        for stem, path in zip(files.stems, files, strict=True)
    ]


def _read(pairing: Pairing) -> Clouds:
    """The clouds of moments in which a camera saw the board. Raises `InputError` where there is none."""
    seen = {view.moment for view in pairing.views if view.camera != LIDAR}
    xyz, rings, files, broken = {}, {}, {}, []
    for view in pairing.views:
        if view.camera == LIDAR and view.moment in seen:
            try:
                cloud = read_cloud(view.file)
            except FrameError as error:
                broken.append(str(error))
                continue
            if not np.isfinite(cloud.xyz_m).all(1).any():
                broken.append(f"{view.file}: no point of it is a number")
                continue
            xyz[view.moment], files[view.moment] = cloud.xyz_m, view.file
            if "ring" in cloud.fields:
                rings[view.moment] = cloud.fields["ring"]
    if broken and not xyz:
        raise InputError(f"none of {len(broken)} clouds can be used; the first: {broken[0]}")
    warn(broken)
    if not xyz:
        hint = f"{pairing.table()}; --tolerance-ms or --pair order may help"
        raise InputError("no cloud belongs to an image that shows the board", hint=hint)
    return Clouds(xyz, rings, files)


def _rough(rig: Any, solution: Solution) -> Floats | None:
    """Where the rig says that the LiDAR is, None where it says nothing."""
    try:
        return rig.pose(solution.estimate.reference, LIDAR)
    except UsageError:
        return None


def _with_lidar(
    desk: Desk, solution: Solution, clouds: Clouds, rough: Floats | None, fixed: Sequence[str]
) -> Solution:
    """The joint solution of everything, the LiDAR included."""
    estimate = solution.estimate
    usable = {m: xyz for m, xyz in clouds.xyz_m.items() if m in estimate.T_ref_board}
    start = lidar_start(
        desk.board,
        {m: estimate.T_ref_board[m] for m in usable},
        usable,
        rough,
        clouds.rings,
        files=clouds.files,
    )
    poses = {**estimate.T_ref_sensor, LIDAR: start.T_ref_lidar}
    joint = solve(
        desk.board, solution.views, start.views, start=replace(estimate, T_ref_sensor=poses), fixed=fixed
    )
    spacing = spacing_note(*board_scale(estimate.T_ref_board, start.T_ref_lidar, start.views))
    notes = (*start.notes, *([spacing] if spacing else []), *joint.notes)
    lost = [(Path(clouds.files[moment]).name, why) for moment, why in start.dropped]
    apart = "the board's pose in the cameras is not known"
    lost += [(Path(clouds.files[moment]).name, apart) for moment in clouds.xyz_m.keys() - usable.keys()]
    return replace(joint, notes=notes, dropped_views=(*solution.dropped_views, *lost, *joint.dropped_views))


def _closure(desk: Desk, solution: Solution, clouds: Clouds) -> tuple[float, float] | None:
    """Every pair of three sensors alone, around the loop; None where a pair has too little by itself."""
    held = tuple(solution.estimate.cameras)
    first, second = list(held)[:2]
    try:
        between = _alone(desk, solution, (first, second), None, clouds, held)
        forth = _alone(desk, solution, (second,), LIDAR, clouds, held)
        back = _alone(desk, solution, (first,), LIDAR, clouds, held)
    except FusionError as error:
        warn([f"no loop closure: {error}"])
        return None
    return loop_closure(between, forth, invert(back))


def _alone(
    desk: Desk,
    solution: Solution,
    cameras: Sequence[str],
    lidar: str | None,
    clouds: Clouds,
    held: Sequence[str],
) -> Floats:
    """T of the first camera from the other sensor, from what these two saw."""
    views = [
        replace(v, ids=v.ids[used], uv=v.uv[used])
        for v, used in zip(solution.views, solution.used, strict=True)
        if v.camera in cameras
    ]
    known = {name: solution.estimate.cameras[name] for name in cameras}
    pairs = calibrate_rig(desk.board, _shared(views, cameras), known=known, reference=cameras[0])
    if lidar is None:
        return pairs.estimate.T_ref_sensor[cameras[1]]
    found = _with_lidar(desk, pairs, clouds, None, [name for name in held if name in cameras])
    return found.estimate.T_ref_sensor[LIDAR]


def _shared(views: Sequence[View], cameras: Sequence[str]) -> list[View]:
    seen = {name: {v.moment for v in views if v.camera == name} for name in cameras}
    shared = set.intersection(*seen.values())
    return [view for view in views if view.moment in shared]
