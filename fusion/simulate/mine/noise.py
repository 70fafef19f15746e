"""Noise in space: smooth, and in facets as rock that broke along its joints."""

from __future__ import annotations

import numpy as np

from fusion.simulate.mine.meshes import Floats

_LATTICE = 48


class Smooth:
    """Value noise, periodic in 48 units, deviation about 0.6, its length about one unit; two octaves."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._lattice = rng.standard_normal((_LATTICE,) * 3).astype(np.float32)

    def __call__(self, p: Floats) -> Floats:
        """The noise at N x 3 points."""
        return self._octave(p) + 0.5 * self._octave(2.1 * p + 7.3)

    def _octave(self, p: Floats) -> Floats:
        from scipy.ndimage import map_coordinates

        return map_coordinates(self._lattice, p.T, order=1, mode="grid-wrap", output=np.float64)


class Facets:
    """Blocks (cells around scattered seeds), each with a plane face: a step out or in, one of a few tilts."""

    def __init__(
        self, rng: np.random.Generator, lattice: Floats, size_m: float, step_m: float, tilt: float
    ) -> None:
        """Blocks around the points of a lattice (N x 3 metres, `size_m` apart), jittered."""
        from scipy.spatial import KDTree

        # Blocks are longer along the bedding than across it.
        stretch = size_m * np.linalg.qr(rng.standard_normal((3, 3)))[0] * np.array([1.35, 1.0, 0.65])
        self._into = np.linalg.inv(stretch)
        self._seeds = (lattice + size_m * rng.uniform(-0.5, 0.5, lattice.shape)) @ self._into.T
        self._tree = KDTree(self._seeds)
        joints = rng.standard_normal((7, 3))
        joints *= tilt / np.linalg.norm(joints, axis=1, keepdims=True)
        self._tilt = joints[rng.integers(0, len(joints), len(lattice))] @ stretch
        self._step = step_m * rng.standard_normal(len(lattice))

    def __call__(self, p: Floats) -> Floats:
        """Metres that the face stands out at N x 3 points."""
        q = p @ self._into.T
        k = self._tree.query(q, workers=-1)[1]
        return self._step[k] + np.einsum("ij,ij->i", self._tilt[k], q - self._seeds[k])
