"""Dense depth by a scan's own structure: between neighbouring rings and columns, never across a jump."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.kernels import read_only, scratch
from fusion.lidar import scan_kernels
from fusion.lidar.sparse import SparseDepth

JUMP = 0.1  # neighbours this share of the nearer one apart may lie on two surfaces
STEEP = 3.0  # and do, where 1 / value changes this many times faster than on either side
REACH_PX = 16  # neighbours on a ring are not farther apart than this, or six times the ring's mean gap
MOST_RINGS = 1024


def scan(
    sparse: SparseDepth, *, jump: float = JUMP, steep: float = STEEP, reach_px: int = REACH_PX
) -> NDArray[np.float32]:
    """The samples of one scan as a dense map, H x W float32, of the same value (m); 0 where there is none.

    First along each ring to whole columns, then down each column between rings that follow each other, both
    times linearly in 1 / value: planes come out exact where the value is depth. Two neighbours lie on two
    surfaces where the farther is beyond the nearer by the share `jump` *and* 1 / value changes `steep` times
    faster than between the pairs on either side: a floor that is seen at grazing incidence is steep
    everywhere, so the threshold follows the spacing of rings, distance and slope by itself. Across such a
    jump nothing is interpolated: three quarters of the gap get the value of the nearer side, the rest that
    of the farther (even halves have larger errors on KITTI's ground truth and on rings held out). Above the
    topmost and below the lowest ring, left of the first and right of the last sample, and where a column has
    none, there is no value; inside a column any gap is filled, so look at the support mask.

    Samples may come in any order; the rings may run upwards or downwards in the image but must run across it
    (a camera rolled by 90 degrees breaks this). Where `sparse.ring` is None, samples are linked to the
    next one on their right, at most `reach_px` columns and a third as many rows away, and rows take the
    rings' place. Raises `ValueError` where a sample lies outside the image, is not positive, or there are
    more than 1024 rings.
    """
    width, height = sparse.size_wh
    if not len(sparse):
        return np.zeros((height, width), np.float32)
    wide = max(width, scan_kernels.LANES)
    samples = [
        _checked(sparse.u),
        _checked(sparse.v),
        read_only(np.ascontiguousarray(sparse.value_m, np.float32)),
    ]
    across = _rows if sparse.ring is None else _rings
    heights, inverses, filled = across(sparse, samples, wide, jump, steep, reach_px)
    out = np.empty((height, wide), np.float32)
    scan_kernels.down_columns(heights, inverses, filled, np.float32(jump), np.float32(steep), out)
    return out if wide == width else out[:, :width].copy()


def _checked(a: NDArray[np.float64]) -> NDArray[np.float64]:
    return read_only(np.ascontiguousarray(a, np.float64))


def _tables(rows: int, wide: int) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    return (
        scratch("scan.cells", (rows, wide), np.int32),
        scratch("scan.heights", (rows, wide), np.float32),
        scratch("scan.inverses", (rows, wide), np.float32),
        scratch("scan.filled", (wide,), np.int32),
    )


def _rings(
    sparse: SparseDepth, samples: list[NDArray[Any]], wide: int, jump: float, steep: float, reach: int
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    ring = np.ascontiguousarray(sparse.ring, np.int32)
    if ring.max() >= MOST_RINGS:
        ring = np.unique(ring, return_inverse=True)[1].reshape(-1).astype(np.int32)
    rings = int(ring.max()) + 1
    if rings > MOST_RINGS:
        raise ValueError(f"expected at most {MOST_RINGS} rings, got {rings}")
    cells, heights, inverses, filled = _tables(max(rings, 1), wide)
    way = scan_kernels.place(*samples, read_only(ring), sparse.size_wh, cells)
    if way < 0:
        raise _outside(sparse)
    scan_kernels.along_rings(
        *samples, cells, way == 1, float(jump), float(steep), float(reach), heights, inverses, filled
    )
    return heights, inverses, filled


def _rows(
    sparse: SparseDepth, samples: list[NDArray[Any]], wide: int, jump: float, _: float, reach: int
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    pixels, heights, inverses, filled = _tables(sparse.size_wh[1], wide)
    if not scan_kernels.along_rows(
        *samples, sparse.size_wh, int(reach), float(jump), pixels, heights, inverses, filled
    ):
        raise _outside(sparse)
    return heights, inverses, filled


def _outside(sparse: SparseDepth) -> ValueError:
    w, h = sparse.size_wh
    return ValueError(
        f"expected positive samples inside {w}x{h} pixels and rings from 0, got one that is not"
    )
