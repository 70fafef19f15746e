"""Natural-neighbour interpolation on a raster: what is lost in exactness is won in time."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion.lidar.bands import in_bands, in_threads
from fusion.lidar.scattered import checked_samples, checked_size

_Reals = NDArray[np.float64]


def natural_discrete(
    u: ArrayLike,
    v: ArrayLike,
    values: ArrayLike,
    size_wh: tuple[int, int],
    *,
    step: int = 1,
    coarse: int | None = 16,
    threads: int = 1,
) -> NDArray[np.float32]:
    """Natural neighbours on a raster (Park et al. 2006), at each pixel of an image: H x W float32.

    Samples (`u`, `v`, `values`: N each) are moved to the nearest cell of a raster of `step` x `step` pixels,
    those outside to its border; several in a cell are averaged. Every cell spreads the value of its nearest
    sample over all cells nearer to it than that sample; the result is the mean of what arrives, and a
    sample's own cell keeps its value. With `step` > 1 cells are interpolated bilinearly. Cells `coarse` cells
    or more from their sample, in gaps and outside the hull, spread in blocks: one for 2 x 2 cells, from
    twice that distance on for 4 x 4, and so on; None spreads each.

    The result lies between the samples' minimum and maximum, outside the hull as well. It is summed in fixed
    point and does not depend on `threads`. Raises `FrameError` without samples, `ValueError` for lists of
    unequal length, numbers that are not finite, and more than 8 million cells.
    """
    from fusion.lidar import discrete_kernels as kernels

    width, height = checked_size(size_wh)
    if step < 1 or (coarse is not None and coarse < 4):
        raise ValueError(f"expected step of at least 1 and coarse of at least 4, got {step} and {coarse}")
    x, y, value = checked_samples(u, v, values)
    w, h = -(-width // step), -(-height // step)
    column = np.clip(np.rint((x + 0.5) / step - 0.5), 0, w - 1).astype(np.int32)
    row = np.clip(np.rint((y + 0.5) / step - 0.5), 0, h - 1).astype(np.int32)
    total, count, nearest = np.zeros((h, w)), np.zeros((h, w), np.int32), np.empty((h, w), np.int32)
    kernels.site_rows(column, row, value, total, count, nearest)
    grey, bits, lowest, unit = _packed(total, count)
    limit = 1 << 20 if coarse is None else coarse
    bands = max(1, min(threads, h))
    discs = np.zeros((bands, h, w + 1), np.int64)
    edges = np.linspace(0, h, bands + 1).astype(int)
    in_threads(
        [
            lambda i=i: kernels.scatter_discs(edges[i], edges[i + 1], nearest, grey, _ROOT, limit, discs[i])
            for i in range(bands)
        ]
    )
    out = np.empty((h, w), np.float32)
    in_bands(
        lambda a, b: kernels.gather_discs(a, b, discs, total, count, bits, lowest, unit, out), h, threads
    )
    if step == 1:
        return out
    import cv2

    return cv2.resize(out, (w * step, h * step))[:height, :width].astype(np.float32)


_ROOT = np.sqrt(np.arange(64 * 64)).astype(np.int32)


def _packed(total: _Reals, count: NDArray[np.int32]) -> tuple[NDArray[np.int64], int, float, float]:
    """Each site's value as a whole number of units, above `bits` bits that count it once."""
    bits = (4 * count.size).bit_length()  # blocks overlap a little where their sizes change
    if bits > 25:
        raise ValueError(f"expected fewer than {1 << 23} cells, got {count.size}: take a larger step")
    site = np.flatnonzero(count)
    mean = total.reshape(-1)[site] / count.reshape(-1)[site]
    lowest, highest = float(mean.min()), float(mean.max())
    unit = (highest - lowest) / ((1 << min(24, 63 - 2 * bits)) - 1) or 1.0
    grey = np.empty(count.shape, np.int64)
    grey.reshape(-1)[site] = (np.rint((mean - lowest) / unit).astype(np.int64) << bits) + 1
    return grey, bits, lowest, unit
