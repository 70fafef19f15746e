"""The offset and the drift between the clocks of two cameras that turn together, from how their pictures
move.

First every offset within a limit, and every drift, is tried on a coarse grid; then least squares make one
motion a linear function of the other (the cameras differ in focal length, and may stand at any angle)
shifted in time. How far the answer can be trusted follows from how much parts of the recording disagree.

A thermal picture shows what its slow sensor saw a little before it was read out. That part of the offset
belongs to no clock: it is taken off as far as the sensor's time constant is known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from fusion.errors import InputError
from fusion.timing.motion import Floats, Motion

LIMIT_S = 2.0
DRIFT_LIMIT = 300e-6  # quartz is a tenth of it
TIME_CONSTANT_S = 0.010  # a common uncooled sensor's
LAG = 0.7  # of the time constant: by how much pictures come late, docs/timing.md
_STEP_S = 0.02
_SPAN_S = 0.2  # motion is taken over so much time: shorter is noise, longer blurs what tells the offset
_HOLE_S = 0.25  # between pictures: what happened there is not known
_PART_S = 2.0  # parts of a recording that are taken to be independent
_LEAST_S = 8.0
_STILL_PX = 0.1  # rms, over `_SPAN_S`
_ALIKE = 0.7  # correlation: docs/timing.md has what unrelated recordings reach
_RIVAL = 0.8  # of the correlation at the best offset
_CLEAR = (0.9, 0.65)  # correlation, and the rival's share of it, that need not be doubted
_LOBE_S = 0.3
_DRIFT_PRIOR = 100e-6
_FLOOR_S = 0.0025  # cameras that see different parts of a scene do not see one motion: docs/timing.md


@dataclass(frozen=True, slots=True, eq=False)
class ClockEstimate:
    """`offset_ns`, added to thermal stamps near `at_ns` (thermal clock, the middle of the recording), gives
    RGB's clock, as `time_offset_s` of a rig says it; `drift` is by how much that grows a second (s/s).

    The sigmas are what parts of the recording say, that of the offset with 2.5 ms for what all parts have in
    common; of short ones the drift is hardly known and is kept near 0 (a prior of 100 ppm). `lag_ns` is what
    was taken to be the thermal sensor's: with `offset_ns - lag_ns` instead, pictures (not clocks) agree best.
    `score` is the correlation of both motions at the best offset, `rival` the highest elsewhere in the curve;
    `confidence` is 1 where neither gives reason to doubt, and falls to 0 where the estimate would be refused.
    `overlap_s` is how much time both are known, `lags_s` and `curve` the correlation of every offset tried.
    """

    offset_ns: int
    drift: float
    at_ns: int
    offset_sigma_ns: float
    drift_sigma: float
    lag_ns: int
    score: float
    rival: float
    confidence: float
    overlap_s: float
    lags_s: Floats
    curve: Floats

    def offset_at(self, stamp_ns: int) -> int:
        """What to add to a thermal stamp to give RGB's clock, in ns."""
        return self.offset_ns + round(self.drift * (stamp_ns - self.at_ns))


def estimate_clock(
    rgb: Motion,
    fir: Motion,
    *,
    around_ns: int = 0,
    limit_s: float = LIMIT_S,
    time_constant_s: float = TIME_CONSTANT_S,
) -> ClockEstimate:
    """The offset, at most `limit_s` from `around_ns`, and the drift of thermal stamps against RGB's.

    `time_constant_s` is the thermal sensor's, from its data sheet; 0 leaves the lag in the offset. Raises
    `InputError` where it cannot tell: too short, hardly any motion, motions that are not alike at any
    offset, or alike at several.
    """
    if len(rgb.stamps_ns) < 3 or len(fir.stamps_ns) < 3:
        raise _unknown("too few pictures", "both streams must show the same time")
    origin = int(rgb.stamps_ns[0])
    one, two = _Way.of(rgb, origin), _Way.of(fir, origin - around_ns)
    start = _search(one, two, limit_s)
    fitted = _refine(one, two, start)
    middle_s = start.middle_s - fitted.offset_s
    lag_ns = round(LAG * time_constant_s * 1e9)
    return ClockEstimate(
        around_ns + round(fitted.offset_s * 1e9) + lag_ns,
        fitted.drift,
        origin - around_ns + round(middle_s * 1e9),
        fitted.offset_sigma_s * 1e9,
        fitted.drift_sigma,
        lag_ns,
        start.score,
        start.rival,
        _confidence(start.score, start.rival),
        start.overlap_s,
        around_ns * 1e-9 + start.lags_s,
        start.curve,
    )


def _confidence(score: float, rival: float) -> float:
    margins = (score - _ALIKE) / (_CLEAR[0] - _ALIKE), (_RIVAL - rival / score) / (_RIVAL - _CLEAR[1])
    return min(1.0, *margins)


def _unknown(what: str, hint: str) -> InputError:
    return InputError(f"the clocks cannot be compared: {what}", hint=hint)


# --- how a camera moved, at any time


@dataclass(frozen=True, slots=True, eq=False)
class _Way:
    """The sum of all shifts over time (s), smooth between pictures, and the holes in it."""

    path: PchipInterpolator
    begin_s: float
    end_s: float
    holes_s: Floats  # (M, 2)
    span_s: float

    @staticmethod
    def of(motion: Motion, origin_ns: int) -> _Way:
        time_s = np.asarray((motion.stamps_ns - origin_ns) * 1e-9, np.float64)
        known = np.isfinite(motion.shift_px.sum(1))
        steps = np.diff(time_s)
        hole = ~known | (steps > max(_HOLE_S, 3 * float(np.median(steps))))
        path = np.vstack([np.zeros(2), np.cumsum(np.nan_to_num(motion.shift_px), 0)])
        holes = np.asarray(np.stack([time_s[:-1][hole], time_s[1:][hole]], -1), np.float64)
        span = max(_SPAN_S, 1.5 * float(np.median(steps)))
        return _Way(PchipInterpolator(time_s, path), float(time_s[0]), float(time_s[-1]), holes, span)

    def moved(self, time_s: Floats, span_s: float) -> tuple[Floats, NDArray[np.bool_]]:
        """(N, 2) shifts over the span around each time, and where they are known."""
        low, high = time_s - span_s / 2, time_s + span_s / 2
        good = (low >= self.begin_s) & (high <= self.end_s)
        good &= np.searchsorted(self.holes_s[:, 0], high) == np.searchsorted(self.holes_s[:, 1], low)
        shift = self.path(np.clip(high, self.begin_s, self.end_s)) - self.path(
            np.clip(low, self.begin_s, self.end_s)
        )
        return np.where(good[:, None], shift, 0.0), good


# --- every offset and drift on a grid


class _Start(NamedTuple):
    """The best of the grid; `middle_s` on RGB's clock is where the offset holds."""

    offset_s: float
    drift: float
    middle_s: float
    score: float
    rival: float
    overlap_s: float
    lags_s: Floats
    curve: Floats


def _search(one: _Way, two: _Way, limit_s: float) -> _Start:
    span = max(one.span_s, two.span_s)
    reach = int(np.ceil(limit_s / _STEP_S)) + 5  # a peak at the limit has two sides
    lags = np.arange(-reach, reach + 1)
    begin, end = max(one.begin_s, two.begin_s - limit_s), min(one.end_s, two.end_s + limit_s)
    count = int((end - begin) / _STEP_S)
    if count * _STEP_S < _LEAST_S:
        what = f"{max(count, 0) * _STEP_S:.1f} s in common"
        raise _unknown(what, f"{_LEAST_S:g} s at least; are the stamps of both of one kind of clock?")
    grid = begin + _times(count)
    a, good_a = one.moved(grid, span)
    b, good_b = two.moved(begin - _STEP_S * reach + _times(count + 2 * reach), span)
    _check_motion(a[good_a], b[good_b])
    part_s = min(max(_PART_S, count * _STEP_S / 60), 30.0)  # in 30 s the largest drift moves about a step
    per = round(part_s / _STEP_S)
    # a thermal stamp plus the lag is on RGB's clock
    moved = [(b[reach - k :][:count], good_b[reach - k :][:count]) for k in lags]
    sums = np.stack([_sums(a, good_a, b_k, good_k, per) for b_k, good_k in moved])
    middles = begin + per * _STEP_S * (0.5 + np.arange(sums.shape[1], dtype=np.float64))
    return _best(sums, lags, middles)


def _times(count: int) -> Floats:
    return np.asarray(_STEP_S * np.arange(count), np.float64)


def _check_motion(a: Floats, b: Floats) -> None:
    for name, motion in (("RGB", a), ("thermal", b)):
        rms = float(np.sqrt((motion**2).sum(1).mean())) if len(motion) else 0.0
        if rms < _STILL_PX:
            hint = "a recording in which the rig turns is needed, by hand is enough"
            raise _unknown(f"the {name} camera hardly moves ({rms:.2f} of {128} px)", hint)


def _sums(a: Floats, good_a: NDArray[np.bool_], b: Floats, good_b: NDArray[np.bool_], per: int) -> Floats:
    """(parts, 15) sums of 1, x and x x^T (10 numbers) of x = (a, b) (4), where both are known."""
    x = np.where((good_a & good_b)[:, None], np.hstack([a, b]), 0.0)
    i, j = np.triu_indices(4)
    columns = np.hstack([(good_a & good_b)[:, None], x, x[:, i] * x[:, j]])
    return np.add.reduceat(columns, np.arange(0, len(x), per), axis=0)


def _best(sums: Floats, lags: NDArray[np.int_], middles: Floats) -> _Start:
    """The offset and drift at which both motions are most alike, all parts together."""
    middle = float(middles.mean())
    length = float(np.ptp(middles)) + _PART_S
    n = int(np.ceil(DRIFT_LIMIT * length / _STEP_S))
    drifts = np.arange(-n, n + 1) * _STEP_S / length
    curves = np.stack([_curve(sums, np.rint(d * (middles - middle) / _STEP_S).astype(int)) for d in drifts])
    which, k = np.unravel_index(int(curves.argmax()), curves.shape)
    curve, lags_s = curves[which], np.asarray(lags * _STEP_S, np.float64)
    overlap = float(sums[k, :, 0].sum()) * _STEP_S
    away = np.abs(lags_s - lags_s[k]) > _LOBE_S
    score, rival = float(curve[k]), float(curve[away].max(initial=0.0))
    _check_peak(score, rival, overlap, at_edge=k in (0, len(lags) - 1))
    return _Start(float(lags_s[k]), float(drifts[which]), middle, score, rival, overlap, lags_s, curve)


def _check_peak(score: float, rival: float, overlap_s: float, *, at_edge: bool) -> None:
    if overlap_s < _LEAST_S:
        raise _unknown(f"{overlap_s:.1f} s of known motion in common", f"{_LEAST_S:g} s at least")
    if score < _ALIKE:
        what = f"the pictures move alike at no offset (correlation {score:.2f}, {_ALIKE:g} is needed)"
        raise _unknown(what, "are these recordings of the same time, does the rig turn enough?")
    if rival > _RIVAL * score or at_edge:
        where = "at the limit of the search" if at_edge else f"{rival:.2f} at another offset"
        raise _unknown(
            f"the best offset is not certain (correlation {score:.2f}, {where})",
            "irregular motion tells more; or search around a known offset",
        )


def _curve(sums: Floats, shift: NDArray[np.int_]) -> Floats:
    """Of each lag the root mean square canonical correlation, part p taken `shift[p]` lags further on."""
    at = np.arange(len(sums))[:, None] + shift
    inside = (at >= 0) & (at < len(sums))
    s = (sums[np.clip(at, 0, len(sums) - 1), np.arange(len(shift))] * inside[..., None]).sum(1)
    n = np.maximum(s[:, 0], 1.0)
    mean = s[:, 1:5] / n[:, None]
    C = np.empty((len(s), 4, 4))
    i, j = np.triu_indices(4)
    C[:, i, j] = C[:, j, i] = s[:, 5:] / n[:, None] - mean[:, i] * mean[:, j]
    C[:, range(4), range(4)] += 1e-9
    A, B, X = C[:, :2, :2], C[:, 2:, 2:], C[:, :2, 2:]
    R = np.linalg.solve(A, X) @ np.linalg.solve(B, X.swapaxes(1, 2))
    likeness = np.sqrt(np.clip(np.trace(R, axis1=1, axis2=2) / 2, 0.0, 1.0))
    enough = s[:, 0] >= 0.5 * s[:, 0].max()
    return np.where(enough, likeness, 0.0)


# --- between the points of the grid


class _Fit(NamedTuple):
    offset_s: float
    drift: float
    offset_sigma_s: float
    drift_sigma: float


def _refine(one: _Way, two: _Way, start: _Start) -> _Fit:
    """Gauss-Newton: a(t) = M b(t - offset - drift (t - middle)) + constant, residuals whitened."""
    span = max(one.span_s, two.span_s)
    grid = one.begin_s + _times(int((one.end_s - one.begin_s) / _STEP_S))
    a, good_a = one.moved(grid, span)
    clock = np.stack([np.ones(len(grid)), grid - start.middle_s], -1)
    scale = np.array([1.0, 1.0 / max(float(np.ptp(grid)), 1.0)])
    clock = clock * scale
    theta = np.array([start.offset_s, start.drift]) / scale
    H = np.eye(2)
    J = r = np.zeros((0, 2))
    part = np.zeros(0, np.intp)
    for _ in range(12):
        J, r, part = _linearised(a, good_a, two, grid, clock, theta, span)
        H = np.einsum("tci,tcj->ij", J, J)
        step = -np.linalg.solve(H + 1e-12 * np.trace(H) * np.eye(2), np.einsum("tci,tc->i", J, r))
        theta = theta + np.clip(step, -_STEP_S, _STEP_S)
        if np.abs(step).max() < 1e-7:
            break
    return _fitted(theta * scale, H, J, r, part, scale)


def _linearised(
    a: Floats, good: NDArray[np.bool_], two: _Way, grid: Floats, clock: Floats, theta: Floats, span_s: float
) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Whitened residuals (T, 2), their derivatives (T, 2, 2) by the scaled offset and drift, and parts
    (T,).
    """
    at = grid - clock @ theta
    h = _STEP_S / 4
    (b, good_b), (b1, _), (b0, _) = (two.moved(at + d, span_s) for d in (0.0, h, -h))
    rows = np.flatnonzero(good & good_b)
    x = np.hstack([b[rows], np.ones((len(rows), 1))])
    M = np.linalg.lstsq(x, a[rows], rcond=None)[0]
    r = a[rows] - x @ M
    white = np.linalg.cholesky(np.linalg.inv(r.T @ r / len(r) + 1e-12 * np.eye(2)))
    slope = ((b1 - b0)[rows] / (2 * h)) @ M[:2] @ white
    return slope[:, :, None] * clock[rows, None, :], r @ white, (rows * _STEP_S // _PART_S).astype(np.intp)


def _fitted(theta: Floats, H: Floats, J: Floats, r: Floats, part: NDArray[np.intp], scale: Floats) -> _Fit:
    """With sigmas from how the parts pull (White's sandwich), and the drift held by its prior."""
    pulls = np.zeros((int(part.max()) + 1, 2))
    np.add.at(pulls, part, np.einsum("tci,tc->ti", J, r))
    inverse = np.linalg.inv(H)
    used = len(np.unique(part))
    spread = inverse @ (pulls.T @ pulls) @ inverse * used / max(used - 2, 1) * np.outer(scale, scale)
    weight = np.linalg.inv(spread)
    covariance = np.linalg.inv(weight + np.diag([0.0, _DRIFT_PRIOR**-2]))
    offset, drift = covariance @ weight @ theta
    sigma = np.sqrt(np.diag(covariance))
    return _Fit(float(offset), float(drift), float(np.hypot(sigma[0], _FLOOR_S)), float(sigma[1]))
