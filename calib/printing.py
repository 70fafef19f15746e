"""Boards to print, to true scale: SVG and PDF, every field, circle and code a vector.

Both come from one list of shapes in millimetres, x to the right and y down from the page's top left. Printed
"at 100 %" or "actual size", the ruler below the pattern is 100 mm long: measure it. For a board that is cut
or milled (warm holes), the circles are the holes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from xml.sax.saxutils import escape

import numpy as np

from calib.boards import Board, rectangles
from calib.codes import black_fields, board_codes

CIRCLE = 0.27  # a circle's radius, in distances to the nearest other one
_MM = 1000.0
_MARGIN_MM = 10.0
_FOOT_MM = 14.0  # below the pattern: ruler and caption
_RULER_MM = 100.0
_TEXT_MM = 3.5
_PT_PER_MM = 72 / 25.4
_KAPPA = 0.5522847498  # handle of the cubic that is nearest to a quarter of a circle


@dataclass(frozen=True, slots=True)
class Rect:
    """A filled rectangle, mm: black, or white on black."""

    x: float
    y: float
    w: float
    h: float
    black: bool = True


@dataclass(frozen=True, slots=True)
class Circle:
    """A filled black circle, mm."""

    x: float
    y: float
    r: float


@dataclass(frozen=True, slots=True)
class Text:
    """A line of text, mm: where its base line begins."""

    x: float
    y: float
    text: str


@dataclass(frozen=True, slots=True)
class Page:
    """A page, mm: its size, its shapes in drawing order, and where the board's first point is on it."""

    size_wh_mm: tuple[float, float]
    shapes: tuple[Rect | Circle | Text, ...]
    first_mm: tuple[float, float]


def board_page(board: Board) -> Page:
    """The board on a page of its own size, a margin around it, ruler and caption below.

    The margin is at least one field (circles: one distance) wide, white, as detectors need it. Hidden circles
    and tags are left out; a chessboard's fields are all there, for what hides them lies on top.
    """
    pattern = _PATTERNS[board.kind](board)
    boxes = np.array([_box(shape) for shape in pattern])
    (left, top), (right, bottom) = boxes[:, :2].min(0), boxes[:, 2:].max(0)
    margin = max(_MARGIN_MM, _quiet_mm(board))
    width = max(right - left, _RULER_MM) + 2 * margin
    height = bottom - top + 2 * margin + _FOOT_MM
    dx, dy = (width - (right - left)) / 2 - left, margin - top
    foot = _foot(board, margin, bottom + dy + margin)
    shapes = (*(_moved(shape, dx, dy) for shape in pattern), *foot)
    return Page((float(width), float(height)), shapes, (float(dx), float(dy)))


def board_svg(board: Board) -> str:
    """The board as SVG, in millimetres."""
    page = board_page(board)
    width, height = page.size_wh_mm
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{_n(width)}mm" height="{_n(height)}mm"'
            f' viewBox="0 0 {_n(width)} {_n(height)}">',
            f"<title>{escape(str(board))}</title>",
            f'<rect width="{_n(width)}" height="{_n(height)}" fill="white"/>',
            *(_svg(shape) for shape in page.shapes),
            "</svg>\n",
        ]
    )


def board_pdf(board: Board) -> bytes:
    """The board as a PDF of one page (ISO 32000-1), in true size."""
    page = board_page(board)
    width, height = (side * _PT_PER_MM for side in page.size_wh_mm)
    flip = f"{_n(_PT_PER_MM)} 0 0 {_n(-_PT_PER_MM)} 0 {_n(height)} cm"
    content = "\n".join([flip, *(_pdf(shape) for shape in page.shapes)]).encode("ascii", "replace")
    font = b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>"
    return _pdf_file(
        [
            b"<< /Type /Catalog /Pages 2 0 R >>",
            b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
            f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {_n(width)} {_n(height)}] /Contents 4 0 R"
            " /Resources << /Font << /F1 5 0 R >> >> >>".encode(),
            b"<< /Length %d >>\nstream\n%s\nendstream" % (len(content), content),
            font,
        ]
    )


def _chessboard(board: Board) -> list[Rect | Circle]:
    """Fields all round the corners, the top left one black."""
    side = board.spacing_m * _MM
    fields = np.argwhere(np.indices((board.rows + 1, board.cols + 1)).sum(0) % 2 == 0)
    return [Rect((j - 1) * side, (i - 1) * side, side, side) for i, j in fields.tolist()]


def _circles(board: Board) -> list[Rect | Circle]:
    nearest = board.spacing_m * (np.sqrt(2) if board.kind == "asymmetric-circles" else 1)
    r = CIRCLE * float(nearest) * _MM
    return [Circle(x * _MM, y * _MM, r) for x, y, _ in board.points_m[board.visible].tolist()]


def _charuco(board: Board) -> list[Rect | Circle]:
    side = board.spacing_m * _MM
    fields = np.argwhere(black_fields(board)).tolist()
    return [*(Rect((j - 1) * side, (i - 1) * side, side, side) for i, j in fields), *_codes(board)]


def _aprilgrid(board: Board) -> list[Rect | Circle]:
    """Squares beside the tags make every corner of theirs a saddle."""
    step = board.spacing_m * _MM
    gap = step - (board.marker_m or 0) * _MM
    places = np.ndindex(board.rows + 1, board.cols + 1)
    return [*(Rect(j * step - gap, i * step - gap, gap, gap) for i, j in places), *_codes(board)]


_PATTERNS = {
    "chessboard": _chessboard,
    "circles": _circles,
    "asymmetric-circles": _circles,
    "charuco": _charuco,
    "aprilgrid": _aprilgrid,
}


def _codes(board: Board) -> Iterable[Rect | Circle]:
    """Black squares with white rectangles on them."""
    for code in board_codes(board):
        x, y, side = code.left_m * _MM, code.top_m * _MM, code.side_m * _MM
        cell = side / len(code.white)
        yield Rect(x, y, side, side)
        for j, i, w, h in rectangles(code.white):
            yield Rect(x + j * cell, y + i * cell, w * cell, h * cell, black=False)


def _quiet_mm(board: Board) -> float:
    """The white rim that a detector needs."""
    if board.kind == "aprilgrid":
        return (board.spacing_m - (board.marker_m or 0)) * _MM
    return board.spacing_m * _MM / (2 if board.kind == "chessboard" else 1)


def _foot(board: Board, left: float, top: float) -> Iterable[Rect | Text]:
    tick, line = 3.0, 0.3
    yield Rect(left, top + tick / 2 - line / 2, _RULER_MM, line)
    for x in (left, left + _RULER_MM - line):
        yield Rect(x, top, line, tick)
    marker = f", codes {board.marker_m * _MM:g} mm" if board.marker_m else ""
    name = f", {board.dictionary}" if board.dictionary else ""
    yield Text(left, top + 7.5, "The line is 100 mm long: print at 100 %, then measure")
    yield Text(left, top + 12, f"{board}{marker}{name}")


def _box(shape: Rect | Circle) -> tuple[float, float, float, float]:
    if isinstance(shape, Circle):
        return shape.x - shape.r, shape.y - shape.r, shape.x + shape.r, shape.y + shape.r
    return shape.x, shape.y, shape.x + shape.w, shape.y + shape.h


def _moved(shape: Rect | Circle, dx: float, dy: float) -> Rect | Circle:
    if isinstance(shape, Circle):
        return Circle(shape.x + dx, shape.y + dy, shape.r)
    return Rect(shape.x + dx, shape.y + dy, shape.w, shape.h, shape.black)


def _svg(shape: Rect | Circle | Text) -> str:
    if isinstance(shape, Circle):
        return f'<circle cx="{_n(shape.x)}" cy="{_n(shape.y)}" r="{_n(shape.r)}"/>'
    if isinstance(shape, Text):
        font = f'font-family="Helvetica, Arial, sans-serif" font-size="{_TEXT_MM}"'
        return f'<text x="{_n(shape.x)}" y="{_n(shape.y)}" {font}>{escape(shape.text)}</text>'
    fill = "" if shape.black else ' fill="white"'
    return f'<rect x="{_n(shape.x)}" y="{_n(shape.y)}" width="{_n(shape.w)}" height="{_n(shape.h)}"{fill}/>'


def _pdf(shape: Rect | Circle | Text) -> str:
    if isinstance(shape, Text):
        text = shape.text.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
        return f"0 g BT /F1 {_TEXT_MM} Tf 1 0 0 -1 {_n(shape.x)} {_n(shape.y)} Tm ({text}) Tj ET"
    if isinstance(shape, Rect):
        return f"{int(not shape.black)} g {_n(shape.x)} {_n(shape.y)} {_n(shape.w)} {_n(shape.h)} re f"
    x, y, r, k = shape.x, shape.y, shape.r, shape.r * _KAPPA
    arcs = (
        (x + r, y + k, x + k, y + r, x, y + r),
        (x - k, y + r, x - r, y + k, x - r, y),
        (x - r, y - k, x - k, y - r, x, y - r),
        (x + k, y - r, x + r, y - k, x + r, y),
    )
    curves = " ".join(" ".join(_n(v) for v in arc) + " c" for arc in arcs)
    return f"0 g {_n(x + r)} {_n(y)} m {curves} f"


def _pdf_file(objects: list[bytes]) -> bytes:
    """Numbered objects, and the table of where each begins."""
    out = bytearray(b"%PDF-1.4\n")
    starts = []
    for number, body in enumerate(objects, 1):
        starts.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    out += b"".join(b"%010d 00000 n \n" % start for start in starts)
    out += b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, table)
    return bytes(out)


def _n(value: float) -> str:
    """A length to a tenth of a micrometre: no exponents, which PDF does not know."""
    return f"{value:.4f}".rstrip("0").rstrip(".")
