"""Numbers of what was looked at: stamps, pixels, points. Nothing is estimated; what was not seen is None."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from fusion.frames import PointCloud
from fusion.inspect.base import Looked, Times

if TYPE_CHECKING:
    from fusion.timing.freeze import Step

GAPS_NAMED = 5
RUNS_NAMED = 20
_PERCENT = {"p1": 0.01, "median": 0.5, "p99": 0.99}


def times_of(
    stamps_ns: Sequence[int | None],
    clock: Literal["header", "log", "name"],
    looked: Looked,
    log_ns: Sequence[int] | None = None,
) -> Times | None:
    """What stamps say that were seen in this order; None where there is none.

    Steps are judged only if `looked` saw everything: between samples nobody knows what lies.
    """
    from fusion.timing.rates import RateMeter

    meter = RateMeter()
    for index, stamp in enumerate(stamps_ns):
        meter.add(stamp, None if log_ns is None else log_ns[index])
    found = meter.rates()
    if found.first_ns is None or found.last_ns is None:
        return None
    delay = found.delay if found.delay is None else (found.delay.median_ns / 1e6, found.delay.spread_ns / 1e6)
    times = Times(clock, looked, found.first_ns, found.last_ns, found.n_unstamped, delay_ms=delay)
    if looked.seen != looked.of or found.interval_ns is None:
        return times
    longest = sorted(found.gaps, key=lambda gap: -gap.length_ns)[:GAPS_NAMED]
    return replace(
        times,
        rate_hz=found.rate_hz,
        jitter_ms=None if found.jitter_ns is None else found.jitter_ns / 1e6,
        gap_count=found.n_gaps,
        gaps_ns=tuple((gap.start_ns, gap.start_ns + gap.length_ns) for gap in longest),
        backwards=found.n_jumps,
        duplicates=found.n_same,
    )


class PixelTally:
    """Counts of pixels over any number of pictures of one type: exact for 8 and 16 bits, of all channels
    together.
    """

    def __init__(self) -> None:
        self.histogram = np.zeros(1 << 16, np.int64)
        self.dtypes: dict[str, int] = {}
        self._floats: list[NDArray[Any]] = []
        self._not_finite = 0

    def add(self, pixels: NDArray[Any]) -> None:
        dtype = pixels.dtype.name
        self.dtypes[dtype] = self.dtypes.get(dtype, 0) + 1
        if pixels.dtype.kind == "f":
            finite = pixels[np.isfinite(pixels)]
            self._not_finite += pixels.size - finite.size
            self._floats.append(finite[:: max(finite.size // 100_000, 1)])
            return
        found = np.bincount(pixels.reshape(-1), minlength=1)
        self.histogram[: len(found)] += found

    def facts(self) -> dict[str, Any]:
        """least, 1 %, median, 99 %, most; empty where nothing was added."""
        if self._floats:
            values = np.concatenate(self._floats)
            if not len(values):
                return {"not_finite_pixels": self._not_finite}
            low, *middle, high = (float(v) for v in np.quantile(values, [0, *_PERCENT.values(), 1]))
            return {"least": low, **dict(zip(_PERCENT, middle, strict=True)), "most": high} | (
                {"not_finite_pixels": self._not_finite} if self._not_finite else {}
            )
        total = int(self.histogram.sum())
        if not total:
            return {}
        running, there = np.cumsum(self.histogram), np.flatnonzero(self.histogram)
        inner = {name: int(np.searchsorted(running, part * total)) for name, part in _PERCENT.items()}
        return {"least": int(there[0]), **inner, "most": int(there[-1])}


def points_of(cloud: PointCloud) -> dict[str, Any]:
    """Numbers, fields and extent of one cloud, metres."""
    read = len(cloud) if cloud.read is None else cloud.read
    facts: dict[str, Any] = {"points": read, "valid_points": len(cloud)}
    dropped = {why: count for why, count in cloud.dropped.items() if count}
    facts |= {"dropped": dropped} if dropped else {}
    facts["fields"] = {
        "xyz": cloud.xyz_m.dtype.name,
        **{name: v.dtype.name for name, v in cloud.fields.items()},
    }
    if not len(cloud):
        return facts
    xyz = cloud.xyz_m.astype(np.float64, copy=False)
    range_m = np.sqrt(np.einsum("ij,ij->i", xyz, xyz))
    facts["range_m"] = {
        name: round(float(value), 3)
        for name, value in zip(
            ("least", "median", "most"), np.quantile(range_m, [0, 0.5, 1], method="nearest"), strict=True
        )
    }
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    facts["extent_m"] = {
        axis: [round(float(low[k]), 3), round(float(high[k]), 3)] for k, axis in enumerate("xyz")
    }
    if "ring" in cloud.fields:
        facts["rings"] = len(np.unique(cloud.fields["ring"]))
    if "intensity" in cloud.fields:
        values = cloud.fields["intensity"]
        facts["intensity"] = {"least": _plain(np.nanmin(values)), "most": _plain(np.nanmax(values))}
    if "time_s" in cloud.fields:
        facts["scan_s"] = round(float(np.ptp(cloud.fields["time_s"])), 6)
    return facts


def spread(count: int, most: int) -> list[int]:
    """Up to `most` of `count` indices, evenly, first and last among them."""
    if count <= most:
        return list(range(count))
    return sorted({round(k * (count - 1) / (most - 1)) for k in range(most)})


def _plain(value: Any) -> float | int:
    return int(value) if np.asarray(value).dtype.kind in "iu" else float(value)


def freezes_said(steps: Sequence[Step]) -> dict[str, Any]:
    """Frozen frames among consecutive pictures: how many repeat the one before, in how many runs, and
    where.
    """
    from fusion.timing.freeze import frozen, frozen_runs

    flags = frozen(steps)
    runs = frozen_runs(flags)
    facts: dict[str, Any] = {"frozen_frames": int(np.count_nonzero(flags)), "freezes": len(runs)}
    if runs:
        facts["frozen_from_to"] = [[run.first, run.end - 1] for run in runs[:RUNS_NAMED]]
    return facts
