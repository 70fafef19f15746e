"""Scattered-data interpolation against SciPy, a Sibson by clipping polygons, and brute force."""

from __future__ import annotations

from itertools import pairwise, product
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import ConvexHull, Delaunay, KDTree

from fusion.errors import FrameError
from fusion.lidar import scattered_kernels
from fusion.lidar.discrete import natural_discrete
from fusion.lidar.scattered import (
    Extrapolate,
    Method,
    ScatteredInterpolant,
    interpolate,
)

SIZE = (50, 40)
COLUMNS, ROWS = (a.astype(float) for a in np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])))
METHODS: tuple[Method, ...] = get_args(Method)
MODES: tuple[Extrapolate, ...] = get_args(Extrapolate)


def samples(count: int = 150, seed: int = 0, border: float = 6.0) -> tuple[NDArray[Any], ...]:
    """Points with room around them, so that the image has an outside; values from 1 to 80 without order."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(border, SIZE[0] - 1 - border, count)
    return u, rng.uniform(border, SIZE[1] - 1 - border, count), rng.uniform(1, 80, count)


def lattice(seed: int = 1, share: float = 0.3) -> tuple[NDArray[Any], ...]:
    """Points on whole pixels: circles through four and more, collinear points, a hull through pixels."""
    rng = np.random.default_rng(seed)
    v, u = np.nonzero(rng.random((24, 30)) < share)
    return u + 5.0, v + 7.0, rng.uniform(1, 80, len(u))


def clip(polygon: NDArray[Any], normal: NDArray[Any], limit: float) -> NDArray[Any]:
    """The part of a convex polygon with x . normal <= limit."""
    over = polygon @ normal - limit
    kept = []
    for i in range(len(polygon)):
        j = (i + 1) % len(polygon)
        if over[i] <= 0:
            kept.append(polygon[i])
        if over[i] * over[j] < 0:
            kept.append(polygon[i] + (polygon[j] - polygon[i]) * over[i] / (over[i] - over[j]))
    return np.array(kept).reshape(-1, 2)


def nearer(polygon: NDArray[Any], a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    return clip(polygon, b - a, float(b @ b - a @ a) / 2) if len(polygon) else polygon


def area(polygon: NDArray[Any]) -> float:
    if len(polygon) < 3:
        return 0.0
    x, y = (polygon - polygon[0]).T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def slow_sibson(points: NDArray[Any], values: NDArray[Any], p: NDArray[Any]) -> float | None:
    """From the definition: p's cell among all points, cut up by the cells that the points had without p.

    None where p's cell is (nearly) unbounded, on the hull and close to it.
    """
    points, far = points - p, 1e5  # p at the origin
    cell = np.array([[-far, -far], [far, -far], [far, far], [-far, far]])
    for q in points:
        cell = nearer(cell, np.zeros(2), q)
    reach = np.hypot(*cell.T).max()
    if reach > 1e3:
        return None
    near = np.hypot(*points.T) <= 2.001 * reach  # no other cell meets p's
    points, values = points[near], values[near]
    stolen = np.zeros(len(points))
    for i, a in enumerate(points):
        piece = cell
        for j, b in enumerate(points):
            if i != j and len(piece):
                piece = nearer(piece, a, b)
        stolen[i] = area(piece)
    assert stolen.sum() == pytest.approx(area(cell), rel=1e-6)
    return float(stolen @ values / stolen.sum())


def test_linear_is_scipys() -> None:
    u, v, f = samples()
    expected = LinearNDInterpolator(np.stack([u, v], axis=1), f)
    dense, inside = interpolate(u, v, f, SIZE, method="linear", extrapolate="none")
    reference = expected(COLUMNS, ROWS)
    assert np.array_equal(np.isfinite(reference), inside)
    np.testing.assert_allclose(dense, reference, rtol=1e-6)
    rng = np.random.default_rng(5)
    uq, vq = rng.uniform(0, SIZE[0], 500), rng.uniform(0, SIZE[1], 500)
    found = ScatteredInterpolant(u, v, f, "linear", "none")(uq, vq)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, expected(uq, vq), rtol=1e-9)


def test_every_pixel_in_the_hull_has_one_triangle_that_holds_it() -> None:
    """Whole coordinates: who holds a pixel is decided in integers, as is the hull."""
    u, v, f = lattice()
    mesh = Delaunay(np.stack([u, v], axis=1))
    label, value = np.empty(SIZE[::-1], np.int32), np.zeros(SIZE[::-1])
    x, y = (np.ascontiguousarray(a, np.float64) for a in (u, v))
    scattered_kernels.rasterise(mesh.simplices.astype(np.int32).reshape(-1), x, y, f, label, value)
    corners = mesh.points[mesh.simplices].astype(int)  # T x 3 x 2
    edge = np.roll(corners, -1, axis=1) - corners
    pixel = np.stack([COLUMNS, ROWS], axis=-1).astype(int).reshape(-1, 1, 1, 2)
    to = pixel - corners
    held = np.all(edge[..., 0] * to[..., 1] - edge[..., 1] * to[..., 0] >= 0, axis=-1)  # pixels x T
    found = label.reshape(-1)
    assert np.array_equal(found >= 0, held.any(1))
    assert held[np.flatnonzero(found >= 0), found[found >= 0]].all()
    assert (held.sum(1) > 1).sum() > 100  # shared edges were there to be decided


def test_triangles_of_pixels_are_scipys_off_the_edges() -> None:
    u, v, f = samples(400)
    mesh = Delaunay(np.stack([u, v], axis=1))
    label, value = np.empty(SIZE[::-1], np.int32), np.zeros(SIZE[::-1])
    scattered_kernels.rasterise(mesh.simplices.astype(np.int32).reshape(-1), u, v, f, label, value)
    assert np.array_equal(label, mesh.find_simplex(np.stack([COLUMNS, ROWS], axis=-1)))


@pytest.mark.parametrize("points", [samples(), lattice(), samples(3, border=-20)])
def test_nearest_is_the_nearest(points: tuple[NDArray[Any], ...]) -> None:
    u, v, _ = points
    chosen, _ = interpolate(u, v, np.arange(len(u)), SIZE, method="nearest", extrapolate="nearest")
    site = chosen.astype(int)
    distance, _ = KDTree(np.stack([u, v], axis=1)).query(np.stack([COLUMNS, ROWS], axis=-1))
    np.testing.assert_allclose(np.hypot(u[site] - COLUMNS, v[site] - ROWS), distance, rtol=1e-14)
    pointwise = ScatteredInterpolant(u, v, np.arange(len(u)), "nearest", "nearest")
    assert np.array_equal(pointwise(COLUMNS, ROWS), chosen)


def test_nearest_down_a_narrow_image() -> None:
    """Where every row is as far as can be from what the row before found."""
    dense, _ = interpolate([0, 1], [0, 0], [1, 2], (2, 40), method="nearest", extrapolate="nearest")
    assert (dense == [1, 2]).all()


def test_of_points_equally_near_the_leftmost_then_topmost_counts() -> None:
    u, v, _ = lattice()
    d2 = (COLUMNS[..., None] - u) ** 2 + (ROWS[..., None] - v) ** 2
    ties = d2 == d2.min(-1, keepdims=True)
    rank = np.argsort(np.argsort(u * 1000 + v))
    expected = np.argmin(np.where(ties, rank, len(u)), axis=-1)
    assert (ties.sum(-1) > 1).sum() > 100
    chosen, _ = interpolate(u, v, np.arange(len(u)), SIZE, method="nearest", extrapolate="nearest")
    assert np.array_equal(chosen, expected)


def test_samples_outside_the_image_count() -> None:
    u, v, f = samples(60, border=-30)
    for method in METHODS:
        dense, inside = interpolate(u, v, f, SIZE, method=method, extrapolate="none")
        assert inside.all()
        assert np.isfinite(dense).all()
    np.testing.assert_allclose(
        ScatteredInterpolant(u, v, f, "linear", "none")(COLUMNS, ROWS),
        LinearNDInterpolator(np.stack([u, v], axis=1), f)(COLUMNS, ROWS),
        rtol=1e-9,
    )


@pytest.mark.parametrize("points", [samples(25), lattice(share=0.05)], ids=["anywhere", "lattice"])
def test_natural_is_sibsons(points: tuple[NDArray[Any], ...]) -> None:
    u, v, f = points
    function = ScatteredInterpolant(u, v, f, "natural", "none")
    sites = np.stack([u, v], axis=1)
    rng = np.random.default_rng(3)
    middle = np.average(sites[rng.integers(0, len(u), (60, 3))], axis=1, weights=[0.5, 0.3, 0.2])
    on_edges = sites[Delaunay(sites).simplices[:10, :2]].mean(1)
    expected = [slow_sibson(sites, f, p) for p in (*middle, *on_edges)]
    assert sum(e is not None for e in expected) > 50
    for p, value in zip((*middle, *on_edges), expected, strict=True):
        if value is not None:
            assert function(*p) == pytest.approx(value, rel=1e-9)


def test_natural_is_startinpys() -> None:
    startinpy = pytest.importorskip("startinpy")
    u, v, f = samples(400)
    mesh = startinpy.DT()
    mesh.snap_tolerance = 1e-9
    mesh.insert(np.stack([u, v, f], axis=1), insertionstrategy="AsIs")
    rng = np.random.default_rng(4)
    q = np.stack([rng.uniform(9, 40, 300), rng.uniform(9, 30, 300)], axis=1)
    expected = np.asarray(mesh.interpolate({"method": "NNI"}, q))
    np.testing.assert_allclose(ScatteredInterpolant(u, v, f, "natural", "none")(*q.T), expected, rtol=1e-6)


@pytest.mark.parametrize("points", [samples(), lattice()], ids=["anywhere", "lattice"])
@pytest.mark.parametrize("method", ["linear", "natural"])
def test_affine_functions_come_back_inside_and_outside(
    points: tuple[NDArray[Any], ...], method: Method
) -> None:
    u, v, _ = points
    function = ScatteredInterpolant(u, v, 0.3 * u - 0.7 * v + 50, method, "linear")
    rng = np.random.default_rng(6)
    uq = np.concatenate([COLUMNS.reshape(-1), rng.uniform(-99, 99, 500)])
    vq = np.concatenate([ROWS.reshape(-1), rng.uniform(-99, 99, 500)])
    np.testing.assert_allclose(function(uq, vq), 0.3 * uq - 0.7 * vq + 50, rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("points", [samples(), lattice()], ids=["anywhere", "lattice"])
@pytest.mark.parametrize(("method", "mode"), list(product(METHODS, MODES)))
def test_samples_keep_their_values_also_on_the_hull(
    points: tuple[NDArray[Any], ...], method: Method, mode: Extrapolate
) -> None:
    u, v, f = points
    assert np.array_equal(ScatteredInterpolant(u, v, f, method, mode)(u, v), f)


@pytest.mark.parametrize(("method", "mode"), list(product(METHODS, MODES)))
def test_the_grid_holds_what_the_function_says(method: Method, mode: Extrapolate) -> None:
    for u, v, f in (samples(), lattice()):
        dense, inside = interpolate(u, v, f, SIZE, method=method, extrapolate=mode)
        function = ScatteredInterpolant(u, v, f, method, mode)
        assert dense.dtype == np.float32
        if (
            u % 1
        ).any() or method == "nearest":  # from which triangle an edge is seen differs in the last bits
            np.testing.assert_allclose(dense, function(COLUMNS, ROWS), rtol=3e-7, atol=1e-4)
        else:
            np.testing.assert_allclose(dense, function(COLUMNS, ROWS), rtol=1e-6, atol=1e-4)
        if mode == "none":
            assert np.array_equal(np.isfinite(dense), inside)
        else:
            assert np.isfinite(dense).all()
        threaded, _ = interpolate(u, v, f, SIZE, method=method, extrapolate=mode, threads=3)
        assert np.array_equal(dense, threaded, equal_nan=True)


@pytest.mark.parametrize("method", METHODS)
def test_inside_is_the_convex_hull_with_its_boundary(method: Method) -> None:
    u, v = np.array([5, 35, 5, 15, 10, 6]), np.array([5, 5, 25, 8, 9, 6])
    _, inside = interpolate(u, v, np.ones(6), SIZE, method=method, extrapolate="none")
    assert np.array_equal(inside, (COLUMNS >= 5) & (ROWS >= 5) & (2 * COLUMNS + 3 * ROWS <= 85))
    assert inside[15, 20]  # on the hypotenuse


@pytest.mark.parametrize("method", ["linear", "natural"])
def test_nearest_extrapolation_takes_the_nearest_sample(method: Method) -> None:
    u, v, f = samples()
    dense, inside = interpolate(u, v, f, SIZE, method=method, extrapolate="nearest")
    everywhere, _ = interpolate(u, v, f, SIZE, method="nearest", extrapolate="nearest")
    without, _ = interpolate(u, v, f, SIZE, method=method, extrapolate="none")
    assert np.array_equal(dense[~inside], everywhere[~inside])
    assert np.array_equal(dense[inside], without[inside])
    assert 100 < inside.sum() < inside.size - 100


def test_linear_extrapolation_follows_the_boundary_gradients() -> None:
    """Our reading, from its sentence: least squares at the hull's points, taken to the nearest of them."""
    u, v, f = samples(40)
    sites = np.stack([u, v], axis=1)
    mesh, ring = Delaunay(sites), ConvexHull(sites).vertices
    starts, neighbours = mesh.vertex_neighbor_vertices
    gradient = np.zeros((len(u), 2))
    for i in ring:
        near = neighbours[starts[i] : starts[i + 1]]
        step = sites[near] - sites[i]
        length = np.hypot(*step.T)
        gradient[i] = np.linalg.lstsq(step / length[:, None], (f[near] - f[i]) / length)[0]
    function = ScatteredInterpolant(u, v, f, "linear", "linear")
    rng = np.random.default_rng(8)
    for q in rng.uniform(-60, 110, (200, 2)):
        if mesh.find_simplex(q) >= 0:
            continue
        best = (np.inf, 0.0)
        for a, b in pairwise([*ring, ring[0]]):
            edge = sites[b] - sites[a]
            t = np.clip((q - sites[a]) @ edge / (edge @ edge), 0, 1)
            offset = q - sites[a] - t * edge
            slope = (1 - t) * gradient[a] + t * gradient[b]
            best = min(best, (float(offset @ offset), float((1 - t) * f[a] + t * f[b] + slope @ offset)))
        assert function(*q) == pytest.approx(best[1], rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(("method", "mode"), [("linear", "linear"), ("natural", "linear")])
def test_continuous_across_sites_edges_and_the_hull(method: Method, mode: Extrapolate) -> None:
    u, v, f = samples(40)
    function = ScatteredInterpolant(u, v, f, method, mode)
    ring = ConvexHull(np.stack([u, v], axis=1)).vertices
    turn = np.linspace(0, 2 * np.pi, 9)
    for i in range(len(u)):
        around = function(u[i] + 1e-7 * np.cos(turn), v[i] + 1e-7 * np.sin(turn))
        np.testing.assert_allclose(around, f[i], atol=1e-3)
    for a, b in pairwise([*ring, ring[0]]):
        for t in (0.2, 0.5, 0.9):
            p, q = u[a] + t * (u[b] - u[a]), v[a] + t * (v[b] - v[a])
            around = function(p + 1e-9 * np.cos(turn), q + 1e-9 * np.sin(turn))
            np.testing.assert_allclose(around, f[a] + t * (f[b] - f[a]), atol=1e-3)
    line = function(np.linspace(-20, 70, 20001), np.full(20001, 20.3))
    assert np.abs(np.diff(line)).max() < 1.0  # steps of 0.0045 px


def test_natural_is_smooth_where_linear_is_not() -> None:
    u, v, f = samples(60)
    x = np.arange(12, 38, 1e-4)
    bend = {m: np.diff(ScatteredInterpolant(u, v, f, m, "none")(x, 18.0 + 0 * x), 2) for m in METHODS[:2]}
    assert np.abs(bend["natural"]).max() < 0.05 * np.abs(bend["linear"]).max()


def test_duplicates_are_averaged() -> None:
    u, v, f = samples(30)
    again = ScatteredInterpolant(
        [*u, u[3], u[3]], [*v, v[3], v[3]], [*f, f[3] + 3, f[3] + 6], "linear", "none"
    )
    f[3] += 3
    once = ScatteredInterpolant(u, v, f, "linear", "none")
    assert (again.merged, once.merged) == (2, 0)
    np.testing.assert_allclose(again(COLUMNS, ROWS), once(COLUMNS, ROWS), rtol=1e-12)
    assert ScatteredInterpolant([0.0, -0.0], [1, 1], [2, 4], "nearest", "nearest")(9, 9) == 3


@pytest.mark.parametrize("method", ["linear", "natural"])
@pytest.mark.parametrize(
    ("u", "v", "count"),
    [([3], [4], 1), ([3, 3], [4, 4], 1), ([1, 2], [1, 5], 2), ([1, 2, 3, 7], [2, 4, 6, 14], 4)],
    ids=["one", "one twice", "two", "a line"],
)
def test_too_few_points_say_what_to_do(method: Method, u: list[int], v: list[int], count: int) -> None:
    with pytest.raises(
        FrameError, match=rf"three points .* not on one line; {count} given.*--method nearest"
    ):
        ScatteredInterpolant(u, v, [1.0] * len(u), method, "nearest")
    dense, inside = interpolate(u, v, range(len(u)), SIZE, method="nearest", extrapolate="nearest")
    assert np.isfinite(dense).all()
    bare, _ = interpolate(u, v, range(len(u)), SIZE, method="nearest", extrapolate="none")
    assert np.array_equal(np.isfinite(bare), inside)
    assert inside[v, u].all()
    assert inside.sum() <= 7  # the point, or the pixels exactly on the line


def test_almost_a_line_is_an_error_or_an_answer() -> None:
    x = np.linspace(0, 40, 30)
    for bend in (1e-16, 1e-14, 1e-12, 1e-9, 1e-6):
        y = 0.3 * x + 5 + bend * np.sin(x)
        try:
            dense, inside = interpolate(x, y, x, SIZE, method="natural", extrapolate="nearest")
        except FrameError:
            continue
        assert np.isfinite(dense).all()
        assert inside.sum() < 20


@pytest.mark.parametrize("gap", [1e-15, 1e-14, 1e-12, 1e-10, 1e-8, 1e-6])
def test_points_almost_on_each_other(gap: float) -> None:
    """Rounding may lose such points; between 1e-11 and 1e-14 px the triangulation is not to be trusted."""
    u, v, f = samples(60)
    function = ScatteredInterpolant([*u, *(u + gap)], [*v, *(v - gap)], [*f, *f], "natural", "linear")
    assert function.lost + function.merged <= 60
    dense, inside = function.on_grid(SIZE)
    assert f.min() <= dense[inside].min() <= dense[inside].max() <= f.max()
    if gap != 1e-12:
        single, _ = interpolate(u, v, f, SIZE, method="natural", extrapolate="linear")
        np.testing.assert_allclose(dense[inside], single[inside], atol=1e-3)


def test_misuse() -> None:
    good: Any = [1.0, 2.0, 5.0]
    with pytest.raises(FrameError, match="no sample"):
        ScatteredInterpolant([], [], [], "nearest", "none")
    with pytest.raises(FrameError, match="no sample"):
        natural_discrete([], [], [], SIZE)
    for bad in ([1.0, np.nan, 2.0], [1.0, 2.0], [[1.0, 2.0, 3.0]], [1.0, np.inf, 3.0]):
        for a, b, c in ((bad, good, good), (good, bad, good), (good, good, bad)):
            with pytest.raises(ValueError, match="expected"):
                ScatteredInterpolant(a, b, c, "nearest", "none")
            with pytest.raises(ValueError, match="expected"):
                natural_discrete(a, b, c, SIZE)
    unknown: Any = "cubic"
    with pytest.raises(ValueError, match="cubic"):
        ScatteredInterpolant(good, good, good, unknown, "none")
    with pytest.raises(ValueError, match="cubic"):
        ScatteredInterpolant(good, good, good, "nearest", unknown)
    with pytest.raises(ValueError, match="size"):
        interpolate(good, good, good, (0, 4), method="nearest", extrapolate="none")
    for wrong in ({"step": 0}, {"coarse": 3}):
        with pytest.raises(ValueError, match="expected"):
            natural_discrete(good, good, good, SIZE, **wrong)
    function = ScatteredInterpolant(good, good, good, "nearest", "nearest")
    assert np.isnan(function([np.nan, 1], [0, np.inf])).all()


def test_inputs_stay_as_they_were() -> None:
    u, v, f = samples(30)
    before = [a.copy() for a in (u, v, f)]
    for method in METHODS:
        interpolate(u, v, f, SIZE, method=method, extrapolate="linear")
    natural_discrete(u, v, f, SIZE)
    assert all(np.array_equal(a, b) for a, b in zip((u, v, f), before, strict=True))
    assert all(a.flags.writeable for a in (u, v, f))


whole = st.integers(-3, 30).map(float)
anywhere = st.floats(-3, 30)


@given(
    st.one_of(
        st.lists(st.tuples(whole, whole, st.floats(-50, 50)), min_size=1, max_size=25),
        st.lists(st.tuples(anywhere, anywhere, st.floats(-50, 50)), min_size=1, max_size=25),
    ),
    st.sampled_from(METHODS),
)
@settings(max_examples=150)
def test_values_stay_within_the_samples(points: list[tuple[float, float, float]], method: Method) -> None:
    u, v, f = np.array(points).T
    try:
        function = ScatteredInterpolant(u, v, f, method, "nearest")
    except FrameError:
        assume(False)
        return
    dense, inside = function.on_grid((28, 27))
    slack = 1e-5 * max(1, np.abs(f).max())
    assert np.isfinite(dense).all()
    assert dense.min() >= f.min() - slack
    assert dense.max() <= f.max() + slack
    assert inside[(ROWS[:27, :28] == v[0]) & (COLUMNS[:27, :28] == u[0])].all()
    discrete = natural_discrete(u, v, f, (28, 27))
    assert f.min() - slack <= discrete.min() <= discrete.max() <= f.max() + slack


def test_a_real_frame(shared_data: Path) -> None:
    """Samples on whole pixels in wide rows: what a data set of sparse depth images holds."""
    raw = cv2.imread(str(shared_data / "kitti_depth/velodyne_raw/0000000007.png"), cv2.IMREAD_UNCHANGED)
    assert raw is not None
    v, u = np.nonzero(raw[150:270, 300:600])
    depth_m = raw[150:270, 300:600][v, u] / 256.0
    dense, inside = interpolate(u, v, 1 / depth_m, (300, 120), method="natural", extrapolate="none")
    assert np.array_equal(dense[v, u], (1 / depth_m).astype(np.float32))
    sites, compared = np.stack([u, v], axis=1).astype(float), 0
    for row, column in np.argwhere(inside)[500::2711]:
        expected = slow_sibson(sites, 1 / depth_m, np.array([column, row], float))
        if expected is not None and raw[150 + row, 300 + column] == 0:
            assert dense[row, column] == pytest.approx(expected, rel=1e-6)
            compared += 1
    assert compared > 5


def slow_discrete(u: Any, v: Any, f: Any, size_wh: tuple[int, int], pick: Any) -> NDArray[Any]:
    """From the definition; `pick` (min or max): which value a pixel with several nearest samples takes."""
    rows, columns = (a.reshape(-1) for a in np.indices(size_wh[::-1]))
    d2 = (columns[:, None] - u) ** 2 + (rows[:, None] - v) ** 2
    least = d2.min(1)
    own = pick(np.where(d2 == least[:, None], f, -pick([-np.inf, np.inf])), axis=1)
    reached = (columns[:, None] - columns) ** 2 + (rows[:, None] - rows) ** 2 < least[
        :, None
    ]  # source x target
    mean = own @ reached / np.maximum(reached.sum(0), 1)
    return np.where(least == 0, own, mean).reshape(size_wh[::-1])


@pytest.mark.parametrize("size_wh", [(32, 24), (7, 30), (1, 9), (40, 1)])
@pytest.mark.parametrize("count", [1, 2, 9])
def test_discrete_is_its_definition(size_wh: tuple[int, int], count: int) -> None:
    rng = np.random.default_rng(count)
    at = rng.choice(size_wh[0] * size_wh[1], count, replace=False)
    u, v, f = at % size_wh[0], at // size_wh[0], rng.uniform(0.1, 1, count)
    found = natural_discrete(u, v, f, size_wh, coarse=None)
    assert found.dtype == np.float32
    assert (found >= slow_discrete(u, v, f, size_wh, np.min) - 1e-6).all()
    assert (found <= slow_discrete(u, v, f, size_wh, np.max) + 1e-6).all()


def test_discrete_by_hand() -> None:
    """A row of eight, samples at 0 and 7: radii 0 1 2 3 3 2 1 0, reaching all pixels nearer than that."""
    found = natural_discrete([0, 7], [0, 0], [0.0, 60.0], (8, 1), coarse=None)
    np.testing.assert_allclose(found[0], [0, 0, 20, 20, 40, 40, 60, 60], atol=1e-5)


def test_discrete_sums_do_not_depend_on_threads() -> None:
    rng = np.random.default_rng(0)
    u, v, f = rng.uniform(-4, 204, 80), rng.uniform(-4, 154, 80), rng.uniform(0, 1, 80)
    one = natural_discrete(u, v, f, (200, 150))
    assert all(np.array_equal(one, natural_discrete(u, v, f, (200, 150), threads=n)) for n in (2, 3, 999))


def test_discrete_moves_samples_to_pixels_and_averages_them() -> None:
    found = natural_discrete([2.4, 1.6, -9, 30], [3.0, 3.2, 0, 30], [2, 4, 7, 8], (10, 8))
    assert (found[3, 2], found[0, 0], found[7, 9]) == (3, 7, 8)
    assert (natural_discrete([4], [4], [0.25], (300, 200)) == 0.25).all()


def test_discrete_approaches_sibson_on_finer_rasters() -> None:
    u, v, f = samples(300, border=0)
    exact = ScatteredInterpolant(np.rint(u), np.rint(v), f, "natural", "none").on_grid(SIZE)[0]
    middle = np.s_[12:-12, 12:-12]  # no cell there is cut off by the raster's border
    errors = []
    for fine in (1, 3, 9):  # odd: a pixel's centre is the centre of a cell
        u_fine, v_fine = (np.rint(a) * fine + fine // 2 for a in (u, v))
        raster = natural_discrete(u_fine, v_fine, f, (SIZE[0] * fine, SIZE[1] * fine), coarse=None)
        difference = raster[fine // 2 :: fine, fine // 2 :: fine] - exact
        errors.append(np.sqrt(np.mean(difference[middle] ** 2)))
    assert errors[1] < 0.5 * errors[0]
    assert errors[2] < 0.5 * errors[1]


def test_blocks_of_distant_pixels_change_little() -> None:
    rng = np.random.default_rng(2)
    u, v = rng.uniform(0, 400, 60), rng.uniform(120, 300, 60)
    f = 1 + u / 400 + v / 300
    every, blocks = (natural_discrete(u, v, f, (400, 300), coarse=c) for c in (None, 16))
    assert 0 < np.abs(blocks - every).max() < 0.02 * np.ptp(f)
    near = KDTree(np.stack([u, v], axis=1)).query(np.stack(np.meshgrid(np.arange(400), np.arange(300)), -1))[
        0
    ]
    assert (near > 64).sum() > 10000  # three sizes of block
    for thin in ((1, 500), (500, 1), (3, 400), (400, 20)):
        assert np.isfinite(natural_discrete([0], [0], [1], thin)).all()


def test_a_coarser_step_is_near_the_finer_one() -> None:
    u, v, _ = samples(120, border=0)
    f = np.sin(u / 9) + v / 20
    fine = natural_discrete(u, v, f, SIZE)
    for step in (2, 3):
        coarse = natural_discrete(u, v, f, SIZE, step=step)
        assert coarse.shape == fine.shape
        assert np.sqrt(np.mean((coarse - fine) ** 2)) < 0.05 * step
    cell = natural_discrete([1.0], [2.0], [3.0], (5, 5), step=9)
    assert (cell == 3).all()


def test_triangles_without_area_are_no_division_by_zero() -> None:
    """Points in rows, as a flat wall gives them: rounding leaves triangles of three on one line."""
    k = np.arange(40)
    u, v = 320 - 37 * k * 0.1 / 5, 240 - 37 * (k % 5) * 0.3 / 5
    value = np.full(40, 5.0)
    dense, inside = interpolate(u, v, value, (640, 480), method="natural", extrapolate="none")
    assert inside.any()
    np.testing.assert_allclose(dense[inside], 5.0, rtol=1e-6)
