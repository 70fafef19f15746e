"""One picture an image: what a detector tried, step by step, and what came of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.boards import Board
from calib.detect.find import grey
from calib.detect.trace import Trace
from calib.observations import Detection, Refusal

Picture = NDArray[np.uint8]

_TILE_WH = 640, 480
_TEXT_PX = 16
_INK, _PAPER = (235, 235, 235), (30, 30, 30)
_GREEN, _RED, _YELLOW = (80, 220, 80), (80, 80, 255), (60, 220, 255)


def debug_picture(
    image: NDArray[Any], result: Detection | Refusal, trace: Trace, title: str, board: Board | None = None
) -> Picture:
    """BGR uint8: the steps of `trace` side by side, then the points found, or why there are none.

    With `board` the points are joined along its rows. Nothing given is changed.
    """
    tiles = [_tile(step, pixels, points) for step, pixels, points in trace.steps]
    tiles.append(_verdict(image, result, board))
    columns = min(len(tiles), 3)
    rows = [_row(tiles[k : k + columns], columns) for k in range(0, len(tiles), columns)]
    return np.vstack([_line(title, columns * _TILE_WH[0], _INK), *rows])


def _row(tiles: list[Picture], columns: int) -> Picture:
    """Tiles beside each other, aligned at their lower edges, with nothing where there are too few."""
    high = max(len(tile) for tile in tiles)
    row = np.full((high, columns * _TILE_WH[0], 3), _PAPER[0], np.uint8)
    for k, tile in enumerate(tiles):
        row[high - len(tile) :, k * _TILE_WH[0] : (k + 1) * _TILE_WH[0]] = tile
    return row


def _tile(title: str, pixels: Picture, points: NDArray[np.float64] | None) -> Picture:
    import cv2

    canvas, scale = _fitted(pixels)
    for x, y in [] if points is None else (points + 0.5) * scale - 0.5:
        cv2.circle(canvas, (round(x * 16), round(y * 16)), 48, _YELLOW, 1, cv2.LINE_AA, 4)
    count = "" if points is None else f": {len(points)}"
    return np.vstack([_line(title + count, _TILE_WH[0], _INK), canvas])


def _verdict(image: NDArray[Any], result: Detection | Refusal, board: Board | None) -> Picture:
    canvas, scale = _fitted(_stretched(image))
    if isinstance(result, Refusal):
        return np.vstack([_line(f"no board: {result.reason}", _TILE_WH[0], _RED), canvas])
    _draw_found(canvas, result, (result.uv + 0.5) * scale - 0.5, board)
    of = "" if board is None else f" of {int(board.visible.sum())}"
    text = "; ".join((f"{len(result.ids)}{of} points, {result.method}", *result.notes))
    return np.vstack([_line(text, _TILE_WH[0], _GREEN), canvas])


def _draw_found(canvas: Picture, found: Detection, uv: NDArray[np.float64], board: Board | None) -> None:
    import cv2

    at = {int(k): (round(x * 16), round(y * 16)) for k, (x, y) in zip(found.ids, uv, strict=True)}
    wide = board.grid_wh[0] if board is not None else 0
    for k, point in at.items():
        if wide and (k + 1) % wide and k + 1 in at:
            cv2.line(canvas, point, at[k + 1], _GREEN, 1, cv2.LINE_AA, 4)
        cv2.circle(canvas, point, 48, _RED if k == min(at) else _YELLOW, 1, cv2.LINE_AA, 4)
    for k, (x, y) in at.items():
        if not wide or k % wide in (0, wide - 1):
            where = x // 16 + 4, y // 16 - 4
            cv2.putText(canvas, str(k), where, cv2.FONT_HERSHEY_SIMPLEX, 0.4, _YELLOW, 1, cv2.LINE_AA)


def _stretched(image: NDArray[Any]) -> Picture:
    """8 bit, whatever it was."""
    if image.dtype == np.uint8:
        return np.asarray(image, np.uint8)
    gray = grey(image).astype(np.float64)
    low, high = np.percentile(gray, (0.5, 99.5))
    return np.clip((gray - low) / max(high - low, 1.0) * 255, 0, 255).astype(np.uint8)


def _fitted(pixels: Picture) -> tuple[Picture, float]:
    """The picture in the middle of nothing, at the largest size that fits a tile; and its scale."""
    import cv2

    height, width = pixels.shape[:2]
    scale = min(_TILE_WH[0] / width, _TILE_WH[1] / height)
    size = max(1, int(width * scale)), max(1, int(height * scale))
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    canvas = np.full((_TILE_WH[1], _TILE_WH[0], 3), _PAPER[0], np.uint8)
    canvas[: size[1], : size[0]] = small if small.ndim == 3 else small[..., None]
    return canvas, scale


def _line(text: str, width: int, colour: tuple[int, int, int]) -> Picture:
    """A line of text, broken where it is too long for the width."""
    import cv2

    room = width // 8
    parts = [text[k : k + room] for k in range(0, len(text), room)] or [""]
    strip = np.full((_TEXT_PX * len(parts) + 6, width, 3), _PAPER[0], np.uint8)
    for k, part in enumerate(parts):
        plain = part.encode("ascii", "replace").decode()
        cv2.putText(
            strip, plain, (4, _TEXT_PX * (k + 1)), cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, 1, cv2.LINE_AA
        )
    return strip
