"""Whether thermal lies on RGB as a manifest claims: edges as they lie against edges moved, in a few pairs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.align.pool import prepared
from calib.align.refine import Frame, scores
from fusion.errors import FusionError

if TYPE_CHECKING:
    from fusion.cli.dataset_checks import Report
    from fusion.manifest import Layout
    from fusion.pairing import Pair

_STEP = 0.02  # of the width, by which thermal is moved to either side, up and down
_STEPS = 3
_STANDS_OUT = 4.0  # deviations of the moved ones above their median, to count as seen
_WIDTH = 160  # pixels of the longer side that are compared


def judge_alignment(layout: Layout, pairs: Sequence[Pair], report: Report) -> None:
    """Compare the edges of thermal and RGB as they lie, and with thermal moved by up to 6 % of the width.

    Where another place fits better, a registered set is wrong; where no place stands out, that is said, and
    proves nothing. The comparison is the masked correlation of orientation channels of `calib.align`.
    """
    try:
        images = _of_one_size(layout, pairs)
        frames, _ = prepared(images, None)
    except FusionError as error:
        report.note("alignment", f"the alignment cannot be judged: {error}")
        return
    moved = {move: _fit(frames, *move) for move in _moves()}
    best = max(moved, key=lambda move: (moved[move], move == (0, 0)))
    values = np.array(list(moved.values()))
    stands_out = (moved[best] - np.median(values)) / max(float(values.std()), 1e-9)
    dx, dy = (100 * _STEP * step for step in best)
    if stands_out < _STANDS_OUT:
        report.note("alignment", f"the alignment cannot be told from the edges of {len(images)} pairs")
    elif best == (0, 0):
        text = f"looks aligned: the edges of {len(images)} pairs fit best where they are"
        report.note("alignment", text)
    else:
        text = (
            f"does not look aligned: thermal fits better moved by {dx:+.0f} % of the width, {dy:+.0f} % down"
        )
        say = report.wrong if layout.manifest.registered else report.note
        say("alignment", text)


def _moves() -> list[tuple[int, int]]:
    steps = range(-_STEPS, _STEPS + 1)
    return [(dx, dy) for dy in steps for dx in steps]


def _fit(frames: Sequence[Frame], dx: int, dy: int) -> float:
    """How well the edges agree with thermal stretched onto RGB and moved by (dx, dy) steps; the mean."""
    rgb, fir = frames[0].rgb.shape, frames[0].fir.shape
    sx, sy = rgb[1] / fir[1], rgb[0] / fir[0]
    step = _STEP * rgb[1]
    H = np.array([[sx, 0, 0.5 * sx - 0.5 + dx * step], [0, sy, 0.5 * sy - 0.5 + dy * step], [0, 0, 1]])
    return float(np.mean(scores(frames, H, _WIDTH)))


def _small(pixels: NDArray) -> NDArray:
    """At most twice what is compared: 49 comparisons of whole images would take long."""
    scale = 2 * _WIDTH / max(pixels.shape[:2])
    return (
        pixels if scale >= 1 else cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    )


def _of_one_size(layout: Layout, pairs: Sequence[Pair]) -> list[tuple[NDArray, NDArray]]:
    """The images of those pairs that have the sizes of the first."""
    rgb, fir = layout.open("rgb"), layout.open("fir", "luma")
    images = [(_small(rgb.read(i).pixels), _small(fir.read(j).pixels)) for i, j, _ in pairs]
    shapes = [(a.shape, b.shape) for a, b in images]
    return [image for image, shape in zip(images, shapes, strict=True) if shape == shapes[0]]
