"""PNG encoders on a fused frame: time and size. That they are lossless is a test's business."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
from content import SXGA, VGA, Case, pairs_of
from table import Row, Section, at_least, milliseconds
from timing import interleaved, repeated

from fusion.codecs import encode_png

FAST = [
    *(cv2.IMWRITE_PNG_COMPRESSION, 1),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY),
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP),
]
TEXT = """\
Encoding one frame in memory on one thread, in ours (`fusion.codecs.encode_png`) and in OpenCV, with its
default settings and with level 1 + `HUFFMAN_ONLY` + `FILTER_UP`. *mask* is 8-bit grey with one edge, which
fpng does not take: it goes through OpenCV in ours too."""


def measure(rounds: int) -> Section:
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        rows = [row for size in (VGA, SXGA) for row in _rows(Case(size, 8), rounds)]
    finally:
        cv2.setNumThreads(before)
    return Section("PNG encoders", TEXT, ("ours", "other"), rows)


def _rows(case: Case, rounds: int) -> list[Row]:
    ((bgr, counts),) = pairs_of(case, 1)
    mask = cv2.threshold(cv2.GaussianBlur(counts, (0, 0), 20), 125, 255, cv2.THRESH_BINARY)[1]
    return [
        row
        for kind, pixels in (("colour", bgr), ("mask", mask))
        for row in _compared(case, kind, pixels, rounds)
    ]


def _compared(case: Case, kind: str, pixels: Any, rounds: int) -> list[Row]:
    ways: dict[str, Callable[[], Any]] = {
        "ours": lambda: encode_png(pixels),
        "OpenCV default": lambda: cv2.imencode(".png", pixels)[1],
        "OpenCV level 1 + HUFFMAN_ONLY + FILTER_UP": lambda: cv2.imencode(".png", pixels, FAST)[1],
    }
    taken = interleaved({name: repeated(way, 3) for name, way in ways.items()}, rounds)
    sizes = {name: len(way()) for name, way in ways.items()}
    shown = {name: f"{milliseconds(taken[name])}, {sizes[name] / 1024:.0f} KiB" for name in ways}
    name = f"{case.size_wh[0]}x{case.size_wh[1]} {kind}"
    return [
        Row(
            f"{name}: {other} / ours",
            shown["ours"],
            shown[other],
            taken[other].over(taken["ours"]),
            at_least(1) if kind == "colour" else None,
        )
        for other in list(ways)[1:]
    ]
