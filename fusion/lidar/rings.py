"""Which laser measured a point: the file's own word, or recovered from the order or the elevation of the
points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.frames import PointCloud

Floats = NDArray[np.float64]
MOST_RINGS, FEWEST_RINGS = 512, 4
FEWEST_POINTS = 16  # a ring, in the median: fewer are no cluster
ORDERED = 0.95  # share of steps that must go one way round
BIN_RAD = np.radians(0.01)
SMOOTH = (2, 6, 18)  # bins by which the histogram is smoothed, tried in turn
VALLEY = 0.3  # rings stand apart where the histogram falls below this share of the lower one's peak
NARROW = 0.2  # deviation of a ring's elevation against the spacing of rings (an even spread has 0.29)


class Spacing(NamedTuple):
    """Angles between neighbouring samples of a scan: along a ring, and between rings."""

    azimuth_rad: float
    elevation_rad: float


def rings_of(cloud: PointCloud) -> NDArray[np.int32] | None:
    """The ring of each point, N int32, 0 the lowest; None where the cloud has no rings that can be told
    apart.

    The cloud's own field ``ring`` is used where it distinguishes anything, re-numbered upwards. Otherwise,
    points that go round and round in one direction are cut at each turn (KITTI's .bin); else, points whose
    elevations gather in narrow clusters are told apart by them (scans as drivers give them, in any order).
    Maps, down-sampled, merged or motion-compensated clouds out of order show neither: None. Angles are those
    at the cloud's origin, so a cloud moved into another frame has no rings unless it brings the field or the
    order.
    """
    if not len(cloud):
        return None
    azimuth, elevation = _angles(cloud)
    own = _own(cloud)
    if own is None:
        own = _by_turns(azimuth, elevation)
    if own is not None:
        return _upwards(own, elevation)
    return _by_elevation(elevation)


def angular_spacing(cloud: PointCloud, ring: NDArray[np.int32]) -> Spacing:
    """The medians of the angles between neighbours, in radians; NaN where there are no two neighbours."""
    azimuth, elevation = _angles(cloud)
    order = np.lexsort((azimuth, ring))
    along = np.diff(azimuth[order])[np.diff(ring[order]) == 0]
    along = along[along > 0]
    between = np.diff(np.sort(_medians(ring, elevation)))
    return Spacing(
        float(np.median(along)) if along.size else np.nan,
        float(np.median(between)) if between.size else np.nan,
    )


def _angles(cloud: PointCloud) -> tuple[Floats, Floats]:
    x, y, z = np.asarray(cloud.xyz_m, np.float64).T
    return np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))


def _own(cloud: PointCloud) -> NDArray[np.int64] | None:
    """The field ``ring``, unless it says nothing (one value for all) or is no number of a laser."""
    field = cloud.fields.get("ring")
    if field is None or not np.isfinite(field).all():
        return None
    labels = np.unique(field, return_inverse=True)[1].reshape(-1)
    return labels if 1 <= labels.max() < MOST_RINGS else None


def _by_turns(azimuth: Floats, elevation: Floats) -> NDArray[np.int64] | None:
    """Which turn a point belongs to, where points go round ring by ring."""
    step = np.angle(np.exp(1j * np.diff(azimuth)))
    moving = step[np.abs(step) > 1e-9]
    if moving.size < len(step) / 2 or not moving.size:
        return None
    sense = np.sign(np.median(moving))
    turns = sense * step.sum() / (2 * np.pi)
    if not FEWEST_RINGS - 1 <= turns <= MOST_RINGS or np.mean(np.sign(moving) == sense) < ORDERED:
        return None
    seam = _seam(azimuth, step, elevation)
    begin = sense * (azimuth[0] - seam) % (2 * np.pi)
    return np.floor((begin + sense * np.r_[0, np.cumsum(step)]) / (2 * np.pi)).astype(np.int64)


def _seam(azimuth: Floats, step: Floats, elevation: Floats) -> float:
    """Where one ring ends and the next begins: the azimuth at which, turn after turn, the elevation steps."""
    change = np.diff(elevation) * np.sign(elevation[-1] - elevation[0])
    turn = np.floor(np.abs(np.cumsum(step)) / (2 * np.pi)).astype(np.int64)
    degree = np.floor(np.degrees(azimuth[1:])).astype(np.int64) % 360
    near = np.abs(step) < np.radians(2)  # over a gap a ring that is not level changes too
    total = np.zeros((turn.max() + 1, 360))
    np.add.at(total, (turn[near], degree[near]), change[near])
    best = np.argmax(np.median(total, 0))
    there = np.flatnonzero(near & (degree == best))
    there = there[change[there] > change[there].max() / 2]
    return float(np.median(azimuth[there + 1] - step[there] / 2)) if there.size else 0.0


def _upwards(label: NDArray[np.int64], elevation: Floats) -> NDArray[np.int32]:
    """Labels counted from the lowest ring. Where they follow each other up or down, their order stands.

    A ring that looks into the sky on one side has a median off its neighbours', which must not exchange them.
    """
    label = np.unique(label, return_inverse=True)[1].reshape(-1)
    middle = _medians(label, elevation)
    up = np.mean(np.diff(middle) > 0) if middle.size > 1 else 1.0
    if up >= 0.9:
        return label.astype(np.int32)
    if up <= 0.1:
        return (label.max() - label).astype(np.int32)
    rank = np.empty(middle.size, np.int32)
    rank[np.argsort(middle)] = np.arange(middle.size)
    return rank[label]


def _medians(label: NDArray[np.integer], values: Floats) -> Floats:
    """The median of the values of each label, in the order of the labels."""
    order = np.lexsort((values, label))
    _, first, count = np.unique(label[order], return_index=True, return_counts=True)
    return (values[order][first + (count - 1) // 2] + values[order][first + count // 2]) / 2


def _by_elevation(elevation: Floats) -> NDArray[np.int32] | None:
    """Clusters of elevation between the valleys of its histogram, as fine as they come out narrow and apart,
    or None.
    """
    place = ((elevation - elevation.min()) / BIN_RAD).astype(np.int64)
    count = np.pad(np.bincount(place), SMOOTH[-1] * 3).astype(np.float64)
    for width in SMOOTH:
        cuts = _valleys(np.convolve(count, _bell(width), "same"))
        ring = np.searchsorted(cuts, place + SMOOTH[-1] * 3).astype(np.int32)
        if FEWEST_RINGS - 1 <= len(cuts) < MOST_RINGS and _stand_apart(ring, elevation):
            return ring
    return None


def _stand_apart(ring: NDArray[np.int32], elevation: Floats) -> bool:
    count = np.bincount(ring)
    if np.median(count) < FEWEST_POINTS or count.min() == 0:
        return False
    middle = _medians(ring, elevation)
    off = np.sqrt(np.bincount(ring, (elevation - middle[ring]) ** 2) / count)
    gap = np.diff(middle)
    return bool(np.mean(off < NARROW * np.minimum(np.r_[gap, np.inf], np.r_[np.inf, gap])) >= ORDERED)


def _bell(width: int) -> Floats:
    weight = np.exp(-0.5 * (np.arange(-3 * width, 3 * width + 1) / width) ** 2)
    return weight / weight.sum()


def _valleys(density: Floats) -> list[int]:
    """The deepest places between peaks that stand apart, from left to right: a cut rises from low to next
    peak.
    """
    floor = 0.05 * np.percentile(density[density > 0], 90)
    cuts: list[int] = []
    peak, low, at = 0.0, np.inf, 0
    for i, value in enumerate(density):
        if value < low:
            low, at = value, i
        if peak > floor and low < VALLEY * min(peak, value) and value > floor:
            cuts.append(at)
            peak, low, at = value, value, i
        elif value > peak:
            peak, low, at = value, value, i
    return cuts
