"""The board in a LiDAR's cloud: its plane, and the rim of its plate."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from calib.boards import Board
from calib.lidar.plate import FREE, Placed, Plane, Rays, fit_plane, place, rays_of, rim, upright_axes
from calib.observations import CloudView, Refusal
from fusion.errors import UsageError
from fusion.geometry import Floats, pose

FEWEST_POINTS = 24
MOST_POINTS = 1500  # of a plane, spread evenly: more make a solve slower, not better
NEAREST_M, FARTHEST_M = 0.3, 15.0
MOST_SCATTER_M = 0.03  # of a plate's points: more is rock, or a cloud put together wrongly
GUESS_M, GUESS_RAD = 0.25, np.radians(12)  # how far off a guess may be
_DOWN = np.array([0.0, 0.0, -1.0])  # of the board's y, without a guess
_MOST_SEEDS, _MOST_PLACED = 300, 5
_ENOUGH_TO_GROW = 16000  # points


@dataclass(frozen=True, slots=True, eq=False)
class CloudBoard:
    """A board found in a cloud.

    `T_lidar_board` is its pose from plane and rim alone. `sigma_plane_m` is the scatter of the points about
    the plane, `sigma_edge_m` that of the rim's points from the rays' spacing (uniform between two rays; NaN
    without rim). `points` is how many lie on the plate, `invalid` how many points of the cloud were NaN,
    infinite or zero.
    """

    view: CloudView
    T_lidar_board: Floats
    sigma_plane_m: float
    sigma_edge_m: float
    points: int
    invalid: int


def find_in_cloud(
    xyz_m: NDArray[np.floating],
    board: Board,
    *,
    T_lidar_board_guess: Floats | None = None,
    rings: NDArray[np.integer] | None = None,
    moment: str = "",
    sensor: str = "lidar",
    file: str = "",
) -> CloudBoard | Refusal:
    """The board in a cloud of N x 3 points, LiDAR frame, in one scan from one place.

    With a guess (good to about 12 degrees and 0.25 m as the sensors stand) it is looked for there; without,
    anywhere up to 15 m away, and the board is taken to be upright within 45 degrees (which of a plate's sides
    is its top cannot be seen). It must be a flat patch of the plate's size, with rays passing it on the
    sides: a piece of a wall is none. `rings` (N,) names the laser of each point; with it the rim is also
    found before the sky. Points that are NaN, infinite or zero are left out and counted. Raises `UsageError`
    if the board's plate is not known.
    """
    size, T_board_plate = plate_of(board)
    xyz, rings, invalid = _valid(xyz_m, rings)
    guess = None if T_lidar_board_guess is None else T_lidar_board_guess @ T_board_plate
    nearby = _nearby(xyz, guess, size)
    toward = KDTree(xyz / np.linalg.norm(xyz, axis=1, keepdims=True))
    looks = []
    for plane in _patches(xyz[nearby], size, guess):
        axes, rows = _axes(plane, guess), _cone(toward, plane, size)
        look = _first_look(rays_of(xyz[rows], plane, axes, _reach(size), None), size)
        if look > 0:
            looks.append((look, plane, axes, rows))
    best: tuple[tuple[bool, float], Plane, Floats, Rays, Placed] | None = None
    for _, plane, axes, rows in sorted(looks, key=lambda look: -look[0])[:_MOST_PLACED]:
        rays = rays_of(xyz[rows], plane, axes, _reach(size), None if rings is None else rings[rows])
        rays = replace(rays, index=np.where(rays.index < 0, -1, rows[rays.index]))
        placed = place(rays, plane, axes, size, np.radians(20))
        score = placed.good, placed.score * np.sqrt(np.count_nonzero(rays.on & placed.inside))
        if best is None or score > best[0]:
            best = score, plane, axes, rays, placed
    if best is None:
        return Refusal(_nothing(len(nearby), guess, invalid))
    _, plane, axes, rays, placed = best
    if not placed.good:
        return Refusal(_no_plate(placed, plane))
    return _found(xyz, size, T_board_plate, plane, axes, rays, placed, (moment, sensor, file), invalid)


def plate_of(board: Board) -> tuple[Floats, Floats]:
    """The plate's width and height (2,), and T_board_plate of its middle. `UsageError` if unknown."""
    if board.plate_m is None:
        hint = "measure its edges from the first corner: plate_m = [left, top, right, bottom]"
        raise UsageError("the board does not say how large its plate is, which a LiDAR needs", hint=hint)
    x0, y0, x1, y1 = board.plate_m
    return np.array([x1 - x0, y1 - y0]), pose(np.eye(3), ((x0 + x1) / 2, (y0 + y1) / 2, 0))


def _valid(
    xyz_m: NDArray[np.floating], rings: NDArray[np.integer] | None
) -> tuple[Floats, NDArray[np.integer] | None, int]:
    xyz = np.asarray(xyz_m, np.float64)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or (rings is not None and rings.shape != xyz.shape[:1]):
        raise ValueError(f"expected N x 3 points and N rings, got {xyz.shape}")
    valid = np.isfinite(xyz).all(1) & (xyz != 0).any(1)
    return xyz[valid], None if rings is None else rings[valid], int((~valid).sum())


def _nearby(xyz: Floats, guess: Floats | None, size: Floats) -> NDArray[np.intp]:
    away = (xyz**2).sum(1)
    near = (away > NEAREST_M**2) & (away < FARTHEST_M**2)
    if guess is not None:
        centre = guess[:3, 3]
        reach = np.hypot(*size) / 2 + GUESS_M + GUESS_RAD * np.linalg.norm(centre)
        near = ((xyz - centre) ** 2).sum(1) < reach**2
    return np.flatnonzero(near)


def _reach(size: Floats) -> float:
    return 0.5 * float(np.hypot(*size)) + 0.6 * float(size.min())


def _cone(toward: KDTree, plane: Plane, size: Floats) -> NDArray[np.intp]:
    """Rows of the rays that may meet the plane near its centre."""
    away = float(np.linalg.norm(plane.centre_m))
    chord = 2 * np.sin(0.5 * np.arctan2(_reach(size), max(away - _reach(size) / 2, 0.1)))
    return np.sort(np.array(toward.query_ball_point(plane.centre_m / away, chord), np.intp))


def _first_look(rays: Rays, size: Floats) -> float:
    """How well rays stop about the middle and pass beyond the plate's reach, 0 to 1; 0: no plate."""
    away = np.linalg.norm(rays.uv, axis=1)
    within, beyond = away < size.min() / 3, away > np.hypot(*size) / 2 + 0.1 * size.min()
    stopped, passed = np.count_nonzero(rays.on & within), np.count_nonzero(rays.through & within)
    kept, free = np.count_nonzero(rays.on & beyond), np.count_nonzero(rays.through & beyond)
    if stopped < 4 or stopped < 2 * passed or free < kept:
        return 0.0
    return stopped / (stopped + passed) * (free / (free + kept) if free + kept else 0.5)


def _axes(plane: Plane, guess: Floats | None) -> Floats:
    if guess is not None:
        return upright_axes(plane.normal, guess[:3, 0])
    down = _DOWN if abs(plane.normal[2]) < 0.95 else np.array([-1.0, 0, 0])
    return upright_axes(plane.normal, np.cross(down, plane.normal))


def _patches(xyz: Floats, size: Floats, guess: Floats | None) -> list[Plane]:
    """Flat patches that may be the plate, each once: grown from flat cells of half the plate's shorter side.

    A cloud of more than 16,000 points is thinned out for it.
    """
    if len(xyz) < FEWEST_POINTS // 2:
        return []
    thin = xyz[:: max(1, round(len(xyz) / _ENOUGH_TO_GROW))]
    tree, found = KDTree(thin), []
    half_diagonal = float(np.hypot(*size)) / 2
    for centre, normal in _seeds(xyz, float(size.min()) / 2, guess):
        if any(_same(plane, centre, normal, size) for plane in found):
            continue
        plane = _grown(thin, tree, centre, normal, half_diagonal)
        if plane is not None and not any(_same(p, plane.centre_m, plane.normal, size) for p in found):
            found.append(plane)
    return found


def _same(plane: Plane, centre: Floats, normal: Floats, size: Floats) -> bool:
    off = centre - plane.centre_m
    return bool(
        abs(plane.normal @ normal) > 0.98
        and abs(off @ plane.normal) < 0.05
        and np.linalg.norm(off) < 0.25 * size.min()
    )


def _seeds(xyz: Floats, cell_m: float, guess: Floats | None) -> list[tuple[Floats, Floats]]:
    """Centre and normal of cells whose points are flat, those with most points first."""
    _, cell = np.unique(np.floor(xyz / cell_m).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    count = np.bincount(cell)
    mean = np.stack([np.bincount(cell, xyz[:, k]) for k in range(3)], 1) / count[:, None]
    d = xyz - mean[cell]
    C = np.empty((len(count), 3, 3))
    for i in range(3):
        for j in range(3):
            C[:, i, j] = np.bincount(cell, d[:, i] * d[:, j]) / count
    spread, axes = np.linalg.eigh(C)
    normal = axes[:, :, 0]
    # Flat, and no mere line of one ring.
    flat = (count >= 6) & (spread[:, 0] < 0.04**2) & (spread[:, 1] > (0.08 * cell_m) ** 2)
    flat &= spread[:, 1] > 4 * spread[:, 0]
    if guess is not None:
        flat &= np.abs(normal @ guess[:3, 2]) > np.cos(GUESS_RAD + np.radians(20))
    chosen = np.flatnonzero(flat)
    chosen = chosen[np.argsort(-count[chosen], kind="stable")][:_MOST_SEEDS]
    return [(mean[k], normal[k]) for k in chosen]


def _grown(xyz: Floats, tree: KDTree, centre: Floats, normal: Floats, radius: float) -> Plane | None:
    """The plane of all points around, centre and tilt settled in a few steps; None if it goes on beyond."""
    plane = Plane(normal, centre, 0.02)
    for _ in range(5):
        around = xyz[tree.query_ball_point(plane.centre_m, 1.3 * radius)]
        off = around - plane.centre_m
        away = np.linalg.norm(off, axis=1)
        on = np.abs(off @ plane.normal) < max(plane.tolerance_m, 0.04)
        inner = on & (away < radius)
        if np.count_nonzero(inner) < FEWEST_POINTS // 2:
            return None
        if plane.sigma_m > MOST_SCATTER_M or np.count_nonzero(on & ~inner) > 0.5 * np.count_nonzero(
            inner
        ):  # 0.69 if evenly filled
            return None
        plane = fit_plane(around[inner])
    return plane


def _found(
    xyz: Floats,
    size: Floats,
    T_board_plate: Floats,
    plane: Plane,
    axes: Floats,
    rays: Rays,
    placed: Placed,
    named: tuple[str, str, str],
    invalid: int,
) -> CloudBoard | Refusal:
    T_lidar_board = placed.T_lidar_plate @ _inverse_shift(T_board_plate)
    rows = rays.index[rays.on & placed.inside]
    # The outermost ring of points may be half plate, half background.
    local = (xyz[rows] - placed.T_lidar_plate[:3, 3]) @ placed.T_lidar_plate[:3, :2]
    inner = rows[(np.abs(local) < size / 2 - min(rays.step_m, 0.1 * size.min())).all(1)]
    away = float(np.linalg.norm(plane.centre_m))
    if len(inner) < FEWEST_POINTS:
        what = f"only {len(inner)} points on the board, {away:.1f} m away; {FEWEST_POINTS} are needed"
        return Refusal(f"{what}: hold it nearer")
    kept = inner[np.linspace(0, len(inner) - 1, min(len(inner), MOST_POINTS)).round().astype(np.intp)]
    edge, side, sigma = rim(rays, plane, axes, placed, size)
    moment, sensor, file = named
    view = CloudView(moment, xyz[kept], edge, side, sensor, file)
    return CloudBoard(view, T_lidar_board, plane.sigma_m, sigma, len(rows), invalid)


def _inverse_shift(T: Floats) -> Floats:
    return pose(np.eye(3), -T[:3, 3])


def _nothing(nearby: int, guess: Floats | None, invalid: int) -> str:
    where = f"up to {FARTHEST_M:.0f} m away"
    if guess is not None:
        where = f"around where it should be, {np.linalg.norm(guess[:3, 3]):.1f} m away"
    left_out = f", {invalid} of no use" if invalid else ""
    return f"no flat patch of the plate's size {where} ({nearby} points there{left_out})"


def _no_plate(placed: Placed, plane: Plane) -> str:
    away = np.linalg.norm(plane.centre_m)
    if placed.stopped < FREE:
        return f"the flattest patch, {away:.1f} m away, fills only {placed.stopped:.0%} of the plate"
    return (
        f"the flat patch {away:.1f} m away goes on beyond the plate: {1 - placed.free:.0%} of the rays around"
    )
