"""Calibration sessions whose truth is known: boards before a rig of RGB, thermal and LiDAR, with noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import chi2

from calib.boards import Board
from calib.observations import CloudView, View
from calib.solve import Estimate, Solution, exp_motion, solve
from calib.solve.cameras import parameter_names, parameters, with_parameters
from fusion.geometry import T_CAM_LIDAR, FisheyeCamera, Floats, PinholeCamera, invert, transform
from fusion.rig import RigCamera

MODELS: dict[str, RigCamera] = {
    "pinhole0": PinholeCamera((640, 480), 520.0, 522.0, 322.9, 234.3),
    "pinhole4": PinholeCamera((640, 480), 520.0, 522.0, 322.9, 234.3, (-0.19, 0.035, 4e-4, -3e-4)),
    "pinhole5": PinholeCamera((640, 480), 520.0, 522.0, 322.9, 234.3, (-0.21, 0.07, 4e-4, -3e-4, -0.01)),
    "pinhole8": PinholeCamera(
        (640, 480), 520.0, 522.0, 322.9, 234.3, (0.25, 0.06, 4e-4, -3e-4, 0.005, 0.45, 0.12, 0.01)
    ),
    "fisheye": FisheyeCamera((640, 480), 330.0, 331.0, 322.9, 234.3, (-0.03, 0.008, -0.004, 0.0008)),
    "thermal5": PinholeCamera((640, 512), 560.0, 561.0, 315.4, 258.2, (-0.24, 0.09, -5e-4, 6e-4, 0.02)),
}
T_RGB_FIR = np.eye(4)
T_RGB_FIR[:3] = exp_motion(np.array([-0.014, 0.021, 0.0106, 0.075, -0.02, -0.01]))[:3]
T_RGB_LIDAR = exp_motion(np.array([0.012, -0.007, 0.0052, 0.0, -0.1, -0.07])) @ T_CAM_LIDAR
TIME_OFFSET_S = 0.012


@dataclass(frozen=True, slots=True)
class Scene:
    """What was seen, and the `truth`."""

    board: Board
    views: tuple[View, ...]
    clouds: tuple[CloudView, ...]
    truth: Estimate


def chessboard(cols: int = 9, rows: int = 6, spacing_m: float = 0.08) -> Board:
    """Inner corners in a grid on a plate with a border of one square and a half."""
    x, y = np.meshgrid(np.arange(cols) * spacing_m, np.arange(rows) * spacing_m)
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], -1).astype(np.float64)
    rim = 1.5 * spacing_m
    plate = (-rim, -rim, (cols - 1) * spacing_m + rim, (rows - 1) * spacing_m + rim)
    return Board("chessboard", cols, rows, spacing_m, points, np.ones(len(points), bool), plate)


def scene(
    seed: int,
    views: int = 30,
    noise_px: float = 0.1,
    models: Sequence[str] = ("pinhole5", "thermal5"),
    lidar_noise_m: float = 0.01,
    *,
    moving: bool = False,
    lidar: bool = True,
    tilt_rad: float = 0.6,
) -> Scene:
    """A session of `views` moments with cameras ``rgb``, ``fir`` (as many as `models`) and ``lidar``.

    Boards fill a third to most of the picture, tilted up to `tilt_rad` about any axis in the plane; every
    camera keeps the points that fall into its picture. Normal noise: `noise_px` on both coordinates,
    `lidar_noise_m` along the ray for points on the plane, on all three coordinates for those on the rim.
    With `moving`, boards move (0.3 m/s, 0.4 rad/s), the thermal camera's stamps differ from the moment's, and
    its clock and the LiDAR's are wrong by TIME_OFFSET_S and -TIME_OFFSET_S.
    """
    rng = np.random.default_rng(seed)
    board = chessboard()
    truth = _truth(rng, board, views, models, moving, tilt_rad)
    if not lidar:
        truth = replace(truth, T_ref_sensor={n: T for n, T in truth.T_ref_sensor.items() if n != "lidar"})
    seen = [
        view
        for moment in truth.T_ref_board
        for camera in truth.cameras
        if (view := _view(rng, board, truth, camera, moment, noise_px)) is not None
    ]
    scans = (
        [_cloud(rng, board, truth, moment, lidar_noise_m) for moment in truth.T_ref_board] if lidar else []
    )
    return Scene(board, tuple(seen), tuple(scans), truth)


def _truth(
    rng: np.random.Generator, board: Board, views: int, models: Sequence[str], moving: bool, tilt_rad: float
) -> Estimate:
    cameras = {name: MODELS[model] for name, model in zip(("rgb", "fir")[: len(models)], models, strict=True)}
    sensors = {"rgb": np.eye(4), "fir": T_RGB_FIR, "lidar": T_RGB_LIDAR}
    present = {n: T for n, T in sensors.items() if n in cameras or n == "lidar"}
    poses = {f"{i:03d}": _board_pose(rng, board, cameras["rgb"], tilt_rad) for i in range(views)}
    twist = {m: np.r_[rng.normal(0, 0.4, 3), rng.normal(0, 0.3, 3)] for m in poses} if moving else {}
    offsets = {"fir": TIME_OFFSET_S, "lidar": -TIME_OFFSET_S}
    timed = {n: s for n, s in offsets.items() if moving and n in present}
    return Estimate("rgb", cameras, present, poses, twist, timed)


def _board_pose(rng: np.random.Generator, board: Board, camera: RigCamera, tilt_rad: float) -> Floats:
    """T_rgb_board of a board whose middle lies well inside the picture."""
    w, h = camera.size_wh
    uv = np.array([[rng.uniform(0.2, 0.8) * w, rng.uniform(0.2, 0.8) * h]])
    away = rng.uniform(0.6, 1.4) * (0.6 if isinstance(camera, FisheyeCamera) else 1.0)
    middle = camera.unproject(uv)[0] * away
    axis = rng.uniform(0, 2 * np.pi)
    angle = tilt_rad * rng.uniform(0.3, 1)
    tilt = exp_motion(np.array([angle * np.cos(axis), angle * np.sin(axis), 0, 0, 0, 0]))
    T = tilt @ exp_motion(np.array([0, 0, rng.normal(0, 0.2 if tilt_rad else 0.0), 0, 0, 0]))
    T[:3, 3] = middle - T[:3, :3] @ board.points_m.mean(0)
    return T


def _view(
    rng: np.random.Generator, board: Board, truth: Estimate, camera: str, moment: str, noise_px: float
) -> View | None:
    model = truth.cameras[camera]
    lag_s = rng.uniform(-0.02, 0.02) if camera in truth.time_offset_s else 0.0
    T = invert(truth.T_ref_sensor[camera]) @ _pose_at(truth, moment, camera, lag_s)
    uv, seen = model.project(transform(T, board.points_m))
    w, h = model.size_wh
    seen &= ((uv >= 0) & (uv <= (w - 1, h - 1))).all(1)
    ids = np.flatnonzero(seen)
    noise = rng.normal(0, noise_px, uv.shape)
    if len(ids) < 12:
        return None
    return View(camera, moment, ids, (uv + noise)[ids], (w, h), lag_s, f"{camera}/{moment}.png")


def _cloud(rng: np.random.Generator, board: Board, truth: Estimate, moment: str, noise_m: float) -> CloudView:
    if board.plate_m is None:
        raise ValueError("expected a board with a plate")
    left, top, right, bottom = board.plate_m
    T = invert(truth.T_ref_sensor["lidar"]) @ _pose_at(truth, moment, "lidar", 0.0)
    on_plate = np.stack([rng.uniform(left, right, 200), rng.uniform(top, bottom, 200), np.zeros(200)], -1)
    plane = transform(T, on_plate)
    plane *= 1 + rng.normal(0, noise_m, (200, 1)) / np.linalg.norm(plane, axis=1, keepdims=True)
    side, share = np.repeat(np.arange(4), 20), rng.uniform(0, 1, 80)
    along, across = left + share * (right - left), top + share * (bottom - top)
    x = np.select([side == 1, side == 3], [right, left], along)
    y = np.select([side == 0, side == 2], [top, bottom], across)
    rim = np.stack([x, y, np.zeros(80)], -1) + rng.normal(0, noise_m, (80, 3))
    return CloudView(moment, plane, transform(T, rim), side, file=f"lidar/{moment}.pcd")


def _pose_at(truth: Estimate, moment: str, sensor: str, lag_s: float) -> Floats:
    s = lag_s + truth.time_offset_s.get(sensor, 0.0)
    return truth.T_ref_board[moment] @ exp_motion(s * truth.twist.get(moment, np.zeros(6)))


def perturbed(truth: Estimate, seed: int, amount: float = 1.0) -> Estimate:
    """A start as rough as initialisation gives: focal lengths 3 %, poses 2 degrees and 2 cm off."""
    rng = np.random.default_rng(seed)

    def jolt(T: Floats) -> Floats:
        return exp_motion(amount * np.r_[rng.normal(0, 0.035, 3), rng.normal(0, 0.02, 3)]) @ T

    def rough(camera: RigCamera) -> RigCamera:
        values = parameters(camera)
        values[:2] *= 1 + amount * rng.normal(0, 0.03)
        values[2:4] += amount * rng.normal(0, 5, 2)
        values[4:] *= 1 - min(amount, 1.0)
        return with_parameters(camera, values)

    return replace(
        truth,
        cameras={n: rough(c) for n, c in truth.cameras.items()},
        T_ref_sensor={n: T if n == truth.reference else jolt(T) for n, T in truth.T_ref_sensor.items()},
        T_ref_board={m: jolt(T) for m, T in truth.T_ref_board.items()},
        time_offset_s=dict.fromkeys(truth.time_offset_s, 0.0),
    )


def errors(solution: Solution, truth: Estimate) -> Floats:
    """(P,) the estimate's error, truth minus estimate, in the order and the sense of `solution.names`."""
    found = solution.estimate
    error: dict[str, float] = {}
    for name, camera in truth.cameras.items():
        off = parameters(camera) - parameters(found.cameras[name])
        error |= {f"{name}.{p}": float(e) for p, e in zip(parameter_names(camera), off, strict=True)}
    for sensor, T in truth.T_ref_sensor.items():
        guess = found.T_ref_sensor[sensor]
        turn = T[:3, :3] @ guess[:3, :3].T
        r = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
        for label, value in zip(("rx", "ry", "rz", "tx", "ty", "tz"), (*r, *(T - guess)[:3, 3]), strict=True):
            error[f"T_{truth.reference}_{sensor}.{label}"] = float(value)
    for sensor, s in truth.time_offset_s.items():
        error[f"{sensor}.time_offset_s"] = s - found.time_offset_s[sensor]
    return np.array([error[name] for name in solution.names])


def planted(views: Sequence[View], seed: int, share: float = 0.1) -> list[View]:
    """The views with a share of their points moved 5 to 50 px in any direction."""
    rng = np.random.default_rng(seed)
    spoilt = []
    for view in views:
        bad, turn = rng.random(len(view.ids)) < share, rng.uniform(0, 2 * np.pi, len(view.ids))
        off = np.stack([np.cos(turn), np.sin(turn)], -1) * rng.uniform(5, 50, (len(view.ids), 1))
        spoilt.append(replace(view, uv=view.uv + np.where(bad[:, None], off, 0)))
    return spoilt


def chi_square(solution: Solution, truth: Estimate, owner: str = "") -> tuple[float, int]:
    """The squared error in standard deviations of all parameters (or those whose name starts with `owner`),
    and of how many; with a true covariance it follows the chi-square distribution."""
    rows = [i for i, name in enumerate(solution.names) if name.startswith(owner)]
    off, C = errors(solution, truth)[rows], solution.covariance[np.ix_(rows, rows)]
    return float(off @ np.linalg.solve(C, off)), len(rows)


def coverage(
    runs: int, owners: Sequence[str] = ("", "T_rgb_fir", "T_rgb_lidar"), **kind: Any
) -> dict[str, float]:
    """The share of runs (`scene(seed, **kind)`) whose truth is in the stated 95 % ellipsoid, by owner.

    Starts from the truth, to save steps: the optimum is the same.
    """
    inside = dict.fromkeys(owners, 0)
    for seed in range(runs):
        world = scene(seed, **kind)
        found = solve(world.board, world.views, world.clouds, start=world.truth)
        for owner in owners:
            squared, count = chi_square(found, world.truth, owner)
            inside[owner] += bool(squared < chi2.ppf(0.95, count))
    return {owner: n / runs for owner, n in inside.items()}
