"""`python benchmarks/accuracy.py [--write docs/depth.md] [--data FOLDER]`: how right the depth is, in tables.

The tables replace what stands between two marks in the page. Real data is looked for in FOLDER (by default
beside the checkout); what is not there is said to be not measured. The simulated mine is always measured.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import accuracy_kitti
import accuracy_map
import accuracy_mine

BEGIN, END = "<!-- begin: made by make accuracy -->", "<!-- end: made by make accuracy -->"
BESIDE = Path(__file__).parents[2] / "shared" / "data"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", type=Path, help="the page to put the tables into, besides printing them")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("FUSION_SHARED_DATA", BESIDE)))
    options = parser.parse_args()
    real = f"{accuracy_kitti.markdown(options.data)}\n\n{accuracy_map.markdown(options.data)}"
    tables = f"{accuracy_mine.markdown()}\n\n{real}"
    print(tables)
    if options.write:
        before, rest = options.write.read_text(encoding="utf-8").split(BEGIN)
        after = rest.split(END)[1]
        options.write.write_text(f"{before}{BEGIN}\n\n{tables}\n\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
