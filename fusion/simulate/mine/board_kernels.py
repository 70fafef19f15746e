"""A printed board laid over what rays have hit, its pattern averaged over each ray's footprint."""

from __future__ import annotations

import math

import numpy as np

from fusion.kernels import compiled

CHESSBOARD, CIRCLES = 0, 1


@compiled
def _wave(u):
    """The integral of the square wave that is 1 in [0, 1), -1 in [1, 2), and so on."""
    k = math.floor(u)
    return u - k if int(k) % 2 == 0 else 1 - (u - k)


@compiled
def _chess(u, v, wu, wv, cols, rows):
    """The dark share of a box wu x wv around (u, v), in fields, of a pattern over [-1, cols] x [-1, rows]."""
    a, b = max(u - wu / 2, -1.0), min(u + wu / 2, float(cols))
    c, d = max(v - wv / 2, -1.0), min(v + wv / 2, float(rows))
    if b <= a or d <= c:
        return 0.0
    signs = (_wave(b) - _wave(a)) * (_wave(d) - _wave(c))
    return 0.5 * ((b - a) * (d - c) + signs) / (wu * wv)


@compiled
def _circles(u, v, w, cols, rows, radius):
    """The dark share of a spot w wide around (u, v), in row distances: of the circle nearest to it."""
    nearest = 1e9
    for i in range(max(int(v) - 1, 0), min(int(v) + 3, rows)):
        j = min(max(round((u - i % 2) / 2), 0), cols - 1)
        nearest = min(nearest, math.hypot(u - 2 * j - i % 2, v - i))
    return min(max(0.5 + (radius - nearest) / w, 0.0), 1.0)


@compiled
def lay_board(rays, T, box, pattern, print_of, footprint, indices, range_m, normal, material, printed):
    """Replace, in place, what lies behind the board. `T` is T_board_world (4 x 4 float64).

    `box` is its extent (x0, y0, x1, y1) in metres, `pattern` (kind, cols, rows, square_m, radius in squares),
    `print_of` its dark and bright reflectance, `indices` the materials of its front (seen along +z) and back.
    """
    least = 1e-4
    for i in range(range_m.size):
        ox, oy, oz, dx, dy, dz = rays[i, 0], rays[i, 1], rays[i, 2], rays[i, 3], rays[i, 4], rays[i, 5]
        slope = T[2, 0] * dx + T[2, 1] * dy + T[2, 2] * dz
        if abs(slope) < 1e-9:
            continue
        r = -(T[2, 0] * ox + T[2, 1] * oy + T[2, 2] * oz + T[2, 3]) / slope
        if not (0 < r < range_m[i]):
            continue
        px, py, pz = ox + r * dx, oy + r * dy, oz + r * dz
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        if not (box[0] <= x <= box[2] and box[1] <= y <= box[3]):
            continue
        sign = -1.0 if slope > 0 else 1.0
        range_m[i] = r
        normal[i, 0], normal[i, 1], normal[i, 2] = sign * T[2, 0], sign * T[2, 1], sign * T[2, 2]
        material[i] = indices[0] if slope > 0 else indices[1]
        printed[i] = np.nan
        if slope <= 0:
            continue
        lean_x = (T[0, 0] * dx + T[0, 1] * dy + T[0, 2] * dz) / slope
        lean_y = (T[1, 0] * dx + T[1, 1] * dy + T[1, 2] * dz) / slope
        scale = 1 / pattern[3]
        wu = max(r * footprint * math.sqrt(1 + lean_x * lean_x) * scale, least)
        wv = max(r * footprint * math.sqrt(1 + lean_y * lean_y) * scale, least)
        cols, rows = int(pattern[1]), int(pattern[2])
        if pattern[0] == CHESSBOARD:
            dark = _chess(x * scale, y * scale, wu, wv, cols, rows)
        else:
            dark = _circles(x * scale, y * scale, 0.5 * (wu + wv), cols, rows, pattern[4])
        printed[i] = print_of[1] + dark * (print_of[0] - print_of[1])
