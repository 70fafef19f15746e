"""Dense depth from few samples and a picture: smooth where the colour is, free to step where it changes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.errors import FrameError
from fusion.lidar.sparse import SparseDepth

SIGMA = 10.0  # grey levels, over the three channels
FLOOR = 1e-3  # of the weight between equal colours: what still binds two sides of an edge
SAMPLE = 1.0  # weight of a sample against that of equal colours
CELLS = 80_000  # unknowns at most


def guided(
    sparse: SparseDepth, guide_bgr: NDArray[np.uint8], *, sigma: float = SIGMA, floor: float = FLOOR
) -> NDArray[np.float32]:
    """A value for every pixel, H x W float32 (m, the samples' value), between their extremes; 0 without
    samples.

    Minimises sum w_ij (x_i - x_j)^2 + sum (x(u_k, v_k) - log value_k)^2 over a grid of half the picture's
    size (coarser for large pictures: at most 80,000 unknowns), where
    w_ij = exp(-|bgr_i - bgr_j|^2 / (2 sigma^2)) + floor binds neighbours (the weighted Laplacian of
    Levin et al. 2004, "Colorization using optimization"). A direct sparse solve, then bilinear to full
    size. In log value: 1 / value gives far surfaces
    no weight, the value itself too much; smoothness of second order overshoots between few samples. Edges
    are those of the picture: texture makes steps and equal colours none, so with many samples other methods
    are better. Raises `FrameError` where the picture has not the samples' size, `ValueError` where it is not
    HxWx3 uint8.
    """
    if guide_bgr.ndim != 3 or guide_bgr.shape[2] != 3 or guide_bgr.dtype != np.uint8:
        raise ValueError(f"expected HxWx3 uint8, got {guide_bgr.shape} {guide_bgr.dtype}")
    w, h = sparse.size_wh
    if guide_bgr.shape[:2] != (h, w):
        what = (
            f"the guiding picture has {guide_bgr.shape[1]}x{guide_bgr.shape[0]} pixels, the samples {w}x{h}"
        )
        raise FrameError(what, hint="give the picture that belongs to these samples, at their size")
    if not len(sparse):
        return np.zeros((h, w), np.float32)
    step = max(2, math.ceil(math.sqrt(w * h / CELLS)))
    laplacian = _laplacian(_shrunk(guide_bgr, step), sigma, floor)
    log = np.log(sparse.value_m.astype(np.float64))
    at = _taps(sparse, step)
    small = _solved(laplacian + SAMPLE * (at.T @ at), SAMPLE * (at.T @ (log - log.mean()))) + log.mean()
    small = np.clip(small, log.min(), log.max()).reshape(-(-h // step), -(-w // step))
    return np.exp(_grown(small, step, (h, w)))


def _shrunk(bgr: NDArray[np.uint8], step: int) -> NDArray[np.float64]:
    """Means of blocks of `step` x `step` pixels; the last ones take in the border's pixels again."""
    h, w = bgr.shape[:2]
    padded = np.pad(bgr, ((0, -h % step), (0, -w % step), (0, 0)), "edge").astype(np.float64)
    return padded.reshape(padded.shape[0] // step, step, -1, step, 3).mean((1, 3))


def _laplacian(bgr: NDArray[np.float64], sigma: float, floor: float) -> Any:
    """The matrix of sum w_ij (x_i - x_j)^2 over pixels and their right and lower neighbours."""
    from scipy.sparse import coo_array

    number = np.arange(bgr.shape[0] * bgr.shape[1]).reshape(bgr.shape[:2])
    i = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
    j = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
    colour = bgr.reshape(-1, 3)
    weight = np.exp(((colour[i] - colour[j]) ** 2).sum(1) / (-2 * sigma**2)) + floor
    entries = np.concatenate([weight, weight, -weight, -weight])
    places = np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i])
    return coo_array((entries, places), (number.size, number.size)).tocsc()


def _taps(sparse: SparseDepth, step: int) -> Any:
    """The matrix, samples x cells, that interpolates the small grid bilinearly at the samples."""
    from scipy.sparse import coo_array

    n, (w, h) = len(sparse), (-(-size // step) for size in sparse.size_wh)
    x, y = (np.clip((a + 0.5) / step - 0.5, 0, size - 1) for a, size in ((sparse.u, w), (sparse.v, h)))
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    x1, y1, fx, fy = np.minimum(x0 + 1, w - 1), np.minimum(y0 + 1, h - 1), x - x0, y - y0
    weight = np.concatenate([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    cell = np.concatenate([y0 * w + x0, y0 * w + x1, y1 * w + x0, y1 * w + x1])
    return coo_array((weight, (np.tile(np.arange(n), 4), cell)), (n, w * h)).tocsc()


def _solved(matrix: Any, right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Symmetric, positive definite: no pivoting, an ordering that keeps a grid's factors sparse."""
    from scipy.sparse.linalg import splu

    factors = splu(
        matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    return factors.solve(right)


def _grown(small: NDArray[np.float64], step: int, shape: tuple[int, int]) -> NDArray[np.float32]:
    import cv2

    v, u = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    x, y = (u + np.float32(0.5)) / step - np.float32(0.5), (v + np.float32(0.5)) / step - np.float32(0.5)
    grown = cv2.remap(small.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(grown, np.float32)
