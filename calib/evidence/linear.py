"""A solution's neighbourhood: what a small change of its parameters does to what the sensors see.

Derivatives are central differences through the cameras' own `project`: evidence does not lean on the
solver's analytic ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from calib.boards import Board
from calib.lidar.start import edge_distances
from calib.observations import CloudView, View
from calib.solve.cameras import parameter_names, parameters, with_parameters
from calib.solve.estimate import Estimate, Solution
from calib.solve.motion import exp_motion, moved
from fusion.geometry import Floats, invert, transform
from fusion.rig import RigCamera

_INTRINSICS = ("fx", "fy", "cx", "cy")
_STEP_PX, _STEP_COEFFICIENT, _STEP_POSE = 1e-2, 1e-6, 1e-6


def shifted(estimate: Estimate, name: str, by: float) -> Estimate:
    """The estimate with one parameter of `Solution.names` changed. `ValueError` for a name that is none."""
    what, _, part = name.rpartition(".")
    if what in estimate.cameras and part in parameter_names(estimate.cameras[what]):
        cameras = {**estimate.cameras, what: _camera_shifted(estimate.cameras[what], part, by)}
        return replace(estimate, cameras=cameras)
    if part == "time_offset_s":
        offsets = {**estimate.time_offset_s, what: estimate.time_offset_s.get(what, 0.0) + by}
        return replace(estimate, time_offset_s=offsets)
    sensor, axes = what.rpartition("_")[2], ("rx", "ry", "rz", "tx", "ty", "tz")
    if sensor not in estimate.T_ref_sensor or part not in axes:
        raise ValueError(f"expected a parameter of the solution, got {name!r}")
    change = by * np.eye(6)[axes.index(part)]
    poses = {**estimate.T_ref_sensor, sensor: moved(estimate.T_ref_sensor[sensor], change)}
    return replace(estimate, T_ref_sensor=poses)


def _camera_shifted(camera: RigCamera, part: str, by: float) -> RigCamera:
    at = parameter_names(camera).index(part)
    return with_parameters(camera, parameters(camera) + by * np.eye(len(parameter_names(camera)))[at])


def derivative(solution: Solution, of: Callable[[Estimate], Floats]) -> Floats:
    """The derivative of `of` (any shape, flattened to M) by the solution's parameters, M x P."""
    columns = []
    for name in solution.names:
        step = _step(name)
        ahead, behind = (of(shifted(solution.estimate, name, s)) for s in (step, -step))
        columns.append((ahead - behind).ravel() / (2 * step))
    return np.stack(columns, 1) if columns else np.zeros((of(solution.estimate).size, 0))


def _step(name: str) -> float:
    part = name.rpartition(".")[2]
    if part in _INTRINSICS:
        return _STEP_PX
    return _STEP_COEFFICIENT if part[0] in "kp" else _STEP_POSE


def board_pose(estimate: Estimate, moment: str, sensor: str, lag_s: float = 0.0) -> Floats:
    """T_sensor_board at a moment, or `lag_s` of the sensor's clock after it."""
    T = estimate.T_ref_board[moment]
    if moment in estimate.twist:
        twist = (lag_s + estimate.time_offset_s.get(sensor, 0.0)) * np.asarray(estimate.twist[moment])
        T = T @ exp_motion(twist)
    return invert(estimate.T_ref_sensor[sensor]) @ T


def seen_px(board: Board, view: View, estimate: Estimate) -> Floats:
    """Where a view's points should be, N x 2 px."""
    T = board_pose(estimate, view.moment, view.camera, view.lag_s)
    return estimate.cameras[view.camera].project(transform(T, board.points_m[view.ids]))[0]


def off_board_m(board: Board, cloud: CloudView, estimate: Estimate) -> tuple[Floats, Floats]:
    """The distances of a cloud's points from the board's plane, and of its rim's from the plate's sides."""
    T_board_sensor = invert(board_pose(estimate, cloud.moment, cloud.sensor))
    rim = edge_distances(transform(T_board_sensor, cloud.edge_m), cloud.edge_of, board)
    return transform(T_board_sensor, cloud.plane_m)[:, 2], rim


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """The weighted derivatives of all that was seen at one moment: by the parameters, and by the board's
    pose."""

    name: str
    by_parameters: Floats
    by_pose: Floats

    def information(self) -> Floats:
        """What the moment tells of the parameters, P x P, the board's pose being unknown."""
        A, B = self.by_parameters, self.by_pose
        return A.T @ A - A.T @ B @ np.linalg.solve(B.T @ B, B.T @ A)


def moments_of(board: Board, solution: Solution) -> list[Moment]:
    """Every moment of a solution, linearised; only points that counted."""
    estimate = solution.estimate
    seen: dict[str, list[Callable[[Estimate], Floats]]] = {}
    for view, used in zip(solution.views, solution.used, strict=True):
        seen.setdefault(view.moment, []).append(_weighted_view(board, view, used, solution))
    clouds = zip(solution.clouds, solution.plane_used, solution.edge_used, strict=True)
    for cloud, plane_used, edge_used in clouds:
        counted = replace(
            cloud,
            plane_m=cloud.plane_m[plane_used],
            edge_m=cloud.edge_m[edge_used],
            edge_of=cloud.edge_of[edge_used],
        )
        seen.setdefault(cloud.moment, []).append(_weighted_cloud(board, counted, solution))
    return [_linearised(name, parts, estimate, solution) for name, parts in seen.items()]


def _linearised(
    name: str, parts: Sequence[Callable[[Estimate], Floats]], estimate: Estimate, solution: Solution
) -> Moment:
    def seen(at: Estimate) -> Floats:
        return np.concatenate([part(at).ravel() for part in parts])

    columns = []
    for change in _STEP_POSE * np.eye(6):
        ahead, behind = (seen(_board_moved(estimate, name, sign * change)) for sign in (1, -1))
        columns.append((ahead - behind) / (2 * _STEP_POSE))
    return Moment(name, derivative(solution, seen), np.stack(columns, 1))


def _board_moved(estimate: Estimate, moment: str, change: Floats) -> Estimate:
    poses = {**estimate.T_ref_board, moment: moved(estimate.T_ref_board[moment], change)}
    return replace(estimate, T_ref_board=poses)


def _weighted_view(
    board: Board, view: View, used: NDArray[np.bool_], solution: Solution
) -> Callable[[Estimate], Floats]:
    kept = replace(view, ids=view.ids[used], uv=view.uv[used])
    sigma = solution.sigma_px[view.camera]
    return lambda estimate: seen_px(board, kept, estimate) / sigma


def _weighted_cloud(board: Board, cloud: CloudView, solution: Solution) -> Callable[[Estimate], Floats]:
    sigmas = solution.sigma_m or 1.0, solution.sigma_edge_m or 1.0

    def seen(estimate: Estimate) -> Floats:
        return np.concatenate(
            [off / sigma for off, sigma in zip(off_board_m(board, cloud, estimate), sigmas, strict=True)]
        )

    return seen


def with_held(
    solution: Solution, names: Sequence[str], covariance: Floats, *, everything: bool = False
) -> Solution:
    """The solution with what was known before of the parameters that it held: `names` and `covariance` (K,
    K).

    Those that it did estimate, or that belong to no camera of it (unless `everything`), are left out; what
    is added is taken to be independent of the rest. Without it a held parameter would count as exactly known.
    """
    ours = {*solution.estimate.cameras}
    at = [
        i
        for i, name in enumerate(names)
        if name not in solution.names and (everything or name.partition(".")[0] in ours)
    ]
    if not at:
        return solution
    known = np.asarray(covariance, np.float64)[np.ix_(at, at)]
    more = (*solution.names, *(names[i] for i in at))
    return replace(solution, names=more, covariance=np.asarray(block_diag(solution.covariance, known)))
