"""Boards with codes: ChArUco and AprilTag grids, of either polarity.

OpenCV reads the first codes, in several preparations of the image. They give a homography; from there the
board is laid over the image and grown: corners are fitted where they must be, and a code counts where the
image correlates with its cells. So a board is found whole where OpenCV reads a few of its codes only, as in
noisy or blurred thermal images, and a code that was read wrongly contradicts the others and drops out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.boards import Board
from calib.codes import APRILGRID_BORDER, CHARUCO_BORDER, Code, board_codes
from calib.detect.known import Known
from calib.detect.saddles import Image, fit_corners, look_up, normalised
from calib.detect.trace import SILENT, Trace
from calib.observations import Detection, Refusal
from fusion.geometry import Floats

# The image for OpenCV: background's sigma (px), enlargement, blur (px), threshold's constant and window.
_TRIES = ((12.0, 1, 0.0, 40, 21), (25.0, 3, 0.7, 25, 51), (12.0, 2, 0.0, 40, 51))
_LEAST_CODES = 2
_UNCONTRADICTED = 0.6  # share of the codes that were read that must be where the board has them
_ENOUGH = 4  # codes after which OpenCV is asked no further
_AGREES = 0.6  # correlation of a code's cells with the image
_ROUNDS = 20
_REACH = 1.6  # how far from known corners others are looked for, in fields
_ADRIFT = 0.15  # how far a fitted corner may lie off its prediction, of a field
_RADIUS_PX = 2.5, 8.0

Read = dict[int, Floats]  # a code's corners, 4 x 2 px


def find_coded(gray: NDArray[Any], board: Board, trace: Trace = SILENT) -> Detection | Refusal:
    """Find a ChArUco board or an AprilTag grid in H x W uint8 or uint16.

    The corners are those beside codes that were recognised, to sub-pixels. A charuco board of OpenCV's older
    layout (before 4.6, an even number of rows) is recognised and noted.
    """
    flat = normalised(gray, 15.0)
    trace.add("local normalisation", flat)
    layouts = [False, True] if board.kind == "charuco" and board.rows % 2 == 0 else [False]
    codes = [{code.number: code for code in board_codes(board, legacy=legacy)} for legacy in layouts]
    least = min(_LEAST_CODES, len(codes[0]))
    best: _Layer | None = None
    for read in _readings(gray, board, trace):
        layers = [_Layer(flat, board, layout, read) for layout in codes]
        best = max(layers if best is None else [*layers, best], key=_Layer.worth)
        if len(best.agreeing) >= max(least, _ENOUGH):
            break
    if best is None or not best.read:
        return Refusal(f"no code of {board.dictionary} is readable")
    if len(best.agreeing) < max(least, _UNCONTRADICTED * len(best.read)) or len(best.ids) < 4:
        return Refusal(
            f"codes read: {sorted(best.read)}, but only {len(best.agreeing)} where the board has them"
        )
    notes = (f"{len(best.agreeing)} of {len(codes[0])} codes",)
    if len(layouts) > 1 and best.codes is codes[1]:
        notes += ("OpenCV's older layout",)
    return Detection(best.ids, best.uv, f"codes ({board.kind})", notes)


def _readings(gray: NDArray[Any], board: Board, trace: Trace) -> Iterator[Read]:
    """Codes that OpenCV reads, for each preparation and polarity; what was read in one stays in the later."""
    read: dict[bool, Read] = {False: {}, True: {}}
    for sigma, enlarged, blur, constant, window in _TRIES:
        shown = _shown(gray, sigma, enlarged, blur)
        for inverted in (False, True):
            new = _opencv(255 - shown if inverted else shown, board, constant, window)
            new = {number: (corners + 0.5) / enlarged - 0.5 for number, corners in new.items()}
            if not new:
                continue
            read[inverted] = new | read[inverted]
            corners = np.concatenate([(corners + 0.5) * enlarged - 0.5 for corners in new.values()])
            trace.add(f"{len(new)} codes, {enlarged}x{', inverted' if inverted else ''}", shown, corners)
            yield dict(read[inverted])
    if trace.wanted and not any(read.values()):
        trace.add("no code in any preparation", _shown(gray, *_TRIES[0][:3]))


def _shown(gray: NDArray[Any], sigma: float, enlarged: int, blur: float) -> NDArray[np.uint8]:
    flat = normalised(gray, sigma)
    if blur:
        flat = cv2.GaussianBlur(flat, (0, 0), blur)
    if enlarged > 1:
        flat = cv2.resize(flat, None, fx=enlarged, fy=enlarged, interpolation=cv2.INTER_CUBIC)
    return np.clip(flat * 60 + 128, 0, 255).astype(np.uint8)


def _opencv(shown: NDArray[np.uint8], board: Board, constant: int, window: int) -> Read:
    """A low threshold on a wide window keeps tags apart that touch at their corners."""
    options = cv2.aruco.DetectorParameters()
    options.markerBorderBits = APRILGRID_BORDER if board.kind == "aprilgrid" else CHARUCO_BORDER
    options.adaptiveThreshWinSizeMin = options.adaptiveThreshWinSizeMax = window
    options.adaptiveThreshConstant = constant
    options.minMarkerPerimeterRate = 0.02
    options.minMarkerDistanceRate = 0.02
    options.perspectiveRemovePixelPerCell = 6
    options.perspectiveRemoveIgnoredMarginPerCell = 0.2
    codes = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary or ""))
    corners, numbers, _ = cv2.aruco.ArucoDetector(codes, options).detectMarkers(shown)
    if numbers is None:
        return {}
    found = zip(np.ravel(numbers).tolist(), corners, strict=True)
    return {int(number): np.asarray(four, np.float64).reshape(4, 2) for number, four in found}


class _Layer:
    """The board laid over the image from the codes that were read: corners `ids`, `uv`; `agreeing` codes."""

    def __init__(self, flat: Image, board: Board, codes: Mapping[int, Code], read: Read) -> None:
        self.codes = codes
        self.read = {number: corners for number, corners in read.items() if number in codes}
        self.ids, self.uv = np.zeros(0, np.intp), np.zeros((0, 2))
        self.agreeing: list[int] = []
        self._flat, self._board = flat, board
        self._smooth = np.asarray(cv2.GaussianBlur(flat, (0, 0), 1.0), np.float32)
        self._beside = _beside(board, codes)
        if self.read:
            self._grow()

    def worth(self) -> tuple[int, int]:
        """A wrong layout may have as many corners, but never as many codes."""
        return len(self.agreeing), len(self.ids)

    def _grow(self) -> None:
        xy = np.concatenate([self.codes[number].corners_m() for number in self.read])
        known = Known.of(xy, np.concatenate(list(self.read.values())), robust=len(self.read) > 1)
        for _ in range(_ROUNDS):
            if known is None:
                return
            before = self.ids
            self._look(known)
            if len(self.ids) < 4 or len(self.agreeing) < min(_LEAST_CODES, len(self.codes)):
                return
            known = Known.of(self._board.points_m[self.ids, :2], self.uv, robust=False)
            if np.array_equal(before, self.ids):
                return

    def _look(self, known: Known) -> None:
        """Recognise codes and fit corners, as far as the known ones reach."""
        self.agreeing = self._recognised(known)
        beside = self._beside[:, [list(self.codes).index(number) for number in self.agreeing]].any(1)
        ids = np.flatnonzero(beside & self._board.visible)
        points, field = self._board.points_m[ids, :2], self._board.spacing_m
        guess, _ = known.predict(points)
        step = 0.05 * field
        right, down = (known.predict(points + step * axis)[0] - guess for axis in np.eye(2))
        field_px = np.minimum(np.hypot(*right.T), np.hypot(*down.T)) * field / step
        along = np.stack([np.arctan2(side[:, 1], side[:, 0]) for side in (right, down)], 1)
        radius = np.clip(field_px * self._free(), *_RADIUS_PX)
        uv, _ = fit_corners(self._flat, guess, along, radius)  # NaN where there is no corner
        h, w = self._flat.shape
        inside = ((uv > 0.5) & (uv < (w - 1.5, h - 1.5))).all(1)
        good = inside & (np.hypot(*(uv - guess).T) < _ADRIFT * field_px + 0.5)
        self.ids, self.uv = ids[good], uv[good]

    def _recognised(self, known: Known) -> list[int]:
        """Codes that are within reach, inside the image, and look as they must."""
        score: dict[int, float] = {}
        h, w = self._flat.shape
        for number, code in self.codes.items():
            uv, gap = known.predict(code.cells_m())
            if gap.min() > _REACH * self._board.spacing_m or not ((uv >= 0) & (uv <= (w - 1, h - 1))).all():
                continue
            score[number] = _correlation(look_up(self._smooth, uv), code.white)
        sign = np.sign(sum(value for value in score.values() if abs(value) > _AGREES))
        return [number for number, value in score.items() if value * sign > _AGREES]

    def _free(self) -> float:
        """How much of a field round a corner shows nothing but its four quarters."""
        marker = (self._board.marker_m or 0) / self._board.spacing_m
        return max(0.8 * (1 - marker) / (2 if self._board.kind == "charuco" else 1), 0.1)


def _beside(board: Board, codes: Mapping[int, Code]) -> NDArray[np.bool_]:
    """Points x codes: whether the point belongs to the code's square or field."""
    half = np.array([code.side_m / 2 for code in codes.values()])
    middle = np.array([(code.left_m, code.top_m) for code in codes.values()]) + half[:, None]
    away = np.abs(board.points_m[:, None, :2] - middle[None]).max(2)
    return away < (0.55 * board.spacing_m if board.kind == "charuco" else 1.05 * half[None])


def _correlation(value: Floats, white: NDArray[np.bool_]) -> float:
    one, two = value - value.mean(), white.ravel() - white.mean()
    return float(one @ two / max(np.linalg.norm(one) * np.linalg.norm(two), 1e-12))
