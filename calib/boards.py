"""Calibration boards: where their points are, in the board's own frame.

The frame is OpenCV's: origin at the first point, x along a row, y down the rows as the front is seen, z into
the board, away from whoever sees its front. A board is described by a small TOML:

format = "fusion-board/1"
kind = "chessboard"        # charuco, aprilgrid, circles, asymmetric-circles
cols = 11                  # chessboard: inner corners a row; charuco: squares; aprilgrid: tags; circles: circles
rows = 9
spacing_m = 0.0505         # from a corner (circle; aprilgrid: tag) to the next; asymmetric: between rows
hidden = [[3, 2, 5, 5]]    # column, row, columns, rows of points that are covered
plate_m = [-0.1, -0.1, 0.605, 0.504]   # left, top, right, bottom edge of the plate, for a LiDAR
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fusion.geometry import Floats

FORMAT = "fusion-board/1"
Kind = Literal["chessboard", "charuco", "aprilgrid", "circles", "asymmetric-circles"]


@dataclass(frozen=True, slots=True, eq=False)
class Board:
    """A board's geometry.

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

    def symmetries(self) -> tuple[NDArray[np.intp], ...]:
        """Relabellings under which the board looks the same: `ids -> symmetry[ids]`, the identity first.

        Boards without codes turned by half (a square grid of corners: by quarters); which squares are dark does not count,
        for in thermal images it is not known. Coded boards have the identity alone.
        """
        raise NotImplementedError
