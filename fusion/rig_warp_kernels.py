"""The loops of `fusion.rig_warp`, compiled. A pixel's `near` is 1 / range from the thermal camera: 0 where
thermal does not see that way, negative where the pixel's distance is assumed, not known.

Points are float32: at 2000 px that is a position to 1e-4 px. Divisions are `np.divide`: Numba guards the
operator against zero, which stops vectorising.
"""

from __future__ import annotations

import math

import numpy as np

from fusion.kernels import compiled

_f32, _i32, _i64, _u32 = np.float32, np.int32, np.int64, np.uint32


@compiled
def place_pinhole(ray, value, t, lens, reach, box, x, y, near):
    """Each pixel's point, `ray` (3 x N) times |`value`| (N) plus `t`, through a pinhole with distortion.

    `lens` is fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6; `reach` the square of the largest radius x/z, y/z that can
    be in the picture; `box` least and largest x, least and largest y that count as seen.
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6 = lens
    ax, ay, az = ray[0], ray[1], ray[2]
    left, right, top, bottom = box
    for i in range(value.size):
        v = abs(value[i])
        z = _f32(_f32(az[i] * v) + t[2])
        one = np.divide(_f32(1), z)
        px, py = _f32(_f32(ax[i] * v) + t[0]), _f32(_f32(ay[i] * v) + t[1])
        a, b = _f32(px * one), _f32(py * one)
        r2 = _f32(_f32(a * a) + _f32(b * b))
        above = _f32(_f32(1) + r2 * _f32(k1 + r2 * _f32(k2 + _f32(r2 * k3))))
        below = _f32(_f32(1) + r2 * _f32(k4 + r2 * _f32(k5 + _f32(r2 * k6))))
        k, two = np.divide(above, below), _f32(_f32(2) * _f32(a * b))
        u = _f32(fx * _f32(a * k + _f32(p1 * two) + p2 * _f32(r2 + _f32(2) * _f32(a * a))) + cx)
        w = _f32(fy * _f32(b * k + _f32(p2 * two) + p1 * _f32(r2 + _f32(2) * _f32(b * b))) + cy)
        seen = (v > _f32(0)) & (z > _f32(0)) & (r2 <= reach)
        seen &= (u >= left) & (u <= right) & (w >= top) & (w <= bottom)
        away = np.divide(_f32(1), np.sqrt(_f32(_f32(px * px) + _f32(py * py) + _f32(z * z))))
        x[i], y[i] = u, w
        near[i] = _f32(math.copysign(away, value[i])) if seen else _f32(0)


@compiled
def place_fisheye(ray, value, t, lens, reach, box, x, y, near):
    """The same through a Kannala-Brandt fisheye: `lens` is fx fy cx cy k1 k2 k3 k4, `reach` an angle."""
    fx, fy, cx, cy, k1, k2, k3, k4 = lens
    ax, ay, az = ray[0], ray[1], ray[2]
    left, right, top, bottom = box
    for i in range(value.size):
        near[i] = _f32(0)
        v = abs(value[i])
        if not v > 0:
            continue
        px, py, z = ax[i] * v + t[0], ay[i] * v + t[1], az[i] * v + t[2]
        across = math.sqrt(px * px + py * py)
        angle = math.atan2(across, z)
        if not angle <= reach:
            continue
        s = angle * angle
        r = angle * (_f32(1) + s * (k1 + s * (k2 + s * (k3 + s * k4))))
        scale = r / across if across > 0 else _f32(0)
        u, w = fx * scale * px + cx, fy * scale * py + cy
        x[i], y[i] = u, w
        if left <= u <= right and top <= w <= bottom:
            near[i] = math.copysign(_f32(1) / math.sqrt(across * across + z * z), value[i])


@compiled
def spread(x, y, near, half, jump, nearest):
    """The z-buffer: each known pixel onto the thermal grid, as large there as it is, the nearer one wins.

    `nearest` (h x w, zero before) takes the largest `near`. `half` (2 x H x W) is half a pixel's extent on
    the thermal grid, left and right, up and down; where the neighbour to the right or below is of the same
    surface (`near` differs by less than `jump`) and farther off, the pixel reaches half-way to it.
    """
    rows, columns = near.shape
    for row in range(rows):
        below = min(row + 1, rows - 1)
        for column in range(columns):
            n = near[row, column]
            if not n > 0:
                continue
            right = min(column + 1, columns - 1)
            u, v = x[row, column], y[row, column]
            across, down = half[0, row, column], half[1, row, column]
            m = near[row, right]
            if m > 0 and abs(m - n) < jump:
                across = max(across, _f32(0.5) * abs(x[row, right] - u))
                down = max(down, _f32(0.5) * abs(y[row, right] - v))
            m = near[below, column]
            if m > 0 and abs(m - n) < jump:
                across = max(across, _f32(0.5) * abs(x[below, column] - u))
                down = max(down, _f32(0.5) * abs(y[below, column] - v))
            _cover(nearest, n, u - across, u + across, v - down, v + down)


@compiled
def _cover(nearest, n, left, right, top, bottom):
    """`n` into the pixels whose centres lie in [left, right) x [top, bottom), where it is the largest."""
    h, w = nearest.shape
    # Not below -2, so that the cut after adding 3 is a floor; of a whole number the pixel after it is taken.
    first, stop = max(_i32(left + _f32(3)) - 2, 0), min(_i32(right + _f32(3)) - 2, w)
    for row in range(max(_i32(top + _f32(3)) - 2, 0), min(_i32(bottom + _f32(3)) - 2, h)):
        for column in range(first, stop):
            nearest[_u32(row), _u32(column)] = max(nearest[_u32(row), _u32(column)], n)


@compiled
def judge(x, y, near, nearest, share, jump, inside, value, offset, fraction, mask):
    """Which pixels the thermal camera sees, and where: `offset` and `fraction` as `resample` reads them.

    A pixel is hidden where the z-buffer holds something nearer, by more than `share` of it and `jump`. Where
    it is not seen `mask` is 0 and the position means nothing. Returns how many are hidden, how many of those
    that the fixed mask `inside` has are without a `value`, and of how many seen it is assumed.
    """
    h, w = nearest.shape
    right, bottom = _f32(w - 1), _f32(h - 1)
    hidden = unknown = assumed = 0
    for i in range(near.size):
        n = abs(near[i])
        offset[i], fraction[i], mask[i] = 0, 0, 0
        if not n > 0:
            unknown += (inside[i] > 0) & (not abs(value[i]) > 0)
            continue
        u, v = min(max(x[i], _f32(0)), right), min(max(y[i], _f32(0)), bottom)
        if nearest[_u32(v + _f32(0.5)), _u32(u + _f32(0.5))] > n * (_f32(1) + share) + jump:
            hidden += 1
            continue
        qx, qy = _u32(u * _f32(256) + _f32(0.5)), _u32(v * _f32(256) + _f32(0.5))
        offset[i] = _u32(_u32(qy >> _u32(8)) * _u32(w) + _u32(qx >> _u32(8)))
        fraction[i] = _u32(_u32(qy & _u32(255)) << _u32(8)) | _u32(qx & _u32(255))
        mask[i] = 255
        assumed += near[i] < 0
    return hidden, unknown, assumed


@compiled
def largest_rectangle(mask, heights, starts, levels):
    """The largest rectangle x, y, w, h of non-zero pixels; of equals the topmost, then the least high.

    `heights` (W), `starts` and `levels` (W + 1) are int64 scratch: how far each column reaches up, and the
    rising steps of that outline.
    """
    rows, columns = mask.shape
    heights[:] = 0
    best_area, best = 0, (0, 0, 0, 0)
    for bottom in range(rows):
        depth = 0
        for x in range(columns + 1):
            level = 0
            if x < columns:
                heights[x] = heights[x] + 1 if mask[bottom, x] else 0
                level = heights[x]
            start = x
            while depth > 0 and levels[depth - 1] >= level:
                depth -= 1
                start = starts[depth]
                tall = levels[depth]
                area, top = tall * (x - start), bottom - tall + 1
                if area > best_area or (area == best_area and area > 0 and (top, tall) < (best[1], best[3])):
                    best_area, best = area, (start, top, x - start, tall)
            if level > 0:
                starts[depth], levels[depth] = start, level
                depth += 1
    return best
