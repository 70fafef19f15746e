"""All evidence of a solution, and what it comes to in words."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from calib.boards import Board
from calib.evidence.coverage import Coverage, NextView, coverage, next_view
from calib.evidence.heldout import HeldOut, held_out
from calib.evidence.linear import moments_of
from calib.evidence.uncertainty import UncertaintyMap, projection_uncertainty, transfer_uncertainty
from calib.solve.estimate import Solution

Grade = Literal["good", "usable", "not usable"]
GRADES: tuple[Grade, ...] = ("good", "usable", "not usable")
DISTANCES_M = (1.0, 2.0, 5.0, 10.0, 50.0)
GOOD_PX, USABLE_PX = 1.0, 3.0  # how far a pixel may land off: unseen by an eye; seen, but still on its object
_NOISY_PX = 1.0
_OVERFITTED = 1.5


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a calibration is good for, what it is not, and what to record next: short lines for the user."""

    grade: Grade
    good_for: tuple[str, ...]
    not_for: tuple[str, ...]
    record_next: tuple[str, ...]

    def lines(self) -> list[str]:
        return [
            f"verdict: {self.grade}",
            *(f"good for {line}" for line in self.good_for),
            *(f"not for {line}" for line in self.not_for),
            *(f"next: {line}" for line in self.record_next),
        ]


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """All that was found out about a solution.

    `projection` by camera is at the boards' median distance; `transfer` by (dst, src) and distance.
    `closure` is rotation (rad) and translation (m) around the loop of three sensors, each pair calibrated
    alone; None without three.
    """

    coverage: Mapping[str, Coverage]
    projection: Mapping[str, UncertaintyMap]
    transfer: Mapping[tuple[str, str], Mapping[float, UncertaintyMap]]
    held_out: HeldOut
    next_views: Mapping[str, NextView]
    verdict: Verdict
    closure: tuple[float, float] | None = None
    notes: tuple[str, ...] = field(default=())


def gather(
    board: Board,
    solution: Solution,
    *,
    fixed: tuple[str, ...] = (),
    closure: tuple[float, float] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Evidence:
    """Everything at once; `fixed` and `closure` as they were given and found. Seconds for 30 views of two
    cameras."""
    cameras = [name for name in solution.estimate.cameras if any(v.camera == name for v in solution.views)]
    covered = {name: coverage(board, solution, name) for name in cameras}
    moments = moments_of(board, solution)
    projection = {
        name: projection_uncertainty(
            board, solution, name, float(np.median(covered[name].distance_m)), moments
        )
        for name in cameras
    }
    reference = solution.estimate.reference
    transfer = {
        (reference, sensor): {d: transfer_uncertainty(solution, reference, sensor, d) for d in DISTANCES_M}
        for sensor in solution.estimate.T_ref_sensor
        if sensor != reference
    }
    judged = held_out(board, solution, fixed=fixed, progress=progress)
    found = {name: view for name in cameras if (view := next_view(board, solution, name)) is not None}
    verdict = judge(solution, covered, transfer, judged, found, projection)
    return Evidence(covered, projection, transfer, judged, found, verdict, closure)


def judge(
    solution: Solution,
    covered: Mapping[str, Coverage],
    transfer: Mapping[tuple[str, str], Mapping[float, UncertaintyMap]],
    judged: HeldOut,
    next_views: Mapping[str, NextView],
    projection: Mapping[str, UncertaintyMap] | None = None,
) -> Verdict:
    """The verdict: by what may land how far off, and by what the residuals say of the model."""
    good: list[str] = []
    bad: list[str] = []
    record: list[str] = []
    grades: list[Grade] = []
    for camera in covered:
        grades.append(_camera_grade(solution, camera, judged, good, bad))
        record += [f"{camera}: {fault}" for fault in covered[camera].faults()]
        if camera in next_views and next_views[camera].then_px < 0.9 * next_views[camera].now_px:
            view = next_views[camera]
            record.append(f"{camera}: {view.words} ({view.now_px:.2f} px would become {view.then_px:.2f})")
    for camera, found in (projection or {}).items():
        if found.worst_px > USABLE_PX:
            bad.append(
                f"the rim of {camera}'s image, where no point was seen: up to {found.worst_px:.1f} px off"
            )
    grades.extend(_pair_grade(dst, src, maps, good, bad) for (dst, src), maps in transfer.items())
    worst = max((GRADES.index(grade) for grade in grades), default=len(GRADES) - 1)
    return Verdict(GRADES[worst], tuple(good), tuple(bad), tuple(record))


def _camera_grade(solution: Solution, camera: str, judged: HeldOut, good: list[str], bad: list[str]) -> Grade:
    inside, outside = solution.rms_px(camera), judged.own_px.get(camera, float("nan"))
    if outside > _OVERFITTED * inside and outside > 0.2:
        bad.append(
            f"places where {camera} saw no board: held-out error {outside:.2f} px against {inside:.2f} px"
            " fitted (too few views, or too rich a model)"
        )
        return "usable"
    if inside > _NOISY_PX:
        bad.append(
            f"measuring with {camera}: rms {inside:.2f} px"
            " (another model? a board that is not flat? blurred views?)"
        )
        return "not usable" if inside > USABLE_PX else "usable"
    good.append(f"undistorting {camera}: rms {inside:.2f} px, held out {outside:.2f} px")
    return "good"


def _pair_grade(
    dst: str, src: str, maps: Mapping[float, UncertaintyMap], good: list[str], bad: list[str]
) -> Grade:
    """By the typical uncertainty from the nearest distance on; an image's worst place is said beside it."""
    sigma = {distance: 2 * found.median_px for distance, found in maps.items()}  # two sigma: 95 %, nearly
    fine = [distance for distance, px in sigma.items() if px <= GOOD_PX]
    what = f"laying {src} on {dst}"
    if fine:
        worst = max(2 * maps[d].worst_px for d in fine)
        good.append(
            f"{what} from {min(fine):g} m on: within {max(sigma[d] for d in fine):.2f} px"
            f" at most places, {worst:.1f} px at the worst"
        )
    rest = [distance for distance, px in sigma.items() if px > GOOD_PX]
    if rest:
        spoken = ", ".join(f"{sigma[d]:.1f} px at {d:g} m" for d in rest)
        bad.append(f"{what} closely at {spoken}")
    if fine:
        return "good"
    return "usable" if min(sigma.values(), default=np.inf) <= USABLE_PX else "not usable"
