"""`fusion calibrate board | check | convert`: work on files, without any solving."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

from calib.boards import Board, load_board, save_board
from calib.checking import check_file
from calib.formats import convert
from calib.printing import board_pdf, board_svg
from fusion.cli.running import refuse_existing
from fusion.errors import InputError, UsageError
from fusion.files import replace_file
from fusion.sources import open_source
from fusion.sources.base import Role

_MARKER_SHARE = 0.75
_CODES = "DICT_5X5_100"


def run_board(
    out: Path,
    board: Path | None,
    kind: Any,
    cols: int,
    rows: int,
    spacing_mm: float,
    marker_mm: float | None,
    dictionary: str | None,
    *,
    overwrite: bool,
) -> None:
    if out.suffix.lower() not in (".pdf", ".svg"):
        raise UsageError(f"{out.name} is neither .pdf nor .svg", where="OUT")
    described = out.with_suffix(".toml")
    refuse_existing(out, overwrite)
    printed = (
        load_board(board) if board is not None else _made(kind, cols, rows, spacing_mm, marker_mm, dictionary)
    )
    if board is None or described.resolve() != board.resolve():
        refuse_existing(described, overwrite)
        save_board(described, printed)
    data = board_pdf(printed) if out.suffix.lower() == ".pdf" else board_svg(printed).encode()
    replace_file(out, data)
    print(f"{printed}: {out} and {described}")
    print("print at 100 %, measure the 100 mm line, glue it flat; put what you measured into the TOML")


def _made(
    kind: Any, cols: int, rows: int, spacing_mm: float, marker_mm: float | None, dictionary: str | None
) -> Board:
    coded = kind in ("charuco", "aprilgrid")
    marker = _MARKER_SHARE * spacing_mm if coded and marker_mm is None else marker_mm
    codes = _CODES if kind == "charuco" and dictionary is None else dictionary
    marker_m = None if marker is None else marker / 1000
    return Board.of(kind, cols, rows, spacing_mm / 1000, marker_m=marker_m, dictionary=codes)


def run_check(path: Path, images: dict[str, str | None]) -> None:
    """Every finding on a line; ends with an error where one of them is one."""
    roles: tuple[Role, ...] = ("rgb", "fir")
    sizes = {role: _size_of(spec, role) for role in roles if (spec := images[role]) is not None}
    findings = check_file(path, size_wh=sizes)
    for finding in findings:
        print(f"{finding.severity:<7}  {finding.what}" + (f" ({finding.hint})" if finding.hint else ""))
    wrong = [finding for finding in findings if finding.severity == "error"]
    if wrong:
        raise InputError(f"{len(wrong)} of {len(findings)} checks failed", where=path, hint=wrong[0].what)


def _size_of(spec: str, role: Role) -> tuple[int, int]:
    with closing(open_source(spec, role, fir_colour="luma")) as source:
        return source.read(0).size_wh


def run_convert(
    source: Path,
    out: Path,
    form: str | None,
    size: tuple[int, int] | None,
    names: tuple[str, ...] | None,
    *,
    overwrite: bool,
) -> None:
    if out.is_file():
        refuse_existing(out, overwrite)
    notes = convert(source, out, form, size_wh=size, names=names)
    print(f"{out} written")
    for note in notes:
        print(f"note: {note}")
