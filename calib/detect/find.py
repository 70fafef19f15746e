"""Finding a board in an image: what every kind has in common, then the kind's own detector."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.boards import Board
from calib.detect.trace import SILENT, Trace
from calib.observations import Detection, Refusal
from fusion.errors import FrameError

VERSION = "1"  # of all detectors together: raise it where results change, and caches are made anew
Pixels = NDArray[np.uint8] | NDArray[np.uint16]

_SMALLEST_SIDE_PX = 32
_SATURATED = 0.02  # share of pixels at the top that is worth a word


def find_board(image: NDArray[Any], board: Board, trace: Trace = SILENT) -> Detection | Refusal:
    """Look for `board` in an image: H x W or H x W x 3 BGR, uint8 or uint16, of either polarity.

    Returns the visible points that were found, with their pixels ((0, 0) is the centre of the top-left
    pixel), or why there is no board. Raises `FrameError` for arrays that are no such image.
    """
    gray = grey(image)
    trace.add("image", gray)
    saturated = _saturation(gray)
    if min(gray.shape) < _SMALLEST_SIDE_PX:
        return Refusal(f"too small: {gray.shape[1]}x{gray.shape[0]} px")
    if gray.min() == gray.max():
        return Refusal(f"no contrast: every pixel is {gray.max()}{saturated and f' ({saturated})'}")
    result = _detector(board)(gray, board, trace)
    if not saturated:
        return result
    if isinstance(result, Refusal):
        return Refusal(f"{result.reason}; {saturated}")
    return replace(result, notes=(*result.notes, saturated))


def grey(image: NDArray[Any]) -> Pixels:
    """The image as H x W, its type kept. Raises `FrameError`."""
    import cv2

    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3) or 0 in image.shape:
        raise FrameError(f"no image of 8 or 16 bit: {'x'.join(map(str, image.shape))} {image.dtype}")
    if image.ndim == 2:
        return np.ascontiguousarray(image)
    if image.shape[2] != 3:
        raise FrameError(f"an image of {image.shape[2]} channels", hint="grey or BGR is needed")
    return cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_BGR2GRAY)  # type: ignore[return-value]


def _saturation(gray: Pixels) -> str:
    """In words, where many pixels are at the top of what 8, 10, 12, 14 or 16 bits hold."""
    top = int(gray.max())
    if top not in (255, 1023, 4095, 16383, 65535):
        return ""
    share = float((gray == top).mean())
    return f"saturated: {share:.0%} of pixels at the top ({top})" if share > _SATURATED else ""


def _detector(board: Board) -> Any:
    if board.kind == "chessboard":
        from calib.detect.chessboard import find_chessboard

        return find_chessboard
    if board.coded:
        from calib.detect.coded import find_coded

        return find_coded
    from calib.detect.circles import find_circles

    return find_circles
