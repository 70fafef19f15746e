"""From samples to a dense map: one table of methods, one meaning of gaps, support and extrapolation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.errors import FrameError, UsageError
from fusion.lidar.project import FARTHEST_M, z_buffer
from fusion.lidar.sparse import DenseDepth, SparseDepth
from fusion.tables import lookup

Extrapolate = Literal["none", "nearest", "linear"]
Scattered = Literal["linear", "natural", "nearest"]
MOST_TRIANGULATED = 4_000_000  # the triangulation takes some hundred bytes a sample
GAP_OF_SPACING = 6.0  # the largest gap, in medians of a pixel's distance to its sample


@dataclass(frozen=True, slots=True)
class Demand:
    """What is asked of a densifier beside its samples.

    A pixel farther than `max_gap_px` from every sample is not interpolated (None: six times the median
    distance of a pixel inside the samples' hull). Values outside `limits_m` are none. `guide_bgr` is
    H x W x 3 uint8, for methods that look at a picture. `threads` never changes a result.
    """

    extrapolate: Extrapolate = "none"
    max_gap_px: float | None = None
    limits_m: tuple[float, float] = (0.0, FARTHEST_M)
    guide_bgr: NDArray[np.uint8] | None = None
    threads: int = 1


Fill = Callable[[SparseDepth, Demand], NDArray[np.float32]]
"""H x W float32 values, 0 or NaN where the method has none; gaps, limits and support are seen to outside."""


def _interpolated(
    method: Scattered, sparse: SparseDepth, demand: Demand
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """MATLAB's scatteredInterpolant (thesis 6.2): in the values themselves, exact positions; and its hull."""
    from fusion.lidar.scattered import interpolate

    if len(sparse) > MOST_TRIANGULATED and (method != "nearest" or demand.extrapolate == "linear"):
        hint = f"at most {MOST_TRIANGULATED:,}: --voxel METRES, or --method plane"
        raise FrameError(f"{len(sparse):,} samples are too many to triangulate", hint=hint)
    return interpolate(
        sparse.u,
        sparse.v,
        sparse.value_m,
        sparse.size_wh,
        method=method,
        extrapolate=demand.extrapolate,
        threads=demand.threads,
    )


def _scattered(method: Scattered) -> Fill:
    return lambda sparse, demand: _interpolated(method, sparse, demand)[0]


def _natural_discrete(sparse: SparseDepth, demand: Demand) -> NDArray[np.float32]:
    from fusion.lidar.discrete import natural_discrete

    inverse = natural_discrete(sparse.u, sparse.v, 1 / sparse.value_m, sparse.size_wh, threads=demand.threads)
    return np.asarray(1 / inverse, np.float32)


def _scan(sparse: SparseDepth, _: Demand) -> NDArray[np.float32]:
    from fusion.lidar.scan import scan

    return scan(sparse)


def _plane(sparse: SparseDepth, demand: Demand) -> NDArray[np.float32]:
    from fusion.lidar.plane import plane

    return plane(sparse, threads=demand.threads)


def _plane_fast(sparse: SparseDepth, demand: Demand) -> NDArray[np.float32]:
    from fusion.lidar.plane import plane

    return plane(sparse, robust=False, threads=demand.threads)


def _guided(sparse: SparseDepth, demand: Demand) -> NDArray[np.float32]:
    from fusion.lidar.guided import guided

    if demand.guide_bgr is None:
        raise UsageError(
            "guided needs a picture", where="--method", hint="give --guide RGB, or another --method"
        )
    return guided(sparse, demand.guide_bgr)


DENSIFIERS: dict[str, Fill] = {
    "plane": _plane,
    "plane-fast": _plane_fast,
    "natural": _scattered("natural"),
    "natural-discrete": _natural_discrete,
    "linear": _scattered("linear"),
    "nearest": _scattered("nearest"),
    "scan": _scan,
    "guided": _guided,
}
# Those that can extrapolate by slope; they know themselves what lies inside the samples' hull.
LINEAR_BEYOND: dict[str, Scattered] = {"linear": "linear", "natural": "natural", "nearest": "nearest"}


def densifier(name: str) -> Fill:
    """The method called `name`: ours, or one from an entry point in group `fusion.densifiers`."""
    return lookup(DENSIFIERS, "fusion.densifiers", name, "method")


def check_beyond(method: str, extrapolate: Extrapolate) -> None:
    """Refuse, before any work, extrapolation that `method` has no slope for. Raises `UsageError`."""
    if extrapolate == "linear" and method in DENSIFIERS and method not in LINEAR_BEYOND:
        hint = f"{', '.join(LINEAR_BEYOND)} can; or --extrapolate nearest"
        raise UsageError(f"{method} cannot extrapolate linearly", where="--extrapolate", hint=hint)


def densify(sparse: SparseDepth, method: str = "plane", demand: Demand | None = None) -> DenseDepth:
    """A value for every pixel near samples, by `method` (a row of `DENSIFIERS`).

    Inside the samples' convex hull, and no farther than the largest gap from a sample, a pixel is
    interpolated: there `support` is True. Elsewhere it has no value unless the demand is to extrapolate: by
    the nearest sample, or linearly where the method can. Raises `FrameError` without samples, `UsageError`
    for a method that is unknown or cannot do what is demanded.
    """
    demand = demand or Demand()
    fill = densifier(method)
    check_beyond(method, demand.extrapolate)
    if not len(sparse):
        raise FrameError("no sample to fill in from")
    near_px, inside = _distance_px(sparse), _hull(sparse)
    gap = demand.max_gap_px or max(GAP_OF_SPACING * float(np.median(near_px[inside])), 1.5)
    if method in LINEAR_BEYOND:
        values, inside = _interpolated(LINEAR_BEYOND[method], sparse, demand)
    else:
        values = fill(sparse, demand)
    values = np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)
    lo, hi = demand.limits_m
    good = (values >= lo) & (values <= hi) & (values > 0)
    support = good & inside & (near_px <= gap)
    if demand.extrapolate == "none":
        return DenseDepth(np.where(support, values, np.float32(0)), support, sparse.value)
    if demand.extrapolate == "nearest":
        beyond = densifier("nearest")(sparse, replace(demand, extrapolate="nearest"))
        values, good = np.where(support, values, beyond), good | ~support
    return DenseDepth(np.where(good, values, np.float32(0)), support, sparse.value)


def _distance_px(sparse: SparseDepth) -> NDArray[np.float32]:
    """How far every pixel lies from the nearest pixel with a sample."""
    empty = (z_buffer(sparse) == 0).astype(np.uint8)
    return np.asarray(cv2.distanceTransform(empty, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32)


def _hull(sparse: SparseDepth) -> NDArray[np.bool_]:
    """The pixels inside the samples' convex hull, those of the samples themselves included."""
    w, h = sparse.size_wh
    corners = cv2.convexHull(np.stack([sparse.u, sparse.v], -1).astype(np.float32))
    inside = np.clip(np.rint(corners), 0, (w - 1, h - 1))  # float32 may round onto the border and beyond
    mask = np.zeros((h, w), np.uint8)
    cv2.fillConvexPoly(mask, inside.astype(np.int32), 1)
    return mask > 0
