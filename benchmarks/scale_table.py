"""`python benchmarks/scale_table.py RECORDING OUT [--write docs/scale.md]`: a campaign's arithmetic from one
run.

OUT is what `fusion preprocess RECORDING -o OUT --workers 1` made: its records say what time the chunks took,
its files what they weigh. With more workers than cores idle for them, chunks wait for each other and the
rates are too low. The table replaces what stands between two marks in the page.
"""

from __future__ import annotations

import argparse
import csv
import json
from dataclasses import dataclass
from pathlib import Path

BEGIN, END = "<!-- begin: made by scale_table.py -->", "<!-- end: made by scale_table.py -->"
CAMPAIGN_BYTES = 10e12
WORKERS = (2, 16, 64, 256)
LINK_BYTES_PER_S = 1.25e9  # 10 Gbit/s


@dataclass(frozen=True, slots=True)
class Rates:
    """What one frame costs: a worker's seconds, bytes in, bytes out, files; and frames in a chunk."""

    seconds: float
    bytes_in: float
    bytes_out: float
    files: float
    frames_in_chunk: float

    @classmethod
    def of(cls, recording: Path, out: Path) -> Rates:
        records = [json.loads(path.read_bytes()) for path in sorted(out.glob("chunks/[0-9]*.json"))]
        with (out / "frames.csv").open(newline="") as file:
            frames = sum(row["status"] == "made" for row in csv.DictReader(file))
        if not records or not frames:
            raise SystemExit(f"{out}: no frames were made there")
        written = [size for record in records for size in record["files"].values()]
        return cls(
            seconds=sum(record["seconds"] for record in records) / frames,
            bytes_in=_bytes_of(recording) / frames,
            bytes_out=sum(written) / frames,
            files=len(written) / frames,
            frames_in_chunk=frames / len(records),
        )


def markdown(rates: Rates, campaign_bytes: float = CAMPAIGN_BYTES) -> str:
    frames = campaign_bytes / rates.bytes_in
    work_h = frames * rates.seconds / 3600
    per_worker = (rates.bytes_in + rates.bytes_out) / rates.seconds
    measured = [
        ("*s*, seconds of a worker a frame", f"{rates.seconds:.3g}"),
        ("*a*, bytes read a frame", _bytes(rates.bytes_in)),
        ("*b*, bytes written a frame", _bytes(rates.bytes_out)),
        ("*k*, files written a frame", f"{rates.files:.3g}"),
        ("*m*, frames a chunk", f"{rates.frames_in_chunk:.3g}"),
    ]
    follows = [
        (f"frames in {_bytes(campaign_bytes)}", "T / a", f"{frames:,.0f}"),
        ("written", "T b / a", _bytes(frames * rates.bytes_out)),
        ("files written", "T k / a", f"{frames * rates.files:,.0f}"),
        ("chunks, and records", "T / (a m)", f"{frames / rates.frames_in_chunk:,.0f}"),
        ("a worker's hours", "T s / a", f"{work_h:,.0f}"),
        ("bytes a worker moves a second", "(a + b) / s", _bytes(per_worker)),
        ("workers that fill 10 Gbit/s", "1.25 GB s / (a + b)", f"{LINK_BYTES_PER_S / per_worker:,.0f}"),
        ("lost at most when a worker dies", "m s", f"{rates.frames_in_chunk * rates.seconds:,.0f} s"),
        *((f"hours with {count} workers", "T s / (a W)", f"{work_h / count:,.1f}") for count in WORKERS),
    ]
    head = "| measured | value |\n|---|---|\n" + "".join(
        f"| {name} | {value} |\n" for name, value in measured
    )
    body = "".join(f"| {name} | {rule} | {value} |\n" for name, rule, value in follows)
    return f"{head}\n| follows | from | value |\n|---|---|---|\n{body}".rstrip()


def _bytes(count: float) -> str:
    for unit, size in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count:.0f} B"


def _bytes_of(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--write", type=Path, help="the page to put the tables into")
    given = parser.parse_args()
    tables = markdown(Rates.of(given.recording, given.out))
    print(tables)
    if given.write:
        before, rest = given.write.read_text(encoding="utf-8").split(BEGIN)
        page = f"{before}{BEGIN}\n\n{tables}\n\n{END}{rest.split(END)[1]}"
        given.write.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
