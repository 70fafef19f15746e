"""Dense depth by a scan's own structure: between neighbouring rings and columns, never across a jump."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion.kernels import read_only, scratch
from fusion.lidar import scan_kernels
from fusion.lidar.sparse import SparseDepth

JUMP = 0.08
STEEP = 2.0


def scan(sparse: SparseDepth, *, jump: float = JUMP, steep: float = STEEP) -> NDArray[np.float32]:
    w, h = sparse.size_wh
    out = np.zeros((h, w), np.float32)
    if not len(sparse):
        return out
    assert sparse.ring is not None
    u, v = (read_only(np.ascontiguousarray(a, np.float64)) for a in (sparse.u, sparse.v))
    value, ring = read_only(np.ascontiguousarray(sparse.value_m)), read_only(np.ascontiguousarray(sparse.ring))
    rings = int(ring.max()) + 1
    cells = scratch("scan.cells", (rings, w), np.int32)
    upside_down = scan_kernels.place(u, v, ring, cells)
    heights, inverses = scratch("scan.heights", (rings, w), np.float32), scratch("scan.inverses", (rings, w), np.float32)
    filled = scratch("scan.filled", (w,), np.int32)
    scan_kernels.along_rings(u, v, value, cells, upside_down, jump, steep, heights, inverses, filled)
    scan_kernels.down_columns(heights, inverses, filled, np.float32(jump), np.float32(steep), out)
    return out
