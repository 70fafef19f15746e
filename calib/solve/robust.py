"""How much noise there is, which points are outliers, which views are unlike the others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib.solve.blocks import Block, by_part
from fusion.geometry import Floats

Mask = NDArray[np.bool_]

_NORMAL_MAD = 1.4826  # standard deviations in a median absolute deviation of normal noise
_CAUCHY = 2.385  # 95 % efficient on normal noise
_OUTLIER = 5.0  # of normal points in an image, four in a million lie farther out
_MIN_POINTS, _MIN_SHARE = 4, 0.5
_VIEW_RATIO, _VIEW_MADS, _MIN_VIEWS = 2.5, 6.0, 4
# Noise is never believed to be less: no corner, no laser is better, and nothing is divided by nothing.
_HARMLESS = {
    "px": 0.1,
    "plane": 0.005,
    "edge": 0.01,
}  # errors for which no view goes, however good the others are
FLOOR = {"px": 1e-6, "plane": 1e-6, "edge": 1e-6}


def size(r: Floats) -> Floats:
    """(N,) lengths of residuals (N, K), inf where they are not finite."""
    length = np.sqrt((r * r).sum(1))
    return np.where(np.isfinite(length), length, np.inf)


def scale(block: Block, r: Floats) -> float:
    """The noise of one coordinate from the median of the absolute residuals: half of them may be outliers."""
    values, least = np.abs(r[known(r)]), FLOOR[block.kind]
    return max(_NORMAL_MAD * float(np.median(values)), least) if values.size else least


def cauchy(block: Block, r: Floats) -> Floats:
    """(N,) weights 1 / variance, less the farther out: the loss log(1 + (r / c)^2) re-weighted."""
    sigma = scale(block, r)
    return 1 / (1 + (size(r) / (_CAUCHY * sigma)) ** 2) / sigma**2


def known(r: Floats) -> Mask:
    """(N,) which points could be seen at all."""
    return np.isfinite(size(r))


def inliers(block: Block, r: Floats) -> Mask:
    """(N,) which points are within five of the robust standard deviations."""
    return size(r) <= _OUTLIER * max(scale(block, r), 10 * FLOOR[block.kind])


def poor_parts(block: Block, r: Floats, used: Mask) -> dict[int, str]:
    """The numbers of views that should go, and why: too few points left, or far above the others'."""
    few = {
        i: _few(block, r[part], used[part])
        for i, part in enumerate(block.parts)
        if used[part].sum() < _MIN_SHARE * (part.stop - part.start)
    }
    few |= starved(block, r, used)
    # By medians: what is left of a blurred view without its outliers looks like the others.
    error = {i: float(np.median(x)) for i, x in enumerate(by_part(block, size(r))) if x.size and i not in few}
    if len(error) < _MIN_VIEWS:
        return few
    values = np.array(list(error.values()))
    middle = max(float(np.median(values)), 10 * FLOOR[block.kind])
    spread = _NORMAL_MAD * float(np.median(np.abs(values - middle)))
    limit = max(_VIEW_RATIO * middle, middle + _VIEW_MADS * spread, _HARMLESS[block.kind])
    return few | {
        i: f"half its points are off by more than {value:.2g} {_unit(block)}; in the others {middle:.2g}"
        for i, value in error.items()
        if value > limit
    }


def starved(block: Block, r: Floats, used: Mask) -> dict[int, str]:
    """The numbers of a camera's views that have too few points for a pose, and that in words."""
    views = list(zip(by_part(block, r), by_part(block, used), strict=True)) if block.kind == "px" else []
    return {i: _few(block, x, u) for i, (x, u) in enumerate(views) if u.sum() < _MIN_POINTS}


def _few(block: Block, r: Floats, used: Mask) -> str:
    off = f"half are off by more than {float(np.median(size(r))):.2g} {_unit(block)}"
    return f"{int(used.sum())} of {len(used)} points fit the others' solution, {off}"


def _unit(block: Block) -> str:
    return "px" if block.kind == "px" else "m"
