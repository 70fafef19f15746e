"""The least-squares fit of a blurred corner of squares, compiled.

The state of a corner: x and y (px from where the search began), the angles of its two edges (rad), the
logarithm of its blur (px), then the linear part: grey level, its slopes along x and y, and the step's height.
"""

from __future__ import annotations

import math

import numpy as np

from fusion.kernels import compiled

_STATE = 9
_ROUNDS = 15


@compiled
def fit_windows(image, start, along, radius, moved, height):
    """Fit each corner in its window: `moved` (N, 2) px and the step's `height` (N,) are written."""
    square, side = np.empty((_STATE, _STATE)), np.empty(_STATE)
    new_square, new_side = np.empty((_STATE, _STATE)), np.empty(_STATE)
    state, trial, step = np.empty(_STATE), np.empty(_STATE), np.empty(_STATE)
    for k in range(start.shape[0]):
        state[:] = 0.0
        state[2], state[3], state[4] = along[k, 0], along[k, 1], math.log(1.2)
        error = _normal(image, start[k], radius[k], state, square, side)
        damping = 1e-2
        for _ in range(_ROUNDS):
            _solve(square, side, damping, step)
            _advance(state, step, math.log(max(radius[k], 1.0)), trial)
            new_error = _normal(image, start[k], radius[k], trial, new_square, new_side)
            if new_error > error:
                damping = min(damping * 5, 1e3)
                continue
            error = new_error
            done = abs(step[0]) + abs(step[1]) < 1e-3 and state[8] != 0
            state[:], square[:], side[:] = trial, new_square, new_side
            damping = max(damping / 5, 1e-6)
            if done:
                break
        moved[k, 0], moved[k, 1], height[k] = state[0], state[1], state[8]


@compiled
def _advance(state, step, widest, trial):
    """One step, but no more than a pixel and a third of a radian; the blur stays within reason."""
    for i in range(_STATE):
        longest = 1.0 if i < 2 else 0.3 if i < 5 else math.inf
        trial[i] = state[i] + min(max(step[i], -longest), longest)
    trial[4] = min(max(trial[4], math.log(0.3)), widest)


@compiled
def _normal(image, start, radius, state, square, side):
    """The normal equations of a step from `state`, into `square` and `side`; returns the squared error."""
    square[:], side[:] = 0.0, 0.0
    slope = np.empty(_STATE)
    cos1, sin1, cos2, sin2 = math.cos(state[2]), math.sin(state[2]), math.cos(state[3]), math.sin(state[3])
    blur = math.exp(state[4])
    wide, steep = 1 / (math.sqrt(2) * blur), math.sqrt(2 / math.pi) / blur
    middle = image[math.floor(start[1] + 0.5), math.floor(start[0] + 0.5)]
    error = 0.0
    for y in range(
        max(math.ceil(start[1] - radius), 0), min(math.floor(start[1] + radius) + 1, image.shape[0])
    ):
        for x in range(
            max(math.ceil(start[0] - radius), 0), min(math.floor(start[0] + radius) + 1, image.shape[1])
        ):
            ox, oy = x - start[0], y - start[1]
            weight = 1 - (ox * ox + oy * oy) / (radius * radius)
            if weight <= 0:
                continue
            dx, dy = ox - state[0], oy - state[1]
            across1, across2 = cos1 * dy - sin1 * dx, cos2 * dy - sin2 * dx
            edge1, edge2 = math.erf(across1 * wide), math.erf(across2 * wide)
            by1 = state[8] * steep * math.exp(-((across1 * wide) ** 2)) * edge2
            by2 = state[8] * steep * math.exp(-((across2 * wide) ** 2)) * edge1
            slope[0] = sin1 * by1 + sin2 * by2
            slope[1] = -cos1 * by1 - cos2 * by2
            slope[2] = -by1 * (cos1 * dx + sin1 * dy)
            slope[3] = -by2 * (cos2 * dx + sin2 * dy)
            slope[4] = -by1 * across1 - by2 * across2
            slope[5], slope[6], slope[7], slope[8] = 1.0, ox, oy, edge1 * edge2
            rest = image[y, x] - middle - state[5] - state[6] * ox - state[7] * oy - state[8] * slope[8]
            weight *= weight
            error += weight * rest * rest
            for i in range(_STATE):
                side[i] += weight * slope[i] * rest
                for j in range(i + 1):
                    square[i, j] += weight * slope[i] * slope[j]
    return error


@compiled
def _solve(square, side, damping, step):
    """Levenberg and Marquardt's step, by Cholesky's decomposition of the lower triangle."""
    low = np.zeros((_STATE, _STATE))
    for i in range(_STATE):
        for j in range(i + 1):
            rest = square[i, j]
            if i == j:
                rest += damping * square[i, i] + 1e-9
            for k in range(j):
                rest -= low[i, k] * low[j, k]
            low[i, j] = math.sqrt(max(rest, 1e-12)) if i == j else rest / low[j, j]
    for i in range(_STATE):
        step[i] = side[i]
        for k in range(i):
            step[i] -= low[i, k] * step[k]
        step[i] /= low[i, i]
    for i in range(_STATE - 1, -1, -1):
        for k in range(i + 1, _STATE):
            step[i] -= low[k, i] * step[k]
        step[i] /= low[i, i]
