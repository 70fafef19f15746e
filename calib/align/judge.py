"""Whether a registration may be used. It tells success from failure, never how large the error is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.align.channels import Doubles
from calib.align.models import Matches, corner_gap, robust_fit

LEAST_SCORE = 0.30  # masked feature correlation
LARGEST_GAP = 0.009  # forward-backward, of the width
_LARGEST_OWN_GAP = 0.04  # of the width: a single frame's own map from that of all
_LEAST_SHARE = 0.5  # of the median score of all frames


@dataclass(frozen=True, slots=True)
class FrameResult:
    """One frame's masked feature correlation under the map of all, and how far its own map is from that.

    `gap_px` is the mean at the thermal image's corners, in RGB pixels, infinite where the frame alone
    gives no map. `outlier` says why the frame does not fit the others; empty where it does.
    """

    name: str
    score: float
    gap_px: float
    outlier: str


def verdict(score: float, gap_share: float) -> str:
    """Why a registration is refused; empty where it is accepted. NaN is refused."""
    reasons = []
    if not score >= LEAST_SCORE:
        reasons.append(f"the edges agree too little: correlation {score:.2f}, wanted {LEAST_SCORE:.2f}")
    if not gap_share <= LARGEST_GAP:
        reasons.append(
            f"thermal to RGB and RGB to thermal differ by {gap_share:.1%}"
            f" of the width, allowed {LARGEST_GAP:.1%}"
        )
    return "; ".join(reasons)


def judged_frames(
    names: Sequence[str],
    scores: Sequence[float],
    matches: Sequence[Matches],
    H: Doubles,
    fir_shape: tuple[int, int],
    tolerance_px: float,
    width_px: float,
) -> list[FrameResult]:
    """Every frame beside the map of all, in the pixels of the matches."""
    middle = float(np.median(scores))
    results = []
    for name, score, own in zip(names, scores, matches, strict=True):
        gap = _own_gap(own, H, fir_shape, tolerance_px)
        results.append(FrameResult(name, score, gap, _outlier(score, middle, gap / width_px, len(names))))
    return results


def _own_gap(own: Matches, H: Doubles, fir_shape: tuple[int, int], tolerance_px: float) -> float:
    try:
        return corner_gap(robust_fit(own, "similarity", tolerance_px), H, fir_shape)
    except ValueError:
        return float("inf")


def _outlier(score: float, middle: float, gap_share: float, count: int) -> str:
    if count < 2:
        return ""
    if score < _LEAST_SHARE * middle:
        return f"correlation {score:.2f} where the middle frame has {middle:.2f}"
    if gap_share > _LARGEST_OWN_GAP:
        return f"alone it lies {gap_share:.1%} of the width elsewhere"
    return ""
