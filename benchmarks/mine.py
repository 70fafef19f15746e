"""The simulated mine: how many sensor sets a second, and whether memory stays flat."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from memory import LAUNCHER
from table import Row, Section, at_least, at_most, milliseconds
from timing import Sample, clocked
from workspace import FUSION, Workspace

from fusion.simulate.mine.config import MineConfig
from fusion.simulate.mine.recording import make_mine, world_of

SHORT_S, LONG_S = 0.55, 1.55
RATE_HZ = 10.0
MEMORY_S = (1.0, 4.0)

TEXT = """\
`make_mine` with truth, two threads, all three sensors at {rate:g} Hz (640x480 + 640x512 + 64x1024): the time
of a set is that of {long:g} s of recording less that of {short:g} s, a set each 0.1 s, so that building the
scene is not in it. Memory is the peak of `fusion simulate mine` for {least:g} and {most:g} s at the default
rates."""


def measure(space: Workspace, rounds: int) -> Section:
    config = MineConfig.of(rgb={"rate_hz": RATE_HZ}, thermal={"rate_hz": RATE_HZ}, lidar={"rate_hz": RATE_HZ})
    world = world_of(config)

    def film(seconds: float) -> tuple[float, int]:
        made: list[int] = []
        settings = config.model_copy(update={"duration_s": seconds})
        taken = clocked(lambda: made.append(make_mine(space.fresh_out(), settings, world=world).rgb))
        return taken, made[0]

    film(SHORT_S)  # machine code
    rates = []
    for _ in range(rounds):
        (short_s, few), (long_s, many) = film(SHORT_S), film(LONG_S)
        rates.append((many - few) / (long_s - short_s))
    rate = Sample(tuple(rates))
    a_set = Sample(tuple(1 / value for value in rates))
    peaks = [Sample((_peak_mib(space.fresh_out(), seconds),)) for seconds in MEMORY_S]
    text = TEXT.format(rate=RATE_HZ, long=LONG_S, short=SHORT_S, least=MEMORY_S[0], most=MEMORY_S[1])
    rows = [
        Row("sensor sets", milliseconds(a_set), "", rate, at_least(4, " sets/s")),
        Row(
            f"peak memory, {MEMORY_S[1]:g} s / {MEMORY_S[0]:g} s",
            f"{peaks[1].median:.0f} MiB",
            f"{peaks[0].median:.0f} MiB",
            peaks[1].over(peaks[0]),
            at_most(1.1),
        ),
    ]
    return Section("The simulated mine", text, ("a set; longer", "shorter"), rows)


def _peak_mib(out: Path, seconds: float) -> float:
    command = [str(FUSION), "simulate", "mine", str(out), "--duration", str(seconds), "--quiet"]
    done = subprocess.run(
        [sys.executable, "-ISc", LAUNCHER, *command], capture_output=True, text=True, check=True
    )
    return int(done.stdout.split()[-1]) / (1 if sys.platform != "darwin" else 1024) / 1024
