"""A camera's place from pairs of LiDAR points and pixels: robust PnP on the rays of any camera model."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from fusion.errors import InputError, UsageError
from fusion.geometry import Camera, Floats, pose, transform

COLUMNS = ("x_m", "y_m", "z_m", "u_px", "v_px")
FEWEST, FEWEST_ROBUST = 4, 6
_MOST_BYTES, _TRIES = 1 << 24, 300
_LARGEST_TURN_RAD, _LARGEST_SHIFT_M = 0.2, 2.0  # deviations beyond which the pairs fix no pose


@dataclass(frozen=True, slots=True, eq=False)
class PointsPose:
    """A pose from N pairs.

    `T_cam_lidar` 4 x 4; `inliers` (N,) bool, the pairs that count; `error_px` (N,) the distance of each from
    where it is projected (NaN where it is not), `rms_px` that of the inliers, root mean square. `covariance`
    (6, 6) of (rx, ry, rz) rad and (tx, ty, tz) m, to the left: exp([r]) R, t + dt; NaN from four pairs that
    fit as they must. `notes` says what is weak.
    """

    T_cam_lidar: Floats
    inliers: NDArray[np.bool_]
    error_px: Floats
    rms_px: float
    covariance: Floats
    notes: tuple[str, ...] = ()


def from_points(
    camera: Camera, xyz_m: NDArray[np.floating], uv: NDArray[np.floating], *, inlier_px: float = 4.0
) -> PointsPose:
    """T_cam_lidar from N points in the LiDAR's frame and the pixels where the camera sees them.

    Pinhole or fisheye: the pixels' rays count, also those that look back. From six pairs on robust: minimal
    sets of four (P3P of Ke and Roumeliotis 2017 on three, the fourth chooses), a seeded choice of them or
    all; those within `inlier_px` of the best, then least squares of their pixel errors with a soft loss. Four
    or five are taken as they are. Raises `InputError` for too few pairs, points on a line or in one place,
    pixels that no ray meets, no pose that most pairs agree with, and pairs that fix none.
    """
    xyz, px = _checked(xyz_m, uv)
    rays = camera.unproject(px)
    usable = np.asarray(np.isfinite(rays).all(1), np.bool_)
    if usable.sum() < FEWEST:
        what = f"only {usable.sum()} of {len(px)} pixels are where the camera model can see"
        raise InputError(what, hint="is it this camera's calibration, and the pictures' own size?")
    _spread_enough(xyz[usable])
    robust = usable.sum() >= FEWEST_ROBUST
    T, inliers = _consensus(camera, xyz, px, rays, usable, inlier_px if robust else np.inf)
    T = _least_squares(camera, xyz, px, inliers, T)
    for _ in range(3 if robust else 0):
        grown = usable & (_errors(camera, T, xyz, px) < inlier_px)
        if grown.sum() < FEWEST or (grown == inliers).all():
            break
        inliers = grown
        T = _least_squares(camera, xyz, px, inliers, T)
    return _judged(camera, T, xyz, px, inliers, usable)


def read_pairs(path: str | Path) -> tuple[Floats, Floats]:
    """Points (N, 3) in metres and pixels (N, 2) of a CSV with the columns x_m, y_m, z_m, u_px, v_px.

    The first line names them, in any order; further columns are passed over. Raises `UsageError` that names
    file and line for whatever is missing or no finite number.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise UsageError("too large for a list of pairs", where=path, hint="at most 16 MiB")
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise UsageError(f"the pairs cannot be read: {error.strerror or error}", where=path) from None
    except UnicodeDecodeError:
        raise UsageError("the pairs are not text", where=path) from None
    lines = csv.reader(text.splitlines())
    names = [name.strip() for name in next(lines, [])]
    missing = [name for name in COLUMNS if names.count(name) != 1]
    if missing:
        what = f"line 1 does not name the column {missing[0]} once"
        raise UsageError(what, where=path, hint=f"it begins with {','.join(COLUMNS)}")
    at = [names.index(name) for name in COLUMNS]
    rows = [_row(row, at, number, path) for number, row in enumerate(lines, 2) if any(w.strip() for w in row)]
    values = np.array(rows, np.float64).reshape(-1, 5)
    return values[:, :3].copy(), values[:, 3:].copy()


def _row(row: list[str], at: list[int], number: int, path: Path) -> list[float]:
    values = []
    for name, k in zip(COLUMNS, at, strict=True):
        word = row[k].strip() if k < len(row) else ""
        try:
            value = float(word)
        except ValueError:
            raise UsageError(f"line {number}: {name} is {word!r}, no number", where=path) from None
        if not math.isfinite(value):
            raise UsageError(f"line {number}: {name} is not finite", where=path)
        values.append(value)
    return values


def _checked(xyz_m: NDArray[np.floating], uv: NDArray[np.floating]) -> tuple[Floats, Floats]:
    xyz, px = np.asarray(xyz_m, np.float64), np.asarray(uv, np.float64)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or px.shape != (len(xyz), 2):
        raise ValueError(f"expected N x 3 points and N x 2 pixels, got {xyz.shape} and {px.shape}")
    if len(xyz) < FEWEST:
        raise InputError(
            f"{len(xyz)} pairs fix no pose", hint=f"{FEWEST} are needed, {FEWEST_ROBUST} or more better"
        )
    if not (np.isfinite(xyz).all() and np.isfinite(px).all()):
        raise InputError("a pair holds a number that is not finite")
    return xyz, px


def _spread_enough(xyz: Floats) -> None:
    """Refuse points in one place and on one line: they can be turned about it."""
    spread = np.linalg.svd(xyz - xyz.mean(0), compute_uv=False)
    if spread[0] < 1e-6:
        raise InputError("all points are in one place", hint="choose points all over the picture")
    if spread[1] < 0.01 * spread[0]:
        raise InputError(
            "all points lie on one line", hint="choose points all over the picture, near and far"
        )


def _consensus(
    camera: Camera, xyz: Floats, px: Floats, rays: Floats, usable: NDArray[np.bool_], inlier_px: float
) -> tuple[Floats, NDArray[np.bool_]]:
    rng, rows = np.random.default_rng(0), np.flatnonzero(usable)
    best, best_cost, needed, limit = None, np.inf, _TRIES, min(inlier_px, 1e4)
    for attempt in range(_TRIES):
        if attempt >= needed:
            break
        four = rng.permutation(rows)[:4]
        for T in _p3p(xyz[four[:3]], rays[four[:3]]):
            if not _errors(camera, T, xyz[four[3:]], px[four[3:]])[0] < 4 * limit:
                continue
            errors = np.minimum(np.nan_to_num(_errors(camera, T, xyz[rows], px[rows]), nan=limit), limit)
            cost = float((errors**2).sum())
            if cost < best_cost:
                best, best_cost = T, cost
                needed = max(20, _enough(float((errors < limit).mean())))
    if best is None:
        raise InputError(_NO_POSE, hint=_NO_POSE_HINT)
    inliers = usable & (_errors(camera, best, xyz, px) < inlier_px)
    if inliers.sum() < max(FEWEST, len(rows) // 2):
        what = f"only {inliers.sum()} of {len(rows)} pairs agree on a pose within {inlier_px:g} px"
        raise InputError(what, hint=_NO_POSE_HINT)
    return best, inliers


def _enough(share: float) -> int:
    """Draws of four after which one without a wrong pair has come up, 9999 times in 10000."""
    clean = min(share**4, 1 - 1e-9)
    return math.ceil(math.log(1e-4) / math.log(1 - clean)) if clean > 1e-6 else _TRIES


_NO_POSE = "no pose brings the points to their pixels"
_NO_POSE_HINT = (
    "are points and pixels in one order, in metres of the LiDAR's frame and pixels of this camera?"
)


def _p3p(xyz: Floats, rays: Floats) -> list[Floats]:
    """Up to four poses that lay three points on three rays. A camera turned to look at them, for rays behind
    it.
    """
    middle = rays.mean(0)
    if np.linalg.norm(middle) < 0.05:
        return []
    turn = Rotation.align_vectors([[0, 0, 1.0]], [middle])[0].as_matrix()
    ahead = rays @ turn.T
    if (ahead[:, 2] < 0.02).any():
        return []
    plane = np.ascontiguousarray(ahead[:, :2] / ahead[:, 2:])
    try:
        _, rs, ts = cv2.solveP3P(np.ascontiguousarray(xyz), plane, np.eye(3), np.zeros(4), cv2.SOLVEPNP_AP3P)
    except cv2.error:  # three points on a line
        return []
    poses = [pose(turn.T @ cv2.Rodrigues(r)[0], turn.T @ t.ravel()) for r, t in zip(rs, ts, strict=True)]
    return [T for T in poses if np.isfinite(T).all()]


def _errors(camera: Camera, T: Floats, xyz: Floats, px: Floats) -> Floats:
    with np.errstate(all="ignore"):
        uv, seen = camera.project(transform(T, xyz))
    return np.where(seen, np.linalg.norm(uv - px, axis=1), np.nan)


def _moved(x: Floats, T: Floats) -> Floats:
    return pose(Rotation.from_rotvec(x[:3]).as_matrix() @ T[:3, :3], T[:3, 3] + x[3:])


def _residuals(x: Floats, camera: Camera, T: Floats, xyz: Floats, px: Floats) -> Floats:
    uv, seen = camera.project(transform(_moved(x, T), xyz))
    return np.where(seen[:, None], uv - px, 1e3).ravel()


def _least_squares(camera: Camera, xyz: Floats, px: Floats, inliers: NDArray[np.bool_], T: Floats) -> Floats:
    rows = camera, T, xyz[inliers], px[inliers]
    x = least_squares(_residuals, np.zeros(6), args=rows, loss="soft_l1", f_scale=1.5, x_scale=[0.01] * 6).x
    return _moved(x, T)


def _judged(
    camera: Camera, T: Floats, xyz: Floats, px: Floats, inliers: NDArray[np.bool_], usable: NDArray[np.bool_]
) -> PointsPose:
    error = _errors(camera, T, xyz, px)
    rms = float(np.sqrt((error[inliers] ** 2).mean()))
    fit = least_squares(
        _residuals, np.zeros(6), jac="3-point", args=(camera, T, xyz[inliers], px[inliers]), max_nfev=1
    )
    J, free = fit.jac, 2 * int(inliers.sum()) - 6
    # At one pixel of noise: whether the pairs fix a pose does not depend on how well they happen to fit.
    strength = np.linalg.svd(J, compute_uv=False)
    if strength[-1] < 1e-9 * strength[0]:
        raise InputError("the pairs fix no pose", hint="choose points all over the picture, near and far")
    unit = np.linalg.inv(J.T @ J)
    turn, shift = np.sqrt(np.trace(unit[:3, :3])), np.sqrt(np.trace(unit[3:, 3:]))
    if turn > _LARGEST_TURN_RAD or shift > _LARGEST_SHIFT_M:
        what = f"the pairs fix the pose to {np.degrees(turn):.1f} degrees and {shift:.2f} m a pixel only"
        raise InputError(what, hint="choose points all over the picture, near and far")
    covariance = unit * (rms**2 * inliers.sum() / free) if free > 2 else np.full((6, 6), np.nan)
    return PointsPose(T, inliers, error, rms, covariance, _notes(xyz, inliers, usable))


def _notes(xyz: Floats, inliers: NDArray[np.bool_], usable: NDArray[np.bool_]) -> tuple[str, ...]:
    notes = []
    if usable.sum() < FEWEST_ROBUST:
        notes.append(f"{usable.sum()} pairs are too few to notice a wrong one: give {FEWEST_ROBUST} or more")
    if (~usable).any():
        rows = ", ".join(str(k + 1) for k in np.flatnonzero(~usable)[:10])
        notes.append(f"pixels where the camera model sees nothing: pair {rows}")
    if (usable & ~inliers).any():
        rows = ", ".join(str(k + 1) for k in np.flatnonzero(usable & ~inliers)[:10])
        notes.append(f"left out, they do not agree with the others: pair {rows}")
    spread = np.linalg.svd(xyz[inliers] - xyz[inliers].mean(0), compute_uv=False)
    if spread[2] < 0.02 * spread[0]:
        notes.append("the points lie in one plane: points off it make the pose firmer")
    return tuple(notes)
