"""Distance transform and discs of natural neighbours on a raster."""

from __future__ import annotations

import math

import numpy as np

from fusion.kernels import compiled

NOWHERE = 1 << 20  # farther than any row


@compiled
def site_rows(column, row, values, total, count, nearest):
    """Sites onto the raster, and each pixel's row of the nearest site in its column, NOWHERE if none.

    `total` (H x W float64) and `count` (H x W int32), both zero, take sum and number of each pixel's sites.
    """
    for i in range(column.size):
        total[row[i], column[i]] += values[i]
        count[row[i], column[i]] += 1
    h, w = count.shape
    for x in range(w):
        nearest[0, x] = 0 if count[0, x] > 0 else NOWHERE
    for y in range(1, h):
        for x in range(w):
            nearest[y, x] = y if count[y, x] > 0 else nearest[y - 1, x]
    for y in range(h - 2, -1, -1):
        for x in range(w):
            up, down = nearest[y, x], nearest[y + 1, x]
            nearest[y, x] = down if abs(down - y) < abs(y - up) else up


@compiled
def scatter_discs(first, last, nearest, grey, root, coarse, discs):
    """Each pixel of rows first to last - 1 spreads the value of its nearest site over a disc.

    Park et al. (2006); the disc reaches to the site and leaves it out. `grey` (H x W int64) is a site's value
    in units, shifted, plus one: value and count are summed at once. `discs` (H x (W + 1) int64) takes a
    disc's rows as steps up and down, whose running sums along rows are the sums. `root` (int32) holds whole
    square roots. Where the radius r is at least `coarse`, one disc stands for a block of pixels whose side
    is the power of two in (r / coarse, 2 r / coarse]; each other pixel of the block adds to itself only.
    """
    h, w = nearest.shape
    site, begin, height = np.empty(w + 1, np.int64), np.empty(w + 1, np.int64), np.empty(w + 1, np.int64)
    for y in range(first, last):
        top = _envelope(y, nearest[y], site, begin, height)
        begin[top + 1] = w
        for k in range(top + 1):
            s = site[k]
            v = np.int64(nearest[y, s])
            value, dv2 = grey[v, s], (y - v) * (y - v)
            for x in range(begin[k], begin[k + 1]):
                r2 = (x - s) * (x - s) + dv2
                if r2 < coarse * coarse:
                    _disc(x, y, r2, value, root, discs)
                else:
                    _disc(x, y, *_for_block(x, y, w, h, r2, coarse, value), root, discs)


@compiled
def _for_block(x, y, w, h, r2, coarse, value):
    """Squared radius and value that pixel (x, y) spreads: for its block, if in the middle, or for itself."""
    side = 2
    while r2 >= side * side * coarse * coarse:
        side *= 2
    left, top = x & -side, y & -side
    if x == min(left + side // 2, w - 1) and y == min(top + side // 2, h - 1):
        return r2, value * min(side, w - left) * min(side, h - top)
    return 1, value


@compiled
def _envelope(y, nearest, site, begin, height):
    """Whose column's site is nearest, along a row (Meijster et al. 2000): site[k] from column begin[k] on."""
    w = nearest.size
    top = -1
    for x in range(w):
        if nearest[x] == NOWHERE:
            continue
        own = x * x + np.int64(nearest[x] - y) * np.int64(nearest[x] - y)
        while top >= 0 and own - height[top] < begin[top] * 2 * (x - site[top]):
            top -= 1
        start = 0
        if top >= 0:  # after the last column in which site[top] is as near; floor is exact for such numbers
            start = np.int64(math.floor((own - height[top]) / (2.0 * (x - site[top])))) + 1
        if start < w:
            top += 1
            site[top], begin[top], height[top] = x, start, own
    return top


@compiled
def _disc(x, y, r2, grey, root, discs):
    h, w = discs.shape[0], discs.shape[1] - 1
    rest, dy = r2 - 1, 0
    while rest >= 0 and (y >= dy or y + dy < h):
        half = np.int64(root[rest]) if rest < root.size else np.int64(math.sqrt(np.float64(rest)))
        start, stop = max(x - half, 0), min(x + half + 1, w)
        if y >= dy:
            discs[y - dy, start] += grey
            discs[y - dy, stop] -= grey
        if dy > 0 and y + dy < h:
            discs[y + dy, start] += grey
            discs[y + dy, stop] -= grey
        rest -= 2 * dy + 1
        dy += 1


@compiled
def gather_discs(first, last, discs, total, count, bits, lowest, unit, out):
    """The mean of what reached each pixel of rows first to last - 1; a site's pixel keeps its own value.

    `discs` (K x H x (W + 1)) are the sums of K threads; `bits` says how many bits of a sum are its count.
    """
    for y in range(first, last):
        running = np.int64(0)
        for x in range(out.shape[1]):
            for k in range(discs.shape[0]):
                running += discs[k, y, x]
            if count[y, x] > 0:
                out[y, x] = total[y, x] / count[y, x]
            else:
                n = running & ((np.int64(1) << bits) - 1)
                out[y, x] = lowest + unit * (np.float64(running >> bits) / np.float64(n))
