"""`fusion calibrate board | check | convert`: work on files, without any solving."""

from __future__ import annotations

from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from calib.boards import Board, load_board, save_board
from calib.checking import check_file
from calib.formats import convert
from calib.printing import board_pdf, board_svg
from fusion.cli.running import refuse_existing
from fusion.errors import FusionError, InputError, UsageError
from fusion.files import replace_file
from fusion.sources import open_source
from fusion.sources.base import Role

_MARKER_SHARE = 0.75
_CODES = "DICT_5X5_100"


@dataclass(frozen=True, slots=True)
class Made:
    """A board as options describe it; None where they do not say."""

    kind: Any
    cols: int | None
    rows: int | None
    spacing_mm: float | None
    marker_mm: float | None
    dictionary: str | None

    def board(self) -> Board:
        kind = self.kind or "chessboard"
        coded = kind in ("charuco", "aprilgrid")
        spacing = 30.0 if self.spacing_mm is None else self.spacing_mm
        marker = _MARKER_SHARE * spacing if coded and self.marker_mm is None else self.marker_mm
        codes = _CODES if kind == "charuco" and self.dictionary is None else self.dictionary
        cols, rows = 9 if self.cols is None else self.cols, 6 if self.rows is None else self.rows
        marker_m = None if marker is None else marker / 1000
        return Board.of(kind, cols, rows, spacing / 1000, marker_m=marker_m, dictionary=codes)


def run_board(out: Path, board: Path | None, made: Made, *, overwrite: bool) -> None:
    if out.suffix.lower() not in (".pdf", ".svg"):
        raise UsageError(f"{out.name} is neither .pdf nor .svg", where="OUT")
    described = out.with_suffix(".toml")
    refuse_existing(out, overwrite)
    told = [f"--{name.replace('_', '-')}" for name, value in asdict(made).items() if value is not None]
    if board is not None and told:
        what = f"the board's file says it already: {', '.join(told)}"
        raise UsageError(what, where="--board", hint="leave one out")
    printed = made.board() if board is None else load_board(board)
    data = board_pdf(printed) if out.suffix.lower() == ".pdf" else board_svg(printed).encode()
    if board is None or described.resolve() != board.resolve():
        refuse_existing(described, overwrite)
        save_board(described, printed)
    replace_file(out, data)
    print(f"{printed}: {out} and {described}")
    print("print at 100 %, measure the 100 mm line, glue it flat; put what you measured into the TOML")


def run_check(path: Path, images: dict[str, str | None]) -> None:
    """Every finding on a line; ends with an error where one of them is one."""
    roles: tuple[Role, ...] = ("rgb", "fir")
    sizes = {role: _size_of(spec, role) for role in roles if (spec := images[role]) is not None}
    findings = check_file(path, size_wh=sizes)
    for finding in findings:
        print(f"{finding.severity:<7}  {finding.what}" + (f" ({finding.hint})" if finding.hint else ""))
    wrong = [finding for finding in findings if finding.severity == "error"]
    if wrong:
        what = "an error" if len(wrong) == 1 else f"{len(wrong)} errors, the first"
        raise InputError(f"{what}: {wrong[0].what}", where=path, hint=wrong[0].hint)


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
    force: bool,
    overwrite: bool,
) -> None:
    if out.is_dir() and not overwrite:
        _refuse_existing_in(source, out, form, size_wh=size, names=names, force=force)
    elif not out.is_dir():
        refuse_existing(out, overwrite)
    notes = convert(source, out, form, size_wh=size, names=names, force=force)
    print(f"{out} written")
    for note in notes:
        print(f"note: {note}")


def _refuse_existing_in(source: Path, folder: Path, form: str | None, **asked: Any) -> None:
    """The same for forms of several files, whose names the form alone knows."""
    with TemporaryDirectory() as name:
        aside = Path(name) / (folder.resolve().name or "rig")
        aside.mkdir()
        with suppress(FusionError):  # the real run says it, with the real names
            convert(source, aside, form, **asked)
        for path in sorted(aside.iterdir()):
            refuse_existing(folder / path.name, overwrite=False)
