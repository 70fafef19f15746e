"""Where the joint solve starts: lenses from plane to picture alone, poses of boards, of sensors.

Everything works on rays, not on pixels, so that a fisheye that sees behind itself is no special case. A
start has to be near enough for the solver to fall into the right valley, no more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation

from calib.boards import Board
from calib.observations import View
from fusion.errors import UsageError
from fusion.geometry import FisheyeCamera, Floats, PinholeCamera, invert, pose, transform
from fusion.rig import RigCamera

MODELS = {"pinhole": 5, "radtan": 4, "rational": 8, "fisheye": 4}
FEWEST_POINTS = 6  # 4 fix a homography; two more tell whether it is right
_AMBIGUOUS = 4.0  # times the better pose's rms: the other might still be it
_FLAT = 0.02  # third singular value of the planes' normals, over the root of their number
_TILT_LIMIT = 0.2  # cosine of 78 degrees: rays this far off a view's middle are left out of its start
_BENT_REACH = np.radians(75)  # beyond it a pinhole's radius runs away
_CAP = 0.1  # of the image diagonal: the most that a view costs
_WIDEST = np.radians(160)  # of c times the field of view: beyond it the radius runs away
_BENDS = (1.0, 0.6, 0.2)
_FOVS = np.radians(np.geomspace(12, 230, 16))


class _Eye(Protocol):
    """What a start needs of a lens."""

    @property
    def size_wh(self) -> tuple[int, int]: ...
    def project(self, xyz_m: Floats) -> tuple[Floats, NDArray[np.bool_]]: ...
    def unproject(self, uv: Floats) -> Floats: ...


# --- the board's pose in one view


def board_pose(
    board: Board, camera: RigCamera, ids: NDArray[np.intp], uv: Floats
) -> tuple[Floats, float] | None:
    """T_camera_board (4 x 4) of points `uv` (N, 2) of `ids` (N,), and the rms in px that it leaves.

    Of the two poses that a plane can have in a picture (Collins and Bartoli 2014, IPPE) the one that fits
    better in pixels once refined. None where fewer than `FEWEST_POINTS` points have a ray, they lie on a
    line, or no pose is in front.
    """
    return _pose_of_rays(board, camera, ids, uv, camera.unproject(uv))


def poses_of(
    board: Board, camera: _Eye, views: Sequence[View], *, refine: bool = True
) -> tuple[dict[int, Floats], dict[int, float]]:
    """T_camera_board and rms in px by the index of the view; views without a pose are not in it.

    Without `refine` the closed form is the pose: a third of the time, and good enough to compare lenses by.
    """
    if not views:
        return {}, {}
    cuts = np.cumsum([len(view.ids) for view in views])[:-1]
    rays = np.split(camera.unproject(np.concatenate([view.uv for view in views])), cuts)
    found = {
        k: pose_
        for k, view in enumerate(views)
        if (pose_ := _pose_of_rays(board, camera, view.ids, view.uv, rays[k], refine)) is not None
    }
    return {k: p[0] for k, p in found.items()}, {k: p[1] for k, p in found.items()}


def rms_px(camera: _Eye, T_camera_board: Floats, xyz_m: Floats, uv: Floats) -> float:
    """Root of the mean squared distance in px; inf where a point cannot be seen."""
    at, seen = camera.project(transform(T_camera_board, xyz_m))
    return float(np.sqrt(((at - uv) ** 2).sum(1).mean())) if seen.all() else np.inf


def _pose_of_rays(
    board: Board, camera: _Eye, ids: NDArray[np.intp], uv: Floats, rays: Floats, refine: bool = True
) -> tuple[Floats, float] | None:
    good = np.isfinite(rays).all(1)
    if good.sum() < FEWEST_POINTS:
        return None
    turn = _to_axis(rays[good].mean(0))
    with np.errstate(invalid="ignore"):
        good &= (rays @ turn.T)[:, 2] > _TILT_LIMIT
    xyz, ahead = board.points_m[ids[good]], rays[good] @ turn.T
    if good.sum() < FEWEST_POINTS or _on_a_line(xyz[:, :2]):
        return None
    poses = [pose(turn.T) @ T for T in _plane_poses(xyz, ahead[:, :2] / ahead[:, 2:], refine)]
    fits = [(rms_px(camera, T, xyz, uv[good]), k) for k, T in enumerate(poses)]
    best, k = min(fits, default=(np.inf, 0))
    return (poses[k], best) if np.isfinite(best) else None


def _to_axis(direction: Floats) -> Floats:
    """The least rotation that takes a direction to +z."""
    x, y, z = direction / max(float(np.linalg.norm(direction)), 1e-12)
    angle = np.arctan2(np.hypot(x, y), z)
    axis = np.array([y, -x, 0.0]) if np.hypot(x, y) > 1e-12 else np.array([1.0, 0, 0])
    return Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle).as_matrix()


def _on_a_line(xy: Floats) -> bool:
    spread = np.linalg.svd(xy - xy.mean(0), compute_uv=False)
    return bool(spread[1] < 1e-3 * spread[0])


def _plane_poses(xyz: Floats, at: Floats, refine: bool) -> list[Floats]:
    none = np.zeros(0)
    try:
        _, rs, ts, left = cv2.solvePnPGeneric(xyz, at, np.eye(3), none, flags=cv2.SOLVEPNP_IPPE)
        left = np.ravel(left)  # rms, the least first: where one is far better the other need not be tried
        found = [(r, t) for r, t, e in zip(rs, ts, left, strict=True) if e <= _AMBIGUOUS * left[0] + 1e-12]
        if refine:
            found = [cv2.solvePnPRefineLM(xyz, at, np.eye(3), none, r, t) for r, t in found]
    except cv2.error:
        return []
    good = [(r, t) for r, t in found if np.isfinite(r).all() and np.isfinite(t).all()]
    return [pose(cv2.Rodrigues(np.asarray(r))[0], np.ravel(t)) for r, t in good]


def seen_from_behind(board: Board, view: View) -> bool:
    """Whether the points lie in the picture as on a board's back: mirrored, for no board is seen through."""
    design = np.column_stack([board.points_m[view.ids][:, :2], np.ones(len(view.ids))])
    affine = np.linalg.lstsq(design, view.uv, rcond=None)[0]
    return bool(np.linalg.det(affine[:2]) < 0)


# --- a lens


def initial_camera(board: Board, views: Sequence[View], model: str) -> RigCamera:
    """A lens near enough to the truth to start from: centre in the middle, square pixels.

    Lenses of radius f tan(c angle) / c, from the pinhole (c = 1) over the stereographic to the equidistant
    fisheye (c = 0), are tried at focal lengths over all fields of view, beside Zhang's closed form (2000),
    and judged by how well the boards' poses explain the pixels. The best one's radius gives the coefficients.
    Raises `UsageError` for an unknown model, `ValueError` without views.
    """
    if model not in MODELS:
        raise UsageError(f"unknown camera model {model!r}", hint=f"known: {', '.join(MODELS)}")
    some = spread_views(views, 8)
    if not some:
        raise ValueError("expected at least one view")
    size = some[0].size_wh
    tried = [_Round(size, f, 1.0) for f in _zhang(board, some)]
    tried += [_Round.of_fov(size, fov, c) for c in _BENDS for fov in _FOVS if fov * c < _WIDEST]
    best = _polished(board, some, min(tried, key=lambda lens: _cost(board, lens, some)))
    plain = _lens(size, best.f, model, (0.0,) * MODELS[model])
    bent = _lens(size, best.f, model, _coefficients(best, some, model))
    return min(plain, bent, key=lambda lens: _cost(board, lens, some))


@dataclass(frozen=True, slots=True)
class _Round:
    """A lens of radius f tan(c angle) / c about the picture's middle; f angle where c is 0."""

    size_wh: tuple[int, int]
    f: float
    c: float

    @classmethod
    def of_fov(cls, size: tuple[int, int], fov: float, c: float) -> _Round:
        return cls(size, size[0] / 2 / float(cls(size, 1.0, c).radius(np.array(fov / 2))), c)

    def radius(self, angle: Floats) -> Floats:
        return self.f * (np.tan(self.c * angle) / self.c if self.c else angle)

    def angle(self, radius: Floats) -> Floats:
        return np.arctan(self.c * radius / self.f) / self.c if self.c else radius / self.f

    def project(self, xyz_m: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        across = np.hypot(xyz_m[:, 0], xyz_m[:, 1])
        angle = np.arctan2(across, xyz_m[:, 2])
        seen = self.c * angle < _WIDEST / 2
        scale = self.radius(np.where(seen, angle, 0.0)) / np.maximum(across, 1e-12)
        return xyz_m[:, :2] * scale[:, None] + self._middle(), seen

    def unproject(self, uv: Floats) -> Floats:
        off = uv - self._middle()
        radius = np.linalg.norm(off, axis=1)
        angle = self.angle(radius)
        across = off * (np.sin(angle) / np.maximum(radius, 1e-12))[:, None]
        return np.column_stack([across, np.where(angle < np.pi, np.cos(angle), np.nan)])

    def _middle(self) -> Floats:
        return (np.array(self.size_wh) - 1) / 2


def _polished(board: Board, views: Sequence[View], start: _Round) -> _Round:
    """Focal length and bend where the cost is least, nearby (Nelder and Mead 1965)."""

    def lens(x: Floats) -> _Round:
        return replace(start, f=float(start.f * np.exp(x[0])), c=float(np.clip(start.c + x[1], 0, 1.2)))

    corners = np.array([(0, 0), (0.12, 0), (0, -0.2 if start.c > 0.5 else 0.2)])
    options = {"initial_simplex": corners, "maxfev": 30, "xatol": 1e-2, "fatol": 1e-3}
    found = minimize(
        lambda x: _cost(board, lens(x), views), np.zeros(2), method="Nelder-Mead", options=options
    )
    return lens(found.x)


def _lens(size: tuple[int, int], f: float, model: str, distortion: tuple[float, ...]) -> RigCamera:
    kind = FisheyeCamera if model == "fisheye" else PinholeCamera
    return kind(size, f, f, (size[0] - 1) / 2, (size[1] - 1) / 2, distortion)


def _coefficients(lens: _Round, views: Sequence[View], model: str) -> tuple[float, ...]:
    """The radial ones that follow `lens` as far as the views reach, by linear least squares."""
    far = max(float(np.linalg.norm(view.uv - lens._middle(), axis=1).max()) for view in views)
    reach = float(lens.angle(np.array(far)))
    angle = np.linspace(0.01, 1.05 * reach if model == "fisheye" else min(1.05 * reach, _BENT_REACH), 60)
    angle = angle[lens.c * angle < _WIDEST / 2]
    radius = lens.radius(angle) / lens.f
    t = angle if model == "fisheye" else np.tan(angle)
    columns = [t**3, t**5] + ([t**7] if model == "pinhole" and reach > 0.8 else [])
    if model == "rational":  # radius (1 + k4 t^2 + ...) = t (1 + k1 t^2 + ...)
        columns += [-radius * t**2, -radius * t**4]
    k1, k2, *rest = np.linalg.lstsq(np.stack(columns, 1), radius - t, rcond=1e-6)[0].tolist()
    if model == "fisheye":
        return (k1, k2, 0.0, 0.0)
    if model == "rational":
        return (k1, k2, 0.0, 0.0, 0.0, *rest, 0.0)
    return (k1, k2, 0.0, 0.0, *rest, 0.0)[: MODELS[model]]


def spread_views(views: Sequence[View], count: int) -> list[View]:
    """At most `count` views, those that differ most in place, size, foreshortening and turn in the image."""
    if len(views) <= count:
        return list(views)
    feature = np.array([_shape_of(view) for view in views])
    chosen = [int(np.argmax([len(view.ids) for view in views]))]
    away = np.linalg.norm(feature - feature[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(feature - feature[chosen[-1]], axis=1))
    return [views[k] for k in sorted(chosen)]


def _shape_of(view: View) -> Floats:
    """Centre, and the root of the points' scatter: size, foreshortening and turn in one."""
    size = np.array(view.size_wh, float)
    scatter, axes = np.linalg.eigh(np.cov(view.uv.T))
    root = axes @ np.diag(np.sqrt(np.maximum(scatter, 0))) @ axes.T
    return np.concatenate([view.uv.mean(0) / size.max(), 2 * root[np.triu_indices(2)] / size.max()])


def _zhang(board: Board, views: Sequence[View]) -> list[float]:
    """Zhang's focal length for a centre in the middle of the image; none where the views do not tell."""
    xyz = [board.points_m[view.ids].astype(np.float32) for view in views]
    uv = [view.uv.astype(np.float32) for view in views]
    try:
        K = cv2.initCameraMatrix2D(xyz, uv, views[0].size_wh, 1.0)
    except cv2.error:
        return []
    width = max(views[0].size_wh)
    return [float(K[0, 0])] if 0.1 * width < K[0, 0] < 20 * width else []


def _cost(board: Board, camera: _Eye, views: Sequence[View]) -> float:
    """Mean logarithm of the views' rms in px: one that no such lens explains must not outweigh the others."""
    cap = _CAP * float(np.hypot(*camera.size_wh))
    rms = poses_of(board, camera, views, refine=False)[1]
    return float(np.mean([np.log(0.1 + min(rms.get(k, cap), cap)) for k in range(len(views))]))


# --- sensors to each other


def symmetry_motions(board: Board) -> list[Floats]:
    """S (4 x 4) for each of `board.symmetries()`: S takes a point to the one that has its label then."""
    seen = np.flatnonzero(board.visible)
    return [rigid_fit(board.points_m[seen], board.points_m[ids[seen]]) for ids in board.symmetries()]


def rigid_fit(source: Floats, target: Floats) -> Floats:
    """T_target_source that takes N x 3 points to N x 3 points best (Kabsch 1976)."""
    a, b = source.mean(0), target.mean(0)
    left, _, right = np.linalg.svd((target - b).T @ (source - a))
    R = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    return pose(R, b - R @ a)


def frame_points(board: Board) -> Floats:
    """Four corners of what is visible of a board, (4, 3): what stands for it where poses are compared."""
    xy = board.points_m[board.visible][:, :2]
    (x0, y0), (x1, y1) = xy.min(0), xy.max(0)
    return np.array([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0]])


def misfit_rad(T_a_b: Floats, T_a_board: Floats, T_b_board: Floats, xyz_m: Floats) -> Floats:
    """How far off, in b, the boards (M, 4, 4) are that a saw: (M,) rms angle of `xyz_m`, radians."""
    here = _directions(invert(T_a_b) @ T_a_board, xyz_m)
    there = _directions(T_b_board, xyz_m)
    return np.sqrt(((here - there) ** 2).sum(-1).mean(-1))


def _directions(T: Floats, xyz_m: Floats) -> Floats:
    at = np.einsum("...ij,nj->...ni", T[..., :3, :3], xyz_m) + T[..., None, :3, 3]
    return at / np.linalg.norm(at, axis=-1, keepdims=True)


def refine_link(T_a_b: Floats, T_a_board: Floats, T_b_board: Floats, xyz_m: Floats) -> Floats:
    """T_a_b that makes the boards (M, 4, 4), as a and as b saw them, agree best in angle; robust."""
    back = invert(T_a_b)
    there = _directions(T_b_board, xyz_m)

    def errors(x: Floats) -> Floats:
        T_b_a = pose(Rotation.from_rotvec(x[:3]).as_matrix(), x[3:]) @ back
        return (_directions(T_b_a @ T_a_board, xyz_m) - there).ravel()

    found = np.zeros(6)
    for _ in range(2):  # what is far off is known only after a first round
        scale = max(1.5 * float(np.median(np.abs(errors(found)))), 1e-9)
        found = least_squares(errors, found, loss="soft_l1", f_scale=scale, max_nfev=30).x
    return T_a_b @ invert(pose(Rotation.from_rotvec(found[:3]).as_matrix(), found[3:]))
