"""`python benchmarks/bench.py [--write docs/benchmarks.md] [--quick]`: every figure beside its target.

The page it writes is made wholly here, so that what it says of machine, versions and method is what ran.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

os.environ.pop("OPENBLAS_CORETYPE", None)  # before numpy is loaded: it would choose another kernel

import calibration
import compute
import encoders
import inprocess
import lidar
import memory
import mine
import preprocess
import recordings
import warp
from content import FIR_NOISE_8, FIR_NOISE_16, RGB_NOISE
from page import OPENING, renewed
from processes import Processes
from table import Section, summary
from workspace import Workspace, machine_lines, storage, version_lines, workspace


@dataclass(frozen=True, slots=True)
class Plan:
    """How much is measured."""

    compute_rounds: int = 11
    run_rounds: int = 7
    run_frames: int = 60
    process_rounds: int = 3
    process_frames: int = 480
    encode_rounds: int = 9
    memory_rounds: int = 2
    few: int = 200
    many: int = 10_000
    help_rounds: int = 11
    lidar_rounds: int = 9
    mine_rounds: int = 3
    calibration_rounds: int = 5
    warp_rounds: int = 9
    distinct: int = 12
    recorded_s: float = 3.0
    recording_rounds: int = 5
    small_messages: int = 5000
    campaign: preprocess.Amount = preprocess.FULL


QUICK = Plan(3, 2, 12, 1, 24, 2, 1, 40, 400, 3, 2, 1, 2, 2, 4, 1.0, 1, 500, preprocess.QUICK)

METHOD = """\
Jobs that are compared run in turn (A B C A B C …) after a warm-up round; every figure is the median of its
rounds with their quartiles (with fewer than four rounds: least and largest) in brackets, and a ratio is the
median of the ratios round by round, so that a machine that slows down slows both sides of it. {storage};
`OPENBLAS_CORETYPE` unset; {plan}.

Images are drawn by the benchmark, always the same: smooth random fields with Gaussian noise (standard
deviation {rgb:g} grey levels in RGB, {fir8:g} in 8-bit thermal, {fir16:g} counts in 16-bit thermal, which
spans about 7000 to 7400), {distinct} different pairs of a kind, repeated as hard links where more are
needed. Input PNG is as `cv2.imwrite` writes it by default, input JPEG of quality 92. Such noise is the hard
case for every PNG codec: there is little to compress."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", type=Path, help="write the page to this file, besides printing it")
    parser.add_argument(
        "--quick", action="store_true", help="a smoke run: few rounds, few frames, soft figures"
    )
    parser.add_argument(
        "--only", action="append", choices=list(SECTIONS), help="only these sections; --write renews them"
    )
    options = parser.parse_args()
    if options.only and options.write:
        parts = measured(Plan(), options.only)
        page = renewed(options.write.read_text(encoding="utf-8"), parts.sections)
    else:
        page = measure(
            QUICK if options.quick else Plan(), options.only or list(SECTIONS), quick=options.quick
        )
    print(page)
    if options.write:
        options.write.write_text(page, encoding="utf-8")


def measure(plan: Plan, names: list[str], *, quick: bool) -> str:
    """The whole page."""
    began, machine = time.monotonic(), machine_lines()
    parts = measured(plan, names)
    minutes = (time.monotonic() - began) / 60
    return page_of(plan, parts, machine, minutes, quick)


def measured(plan: Plan, names: list[str]) -> Parts:
    parts = Parts([], [])
    with workspace() as space:
        for name in names:
            print(f"measuring: {name} …", file=sys.stderr, flush=True)
            SECTIONS[name](plan, space, parts)
    return parts


@dataclass(frozen=True, slots=True)
class Parts:
    """What the sections add to: tables, and the text after them."""

    sections: list[Section]
    endings: list[str]


def _processes(plan: Plan, space: Workspace, parts: Parts) -> None:
    section, tuning = Processes(space, plan.distinct, plan.process_frames, plan.process_rounds).measure()
    parts.sections.append(section)
    parts.endings.append(f"## How the others were tuned\n\n{tuning}")


def _simple(measured: Callable[[Plan, Workspace], Section]) -> Callable[[Plan, Workspace, Parts], None]:
    return lambda plan, space, parts: parts.sections.append(measured(plan, space))


SECTIONS: dict[str, Callable[[Plan, Workspace, Parts], None]] = {
    "compute": _simple(lambda plan, _: compute.measure(plan.compute_rounds)),
    "inprocess": _simple(lambda p, space: inprocess.measure(space, p.distinct, p.run_frames, p.run_rounds)),
    "processes": _processes,
    "memory": _simple(lambda p, space: memory.measure(space, p.distinct, p.few, p.many, p.memory_rounds)),
    "encoders": _simple(lambda plan, _: encoders.measure(plan.encode_rounds)),
    "lidar": _simple(lambda plan, _: lidar.measure(plan.lidar_rounds)),
    "warp": _simple(lambda plan, _: warp.measure(plan.warp_rounds)),
    "mine": _simple(lambda plan, space: mine.measure(space, plan.mine_rounds)),
    "recordings": _simple(
        lambda p, space: recordings.measure(space, p.recorded_s, p.small_messages, p.recording_rounds)
    ),
    "preprocess": _simple(lambda p, space: preprocess.measure(space, p.campaign)),
    "calibration": _simple(lambda plan, _: calibration.measure(plan.calibration_rounds)),
    "help": _simple(lambda plan, space: memory.measure_start(space, plan.help_rounds)),
}


def page_of(plan: Plan, parts: Parts, machine: list[str], minutes: float, quick: bool) -> str:
    blocks = [
        "# Benchmarks",
        OPENING,
        *(["**A smoke run (`--quick`): these figures are soft.**"] if quick else []),
        summary(parts.sections),
        *(section.markdown() for section in parts.sections),
        "## Machine and versions\n\n" + "\n".join([*machine, *version_lines()]),
        f"## Method\n\n{method(plan)} The run took {minutes:.1f} minutes.",
        *parts.endings,
    ]
    return "\n\n".join(blocks) + "\n"


def method(plan: Plan) -> str:
    rounds = (
        f"{plan.compute_rounds} rounds in memory, {plan.run_rounds} in one process,"
        f" {plan.process_rounds} of whole processes, {plan.encode_rounds} of encoders,"
        f" {plan.memory_rounds} of memory, {plan.lidar_rounds} of LiDAR,"
        f" {plan.warp_rounds} of warps from a rig, {plan.mine_rounds} of the mine,"
        f" {plan.calibration_rounds} of calibration, {plan.recording_rounds} of recordings,"
        f" {plan.campaign.rounds} of campaigns,"
        f" {plan.help_rounds} of start-up"
    )
    return METHOD.format(
        storage=storage().capitalize(),
        plan=rounds,
        rgb=RGB_NOISE,
        fir8=FIR_NOISE_8,
        fir16=FIR_NOISE_16,
        distinct=plan.distinct,
    )


if __name__ == "__main__":
    main()
