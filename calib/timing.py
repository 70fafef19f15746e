"""The offset between the clocks of two cameras, from a board that moves.

How fast a board turns, and how fast its middle moves, is the same for all cameras of a rig, whatever
their frames: two speeds over time, shifted by what their clocks differ.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from calib.boards import Board
from calib.initial import poses_of, spread_views, symmetry_motions
from calib.moments import nearest_one_to_one
from calib.observations import View
from fusion.errors import InputError, UsageError
from fusion.geometry import Floats
from fusion.rig import RigCamera

LIMIT_S = 2.0
_STEP_S = 0.005
_WINDOW_S = 0.15  # each side, over which motion is taken to be a cubic
_FEWEST = 7  # frames in a window: a cubic has four unknowns
_STILL = (0.03, 0.01)  # rad/s and m/s: a hand that moves a board does ten times that
_ALIKE = 0.8  # correlation: unrelated motion reaches a half, the same one with much noise 0.95
_MOST_MOMENTS = 80


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """A board's way in a camera's frame: times (N,) in seconds, T_camera_board (N, 4, 4), labels continuous.

    `views` are those of the times, relabelled as the poses are.
    """

    time_s: Floats
    T: Floats
    views: tuple[View, ...]


@dataclass(frozen=True, slots=True)
class Offset:
    """`seconds`, added to a camera's stamps, give the reference's clock; from `overlap_s` seconds of motion.

    `score` is the correlation at the best offset; `drift` the change of the offset by second, and
    `drift_sigma` how well that is known.
    """

    seconds: float
    score: float
    overlap_s: float
    drift: float = 0.0
    drift_sigma: float = np.inf
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Timed:
    """Views with moments on the reference's clock, the board's motion in each, and the offsets."""

    views: list[View]
    twist: dict[str, Floats]
    offset_s: dict[str, float]
    notes: list[str]


def track_of(board: Board, camera: RigCamera, views: Sequence[View], time_s: Floats) -> Track:
    """The board's way in one camera's frame; each view labelled as the one before it, turned the least."""
    poses, _ = poses_of(board, camera, views)
    order = sorted(poses, key=lambda k: (time_s[k], k))
    motions, labels = symmetry_motions(board), board.symmetries()
    Ts: list[Floats] = []
    kept: list[View] = []
    for k in order:
        turns = [poses[k] @ np.linalg.inv(S) for S in motions]
        near = [np.trace(Ts[-1][:3, :3].T @ T[:3, :3]) for T in turns] if Ts else [0.0]
        best = int(np.argmax(near))
        Ts.append(turns[best])
        kept.append(replace(views[k], ids=labels[best][views[k].ids]) if best else views[k])
    return Track(time_s[order], np.array(Ts).reshape(-1, 4, 4), tuple(kept))


def motion_of(track: Track, at_s: Floats, ahead_s: Floats | float = 0.0) -> tuple[Floats, Floats]:
    """Twists (M, 6) in the board's frame at times (M,): rotation (rad/s), translation (m/s); their sigma.

    A cubic through the poses of `_WINDOW_S` on each side, as motions from the nearest one: its slope, or,
    where `ahead_s` (M,) is not 0, the steady motion that arrives where the cubic does that much later. NaN
    where the window has fewer than `_FEWEST` poses, or less than two on one side.
    """
    twist, sigma = np.full((2, len(at_s), 6), np.nan)
    ahead = np.broadcast_to(ahead_s, len(at_s))
    low = np.searchsorted(track.time_s, at_s - _WINDOW_S)
    high = np.searchsorted(track.time_s, at_s + _WINDOW_S, side="right")
    for k, (i, j) in enumerate(zip(low, high, strict=True)):
        s = track.time_s[i:j] - at_s[k]
        if j - i < _FEWEST or s[1] > 0 or s[-2] < 0:
            continue
        middle = track.T[i + int(np.abs(s).argmin())]
        powers = s[:, None] ** np.arange(4)
        xi = _log(np.linalg.inv(middle) @ track.T[i:j])
        spread = np.linalg.inv(powers.T @ powers)
        fit = spread @ powers.T @ xi
        twist[k] = ahead[k] ** np.arange(3) @ fit[1:]
        left = ((xi - powers @ fit) ** 2).sum(0)
        sigma[k] = np.sqrt(left * spread[1, 1] / max(len(s) - 4, 1))
    return twist, sigma


def _log(T: Floats) -> Floats:
    """(N, 6) motions whose exponential is T (N, 4, 4)."""
    r = Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
    angle = np.linalg.norm(r, axis=1)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    c = np.where(small, 1 / 12, (1 - safe / 2 / np.tan(safe / 2)) / safe**2)
    t = T[:, :3, 3]
    once = np.cross(r, t)
    return np.hstack([r, t - once / 2 + c[:, None] * np.cross(r, once)])


def speeds(board: Board, twist: Floats) -> Floats:
    """(M, 2) of twists (M, 6): how fast the board turns (rad/s) and its middle moves (m/s)."""
    middle = board.points_m[board.visible].mean(0)
    velocity = twist[:, 3:] + np.cross(twist[:, :3], middle)
    return np.stack([np.linalg.norm(twist[:, :3], axis=1), np.linalg.norm(velocity, axis=1)], -1)


def estimate_offset(board: Board, a: Track, b: Track, *, limit_s: float = LIMIT_S) -> Offset:
    """The offset of b's clock to a's, at most `limit_s`, from the correlation of the board's speeds.

    Raises `InputError` where the board stands still, or the streams' motion has nothing in common.
    """
    where = " and ".join(track.views[0].camera for track in (a, b) if track.views)
    one, two = _signal(board, a), _signal(board, b)
    shift, score, overlap = _correlate(one, two, limit_s, where=where)
    notes = []
    drift, sigma = _drift(one, two, shift)
    length = b.time_s[-1] - b.time_s[0]
    if abs(drift) > 3 * sigma and abs(drift) * length > 0.005:
        apart = f"{1e3 * drift * length:.0f} ms over {length:.0f} s"
        notes.append(f"the clocks drift apart, {apart}: one offset is too few")
    return Offset(shift, score, overlap, drift, sigma, tuple(notes))


def _correlate(
    one: _Signal, two: _Signal, limit_s: float, around_s: float = 0.0, where: str = ""
) -> tuple[float, float, float]:
    """Offset, correlation there, and seconds of overlap: the mean of the channels that show motion."""
    moving = [c for c in range(2) if one.moving[c] and two.moving[c]]
    if not moving:
        what = "no offset can be estimated: the board stands still"
        raise InputError(
            what, where=where, hint="move and turn the board by hand for 20 s, or use still poses"
        )
    lags = around_s + np.arange(-limit_s, limit_s + _STEP_S / 2, _STEP_S)
    grid = np.arange(one.time_s[0], one.time_s[-1], _STEP_S)
    fixed = one.at(grid)
    steps = np.arange(len(grid) + len(lags) - 1) - (len(lags) - 1)
    wide = two.at(grid[0] - lags[0] + steps * _STEP_S)  # all that any lag asks for
    scores, lengths = np.full(len(lags), -np.inf), np.zeros(len(lags))
    least = min(2.0, 0.3 * (one.time_s[-1] - one.time_s[0]), 0.3 * (two.time_s[-1] - two.time_s[0]))
    for k in range(len(lags)):
        other = wide[len(lags) - 1 - k :][: len(grid)]
        good = np.isfinite(fixed[:, 0]) & np.isfinite(other[:, 0])
        lengths[k] = good.sum() * _STEP_S
        if lengths[k] > least:
            scores[k] = np.mean([_likeness(fixed[good, c], other[good, c]) for c in moving])
    best = int(scores.argmax())
    if not scores[best] > _ALIKE:
        what = f"no offset within {limit_s:g} s makes the board move alike (correlation {scores[best]:.2f})"
        raise InputError(what, where=where, hint="are these recordings of the same time, their stamps right?")
    return float(lags[best] + _STEP_S * _summit(scores, best)), float(scores[best]), float(lengths[best])


def _likeness(x: Floats, y: Floats) -> float:
    x, y = x - x.mean(), y - y.mean()
    return float(x @ y / max(np.linalg.norm(x) * np.linalg.norm(y), 1e-12))


def _summit(scores: Floats, k: int) -> float:
    """Where, in steps from k, a parabola through the neighbours is highest."""
    if not 0 < k < len(scores) - 1:
        return 0.0
    left, middle, right = scores[k - 1 : k + 2]
    bend = left - 2 * middle + right
    return float(np.clip((left - right) / (2 * bend), -0.5, 0.5)) if np.isfinite(bend) and bend < 0 else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _Signal:
    time_s: Floats
    value: Floats  # (N, 2)
    moving: tuple[bool, bool]

    def at(self, time_s: Floats) -> Floats:
        """Between neighbours that are near; NaN elsewhere."""
        right = np.clip(np.searchsorted(self.time_s, time_s), 1, len(self.time_s) - 1)
        wide = self.time_s[right] - self.time_s[right - 1] > _WINDOW_S
        outside = wide | (time_s < self.time_s[0]) | (time_s > self.time_s[-1])
        values = np.stack([np.interp(time_s, self.time_s, column) for column in self.value.T], -1)
        return np.where(outside[:, None], np.nan, values)


def _signal(board: Board, track: Track) -> _Signal:
    twist, sigma = motion_of(track, track.time_s)
    good = np.isfinite(twist).all(1)
    if good.sum() < 2:
        name = track.views[0].camera if track.views else ""
        what = (
            f"no offset can be estimated: the board is followed in {len(track.time_s)} images, never for long"
        )
        raise InputError(what, where=name, hint="record at 10 images/s or more, the board always in view")
    value = speeds(board, twist[good])
    typical = np.sqrt((value**2).mean(0))
    noise = [np.sqrt(np.median((sigma[good, c : c + 3] ** 2).sum(1))) for c in (0, 3)]
    moving = [bool(typical[c] > max(_STILL[c], 2 * noise[c])) for c in range(2)]
    return _Signal(track.time_s[good], value, (moving[0], moving[1]))


def _drift(one: _Signal, two: _Signal, shift: float, parts: int = 4) -> tuple[float, float]:
    """Change of the offset by second, and its sigma (inf where it is too short), from parts of it."""
    edges = np.linspace(two.time_s[0], two.time_s[-1], parts + 1)
    if edges[1] - edges[0] < 3:
        return 0.0, np.inf
    middles, found = [], []
    for low, high in pairwise(edges):
        rows = (two.time_s >= low) & (two.time_s <= high)
        if rows.sum() < _FEWEST:
            continue
        part = _Signal(two.time_s[rows], two.value[rows], two.moving)
        try:
            found.append(_correlate(one, part, 0.1, shift)[0])
            middles.append((low + high) / 2)
        except InputError:  # the board rests in this part
            continue
    if len(found) < 3:
        return 0.0, np.inf
    A = np.stack([np.ones(len(found)), np.array(middles) - np.mean(middles)], 1)
    x, *_ = np.linalg.lstsq(A, np.array(found), rcond=None)
    left = float(np.linalg.norm(A @ x - found)) / np.sqrt(len(found) - 2)
    return float(x[1]), max(left, 1e-4) / float(np.linalg.norm(A[:, 1]))


# --- the views again, with the offset


def with_offsets(
    board: Board,
    cameras: Mapping[str, RigCamera],
    views: Sequence[View],
    moment_ns: Mapping[str, int],
    reference: str,
    keep: Collection[str] = (),
) -> Timed:
    """Offsets of all cameras to the reference, views paired anew with them, and the twist of each moment.

    Moments are the reference's images, those that differ most, and those in `keep`. Raises
    `UsageError` where a view has no stamp, `InputError` where the board stands still or the motions have
    nothing in common.
    """
    if any(view.moment not in moment_ns for view in views):
        raise UsageError("an offset of clocks needs time stamps", hint="or use still poses (timing static)")
    origin = min(moment_ns[view.moment] for view in views)
    tracks, offsets = {}, {}
    notes: list[str] = []
    for name, camera in cameras.items():
        own = [view for view in views if view.camera == name]
        time_s = np.array([(moment_ns[v.moment] - origin) * 1e-9 + v.lag_s for v in own])
        tracks[name] = track_of(board, camera, own, time_s)
        if name != reference:
            offset = estimate_offset(board, tracks[reference], tracks[name])
            offsets[name] = offset.seconds
            notes += [f"{name}: {note}" for note in offset.notes]
    paired, twist, chosen = _paired(tracks, offsets, reference, keep)
    notes.append(chosen)
    return Timed(paired, twist, offsets, notes)


def _paired(
    tracks: Mapping[str, Track], offsets: Mapping[str, float], reference: str, keep: Collection[str]
) -> tuple[list[View], dict[str, Floats], str]:
    """Views of the moments that differ most, of those that several cameras saw while the motion is known."""
    ref = tracks[reference]
    twist, _ = motion_of(ref, ref.time_s)
    partners: dict[int, list[tuple[str, int]]] = {}
    for name, offset in offsets.items():
        other = tracks[name]
        limit = 0.6 * float(np.median(np.diff(ref.time_s)))
        for i, j in nearest_one_to_one(ref.time_s, other.time_s + offset):
            if abs(ref.time_s[i] - other.time_s[j] - offset) <= limit and np.isfinite(twist[i]).all():
                partners.setdefault(i, []).append((name, j))
    index = {id(ref.views[i]): i for i in partners}
    spread = [index[id(v)] for v in spread_views([ref.views[i] for i in sorted(partners)], _MOST_MOMENTS)]
    chosen = sorted({*spread, *(i for i in partners if ref.views[i].moment in keep)})
    paired: list[View] = []
    motion: dict[str, Floats] = {}
    for i in chosen:
        moment = ref.views[i].moment
        paired.append(replace(ref.views[i], lag_s=0.0))
        # the track bends: the motion that takes the board from here to where the others saw it
        ahead = np.mean([tracks[name].time_s[j] + offsets[name] - ref.time_s[i] for name, j in partners[i]])
        motion[moment] = motion_of(ref, ref.time_s[i : i + 1], float(ahead))[0][0]
        for name, j in partners[i]:
            lag = float(tracks[name].time_s[j] - ref.time_s[i])
            paired.append(replace(tracks[name].views[j], moment=moment, lag_s=lag))
    return paired, motion, f"{len(chosen)} of {len(partners)} moments that the cameras share take part"
