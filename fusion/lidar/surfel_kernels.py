"""The loops of `fusion.lidar.surfels`, compiled."""

from __future__ import annotations

import math

import numpy as np

from fusion.kernels import compiled

_f32, _i64 = np.float32, np.int64
_HALF, _DEEP, _STEPS = _f32(0.5), _f32(3), 256


@compiled
def splat(order, xyz, normal, radius, u, v, range_m, rays, most, buffer):
    """Discs into a range image: `buffer` (H x W, inf: nothing) keeps the least range at which a pixel's ray
    meets one.

    `order` lists the discs to draw, near ones first: a disc whose centre lies deep behind what is there is
    not drawn. `rays` (H x W x 3) are unit directions of the pixels, NaN where there is none; `u`, `v` count
    its pixels; no disc covers more than `most` pixels to a side.
    """
    height, width = buffer.shape
    for i in order:
        column, row = min(max(_i64(u[i] + _HALF), 0), width - 1), min(max(_i64(v[i] + _HALF), 0), height - 1)
        if range_m[i] - _DEEP * radius[i] > buffer[row, column]:
            continue
        angle = np.divide(radius[i], range_m[i])
        wide = _extent(angle, _apart(rays, row, column, 0, 1), most)
        tall = _extent(angle, _apart(rays, row, column, 1, 0), most)
        first, last = max(_i64(math.ceil(u[i] - wide)), 0), min(_i64(math.floor(u[i] + wide)) + 1, width)
        for p in range(max(_i64(math.ceil(v[i] - tall)), 0), min(_i64(math.floor(v[i] + tall)) + 1, height)):
            _draw(rays[p], xyz[i], normal[i], radius[i], first, last, buffer[p])


@compiled
def _draw(rays, centre, normal, radius, first, last, line):
    x, y, z = centre[0], centre[1], centre[2]
    a, b, c = normal[0], normal[1], normal[2]
    offset, far2 = a * x + b * y + c * z, radius * radius
    for q in range(first, last):
        d, e, f = rays[q, 0], rays[q, 1], rays[q, 2]
        t = np.divide(offset, a * d + b * e + c * f)
        dx, dy, dz = t * d - x, t * e - y, t * f - z
        if (
            dx * dx + dy * dy + dz * dz <= far2 and 0 < t < line[q]
        ):  # false for NaN: no ray, or along the disc
            line[q] = t


@compiled
def near_first(u, v, range_m, seen, margin, width, height, order):
    """The discs that may touch the frame, in steps of 9 % of range, near ones first, into `order`; how
    many.
    """
    start = np.zeros(_STEPS + 1, np.int64)
    for i in range(u.size):
        if _touches(u[i], v[i], seen[i], margin, width, height):
            start[_step(range_m[i]) + 1] += 1
    for k in range(_STEPS):
        start[k + 1] += start[k]
    total = start[_STEPS]
    for i in range(u.size):
        if _touches(u[i], v[i], seen[i], margin, width, height):
            k = _step(range_m[i])
            order[start[k]] = i
            start[k] += 1
    return total


@compiled
def _touches(u, v, seen, margin, width, height):
    return seen and -margin < u < width + margin and -margin < v < height + margin


@compiled
def _step(range_m):
    return min(max(_i64(8 * math.log2(range_m + _f32(1e-6))) + 80, 0), _STEPS - 1)


@compiled
def _apart(rays, row, column, down, right):
    """The angle between a pixel's ray and its neighbour's."""
    p = row + down if row + down < rays.shape[0] else row - down
    q = column + right if column + right < rays.shape[1] else column - right
    if p < 0 or q < 0:
        return _f32(1)
    x, y, z = (
        rays[p, q, 0] - rays[row, column, 0],
        rays[p, q, 1] - rays[row, column, 1],
        rays[p, q, 2] - rays[row, column, 2],
    )
    return math.sqrt(x * x + y * y + z * z)


@compiled
def _extent(angle, apart, most):
    """Half the width of a disc's picture in pixels: a fifth more, since pixels shrink away from its
    centre.
    """
    if not apart > 0:
        return _f32(0.5)
    return _f32(min(1.2 * np.divide(angle, apart) + 0.5, most))


@compiled
def behind(u, v, range_m, tolerance, seen, buffer, visible):
    """Which points lie no farther behind the range image than their tolerance."""
    height, width = buffer.shape
    for i in range(u.size):
        visible[i] = False
        if seen[i] and -0.5 <= u[i] < width - 0.5 and -0.5 <= v[i] < height - 0.5:
            visible[i] = range_m[i] <= buffer[_i64(v[i] + 0.5), _i64(u[i] + 0.5)] + tolerance[i]
