"""Errors of a depth map as KITTI's depth completion benchmark defines them, in float64."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Score:
    """Errors over the `count` pixels that have both truth and a value; NaN where there is none.

    Root mean square and mean absolute error of the depth in millimetres, and of its inverse in 1/km.
    `coverage` is the share, in [0, 1], of the pixels with truth that have a value.
    """

    rmse_mm: float
    mae_mm: float
    irmse_1_km: float
    imae_1_km: float
    coverage: float
    count: int


def score(
    depth_m: NDArray[np.floating], truth_m: NDArray[np.floating], *, fill_missing: bool = False
) -> Score:
    """Errors of `depth_m` against `truth_m`, both H x W along the camera's axis in metres, 0 or NaN: none.

    Uhrig et al. 2017 (Sparsity Invariant CNNs), as KITTI's evaluation counts: over pixels with truth only.
    That evaluation leaves no pixel out: it fills those without a value from their row (`fill_missing`, see
    `fill_background`). The default scores what was predicted and tells the rest by `coverage`, which is
    that of the map as given in either case. Raises `ValueError` for unequal shapes.
    """
    if depth_m.shape != truth_m.shape or depth_m.ndim != 2:
        raise ValueError(f"expected two maps of one shape, got {depth_m.shape} and {truth_m.shape}")
    known, given = _valid(truth_m), _valid(depth_m)
    coverage = np.count_nonzero(known & given) / max(np.count_nonzero(known), 1)
    if fill_missing:
        depth_m = fill_background(depth_m)
        given = _valid(depth_m)
    both = known & given
    depth, truth = depth_m[both].astype(np.float64), truth_m[both].astype(np.float64)
    errors = (*_errors(1000 * depth, 1000 * truth), *_errors(1000 / depth, 1000 / truth))
    return Score(*errors, float(coverage), int(both.sum()))


def mean_score(scores: Sequence[Score]) -> Score:
    """The mean over images, each counting alike, as the benchmark ranks; `count` is the sum.

    Images without a common pixel have no errors and count in `coverage` only. Raises `ValueError` for none.
    """
    if not scores:
        raise ValueError("expected at least one score")
    rows = np.array([[s.rmse_mm, s.mae_mm, s.irmse_1_km, s.imae_1_km] for s in scores if s.count])
    errors = rows.mean(0) if len(rows) else np.full(4, np.nan)
    rmse, mae, irmse, imae = (float(e) for e in errors)
    coverage = float(np.mean([s.coverage for s in scores]))
    return Score(rmse, mae, irmse, imae, coverage, sum(s.count for s in scores))


def fill_background(depth_m: NDArray[np.floating]) -> NDArray[np.float32]:
    """Every hole filled as KITTI's evaluation does before it scores.

    Along its row a hole takes the lesser of the depths at its two ends, or the one there is at the picture's
    side; rows without any depth then take that of the next row with one (above first). A map without any
    depth stays empty.
    """
    depth = np.where(_valid(depth_m), depth_m, 0).astype(np.float32)
    rows = np.flatnonzero((depth > 0).any(1))
    if not rows.size:
        return depth
    full = depth[rows]
    before, after = _carried(full), _carried(full[:, ::-1])[:, ::-1]
    ends = np.where((before > 0) & (after > 0), np.minimum(before, after), before + after)
    below = np.searchsorted(rows, np.arange(len(depth)), "right") - 1
    return np.where(full > 0, full, ends)[np.maximum(below, 0)]


def _carried(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """The last depth seen on the way along each row, 0 before the first."""
    last = np.maximum.accumulate(np.where(depth > 0, np.arange(depth.shape[1]), 0), axis=1)
    return np.take_along_axis(depth, last, 1)


def _valid(values_m: NDArray[np.floating]) -> NDArray[np.bool_]:
    return np.isfinite(values_m) & (values_m > 0)


def _errors(values: NDArray[np.float64], truth: NDArray[np.float64]) -> tuple[float, float]:
    if not values.size:
        return float("nan"), float("nan")
    error = np.abs(values - truth)
    return float(np.sqrt(np.mean(error**2))), float(np.mean(error))
