"""Triangle meshes, and the simple shapes that things in a mine are made of. Metres, float64."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Mesh:
    """`vertices` N x 3 float64 in metres, `triangles` M x 3 int64, anticlockwise seen from the air."""

    vertices: Floats
    triangles: Indices

    def moved(self, T: Floats) -> Mesh:
        """The mesh after a 4 x 4 affine transformation."""
        return Mesh(self.vertices @ T[:3, :3].T + T[:3, 3], self.triangles)

    def normals(self) -> Floats:
        """M x 3 unit normals; zero for a triangle without area."""
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        n = np.cross(b - a, c - a)
        length = np.linalg.norm(n, axis=1, keepdims=True)
        return n / np.where(length > 0, length, 1)


def join(meshes: Iterable[Mesh]) -> Mesh:
    """All meshes as one, in their order."""
    parts = list(meshes)
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    triangles = [part.triangles + start for part, start in zip(parts, starts, strict=False)]
    return Mesh(np.concatenate([part.vertices for part in parts]), np.concatenate(triangles))


def frame(origin: ArrayLike, heading: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Floats:
    """4 x 4 pose: turned by `heading` around z, then `pitch` (nose down) around y, then `roll` around x."""
    (cz, cy, cx), (sz, sy, sx) = np.cos([heading, pitch, roll]), np.sin([heading, pitch, roll])
    Rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    Ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    Rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rz @ Ry @ Rx, origin
    return T


def prism(outline: ArrayLike, z0: float, z1: float) -> Mesh:
    """A convex outline (N x 2, anticlockwise) drawn up from z0 to z1."""
    xy = np.asarray(outline, np.float64)
    n = len(xy)
    vertices = np.vstack([np.c_[xy, np.full(n, z0)], np.c_[xy, np.full(n, z1)]])
    k, after = np.arange(n), (np.arange(n) + 1) % n
    sides = np.vstack([np.c_[k, after, n + after], np.c_[k, n + after, n + k]])
    fan = np.c_[np.zeros(n - 2, np.int64), np.arange(1, n - 1), np.arange(2, n)]
    return Mesh(vertices, np.vstack([sides, fan[:, ::-1], n + fan]))


def box(low: ArrayLike, high: ArrayLike) -> Mesh:
    """The box between two corners."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(low, np.float64), np.asarray(high, np.float64)
    return prism([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], z0, z1)


def tube(centres: ArrayLike, radii: ArrayLike, sides: int = 12) -> Mesh:
    """A round tube along a polyline (N x 3) with a radius at each point (or one), closed by flat ends."""
    centres = np.asarray(centres, np.float64)
    radii = np.broadcast_to(np.asarray(radii, np.float64), len(centres))
    along = np.gradient(centres, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side, up = _frames_along(along)
    angle = 2 * np.pi * np.arange(sides) / sides
    around = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * up[:, None]
    rings = centres[:, None] + radii[:, None, None] * around
    vertices = np.vstack([rings.reshape(-1, 3), centres[:1], centres[-1:]])
    return Mesh(vertices, _tube_triangles(len(centres), sides))


def _frames_along(along: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors across each direction, carried along without twisting."""
    side = np.empty_like(along)
    start = np.eye(3)[np.argmin(np.abs(along[0]))]
    for k, direction in enumerate(along):
        start = start - direction * (direction @ start)
        start = side[k] = start / np.linalg.norm(start)
    return side, np.cross(along, side)


def _tube_triangles(rings: int, sides: int) -> Indices:
    k, after = np.arange(sides), (np.arange(sides) + 1) % sides
    strip = np.vstack([np.c_[k, after, sides + after], np.c_[k, sides + after, sides + k]])
    body = (strip + sides * np.arange(rings - 1)[:, None, None]).reshape(-1, 3)
    first, last, end = rings * sides, rings * sides + 1, (rings - 1) * sides
    caps = np.vstack(
        [np.c_[after, k, np.full(sides, first)], np.c_[end + k, end + after, np.full(sides, last)]]
    )
    return np.vstack([body, caps])


def rod(a: ArrayLike, b: ArrayLike, radius_a: float, radius_b: float | None = None, sides: int = 12) -> Mesh:
    """A straight cylinder or cone from a to b."""
    return tube(np.array([a, b], np.float64), [radius_a, radius_a if radius_b is None else radius_b], sides)


def capsule(a: ArrayLike, b: ArrayLike, radius_a: float, radius_b: float, sides: int = 12) -> Mesh:
    """A limb: a cone from a to b with round ends."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    way = (b - a) / np.linalg.norm(b - a)
    angle = np.linspace(0.12, np.pi / 2, 5)
    starts = [(a - way * radius_a * np.cos(t), radius_a * np.sin(t)) for t in angle]
    ends = [(b + way * radius_b * np.cos(t), radius_b * np.sin(t)) for t in angle[::-1]]
    points, radii = zip(*starts, *ends, strict=True)
    return tube(points, radii, sides)


def ellipsoid(centre: ArrayLike, half_axes: ArrayLike, sides: int = 16) -> Mesh:
    """An ellipsoid with its axes along x, y, z."""
    height = np.cos(np.linspace(np.pi - 0.1, 0.1, sides // 2 + 1))
    ball = tube(np.c_[np.zeros((len(height), 2)), height], np.sqrt(1 - height**2), sides)
    return Mesh(ball.vertices * np.asarray(half_axes, np.float64) + np.asarray(centre), ball.triangles)


def stone(rng: np.random.Generator, corners: int = 11) -> Mesh:
    """A convex block of rock of about unit diameter, flattish, with plane faces."""
    from scipy.spatial import ConvexHull

    p = rng.standard_normal((corners, 3))
    p = (
        0.5
        * p
        / np.linalg.norm(p, axis=1, keepdims=True)
        * rng.uniform(0.75, 1.0, (corners, 1))
        * (1, 0.8, 0.6)
    )
    hull = ConvexHull(p)
    triangles = hull.simplices.astype(np.int64)
    inside = np.einsum("ij,ij->i", Mesh(p, triangles).normals(), hull.equations[:, :3]) < 0
    triangles[inside] = triangles[inside][:, ::-1]
    return Mesh(p, triangles)


def copies(prototypes: list[Mesh], which: Indices, T: Floats) -> Mesh:
    """Prototype `which[k]` moved by `T[k]` (K x 4 x 4), all as one mesh, in the order of k."""
    return join(prototypes[kind].moved(pose) for kind, pose in zip(which, T, strict=True))
