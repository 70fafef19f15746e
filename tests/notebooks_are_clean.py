"""Notebooks are stored without outputs: `python -m tests.notebooks_are_clean notebooks/*.ipynb`."""

from __future__ import annotations

import json
import sys
from pathlib import Path


def outputs(notebook: Path) -> int:
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return sum(bool(cell.get("outputs")) or cell.get("execution_count") is not None for cell in cells)


if __name__ == "__main__":
    stained = [path for path in sys.argv[1:] if outputs(Path(path))]
    sys.exit(f"stored with outputs: {', '.join(stained)}" if stained else 0)
