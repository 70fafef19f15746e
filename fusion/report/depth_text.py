"""What a depth run says: its plan before, tables and warnings after. Plain text, for logs too."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fusion.lidar.lane import DepthLane, likely_cause
from fusion.lidar.score import Score, mean_score
from fusion.report.table import LOUD_SKIPS, table
from fusion.sinks.depth import DepthRow

STEPS = {
    "read": "points read",
    "finite": "finite",
    "in_front": "in front",
    "in_frame": "in the frame",
    "in_range": "in range",
    "visible": "visible",
    "covered": "pixels covered",
    "supported": "of them supported",
}


@dataclass(slots=True)
class DepthReport:
    """What a run did; `sums` are over all maps, kept ones included."""

    made: int = 0
    kept: int = 0
    skipped: list[tuple[str, str]] = field(default_factory=list)
    sums: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    poor: list[str] = field(default_factory=list)

    @property
    def total(self) -> int:
        return self.made + self.kept + len(self.skipped)

    def add(self, row: DepthRow, kept: bool) -> None:
        if not row.done:
            self.skipped.append((row.stem, row.reason))
            return
        self.kept += kept
        self.made += not kept
        counts = {name: int(getattr(row, name)) for name in (*STEPS, "pixels")}
        self.sums.update(counts)
        self.dropped.update(
            {why: int(n) for why, n in (pair.split("=") for pair in row.dropped.split(";") if pair)}
        )
        cause = likely_cause(counts)
        if cause:
            self.poor.append(f"{row.stem}: {cause}")


def plan_lines(lane: DepthLane, inputs: int, ignored: int, *, pictures: bool = False) -> list[str]:
    """What will be done, before the first cloud, or the first of sparse `pictures`."""
    dense, samples = lane.config.dense, lane.config.samples
    gap = "by spacing" if dense.max_gap_px is None else f"{dense.max_gap_px:g} px"
    rows = [
        ("inputs", f"{inputs}" + (f", and {ignored} other files ignored" if ignored else "")),
        ("camera", "that of the pictures" if pictures else _camera_line(lane)),
        ("value", f"{lane.value}, {samples.limits_m[0]:g} to {samples.limits_m[1]:g} m"),
        ("visibility", samples.visibility),
        ("method", f"{dense.method}, largest gap {gap}, extrapolation {dense.extrapolate}"),
    ]
    return table(rows)


def _camera_line(lane: DepthLane) -> str:
    camera, (w, h) = lane.config.camera, lane.camera.size_wh
    if camera.rig is not None:
        return f"{camera.rig}, {camera.sensor}, {w}x{h}"
    return f"{camera.model}, {camera.fov_deg:g} degrees, {w}x{h}"


def closing_lines(report: DepthReport, out: Path) -> list[str]:
    """The table at the end of a run: what was left after each step, every dropped point counted."""
    maps = report.made + report.kept
    rows = [
        ("maps", f"{report.made}" + (f", and {report.kept} kept from before" if report.kept else "")),
        ("skipped", f"{len(report.skipped)}"),
    ]
    before = 0
    for name, label in STEPS.items():
        count = report.sums[name]
        whole = report.sums["pixels"] if name in ("covered", "supported") else before
        share = f" ({count / whole:.1%})" if whole and name != "read" else ""
        rows.append((label, f"{count}{share}"))
        before = count
    rows += [(f"dropped: {why}", f"{count}") for why, count in sorted(report.dropped.items())]
    rows.append(("written to", f"{out}: depth/, support/, sparse/, picture/ of {maps} and frames.csv"))
    return table(rows)


def warnings_of(report: DepthReport, unscored: Mapping[str, str]) -> list[str]:
    """What the user should act on, a line each; `unscored` says of maps why they have no score."""
    skipped = [f"skipped {stem}: {reason}" for stem, reason in report.skipped]
    without = [f"{stem} is not scored: {reason}" for stem, reason in unscored.items()]
    return [
        *_loudest(skipped, "all named in frames.csv"),
        *_loudest(report.poor, "with little left"),
        *_loudest(without, "without a score"),
    ]


def _loudest(lines: Sequence[str], which: str) -> list[str]:
    more = len(lines) - LOUD_SKIPS
    return [*lines[:LOUD_SKIPS], *([f"… and {more} more, {which}"] if more > 0 else [])]


def score_lines(scores: Mapping[str, Score]) -> list[str]:
    """The errors of every map and, last, their means over the images, as the KITTI benchmark counts them."""
    head = ("map", "RMSE mm", "MAE mm", "iRMSE 1/km", "iMAE 1/km", "coverage")
    lines = [(stem, *_cells(one)) for stem, one in scores.items()]
    if len(scores) > 1:
        lines.append(("mean", *_cells(mean_score(list(scores.values())))))
    widths = [max(len(line[k]) for line in (head, *lines)) for k in range(len(head))]
    return [
        "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True))
        for line in (head, *lines)
    ]


def _cells(score: Score) -> tuple[str, ...]:
    errors = (score.rmse_mm, score.mae_mm, score.irmse_1_km, score.imae_1_km)
    return (*(f"{error:.2f}" for error in errors), f"{score.coverage:.2%}")
