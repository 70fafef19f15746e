"""The surface on which a sampled function is zero (naive surface nets, after Gibson 1998)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion.simulate.mine.meshes import Indices, Mesh

_CORNERS = np.array([(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)])
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 1]


def surface(field: NDArray[np.float32], origin: tuple[float, float, float], cell_m: float) -> Mesh:
    """The closed surface between `field` < 0 (air) and >= 0, its normals towards the air.

    `field` is nx x ny x nz float32, finite, >= 0 on all its outer faces, sampled every `cell_m` metres from
    `origin`. One vertex a cell that the surface cuts, at the mean of where it cuts the cell's edges; vertices
    and triangles run along x first, so that neighbours lie near each other in memory. Raises `ValueError`.
    """
    air = field < 0
    shell = air.copy()
    shell[1:-1, 1:-1, 1:-1] = False
    if shell.any():
        raise ValueError("expected a field that is >= 0 on its outer faces: the surface would be open")
    cells = _cut_cells(air)
    vertices = np.array(origin) + cell_m * (cells + _mean_crossing(field, cells))
    number = np.full(air.shape, -1, np.int64)
    number[tuple(cells.T)] = np.arange(len(cells))
    return Mesh(vertices, _faces(air, number, vertices))


def _cut_cells(air: NDArray[np.bool_]) -> Indices:
    nx, ny, nz = (side - 1 for side in air.shape)
    n = np.zeros((nx, ny, nz), np.uint8)
    for i, j, k in _CORNERS:
        n += air[i : i + nx, j : j + ny, k : k + nz]
    return np.argwhere((n > 0) & (n < 8))


def _mean_crossing(field: NDArray[np.float32], cells: Indices) -> NDArray[np.float64]:
    value = np.stack([field[tuple((cells + corner).T)] for corner in _CORNERS], -1).astype(np.float64)
    total, count = np.zeros((len(cells), 3)), np.zeros((len(cells), 1))
    for a, b in _EDGES:
        cut = (value[:, a] < 0) != (value[:, b] < 0)
        share = value[:, a] / np.where(cut, value[:, a] - value[:, b], 1)
        place = _CORNERS[a] + share[:, None] * (_CORNERS[b] - _CORNERS[a])
        total += cut[:, None] * place
        count += cut[:, None]
    return total / count


def _faces(air: NDArray[np.bool_], number: Indices, vertices: NDArray[np.float64]) -> Indices:
    """Two triangles for each edge of the grid that the surface cuts: between the four cells around it."""
    quads, starts = [], []
    for axis in range(3):
        u, v = np.roll(np.eye(3, dtype=np.int64), -axis - 1, 0)[:2]
        low = tuple(slice(None, -1) if k == axis else slice(None) for k in range(3))
        high = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        edge = np.argwhere(air[low] != air[high])
        quad = np.stack([number[tuple((edge - d).T)] for d in (u + v, v, 0 * u, u)], 1)
        flip = air[tuple(edge.T)]  # air below: the normal looks down the axis
        quad[flip] = quad[flip][:, ::-1]
        quads.append(quad)
        starts.append(edge)
    quad = np.vstack(quads)
    return _split(quad[np.lexsort(np.vstack(starts).T[::-1])], vertices)


def _split(quad: Indices, vertices: NDArray[np.float64]) -> Indices:
    """Each quad along its shorter diagonal."""
    a, b, c, d = (vertices[quad[:, k]] for k in range(4))
    first = (np.linalg.norm(a - c, axis=1) <= np.linalg.norm(b - d, axis=1))[:, None]
    one = np.where(first, quad[:, [0, 1, 2]], quad[:, [1, 2, 3]])
    two = np.where(first, quad[:, [0, 2, 3]], quad[:, [1, 3, 0]])
    return np.stack([one, two], 1).reshape(-1, 3)
