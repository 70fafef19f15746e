"""Calibration boards: where their points are, in the board's own frame.

The frame is OpenCV's: origin at the first point, x along a row, y down the rows as the front is seen, z into
the board, away from whoever sees its front. A board is described by a small TOML:

format = "fusion-board/1"
kind = "chessboard"        # charuco, aprilgrid, circles, asymmetric-circles
cols = 11                  # chessboard: inner corners a row; charuco: squares; aprilgrid: tags
rows = 9
spacing_m = 0.0505         # from a corner (circle; aprilgrid: tag) to the next; asymmetric: between rows
hidden = [[3, 2, 5, 5]]    # column, row, columns, rows of points that are covered
plate_m = [-0.1, -0.1, 0.605, 0.504]   # left, top, right, bottom edge of the plate, for a LiDAR
marker_m = 0.03            # charuco, aprilgrid: side of a code's black square
dictionary = "DICT_5X5_100"            # charuco: which codes, as OpenCV calls them

Points, row by row from the top left: a chessboard's inner corners (for charuco: of its squares, cols - 1 a
row), the centres of circles, the corners of tags (2 * cols a row, 2 * rows rows). An asymmetric grid's
circle is at x = (2 * column + row % 2) * spacing, y = row * spacing. An aprilgrid is Kalibr's: tags of the
family 36h11 with a border of two bits and black squares at their corners, tag 0 at the bottom left, tag
`cols` above it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
import tomlkit
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, FiniteFloat, ValidationError

from fusion.errors import UsageError
from fusion.files import replace_file
from fusion.geometry import Floats
from fusion.settings import MAX_CONFIG_BYTES, Group, first_problem, read_settings

FORMAT = "fusion-board/1"
Kind = Literal["chessboard", "charuco", "aprilgrid", "circles", "asymmetric-circles"]
Rect = tuple[int, int, int, int]
KINDS: tuple[Kind, ...] = get_args(Kind)
CODED: tuple[Kind, ...] = ("charuco", "aprilgrid")
LARGEST_SIDE = 200  # points, tags or squares a row: far above any real board
_TAGS = 587  # in the family 36h11


@dataclass(frozen=True, slots=True, eq=False)
class Board:
    """A board's geometry; made by `Board.of` or `load_board`.

    `points_m` is N x 3 float64 in the board's frame, row by row, z = 0; a point's row is its id. `visible`
    is N bool: False for points that are covered. `plate_m` is (left, top, right, bottom) of the plate in
    the board's frame, None where it is unknown. `marker_m` is the side of a code's square (charuco,
    aprilgrid), `dictionary` the codes' name.
    """

    kind: Kind
    cols: int
    rows: int
    spacing_m: float
    points_m: Floats
    visible: NDArray[np.bool_]
    plate_m: tuple[float, float, float, float] | None = None
    marker_m: float | None = None
    dictionary: str | None = None

    @classmethod
    def of(
        cls,
        kind: Kind,
        cols: int,
        rows: int,
        spacing_m: float,
        *,
        hidden: ArrayLike = (),
        plate_m: tuple[float, float, float, float] | None = None,
        marker_m: float | None = None,
        dictionary: str | None = None,
    ) -> Board:
        """A board from what one measures on it.

        `hidden` are K rectangles (column, row, columns, rows) of points. For an aprilgrid `spacing_m` is
        from tag to tag, the tag's side and the gap together. Raises `UsageError` where that is no board.
        """
        _check(kind, cols, rows, spacing_m, marker_m)
        dictionary = _dictionary(kind, cols, rows, dictionary)
        points = _points(kind, cols, rows, spacing_m, marker_m or 0.0)
        visible = _visible(grid_size(kind, cols, rows), hidden)
        if plate_m is not None:
            plate_m = _plate(plate_m, points)
        return cls(kind, cols, rows, float(spacing_m), points, visible, plate_m, marker_m, dictionary)

    @property
    def grid_wh(self) -> tuple[int, int]:
        """Points a row, and rows of points."""
        return grid_size(self.kind, self.cols, self.rows)

    @property
    def coded(self) -> bool:
        """Whether every point says by itself which it is."""
        return self.kind in CODED

    def symmetries(self) -> tuple[NDArray[np.intp], ...]:
        """Relabellings under which the board looks the same: `ids -> symmetry[ids]`, the identity first.

        Boards without codes turned by quarters, where the visible points fall on each other; which squares
        are dark does not count, for in thermal images it is not known. A hidden part that is not symmetric
        itself leaves the identity alone, as codes do.
        """
        identity = np.arange(len(self.points_m))
        if self.coded:
            return (identity,)
        turned = (_turned(self.points_m[:, :2], self.visible, quarters) for quarters in (1, 2, 3))
        return (identity, *(ids for ids in turned if ids is not None))

    def __str__(self) -> str:
        """In words: ``chessboard 9x6, 80 mm``."""
        return f"{self.kind} {self.cols}x{self.rows}, {self.spacing_m * 1000:g} mm"


def grid_size(kind: Kind, cols: int, rows: int) -> tuple[int, int]:
    """Points a row and rows of points of a board of `cols` x `rows`."""
    if kind == "charuco":
        return cols - 1, rows - 1
    return (2 * cols, 2 * rows) if kind == "aprilgrid" else (cols, rows)


def tag_of(board: Board, col: int, row: int) -> int:
    """Which tag an aprilgrid has in that column, and row from the top."""
    return (board.rows - 1 - row) * board.cols + col


def _points(kind: Kind, cols: int, rows: int, spacing: float, marker: float) -> Floats:
    wide, high = grid_size(kind, cols, rows)
    i, j = (a.ravel() for a in np.indices((high, wide)))
    if kind == "aprilgrid":
        x, y = j // 2 * spacing + j % 2 * marker, i // 2 * spacing + i % 2 * marker
    else:
        shifted = kind == "asymmetric-circles"
        x, y = (2 * j + i % 2 if shifted else j) * spacing, i * spacing
    return np.stack([x, y, np.zeros(wide * high)], -1).astype(np.float64)


def _visible(grid_wh: tuple[int, int], hidden: ArrayLike) -> NDArray[np.bool_]:
    wide, high = grid_wh
    visible = np.ones((high, wide), np.bool_)
    rects = np.asarray(hidden)
    if rects.size and (rects.ndim != 2 or rects.shape[1] != 4 or not np.issubdtype(rects.dtype, np.integer)):
        raise _wrong(f"hidden must be lists of four whole numbers, not {np.asarray(hidden).tolist()}")
    for col, row, cols, rows in rects.reshape(-1, 4).tolist():
        if min(col, row) < 0 or min(cols, rows) < 1 or col + cols > wide or row + rows > high:
            raise _wrong(f"hidden = {[col, row, cols, rows]} leaves the grid of {wide}x{high} points")
        visible[row : row + rows, col : col + cols] = False
    if visible.sum() < 4:
        raise _wrong(f"{visible.sum()} points are left visible: at least 4 are needed")
    return visible.ravel()


def _check(kind: str, cols: int, rows: int, spacing_m: float, marker_m: float | None) -> None:
    if kind not in KINDS:
        raise _wrong(f"unknown kind {kind!r}", f"known: {', '.join(KINDS)}")
    least = 1 if kind == "aprilgrid" else 2
    if not (least <= cols <= LARGEST_SIDE and least <= rows <= LARGEST_SIDE):
        raise _wrong(f"{cols}x{rows}: columns and rows must be {least} to {LARGEST_SIDE}")
    if not 1e-4 <= spacing_m <= 100:
        raise _wrong(f"a spacing of {spacing_m:g} m", "spacing_m is in metres: 30 mm are 0.03")
    if kind not in CODED:
        if marker_m is not None:
            raise _wrong(f"a {kind} has no marker_m")
    elif marker_m is None or not 0 < marker_m < spacing_m:
        size = "none" if marker_m is None else f"{marker_m:g}"
        raise _wrong(f"marker_m is {size}", f"it must lie between 0 and spacing_m = {spacing_m:g}")


def _dictionary(kind: Kind, cols: int, rows: int, name: str | None) -> str | None:
    if kind == "aprilgrid":
        if name not in (None, "DICT_APRILTAG_36h11"):
            raise _wrong(f"an aprilgrid of {name}", "its tags are of the family DICT_APRILTAG_36h11")
        if cols * rows > _TAGS:
            raise _wrong(f"{cols}x{rows} are more tags than the family 36h11 has ({_TAGS})")
        return "DICT_APRILTAG_36h11"
    if kind == "charuco":
        return _codes_enough(cols * rows // 2, name)
    if name is not None:
        raise _wrong(f"a {kind} has no dictionary")
    return None


def _codes_enough(needed: int, name: str | None) -> str:
    import cv2

    known = [entry for entry in dir(cv2.aruco) if entry.startswith("DICT_")]
    if name not in known:
        raise _wrong(f"unknown dictionary {name!r}", f"known: {', '.join(known)}")
    has = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList)
    if has < needed:
        raise _wrong(f"{name} has {has} codes, the board needs {needed}", "take a larger dictionary")
    return name


def _plate(plate_m: tuple[float, ...], points: Floats) -> tuple[float, float, float, float]:
    left, top, right, bottom = plate_m
    (x0, y0, _), (x1, y1, _) = points.min(0), points.max(0)
    slack = 1e-9
    if not (left <= x0 + slack and top <= y0 + slack and right >= x1 - slack and bottom >= y1 - slack):
        has = f"{x0:g}, {y0:g} to {x1:g}, {y1:g}"
        raise _wrong(
            f"plate_m = {[left, top, right, bottom]} does not hold all points ({has})",
            "plate_m is left, top, right, bottom in metres from the first point: left and top are negative",
        )
    return left, top, right, bottom


def _turned(xy: Floats, visible: NDArray[np.bool_], quarters: int) -> NDArray[np.intp] | None:
    """Where each point comes to lie, or None; hidden points, never seen, take what is left."""
    seen = np.flatnonzero(visible)
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters]
    middle = xy[seen].mean(0)
    turned = (xy[seen] - middle) @ np.array([[c, s], [-s, c]], float) + middle
    away = np.linalg.norm(turned[:, None] - xy[seen][None], axis=2)
    nearest = away.argmin(1)
    step = np.linalg.norm(xy[1] - xy[0])
    if away[np.arange(len(seen)), nearest].max() > 1e-6 * step:
        return None
    ids = np.arange(len(xy))
    ids[seen] = seen[nearest]
    return ids


def _wrong(what: str, hint: str = "") -> UsageError:
    return UsageError(what, where="board", hint=hint)


_Plate = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
_Count = Annotated[int, Field(ge=1)]
_Length = Annotated[float, Field(gt=0)]


class _BoardFile(Group):
    format: Literal["fusion-board/1"]
    kind: Kind
    cols: _Count
    rows: _Count
    spacing_m: _Length
    hidden: tuple[Rect, ...] = ()
    plate_m: _Plate | None = None
    marker_m: _Length | None = None
    dictionary: str | None = None


class _Checkerboard(Group):
    target_type: Literal["checkerboard"]
    targetCols: _Count  # noqa: N815 - Kalibr's names
    targetRows: _Count  # noqa: N815
    rowSpacingMeters: _Length  # noqa: N815
    colSpacingMeters: _Length  # noqa: N815


class _Circlegrid(Group):
    target_type: Literal["circlegrid"]
    targetCols: _Count  # noqa: N815
    targetRows: _Count  # noqa: N815
    spacingMeters: _Length  # noqa: N815
    asymmetricGrid: bool = False  # noqa: N815


class _Aprilgrid(Group):
    target_type: Literal["aprilgrid"]
    tagCols: _Count  # noqa: N815
    tagRows: _Count  # noqa: N815
    tagSize: _Length  # noqa: N815
    tagSpacing: _Length  # noqa: N815


_KALIBR: dict[str, type[_Checkerboard] | type[_Circlegrid] | type[_Aprilgrid]] = {
    "checkerboard": _Checkerboard,
    "circlegrid": _Circlegrid,
    "aprilgrid": _Aprilgrid,
}


def load_board(path: Path | str) -> Board:
    """The board in a file: our TOML, or Kalibr's target YAML, told by the content.

    Of Kalibr's files the geometry is taken, not the numbers of points: theirs count from the bottom left
    with y up, ours from the top left with y down. Raises `UsageError`.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        text = path.read_text(encoding="utf-8") if size <= MAX_CONFIG_BYTES else ""
    except (OSError, UnicodeDecodeError) as error:
        hint = "make one: `fusion calibrate board --help`"
        why = error.strerror if isinstance(error, OSError) else "it is not text"
        raise UsageError(f"no board can be read: {why}", where=path, hint=hint) from None
    try:
        if size <= MAX_CONFIG_BYTES and "target_type" in text and "format" not in _first_line(text):
            return _from_kalibr(_yaml(text, path))
        table = _BoardFile.model_validate(read_settings(path, FORMAT))
        return Board.of(**table.model_dump(exclude={"format"}))
    except ValidationError as error:
        raise UsageError(first_problem(error), where=path) from None
    except UsageError as error:
        raise UsageError(error.what, where=path, hint=error.hint) from None


def save_board(path: Path | str, board: Board) -> None:
    """Write the board as TOML. Raises `OutputError`."""
    replace_file(Path(path), board_toml(board).encode())


def board_toml(board: Board) -> str:
    """The text of `save_board`'s file."""
    table: dict[str, Any] = {"format": FORMAT, "kind": board.kind, "cols": board.cols, "rows": board.rows}
    table["spacing_m"] = board.spacing_m
    wide, high = board.grid_wh
    if rects := rectangles(~board.visible.reshape(high, wide)):
        table["hidden"] = [list(rect) for rect in rects]
    if board.plate_m is not None:
        table["plate_m"] = list(board.plate_m)
    if board.marker_m is not None:
        table |= {"marker_m": board.marker_m, "dictionary": board.dictionary}
    return tomlkit.dumps(table)


def rectangles(mask: NDArray[np.bool_]) -> list[Rect]:
    """Rectangles (column, row, columns, rows) that cover what is True in H x W bool, each place once."""
    left, rects = mask.copy(), list[Rect]()
    while left.any():
        row, col = (int(k) for k in np.argwhere(left)[0])
        cols = int(np.argmin(np.append(left[row, col:], False)))
        rows = int(np.argmin(np.append(left[row:, col : col + cols].all(1), False)))
        left[row : row + rows, col : col + cols] = False
        rects.append((col, row, cols, rows))
    return rects


def _first_line(text: str) -> str:
    lines = (line.strip() for line in text.splitlines())
    return next((line for line in lines if line and not line.startswith("#")), "")


def _yaml(text: str, path: Path) -> Any:
    import yaml

    try:
        return yaml.load(text, yaml.SafeLoader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise UsageError(f"cannot be read as YAML: {error}", where=path) from None


def _from_kalibr(table: Any) -> Board:
    if not isinstance(table, dict) or table.get("target_type") not in _KALIBR:
        found = table.get("target_type") if isinstance(table, dict) else type(table).__name__
        raise UsageError(
            f"no target of Kalibr's: target_type is {found!r}", hint=f"known: {', '.join(_KALIBR)}"
        )
    target = _KALIBR[table["target_type"]].model_validate(table)
    if isinstance(target, _Aprilgrid):
        spacing = target.tagSize * (1 + target.tagSpacing)
        return Board.of("aprilgrid", target.tagCols, target.tagRows, spacing, marker_m=target.tagSize)
    if isinstance(target, _Circlegrid):
        kind: Kind = "asymmetric-circles" if target.asymmetricGrid else "circles"
        return Board.of(kind, target.targetCols, target.targetRows, target.spacingMeters)
    if not np.isclose(target.rowSpacingMeters, target.colSpacingMeters, rtol=1e-9):
        gaps = f"rows {target.rowSpacingMeters:g} m, columns {target.colSpacingMeters:g} m apart"
        raise UsageError(f"fields that are not square: {gaps}", hint="only square fields can be used")
    return Board.of("chessboard", target.targetCols, target.targetRows, target.rowSpacingMeters)
