"""What the covariance means in pixels: of one camera's projection, and of carrying a pixel to another camera.

The first follows mrcal's "mean-pcam" (D. Kogan, mrcal documentation, Projection uncertainty): a point stands
still with respect to the boards, and the question is where it appears when everything was calibrated anew.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.boards import Board
from calib.evidence.linear import Moment, derivative, moments_of
from calib.solve.estimate import Estimate, Solution
from fusion.geometry import Floats, invert, transform

GRID_WH = (24, 18)


@dataclass(frozen=True, slots=True, eq=False)
class UncertaintyMap:
    """The standard deviation in px, along its worst direction, on a grid over an image.

    `uv` (R, C, 2) are the pixels, `sigma_px` (R, C) float64, NaN where nothing can be said (the model ends,
    or the other camera does not see it). `distance_m` is how far the points lie, inf included.
    """

    of: str
    distance_m: float
    size_wh: tuple[int, int]
    uv: Floats
    sigma_px: Floats

    @property
    def centre_px(self) -> float:
        rows, cols = self.sigma_px.shape
        return float(np.nanmedian(self.sigma_px[rows // 3 : -(rows // 3), cols // 3 : -(cols // 3)]))

    @property
    def median_px(self) -> float:
        return float(np.nanmedian(self.sigma_px))

    @property
    def worst_px(self) -> float:
        return float(np.nanmax(self.sigma_px))


def projection_uncertainty(
    board: Board, solution: Solution, camera: str, distance_m: float, moments: list[Moment] | None = None
) -> UncertaintyMap:
    """How far a point at `distance_m` from `camera` may appear off where it would, over its image."""
    lens = solution.estimate.cameras[camera]
    uv = _grid(lens.size_wh)
    points = lens.unproject(uv.reshape(-1, 2)) * _finite(distance_m)
    found = sensitivity(board, solution, camera, points, moments)
    sigma = found.deviation_px(solution.covariance)
    return UncertaintyMap(camera, distance_m, lens.size_wh, uv, sigma.reshape(uv.shape[:2]))


@dataclass(frozen=True, slots=True, eq=False)
class Sensitivity:
    """How N points' pixels follow the solution's parameters.

    `by_parameters` (N, 2, P) px a unit, the boards' poses following the parameters; `own_px2` (N, 2, 2) is
    what the boards' poses add by their own noise.
    """

    by_parameters: Floats
    own_px2: Floats

    def covariance_px2(self, covariance: Floats) -> Floats:
        """The covariance of the pixels, N x 2 x 2, where that of the parameters is `covariance` (P, P)."""
        return self.by_parameters @ covariance @ self.by_parameters.transpose(0, 2, 1) + self.own_px2

    def deviation_px(self, covariance: Floats) -> Floats:
        """The standard deviation along the worst direction, N."""
        return _worst(self.covariance_px2(covariance))


def sensitivity(
    board: Board, solution: Solution, camera: str, xyz_m: Floats, moments: list[Moment] | None = None
) -> Sensitivity:
    """Of points that stand still with respect to the boards; `xyz_m` (N, 3) in the camera's frame.

    `moments` as `moments_of` gives them, where they are at hand.
    """
    estimate, moments = solution.estimate, moments or moments_of(board, solution)
    at_ref = transform(estimate.T_ref_sensor[camera], xyz_m)

    def seen(other: Estimate) -> Floats:
        return other.cameras[camera].project(transform(invert(other.T_ref_sensor[camera]), at_ref))[0]

    by_parameters = derivative(solution, seen).reshape(len(at_ref), 2, -1)
    by_point = _by_point(solution, camera, at_ref)
    carried = np.zeros((len(at_ref), 3, len(solution.names)))
    own = np.zeros((len(at_ref), 3, 3))
    for moment in moments:
        B = moment.by_pose
        H = np.linalg.inv(B.T @ B)
        moves = _moves(at_ref, solution.estimate.T_ref_board[moment.name][:3, 3])
        carried += moves @ (-H @ B.T @ moment.by_parameters) / len(moments)
        own += moves @ H @ moves.transpose(0, 2, 1) / len(moments) ** 2
    return Sensitivity(by_parameters + by_point @ carried, by_point @ own @ by_point.transpose(0, 2, 1))


def transfer_uncertainty(solution: Solution, dst: str, src: str, depth_m: float) -> UncertaintyMap:
    """How far a pixel of camera `src`, at distance `depth_m`, may land off where it belongs in camera `dst`.

    Over the image of `src`, px of `dst`. A `src` that is no camera has no image: its points are taken at that
    distance from `dst`, over the image of `dst`.
    """
    estimate = solution.estimate
    looks_from = dst if src not in estimate.cameras else src
    uv = _grid(estimate.cameras[looks_from].size_wh)
    fixed = estimate.cameras[looks_from].unproject(uv.reshape(-1, 2)) * _finite(depth_m)
    measured = transform(invert(pose_between(estimate, dst, src)), fixed) if looks_from == dst else None

    def landed(other: Estimate) -> Floats:
        points = measured
        if points is None:
            points = other.cameras[src].unproject(uv.reshape(-1, 2)) * _finite(depth_m)
        return other.cameras[dst].project(transform(pose_between(other, dst, src), points))[0]

    J = derivative(solution, landed).reshape(-1, 2, len(solution.names))
    sigma = _worst(J @ solution.covariance @ J.transpose(0, 2, 1))
    sigma[~_inside(landed(estimate), estimate.cameras[dst].size_wh)] = np.nan
    return UncertaintyMap(
        f"{src} to {dst}", depth_m, estimate.cameras[looks_from].size_wh, uv, sigma.reshape(uv.shape[:2])
    )


def pose_between(estimate: Estimate, dst: str, src: str) -> Floats:
    """T_dst_src of an estimate."""
    return invert(estimate.T_ref_sensor[dst]) @ estimate.T_ref_sensor[src]


def _moves(at_ref: Floats, origin: Floats) -> Floats:
    """How points fixed to a board move when its pose changes by (r, t), N x 3 x 6: r x (p - origin) + t."""
    x, y, z = (at_ref - origin).T
    zero = np.zeros_like(x)
    cross = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], -1).reshape(-1, 3, 3)
    return np.concatenate([cross, np.broadcast_to(np.eye(3), cross.shape)], 2)


def _by_point(solution: Solution, camera: str, at_ref: Floats) -> Floats:
    """The derivative of a point's pixel by the point, N x 2 x 3."""
    estimate, scale = solution.estimate, np.linalg.norm(at_ref, axis=1, keepdims=True)
    columns = []
    for axis in np.eye(3):
        step = 1e-6 * scale * axis
        ahead, behind = (
            estimate.cameras[camera].project(transform(invert(estimate.T_ref_sensor[camera]), at_ref + s))[0]
            for s in (step, -step)
        )
        columns.append((ahead - behind) / (2e-6 * scale))
    return np.stack(columns, 2)


def _worst(covariance: Floats) -> Floats:
    """The root of the larger eigenvalue of N 2 x 2 covariances."""
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    with np.errstate(invalid="ignore"):
        return np.sqrt((a + c) / 2 + np.hypot((a - c) / 2, b))


def _grid(size_wh: tuple[int, int]) -> Floats:
    (w, h), (columns, rows) = size_wh, GRID_WH
    u, v = np.linspace(0, w - 1, columns), np.linspace(0, h - 1, rows)
    return np.stack(np.meshgrid(u, v), -1)


def _inside(uv: Floats, size_wh: tuple[int, int]) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return np.asarray(((uv > -0.5) & (uv < np.array(size_wh) - 0.5)).all(1))


def _finite(distance_m: float) -> float:
    return min(distance_m, 1e6)
