"""`python benchmarks/fuzz.py [--write docs/fuzz.md] [--inputs N] [--seed N] [--case READER:K]`: bad inputs.

Every reader is given damaged and drawn inputs, each in a process that is watched. An input may be read, or
refused with a line of ours; all else is a finding. `--case` makes one input again, reads it in this process
and shows what happens; `--keep FOLDER` saves the inputs of findings. Ends with 1 where there is a finding.
"""

from __future__ import annotations

import argparse
import os
import pickle
import sys
import tempfile
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path

import fuzz_run as runs
from fuzz_readers import READERS
from fuzz_run import Outcome, Task
from fuzz_seeds import Seeds, all_seeds
from workspace import MEMORY_BACKED, version_lines

BESIDE = Path(__file__).parents[2] / "shared" / "data"
INPUTS = 40_000
FINE = ("read", "refused")


def shares(inputs: int, names: Iterable[str]) -> dict[str, int]:
    """How many inputs each reader gets."""
    chosen = {name: READERS[name].share for name in names}
    total = sum(chosen.values())
    return {name: max(1, round(inputs * share / total)) for name, share in chosen.items()}


def page(outcomes: list[Outcome], seeds: Seeds, number: int, seconds: float, real: str) -> str:
    """docs/fuzz.md."""
    by_reader: dict[str, list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        by_reader[outcome.reader].append(outcome)
    inputs = [outcome for outcome in outcomes if outcome.case >= 0]
    bad = [outcome for outcome in outcomes if _is_finding(outcome)]
    table = [_row(name, by_reader[name], seeds) for name in READERS if name in by_reader]
    findings = [_finding(outcome) for outcome in bad[:100]] or ["None."]
    return "\n".join(
        [
            _HEAD.format(
                cpu=runs.CPU_LIMIT_S, wall=runs.WALL_LIMIT_S, spare=runs.SPARE_MIB, words=runs.MOST_WORDS
            ),
            "## Result\n",
            f"{len(inputs):,} inputs, {len(bad)} findings, in {seconds / 60:.1f} minutes;"
            f" {datetime.now(UTC):%Y-%m-%d}, seed {number}, {real}.\n",
            *version_lines()[:1],
            "",
            *("| " + " | ".join(cells) + " |" for cells in [_COLUMNS, ["---", "---"] + ["---:"] * 8, *table]),
            "\n## Findings\n",
            *findings,
            "",
        ]
    )


_COLUMNS = ["reader", "what", "sound seeds", "inputs", "read", "refused", "findings", "slowest (CPU s)"]
_COLUMNS += ["largest growth (MiB)", "bound (MiB)"]
_HEAD = """# Fuzzing

Written by `make fuzz`; every figure is of the run named below.

Every reader gets inputs that nobody meant to be read: sound files damaged at random (bits, runs of bytes,
cuts, blocks doubled, left out or swapped, pieces of other files, lengths and counts of 1 to 8 bytes made
extreme; texts word by word, and brackets and YAML references nested until a careless reader has no stack or
memory left), and inputs drawn by hypothesis and by hand where damage would not reach. Half of the damaged
PNGs get right checksums again, and every second MCAP has none. Seeds are recordings of a tiny simulated mine
in every container and compression, drawn images and clouds, and the real files of the shared data where they
are there.

An input may be **read**, or **refused** with a `FusionError`, a line of at most {words:,} letters (damaged
records of chunks are refused by a word). All else is a finding: another exception, a crash, a file left
behind or beside its folder, a path or name that leads out of its root, more than {cpu:g} s of CPU (a process
that sleeps {wall:g} s is killed as well), or memory above the bound. Memory is the highest resident size
while the input is read, less that of the idle process that has read every sound seed; the bound is 512 MiB,
and 1.5 GiB where a format's own stated limit lets a chunk or a packed message unpack to 1 GiB. Addresses are
limited to {spare:,} MiB above the bound: a request for more fails, and is a finding even if a reader makes a
refusal of it.

One case again, with its traceback: `python benchmarks/fuzz.py --seed N --case READER:K` (with the same
libraries and the same shared data; `--keep FOLDER` saves its files).
"""


def _is_finding(outcome: Outcome) -> bool:
    return outcome.kind not in FINE


def _row(name: str, outcomes: list[Outcome], seeds: Seeds) -> list[str]:
    cases = [outcome for outcome in outcomes if outcome.case >= 0]
    kinds = Counter(outcome.kind for outcome in cases)
    count = len(seeds.get(READERS[name].seeds, []))
    sound = {outcome.case for outcome in outcomes if outcome.case < 0 and outcome.kind == "read"}
    figures = [kinds["read"], kinds["refused"], sum(map(_is_finding, outcomes))]
    return [
        *(name, READERS[name].says, f"{len(sound)} of {count}" if count else "drawn", f"{len(cases):,}"),
        *(f"{figure:,}" for figure in figures),
        f"{max((o.seconds for o in cases), default=0):.2f}",
        f"{max((o.mib for o in cases), default=0):.0f}",
        str(READERS[name].bound_mib),
    ]


def _finding(outcome: Outcome) -> str:
    last = (outcome.said.strip().splitlines() or [""])[-1][:300]
    return f"- `{outcome.reader}:{outcome.case}` {outcome.kind}: `{last}`"


def _keep(outcome: Outcome, seeds: Seeds, number: int, folder: Path) -> None:
    seed = runs.input_of(READERS[outcome.reader], seeds, number, outcome.case)
    place = folder / f"{outcome.reader}-{outcome.case}"
    place.mkdir(parents=True, exist_ok=True)
    runs.lay_out(seed, place)
    (place / "said.txt").write_text(f"{outcome.kind}\n{seed.name}\n{outcome.said}\n")


def _again(case: str, seeds: Seeds, number: int, keep: Path | None, scratch: Path) -> int:
    """One case in this process."""
    name, _, k = case.partition(":")
    seed = runs.input_of(READERS[name], seeds, number, int(k))
    path = runs.lay_out(seed, keep / f"{name}-{k}" if keep else scratch / "case")
    print(f"{case} is made from {seed.name!r}: {seed.about!r:.500}", file=sys.stderr)
    try:
        print(READERS[name].read(path, seed) or "read")
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", type=Path, help="the page to write")
    parser.add_argument("--inputs", type=int, default=INPUTS)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only", nargs="+", choices=list(READERS), default=list(READERS), metavar="READER")
    parser.add_argument("--case", help="READER:K: only this one, here")
    parser.add_argument("--keep", type=Path, help="a folder for the inputs of findings")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("FUSION_SHARED_DATA", BESIDE)))
    options = parser.parse_args()
    there = options.data.is_dir()
    real = "real files included" if there else f"**no real files**: {options.data} is not there"
    parent = MEMORY_BACKED if os.access(MEMORY_BACKED, os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix="fusion-fuzz-", dir=parent) as folder:
        scratch = Path(folder)
        seeds = all_seeds(scratch / "seeds", options.data if there else None)
        if options.case:
            return _again(options.case, seeds, options.seed, options.keep, scratch)
        began = time.monotonic()
        counts = shares(options.inputs, options.only)
        (scratch / "seeds.pickle").write_bytes(pickle.dumps(seeds))
        task = Task(options.seed, dict.fromkeys(READERS, ""), scratch / "seeds.pickle")
        outcomes = list(_told(runs.run(task, counts, scratch / "run", options.workers), sum(counts.values())))
        for outcome in filter(_is_finding, outcomes):
            if options.keep:
                _keep(outcome, seeds, options.seed, options.keep)
    text = page(outcomes, seeds, options.seed, time.monotonic() - began, real)
    print(text[text.index("## Result") :])
    if options.write:
        options.write.write_text(text, encoding="utf-8")
    return 1 if any(map(_is_finding, outcomes)) else 0


def _told(outcomes: Iterable[Outcome], total: int) -> Iterable[Outcome]:
    """The outcomes as they come; findings and every thousandth are told on the way."""
    done = 0
    for outcome in outcomes:
        done += outcome.case >= 0
        if _is_finding(outcome):
            print(_finding(outcome), file=sys.stderr, flush=True)
        elif outcome.case >= 0 and done % 1000 == 0:
            print(f"{done:,} of {total:,}", file=sys.stderr, flush=True)
        yield outcome


if __name__ == "__main__":
    sys.exit(main())
