"""A LiDAR's place refined on scenes without a board: steps in depth and reflectance laid on an image's edges.

Edges of depth after Levinson and Thrun 2013 (Automatic Online Calibration of Cameras and Lasers), on
orientation channels instead of an edge image, from wide to narrow blur.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from calib.lidar.score import Field, Lifted, edge_score, lift, orientation_fields, scene_edges
from fusion.errors import InputError
from fusion.geometry import Camera, Floats, checked_pose, invert, pose

BLURS_RAD = tuple(np.radians((1.2, 0.6, 0.3, 0.15)))
MOST_WIDTH = 800  # of the image that is looked at
FARTHEST_RAD, FARTHEST_M = np.radians(4), 0.25  # that a refinement may move
FEWEST_EDGES, MOST_EDGES = 150, 1600  # of a frame
TILES_WH = 6, 4
_JUDGED = 2  # the blur at which results are compared
_PRIOR_M, _PRIOR_RAD, _PRIOR = 0.05, np.radians(2), 0.01  # so far must raise the score by so much
_AGREE_RAD, _AGREE_M = np.radians(0.5), 0.12  # between parts of the data
_AROUND_RAD = np.radians(2.5)  # where a true place scores clearly less
_DISTINCT = 1.4


@dataclass(frozen=True, slots=True, eq=False)
class SceneFrame:
    """An image, and what the LiDAR saw at the same time.

    `image` is H x W (8- or 16-bit, thermal counts too) or H x W x 3 BGR; `xyz_m` N x 3 in the LiDAR's frame,
    `intensity` (N,) or None. `name` is for messages.
    """

    image: NDArray[Any]
    xyz_m: NDArray[np.floating]
    intensity: NDArray[Any] | None = None
    name: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """What came of it. `T_cam_lidar` is the refined place, or the start where that could not be shown to be
    worse.

    `score_before` and `score_after` (of the candidate, kept or not) are of edges that did not take part in
    finding what they judge: the mean of the image's edge field where they fall, in its deviations; 0 is
    chance. `gain_sigma` is their difference over its own deviation. `moved_rad`, `moved_m`: from the start to
    the candidate. `agreement_rad` and `agreement_m`: the largest difference between candidates of parts of
    the data. `note` says why.
    """

    T_cam_lidar: Floats
    kept: Literal["refined", "start"]
    score_before: float
    score_after: float
    gain_sigma: float
    moved_rad: float
    moved_m: float
    agreement_rad: float
    agreement_m: float
    note: str
    candidate: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    lifted: Lifted
    fields: list[Field]
    tile: NDArray[np.intp]


def refine_on_scene(camera: Camera, frames: Sequence[SceneFrame], T_cam_lidar: Floats) -> Refinement:
    """T_cam_lidar refined from a start within about 2 degrees and 5 cm, on one frame or better several.

    The candidate is found on all edges. Whether it is kept is judged by candidates found on parts of the data
    (all frames but some; for one or two frames half the image's tiles) and scored on the rest: the score
    there must rise by three of its deviations, the parts must agree within 0.5 degrees and 0.12 m, the
    candidate must stand out of what lies 2.5 degrees around it, and be within 4 degrees and 0.25 m of the
    start. Otherwise the start stays, and `note` says why. Raises `InputError` where no frame has enough edges
    in the picture.
    """
    if not frames:
        raise InputError("no frames to refine on", hint="give images and clouds of the same moments")
    start = checked_pose(T_cam_lidar, where="T_cam_lidar")
    scenes = [scene for scene in (_prepared(camera, frame, start) for frame in frames) if scene is not None]
    if not scenes:
        what = f"in none of {len(frames)} frames do {FEWEST_EDGES} edges of the cloud fall into the picture"
        raise InputError(what, hint="is the start right, and do image and cloud look the same way?")
    passed_over = len(frames) - len(scenes)
    candidate = _optimised(camera, scenes, start)
    parts = [_optimised(camera, learnt, start) for learnt, _ in _folds(scenes)]
    held = [rest for _, rest in _folds(scenes)]
    before, after, sigmas = _held_out(camera, held, parts, start)
    apart = max((_apart(a, b) for a in [*parts, candidate] for b in [*parts, candidate]), key=lambda d: d[0])
    apart_m = max(_apart(a, b)[1] for a in [*parts, candidate] for b in [*parts, candidate])
    moved = _apart(candidate, start)
    fault = _fault(camera, scenes, candidate, moved, (apart[0], apart_m), sigmas)
    note = fault or f"the score of held-out edges rose from {before:.2f} to {after:.2f}"
    if passed_over:
        note += f"; {passed_over} of {len(frames)} frames had too few edges"
    kept: Literal["refined", "start"] = "start" if fault else "refined"
    T = start if fault else candidate
    return Refinement(T, kept, before, after, sigmas, *moved, apart[0], apart_m, note, candidate)


def _prepared(camera: Camera, frame: SceneFrame, start: Floats) -> _Scene | None:
    xyz = np.asarray(frame.xyz_m, np.float64)
    size = frame.image.shape[1], frame.image.shape[0]
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise ValueError(f"expected N x 3 points, got {xyz.shape}")
    if size != tuple(camera.size_wh):
        what = "the image has {}x{} pixels, the camera {}x{}".format(*size, *camera.size_wh)
        raise InputError(what, where=frame.name, hint="is it another camera's, or was it scaled?")
    valid = np.isfinite(xyz).all(1) & (xyz != 0).any(1)
    intensity = None if frame.intensity is None else np.asarray(frame.intensity)[valid]
    xyz = xyz[valid]
    uv, seen = camera.project(xyz @ start[:3, :3].T + start[:3, 3])
    with np.errstate(invalid="ignore"):
        near = seen & (np.abs(uv / size - 0.5) < 0.8).all(1)
    edges = scene_edges(xyz[near], None if intensity is None else intensity[near])
    lifted, at = lift(edges, camera, start)
    if len(at) < FEWEST_EDGES:
        return None
    some = np.linspace(0, len(at) - 1, min(len(at), MOST_EDGES)).round().astype(np.intp)
    lifted, at = lifted.part(some), at[some]
    scale = min(1.0, MOST_WIDTH / size[0])
    blurs = tuple(float(b) * _px_per_rad(camera) for b in BLURS_RAD)
    fields = orientation_fields(frame.image, blurs, scale)
    column, row = np.clip((at / size * TILES_WH).astype(np.intp), 0, np.array(TILES_WH) - 1).T
    return _Scene(lifted, fields, row * TILES_WH[0] + column)


def _px_per_rad(camera: Camera) -> float:
    """Pixels a radian in the middle of the picture."""
    w, h = camera.size_wh
    rays = camera.unproject(np.array([[w / 2 - 2, h / 2], [w / 2 + 2, h / 2]]))
    return float(4 / np.arccos(np.clip(rays[0] @ rays[1], -1, 1)))


def _folds(scenes: list[_Scene]) -> list[tuple[list[_Scene], list[_Scene]]]:
    """(learnt from, held out): by frames from three on, else by tiles like the fields of a chessboard."""
    if len(scenes) >= 3:
        groups = [[s for k, s in enumerate(scenes) if k % 3 == g] for g in range(3)]
        return [([s for k, s in enumerate(scenes) if k % 3 != g], groups[g]) for g in range(3)]
    halves = [
        [_some(s, (s.tile % TILES_WH[0] + s.tile // TILES_WH[0]) % 2 == g) for s in scenes] for g in (0, 1)
    ]
    return [(halves[0], halves[1]), (halves[1], halves[0])]


def _some(scene: _Scene, rows: NDArray[np.bool_]) -> _Scene:
    return _Scene(scene.lifted.part(rows), scene.fields, scene.tile[rows])


def _moved(x: Floats, T: Floats) -> Floats:
    """Turned about the camera's own centre, then shifted."""
    return pose(Rotation.from_rotvec(x[:3]).as_matrix(), x[3:]) @ T


def _score(camera: Camera, scenes: list[_Scene], T: Floats, blur: int) -> float:
    """The mean over frames, each counting alike."""
    return float(np.mean([edge_score(s.lifted, camera, T, s.fields[blur]) for s in scenes]))


def _optimised(camera: Camera, scenes: list[_Scene], start: Floats) -> Floats:
    """From wide to narrow: first turned, then turned and shifted (Nelder and Mead)."""
    x = np.zeros(6)
    for blur, free in ((0, 3), (1, 3), (1, 6), (2, 6), (3, 6)):
        unit = np.r_[np.full(3, BLURS_RAD[blur]), np.full(3, min(BLURS_RAD[blur] * 4, 0.05))]

        def cost(y: Floats, blur: int = blur, free: int = free, unit: Floats = unit, x: Floats = x) -> float:
            z = np.r_[y * unit[:free], x[free:]]
            moved = (z[:3] ** 2).sum() / _PRIOR_RAD**2 + (z[3:] ** 2).sum() / _PRIOR_M**2
            return _PRIOR * moved - _score(camera, scenes, _moved(z, start), blur)

        y0 = x[:free] / unit[:free]
        simplex = np.vstack([y0, y0 + np.eye(free)]) - 1 / (free + 1)
        options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-4, "maxfev": 35 * free}
        y = minimize(cost, y0, method="Nelder-Mead", options=options).x
        x = np.r_[y * unit[:free], x[free:]]
    return _moved(x, start)


def _held_out(
    camera: Camera, held: list[list[_Scene]], parts: list[Floats], start: Floats
) -> tuple[float, float, float]:
    """Scores before and after of edges that the parts did not see; the gain over its deviation (tiles drawn
    anew).
    """
    rows = []
    for scenes, T in zip(held, parts, strict=True):
        for s in scenes:
            for tile in np.unique(s.tile):
                some = s.lifted.part(s.tile == tile)
                field = s.fields[_JUDGED]
                scores = edge_score(some, camera, start, field), edge_score(some, camera, T, field)
                rows.append((some.weights.sum(), *scores))
    weight, before, after = np.array(rows).T
    draws = np.random.default_rng(0).integers(0, len(rows), (300, len(rows)))
    gain = np.array([np.average((after - before)[d], weights=weight[d]) for d in draws])
    mean = float(np.average(after - before, weights=weight))
    return (
        float(np.average(before, weights=weight)),
        float(np.average(after, weights=weight)),
        mean / max(float(gain.std()), 1e-9),
    )


def _apart(A: Floats, B: Floats) -> tuple[float, float]:
    """Angle and distance between two places of the LiDAR in the camera."""
    R = A[:3, :3] @ B[:3, :3].T
    angle = float(np.linalg.norm(Rotation.from_matrix(R).as_rotvec()))
    return angle, float(np.linalg.norm(invert(A)[:3, 3] - invert(B)[:3, 3]))


def _fault(
    camera: Camera,
    scenes: list[_Scene],
    T: Floats,
    moved: tuple[float, float],
    apart: tuple[float, float],
    gain_sigma: float,
) -> str:
    """Why the candidate is not to be trusted; empty where it is."""
    turn_deg, apart_deg = np.degrees(moved[0]), np.degrees(apart[0])
    if moved[0] > FARTHEST_RAD or moved[1] > FARTHEST_M:
        return f"it moved {turn_deg:.1f} degrees and {moved[1]:.2f} m: the start is wrong, or the scene bare"
    if apart[0] > _AGREE_RAD or apart[1] > _AGREE_M:
        found = f"parts of the data disagree by {apart_deg:.1f} degrees and {apart[1]:.2f} m"
        return f"{found}: the start is too far off, or the scenes have too few edges"
    if not _stands_out(camera, scenes, T):
        return "the result scores hardly better than what lies 2.5 degrees around it"
    if gain_sigma < 3:
        return f"held-out edges do not score better by enough (gain {gain_sigma:.1f} of its deviations)"
    return ""


def _stands_out(camera: Camera, scenes: list[_Scene], T: Floats) -> bool:
    here = _score(camera, scenes, T, _JUDGED)
    turns = np.arange(8) * np.pi / 4
    ring = [_moved(_AROUND_RAD * np.array([np.cos(a), np.sin(a), 0, 0, 0, 0]), T) for a in turns]
    around = [_score(camera, scenes, other, _JUDGED) for other in ring]
    return bool(here > max(_DISTINCT * max(around), float(np.mean(around) + 3 * np.std(around)), 0.0))
