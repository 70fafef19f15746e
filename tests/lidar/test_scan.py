"""Between rings and columns: against a plain twin, exact on planes, and nothing between the two sides of a
jump.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fusion.frames import PointCloud
from fusion.geometry import T_CAM_LIDAR, PinholeCamera, transform
from fusion.lidar.scan import JUMP, STEEP, scan
from fusion.lidar.sparse import SparseDepth

CAMERA = PinholeCamera.of_fov((160, 120), 90)


def samples_of(u, v, value, size_wh, ring=None):
    u, v = np.asarray(u, np.float64), np.asarray(v, np.float64)
    ring = None if ring is None else np.asarray(ring, np.int32)
    return SparseDepth(size_wh, u, v, np.asarray(value, np.float32), "depth", np.arange(len(u)), ring)


def scanned(distance, camera=CAMERA, rings=32, columns=360, seed=None, offset_m=(0, 0, 0)):
    """What a scanner sees of a world that gives the distance along unit rays (its frame), in the camera's
    picture.
    """
    e = np.radians(np.linspace(-25, 20, rings))[:, None]
    a = np.radians(np.arange(columns) * 360 / columns + 0.3)[None]
    rays = np.stack(np.broadcast_arrays(np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)), -1).reshape(
        -1, 3
    )
    far = distance(rays)
    kept = np.isfinite(far)
    xyz = transform(T_CAM_LIDAR, rays[kept] * far[kept, None]) + offset_m
    ring = np.repeat(np.arange(rings), columns)[kept]
    uv, seen = camera.project(xyz)
    seen &= ((uv >= -0.5) & (uv < np.subtract(camera.size_wh, 0.5))).all(1)
    if seed is not None:
        seen = np.random.default_rng(seed).permutation(np.flatnonzero(seen))
    return samples_of(uv[seen, 0], uv[seen, 1], xyz[seen, 2], camera.size_wh, ring[seen])


def plane(normal, offset):
    """Distance along rays to the plane normal . x = offset."""

    def distance(rays):
        along = rays @ np.asarray(normal, float)
        with np.errstate(divide="ignore"):
            t = offset / along
        return np.where((t > 0) & (t < 80), t, np.inf)

    return distance


def without_ring(s):
    return samples_of(s.u, s.v, s.value_m, s.size_wh)


# --- the plain twin


def twin(sparse, jump=JUMP, steep=STEEP, reach=16):
    """What `scan` promises, sample by sample, in float64."""
    w, h = sparse.size_wh
    columns = [[] for _ in range(w)]
    upside_down = np.sum((sparse.ring - sparse.ring.max() / 2) * (sparse.v - sparse.v.mean())) > 0
    for ring in sorted(set(sparse.ring.tolist()), reverse=bool(upside_down)):
        for x, v, q in ring_columns(sparse.take(sparse.ring == ring), jump, steep, reach):
            hidden_by = [k for k, (row, _) in enumerate(columns[x]) if row <= v]
            if all(columns[x][k][1] < q for k in hidden_by):
                columns[x] = [*(pair for pair in columns[x] if pair[0] > v), (v, q)]
    out = np.zeros((h, w))
    for x, stack in enumerate(columns):
        fill_column(out[:, x], stack, jump, steep)
    return out


def ring_columns(one, jump, steep, reach):
    best = {}
    for i in range(len(one)):
        x = int(np.floor(one.u[i] + 0.5))
        if x not in best or abs(one.u[i] - x) < abs(one.u[best[x]] - x):
            best[x] = i
    order = [best[x] for x in sorted(best)]
    u, v, q = one.u[order], one.v[order], 1 / one.value_m[order].astype(np.float64)
    far = max(reach, 6 * (u[-1] - u[0]) / len(u))
    slope = np.diff(q) / np.diff(u)
    found = {}
    for i in range(len(u)):  # the pixel a sample lies in always has its value, unless it is between two
        found[int(np.floor(u[i] + 0.5))] = (v[i], q[i])
    for i in range(len(u) - 1):
        if u[i + 1] - u[i] > far:
            continue
        apart = torn(q, slope, i, jump, steep)
        for x in range(int(np.ceil(u[i])), int(np.ceil(u[i + 1]))):
            t = (x - u[i]) / (u[i + 1] - u[i])
            t = float(t >= (0.75 if q[i] > q[i + 1] else 0.25)) if apart else t
            found[x] = (v[i] + t * (v[i + 1] - v[i]), q[i] + t * (q[i + 1] - q[i]))
    return [(x, *found[x]) for x in sorted(found)]


def torn(q, slope, i, jump, steep):
    beside = [slope[k] * np.sign(slope[i]) for k in (i - 1, i + 1) if 0 <= k < len(slope)]
    return abs(q[i + 1] - q[i]) > jump * min(q[i], q[i + 1]) and abs(slope[i]) > steep * max([0, *beside])


def fill_column(out, stack, jump, steep):
    for v, q in stack[:1] + stack[-1:]:
        out[int(np.floor(v + 0.5))] = 1 / q
    if len(stack) < 2:
        return
    v, q = np.array(stack).T
    slope = np.diff(q) / np.diff(v)
    for i in range(len(v) - 1):
        apart = torn(q, slope, i, jump, steep)
        for y in range(max(int(np.ceil(v[i + 1])), 0), min(int(np.floor(v[i])), len(out) - 1) + 1):
            t = (v[i] - y) / (v[i] - v[i + 1])
            if apart:
                t = float(t > (0.75 if q[i] > q[i + 1] else 0.25))
            out[y] = 1 / (q[i] + t * (q[i + 1] - q[i]))


def rough(rays):
    wall = plane((1, 0.2, 0), 6)(rays)
    post = np.where(np.abs(rays @ (0.1, 1, 0)) < 0.1, 2.0, np.inf)
    ball = np.where(rays @ (0.9, -0.4, 0.17) > 0.98, 3.5, np.inf)
    floor = plane((0, 0, -1), 1.5)(rays)
    noise = 1 + 0.01 * np.random.default_rng(0).standard_normal(len(rays))
    return np.minimum.reduce([wall, post, ball, floor]) * noise


@pytest.mark.parametrize("size_wh", [(160, 120), (97, 61), (7, 60), (16, 16)])
@pytest.mark.parametrize("offset_m", [(0, 0, 0), (0.1, 0.3, 0.2)])
def test_as_the_plain_twin(size_wh, offset_m):
    samples = scanned(rough, PinholeCamera.of_fov(size_wh, 90), seed=3, offset_m=offset_m)
    got, expected = scan(samples), twin(samples)
    np.testing.assert_array_equal(got > 0, expected > 0)
    off = ~np.isclose(got, expected, rtol=2e-4)
    assert (
        off.mean() < 2e-3
    )  # a row or a decision that rounding of single precision may put on the other side


def strewn(seed):
    rng = np.random.default_rng(seed)
    (w, h), n = rng.integers(1, 40, 2), rng.integers(1, 60)
    u, v, value = rng.uniform(-0.5, w - 0.5, n), rng.uniform(-0.5, h - 0.5, n), rng.uniform(1, 30, n)
    return samples_of(u, v, value, (int(w), int(h)), rng.integers(0, rng.integers(1, 6), n))


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
@example(19)  # the slope above the topmost pair
@example(50)
@example(216)
def test_any_samples_as_the_twin(seed):
    samples = strewn(seed)
    got, expected = scan(samples), twin(samples)
    np.testing.assert_array_equal(got > 0, expected > 0)
    assert (~np.isclose(got, expected, rtol=1e-3)).sum() <= 0.01 * got.size + 1
    inside = got[got > 0]
    assert inside.min() >= samples.value_m.min() * 0.999
    assert inside.max() <= samples.value_m.max() * 1.001


# --- what is true of the world


@pytest.mark.parametrize("normal", [(1, 0, 0), (1, 0.7, 0), (1, -0.4, 0.5), (0, 0, -1)])
@pytest.mark.parametrize("ringless", [False, True])
def test_planes_are_exact(normal, ringless):
    samples = scanned(plane(normal, 2.0))
    got = scan(without_ring(samples) if ringless else samples)
    v, u = np.nonzero(got)
    rays = CAMERA.unproject(np.stack([u, v], -1).astype(float))
    truth = 2.0 / (rays @ T_CAM_LIDAR[:3, :3] @ np.asarray(normal, float)) * rays[:, 2]
    first, last = (got > 0).argmax(0), 119 - (got[::-1] > 0).argmax(0)
    inner = (
        (u > 2) & (u < 157) & (v > first[u]) & (v < last[u])
    )  # half a pixel beyond a ring its value goes on
    assert inner.sum() > 2000
    off = np.abs(got[v, u] / truth - 1)[inner]
    if ringless:  # rows near the samples instead of rings: positions are shifted by up to half a pixel
        assert np.median(off) < 0.01
    else:
        assert off.max() < 1e-4


def box_before_wall(rays):
    wall = 10 / np.maximum(rays[:, 0], 1e-9)
    at = rays * (3 / np.maximum(rays[:, :1], 1e-9))
    box = (np.abs(at[:, 1]) < 0.8) & (np.abs(at[:, 2]) < 0.6)
    return np.where(rays[:, 0] > 0.1, np.where(box, 3 / np.maximum(rays[:, 0], 1e-9), wall), np.inf)


@pytest.mark.parametrize("ringless", [False, True])
def test_nothing_between_a_box_and_the_wall(ringless):
    samples = scanned(box_before_wall)
    got = scan(without_ring(samples) if ringless else samples)
    found = got[got > 0]
    assert np.all(np.isclose(found, 3, rtol=1e-3) | np.isclose(found, 10, rtol=1e-3))
    f = CAMERA.fx
    half_u, half_v = 0.8 / 3 * f, 0.6 / 3 * f
    box = (got > 0) & (got < 5)
    gap = np.tan(np.radians(45 / 31)) * f
    assert 2 * half_u < np.ptp(np.flatnonzero(box.any(0))) + 1 + gap < 2 * half_u + 4 * gap
    assert abs(box.sum() / (4 * half_u * half_v) - 1) < 0.2


def test_a_grazing_floor_is_no_jump():
    # Rings on a floor follow each other at ever larger ratios of distance; all of it is one surface.
    camera = PinholeCamera.of_fov((320, 240), 60)
    samples = scanned(plane((0, 0, -1), 1.7), camera, rings=128, columns=1800)
    ratio = np.sort(samples.value_m[np.abs(samples.u - 160) < 1])
    assert (ratio[1:] / ratio[:-1]).max() > 1 + 2 * JUMP
    got = scan(samples)
    rows = np.flatnonzero(got[:, 160])
    steps = -np.diff(1 / got[rows, 160])
    assert steps.max() < 1.05 * np.median(steps) or (steps <= 0).all()
    np.testing.assert_allclose(-steps, camera.fy**-1 / 1.7, rtol=0.05)


def test_order_and_direction_of_rings_do_not_matter():
    samples = scanned(rough)
    shuffled = samples.take(np.random.default_rng(1).permutation(len(samples)))
    np.testing.assert_array_equal(scan(shuffled), scan(samples))
    assert samples.ring is not None
    flipped = samples_of(samples.u, samples.v, samples.value_m, samples.size_wh, 31 - samples.ring)
    np.testing.assert_array_equal(scan(flipped), scan(samples))
    sparse_labels = samples_of(samples.u, samples.v, samples.value_m, samples.size_wh, samples.ring * 100_000)
    np.testing.assert_array_equal(scan(sparse_labels), scan(samples))


def test_the_nearer_hides_where_rings_cross():
    # Column 8: rings 0, 1, 2 at rows 20, 8, 12: the far sample of ring 1 is seen past the near one of ring 2.
    u, v = np.full(3, 8.0), np.array([20.0, 8.0, 12.0])
    got = scan(samples_of(u, v, [5, 9, 5], (20, 24), [0, 1, 2]))
    np.testing.assert_allclose(got[12:21, 8], 5, rtol=1e-6)
    assert not got[:12].any()


def test_holes_in_a_ring_stay_open():
    u = np.r_[np.arange(0, 30, 2.0), np.arange(120, 150, 2.0)]
    got = scan(
        samples_of(
            np.tile(u, 2), np.repeat([10.0, 14.0], 30), np.full(60, 5.0), (160, 20), np.repeat([1, 0], 30)
        )
    )
    assert got[10:15, :29].all()
    assert not got[:, 30:119].any()
    assert got[10:15, 120:149].all()


@pytest.mark.parametrize("ring", [None, [3]])
def test_one_sample_is_one_pixel(ring):
    got = scan(samples_of([5.4], [2.6], [4.0], (12, 9), ring))
    assert got.shape == (9, 12)
    assert got.dtype == np.float32
    assert got[3, 5] == 4
    assert np.count_nonzero(got) == 1


@pytest.mark.parametrize("ring", [None, np.zeros(0)])
def test_no_samples(ring):
    empty = np.zeros(0)
    assert not scan(samples_of(empty, empty, empty, (12, 9), ring)).any()


@pytest.mark.parametrize(
    ("u", "v", "value", "ring"),
    [
        *((12, 2, 1, 0), (-0.6, 2, 1, 0), (2, 9, 1, 0), (2, -1, 1, 0), (np.nan, 2, 1, 0)),
        *(
            (2, 2, 0, 0),
            (2, 2, -1, 0),
            (2, 2, np.inf, 0),
            (2, 2, np.nan, 0),
            (2, np.nan, 1, 0),
            (2, 2, 1, -1),
        ),
    ],
)
def test_samples_that_cannot_be(u, v, value, ring):
    with pytest.raises(ValueError, match="inside 12x9"):
        scan(samples_of([3, u], [3, v], [1, value], (12, 9), [0, ring]))
    if ring == 0:
        with pytest.raises(ValueError, match="inside 12x9"):
            scan(samples_of([3, u], [3, v], [1, value], (12, 9)))


def test_too_many_rings():
    n = 1025
    with pytest.raises(ValueError, match="1024 rings, got 1025"):
        scan(samples_of(np.full(n, 3), np.full(n, 3), np.ones(n), (12, 9), np.arange(n)))


def test_nothing_is_changed_and_nothing_is_shared():
    samples = scanned(rough)
    before = [a.copy() for a in (samples.u, samples.v, samples.value_m)]
    first = scan(samples)
    kept = first.copy()
    scan(scanned(plane((1, 0, 0), 3.0)))
    np.testing.assert_array_equal(first, kept)
    for a, b in zip(before, (samples.u, samples.v, samples.value_m), strict=True):
        np.testing.assert_array_equal(a, b)


def test_kitti_with_rings_held_out(shared_data):
    """Alternate rings from the others: rings that are recovered serve better than none."""
    from fusion.lidar.rings import rings_of

    xyz = (
        np.fromfile(shared_data / "kitti_object/velodyne/000000.bin", np.float32).reshape(-1, 4)[:, :3].copy()
    )
    ring = rings_of(PointCloud(xyz))
    assert ring is not None
    camera = PinholeCamera((1224, 370), 707.0, 707.0, 604.0, 180.5)
    at = transform(T_CAM_LIDAR, xyz)
    uv, seen = camera.project(at)
    seen &= ((uv >= -0.5) & (uv < np.subtract(camera.size_wh, 0.5))).all(1)
    every = samples_of(uv[seen, 0], uv[seen, 1], at[seen, 2], camera.size_wh, ring[seen])
    known, held = every.take(ring[seen] % 2 == 0), every.take(ring[seen] % 2 == 1)
    row, column = (np.floor(a + 0.5).astype(int) for a in (held.v, held.u))
    wrong = []
    for dense in (scan(known), scan(without_ring(known))):
        got = dense[row, column]
        covered = got > 0
        assert covered.mean() > 0.85
        wrong.append(np.mean(np.abs(got - held.value_m)[covered] > 0.5))
    assert wrong[0] < 0.2
    assert wrong[0] <= wrong[1] + 0.01
