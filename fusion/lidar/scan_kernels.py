"""The loops of `fusion.lidar.scan`, compiled. They index with what they know not to be negative."""

from __future__ import annotations

import numpy as np

from fusion.kernels import compiled

_f32, _i64, _u64 = np.float32, np.int64, np.uint64
LANES = (
    16  # columns worked on side by side: few enough that the rows between two rings differ little among them
)
_NEVER = _f32(1e9)
_FAR = 6.0  # no return where the gap is so many times the mean one of the ring
# How much of the gap at a jump the nearer surface gets; measured, see `fusion.lidar.scan`.
_NEARER = _f32(0.75)


@compiled
def place(u, v, value, ring, size, cells):
    """The sample nearest to the centre of each column, ring by ring (-1: none), into `cells` (rings x width).

    Returns -1 where a sample lies outside the image, 1 where ring 0 is on top, else 0.
    """
    if not (_all_inside(u, v, value, size) and ring.min() >= 0 and ring.max() < cells.shape[0]):
        return -1
    cells[:] = -1
    flat, (rings, width) = cells.reshape(-1), cells.shape
    middle, centre, weight = 0.5 * (rings - 1), v.mean(), 0.0
    for i in range(u.size):
        column = _i64(u[i] + 0.5)
        cell = _u64(ring[i] * width + column)
        held = flat[cell]
        if held < 0 or abs(u[i] - column) < abs(u[_u64(held)] - column):
            flat[cell] = i
        weight += (ring[i] - middle) * (v[i] - centre)
    return 1 if weight > 0 else 0


@compiled
def _all_inside(u, v, value, size):
    outside = 0
    right, bottom = size[0] - 0.5, size[1] - 0.5
    for i in range(u.size):
        here = (u[i] >= -0.5) & (u[i] < right) & (v[i] >= -0.5) & (v[i] < bottom)
        outside += not (here & (value[i] > 0) & (value[i] < np.inf))
    return outside == 0


@compiled
def along_rings(u, v, value, cells, upside_down, jump, steep, reach, heights, inverses, filled):
    """Pass 1: rings sampled at whole columns. Column x gets `filled[x]` pairs (row, 1 / value), lowest
    first.
    """
    filled[:] = 0
    rings, width = cells.shape
    us, vs, qs = np.empty(width + 1), np.empty(width + 1), np.empty(width + 1)
    tilt, slope, apart = np.empty(width + 1), np.zeros(width + 2), np.empty(width + 1, np.bool_)
    for k in range(rings):
        row = cells[rings - 1 - k if upside_down else k]
        n = 0
        for x in range(width):
            i = row[x]
            j = _u64(max(i, 0))
            us[n], vs[n], qs[n] = u[j], v[j], value[j]
            n += i >= 0
        if n:
            _slopes(us, vs, qs, n, jump, steep, tilt, slope, apart)
            far = max(reach, _FAR * np.divide(us[n - 1] - us[0], n))
            _columns(us, vs, qs, n, tilt, slope, apart, far, heights, inverses, filled)


@compiled
def _slopes(us, vs, qs, n, jump, steep, tilt, slope, apart):
    """How row and 1 / value change along a ring, and where it jumps: `slope[i + 1]` leads from i to i + 1."""
    for i in range(n):
        qs[i] = np.divide(1.0, qs[i])
    for i in range(n - 1):
        one = np.divide(1.0, us[i + 1] - us[i])
        tilt[i], slope[i + 1] = (vs[i + 1] - vs[i]) * one, (qs[i + 1] - qs[i]) * one
    slope[n] = 0
    for i in range(n - 1):
        apart[i] = _apart(qs[i], qs[i + 1], slope[i], slope[i + 1], slope[i + 2], jump, steep)


@compiled
def _apart(q0, q1, before, slope, after, jump, steep):
    """Whether two neighbours lie on two surfaces: farther apart than `jump`, and steeper than on either side.

    What slopes the other way beside them is no sign of a surface that goes on: a post has a jump on both
    sides.
    """
    sign = np.sign(slope)
    return (abs(q1 - q0) > jump * min(q0, q1)) & (abs(slope) > steep * max(sign * before, sign * after))


@compiled
def _columns(us, vs, qs, n, tilt, slope, apart, far, heights, inverses, filled):
    x = _i64(us[0] + 0.5)
    if x < us[0]:  # a ring reaches half a column beyond its last sample
        _push(x, vs[0], qs[0], heights, inverses, filled)
        x += 1
    for i in range(n - 1):
        if us[i + 1] - us[i] > far:
            if x == _i64(us[i] + 0.5):
                _push(x, vs[i], qs[i], heights, inverses, filled)
            x = _i64(us[i + 1] + 0.5)
            if x < us[i + 1]:
                _push(x, vs[i + 1], qs[i + 1], heights, inverses, filled)
                x += 1
            continue
        middle = us[i] + (_NEARER if qs[i] > qs[i + 1] else 1 - _NEARER) * (us[i + 1] - us[i])
        while x < us[i + 1]:
            t = x - us[i]
            if not apart[i]:
                _push(x, vs[i] + tilt[i] * t, qs[i] + slope[i + 1] * t, heights, inverses, filled)
            else:
                j = i if x < middle else i + 1
                _push(x, vs[j], qs[j], heights, inverses, filled)
            x += 1
    if x == _i64(us[n - 1] + 0.5):
        _push(x, vs[n - 1], qs[n - 1], heights, inverses, filled)


@compiled
def _push(x, v, q, heights, inverses, filled):
    """One more sample on top of column x; where rings cross (parallax), the nearer one hides the other."""
    column, n = _u64(x), filled[_u64(x)]
    while n > 0 and heights[_u64(n - 1), column] <= v:
        if inverses[_u64(n - 1), column] >= q:
            return
        n -= 1
    heights[_u64(n), column] = v
    inverses[_u64(n), column] = q
    filled[column] = n + 1


@compiled
def down_columns(heights, inverses, filled, jump, steep, out):
    """Pass 2: between the samples of each column, `LANES` columns at a time; `out` is at least that wide."""
    out[:] = 0
    _ends(heights, inverses, filled, out)
    width, most = out.shape[1], filled.max()
    before, slope, after = np.zeros(width, _f32), np.zeros(width, _f32), np.zeros(width, _f32)
    top, bottom, middle = np.empty(width, _f32), np.empty(width, _f32), np.empty(width, _f32)
    upper, lower, step = np.empty(width, _f32), np.empty(width, _f32), np.empty(width, _f32)
    for k in range(most - 1):
        v0, v1, q0, q1 = heights[k], heights[k + 1], inverses[k], inverses[k + 1]
        if k == 0:
            _gradient(v0, v1, q0, q1, filled, 0, slope)
        if k + 2 < most:
            _gradient(v1, heights[k + 2], q1, inverses[k + 2], filled, k + 1, after)
        else:
            after[:] = 0
        _between(
            v0,
            v1,
            q0,
            q1,
            before,
            slope,
            after,
            filled,
            k,
            jump,
            steep,
            top,
            bottom,
            middle,
            upper,
            lower,
            step,
        )
        _fill(top, bottom, middle, upper, lower, step, out)
        before, slope, after = slope, after, before


@compiled
def _gradient(v0, v1, q0, q1, filled, k, slope):
    """How 1 / value changes a row between the samples k and k + 1 of a column; 0 where there is no other."""
    for x in range(slope.size):
        s = np.divide(q1[x] - q0[x], v1[x] - v0[x])
        slope[x] = s if k + 1 < filled[x] else _f32(0)


@compiled
def _between(
    v0, v1, q0, q1, before, slope, after, filled, k, jump, steep, top, bottom, middle, upper, lower, step
):
    """What lies between the samples k and k + 1: 1 / value at row 0 above and below the middle, its step a
    row.
    """
    for x in range(v0.size):
        there = k + 1 < filled[x]
        apart = _apart(q0[x], q1[x], before[x], slope[x], after[x], jump, steep)
        plane = q0[x] - slope[x] * v0[x]
        top[x], bottom[x] = v1[x] if there else _NEVER, v0[x] if there else -_NEVER
        middle[x] = v1[x] + (_NEARER if q1[x] > q0[x] else _f32(1) - _NEARER) * (v0[x] - v1[x])
        upper[x], lower[x] = q1[x] if apart else plane, q0[x] if apart else plane
        step[x] = _f32(0) if apart else slope[x]


@compiled
def _fill(top, bottom, middle, upper, lower, step, out):
    height, width = out.shape
    flat = out.reshape(-1)
    for block in range(0, width, LANES):
        start = min(block, width - LANES)  # the last block overlaps: it writes the same again
        low, high = _NEVER, -_NEVER
        for lane in range(LANES):
            x = _u64(start + lane)
            low, high = min(low, top[x]), max(high, bottom[x])
        if low <= high:
            first, last = max(_i64(np.ceil(low)), 0), min(_i64(np.floor(high)), height - 1)
            _rows(top, bottom, middle, upper, lower, step, start, first, last, width, flat)


@compiled
def _rows(top, bottom, middle, upper, lower, step, start, first, last, width, flat):
    for y in range(first, last + 1):
        row, at = _f32(y), y * width + start
        for lane in range(LANES):
            x = _u64(start + lane)
            q = (upper[x] if row < middle[x] else lower[x]) + step[x] * row
            inside = (row >= top[x]) & (row <= bottom[x])
            held = flat[_u64(at + lane)]
            flat[_u64(at + lane)] = np.divide(_f32(1), q) if inside else held


@compiled
def _ends(heights, inverses, filled, out):
    """The pixels that hold the lowest and the highest sample of a column have a value even half a row beyond
    it.
    """
    for x in range(out.shape[1]):
        n = filled[x]
        if n > 0:
            for k in (0, n - 1):
                y = _i64(heights[_u64(k), x] + _f32(0.5))
                out[_u64(min(max(y, 0), out.shape[0] - 1)), x] = np.divide(_f32(1), inverses[_u64(k), x])


@compiled
def along_rows(u, v, value, size, reach, jump, pixels, heights, inverses, filled):
    """Pass 1 without rings: each sample is linked to the next one on its right, at most `reach` columns away.

    `pixels` (H x W) holds the sample nearest to each pixel's centre. Rows of the tables count from below.
    Returns whether all samples lie inside the image.
    """
    height, width = pixels.shape
    if not _all_inside(u, v, value, size):
        return False
    _nearest(u, v, pixels)
    inverses[:] = 0
    for y in range(height):
        for x in range(width):
            i = pixels[y, x]
            if i < 0:
                continue
            heights[height - 1 - y, x], inverses[height - 1 - y, x] = v[i], np.divide(1.0, value[i])
    for y in range(height):
        for x in range(width):
            i = pixels[y, x]
            if i < 0:
                continue
            j = _right(pixels, x, y, reach)
            if j >= 0:
                _link(u, v, value, i, j, jump, heights, inverses)
    _stack(heights, inverses, filled)
    return True


@compiled
def _nearest(u, v, pixels):
    pixels[:] = -1
    for i in range(u.size):
        x, y = _i64(u[i] + 0.5), _i64(v[i] + 0.5)
        j = pixels[y, x]
        if j < 0 or (u[i] - x) ** 2 + (v[i] - y) ** 2 < (u[j] - x) ** 2 + (v[j] - y) ** 2:
            pixels[y, x] = i


@compiled
def _right(pixels, x, y, reach):
    """The sample to the right of pixel (x, y) in the fewest columns, and there in the fewest rows; -1:
    none.
    """
    height, width = pixels.shape
    for dx in range(1, min(reach, width - 1 - x) + 1):
        for dy in range((dx + 2) // 3 + 1):
            if y + dy < height and pixels[y + dy, x + dx] >= 0:
                return pixels[y + dy, x + dx]
            if y - dy >= 0 and pixels[y - dy, x + dx] >= 0:
                return pixels[y - dy, x + dx]
    return -1


@compiled
def _link(u, v, value, i, j, jump, heights, inverses):
    q0, q1 = np.divide(1.0, value[i]), np.divide(1.0, value[j])
    du = u[j] - u[i]
    apart = abs(q1 - q0) > jump * min(q0, q1)
    for x in range(_i64(np.ceil(u[i])), _i64(np.ceil(u[j]))):
        t = np.divide(x - u[i], du)
        if apart:
            t = 0.0 if t < (_NEARER if q0 > q1 else 1 - _NEARER) else 1.0
        row = v[i] + t * (v[j] - v[i])
        k = heights.shape[0] - 1 - _i64(row + 0.5)
        if inverses[k, x] == 0:
            heights[k, x], inverses[k, x] = row, q0 + t * (q1 - q0)


@compiled
def _stack(heights, inverses, filled):
    filled[:] = 0
    for k in range(heights.shape[0]):
        for x in range(heights.shape[1]):
            if inverses[k, x] > 0:
                heights[filled[x], x], inverses[filled[x], x] = heights[k, x], inverses[k, x]
                filled[x] += 1
