"""One camera from views of a board: checked, started, solved."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.boards import Board
from calib.initial import FEWEST_POINTS, initial_camera, poses_of, seen_from_behind
from calib.observations import View
from calib.solve import Estimate, Solution, solve
from calib.solve.cameras import parameter_names
from calib.solve.descent import Progress
from fusion.errors import InputError
from fusion.geometry import Floats
from fusion.rig import RigCamera

FEWEST_VIEWS = 3
_LEAST_TILT = np.radians(6)  # between the most different two boards
_FEW_PIXELS = 1.5  # rms above which the lens is likely another one
_RECORD = "record 15 or more views with the board tilted by 20 to 45 degrees to the left, right, up and down"


def calibrate_camera(
    board: Board, views: Sequence[View], model: str = "pinhole", *, progress: Progress | None = None
) -> Solution:
    """The lens of one camera: `model` is a row of `calib.initial.MODELS`, with its coefficients.

    The camera is its own reference; moments are the views'. Raises `InputError` where no board was found,
    in one or two views only, in images of different sizes, where all views are alike, or where the
    solution leaves the focal length open; `UsageError` for an unknown model. Views that were left out are
    named in the solution.
    """
    name = check_views(board, views)
    start = initial_camera(board, views, model)
    try:
        solution = _solved(board, views, start, progress)
        if solution.dropped_views:  # a better lens may explain what the start could not
            solution = _solved(board, views, solution.estimate.cameras[name], progress)
    except InputError as error:
        try:
            solution = _solved(board, views, _better_start(board, views, start), progress)
        except InputError:
            raise error from None
    return replace(solution, notes=(*solution.notes, *_likely_causes(name, solution, model)))


def _better_start(board: Board, views: Sequence[View], camera: RigCamera) -> RigCamera:
    """The lens after a solve that leaves all but the focal lengths and k1 alone: a wider valley."""
    name = views[0].camera
    start, kept, _ = camera_start(board, views, camera)
    held = {f"{name}.{p}" for p in parameter_names(camera)} - {f"{name}.{p}" for p in ("fx", "fy", "k1")}
    return solve(board, kept, start=start, fixed=held, drop_views=False).estimate.cameras[name]


def _solved(board: Board, views: Sequence[View], camera: RigCamera, progress: Progress | None) -> Solution:
    name = views[0].camera
    start, kept, dropped = camera_start(board, views, camera)
    if len(kept) < FEWEST_VIEWS:
        why = "; ".join(f"{file}: {reason}" for file, reason in dropped[:3])
        raise InputError(
            f"only {len(kept)} of {len(views)} views can be used ({why})", where=name, hint=_RECORD
        )
    _check_tilts(name, [start.T_ref_board[view.moment] for view in kept])
    solution = solve(board, kept, start=start, progress=progress)
    return replace(solution, dropped_views=(*dropped, *solution.dropped_views))


def check_views(board: Board, views: Sequence[View]) -> str:
    """The name of the views' camera. Raises `InputError` where they cannot be used."""
    if not views:
        hint = "check the board's columns and rows (inner corners), that it is whole and in focus"
        raise InputError("no board in any image", hint=hint)
    names = sorted({view.camera for view in views})
    if len(names) > 1:
        raise ValueError(f"expected views of one camera, got {', '.join(names)}")
    sizes = Counter(view.size_wh for view in views)
    if len(sizes) > 1:
        said = ", ".join(f"{n} of {w}x{h}" for (w, h), n in sizes.most_common())
        raise InputError(f"images of different sizes: {said}", where=names[0], hint="take out the odd ones")
    if len(views) < FEWEST_VIEWS:
        count = "one view" if len(views) == 1 else f"{len(views)} views"
        what = f"{count} only: a camera's lens needs at least {FEWEST_VIEWS}"
        raise InputError(what, where=names[0], hint=_RECORD)
    check_mirrored(board, views)
    return names[0]


def check_mirrored(board: Board, views: Sequence[View]) -> None:
    """Raises `InputError` where most views show the board from behind, as no camera can."""
    behind = sum(seen_from_behind(board, view) for view in views)
    if behind > 0.5 * len(views):
        what = f"the board is seen from behind in {behind} of {len(views)} images: they are mirrored"
        raise InputError(what, where=views[0].camera, hint="flip them left-right and detect again")


def camera_start(
    board: Board, views: Sequence[View], camera: RigCamera
) -> tuple[Estimate, list[View], list[tuple[str, str]]]:
    """A start for one camera alone, the views with a pose, and (file or moment, reason) of the others."""
    poses, _ = poses_of(board, camera, views)
    poses = {k: T for k, T in poses.items() if not seen_from_behind(board, views[k])}
    kept = [view for k, view in enumerate(views) if k in poses]
    boards = {view.moment: poses[k] for k, view in enumerate(views) if k in poses}
    if len(boards) < len(kept):
        raise ValueError("expected one view of a camera in each moment")
    name = views[0].camera
    dropped = [(v.file or v.moment, _reason(board, v)) for k, v in enumerate(views) if k not in poses]
    return Estimate(name, {name: camera}, {name: np.eye(4)}, boards), kept, dropped


def _reason(board: Board, view: View) -> str:
    if len(view.ids) < FEWEST_POINTS:
        return f"{len(view.ids)} points, {FEWEST_POINTS} are needed"
    behind = seen_from_behind(board, view)
    return "the board is seen from behind: mirrored" if behind else "no pose of the board explains it"


def tilt_spread(T_camera_board: Sequence[Floats]) -> float:
    """The angle in radians between the two most different planes."""
    normals = np.array([T[:3, 2] for T in T_camera_board])
    cosine = np.clip(np.abs(normals @ normals.T), 0, 1)
    return float(np.arccos(cosine.min()))


def _check_tilts(name: str, poses: Sequence[Floats]) -> None:
    spread = tilt_spread(poses)
    if spread < _LEAST_TILT:
        what = f"all {len(poses)} views are alike: their tilts differ by {np.degrees(spread):.1f} degrees"
        raise InputError(f"{what} at most, which leaves the focal length open", where=name, hint=_RECORD)


def _likely_causes(name: str, solution: Solution, model: str) -> list[str]:
    rms = solution.rms_px(name)
    if not rms > _FEW_PIXELS:
        return []
    other = (
        "rational or fisheye"
        if model in ("pinhole", "radtan")
        else "fisheye"
        if model == "rational"
        else "rational"
    )
    return [f"{name}: the {model} model leaves {rms:.1f} px: try {other}, or check that the board is flat"]
