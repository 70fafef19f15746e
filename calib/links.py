"""Labels and poses that all cameras agree on, before anything is solved together.

A board without codes looks the same turned by half, a board that the frame cuts may be labelled a row off,
and a stream may be mirrored: each camera alone fits all of that. Only together do they contradict, so every
pair of cameras is asked which of the poses it could have explains most moments.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib.boards import Board
from calib.initial import frame_points, misfit_rad, poses_of, refine_link, symmetry_motions
from calib.moments import PairRow, pair_rows
from calib.observations import View
from fusion.errors import InputError
from fusion.geometry import FisheyeCamera, Floats, PinholeCamera, invert, transform
from fusion.rig import RigCamera

_CAP_RAD = 0.05  # what a moment that contradicts costs
_AGREES = 0.02  # of the image's diagonal, over the camera's focal length: what still agrees
_CANDIDATES = 15
_CLOSURE_PX, _CLOSURE_TIMES = 3.0, 6.0


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """T_a_b, the moments that agree with it, all that are shared, and the rms angle of those that agree."""

    a: str
    b: str
    T_a_b: Floats
    agreeing: int
    shared: int
    misfit_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class Joined:
    """Views relabelled so that they agree, where boards and sensors are, and what was left out."""

    views: list[View]
    T_ref_sensor: dict[str, Floats]
    T_ref_board: dict[str, Floats]
    dropped: list[tuple[str, str]]
    notes: list[str]


def join_views(
    board: Board,
    cameras: Mapping[str, RigCamera],
    views: Sequence[View],
    reference: str,
    moment_ns: Mapping[str, int] | None = None,
) -> Joined:
    """A start for all cameras together: links of pairs, a tree over them, labels that agree, closure.

    Raises `InputError` where a camera is not connected to the reference, does not agree, or is mirrored.
    """
    poses = _poses_by_moment(board, cameras, views)
    links = [
        link
        for a, b in combinations(cameras, 2)
        if (link := find_link(board, cameras[b], a, b, poses[a], poses[b])) is not None
    ]
    links = [_trusted(board, cameras, views, link, poses) for link in links]
    T_ref_sensor = _tree(links, reference, list(cameras), views, moment_ns or {})
    kept, dropped, turned = _close(board, cameras, views, poses, T_ref_sensor)
    boards = _boards(board, cameras, kept, T_ref_sensor)
    notes = (
        [f"{turned} views had the board turned: relabelled to agree with the other cameras"] if turned else []
    )
    return Joined([v for v in kept if v.moment in boards], T_ref_sensor, boards, dropped, notes)


def _poses_by_moment(
    board: Board, cameras: Mapping[str, RigCamera], views: Sequence[View]
) -> dict[str, dict[str, Floats]]:
    poses: dict[str, dict[str, Floats]] = {}
    for name, camera in cameras.items():
        own = [view for view in views if view.camera == name]
        poses[name] = {own[k].moment: T for k, T in poses_of(board, camera, own)[0].items()}
    return poses


def find_link(
    board: Board, camera_b: RigCamera, a: str, b: str, T_a: Mapping[str, Floats], T_b: Mapping[str, Floats]
) -> Link | None:
    """The T_a_b that most shared moments agree with, each under the symmetry of the board that suits it.

    Every moment proposes one for each symmetry; where several explain all equally well, as when the board
    never turned, the least rotation counts. None where no moment is shared.
    """
    shared = [moment for moment in T_a if moment in T_b]
    if not shared:
        return None
    A, B = np.stack([T_a[m] for m in shared]), np.stack([T_b[m] for m in shared])
    turned = np.stack([A @ S for S in symmetry_motions(board)])  # K x M x 4 x 4
    xyz = frame_points(board)
    some = np.unique(np.linspace(0, len(shared) - 1, min(_CANDIDATES, len(shared))).round().astype(int))
    proposed = [T[m] @ invert(B[m]) for T in turned for m in some]
    costs = np.array([np.minimum(_misfits(T, turned, B, xyz).min(0), _CAP_RAD).mean() for T in proposed])
    angles = [Rotation.from_matrix(T[:3, :3]).magnitude() for T in proposed]
    good = np.flatnonzero(costs <= 1.3 * costs.min() + 2e-4)
    T_a_b = proposed[min(good, key=lambda k: (round(angles[k], 1), costs[k]))]
    limit = _AGREES * float(np.hypot(*camera_b.size_wh)) / camera_b.fx
    for _ in range(3):
        misfits = _misfits(T_a_b, turned, B, xyz)
        k, least = misfits.argmin(0), misfits.min(0)
        agree = least <= np.clip(4 * np.median(least), 1e-6, limit)
        if not agree.any():
            break
        rows = np.flatnonzero(agree)
        T_a_b = refine_link(T_a_b, turned[k[rows], rows], B[rows], xyz)
    least = _misfits(T_a_b, turned, B, xyz).min(0)
    agree = least <= limit
    rms = float(np.sqrt((least[agree] ** 2).mean())) if agree.any() else np.inf
    return Link(a, b, T_a_b, int(agree.sum()), len(shared), rms)


def _misfits(T_a_b: Floats, turned: Floats, B: Floats, xyz: Floats) -> Floats:
    """K x M angles in radians, by symmetry and moment."""
    return misfit_rad(T_a_b, turned, B[None], xyz)


def _trusted(
    board: Board,
    cameras: Mapping[str, RigCamera],
    views: Sequence[View],
    link: Link,
    poses: Mapping[str, Mapping[str, Floats]],
) -> Link:
    """The link, if most of its moments agree. Raises `InputError` that says what is likely wrong."""
    if link.agreeing > 0.5 * link.shared or link.shared < 3:
        return link
    a, b = link.a, link.b
    where = f"{a} and {b}"
    mirrored = _mirrored_link(board, cameras, views, link, poses)
    if mirrored is not None and mirrored.agreeing > 0.7 * link.shared:
        upright = np.trace(mirrored.T_a_b[:2, :2]) > 0
        how = "left-right" if upright else "top-bottom"
        what = f"the images of {b} are mirrored {how} against {a}'s"
        hint = f"flip {b} {how} (or {a}, if that is the mirrored one) and detect again"
        raise InputError(f"{what}: so {mirrored.agreeing} of {link.shared} moments agree", hint=hint)
    what = f"they do not agree where the board is: one pose explains {link.agreeing} of {link.shared} moments"
    hint = "are the images matched rightly (names, clocks), and did the board and the rig stand still?"
    raise InputError(what, where=where, hint=hint)


def _mirrored_link(
    board: Board,
    cameras: Mapping[str, RigCamera],
    views: Sequence[View],
    link: Link,
    poses: Mapping[str, Mapping[str, Floats]],
) -> Link | None:
    relabel = reflection(board)
    if relabel is None:
        return None
    camera, width = mirrored_camera(cameras[link.b]), cameras[link.b].size_wh[0]
    flipped = [
        replace(v, ids=relabel[v.ids], uv=np.stack([width - 1 - v.uv[:, 0], v.uv[:, 1]], -1))
        for v in views
        if v.camera == link.b and v.moment in poses[link.a]
    ]
    T_b = {flipped[k].moment: T for k, T in poses_of(board, camera, flipped)[0].items()}
    return find_link(board, camera, link.a, link.b, poses[link.a], T_b)


def reflection(board: Board) -> NDArray[np.intp] | None:
    """`ids -> reflection[ids]` of the board seen in a mirror; None where it then is another board."""
    seen = np.flatnonzero(board.visible)
    xy = board.points_m[seen][:, :2]
    mirrored = xy * (-1, 1) + (xy[:, 0].min() + xy[:, 0].max(), 0)
    away = np.linalg.norm(mirrored[:, None] - xy[None], axis=2)
    if board.coded or away.min(1).max() > 1e-6 * board.spacing_m:
        return None
    ids = np.arange(len(board.points_m))
    ids[seen] = seen[away.argmin(1)]
    return ids


def mirrored_camera(camera: RigCamera) -> RigCamera:
    """The camera whose pictures are this one's, mirrored left-right."""
    cx = camera.size_wh[0] - 1 - camera.cx
    if isinstance(camera, FisheyeCamera) or not camera.distortion:
        return replace(camera, cx=cx)
    k1, k2, p1, p2, *rest = camera.distortion
    return PinholeCamera(camera.size_wh, camera.fx, camera.fy, cx, camera.cy, (k1, k2, p1, -p2, *rest))


def _tree(
    links: Sequence[Link],
    reference: str,
    cameras: Sequence[str],
    views: Sequence[View],
    moment_ns: Mapping[str, int],
) -> dict[str, Floats]:
    """T_ref_sensor along the links with most moments, one camera after the other (Prim)."""
    T_ref: dict[str, Floats] = {reference: np.eye(4)}
    while True:
        open_links = [link for link in links if (link.a in T_ref) != (link.b in T_ref) and link.agreeing]
        if not open_links:
            break
        link = max(open_links, key=lambda item: (item.agreeing, -item.misfit_rad))
        if link.a in T_ref:
            T_ref[link.b] = T_ref[link.a] @ link.T_a_b
        else:
            T_ref[link.a] = T_ref[link.b] @ invert(link.T_a_b)
    missing = [name for name in cameras if name not in T_ref]
    if missing:
        raise _not_connected(missing, list(T_ref), pair_rows(views, moment_ns))
    return {name: T_ref[name] for name in cameras}


def _not_connected(missing: Sequence[str], reached: Sequence[str], rows: Sequence[PairRow]) -> InputError:
    what = f"{', '.join(missing)}: no moment in which {'it' if len(missing) == 1 else 'they'} and "
    what += f"{' or '.join(reached)} saw the board. Pairs: {'; '.join(str(row) for row in rows)}"
    across = [r for r in rows if (r.a in reached) != (r.b in reached) and r.tolerance_s is not None]
    if across:
        best = min(across, key=lambda row: row.tolerance_s or np.inf)
        hint = f"allow {best.tolerance_s:g} s between the stamps of {best.a} and {best.b}"
        return InputError(what, hint=f"{hint} if the board stood still, or estimate the offset of the clocks")
    links = " or ".join(f"{m} and {r}" for m in missing[:1] for r in reached)
    return InputError(what, hint=f"record the board where {links} see it at once, or match by name or order")


# --- labels that agree


def _close(
    board: Board,
    cameras: Mapping[str, RigCamera],
    views: Sequence[View],
    poses: Mapping[str, Mapping[str, Floats]],
    T_ref_sensor: Mapping[str, Floats],
) -> tuple[list[View], list[tuple[str, str]], int]:
    """Views relabelled to agree with the first of their moment; those that contradict, dropped and named."""
    moments: dict[str, list[View]] = {}
    for view in views:
        if view.moment in poses[view.camera]:
            moments.setdefault(view.moment, []).append(view)
    check = _Closure(board, cameras, poses, T_ref_sensor)
    gaps = {m: check.gaps(seen) for m, seen in moments.items()}
    usual = [float(g[np.triu_indices(len(g), 1)].min()) for g, _ in gaps.values() if len(g) > 1]
    limit = max(_CLOSURE_PX, _CLOSURE_TIMES * float(np.median(usual))) if usual else np.inf
    kept: list[View] = []
    dropped: list[tuple[str, str]] = []
    turned = 0
    for moment, seen in moments.items():
        gap, how = gaps[moment]
        size = [len(view.ids) for view in seen]
        anchor = max(range(len(seen)), key=lambda k: ((gap[k] <= limit).sum(), size[k], -k))
        agree = np.flatnonzero(gap[anchor] <= limit)
        first = int(agree[0])
        for k, view in enumerate(seen):
            if k not in agree:
                reason = f"its board is {gap[anchor, k]:.1f} px off where {seen[anchor].camera} sees it"
                dropped.append(
                    (view.file or f"{view.camera} {moment}", f"{reason}: wrongly labelled, or moved")
                )
                continue
            turn = int(how[first, k])
            turned += turn > 0
            kept.append(replace(view, ids=check.labels[turn][view.ids]) if turn else view)
    without = [v for v in views if v.moment not in poses[v.camera]]
    dropped += [(v.file or f"{v.camera} {v.moment}", "no pose of the board explains it") for v in without]
    return kept, dropped, turned


class _Closure:
    """How far, in px, one camera's board lies off where another sees it, as the best symmetry has it."""

    def __init__(
        self,
        board: Board,
        cameras: Mapping[str, RigCamera],
        poses: Mapping[str, Mapping[str, Floats]],
        T_ref_sensor: Mapping[str, Floats],
    ) -> None:
        self.xyz, self.cameras, self.poses, self.T = board.points_m, cameras, poses, T_ref_sensor
        self.labels = board.symmetries()

    def gaps(self, seen: Sequence[View]) -> tuple[Floats, NDArray[np.intp]]:
        """N x N px, and by which symmetry the second must be relabelled to agree with the first.

        The less of two directions counts: a part of a board says little about where the rest of it is.
        """
        count = len(seen)
        gap, how = np.zeros((count, count)), np.zeros((count, count), np.intp)
        for i, j in combinations(range(count), 2):
            there = [self._gap(seen[i], seen[j], relabel) for relabel in self.labels]
            # relabelling one by S is relabelling the other by its inverse
            back = [self._gap(seen[j], seen[i], np.argsort(relabel)) for relabel in self.labels]
            best = np.minimum(there, back)
            how[i, j] = best.argmin()
            how[j, i] = self._inverse(int(how[i, j]))
            gap[i, j] = gap[j, i] = best.min()
        return gap, how

    def _gap(self, a: View, b: View, relabel: NDArray[np.intp]) -> float:
        T_b_board = invert(self.T[b.camera]) @ self.T[a.camera] @ self.poses[a.camera][a.moment]
        at, ok = self.cameras[b.camera].project(transform(T_b_board, self.xyz[relabel[b.ids]]))
        return float(np.median(np.linalg.norm(at - b.uv, axis=1))) if ok.mean() > 0.5 else np.inf

    def _inverse(self, turn: int) -> int:
        back = np.argsort(self.labels[turn])
        return next(k for k, labels in enumerate(self.labels) if np.array_equal(labels, back))


def _boards(
    board: Board, cameras: Mapping[str, RigCamera], views: Sequence[View], T_ref_sensor: Mapping[str, Floats]
) -> dict[str, Floats]:
    """T_ref_board of each moment, from the view that has most points."""
    best: dict[str, View] = {}
    for view in views:
        if view.moment not in best or len(view.ids) > len(best[view.moment].ids):
            best[view.moment] = view
    found = {}
    for name, camera in cameras.items():
        own = [view for view in best.values() if view.camera == name]
        for k, T in poses_of(board, camera, own)[0].items():
            found[own[k].moment] = T_ref_sensor[name] @ T
    return {moment: found[moment] for moment in best if moment in found}
