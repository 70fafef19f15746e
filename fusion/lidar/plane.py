"""Dense depth by a robust plane at every pixel: 1/z of a plane in space is affine in the picture."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.kernels import read_only, scratch
from fusion.lidar import plane_kernels as kernels
from fusion.lidar.occlusion import SpacingPx, spacing_px
from fusion.lidar.project import z_buffer
from fusion.lidar.sparse import SparseDepth

_Map = NDArray[np.float32]

POWER, SOFTENING_PX2 = 1.5, 0.05  # a sample's weight: 1 / (distance^2 + softening)^power
RESIDUAL = 0.03  # half the weight is left for a sample this far, relatively, from the first map
RIDGE = 0.0003  # of the samples' mean squared distance: holds slopes that they do not tell, as along a line
CLAMP = 0.2  # how far from the weighted mean a plane may lead, relatively
# Windows reach this many spacings of the samples: across, of the mean one; up and down, of the rings'.
FIRST_REACH, REACH = (3.0, 1.6), (5.0, 2.4)
STEP = 2  # pixels between those of the first map, and how much coarser each map is that fills its holes
MOST_STRETCHED = 8.0
_BANDS, _LANES = 4, 8  # bands of rows a thread; columns that are summed at a time


@dataclass(frozen=True, slots=True)
class _Samples:
    """Columns, rows (sorted) and inverse depths, and by how much rings stand wider than samples on them."""

    u: NDArray[np.float64]
    v: NDArray[np.float64]
    q: _Map
    stretch: float


class _Bands(NamedTuple):
    """Who works, and on how many bands of rows."""

    pool: ThreadPoolExecutor
    number: int


def plane(sparse: SparseDepth, *, robust: bool = True, threads: int = 1) -> _Map:
    """A value for every pixel, H x W float32, of the kind and unit of the samples; all 0 without samples.

    At each pixel an affine function is fitted to 1/value over the samples in a window, by least squares with
    weights 1 / (d^2 + 0.05)^1.5 for a distance of d pixels, where distances along x count more as rings stand
    wider apart than the samples on one. It is fitted twice: plainly, on every second pixel; then with Cauchy
    weights of the residual against the median of that first map, so that it settles on one side of an edge.
    Where a window is empty, the first map comes from coarser ones. A 5 x 5 median and a narrow 3 x 3 Gaussian
    of 1/value, which leave pixels with a sample as they are, calm what is undecided at edges.

    Planes are exact for depth along the axis of a pinhole camera, save for a slight pull towards slope 0; in
    range, and in other cameras, they bend little within a window. Of several samples in a pixel the nearest
    counts. Pixels far from samples, or outside their hull, get a value too, like that at the rim: support is
    the caller's matter. `threads` does not change the result.
    """
    w, h = sparse.size_wh
    if not len(sparse):
        return np.zeros((h, w), np.float32)
    image = z_buffer(sparse)
    spacing = spacing_px(sparse, image)
    samples = _samples(sparse, image, spacing.y / spacing.x)
    with ThreadPoolExecutor(threads) as pool:
        bands = _Bands(pool, _BANDS * threads)
        half = -(-w // STEP), -(-h // STEP)
        first = _first_map(_merged(samples, half), half, _reach(FIRST_REACH, spacing, STEP), bands)
        start = _enlarged(_median(first), (w, h))
        if not robust:
            return np.reciprocal(start)
        fitted = _fit(samples, _reach(REACH, spacing), start, 1 / RESIDUAL, bands)
    np.copyto(fitted, start, where=np.isnan(fitted))
    return np.reciprocal(_calmed(fitted, image > 0))


def _reach(reach: tuple[float, float], spacing: SpacingPx, step: int = 1) -> tuple[int, int]:
    """How many pixels of `step` x `step` a window reaches to each side, and up and down; at least one."""
    across, along = reach[0] * (spacing.x * spacing.y) ** 0.5, reach[1] * spacing.y
    return max(1, round(across / step)), max(1, round(along / step))


def _samples(sparse: SparseDepth, image: _Map, stretch: float) -> _Samples:
    """The nearest sample of each pixel, from the top row down."""
    columns, rows = (np.floor(a + 0.5).astype(np.intp) for a in (sparse.u, sparse.v))  # as z_buffer
    nearest = np.flatnonzero(sparse.value_m <= image[rows, columns])
    order = nearest[np.argsort(sparse.v[nearest], kind="stable")]
    stretch = min(max(stretch, 1 / MOST_STRETCHED), MOST_STRETCHED)
    return _Samples(sparse.u[order], sparse.v[order], np.reciprocal(sparse.value_m[order]), stretch)


def _first_map(samples: _Samples, size_wh: tuple[int, int], reach: tuple[int, int], bands: _Bands) -> _Map:
    """A plain fit at every pixel, its holes filled from maps of coarser pixels until there is none."""
    w, h = size_wh
    fitted = _fit(samples, reach, np.full((h, w), samples.q.mean(), np.float32), 0.0, bands)
    holes = np.isnan(fitted)
    if holes.any():
        half = -(-w // STEP), -(-h // STEP)
        coarser = _first_map(_merged(samples, half), half, reach, bands)
        np.copyto(fitted, _enlarged(coarser, size_wh), where=holes)
    return fitted


def _merged(samples: _Samples, size_wh: tuple[int, int]) -> _Samples:
    """Samples on a raster of larger pixels, those in one pixel averaged: planes stay planes."""
    w, h = size_wh
    u, v = ((a + 0.5) / STEP - 0.5 for a in (samples.u, samples.v))
    column, row = (np.clip(np.rint(a).astype(np.intp), 0, n - 1) for a, n in ((u, w), (v, h)))
    pixel = row * w + column
    count = np.bincount(pixel)
    filled = np.flatnonzero(count)
    u, v, q = (np.bincount(pixel, a)[filled] / count[filled] for a in (u, v, samples.q))
    return _Samples(u, v, q.astype(np.float32), samples.stretch)


def _fit(samples: _Samples, reach: tuple[int, int], start: _Map, gain: float, bands: _Bands) -> _Map:
    """One fit at every pixel of `start`; NaN where a window has no sample."""
    h, w = start.shape
    column, row = (
        np.clip(np.rint(a).astype(np.int64), 0, n - 1) for a, n in ((samples.u, w), (samples.v, h))
    )
    order = np.argsort(row, kind="stable")  # means of merged samples may round into the next row
    column, row = column[order], row[order]
    u, v, q = (np.ascontiguousarray(a[order], np.float32) for a in (samples.u, samples.v, samples.q))
    starts = np.searchsorted(row, np.arange(h + 1))
    weight, spans = _weights(reach, samples.stretch)
    lists = [read_only(a) for a in (starts, column, row, u, v, q, weight, spans)]
    numbers = [np.float32(a) for a in (gain, RIDGE, CLAMP)]
    out = np.empty((h, w), np.float32)

    def band(first: int, last: int) -> None:
        sums = scratch("plane.sums", (kernels.SCRATCH, w + weight.shape[1]), np.float32)
        kernels.fit_rows(first, last, *lists, reach, read_only(start), *numbers, sums, out)

    edges = np.linspace(0, h, bands.number + 1).astype(int)
    list(bands.pool.map(band, edges[:-1], edges[1:]))
    return out


@lru_cache(maxsize=16)
def _weights(reach: tuple[int, int], stretch: float) -> tuple[_Map, NDArray[np.int64]]:
    """The weights of a sample by its rounded offset to the pixel, and where in each row they begin, how many.

    Those outside the ellipse of the reach are 0; rows are padded, so that whole vectors are summed.
    """
    x, y = np.arange(-reach[0], reach[0] + 1), np.arange(-reach[1], reach[1] + 1)[:, None]
    weight = (x**2 * stretch + y**2 + SOFTENING_PX2) ** -POWER
    weight[(x / (reach[0] + 0.5)) ** 2 + (y / (reach[1] + 0.5)) ** 2 > 1] = 0
    begin = (weight > 0).argmax(1)
    count = -(-(len(x) - 2 * begin) // _LANES) * _LANES
    weight = np.pad(weight, ((0, 0), (0, _LANES))).astype(np.float32)
    return weight, np.stack([begin, count], 1).astype(np.int64)


def _enlarged(image: _Map, size_wh: tuple[int, int]) -> _Map:
    """Bilinearly enlarged by `STEP` and cut to size; pixel centres stay where they are in the picture."""
    h, w = image.shape
    large = cv2.resize(image, (w * STEP, h * STEP), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(large[: size_wh[1], : size_wh[0]], np.float32)


def _median(image: _Map) -> _Map:
    return np.asarray(cv2.medianBlur(image, 5), np.float32)


def _calmed(fitted: _Map, measured: NDArray[np.bool_]) -> _Map:
    """Smoothed, save where there is a sample."""
    calm = _median(fitted)
    np.copyto(calm, fitted, where=measured)
    calm = np.asarray(cv2.GaussianBlur(calm, (3, 3), 0.5), np.float32)
    np.copyto(calm, fitted, where=measured)
    return calm
