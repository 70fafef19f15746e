"""The loops of `fusion.lidar.scan`, compiled. They index with what they know not to be negative."""

from __future__ import annotations

import numpy as np

from fusion.kernels import compiled

_f32, _i64, _u64 = np.float32, np.int64, np.uint64
LANES = 16  # columns worked on side by side: few enough that the rows between two rings differ little among them
_NEVER = _f32(1e9)


@compiled
def place(u, v, ring, cells):
    """Which sample is nearest to the centre of each column, ring by ring (-1: none). Returns whether ring 0 is on top."""
    cells[:] = -1
    flat, width = cells.reshape(-1), cells.shape[1]
    middle, centre, weight = 0.5 * (cells.shape[0] - 1), v.mean(), 0.0
    for i in range(u.size):
        column = _i64(u[i] + 0.5)
        cell = _u64(ring[i] * width + column)
        held = flat[cell]
        if held < 0 or abs(u[i] - column) < abs(u[_u64(held)] - column):
            flat[cell] = i
        weight += (ring[i] - middle) * (v[i] - centre)
    return weight > 0


@compiled
def along_rings(u, v, value, cells, upside_down, jump, steep, heights, inverses, filled):
    """Pass 1: rings sampled at whole columns. Column x gets `filled[x]` pairs (row, 1 / value), lowest first."""
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
            _columns(us, vs, qs, n, tilt, slope, apart, heights, inverses, filled)


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
    """Whether two neighbours lie on two surfaces: farther apart than `jump`, and steeper than on either side."""
    return (abs(q1 - q0) > jump * min(q0, q1)) & (abs(slope) > steep * max(abs(before), abs(after)))


@compiled
def _columns(us, vs, qs, n, tilt, slope, apart, heights, inverses, filled):
    x = _i64(us[0] + 0.5)
    if x < us[0]:  # a ring reaches half a column beyond its last sample
        _push(x, vs[0], qs[0], heights, inverses, filled)
        x += 1
    for i in range(n - 1):
        middle = 0.5 * (us[i] + us[i + 1])
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
    """Pass 2: between the samples of each column, `LANES` columns at a time. `out` is at least that wide."""
    out[:] = 0
    height, width = out.shape
    flat = out.reshape(-1)
    v0, v1, q0, q1 = np.empty(LANES, _f32), np.empty(LANES, _f32), np.empty(LANES, _f32), np.empty(LANES, _f32)
    before, slope, after = np.empty(LANES, _f32), np.empty(LANES, _f32), np.empty(LANES, _f32)
    top, bottom, middle = np.empty(LANES, _f32), np.empty(LANES, _f32), np.empty(LANES, _f32)
    upper, lower, step = np.empty(LANES, _f32), np.empty(LANES, _f32), np.empty(LANES, _f32)
    last = heights.shape[0] - 1
    for block in range(0, width, LANES):
        start = min(block, width - LANES)
        _ends(heights, inverses, filled, start, out)
        most = 0
        for lane in range(LANES):
            most = max(most, filled[start + lane])
            before[lane] = after[lane] = 0
        if most > 1:
            _gradient(heights, inverses, filled, start, 0, after)
        for k in range(most - 1):
            a, b = heights[k], heights[k + 1]
            c, d = inverses[k], inverses[k + 1]
            for lane in range(LANES):
                v0[lane], v1[lane] = a[_u64(start + lane)], b[_u64(start + lane)]
                q0[lane], q1[lane] = c[_u64(start + lane)], d[_u64(start + lane)]
                before[lane], slope[lane] = slope[lane] if k else _f32(0), after[lane]
            _gradient(heights, inverses, filled, start, min(k + 1, last - 1), after)
            low, high = _NEVER, -_NEVER
            for lane in range(LANES):
                there = k + 1 < filled[_u64(start + lane)]
                follows = after[lane] if k + 2 < filled[_u64(start + lane)] else _f32(0)
                apart = _apart(q0[lane], q1[lane], before[lane], slope[lane], follows, jump, steep)
                middle[lane] = _f32(0.5) * (v0[lane] + v1[lane])
                step[lane] = _f32(0) if apart else slope[lane]
                upper[lane] = q1[lane] if apart else q0[lane] - slope[lane] * v0[lane]
                lower[lane] = q0[lane] if apart else q0[lane] - slope[lane] * v0[lane]
                top[lane] = v1[lane] if there else _NEVER
                bottom[lane] = v0[lane] if there else -_NEVER
            for lane in range(LANES):
                low, high = min(low, top[lane]), max(high, bottom[lane])
            if low <= high:
                first, final = max(_i64(np.ceil(low)), 0), min(_i64(np.floor(high)), height - 1)
                for y in range(first, final + 1):
                    row, at = _f32(y), _u64(y * width + start)
                    for lane in range(LANES):
                        q = (upper[lane] if row < middle[lane] else lower[lane]) + step[lane] * row
                        inside = (row >= top[lane]) & (row <= bottom[lane])
                        held = flat[at + _u64(lane)]
                        flat[at + _u64(lane)] = np.divide(_f32(1), q) if inside else held


@compiled
def _gradient(heights, inverses, filled, start, k, out):
    a, b, c, d = heights[k], heights[k + 1], inverses[k], inverses[k + 1]
    for lane in range(LANES):
        x = _u64(start + lane)
        out[lane] = np.divide(d[x] - c[x], b[x] - a[x])


@compiled
def _ends(heights, inverses, filled, start, out):
    """The pixels that hold the lowest and the highest sample of a column have a value even half a row beyond it."""
    for lane in range(LANES):
        x = _u64(start + lane)
        n = filled[x]
        if n > 0:
            for k in (0, n - 1):
                y = _i64(heights[_u64(k), x] + _f32(0.5))
                out[_u64(min(max(y, 0), out.shape[0] - 1)), x] = np.divide(_f32(1), inverses[_u64(k), x])
