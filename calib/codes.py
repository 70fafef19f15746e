"""The codes on a board: which one lies where, and what its cells look like."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.boards import Board, tag_of
from fusion.geometry import Floats

CHARUCO_BORDER, APRILGRID_BORDER = 1, 2  # black cells round the code


@dataclass(frozen=True, slots=True, eq=False)
class Code:
    """A code: `left_m`, `top_m` of its black square in the board's frame, and its side.

    `white` (n x n bool) are its cells, border and all, as the board shows them. OpenCV's corner k of the code
    lies at the square's corner (k + turn) % 4, counted clockwise from the top left.
    """

    number: int
    left_m: float
    top_m: float
    side_m: float
    white: NDArray[np.bool_]
    turn: int

    def corners_m(self) -> Floats:
        """4 x 2, in OpenCV's order."""
        square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * self.side_m + (self.left_m, self.top_m)
        return np.roll(square, -self.turn, 0)

    def cells_m(self) -> Floats:
        """(n * n) x 2: the cells' centres, row by row."""
        steps = (np.arange(len(self.white)) + 0.5) * self.side_m / len(self.white)
        x, y = np.meshgrid(self.left_m + steps, self.top_m + steps)
        return np.stack([x.ravel(), y.ravel()], 1)


def board_codes(board: Board, *, legacy: bool = False) -> list[Code]:
    """The codes of a coded board, by number; those of hidden tags are left out.

    A charuco board has them in the white fields, row by row; its top left field is black, or, where it is
    `legacy` (OpenCV before 4.6) and has an even number of rows, white. An aprilgrid's tags are Kalibr's,
    which stand on their heads as OpenCV has them. Raises `ValueError` for boards without codes.
    """
    if board.marker_m is None or board.dictionary is None:
        raise ValueError(f"expected a board with codes, got {board}")
    return _charuco(board, legacy) if board.kind == "charuco" else _aprilgrid(board)


def black_fields(board: Board, legacy: bool = False) -> NDArray[np.bool_]:
    """Rows x columns of a charuco board's fields, True where black."""
    white_first = legacy and board.rows % 2 == 0
    return np.indices((board.rows, board.cols)).sum(0) % 2 == int(white_first)


def _charuco(board: Board, legacy: bool) -> list[Code]:
    side, marker = board.spacing_m, board.marker_m or 0.0
    inset = (side - marker) / 2 - side  # the first point is a field away from the pattern's corner
    fields = np.argwhere(~black_fields(board, legacy)).tolist()
    bits = _bits(board.dictionary or "", len(fields), CHARUCO_BORDER)
    return [
        Code(number, j * side + inset, i * side + inset, marker, bits[number], 0)
        for number, (i, j) in enumerate(fields)
    ]


def _aprilgrid(board: Board) -> list[Code]:
    step, marker = board.spacing_m, board.marker_m or 0.0
    visible = board.visible.reshape(board.rows, 2, board.cols, 2).all((1, 3))
    bits = _bits(board.dictionary or "", board.rows * board.cols, APRILGRID_BORDER)
    codes = [
        Code(number := tag_of(board, j, i), j * step, i * step, marker, np.rot90(bits[number], 2), 2)
        for i, j in np.argwhere(visible).tolist()
    ]
    return sorted(codes, key=lambda code: code.number)


def _bits(dictionary: str, count: int, border: int) -> list[NDArray[np.bool_]]:
    import cv2

    codes = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    cells = codes.markerSize + 2 * border
    return [cv2.aruco.generateImageMarker(codes, k, cells, borderBits=border) > 0 for k in range(count)]
