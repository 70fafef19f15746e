"""Held-out error: views that took no part in the solution, predicted by it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from calib.boards import Board
from calib.evidence.linear import seen_px
from calib.observations import View
from calib.solve import solve
from calib.solve.estimate import Estimate, Solution
from calib.solve.motion import moved
from fusion.errors import FusionError
from fusion.geometry import Floats


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Root mean squared distances in px over views left out in turn.

    `own_px` by camera: the board's pose fitted to that camera's view itself. `across_px` by (seen in,
    predicted from): the pose fitted in one camera, the points predicted in another. `views` is how many
    were judged. `folds` how many times it was solved anew; `failed` of these could not be solved without
    the views left out.
    """

    own_px: dict[str, float]
    across_px: dict[tuple[str, str], float]
    views: int
    folds: int
    failed: int = 0


def held_out(
    board: Board,
    solution: Solution,
    *,
    fixed: tuple[str, ...] = (),
    folds: int = 5,
    progress: Callable[[int, int], None] | None = None,
) -> HeldOut:
    """Solve `folds` times without a part of the moments, and predict that part.

    `fixed` as it was given to `solve`. Outliers of the solution are left out of the judgement. Fewer
    moments than folds: one is left out at a time.
    """
    moments = sorted(solution.estimate.T_ref_board)
    folds = min(folds, len(moments))
    own: dict[str, list[Floats]] = {}
    across: dict[tuple[str, str], list[Floats]] = {}
    judged = failed = 0
    for fold in range(folds):
        left_out = set(moments[fold::folds])
        try:
            without = _solve_without(board, solution, left_out, fixed)
        except FusionError:
            failed += 1
            continue
        for moment in sorted(left_out):
            judged += _judge(board, solution, without.estimate, moment, own, across)
        if progress is not None:
            progress(fold + 1, folds)
    return HeldOut(
        {camera: _rms(errors) for camera, errors in own.items()},
        {pair: _rms(errors) for pair, errors in across.items()},
        judged,
        folds,
        failed,
    )


def _solve_without(board: Board, solution: Solution, left_out: set[str], fixed: tuple[str, ...]) -> Solution:
    kept = [
        (replace(v, ids=v.ids[used], uv=v.uv[used]))
        for v, used in zip(solution.views, solution.used, strict=True)
        if v.moment not in left_out
    ]
    clouds = [cloud for cloud in solution.clouds if cloud.moment not in left_out]
    poses = {m: T for m, T in solution.estimate.T_ref_board.items() if m not in left_out}
    start = replace(solution.estimate, T_ref_board=poses)
    return solve(board, kept, clouds, start=start, fixed=fixed)


def _judge(
    board: Board,
    solution: Solution,
    estimate: Estimate,
    moment: str,
    own: dict[str, list[Floats]],
    across: dict[tuple[str, str], list[Floats]],
) -> int:
    views = [
        replace(v, ids=v.ids[used], uv=v.uv[used])
        for v, used in zip(solution.views, solution.used, strict=True)
        if v.moment == moment and used.sum() >= 4
    ]
    T_ref_board = {**estimate.T_ref_board, moment: solution.estimate.T_ref_board[moment]}
    estimate = replace(estimate, T_ref_board=T_ref_board)
    for view in views:
        fitted = _posed(board, view, estimate)
        for other in views:
            errors = seen_px(board, other, fitted) - other.uv
            if other is view:
                own.setdefault(view.camera, []).append(errors)
            else:
                across.setdefault((other.camera, view.camera), []).append(errors)
    return len(views)


def _posed(board: Board, view: View, estimate: Estimate) -> Estimate:
    """The estimate with the pose of a view's moment fitted to that view alone."""
    start = estimate.T_ref_board[view.moment]

    def at(change: Floats) -> Estimate:
        return replace(estimate, T_ref_board={**estimate.T_ref_board, view.moment: moved(start, change)})

    fit = least_squares(lambda change: (seen_px(board, view, at(change)) - view.uv).ravel(), np.zeros(6))
    return at(fit.x)


def _rms(errors: list[Floats]) -> float:
    return float(np.sqrt(np.mean((np.concatenate(errors) ** 2).sum(1))))
