"""A page of benchmarks of which some sections are measured anew: they replace their like, the summary
follows."""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import UTC, datetime
from os import getloadavg

from table import Section

OPENING = (
    "Written by `make bench`; sections that say so were renewed on their own (`benchmarks/bench.py --only`)."
    " The targets were set before anything was measured."
)
_HEAD, _MACHINE = "# Benchmarks", "Machine and versions"
_MISSED = "**missed**"


def renewed(page: str, sections: Iterable[Section]) -> str:
    """`page` with these sections in place of those of the same title, or before the machine's.

    Each says when it was measured, and how busy the machine was. The summary is made again, from the page's
    tables.
    """
    _, *blocks = re.split(r"\n(?=## )", page.rstrip() + "\n")
    titled = {_title(block): block for block in blocks}
    today, load = datetime.now(UTC).date().isoformat(), getloadavg()[0]
    when = f"*Measured on its own on {today}, load average {load:.1f} at its end.*"
    for section in sections:
        titled[section.title] = (
            section.markdown().replace("\n\n| what |", f"\n\n{when}\n\n| what |", 1) + "\n"
        )
    tail = [title for title in titled if title == _MACHINE or not _rows(titled[title])]
    order = [title for title in titled if title not in tail] + tail
    return "\n".join([f"{_HEAD}\n\n{OPENING}\n\n{summary_of(titled)}\n", *(titled[title] for title in order)])


def summary_of(titled: dict[str, str]) -> str:
    """How many targets are met, and every one that is not, by its name."""
    lines, met, count = [], 0, 0
    for title, block in titled.items():
        for what, _, _, ratio, target, verdict in _rows(block):
            if target:
                count += 1
                met += verdict == "met"
                if verdict == _MISSED:
                    lines.append(f"- missed: {title}: {what}: {ratio}, wanted {target}")
                elif verdict != "met":
                    lines.append(f"- not measured: {title}: {what}: {verdict}")
    return "\n".join([f"{met} of {count} targets met.", *([""] if lines else []), *lines])


def _title(block: str) -> str:
    return block.splitlines()[0].removeprefix("## ")


def _rows(block: str) -> list[list[str]]:
    """The cells of a block's table rows: what, ours, other, ratio, target, verdict."""
    found = []
    for line in block.splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if line.startswith("| ") and len(cells) == 6 and cells[0] not in ("what", "---"):
            found.append(cells)
    return found
