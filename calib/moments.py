"""Detections of several streams become views with moments: who saw the board at the same time.

Images that have no board, or no partner, are kept in the report, each with its reason.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calib.observations import Detection, Refusal, View
from fusion.errors import InputError, UsageError
from fusion.geometry import Floats

By = Literal["auto", "stamp", "name", "order"]
TOLERANCE_S = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One image of a camera: partners have its `name`, or a near `stamp_ns` (None: no clock)."""

    name: str
    file: str
    stamp_ns: int | None
    size_wh: tuple[int, int]
    found: Detection | Refusal


@dataclass(frozen=True, slots=True)
class PairRow:
    """What two cameras share: moments where both saw the board, and the images of each left without partner.

    `left` are (camera, file, reason). `median_s` and `largest_s` are of the stamps' differences, b minus
    a, in size, over shared moments; `nearest_s` is the median signed difference of nearest images, and
    `tolerance_s` the least that would pair nine in ten of them: None without stamps, or where it would
    pair at random.
    """

    a: str
    b: str
    shared: int
    left: tuple[tuple[str, str, str], ...] = ()
    median_s: float | None = None
    largest_s: float | None = None
    nearest_s: float | None = None
    tolerance_s: float | None = None

    def __str__(self) -> str:
        text = f"{self.a}-{self.b}: {self.shared} shared"
        if self.left:
            text += f", {len(self.left)} without partner"
        if self.median_s is not None and self.largest_s is not None:
            text += f", {_ms(self.median_s)} apart (median; at most {_ms(self.largest_s)})"
        elif self.nearest_s is not None:
            text += f", nearest images {_ms(abs(self.nearest_s))} apart (median)"
            if self.tolerance_s:
                text += f", a tolerance of {1e3 * self.tolerance_s:g} ms would pair them"
        return text


@dataclass(frozen=True, slots=True)
class Pairing:
    """Views with moments, and how they came about.

    `by` says how images were matched. `moment_ns` is the stamp of each moment, where there is one: that
    of the first camera that saw it, on the first camera's clock.
    """

    views: tuple[View, ...]
    pairs: tuple[PairRow, ...]
    by: str
    moment_ns: Mapping[str, int] = field(default_factory=dict)
    without_board: tuple[tuple[str, str, str], ...] = ()
    notes: tuple[str, ...] = ()

    def table(self) -> str:
        """The pairs of cameras, one clause each."""
        return "; ".join(str(row) for row in self.pairs)


def pair(
    streams: Mapping[str, Sequence[Shot]],
    *,
    by: By = "auto",
    tolerance_s: float = TOLERANCE_S,
    offset_s: Mapping[str, float] | None = None,
) -> Pairing:
    """Views of all cameras, the first of `streams` being the clock.

    By stamp: nearest, one to one, in order of time, at most `tolerance_s` apart; `offset_s` by camera is
    added to its stamps first. By name: equal names. By order: the first with the first; the streams must
    be equally long. "auto" is by stamp where all have stamps, else by name. A camera that shares nothing
    is no error here: the report says what is missing. Raises `InputError` for images of different sizes
    in one camera, names that are there twice, or streams that cannot be matched that way; `UsageError`
    for a tolerance that is no positive number.
    """
    if not (np.isfinite(tolerance_s) and tolerance_s > 0):
        raise UsageError(f"a tolerance of {tolerance_s:g} s", hint="it must be above 0")
    for camera, shots in streams.items():
        check_sizes(camera, shots)
    stamped = all(shot.stamp_ns is not None for shots in streams.values() for shot in shots)
    rule = ("stamp" if stamped else "name") if by == "auto" else by
    if rule == "stamp":
        groups = _by_stamp(streams, tolerance_s, offset_s or {})
    else:
        groups = _by_name(streams) if rule == "name" else _by_order(streams)
    return _pairing(streams, groups, rule, offset_s or {})


def check_sizes(camera: str, shots: Sequence[Shot]) -> None:
    """Raises `InputError` where a camera's images have different sizes, naming the odd ones."""
    sizes = Counter(shot.size_wh for shot in shots)
    if len(sizes) < 2:
        return
    (usual, count), *_ = sizes.most_common()
    odd = [shot for shot in shots if shot.size_wh != usual]
    named = ", ".join(f"{shot.file} ({shot.size_wh[0]}x{shot.size_wh[1]})" for shot in odd[:5])
    named += f" and {len(odd) - 5} more" if len(odd) > 5 else ""
    raise InputError(
        f"images of different sizes: {count} of {len(shots)} are {usual[0]}x{usual[1]}, but not {named}",
        where=camera,
        hint="a camera's images all have the size they were taken with: take out or mend the odd ones",
    )


def nearest_one_to_one(a: Floats, b: Floats) -> list[tuple[int, int]]:
    """Pairs (i, j) of sorted times that are each other's nearest: one to one, and in order."""
    if not len(a) or not len(b):
        return []
    to_b, to_a = _nearest(a, b), _nearest(b, a)
    return [(i, int(j)) for i, j in enumerate(to_b) if to_a[j] == i]


def _nearest(a: Floats, b: Floats) -> NDArray[np.intp]:
    right = np.clip(np.searchsorted(b, a), 1, max(len(b) - 1, 1)) if len(b) > 1 else np.zeros(len(a), np.intp)
    left = np.maximum(right - 1, 0)
    return np.where(np.abs(a - b[left]) <= np.abs(a - b[right]), left, right)


# --- who belongs together: a list of moments, each a camera's name to an index


_Group = dict[str, int]


def _by_stamp(
    streams: Mapping[str, Sequence[Shot]], tolerance_s: float, offset_s: Mapping[str, float]
) -> list[_Group]:
    groups: list[_Group] = []
    times = np.zeros(0)
    origin = min(
        (s.stamp_ns for shots in streams.values() for s in shots if s.stamp_ns is not None), default=0
    )
    for camera, shots in streams.items():
        if any(shot.stamp_ns is None for shot in shots):
            raise InputError(
                "images without a time stamp", where=camera, hint="match them by name or by order"
            )
        own = np.array([((shot.stamp_ns or 0) - origin) * 1e-9 for shot in shots]) + offset_s.get(camera, 0.0)
        order, sort = np.argsort(times, kind="stable"), np.argsort(own, kind="stable")
        match = nearest_one_to_one(times[order], own[sort])
        near = {
            int(sort[j]): int(order[i])
            for i, j in match
            if abs(times[order[i]] - own[sort[j]]) <= tolerance_s
        }
        for k in sort.tolist():
            if k in near:
                groups[near[k]][camera] = k
            else:
                groups.append({camera: k})
                times = np.append(times, own[k])
    return [groups[k] for k in np.argsort(times, kind="stable")]


def _by_name(streams: Mapping[str, Sequence[Shot]]) -> list[_Group]:
    groups: dict[str, _Group] = {}
    for camera, shots in streams.items():
        twice = [name for name, n in Counter(shot.name for shot in shots).items() if n > 1]
        if twice:
            raise InputError(f"{len(twice)} names are there twice, such as {twice[0]!r}", where=camera)
        for k, shot in enumerate(shots):
            groups.setdefault(shot.name, {})[camera] = k
    return list(groups.values())


def _by_order(streams: Mapping[str, Sequence[Shot]]) -> list[_Group]:
    counts = {camera: len(shots) for camera, shots in streams.items()}
    if len(set(counts.values())) > 1:
        said = ", ".join(f"{n} of {camera}" for camera, n in counts.items())
        raise InputError(
            f"images cannot be matched by order: {said}", hint="one is missing: match by stamp or name"
        )
    return [dict.fromkeys(streams, k) for k in range(max(counts.values(), default=0))]


# --- views and the report


def _pairing(
    streams: Mapping[str, Sequence[Shot]], groups: Sequence[_Group], rule: str, offset_s: Mapping[str, float]
) -> Pairing:
    views: list[View] = []
    moment_ns: dict[str, int] = {}
    for number, group in enumerate(groups):
        seen = {c: streams[c][k] for c, k in group.items() if isinstance(streams[c][k].found, Detection)}
        if not seen:
            continue
        first = next(iter(seen))
        moment = f"{number:05d}"
        start = seen[first].stamp_ns
        if start is not None:
            moment_ns[moment] = start + round(offset_s.get(first, 0.0) * 1e9)
        views += [_view(c, moment, shot, moment_ns.get(moment)) for c, shot in seen.items()]
    missing = tuple(
        (camera, shot.file, shot.found.reason)
        for camera, shots in streams.items()
        for shot in shots
        if isinstance(shot.found, Refusal)
    )
    rows = tuple(_row(a, b, streams, groups, offset_s) for a, b in combinations(streams, 2))
    return Pairing(tuple(views), rows, rule, moment_ns, missing)


def _view(camera: str, moment: str, shot: Shot, moment_ns: int | None) -> View:
    assert isinstance(shot.found, Detection)  # noqa: S101 - the caller chose those
    lag = 0.0 if moment_ns is None or shot.stamp_ns is None else (shot.stamp_ns - moment_ns) * 1e-9
    return View(camera, moment, shot.found.ids, shot.found.uv, shot.size_wh, lag, shot.file)


def _row(
    a: str,
    b: str,
    streams: Mapping[str, Sequence[Shot]],
    groups: Sequence[_Group],
    offset_s: Mapping[str, float],
) -> PairRow:
    shared: list[float] = []
    left: list[tuple[str, str, str]] = []
    count = 0
    for group in groups:
        here = {c: streams[c][group[c]] for c in (a, b) if c in group}
        seen = [c for c, shot in here.items() if isinstance(shot.found, Detection)]
        if len(seen) == 2:
            count += 1
            gap = _gap_s(here[a], here[b], a, b, offset_s)
            shared += [] if gap is None else [gap]
        elif seen:
            other = b if seen == [a] else a
            reason = (
                f"no board in {here[other].file}" if other in here else f"no image of {other} at that time"
            )
            left.append((seen[0], here[seen[0]].file, reason))
    sizes = np.abs(shared)
    median, largest = (float(np.median(sizes)), float(sizes.max())) if shared else (None, None)
    nearest = nearest_gap(*(_times(streams[c], offset_s.get(c, 0.0)) for c in (a, b)))
    return PairRow(a, b, count, tuple(left), median, largest, *nearest)


def _gap_s(one: Shot, two: Shot, a: str, b: str, offset_s: Mapping[str, float]) -> float | None:
    if one.stamp_ns is None or two.stamp_ns is None:
        return None
    return (two.stamp_ns - one.stamp_ns) * 1e-9 + offset_s.get(b, 0.0) - offset_s.get(a, 0.0)


def _times(shots: Sequence[Shot], offset_s: float) -> Floats | None:
    stamps = [
        shot.stamp_ns for shot in shots if isinstance(shot.found, Detection) and shot.stamp_ns is not None
    ]
    return np.sort(np.array(stamps, np.float64)) * 1e-9 + offset_s if stamps else None


def nearest_gap(a: Floats | None, b: Floats | None) -> tuple[float | None, float | None]:
    """Median signed difference, b minus a, of nearest times (s), and a tolerance that pairs nine in ten.

    The tolerance is None where it exceeds half the usual step of both: it would pair at random.
    """
    if a is None or b is None:
        return None, None
    gaps = np.array([b[j] - a[i] for i, j in nearest_one_to_one(a, b)])
    if not len(gaps):
        return None, None
    tolerance = float(np.ceil(np.quantile(np.abs(gaps), 0.9) * 1.1e3) / 1e3)
    steps = [float(np.median(np.diff(t))) for t in (a, b) if len(t) > 1]
    return float(np.median(gaps)), tolerance if tolerance <= 0.5 * max(steps, default=np.inf) else None


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3:.3g} ms" if seconds < 1 else f"{seconds:.3g} s"


def pair_rows(views: Sequence[View], moment_ns: Mapping[str, int]) -> tuple[PairRow, ...]:
    """The table of pairs of cameras from views alone, with times where their moments have stamps."""
    cameras = list(dict.fromkeys(view.camera for view in views))
    seen = {c: {v.moment: v for v in views if v.camera == c} for c in cameras}
    rows = []
    for a, b in combinations(cameras, 2):
        shared = [m for m in seen[a] if m in seen[b]]
        gaps = np.abs([seen[b][m].lag_s - seen[a][m].lag_s for m in shared])
        times = [_view_times(seen[c].values(), moment_ns) for c in (a, b)]
        known = bool(shared) and all(t is not None for t in times)
        figures = (float(np.median(gaps)), float(gaps.max())) if known else (None, None)
        rows.append(PairRow(a, b, len(shared), (), *figures, *nearest_gap(*times)))
    return tuple(rows)


def _view_times(views: Collection[View], moment_ns: Mapping[str, int]) -> Floats | None:
    if not views or any(view.moment not in moment_ns for view in views):
        return None
    return np.sort(np.array([moment_ns[view.moment] * 1e-9 + view.lag_s for view in views]))
