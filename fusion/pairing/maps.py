"""Pairing by a list of pairs in a file."""

from __future__ import annotations

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from fusion.errors import InputError
from fusion.pairing.keys import clocked
from fusion.pairing.rule import Match, PairingRule, Unmatched

if TYPE_CHECKING:
    from fusion.sources.base import Entry

_MAP_BYTES = 64 * 2**20


def by_map(rgb: Sequence[Entry], fir: Sequence[Entry], rule: PairingRule) -> Match:
    match, path = Match(), Path(rule.map_file or "")
    names = _Names.of(rgb), _Names.of(fir)
    edges: list[tuple[str, int, int]] = []
    for line, rgb_name, fir_name in read_map(path):
        i, j = names[0].find(rgb_name), names[1].find(fir_name)
        if i >= 0 and j >= 0:
            edges.append((line, i, j))
            continue
        said = {-1: "there is no {} image '{}'", -2: "more than one {} image is called '{}'"}
        reason = "; ".join(
            said[k].format(side, name)
            for k, side, name in ((i, "RGB", rgb_name), (j, "thermal", fir_name))
            if k < 0
        )
        match.from_map.append(Unmatched("map", f"{path} {line}", reason))
    uses = Counter(i for _, i, _ in edges), Counter(j for _, _, j in edges)
    for line, i, j in edges:
        if uses[0][i] == uses[1][j] == 1:
            match.pairs.append(clocked(rgb, fir, i, j))
        else:
            twice = rgb[i].where if uses[0][i] > 1 else fir[j].where
            match.from_map.append(
                Unmatched("map", f"{path} {line}", f"{twice} is named more than once: ambiguous")
            )
    said = (
        "no line of the mapping file pairs it",
        "the mapping file names it or its partner more than once: ambiguous",
    )
    paired = {p.rgb for p in match.pairs}, {p.fir for p in match.pairs}
    match.rgb = {k: said[uses[0][k] > 0] for k in range(len(rgb)) if k not in paired[0]}
    match.fir = {k: said[uses[1][k] > 0] for k in range(len(fir)) if k not in paired[1]}
    return match


def read_map(path: Path) -> list[tuple[str, str, str]]:
    """Rows (line or entry, RGB name, thermal name) of a mapping file. Raises `InputError`."""
    try:
        if not path.is_file():
            raise InputError(
                "no such mapping file", where=path, hint="a CSV with the header rgb,fir or a JSON object"
            )
        if path.stat().st_size > _MAP_BYTES:
            raise InputError("mapping file is over 64 MB", where=path)
        text = path.read_text(encoding="utf-8-sig")
        rows = _json_rows(text) if path.suffix.lower() == ".json" else _csv_rows(text)
    except (OSError, ValueError, RecursionError, csv.Error) as error:
        hint = "a CSV with the header rgb,fir or a JSON object of RGB name to thermal name, in UTF-8"
        raise InputError(f"cannot read the mapping file: {error}", where=path, hint=hint) from None
    if not rows:
        raise InputError("the mapping file has no rows", where=path)
    return rows


def _csv_rows(text: str) -> list[tuple[str, str, str]]:
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    header = [cell.strip().lower() for cell in next(reader, [])]
    if header.count("rgb") != 1 or header.count("fir") != 1:
        raise ValueError(f"its first line is '{','.join(header)[:80]}'")
    a, b, rows = header.index("rgb"), header.index("fir"), []
    for cells in reader:
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header) or not cells[a].strip() or not cells[b].strip():
            raise ValueError(f"line {reader.line_num} does not have one name in each column")
        rows.append((f"line {reader.line_num}", cells[a].strip(), cells[b].strip()))
    return rows


def _json_rows(text: str) -> list[tuple[str, str, str]]:
    table = json.loads(text, object_pairs_hook=tuple)
    if not isinstance(table, tuple) or not all(isinstance(fir, str) for _, fir in table):
        raise ValueError("expected one JSON object of RGB name to thermal name")
    return [(f"entry {k}", rgb, fir) for k, (rgb, fir) in enumerate(table, 1)]


@dataclass(slots=True)
class _Names:
    """Index of an entry by its stem, and by every shorter ending of its path; -2 where it is not one."""

    exact: dict[str, int] = field(default_factory=dict)
    endings: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, entries: Sequence[Entry]) -> _Names:
        names = cls()
        for i, entry in enumerate(entries):
            parts = entry.stem.split("/")
            names.exact[entry.stem] = -2 if entry.stem in names.exact else i
            for ending in ("/".join(parts[k:]) for k in range(1, len(parts))):
                names.endings[ending] = -2 if ending in names.endings else i
        return names

    def find(self, name: str) -> int:
        """The entry that a map's name means, given with more or fewer folders; -1 none, -2 more than one."""
        parts = [p for p in name.replace("\\", "/").split("/") if p not in ("", ".")]
        tails = ["/".join(parts[k:]) for k in range(len(parts))]
        spelt = [spelling for tail in tails for spelling in (tail, re.sub(r"\.[^./]*$", "", tail))]
        shorter = [(self.endings, spelling) for spelling in spelt[:2]]
        tables = [(self.exact, spelling) for spelling in spelt[:2]] + shorter
        tables += [(self.exact, spelling) for spelling in spelt[2:]]
        return next((table[spelling] for table, spelling in tables if spelling in table), -1)
