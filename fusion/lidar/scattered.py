"""Interpolation of scattered samples, as MATLAB's `scatteredInterpolant` does it (thesis 6.2, equation 6.2).

`interpolate` fills an image, `ScatteredInterpolant` answers at any point. Coordinates are pixels: u the
column, v the row, (0, 0) the centre of the first pixel; they need not be whole and may lie outside the image.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion.errors import FrameError
from fusion.kernels import read_only
from fusion.lidar.bands import in_bands

Method = Literal["linear", "natural", "nearest"]
Extrapolate = Literal["none", "nearest", "linear"]

_Reals = NDArray[np.float64]


class _Mesh(NamedTuple):
    """A Delaunay triangulation, as `fusion.lidar.scattered_kernels` describes it."""

    corner: NDArray[np.int32]
    twin: NDArray[np.int32]
    x: _Reals
    y: _Reals


class _Hull(NamedTuple):
    """What linear extrapolation needs: the hull's sites, counter-clockwise, with values and gradients."""

    x: _Reals
    y: _Reals
    value: _Reals
    slope: _Reals


def interpolate(
    u: ArrayLike,
    v: ArrayLike,
    values: ArrayLike,
    size_wh: tuple[int, int],
    *,
    method: Method,
    extrapolate: Extrapolate,
    threads: int = 1,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """`values` (N) sampled at columns `u` and rows `v` (N), at every pixel of an image of `size_wh`.

    Returns the values, H x W float32, NaN where there is none, and H x W bool: True inside the convex hull of
    the samples, its boundary included. The result does not depend on `threads`. The rules, and the errors
    raised, are those of `ScatteredInterpolant`.
    """
    return ScatteredInterpolant(u, v, values, method, extrapolate).on_grid(size_wh, threads=threads)


class ScatteredInterpolant:
    """The function through `values` (N) at distinct points (`u`, `v`) (N), after MATLAB's of that name.

    Points that are exactly equal are merged and their values averaged (`merged` counts the surplus). Methods:

    - ``linear``: linear on each triangle of a Delaunay triangulation; continuous.
    - ``natural``: natural neighbours, exactly (Sibson 1981): continuous, smooth but at the samples.
    - ``nearest``: the value of the nearest point; of points equally near, of the one with the least u, then
      the least v. (MATLAB does not say.)

    Outside the convex hull of the points `extrapolate` decides (MATLAB's default is ``nearest`` for the
    method ``nearest``, else ``linear``):

    - ``none``: NaN.
    - ``nearest``: the value of the nearest point. (MATLAB's manual speaks of the nearest neighbour on the
      hull's boundary. Hulls of image samples have few and distant corners, so we take all points.)
    - ``linear``: MATLAB's manual says that it rests on values and gradients at the hull's boundary, the
      gradients from least squares; the rest is our reading. A boundary point's gradient is that of the plane
      through its value that fits its neighbours in the triangulation best, each weighted by 1 / distance^2;
      value and gradient vary linearly between neighbouring boundary points; a query takes both from the
      boundary's nearest point. So it is continuous (for ``linear`` and ``natural``), and exact where the
      values are affine in (u, v). It is not bounded by the values: far outside it means little.

    Raises `FrameError` if there is no point, or, where the method or `extrapolate` needs a triangulation
    (any but ``nearest`` with ``none`` or ``nearest``), fewer than three or all on one line; `ValueError` for
    lists of unequal length, numbers that are not finite, or unknown names. Points less than 1e-10 px apart
    may be lost to the triangulation's rounding; `lost` counts them.
    """

    def __init__(
        self, u: ArrayLike, v: ArrayLike, values: ArrayLike, method: Method, extrapolate: Extrapolate
    ) -> None:
        if method not in get_args(Method) or extrapolate not in get_args(Extrapolate):
            raise ValueError(f"expected {Method} and {Extrapolate}, got {method!r} and {extrapolate!r}")
        x, y, value = checked_samples(u, v, values)
        self.method, self.extrapolate = method, extrapolate
        self._x, self._y, self._value = _merged(x, y, value)
        self.merged, self.lost = x.size - self._x.size, 0
        self._corner_hull = _convex_hull(self._x, self._y)
        self._mesh: _Mesh | None = None
        if method != "nearest" or extrapolate == "linear":
            if len(self._corner_hull) < 3:
                raise _too_few(self._x.size)
            self._mesh, self.lost = _triangulated(self._x, self._y)
        self._hull = _hull_slopes(self._mesh, self._value) if self._mesh and extrapolate == "linear" else None

    def __call__(self, uq: ArrayLike, vq: ArrayLike) -> _Reals:
        """The function at columns `uq` and rows `vq`, which broadcast: float64, NaN where it has no value."""
        wide_u, wide_v = np.broadcast_arrays(np.asarray(uq, np.float64), np.asarray(vq, np.float64))
        out = np.full(wide_u.shape, np.nan)
        known = np.isfinite(wide_u) & np.isfinite(wide_v)
        out[known] = self._at(read_only(wide_u[known]), read_only(wide_v[known]))
        return out

    def on_grid(
        self, size_wh: tuple[int, int], *, threads: int = 1
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """As `interpolate`."""
        from fusion.lidar import scattered_kernels as kernels

        width, height = checked_size(size_wh)
        inside = np.zeros((height, width), np.bool_)
        kernels.fill_convex(self._x[self._corner_hull], self._y[self._corner_hull], inside)
        if self._mesh is None or self.method == "nearest":
            dense = self._nearest_grid(inside.shape, threads)
        else:
            dense, label = self._mesh_grid(self._mesh, inside.shape, threads)
            inside |= label >= 0
            holes = inside & (label < 0)
            dense[holes] = self._beyond(_hull_slopes(self._mesh, self._value, flat=True), *_centres(holes))
        outside = ~inside
        if self.extrapolate == "none":
            dense[outside] = np.nan
        elif self._hull is not None:
            dense[outside] = self._beyond(self._hull, *_centres(outside))
        elif self.method != "nearest":
            dense = np.where(outside, self._nearest_grid(inside.shape, threads), dense)
        return dense.astype(np.float32), inside

    def _at(self, xq: _Reals, yq: _Reals) -> _Reals:
        out, inside = self._nearest_at(xq, yq), self._in_hull(xq, yq)
        if self._mesh is not None and self.method != "nearest":
            where = self._mesh_at(self._mesh, xq, yq, out)
            inside |= where >= 0
            holes = inside & (where < 0)
            out[holes] = self._beyond(_hull_slopes(self._mesh, self._value, flat=True), xq[holes], yq[holes])
        if self.extrapolate == "none":
            out[~inside] = np.nan
        elif self._hull is not None:
            out[~inside] = self._beyond(self._hull, xq[~inside], yq[~inside])
        return out

    def _mesh_grid(
        self, mesh: _Mesh, shape: tuple[int, ...], threads: int
    ) -> tuple[_Reals, NDArray[np.int32]]:
        from fusion.lidar import scattered_kernels as kernels

        label, dense = np.empty(shape, np.int32), np.zeros(shape)
        kernels.rasterise(mesh.corner, mesh.x, mesh.y, self._value, label, dense)
        if self.method == "natural":
            centre = _circumcentres(mesh)
            in_bands(
                lambda a, b: kernels.sibson_rows(a, b, label, *mesh, self._value, centre, dense),
                shape[0],
                threads,
            )
        return dense, label

    def _mesh_at(self, mesh: _Mesh, xq: _Reals, yq: _Reals, out: _Reals) -> NDArray[np.int32]:
        from fusion.lidar import scattered_kernels as kernels

        where = np.empty(xq.size, np.int32)
        kernels.locate(xq, yq, *mesh, where)
        kernels.linear_at(xq, yq, where, mesh.corner, mesh.x, mesh.y, self._value, out)
        if self.method == "natural":
            kernels.sibson_at(xq, yq, where, *mesh, self._value, _circumcentres(mesh), out)
        return where

    def _nearest_grid(self, shape: tuple[int, ...], threads: int) -> _Reals:
        from fusion.lidar import scattered_kernels as kernels

        site = np.empty(shape, np.int32)
        in_bands(lambda a, b: kernels.nearest_rows(a, b, self._x, self._y, site), shape[0], threads)
        return self._value[site]

    def _nearest_at(self, xq: _Reals, yq: _Reals) -> _Reals:
        from fusion.lidar import scattered_kernels as kernels

        site = np.empty(xq.size, np.int32)
        kernels.nearest_at(xq, yq, self._x, self._y, site)
        return self._value[site]

    def _in_hull(self, xq: _Reals, yq: _Reals) -> NDArray[np.bool_]:
        x, y = self._x[self._corner_hull], self._y[self._corner_hull]
        inside = (xq >= x.min()) & (xq <= x.max()) & (yq >= y.min()) & (yq <= y.max())
        for a in range(x.size):
            ex, ey = x[(a + 1) % x.size] - x[a], y[(a + 1) % x.size] - y[a]
            inside &= ex * (yq - y[a]) >= ey * (xq - x[a])
        return inside

    @staticmethod
    def _beyond(hull: _Hull, xq: _Reals, yq: _Reals) -> _Reals:
        from fusion.lidar import scattered_kernels as kernels

        out = np.empty(xq.size)
        kernels.extend(xq, yq, *hull, out)
        return out


def checked_samples(u: ArrayLike, v: ArrayLike, values: ArrayLike) -> tuple[_Reals, _Reals, _Reals]:
    """Three lists of one length, float64 and finite; else `ValueError`. `FrameError` if they are empty."""
    x, y, value = (np.ascontiguousarray(a, np.float64) for a in (u, v, values))
    if x.ndim != 1 or x.shape != y.shape or x.shape != value.shape:
        raise ValueError(f"expected three lists of one length, got {x.shape}, {y.shape} and {value.shape}")
    if not (np.isfinite(x).all() and np.isfinite(y).all() and np.isfinite(value).all()):
        raise ValueError("expected finite coordinates and values")
    if x.size == 0:
        raise FrameError("there is no sample to interpolate from", hint="did any point fall into the image?")
    return x, y, value


def checked_size(size_wh: tuple[int, int]) -> tuple[int, int]:
    """A size of at least 1 x 1; else `ValueError`."""
    width, height = size_wh
    if width < 1 or height < 1:
        raise ValueError(f"expected a size of at least 1 x 1, got {size_wh}")
    return width, height


def _too_few(count: int) -> FrameError:
    return FrameError(
        f"needs at least three points that are not on one line; {count} given", hint="use --method nearest"
    )


def _merged(x: _Reals, y: _Reals, value: _Reals) -> tuple[_Reals, _Reals, _Reals]:
    """The distinct points, sorted by x, then y, with the mean of their values; read-only."""
    order = np.lexsort((y, x))
    x, y, value = x[order] + 0.0, y[order] + 0.0, value[order]  # + 0.0: no negative zero
    new = np.ones(x.size, np.bool_)
    new[1:] = (x[1:] != x[:-1]) | (y[1:] != y[:-1])
    start = np.flatnonzero(new)
    mean = np.add.reduceat(value, start) / np.diff(start, append=x.size)
    return read_only(x[new]), read_only(y[new]), read_only(mean)


def _convex_hull(x: _Reals, y: _Reals) -> NDArray[np.int32]:
    from fusion.lidar import scattered_kernels as kernels

    ring = np.empty(2 * x.size + 2, np.int32)
    return ring[: kernels.hull_of(x, y, ring)]


def _triangulated(x: _Reals, y: _Reals) -> tuple[_Mesh, int]:
    """The Delaunay triangulation of distinct points, and how many of them it lost."""
    from scipy.spatial import Delaunay, QhullError

    from fusion.lidar import scattered_kernels as kernels

    points = np.stack([x - round(x.mean()), y - round(y.mean())], axis=1)  # near 0: less is lost to rounding
    try:
        mesh: Any = Delaunay(points)
    except QhullError as error:
        raise _too_few(x.size) from error
    corner = np.ascontiguousarray(mesh.simplices, np.int32).reshape(-1)
    twin = np.empty(corner.size, np.int32)
    kernels.twins(corner, np.ascontiguousarray(mesh.neighbors, np.int32), twin)
    return _Mesh(read_only(corner), read_only(twin), x, y), x.size - int(
        np.count_nonzero(np.bincount(corner))
    )


def _circumcentres(mesh: _Mesh) -> _Reals:
    from fusion.lidar import scattered_kernels as kernels

    centre = np.empty((mesh.corner.size // 3, 2))
    kernels.circumcentres(mesh.corner, mesh.x, mesh.y, centre)
    return read_only(centre)


def _hull_slopes(mesh: _Mesh, value: _Reals, *, flat: bool = False) -> _Hull:
    """The mesh's outline with a gradient at each of its sites (zero if `flat`)."""
    tail, tip = mesh.corner, mesh.corner.reshape(-1, 3)[:, [1, 2, 0]].reshape(-1)
    rim = mesh.twin < 0
    after = dict(zip(tail[rim].tolist(), tip[rim].tolist(), strict=True))
    ring = [next(iter(after))]
    while after[ring[-1]] != ring[0]:
        ring.append(after[ring[-1]])
    site = np.array(ring)
    slope = np.zeros((site.size, 2))
    if not flat:
        place = np.full(value.size, -1)
        place[site] = np.arange(site.size)
        a, b = np.concatenate([tail, tip[rim]]), np.concatenate([tip, tail[rim]])
        slope = _slopes(mesh, value, place, a[place[a] >= 0], b[place[a] >= 0], site.size)
    return _Hull(mesh.x[site], mesh.y[site], value[site], slope)


def _slopes(
    mesh: _Mesh, value: _Reals, place: NDArray[np.int64], a: NDArray[Any], b: NDArray[Any], count: int
) -> _Reals:
    """Weighted least squares over the edges a-b, gathered by the `place` of a."""
    dx, dy, df = mesh.x[b] - mesh.x[a], mesh.y[b] - mesh.y[a], value[b] - value[a]
    weight, index = 1 / (dx * dx + dy * dy), place[a]
    xx, xy, yy, xf, yf = (
        np.bincount(index, weight * p, count) for p in (dx * dx, dx * dy, dy * dy, dx * df, dy * df)
    )
    trace, det = xx + yy, xx * yy - xy * xy
    steep = det > 1e-14 * trace * trace
    det = np.where(steep, det, 1)
    gx = np.where(steep, (yy * xf - xy * yf) / det, xf / trace)  # neighbours on one line: the slope along it
    gy = np.where(steep, (xx * yf - xy * xf) / det, yf / trace)
    return np.stack([gx, gy], axis=1)


def _centres(mask: NDArray[np.bool_]) -> tuple[_Reals, _Reals]:
    rows, columns = np.nonzero(mask)
    return columns.astype(np.float64), rows.astype(np.float64)
