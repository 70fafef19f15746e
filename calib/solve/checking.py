"""What the solver refuses before it starts, and which views cannot take part."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from calib.boards import Board
from calib.observations import CloudView, View
from calib.solve.blocks import blocks_of, by_part
from calib.solve.estimate import Estimate
from calib.solve.robust import known
from calib.solve.state import Layout
from fusion.errors import InputError

Dropped = list[tuple[str, str]]
_MIN_POINTS = 4


def label(item: View | CloudView) -> str:
    """What a view is called in reports: its file, else its sensor and moment."""
    sensor = item.camera if isinstance(item, View) else item.sensor
    return item.file or f"{sensor} {item.moment}"


def check_input(board: Board, views: Sequence[View], clouds: Sequence[CloudView], start: Estimate) -> None:
    """`ValueError` for what a program got wrong, `InputError` for data that are not finite."""
    sensors = {*(v.camera for v in views), *(c.sensor for c in clouds)}
    if missing := sensors - set(start.T_ref_sensor):
        raise ValueError(f"expected T_ref_sensor of every sensor, got none of {sorted(missing)}")
    if missing := {v.camera for v in views} - set(start.cameras):
        raise ValueError(f"expected a camera of every view, got none of {sorted(missing)}")
    if start.reference not in start.T_ref_sensor or not np.array_equal(
        start.T_ref_sensor[start.reference], np.eye(4)
    ):
        raise ValueError(f"expected the identity for the reference {start.reference!r}")
    for view in views:
        if len(view.ids) and not 0 <= view.ids.min() <= view.ids.max() < len(board.points_m):
            raise ValueError(f"expected ids of {len(board.points_m)} points in {label(view)}")
        _check_finite(view, view.uv, np.array([view.lag_s]))
        size_wh = tuple(start.cameras[view.camera].size_wh)
        if tuple(view.size_wh) != size_wh:
            other = f"{view.camera} has {size_wh[0]}x{size_wh[1]}"
            what = f"an image of {view.size_wh[0]}x{view.size_wh[1]} where {other}"
            raise InputError(what, where=label(view), hint="calibrate sizes apart: crops and scales differ")
    for cloud in clouds:
        _check_finite(cloud, cloud.plane_m, cloud.edge_m)
    if any(len(c.edge_m) for c in clouds) and board.plate_m is None:
        raise ValueError("expected plate_m of a board whose edges a LiDAR saw")


def check_fixed(fixed: Collection[str], start: Estimate) -> None:
    """`ValueError` for a name that is no parameter, sensor or transformation."""
    everything = Layout(start, list(start.T_ref_sensor), (), ())
    names = {*everything.names, *(name.rpartition(".")[0] for name in everything.names), *start.T_ref_sensor}
    if unknown := set(fixed) - names:
        raise ValueError(f"expected names among {sorted(names)}, got {sorted(unknown)}")


def check_linked(
    views: Sequence[View], clouds: Sequence[CloudView], start: Estimate, fixed: Collection[str]
) -> None:
    """`InputError` where a sensor whose pose is free is not linked to the reference by shared moments."""
    seen = {*((v.camera, v.moment) for v in views), *((c.sensor, c.moment) for c in clouds)}
    sensors = {sensor for sensor, _ in seen}
    layout = Layout(start, sorted(sensors), (), fixed)
    free = {name.rpartition(".")[0] for name in layout.free_names}
    linked = {s for s in start.T_ref_sensor if layout.transform(s) not in free}
    while more := {s for s, m in seen if s not in linked and any((o, m) in seen for o in linked)}:
        linked |= more
    if apart := sorted(sensors - linked):
        others = " or ".join(sorted(linked & sensors)) or start.reference
        what = f"no moment at which {' or '.join(apart)} sees the board as well as {others}"
        held = ", ".join(layout.transform(s) for s in apart)
        raise InputError(what, hint=f"record moments that two sensors share, or hold {held}")


def usable(
    board: Board, views: Sequence[View], clouds: Sequence[CloudView], start: Estimate
) -> tuple[list[View], list[CloudView], Dropped]:
    """The views that can take part, and the others with the reason."""
    kept, dropped = _split(views, [_unusable(board, view, start) for view in views])
    kept, behind = _split(kept, _behind(board, kept, start))
    dropped += behind
    scans, lost = usable_clouds(clouds, kept)
    return kept, scans, dropped + lost


def usable_clouds(clouds: Sequence[CloudView], views: Sequence[View]) -> tuple[list[CloudView], Dropped]:
    """The clouds of moments that a camera saw: a board's pose cannot come from a plane alone."""
    moments = {v.moment for v in views}
    lost = [
        (label(c), "no camera's view of that moment takes part") for c in clouds if c.moment not in moments
    ]
    return [c for c in clouds if c.moment in moments], lost


def _split(views: Sequence[View], reasons: Sequence[str]) -> tuple[list[View], Dropped]:
    pairs = list(zip(views, reasons, strict=True))
    return [v for v, why in pairs if not why], [(label(v), why) for v, why in pairs if why]


def _unusable(board: Board, view: View, start: Estimate) -> str:
    if len(view.ids) < _MIN_POINTS:
        return f"{len(view.ids)} points, of at least {_MIN_POINTS}"
    spread = np.linalg.svd(board.points_m[view.ids] - board.points_m[view.ids].mean(0), compute_uv=False)
    if spread[1] < 1e-6 * spread[0]:
        return "all its points lie on one line"
    if view.moment not in start.T_ref_board:
        return "no pose of its board to start from"
    return ""


def _behind(board: Board, views: Sequence[View], start: Estimate) -> list[str]:
    """What is wrong with each view's start: points that the camera could not see."""
    moments = [*dict.fromkeys(v.moment for v in views)]
    layout = Layout(start, [*dict.fromkeys(v.camera for v in views)], moments, ())
    reasons = dict.fromkeys(map(id, views), "")
    for block in blocks_of(board, views, (), layout) if views else ():
        lost = ~known(block.linearise(layout.first_state()).r)
        seen = [v for v in views if v.camera == block.sensor]
        for view, part in zip(seen, by_part(block, lost), strict=True):
            reasons[id(view)] = f"{int(part.sum())} points start behind the camera" if part.any() else ""
    return [reasons[id(view)] for view in views]


def _check_finite(item: View | CloudView, *arrays: np.ndarray) -> None:
    if not all(np.isfinite(a).all() for a in arrays):
        raise InputError("a number that is not finite", where=label(item), hint="leave such points out")
