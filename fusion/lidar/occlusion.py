"""Which points of a scan the camera cannot see, because the LiDAR looked past what hides them."""

from __future__ import annotations

from math import ceil
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.kernels import read_only
from fusion.lidar import plane_kernels
from fusion.lidar.project import z_buffer
from fusion.lidar.sparse import SparseDepth

# A sample is hidden by others that are nearer by more than this.
NEARER_M, NEARER_SHARE = 0.3, 0.05
# They lie this many spacings of the samples away: about one column to each side, and one ring up or down.
COLUMNS, ROWS = 1.0, 0.75
FARTHEST_PX, LOOKED_AT = 64, 2048  # how far to look for the next sample, and from how many


class SpacingPx(NamedTuple):
    """The usual distance in pixels from a sample to the next beside it, and to the next below it."""

    x: float
    y: float


def occluded(sparse: SparseDepth) -> NDArray[np.bool_]:
    """The samples of a scan that something nearer hides from the camera, N bool.

    A camera beside the LiDAR sees foreground where the LiDAR, over its edge, measured what lies behind: there
    near and far samples alternate. A sample is taken out if samples nearer by 0.3 m + 5 % lie to its left and
    to its right and at least one of them above it, within about one spacing of the samples (KITTI's 64 rings:
    3 columns and 4 rows), so that the window grows as rings are fewer. The sides keep what is beside a
    silhouette, or seen over it. Meant for one scan from near the camera, with the LiDAR not below it; maps
    need `fusion.lidar.surfels`. Nearer samples are looked for in the z-buffered image.
    """
    if not len(sparse):
        return np.zeros(0, np.bool_)
    image = z_buffer(sparse)
    spacing = spacing_px(sparse, image)
    x, y = ceil(COLUMNS * spacing.x), ceil(ROWS * spacing.y)
    image[image == 0] = np.inf
    padded = np.pad(image, ((y, y), (x, x)), constant_values=np.inf)
    beside, over = _least(padded, x, 2 * y + 1), _least(padded, 2 * x + 1, y)
    columns, rows = (np.floor(a + 0.5).astype(np.intp) for a in (sparse.u, sparse.v))  # as z_buffer
    limit = sparse.value_m - (NEARER_M + NEARER_SHARE * sparse.value_m)
    left, right = beside[rows, columns] < limit, beside[rows, columns + x + 1] < limit
    return left & right & (over[rows, columns] < limit)


def _least(image: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """The least value of the window that begins at each pixel and goes right and down."""
    window = np.ones((height, width), np.uint8)
    return np.asarray(cv2.erode(image, window, anchor=(0, 0)), np.float32)


def visible_in_scan(image_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Where a sparse picture of a scan (H x W float32, 0: none) has a sample that `occluded` leaves."""
    from fusion.lidar.project import from_image

    sparse = from_image(image_m)
    seen = image_m > 0
    seen[seen] = ~occluded(sparse)
    return seen


def spacing_px(sparse: SparseDepth, image_m: NDArray[np.float32] | None = None) -> SpacingPx:
    """How far apart samples stand in the picture (`image_m`: their z-buffer, if it is there already).

    The next sample is looked for in the quarter planes to the right and below, each bounded by diagonals, up
    to 64 px; where fewer than half the samples have one, the spacing is that of an even spread of all.
    """
    image = z_buffer(sparse) if image_m is None else image_m
    even = min((image.size / max(len(sparse), 1)) ** 0.5, 4 * FARTHEST_PX)
    step = -(-len(sparse) // LOOKED_AT) or 1
    columns, rows = (np.floor(a[::step] + 0.5).astype(np.int64) for a in (sparse.u, sparse.v))
    gaps = np.full((2, max(len(rows), 1)), np.inf)
    plane_kernels.gaps_px(read_only(image), read_only(rows), read_only(columns), FARTHEST_PX, gaps)
    return SpacingPx(*(_typical(gap, even) for gap in gaps))


def _typical(gaps: NDArray[np.float64], otherwise: float) -> float:
    """The mean of gaps up to twice their median: in whole pixels the median alone is coarse."""
    median = np.median(gaps)
    return float(gaps[gaps <= 2 * median].mean()) if np.isfinite(median) else otherwise
