"""Peak memory of `fusion blend` for few and for many pairs, and how long `fusion --help` takes."""

from __future__ import annotations

import subprocess
import sys

import lidar
from content import Case
from table import Row, Section, at_most
from timing import Sample, interleaved
from workspace import FUSION, Workspace, blend_command, run_clocked

SMALL = Case((160, 120), 8)
HELP_TARGET_S = 0.3

# A process between: a child's peak counts from its parent's size, and the benchmark itself is large.
LAUNCHER = """\
import resource, subprocess, sys
subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL)
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""

TEXT = """\
Peak resident memory of the whole process (`ru_maxrss`) of `fusion blend` with two workers on pairs of
160x120, {few} and {many} of them ({distinct} different ones, repeated as hard links)."""

HELP_TEXT = "Whole processes, warm disk cache, machine code of the compiled loops cached."


def measure(space: Workspace, distinct: int, few: int, many: int, rounds: int) -> Section:
    peaks: dict[int, list[float]] = {few: [], many: []}
    for _ in range(rounds):
        for count, values in peaks.items():
            values.append(_peak_mib(space, distinct, count))
    less, more = (Sample(tuple(values)) for values in peaks.values())
    text = TEXT.format(few=few, many=many, distinct=distinct)
    row = Row(f"{many} pairs / {few} pairs", _mib(more), _mib(less), more.over(less), at_most(1.2))
    return Section("Memory", text, (f"{many} pairs", f"{few} pairs"), [row])


def _peak_mib(space: Workspace, distinct: int, count: int) -> float:
    pairs = space.pairs(SMALL, distinct, count)
    command = blend_command(SMALL, pairs, space.fresh_out(), workers=2)
    done = subprocess.run(
        [sys.executable, "-ISc", LAUNCHER, *command], capture_output=True, text=True, check=True
    )
    made = sum(1 for _ in (space.out / "fused").iterdir())
    if made != count:
        raise RuntimeError(f"{made} of {count} frames were made")
    return int(done.stdout.split()[-1]) / (1 if sys.platform != "darwin" else 1024) / 1024


def _mib(sample: Sample) -> str:
    return f"{sample.median:.0f} MiB"


def measure_start(space: Workspace, rounds: int) -> Section:
    taken = interleaved({"help": lambda: run_clocked([str(FUSION), "--help"])}, rounds, warm=2)["help"]
    blend = interleaved({"help": lambda: run_clocked([str(FUSION), "blend", "--help"])}, rounds, warm=1)[
        "help"
    ]
    rows = [
        Row("`fusion --help`", "", "", taken, at_most(HELP_TARGET_S, " s")),
        Row("`fusion blend --help`", "", "", blend, at_most(HELP_TARGET_S, " s")),
    ]
    rows += lidar.measure_start(space, rounds)
    return Section("Start-up", HELP_TEXT, ("", ""), rows)
