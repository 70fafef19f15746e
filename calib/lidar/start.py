"""Where a LiDAR stands, from a board that a camera and the LiDAR both saw in several poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calib.boards import Board
from calib.lidar.board import CloudBoard, find_in_cloud, plate_of
from calib.observations import CloudView, Refusal
from fusion.errors import InputError
from fusion.geometry import T_CAM_LIDAR, Floats, invert, pose, transform

FEWEST_POSES = 3
_ANGLE_RAD, _OFFSET_M, _MIDDLE_M = np.radians(3), 0.04, 0.12  # how far a pose may be off the others
_LEAST_SPREAD = (
    0.08  # third singular value of the unit normals over sqrt(poses): 0.08 is about 8 degrees of tilt
)
_MOST_TRIPLES = 400


@dataclass(frozen=True, slots=True, eq=False)
class LidarStart:
    """A LiDAR's place from boards: `T_ref_lidar` (4 x 4), the clouds that agree with it, and the others.

    `dropped` has (moment, reason). `sigma_plane_m` and `sigma_edge_m` are the scatter of points about their
    planes and the root mean square distance of the rims' points to the plates' sides, both with
    `T_ref_lidar`. `notes` says what the data leave weak.
    """

    T_ref_lidar: Floats
    views: tuple[CloudView, ...]
    dropped: tuple[tuple[str, str], ...]
    sigma_plane_m: float
    sigma_edge_m: float
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _Pose:
    """One moment: the board by the camera and by the LiDAR; planes n x = d, and the plates' middles."""

    moment: str
    T_ref_board: Floats
    found: CloudBoard
    n_ref: Floats
    d_ref: float
    middle_ref: Floats
    n_lidar: Floats
    d_lidar: float
    middle_lidar: Floats


def lidar_start(
    board: Board,
    T_ref_board: Mapping[str, Floats],
    clouds: Mapping[str, NDArray[np.floating]],
    rough: Floats | None = None,
    rings: Mapping[str, NDArray[np.integer]] | None = None,
    sensor: str = "lidar",
    files: Mapping[str, str] | None = None,
) -> LidarStart:
    """T_ref_lidar from the boards' poses in the reference camera and clouds (N x 3, LiDAR frame), by moment.

    `rough` is T_ref_lidar to about 10 degrees and 0.2 m; by default the LiDAR looks where the camera does (x
    forward along the camera's z); if fewer than three poses are found or agree so, boards are searched
    anywhere in the clouds. Normals give the rotation (Kabsch 1976), distances of planes and the plates'
    middles the translation; poses that do not agree with the most are dropped by name (RANSAC over triples,
    all of them or a seeded choice). Then all points of planes and rims together. Raises `InputError` for
    fewer than three poses, and for boards all parallel.
    """
    names = sorted(T_ref_board.keys() & clouds.keys())
    dropped = dict.fromkeys(T_ref_board.keys() - clouds.keys(), "no cloud of this moment")
    dropped |= dict.fromkeys(
        clouds.keys() - T_ref_board.keys(), "the board's pose in the camera is not known"
    )

    def search(moments: list[str], T_ref_lidar: Floats | None) -> tuple[list[_Pose], dict[str, str]]:
        poses, refused = [], {}
        for m in moments:
            guess = None if T_ref_lidar is None else invert(T_ref_lidar) @ T_ref_board[m]
            ring, file = (rings or {}).get(m), (files or {}).get(m, "")
            found = find_in_cloud(
                clouds[m], board, T_lidar_board_guess=guess, rings=ring, moment=m, sensor=sensor, file=file
            )
            if isinstance(found, Refusal):
                refused[m] = found.reason
            else:
                poses.append(_pose_of(m, T_ref_board[m], found, board))
        return poses, refused

    poses, refused = search(names, T_CAM_LIDAR if rough is None else rough)
    try:
        T, _ = _agreed(poses)
    except InputError as error:
        T = _anywhere(search(names, None)[0], error, dropped | refused)
        poses = []  # which of a plate's sides is its top was not known: again, now that it is
    more, refused = search([m for m in names if m not in {p.moment for p in poses}], T)
    poses = sorted(poses + more, key=lambda p: p.moment)
    T, agree = _agreed(poses)
    dropped |= refused
    dropped |= {
        p.moment: "does not agree with the other poses" for p, a in zip(poses, agree, strict=True) if not a
    }
    kept = [p for p, a in zip(poses, agree, strict=True) if a]
    T, planes, edges = _polished(T, kept, board)
    return LidarStart(
        T, tuple(p.found.view for p in kept), tuple(sorted(dropped.items())), planes, edges, _weak(kept)
    )


def _anywhere(poses: list[_Pose], error: InputError, dropped: Mapping[str, str]) -> Floats:
    """The place of the LiDAR from boards searched without a guess; else what was wrong with the guess."""
    try:
        return _agreed(poses)[0]
    except InputError:
        reasons = "; ".join(f"{m}: {r}" for m, r in sorted(dropped.items())[:3])
        raise InputError(f"the LiDAR cannot be placed: {error.what}", hint=reasons) from None


def _pose_of(moment: str, T_ref_board: Floats, found: CloudBoard, board: Board) -> _Pose:
    _, T_board_plate = plate_of(board)
    sides = []
    for T in (T_ref_board @ T_board_plate, found.T_lidar_board @ T_board_plate):
        normal, middle = T[:3, 2], T[:3, 3]
        sides += [normal, float(normal @ middle), middle]
    return _Pose(moment, T_ref_board, found, *sides)


def _agreed(poses: list[_Pose]) -> tuple[Floats, NDArray[np.bool_]]:
    """The pose that most poses agree with, from those that do, and which they are."""
    if len(poses) < FEWEST_POSES:
        raise InputError(
            f"the board was found in {len(poses)} clouds, at least {FEWEST_POSES} poses are needed"
        )
    triples = np.array(list(combinations(range(len(poses)), 3)))
    if len(triples) > _MOST_TRIPLES:
        triples = np.random.default_rng(0).permutation(triples)[:_MOST_TRIPLES]
    best, count = np.zeros(len(poses), bool), 0
    for triple in triples:
        some = [poses[k] for k in triple]
        if _spread(some) < _LEAST_SPREAD:
            continue
        agree = _agree(_of_planes(some), poses)
        if agree.sum() > count:
            best, count = agree, int(agree.sum())
    if count < FEWEST_POSES:
        raise InputError(_disagreement(poses))
    T = np.eye(4)
    for _ in range(3):
        T = _of_planes([p for p, a in zip(poses, best, strict=True) if a])
        best = _agree(T, poses)
    return T, best


def _disagreement(poses: list[_Pose]) -> str:
    if _spread(poses) < 1.5 * _LEAST_SPREAD:
        return "all boards are nearly parallel: tilt the board about both of its axes from pose to pose"
    return f"no three of {len(poses)} poses agree: the same board and moments in camera and LiDAR?"


def _spread(poses: list[_Pose]) -> float:
    normals = np.stack([p.n_ref for p in poses])
    return float(np.linalg.svd(normals, compute_uv=False)[-1] / np.sqrt(len(poses)))


def _of_planes(poses: list[_Pose]) -> Floats:
    """Rotation of the normals, then translation from the planes' distances and, weaker, the middles."""
    to, of = np.stack([p.n_ref for p in poses]), np.stack([p.n_lidar for p in poses])
    R = Rotation.align_vectors(to, of)[0].as_matrix()
    rows = [*to, *(0.3 * np.eye(3) for _ in poses)]
    distance = [p.d_ref - p.d_lidar for p in poses]
    middles = [0.3 * (p.middle_ref - R @ p.middle_lidar) for p in poses]
    t = np.linalg.lstsq(np.vstack(rows), np.r_[distance, np.concatenate(middles)], rcond=None)[0]
    return pose(R, t)


def _agree(T: Floats, poses: list[_Pose]) -> NDArray[np.bool_]:
    R, t = T[:3, :3], T[:3, 3]
    angle = [np.arccos(np.clip(p.n_ref @ R @ p.n_lidar, -1, 1)) < _ANGLE_RAD for p in poses]
    offset = [abs(p.n_ref @ (R @ p.middle_lidar + t) - p.d_ref) < _OFFSET_M for p in poses]
    middle = [np.linalg.norm(R @ p.middle_lidar + t - p.middle_ref) < _MIDDLE_M for p in poses]
    return np.array(angle) & np.array(offset) & np.array(middle)


def _polished(T: Floats, poses: list[_Pose], board: Board) -> tuple[Floats, float, float]:
    """T_ref_lidar that lays planes' points on the planes and rims' points on the sides; their scatter,
    metres.
    """

    def residuals(x: Floats) -> tuple[Floats, Floats]:
        moved = pose(Rotation.from_rotvec(x[:3]).as_matrix(), x[3:]) @ T
        off, out = [], []
        for p in poses:
            view, T_board_lidar = p.found.view, invert(p.T_ref_board) @ moved
            off.append(transform(T_board_lidar, view.plane_m)[:, 2])
            out.append(edge_distances(transform(T_board_lidar, view.edge_m), view.edge_of, board))
        return np.concatenate(off), np.concatenate(out)

    def scatter(x: Floats) -> tuple[float, float]:
        off, out = residuals(x)
        return _rms(off), _rms(out)

    def weighed(x: Floats, sigma: tuple[float, float]) -> Floats:
        return np.concatenate([r / max(s, 1e-6) for r, s in zip(residuals(x), sigma, strict=True) if len(r)])

    x = np.zeros(6)
    for _ in range(2):
        x = least_squares(weighed, x, args=(scatter(x),), loss="soft_l1", x_scale=[1e-3] * 6).x
    planes, edges = scatter(x)
    return pose(Rotation.from_rotvec(x[:3]).as_matrix(), x[3:]) @ T, planes, edges


def edge_distances(edge_board_m: Floats, edge_of: NDArray[np.intp], board: Board) -> Floats:
    """How far points of the rim (M x 3, board frame) lie outside the side that each belongs to, metres."""
    if board.plate_m is None or not len(edge_board_m):
        return np.zeros(len(edge_board_m))
    x0, y0, x1, y1 = board.plate_m
    x, y = edge_board_m[:, 0], edge_board_m[:, 1]
    return np.choose(edge_of, [y0 - y, x - x1, y - y1, x0 - x])


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean())) if values.size else float("nan")


def _weak(poses: list[_Pose]) -> tuple[str, ...]:
    notes = []
    if len(poses) < 8:
        notes.append(f"{len(poses)} poses only: ten or more make it firm")
    if _spread(poses) < 2 * _LEAST_SPREAD:
        notes.append("the boards' tilts hardly differ: tilt the board more, about both of its axes")
    if not any(len(p.found.view.edge_m) for p in poses):
        notes.append("no rim was seen: the planes alone place the LiDAR")
    return tuple(notes)
