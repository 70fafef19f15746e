"""`python benchmarks/accuracy.py [--write docs] [--only PAGE] [--data FOLDER]`: results against truth.

The tables replace what stands between two marks in docs/depth.md, docs/calibration.md and docs/timing.md.
Real data is looked for in FOLDER (by default beside the checkout); what is not there is said to be not
measured. The simulated mine and drawn sessions are always measured.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path

import accuracy_align
import accuracy_calib
import accuracy_kitti
import accuracy_map
import accuracy_mine
import accuracy_timing
import accuracy_warp

BEGIN, END = "<!-- begin: made by make accuracy -->", "<!-- end: made by make accuracy -->"
BESIDE = Path(__file__).parents[2] / "shared" / "data"


def depth(data: Path) -> str:
    return "\n\n".join([accuracy_mine.markdown(), accuracy_kitti.markdown(data), accuracy_map.markdown(data)])


def calibration(data: Path) -> str:
    parts = [accuracy_calib.markdown(data), accuracy_warp.markdown(), accuracy_align.markdown(data)]
    return "\n\n".join(parts)


def timing(data: Path) -> str:  # noqa: ARG001 - of simulated flights alone
    return accuracy_timing.markdown()


PAGES: dict[str, Callable[[Path], str]] = {"depth": depth, "calibration": calibration, "timing": timing}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", type=Path, help="the folder of the pages to put the tables into")
    parser.add_argument("--only", choices=list(PAGES), help="only this page")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("FUSION_SHARED_DATA", BESIDE)))
    options = parser.parse_args()
    for name in [options.only] if options.only else list(PAGES):
        tables = PAGES[name](options.data)
        print(tables, flush=True)
        if options.write:
            _put(options.write / f"{name}.md", tables)


def _put(page: Path, tables: str) -> None:
    before, rest = page.read_text(encoding="utf-8").split(BEGIN)
    page.write_text(f"{before}{BEGIN}\n\n{tables}\n\n{END}{rest.split(END)[1]}", encoding="utf-8")


if __name__ == "__main__":
    main()
