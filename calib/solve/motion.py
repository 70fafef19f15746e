"""Rotations and motions from their vectors, many at once; and cross products without numpy's overhead."""

from __future__ import annotations

import numpy as np

from fusion.geometry import Floats

_SMALL = 1e-6  # rad^2 below which sines and cosines are replaced by their series (error below 1e-13)


def hat(v: Floats) -> Floats:
    """... x 3 x 3 matrices [v] with [v] x = v × x, of vectors ... x 3."""
    M = np.zeros((*v.shape[:-1], 3, 3))
    M[..., 2, 1], M[..., 0, 2], M[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    return M - np.swapaxes(M, -1, -2)


def cross(a: Floats, b: Floats) -> Floats:
    """a × b of arrays ... x 3 that broadcast."""
    (ax, ay, az), (bx, by, bz) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], -1)


def exp_motion(xi: Floats) -> Floats:
    """... x 4 x 4 rigid motions exp of twists ... x 6: rotation vector (rad), then translation (m).

    Closed form: R = exp([r]), t = V v with V = I + b [r] + c [r]^2 (Murray, Li, Sastry 1994, eq. 2.36).
    """
    r, v = xi[..., :3], xi[..., 3:]
    W, angle2 = hat(r), (r * r).sum(-1)[..., None, None]
    angle, series = np.sqrt(angle2), angle2 < _SMALL
    with np.errstate(divide="ignore", invalid="ignore"):
        a = np.where(series, 1 - angle2 / 6, np.sin(angle) / angle)
        b = np.where(series, 0.5 - angle2 / 24, (1 - np.cos(angle)) / angle2)
        c = np.where(series, 1 / 6 - angle2 / 120, (1 - a) / angle2)
    W2, T = W @ W, np.zeros((*xi.shape[:-1], 4, 4))
    T[..., :3, :3] = np.eye(3) + a * W + b * W2
    T[..., :3, 3] = ((np.eye(3) + b * W + c * W2) @ v[..., None])[..., 0]
    T[..., 3, 3] = 1
    return T


def exp_rotation(r: Floats) -> Floats:
    """... x 3 x 3 rotations exp([r]) of rotation vectors ... x 3 (rad)."""
    return exp_motion(np.concatenate([r, np.zeros_like(r)], -1))[..., :3, :3]


def moved(T: Floats, step: Floats) -> Floats:
    """... x 4 x 4 poses after a solver's step ... x 6: exp([r]) R and t + dt."""
    new = np.array(T)
    new[..., :3, :3] = exp_rotation(step[..., :3]) @ T[..., :3, :3]
    new[..., :3, 3] += step[..., 3:]
    return new
