"""A contact sheet like the thesis's figures 6.1 and 6.2: what each step makes of a few frames."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.errors import FrameError, InputError
from fusion.fusing import Stages
from fusion.kernels import index_counts
from fusion.pipeline import Fuser
from fusion.report.depth_picture import REGULAR

PANEL_WIDTH, CAPTION_HEIGHT, GAP = 320, 26, 4
TITLES = ("RGB", "thermal, full range", "thermal on RGB", "window and colour", "fused")
INK, PAPER = (32, 32, 32), 255


def contact_sheet(fuser: Fuser, frames: int = 5) -> NDArray[np.uint8]:
    """BGR uint8 picture: a row for each of up to `frames` pairs spread over the sequence, a column a step.

    Unusable pairs are passed over; raises `InputError` when none of those looked at is usable.
    """
    rows: list[NDArray[np.uint8]] = []
    count = min(frames, len(fuser))
    for index in sorted({(2 * k + 1) * len(fuser) // (2 * count) for k in range(count)}):
        try:
            rows.append(_row(fuser.stages(index)))
        except FrameError:
            continue
    if not rows:
        raise InputError("none of the frames for the preview can be read")
    sheet = np.vstack([_captions(TITLES), *rows])
    return np.ascontiguousarray(sheet)


def panels(stages: Stages) -> dict[str, NDArray[np.uint8]]:
    """The pictures of one frame by title (BGR uint8, each on its own grid), in the order of the steps."""
    bgr, counts = stages.frames.bgr, stages.frames.counts
    inside = stages.mask[..., None] > 0
    grey = cv2.cvtColor(_full_range(counts), cv2.COLOR_GRAY2BGR)
    onto_rgb = cv2.addWeighted(bgr, 0.5, cv2.cvtColor(stages.warped, cv2.COLOR_GRAY2BGR), 0.5, 0)
    pictures = (
        bgr,
        grey,
        np.where(inside, onto_rgb, bgr),
        np.where(inside, stages.overlay_bgr, np.uint8(PAPER)),
        stages.fused.bgr,
    )
    return {title: np.asarray(picture, np.uint8) for title, picture in zip(TITLES, pictures, strict=True)}


def _row(stages: Stages) -> NDArray[np.uint8]:
    pictures = [_fitted(picture) for picture in panels(stages).values()]
    height = max(picture.shape[0] for picture in pictures)
    padded = [_padded(picture, height) for picture in pictures]
    window = stages.fused.window
    clipped = f"clipped {stages.fused.clipped_below:.0%} below, {stages.fused.clipped_above:.0%} above"
    text = f"{stages.fused.stem}    window {window.lo:g} to {window.hi:g} counts, {clipped}"
    return np.vstack([np.hstack(padded), _captions((text,), width=len(padded) * (PANEL_WIDTH + GAP))])


def _full_range(counts: NDArray[np.uint8] | NDArray[np.uint16]) -> NDArray[np.uint8]:
    lo, hi = int(counts.min()), int(counts.max())
    return index_counts(counts, lo, max(hi, lo + 1))[0]


def _fitted(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height = max(1, round(picture.shape[0] * PANEL_WIDTH / picture.shape[1]))
    way = cv2.INTER_AREA if picture.shape[1] > PANEL_WIDTH else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(picture, (PANEL_WIDTH, height), interpolation=way), np.uint8)


def _padded(picture: NDArray[np.uint8], height: int) -> NDArray[np.uint8]:
    bottom = height - picture.shape[0]
    return np.pad(picture, ((0, bottom), (0, GAP), (0, 0)), constant_values=PAPER)


def _captions(texts: Sequence[str], width: int = PANEL_WIDTH + GAP) -> NDArray[np.uint8]:
    strip = np.full((CAPTION_HEIGHT, width * len(texts), 3), PAPER, np.uint8)
    for column, text in enumerate(texts):
        cv2.putText(strip, text, (column * width + 4, 18), INK, cv2.FontFace("sans"), 14, weight=REGULAR)
    return strip
