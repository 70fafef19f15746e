"""A homography through point pairs: robust, least squares of the distance, with its evidence.

float64 throughout (OpenCV's own fit rounds the points to float32); the linear step and its normalisation:
R. Hartley, A. Zisserman, Multiple View Geometry, 2nd ed., algorithm 4.2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_INSIDE_OUT = "the point pairs turn the image inside out: some rows are mixed up"
# Second-smallest singular value of the linear system over its largest. Floats spread over an image give
# 0.02 to 0.3; points on a line but one, with 0.3 px of noise, stay below this.
_LEAST_DETERMINACY = 2e-3


@dataclass(frozen=True, slots=True)
class PointFit:
    """How well `count` point pairs agree with the homography fitted to them.

    `inliers` of them took part; `outlier_rows` are the others, counted from 0 in the order given.
    `rms_px` and `max_px` are distances in the RGB image over the inliers. `leave_one_out_px` is the
    median distance of an inlier from the fit to all the others: what to expect between the points.
    None where the pairs leave nothing to compare, as four do.
    """

    count: int
    inliers: int
    outlier_rows: tuple[int, ...]
    rms_px: float
    max_px: float
    leave_one_out_px: float | None


class DegenerateError(ValueError):
    """The point pairs determine no homography."""


def fit_homography(src: Floats, dst: Floats, threshold: float) -> tuple[Floats, PointFit]:
    """The homography (3, 3) that takes `src` to `dst`, both (N, 2) float64, and its evidence.

    Pairs further than `threshold` (units of `dst`) are left out. Raises `DegenerateError`.
    """
    distinct = _distinct(src, dst)
    if distinct < 4:
        raise DegenerateError(f"{distinct} different point pairs: a homography needs 4 or more")
    inlier = np.ones(len(src), bool) if distinct == 4 else _consensus(src, dst, threshold)
    matrix, left_out = _fit_least_squares(src[inlier], dst[inlier])
    distance = np.linalg.norm(_project(matrix, src[inlier]) - dst[inlier], axis=1)
    expected = float(np.median(left_out))
    fit = PointFit(
        len(src),
        int(inlier.sum()),
        tuple(int(row) for row in np.flatnonzero(~inlier)),
        float(np.sqrt(np.mean(distance**2))),
        float(distance.max()),
        expected if distinct > 4 and math.isfinite(expected) else None,
    )
    return matrix, fit


def _project(matrix: Floats, xy: Floats) -> Floats:
    """(N, 2) points through a homography (3, 3)."""
    mapped = xy @ matrix[:, :2].T + matrix[:, 2]
    return mapped[:, :2] / mapped[:, 2:]


def _fit_least_squares(src: Floats, dst: Floats) -> tuple[Floats, Floats]:
    """The homography with the least sum of squared distances in `dst`, and each pair's left-out distance.

    The second result, (N,), is the distance of each pair from the fit to all others, to first order
    (exact for an affine map); inf where the others determine none.
    """
    to_src, to_dst = _normaliser(src), _normaliser(dst)
    p, q = _project(to_src, src), _project(to_dst, dst)
    matrix = _linear(p, q)
    if not _in_front(matrix, p):
        raise DegenerateError(_INSIDE_OUT)
    error, slope = _linearised(matrix, p, q)
    for _ in range(20):  # Gauss-Newton; the linear start is close, so it is never damped, only stopped
        step = np.append(np.linalg.lstsq(slope, error, rcond=None)[0], 0.0).reshape(3, 3)
        if not _in_front(matrix - step, p):
            break
        trial_error, trial_slope = _linearised(matrix - step, p, q)
        if trial_error @ trial_error >= error @ error:
            break
        matrix, error, slope = matrix - step, trial_error, trial_slope
    return np.linalg.inv(to_dst) @ matrix @ to_src, _left_out(error, slope) / to_dst[0, 0]


def _in_front(matrix: Floats, xy: Floats) -> bool:
    return bool((xy @ matrix[2, :2] + matrix[2, 2] > 0).all())


def _consensus(src: Floats, dst: Floats, threshold: float) -> NDArray[np.bool_]:
    """The pairs that agree with one homography: RANSAC, then the same question asked of the refined fit."""
    # Its random numbers start from a fixed seed of its own: the same points give the same answer.
    _, mask = cv2.findHomography(src, dst, cv2.RANSAC, threshold, maxIters=5000, confidence=0.9999)
    inlier = np.zeros(len(src), bool) if mask is None else mask.ravel() > 0
    for _ in range(10):
        found = _distinct(src[inlier], dst[inlier])
        if found <= 4 or 2 * inlier.sum() <= len(src):
            _refuse(src, dst, threshold, found)
        matrix, _ = _fit_least_squares(src[inlier], dst[inlier])
        with np.errstate(all="ignore"):
            near = np.linalg.norm(_project(matrix, src) - dst, axis=1) <= threshold
        if np.array_equal(near, inlier):
            break
        inlier = near
    return inlier


def _refuse(src: Floats, dst: Floats, threshold: float, found: int) -> None:
    _linear(_project(_normaliser(src), src), _project(_normaliser(dst), dst))  # degenerate as a whole?
    raise DegenerateError(
        f"only {found} of {len(src)} point pairs agree with one homography within {threshold:g} px:"
        " too few to tell good pairs from bad"
    )


def _distinct(src: Floats, dst: Floats) -> int:
    return len(np.unique(np.hstack([src, dst]), axis=0))


def _normaliser(xy: Floats) -> Floats:
    """The similarity that puts the centre of `xy` at 0 and its mean square distance at 2."""
    centre = xy.mean(axis=0)
    spread = float(np.sqrt(np.mean((xy - centre) ** 2)))
    if spread == 0:
        raise DegenerateError("all points of one image are the same")
    return np.array([[1, 0, -centre[0]], [0, 1, -centre[1]], [0, 0, spread]]) / spread


def _linear(p: Floats, q: Floats) -> Floats:
    """The direct linear solution for normalised points, last element 1."""
    ones, zeros = np.ones((len(p), 1)), np.zeros((len(p), 3))
    x, (u, v) = np.hstack([p, ones]), (q[:, :1], q[:, 1:])
    system = np.vstack([np.hstack([x, zeros, -u * x]), np.hstack([zeros, x, -v * x])])
    _, values, rows = np.linalg.svd(system, full_matrices=len(p) == 4)
    if values[7] < _LEAST_DETERMINACY * values[0]:
        raise DegenerateError("the point pairs determine no homography: too many on one line or spot")
    matrix = rows[8].reshape(3, 3)
    if abs(matrix[2, 2]) < 1e-9:  # the middle of the points would lie on the horizon
        raise DegenerateError(_INSIDE_OUT)
    return matrix / matrix[2, 2]


def _linearised(matrix: Floats, p: Floats, q: Floats) -> tuple[Floats, Floats]:
    """The errors in `q` (2N,) and their derivatives (2N, 8) by the matrix's first eight elements."""
    x = np.hstack([p, np.ones((len(p), 1))])
    mapped = _project(matrix, p)
    x_w = x / (x @ matrix[2])[:, None]
    slope = np.zeros((len(p), 2, 9))
    slope[:, 0, 0:3] = slope[:, 1, 3:6] = x_w
    slope[:, :, 6:9] = -mapped[:, :, None] * x_w[:, None, :]
    return (mapped - q).ravel(), slope[:, :, :8].reshape(-1, 8)


def _left_out(error: Floats, slope: Floats) -> Floats:
    """|(I - L_i)^-1 e_i| with L_i each pair's 2x2 block of the leverage (hat) matrix."""
    basis = np.linalg.qr(slope)[0].reshape(-1, 2, 8)
    rest = np.eye(2) - basis @ basis.transpose(0, 2, 1)
    sound = np.linalg.det(rest) > 1e-9
    distance = np.full(len(rest), np.inf)
    distance[sound] = np.linalg.norm(
        np.linalg.solve(rest[sound], error.reshape(-1, 2, 1)[sound]), axis=(1, 2)
    )
    return distance
