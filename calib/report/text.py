"""A calibration in a few lines and tables of words."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from calib.evidence.uncertainty import pose_between
from calib.evidence.verdict import Evidence
from calib.solve.estimate import Solution

Rows = tuple[Sequence[str], list[list[str]]]


def closing_lines(solution: Solution, evidence: Evidence) -> list[str]:
    """What the terminal says at the end."""
    lines: list[str] = []
    for head, rows in (camera_rows(solution, evidence), pair_rows(solution, evidence), offset_rows(solution)):
        if rows:
            lines += _columns([list(head), *rows])
    lines += [f"left out: {what}: {why}" for what, why in solution.dropped_views]
    return [*lines, *evidence.verdict.lines()]


def camera_rows(solution: Solution, evidence: Evidence) -> Rows:
    """A row for each camera."""
    head = (
        "camera",
        "views",
        "points",
        "left out",
        "rms px",
        "held out px",
        "focal px",
        "centre px",
        "seen",
        "uncertain px",
    )
    rows = []
    for name, covered in evidence.coverage.items():
        used = [u for v, u in zip(solution.views, solution.used, strict=True) if v.camera == name]
        points, kept = sum(len(u) for u in used), sum(int(u.sum()) for u in used)
        lens, where = solution.estimate.cameras[name], evidence.projection[name]
        rows.append(
            [
                name,
                str(len(used)),
                str(points),
                str(points - kept),
                f"{solution.rms_px(name):.3f}",
                f"{evidence.held_out.own_px.get(name, math.nan):.3f}",
                f"{lens.fx:.2f} {lens.fy:.2f}",
                f"{lens.cx:.2f} {lens.cy:.2f}",
                f"{covered.share:.0%}",
                f"{where.centre_px:.2f} middle, {where.worst_px:.2f} worst",
            ]
        )
    return head, rows


def pair_rows(solution: Solution, evidence: Evidence) -> Rows:
    """A row for each pair of sensors: how they stand, and how far off in px one lands on the other."""
    distances = sorted({d for maps in evidence.transfer.values() for d in maps})
    head = (
        "pair",
        "turned deg",
        "moved mm",
        "+- mrad",
        "+- mm",
        "across px",
        *(f"px at {d:g} m" for d in distances),
    )
    rows = []
    for (dst, src), maps in evidence.transfer.items():
        T = pose_between(solution.estimate, dst, src)
        angle = math.degrees(math.acos(float(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1))))
        across = evidence.held_out.across_px.get((dst, src), math.nan)
        rows.append(
            [
                f"{src} to {dst}",
                f"{angle:.2f}",
                " ".join(f"{1000 * t:.1f}" for t in T[:3, 3]),
                *_deviations(solution, dst, src),
                "" if math.isnan(across) else f"{across:.3f}",
                *(f"{maps[d].median_px:.2f}" for d in distances),
            ]
        )
    if evidence.closure is not None:
        turn, shift = evidence.closure
        rows.append(
            [
                "loop of three",
                "",
                "",
                f"{1000 * turn:.2f}",
                f"{1000 * shift:.1f}",
                "",
                *("" for _ in distances),
            ]
        )
    return head, rows


def offset_rows(solution: Solution) -> Rows:
    """A row for each clock that was estimated."""
    rows = []
    for sensor, offset in solution.estimate.time_offset_s.items():
        name = f"{sensor}.time_offset_s"
        sigma = _sigma(solution, [name]) if name in solution.names else math.nan
        rows.append([sensor, f"{1000 * offset:.2f}", "held" if math.isnan(sigma) else f"{1000 * sigma:.2f}"])
    return ("clock", "offset ms", "+- ms"), rows


def _deviations(solution: Solution, dst: str, src: str) -> list[str]:
    """The standard deviations of rotation (mrad) and translation (mm) along their worst axes."""
    found = []
    for axes in ("r", "t"):
        names = [f"T_{dst}_{src}.{axes}{axis}" for axis in "xyz"]
        found.append(f"{1000 * _sigma(solution, names):.2f}" if set(names) <= set(solution.names) else "held")
    return found


def _sigma(solution: Solution, names: Sequence[str]) -> float:
    at = [solution.names.index(name) for name in names]
    return float(np.sqrt(np.linalg.eigvalsh(solution.covariance[np.ix_(at, at)])[-1]))


def _columns(rows: list[list[str]]) -> list[str]:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]
