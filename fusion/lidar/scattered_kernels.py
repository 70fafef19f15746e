"""The loops of scattered-data interpolation, compiled; `fusion.lidar.scattered` prepares what they take.

A mesh is a Delaunay triangulation: `corner` (3 T int32) holds three sites a triangle, counter-clockwise in
(x, y); half-edge e runs from corner[e] to the next corner of its triangle e // 3; `twin` (3 T int32) is the
half-edge that runs back along it in the neighbouring triangle, -1 on the hull. Coordinates are float64.
Each result depends on its pixel alone: rows may be given out to any number of threads.
"""

from __future__ import annotations

import math

import numpy as np

from fusion.kernels import compiled


@compiled
def twins(corner, neighbour, twin):
    """`neighbour` (T x 3) names the triangle opposite to each corner, -1 where there is none."""
    for t in range(neighbour.shape[0]):
        for k in range(3):
            e = 3 * t + (k + 1) % 3  # the edge opposite to corner k
            other = neighbour[t, k]
            twin[e] = -1
            for f in range(3 * other, 3 * other + 3):
                if other >= 0 and corner[f] == corner[_next(e)] and corner[_next(f)] == corner[e]:
                    twin[e] = f


@compiled
def circumcentres(corner, x, y, centre):
    """`centre` (T x 2): computed from an end of the shortest edge, where the least is lost to rounding."""
    for t in range(centre.shape[0]):
        shortest, base = math.inf, 0
        for k in range(3):
            a, b = corner[3 * t + k], corner[3 * t + (k + 1) % 3]
            length2 = (x[b] - x[a]) * (x[b] - x[a]) + (y[b] - y[a]) * (y[b] - y[a])
            if length2 < shortest:
                shortest, base = length2, k
        a, b, c = corner[3 * t + base], corner[3 * t + (base + 1) % 3], corner[3 * t + (base + 2) % 3]
        ax, ay, bx, by = x[b] - x[a], y[b] - y[a], x[c] - x[a], y[c] - y[a]
        a2, b2, d = ax * ax + ay * ay, bx * bx + by * by, 2 * (ax * by - ay * bx)
        if d == 0:  # three on one line, by rounding: the centre is far away
            d = 1e-12 * shortest
        centre[t, 0], centre[t, 1] = x[a] + (by * a2 - ay * b2) / d, y[a] + (ax * b2 - bx * a2) / d


@compiled
def _next(e):
    return e - 2 if e % 3 == 2 else e + 1


@compiled
def _before(e):
    return e + 2 if e % 3 == 0 else e - 1


@compiled
def _cut(yq, ya, yb, a, b):
    """What varies from `a` at ya to `b` at yb, at yq: never outside [a, b], and equal for both directions."""
    if ya > yb:
        ya, yb, a, b = yb, ya, b, a
    if yq <= ya:
        return a
    if yq >= yb:
        return b
    # Multiplied before it is divided: exact wherever all are whole numbers and the result is.
    return min(max(a + (yq - ya) * (b - a) / (yb - ya), min(a, b)), max(a, b))


@compiled
def _span(t, yq, corner, x, y, f):
    """Where the row yq crosses triangle t: leftmost and rightmost x with their values, empty if left > right.

    A crossing depends on its edge alone, so that spans of triangles that share the edge meet without a gap.
    A level edge gives its start; its end is the next edge's start.
    """
    left, right, f_left, f_right = math.inf, -math.inf, 0.0, 0.0
    for k in range(3):
        a, b = corner[3 * t + k], corner[3 * t + (k + 1) % 3]
        if min(y[a], y[b]) <= yq <= max(y[a], y[b]):
            xc = _cut(yq, y[a], y[b], x[a], x[b])
            fc = _cut(yq, y[a], y[b], f[a], f[b])
            if xc < left:
                left, f_left = xc, fc
            if xc > right:
                right, f_right = xc, fc
    return left, right, f_left, f_right


@compiled
def rasterise(corner, x, y, f, label, value):
    """For each pixel centre in the mesh its triangle and its linear interpolant, else -1 and as it was.

    `label` is H x W int32, `value` H x W float64. On a shared edge the triangle with the highest number
    wins. The value is interpolated along two edges, then between them: it stays between the corners' values
    and is accurate for slivers, where areas are not.
    """
    h, w = label.shape
    label[:] = -1
    for t in range(corner.size // 3):
        a, b, c = y[corner[3 * t]], y[corner[3 * t + 1]], y[corner[3 * t + 2]]
        first, last = max(math.ceil(min(a, b, c)), 0), min(math.floor(max(a, b, c)), h - 1)
        for row in range(first, last + 1):
            left, right, f_left, f_right = _span(t, float(row), corner, x, y, f)
            low, high = min(f_left, f_right), max(f_left, f_right)
            slope = (f_right - f_left) / (right - left) if right > left else 0.0
            for column in range(max(math.ceil(left), 0), min(math.floor(right), w - 1) + 1):
                label[row, column] = t
                value[row, column] = min(max(f_left + (column - left) * slope, low), high)
                if column == right:  # a site may be there, whose value is kept to the last bit
                    value[row, column] = f_right


@compiled
def linear_at(xq, yq, where, corner, x, y, f, out):
    """The linear interpolant at points of known triangles (`where`, N int32, -1: left as it was)."""
    for i in range(xq.size):
        if where[i] >= 0:
            left, right, f_left, f_right = _span(where[i], yq[i], corner, x, y, f)
            out[i] = _cut(xq[i], left, right, f_left, f_right)


@compiled
def locate(xq, yq, corner, twin, x, y, where):
    """The triangle of each point, -1 outside the hull: a walk that starts from the last point's triangle."""
    t = 0
    for i in range(xq.size):
        where[i] = -1
        for _ in range(corner.size):
            out = -1
            for e in range(3 * t, 3 * t + 3):
                a, b = corner[e], corner[_next(e)]
                if (x[b] - x[a]) * (yq[i] - y[a]) < (y[b] - y[a]) * (xq[i] - x[a]):
                    out = e
                    if twin[e] >= 0:
                        break
            if out < 0:
                where[i] = t
                break
            if twin[out] < 0:
                break
            t = twin[out] // 3


@compiled
def sibson_rows(first, last, label, corner, twin, x, y, f, centre, value):
    """Sibson's interpolant in place of the linear one, at the pixels of rows first to last - 1 of `value`."""
    stack = np.empty(corner.size // 3 + 4, np.int32)
    for row in range(first, last):
        for column in range(label.shape[1]):
            if label[row, column] >= 0:
                s = _sibson(
                    float(column), float(row), label[row, column], corner, twin, x, y, f, centre, stack
                )
                if not math.isnan(s):
                    value[row, column] = s


@compiled
def sibson_at(xq, yq, where, corner, twin, x, y, f, centre, out):
    """Sibson's interpolant in place of the linear one, at points of known triangles."""
    stack = np.empty(corner.size // 3 + 4, np.int32)
    for i in range(xq.size):
        if where[i] >= 0:
            s = _sibson(xq[i], yq[i], where[i], corner, twin, x, y, f, centre, stack)
            if not math.isnan(s):
                out[i] = s


@compiled
def _sibson(px, py, start, corner, twin, x, y, f, centre, stack):
    """Natural neighbour interpolation (Sibson 1981) at p, in triangle `start`; NaN: use the linear one.

    The triangles whose circle holds p (Bowyer and Watson's cavity) form a tree, which is walked so that its
    outline comes out counter-clockwise. The cell that p would take has its corners n at the circumcentres of
    p with the outline's edges; what it takes from the cell of a site is bounded by edges n-n, by edges from n
    to an old circumcentre and by edges between old circumcentres. The shoelace terms of all these edges
    are summed, each times the value of the site whose area it bounds. NaN: p lies on the hull, or so near to
    a site or the hull that an area is lost in rounding; there Sibson's interpolant tends to the linear one.
    """
    base = f[corner[3 * start]]  # values are taken relative to one of them: less cancels
    lowest, highest = math.inf, -math.inf
    weighted = area = 0.0
    first_x = first_y = last_x = last_y = first_f = 0.0
    begun = False
    depth = 0
    for k in range(2, -1, -1):
        stack[depth] = 3 * start + k
        depth += 1
    left = 2 * corner.size
    while depth > 0:
        left -= 1
        depth -= 1
        e = stack[depth]
        a, b, back = corner[e], corner[_next(e)], twin[e]
        # The edge is taken from the sites themselves: sites close together do not cancel.
        ax, ay, ex, ey = x[a] - px, y[a] - py, x[b] - x[a], y[b] - y[a]
        a2, e2, cross = ax * ax + ay * ay, ex * ex + ey * ey, ax * ey - ay * ex
        grown = 2 * (ax * ex + ay * ey) + e2  # |b - p|^2 - |a - p|^2
        cx, cy = centre[e // 3, 0] - px, centre[e // 3, 1] - py
        inside = False
        if back >= 0:
            o = corner[_before(back)]
            gx, gy = x[o] - x[a], y[o] - y[a]
            raised = 2 * (ax * gx + ay * gy) + gx * gx + gy * gy
            inside = grown * (ax * gy - ay * gx) - raised * cross - a2 * (ex * gy - ey * gx) > 0
        if inside:
            nx, ny = centre[back // 3, 0] - px, centre[back // 3, 1] - py
            if depth + 2 > stack.size or left < 0:
                return math.nan
            stack[depth], stack[depth + 1] = _before(back), _next(back)
            depth += 2
        else:
            if cross <= 1e-12 * math.sqrt(a2 * e2):
                return math.nan
            nx, ny = (ey * a2 - ay * grown) / (2 * cross), (ax * grown - ex * a2) / (2 * cross)
            fa = f[a] - base
            lowest, highest = min(lowest, fa), max(highest, fa)
            if begun:
                swept = last_x * ny - last_y * nx
                weighted += swept * fa
                area += swept
            else:
                begun, first_x, first_y, first_f = True, nx, ny, fa
            last_x, last_y = nx, ny
        weighted += (cx * ny - cy * nx) * (f[b] - f[a])
    swept = last_x * first_y - last_y * first_x
    weighted += swept * first_f
    area += swept
    if not area > 0:
        return math.nan
    return base + min(max(weighted / area, lowest), highest)


@compiled
def nearest_rows(first, last, x, y, out):
    """The nearest site of each pixel of rows first to last - 1 of `out` (H x W int32).

    Sites are sorted by (x, y). Exact: the distances to all sites of a row are parabolas of one width, whose
    lower envelope is built from left to right; sites farther from a row than its farthest pixel can be from
    its nearest site (one more than in the row before) are left out. Of sites equally near, the first.
    """
    site = np.empty(x.size, np.int32)
    begin = np.empty(x.size)
    reach = math.inf
    for row in range(first, last):
        top = -1
        for i in range(x.size):
            if abs(y[i] - row) > reach:
                continue
            di = (y[i] - row) * (y[i] - row)
            start = -math.inf
            while top >= 0:
                k = site[top]
                dk = (y[k] - row) * (y[k] - row)
                if x[i] == x[k]:
                    start = begin[top] if di < dk else math.inf
                else:
                    start = 0.5 * (x[i] + x[k] + (di - dk) / (x[i] - x[k]))
                if start > begin[top]:
                    break
                top -= 1
                start = -math.inf
            if start < math.inf:
                top += 1
                site[top], begin[top] = i, start
        reach = math.sqrt(_from_envelope(row, x, y, site, begin, top, out[row])) * (1 + 1e-12) + 1


@compiled
def _from_envelope(row, x, y, site, begin, top, out):
    """Each pixel's site, the best of three of the envelope; returns the largest squared distance."""
    farthest = 0.0
    k = 0
    for column in range(out.size):
        while k < top and begin[k + 1] < column:
            k += 1
        best, nearest = site[k], _distance2(site[k], column, row, x, y)
        for j in range(max(k - 1, 0), min(k + 2, top + 1)):
            d = _distance2(site[j], column, row, x, y)
            if d < nearest or (d == nearest and site[j] < best):
                best, nearest = site[j], d
        out[column] = best
        farthest = max(farthest, nearest)
    return farthest


@compiled
def _distance2(i, xq, yq, x, y):
    return (x[i] - xq) * (x[i] - xq) + (y[i] - yq) * (y[i] - yq)


@compiled
def nearest_at(xq, yq, x, y, out):
    """The nearest site of each point; of sites equally near, the first. Sites are sorted by (x, y)."""
    for i in range(xq.size):
        middle = np.searchsorted(x, xq[i])
        best, nearest = -1, math.inf
        j = middle
        while j < x.size and (x[j] - xq[i]) * (x[j] - xq[i]) <= nearest:
            d = _distance2(j, xq[i], yq[i], x, y)
            if d < nearest:
                best, nearest = j, d
            j += 1
        j = middle - 1
        while j >= 0 and (x[j] - xq[i]) * (x[j] - xq[i]) <= nearest:
            d = _distance2(j, xq[i], yq[i], x, y)
            if d <= nearest:
                best, nearest = j, d
            j -= 1
        out[i] = best


@compiled
def hull_of(x, y, ring):
    """The convex hull, counter-clockwise, without collinear points (Andrew 1979); how many sites it has.

    Sites are distinct and sorted by (x, y); `ring` (2 N + 2 int32) takes their numbers.
    """
    count = 0
    for turn in range(2):
        floor = count + 1
        for k in range(x.size):
            i = x.size - 1 - k if turn else k
            while count > floor and _turn(ring[count - 2], ring[count - 1], i, x, y) <= 0:
                count -= 1
            if not (turn and k == 0):
                ring[count] = i
                count += 1
            else:
                floor = count
    return max(count - 1, 1)


@compiled
def _turn(a, b, c, x, y):
    return (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a])


@compiled
def fill_convex(x, y, inside):
    """Marks the pixel centres (H x W bool, all False) in a convex polygon, its boundary included."""
    h, w = inside.shape
    for row in range(max(math.ceil(y.min()), 0), min(math.floor(y.max()), h - 1) + 1):
        left, right = math.inf, -math.inf
        for a in range(x.size):
            b = a + 1 if a + 1 < x.size else 0
            if min(y[a], y[b]) <= row <= max(y[a], y[b]):
                xc = _cut(float(row), y[a], y[b], x[a], x[b])
                left, right = min(left, xc), max(right, xc)
        for column in range(max(math.ceil(left), 0), min(math.floor(right), w - 1) + 1):
            inside[row, column] = True


@compiled
def extend(xq, yq, x, y, f, slope, out):
    """The linear extension at points outside a hull given by its sites in counter-clockwise order.

    From the nearest point of the hull: its value and `slope` (M x 2), linear between sites. That a point is
    the nearest is seen from its neighbours alone, so the search begins at the last one and goes both ways.
    """
    m = x.size
    last = 0
    for i in range(xq.size):
        best, best_t, nearest = last, 0.0, math.inf
        for step in range(m):
            a = (last + ((step + 1) // 2 if step % 2 else m - step // 2)) % m
            b = (a + 1) % m
            ex, ey, dx, dy = x[b] - x[a], y[b] - y[a], xq[i] - x[a], yq[i] - y[a]
            t = (ex * dx + ey * dy) / (ex * ex + ey * ey)
            beside = 0 <= t <= 1 and ex * dy - ey * dx < 0
            before = (a - 1) % m
            beyond = t < 0 and (x[before] - x[a]) * dx + (y[before] - y[a]) * dy <= 0
            t = min(max(t, 0.0), 1.0)
            d = (dx - t * ex) * (dx - t * ex) + (dy - t * ey) * (dy - t * ey)
            if d < nearest or beside or beyond:
                best, best_t, nearest = a, t, d
            if beside or beyond:
                break
        last, t = best, best_t
        b = (last + 1) % m
        dx, dy = xq[i] - x[last] - t * (x[b] - x[last]), yq[i] - y[last] - t * (y[b] - y[last])
        gx = slope[last, 0] + t * (slope[b, 0] - slope[last, 0])
        gy = slope[last, 1] + t * (slope[b, 1] - slope[last, 1])
        out[i] = f[last] + t * (f[b] - f[last]) + gx * dx + gy * dy
