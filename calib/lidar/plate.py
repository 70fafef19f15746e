"""A plate of known size in a cloud: which rays it stopped, where its rim is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import KDTree

from calib.observations import Ids
from fusion.geometry import Floats, pose

Bools = NDArray[np.bool_]
MARGIN = 0.3  # of the shorter side: how far beyond the rim rays are asked
FREE = 0.85  # share of the rays just outside that must pass, and of those inside that must not


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """`normal` (3,), unit, away from the sensor, through `centre_m` (3,); `sigma_m` is their scatter."""

    normal: Floats
    centre_m: Floats
    sigma_m: float

    @property
    def tolerance_m(self) -> float:
        """How far off the plane a point of the plate may lie."""
        return float(np.clip(3.5 * self.sigma_m, 0.02, 0.07))


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Where rays meet the plate's plane, in its own axes: `uv` N x 2 metres; `on` stopped there, `through`
    passed.

    Those that are neither were stopped before it. `index` are the points' rows, -1 for rays without return.
    `step_m` is the usual distance from one that was stopped there to the next.
    """

    uv: Floats
    on: Bools
    through: Bools
    index: Ids
    step_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A rectangle laid over rays. `T_lidar_plate`: origin at the plate's middle, axes as the board's.

    `stopped` is the share of the rays inside that the plate stopped (others pass, or are stopped before it),
    `free` that of the rays around it that passed out of those that went so far, NaN where there are none.
    """

    T_lidar_plate: Floats
    stopped: float
    free: float
    inside: Bools

    @property
    def score(self) -> float:
        """The worse of both shares."""
        return min(self.stopped, 1.0 if np.isnan(self.free) else self.free)

    @property
    def good(self) -> bool:
        return self.score >= FREE


def fit_plane(xyz_m: Floats) -> Plane:
    """The total least squares plane of N x 3 points around the origin's far side. Its scatter is robust."""
    centre = xyz_m.mean(0)
    normal = np.linalg.eigh(np.cov((xyz_m - centre).T))[1][:, 0]
    normal = normal if normal @ centre >= 0 else -normal
    off = (xyz_m - centre) @ normal
    return Plane(normal, centre, float(1.4826 * np.median(np.abs(off))))


def upright_axes(normal: Floats, across: Floats) -> Floats:
    """Rotation whose z is the normal and whose x is the given direction as far as the plane allows."""
    x = across - normal * (across @ normal)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal], 1)


def rays_of(
    xyz_m: Floats, plane: Plane, axes: Floats, reach_m: float, rings: NDArray[np.integer] | None
) -> Rays:
    """Every ray that meets the plane within `reach_m` of its centre, sorted into stopped, passed, neither.

    With `rings`, the first and the last ray stopped on each get a neighbour without return where the next one
    is missing (sky): one usual step further.
    """
    along = xyz_m @ plane.normal
    with np.errstate(divide="ignore", invalid="ignore"):
        meets = np.where(along > 0.05, (plane.normal @ plane.centre_m) / along, np.nan)
    at = xyz_m * meets[:, None]
    uv = (at - plane.centre_m) @ axes[:, :2]
    index = np.flatnonzero(np.isfinite(meets) & (meets > 0) & ((uv**2).sum(1) < reach_m**2))
    behind = along[index] - plane.normal @ plane.centre_m
    on, through = np.abs(behind) <= plane.tolerance_m, behind > plane.tolerance_m
    uv = uv[index]
    step = _step(uv[on])
    if rings is not None:
        extra = _without_return(xyz_m[index], rings[index], on, uv)
        uv = np.concatenate([uv, extra])
        on, through = np.r_[on, np.zeros(len(extra), bool)], np.r_[through, np.ones(len(extra), bool)]
        index = np.r_[index, np.full(len(extra), -1)]
    return Rays(uv, on, through, index, step)


def _step(uv: Floats) -> float:
    if len(uv) < 2:
        return 0.05
    return float(np.median(KDTree(uv).query(uv, 2)[0][:, 1]))


def _without_return(xyz: Floats, rings: NDArray[np.integer], on: Bools, uv: Floats) -> Floats:
    """Where the rays beyond the ends of each ring's run would meet the plane, if they brought no return."""
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    middle = np.angle(np.exp(1j * azimuth[on]).mean()) if on.any() else 0.0
    azimuth = np.angle(np.exp(1j * (azimuth - middle)))
    order = np.lexsort((azimuth, rings))
    steps = np.diff(azimuth[order])[np.diff(rings[order]) == 0]
    usual = float(np.median(steps[steps > 1e-6])) if (steps > 1e-6).any() else np.inf
    found = []
    for ring in np.unique(rings[on]):
        row = order[rings[order] == ring]
        hits = np.flatnonzero(on[row])
        for end, way in ((hits[0], -1), (hits[-1], 1)):
            other = end + way
            missing = not 0 <= other < len(row) or abs(azimuth[row[other]] - azimuth[row[end]]) > 1.6 * usual
            if missing and len(hits) > 1:
                inner = row[hits[1] if way < 0 else hits[-2]]
                turned = azimuth[row[end]] - azimuth[inner]
                found.append(uv[row[end]] + (uv[row[end]] - uv[inner]) * abs(usual / turned))
    return np.array(found).reshape(-1, 2)


def place(rays: Rays, plane: Plane, axes: Floats, size_m: Floats, turn_limit: float) -> Placed:
    """The w x h rectangle that has the stopped rays inside and those that passed outside.

    A smooth count of the rays on the wrong side is least (logistic, as wide as the rays' step), from the
    middle of the stopped ones and the given axes, from wide to narrow.
    """
    width = max(rays.step_m, 0.004)
    half = size_m / 2
    asked = rays.on | rays.through
    uv, sign = rays.uv[asked], np.where(rays.on[asked], 1.0, -1.0)

    def cost(p: Floats, w: float) -> tuple[float, Floats]:
        sd, slope = _outside_slope(uv, p, half)
        wrong = np.clip(sign * sd / w, -30, 30)
        push = sign / w / (1 + np.exp(-wrong))
        loss = np.logaddexp(0, wrong).sum() + (p[2] / turn_limit) ** 2
        return float(loss), push @ slope + [0, 0, 2 * p[2] / turn_limit**2]

    best = np.zeros(3)
    for w in (4 * width, 2 * width, width):
        best = minimize(
            cost, best, args=(w,), jac=True, method="BFGS", options={"maxiter": 20, "gtol": 1e-2}
        ).x
    c, s = np.cos(best[2]), np.sin(best[2])
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    middle = plane.centre_m + axes[:, :2] @ best[:2]
    sd = _outside(rays.uv, best, half)
    return Placed(pose(axes @ turn, middle), *_shares(rays, sd, MARGIN * size_m.min()), sd < 0)


def _shares(rays: Rays, sd: Floats, margin: float) -> tuple[float, float]:
    inside, around = sd < -rays.step_m, (sd > rays.step_m) & (sd < margin)
    on, through = (np.count_nonzero(rays.on & inside), np.count_nonzero(rays.through & inside))
    kept, passed = np.count_nonzero(rays.on & around), np.count_nonzero(rays.through & around)
    before = np.count_nonzero(~(rays.on | rays.through) & inside)
    return on / max(on + through + before, 1), passed / (kept + passed) if kept + passed else np.nan


def _outside(uv: Floats, p: Floats, half: Floats) -> Floats:
    """Distance to the rectangle's rim, negative inside (the larger of both axes' outside the corners)."""
    c, s = np.cos(p[2]), np.sin(p[2])
    x, y = (uv - p[:2]).T
    return np.maximum(np.abs(c * x + s * y) - half[0], np.abs(c * y - s * x) - half[1])


def _outside_slope(uv: Floats, p: Floats, half: Floats) -> tuple[Floats, Floats]:
    """The same, and its derivatives by the rectangle's middle and turn, N x 3."""
    c, s = np.cos(p[2]), np.sin(p[2])
    x, y = (uv - p[:2]).T
    X, Y = c * x + s * y, c * y - s * x
    across, down = np.abs(X) - half[0], np.abs(Y) - half[1]
    first = across > down
    a, b = np.sign(X), np.sign(Y)
    columns = (
        np.where(first, -a * c, b * s),
        np.where(first, -a * s, -b * c),
        np.where(first, a * Y, -b * X),
    )
    return np.maximum(across, down), np.stack(columns, 1)


def rim(rays: Rays, plane: Plane, axes: Floats, placed: Placed, size_m: Floats) -> tuple[Floats, Ids, float]:
    """Points on the rim (M x 3), the side of each (0 top, 1 right, 2 bottom, 3 left), their deviation (m).

    Each is half way between a stopped ray and one that passed, nearest to each other: where the rim was
    crossed is uniform between the two. Pairs that are far apart, off the placed rim or near a corner are left
    out.
    """
    on, through = np.flatnonzero(rays.on), np.flatnonzero(rays.through)
    none = np.zeros((0, 3)), np.zeros(0, np.intp), float("nan")
    if len(on) < 2 or len(through) < 2:
        return none
    to_on = np.asarray(KDTree(rays.uv[on]).query(rays.uv[through])[1])
    to_through = np.asarray(KDTree(rays.uv[through]).query(rays.uv[on])[1])
    mutual = to_through[to_on] == np.arange(len(through))
    a, b = rays.uv[on[to_on[mutual]]], rays.uv[through[mutual]]
    gap = np.linalg.norm(a - b, axis=1)
    at = plane.centre_m + ((a + b) / 2) @ axes[:, :2].T
    local = ((at - placed.T_lidar_plate[:3, 3]) @ placed.T_lidar_plate[:3, :3])[:, :2]
    half = size_m / 2
    # Distance outwards from top, right, bottom, left.
    out = np.stack([-local[:, 1], local[:, 0], local[:, 1], -local[:, 0]], 1) - half[[1, 0, 1, 0]]
    side = np.argmax(out, 1)
    other = np.sort(out, 1)[:, -2]
    usual = np.median(gap) if len(gap) else 0.0
    near = np.abs(out.max(1)) < np.maximum(gap, 2 * rays.step_m)
    kept = near & (gap <= 2.5 * usual) & (gap < 0.25 * size_m.min()) & (other < -gap)
    if not kept.any():
        return none
    return at[kept], side[kept].astype(np.intp), float(np.sqrt((gap[kept] ** 2).mean() / 12))
