"""The loops of the robust plane fit, compiled.

Each pixel is summed in the order of the samples whatever the bands of rows, so that a result does not depend
on the number of threads. Divisions are `np.divide`: Numba guards the operator against zero, which stops
vectorising. Indices are unsigned: it would otherwise test for Python's negative ones.
"""

from __future__ import annotations

import numpy as np

from fusion.kernels import compiled

_f32, _i32 = np.float32, np.int32
TINY = _f32(1e-6)  # of a squared pixel, for a sample in the middle of the pixel and no other
SCRATCH = 11  # where a fit starts, its gain, and the sums of w (1, x, y, xx, xy, yy) and w (1, x, y) q


@compiled
def gaps_px(image, rows, columns, farthest, gaps):
    """The distance to the next sample to the right, and below; inf where it is farther than `farthest`."""
    h, w = image.shape
    for i in range(rows.size):
        y, x = rows[i], columns[i]
        gaps[0, i] = gaps[1, i] = np.inf
        for d in range(1, farthest):
            if d >= gaps[0, i] or x + d >= w:
                break
            for e in range(max(-d + 1, -y), min(d, h - y)):
                if image[y + e, x + d] > 0:
                    gaps[0, i] = min(gaps[0, i], np.sqrt(d * d + e * e))
        for d in range(1, farthest):
            if d >= gaps[1, i] or y + d >= h:
                break
            for e in range(max(-d, -x), min(d + 1, w - x)):
                if image[y + d, x + e] > 0:
                    gaps[1, i] = min(gaps[1, i], np.sqrt(d * d + e * e))


@compiled
def fit_rows(
    first, last, starts, column, row, u, v, q, weight, spans, reach, start, gain, ridge, clamp, sums, out
):
    """An affine function q(x, y) fitted at each pixel of rows [first, last) of `out`; NaN without samples.

    Samples (at `u`, `v` float32, in pixel `column`, `row`) are sorted by row; `starts` says where each row's
    begin. `weight` ((2 reach_y + 1) x columns) is that of a sample by the offset of its pixel, from lower and
    right to upper and left; of each of its rows only the columns of `spans` are used. The fit starts from the
    map `start`, to which values are relative; `gain` multiplies relative residuals before the Cauchy weight:
    0 fits plainly. `sums` is scratch, 11 x (columns of `out` and `weight`).
    """
    h = out.shape[0]
    reach_x, reach_y = reach
    n = np.uint64(weight.shape[1])
    weights = weight.reshape(-1)
    base, slack = sums[0], sums[1]
    s, sx, sy, sxx, sxy, syy = sums[2], sums[3], sums[4], sums[5], sums[6], sums[7]
    t, tx, ty = sums[8], sums[9], sums[10]
    for y in range(first, last):
        _begin(start[y], gain, np.uint64(reach_x), sums)
        for i in range(starts[max(0, y - reach_y)], starts[min(h, y + reach_y + 1)]):
            k = row[i] - y + reach_y
            lo, count = spans[k, 0], spans[k, 1]
            _add(
                weights,
                np.uint64(np.uint64(k) * n + np.uint64(lo)),
                np.uint64(column[i] + lo),
                count,
                _f32(u[i] - _f32(column[i] + lo - reach_x)),
                _f32(v[i] - _f32(y)),
                q[i],
                *(base, slack, s, sx, sy, sxx, sxy, syy, t, tx, ty),
            )
        _solve(np.uint64(reach_x), *(base, s, sx, sy, sxx, sxy, syy, t, tx, ty), ridge, clamp, out[y])


@compiled
def _begin(start, gain, shift, sums):
    sums[0] = _f32(1)
    sums[1:] = _f32(0)
    base, slack = sums[0], sums[1]
    for x in range(start.size):
        base[np.uint64(x) + shift] = start[x]
        slack[np.uint64(x) + shift] = np.divide(gain, start[x])


@compiled
def _add(weights, k, at, count, x0, y, q, base, slack, s, sx, sy, sxx, sxy, syy, t, tx, ty):
    """One sample's share in the sums of the pixels of its window along a row."""
    for j in range(count):
        i = at + np.uint64(j)
        d = _f32(q - base[i])
        e = _f32(d * slack[i])
        w = np.divide(weights[k + np.uint64(j)], _f32(_f32(1) + _f32(e * e)))
        x = _f32(x0 - _f32(_i32(j)))
        wx, wy, wd = _f32(w * x), _f32(w * y), _f32(w * d)
        s[i] += w
        sx[i] += wx
        sy[i] += wy
        sxx[i] += _f32(wx * x)
        sxy[i] += _f32(wx * y)
        syy[i] += _f32(wy * y)
        t[i] += wd
        tx[i] += _f32(wd * x)
        ty[i] += _f32(wd * y)


@compiled
def _solve(shift, base, s, sx, sy, sxx, sxy, syy, t, tx, ty, ridge, clamp, out):
    """The fitted functions' values at the pixels themselves, within `clamp` of the weighted mean."""
    for x in range(out.size):
        i = np.uint64(x) + shift
        one = np.divide(_f32(1), s[i])  # inf without samples: all that follows is NaN
        mx, my, m = _f32(sx[i] * one), _f32(sy[i] * one), _f32(t[i] * one)
        xx, yy = _f32(sxx[i] * one), _f32(syy[i] * one)
        held = _f32(ridge * _f32(xx + yy)) + TINY
        a = _f32(xx - _f32(mx * mx)) + held
        b = _f32(_f32(sxy[i] * one) - _f32(mx * my))
        c = _f32(yy - _f32(my * my)) + held
        e = _f32(_f32(tx[i] * one) - _f32(mx * m))
        f = _f32(_f32(ty[i] * one) - _f32(my * m))
        down = _f32(_f32(_f32(e * c) - _f32(f * b)) * mx) + _f32(_f32(_f32(f * a) - _f32(e * b)) * my)
        step = np.divide(down, _f32(_f32(a * c) - _f32(b * b)))
        mean = _f32(base[i] + m)
        limit = _f32(clamp * mean)
        out[x] = _f32(mean - min(max(step, -limit), limit))
