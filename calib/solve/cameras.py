"""The camera models as the solver sees them: a vector of parameters, and derivatives by all of it.

Formulas are those of `fusion.geometry`; the tests hold the two together, and the derivatives to differences.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.geometry import FisheyeCamera, Floats, PinholeCamera
from fusion.rig import RigCamera

_PINHOLE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE = ("k1", "k2", "k3", "k4")
_POWERS = {"k1": 2, "k2": 4, "k3": 6, "k4": 8, "p1": 1, "p2": 1}  # of the radius; the rational's as k1 to k3
_RATIONAL = {"k4": 2, "k5": 4, "k6": 6}


@dataclass(frozen=True, slots=True)
class Pixels:
    """N points in an image: `uv` (N, 2), `seen` (N,), and the derivatives of uv (px) by the point in the
    camera's frame `by_point` (N, 2, 3) (px/m) and by the parameters `by_parameter` (N, 2, P)."""

    uv: Floats
    seen: NDArray[np.bool_]
    by_point: Floats
    by_parameter: Floats


def parameter_names(camera: RigCamera) -> tuple[str, ...]:
    """fx fy cx cy and those of the distortion coefficients that the camera has."""
    names = _FISHEYE if isinstance(camera, FisheyeCamera) else _PINHOLE
    return ("fx", "fy", "cx", "cy", *names[: len(camera.distortion)])


def parameters(camera: RigCamera) -> Floats:
    """(P,) values in the order of `parameter_names`."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion], np.float64)


def with_parameters(camera: RigCamera, values: Floats) -> RigCamera:
    """The camera with other parameters. Raises `UsageError` where they cannot be a camera's."""
    fx, fy, cx, cy, *distortion = (float(x) for x in values)
    return type(camera)(camera.size_wh, fx, fy, cx, cy, tuple(distortion))


def corner_radius(camera: RigCamera) -> float:
    """The distance of the picture's farthest corner from the centre, in focal lengths."""
    w, h = camera.size_wh
    across = max(abs(camera.cx), abs(w - 1 - camera.cx)) / camera.fx
    return float(np.hypot(across, max(abs(camera.cy), abs(h - 1 - camera.cy)) / camera.fy)) or 1.0


def effect_powers(camera: RigCamera) -> Floats:
    """(P,) by which power of the radius each coefficient acts on the radius itself, 0 for fx fy cx cy."""
    rational = _RATIONAL if isinstance(camera, PinholeCamera) else {}
    powers = _POWERS | rational
    return np.array([powers.get(name, 0) for name in parameter_names(camera)], np.float64)


def project(camera: RigCamera, values: Floats, xyz_m: Floats) -> Pixels:
    """Pixels of N x 3 points in the camera's frame by a camera of this kind with parameters `values`.

    `seen` is False where z (fisheye: the range) is not positive or a rational's denominator is not; there
    the numbers mean nothing (and may not be finite).
    """
    kind = _fisheye if isinstance(camera, FisheyeCamera) else _pinhole
    with np.errstate(all="ignore"):
        return kind(values, np.asarray(xyz_m, np.float64))


def _pinhole(values: Floats, xyz: Floats) -> Pixels:
    fx, fy, _, _, *rest = values
    k1, k2, p1, p2, k3, k4, k5, k6 = [*rest, *[0.0] * (8 - len(rest))]
    x, y, z = xyz.T
    a, b = x / z, y / z
    r2 = a * a + b * b
    below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    k = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
    slope = (k1 + r2 * (2 * k2 + r2 * 3 * k3) - k * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / below
    across = a * k + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
    down = b * k + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
    aa = k + 2 * a * a * slope + 2 * p1 * b + 6 * p2 * a
    ab = 2 * a * b * slope + 2 * p1 * a + 2 * p2 * b
    bb = k + 2 * b * b * slope + 6 * p1 * b + 2 * p2 * a
    by_point = np.empty((len(xyz), 2, 3))
    for row, f, by_a, by_b in ((0, fx, aa, ab), (1, fy, ab, bb)):
        by_point[:, row, 0], by_point[:, row, 1] = f * by_a / z, f * by_b / z
        by_point[:, row, 2] = -f * (by_a * a + by_b * b) / z
    radial = [r2 / below, r2**2 / below, r2**3 / below]
    columns = [
        *((q * a, q * b) for q in radial[:2]),
        (2 * a * b, r2 + 2 * b * b),
        (r2 + 2 * a * a, 2 * a * b),
        (radial[2] * a, radial[2] * b),
        *((-k * q * a, -k * q * b) for q in radial),
    ]
    seen = (z > 0) & (below > 0)
    return _pixels(values, across, down, by_point, columns[: len(rest)], seen)


def _fisheye(values: Floats, xyz: Floats) -> Pixels:
    fx, fy, _, _, *rest = values
    k1, k2, k3, k4 = rest or (0.0, 0.0, 0.0, 0.0)
    x, y, z = xyz.T
    rho, n2 = np.hypot(x, y), (xyz * xyz).sum(1)
    t = np.arctan2(rho, z)
    t2, off = t * t, rho > 1e-9 * np.sqrt(n2)
    radius = t * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    growth = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
    scale = np.where(off, radius / rho, 1 / z)  # on the axis: the limits
    bend = np.where(off, (growth * z / n2 - scale) / rho**2, 0.0)
    by_point = np.empty((len(xyz), 2, 3))
    for row, f, at in ((0, fx, x), (1, fy, y)):
        by_point[:, row, 0], by_point[:, row, 1] = f * at * x * bend, f * at * y * bend
        by_point[:, row, row] += f * scale
        by_point[:, row, 2] = -f * at * growth / n2
    powers = [np.where(off, t ** (2 * i + 1) / rho, 0.0) for i in range(1, 1 + len(rest))]
    columns = [(q * x, q * y) for q in powers]
    return _pixels(values, scale * x, scale * y, by_point, columns, off | (z > 0))


def _pixels(
    values: Floats,
    across: Floats,
    down: Floats,
    by_point: Floats,
    columns: list[tuple[Floats, Floats]],
    seen: NDArray[np.bool_],
) -> Pixels:
    """Focal lengths and centre on top of distorted coordinates and their derivatives by the coefficients."""
    fx, fy, cx, cy = values[:4]
    by_parameter = np.zeros((len(across), 2, len(values)))
    by_parameter[:, 0, 0], by_parameter[:, 1, 1] = across, down
    by_parameter[:, 0, 2] = by_parameter[:, 1, 3] = 1
    for i, (u, v) in enumerate(columns, 4):
        by_parameter[:, 0, i], by_parameter[:, 1, i] = fx * u, fy * v
    return Pixels(np.stack([fx * across + cx, fy * down + cy], -1), seen, by_point, by_parameter)
