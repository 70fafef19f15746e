"""A load-haul-dump machine, parked: 6.8 m long, 1.8 m wide, engine behind, bucket in front."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fusion.simulate.mine.meshes import Floats, Mesh, box, join, prism, rod, tube
from fusion.simulate.mine.parts import Part

_SIDES = (1, -1)
_WHEEL_R, _TREAD = 0.62, 16


def machine(T_world_machine: Floats) -> list[Part]:
    """The parts of a machine whose frame is on the floor at its joint: x towards the bucket, y left, z up."""
    made: dict[str, list[Mesh]] = {
        "hood": [_slab([(-3.2, 0.55), (-1.0, 0.55), (-1.0, 1.5), (-2.9, 1.42), (-3.2, 1.25)], -0.80, 0.80)],
        "paint": [
            *_cab(),
            *_fenders(),
            _slab([(0.25, 0.55), (2.2, 0.5), (2.1, 0.95), (0.9, 1.25), (0.25, 1.2)], -0.5, 0.5),
        ],
        "frame": [*_frame(), *(_boom(side) for side in _SIDES)],
        "rim": [_rim(x, side) for x in (-1.95, 1.45) for side in _SIDES],
        "tyre": [_wheel(x, side) for x in (-1.95, 1.45) for side in _SIDES],
        "bucket": [_bucket()],
        "glass": [box((-0.86, 0.79, 1.32), (-0.06, 0.83, 1.86)), box((0.03, 0.14, 1.32), (0.07, 0.76, 1.86))],
        "radiator": [box((-3.24, -0.52, 0.68), (-3.19, 0.52, 1.18)), *_slats()],
        "exhaust": [
            rod((-2.55, -0.55, 1.40), (-1.75, -0.55, 1.52), 0.13),
            rod((-2.5, -0.55, 1.5), (-2.5, -0.55, 1.95), 0.055),
        ],
        "reflector": [box((-3.24, y - 0.06, 1.02), (-3.205, y + 0.06, 1.14)) for y in (-0.7, 0.7)],
        "lamp": [rod((-3.15, y, 1.33), (-3.2, y, 1.33), 0.05) for y in (-0.45, 0.45)],
    }
    return [
        Part("machine", material, join(meshes).moved(T_world_machine)) for material, meshes in made.items()
    ]


def _slab(outline_xz: ArrayLike, y0: float, y1: float) -> Mesh:
    """A convex outline (x, z; anticlockwise seen from the right) drawn across from y0 to y1."""
    upright = prism(outline_xz, -y1, -y0)
    x, z, minus_y = upright.vertices.T
    return Mesh(np.c_[x, -minus_y, z], upright.triangles)


def _cab() -> list[Mesh]:
    posts = [box((x, y, 1.25), (x + 0.09, y + 0.09, 1.95)) for x in (-0.95, -0.05) for y in (0.05, 0.73)]
    roof = _slab([(-1.05, 1.95), (0.12, 1.95), (0.05, 2.06), (-0.98, 2.06)], 0.0, 0.88)
    return [*posts, roof, box((-0.95, 0.05, 0.5), (0.04, 0.82, 1.30))]


def _fenders() -> list[Mesh]:
    def fender(x: float, side: int) -> Mesh:
        y0, y1 = sorted((0.42 * side, 0.92 * side))
        return _slab([(x - 0.75, 1.22), (x + 0.75, 1.22), (x + 0.55, 1.34), (x - 0.55, 1.34)], y0, y1)

    return [fender(x, side) for x in (-1.95, 1.45) for side in _SIDES]


def _frame() -> list[Mesh]:
    joint = [rod((0.05, 0, 0.5), (0.05, 0, 1.1), 0.2), box((-1.0, -0.35, 0.5), (0.3, 0.35, 0.85))]
    bumper = box((-3.38, -0.85, 0.42), (-3.2, 0.85, 0.62))
    grille = [box((-3.26, y - 0.03, 0.62), (-3.2, y + 0.03, 1.24)) for y in (-0.56, 0.56)]
    tank = box((-0.95, -0.82, 0.5), (0.0, -0.02, 1.12))
    axles = [rod((x, -0.7, _WHEEL_R), (x, 0.7, _WHEEL_R), 0.16) for x in (-1.95, 1.45)]
    return [*joint, bumper, *grille, tank, *axles]


def _slats() -> list[Mesh]:
    return [box((-3.27, -0.5, z), (-3.235, 0.5, z + 0.025)) for z in np.arange(0.72, 1.16, 0.07)]


def _wheel(x: float, side: int) -> Mesh:
    width = 0.45
    y = side * (0.9 - width / 2) + width * np.array([-0.5, -0.48, -0.36, 0.36, 0.48, 0.5])
    body = tube(
        np.c_[np.full(6, x), y, np.full(6, _WHEEL_R)],
        _WHEEL_R * np.array([0.55, 0.86, 0.97, 0.97, 0.86, 0.55]),
        28,
    )
    return join([body, *(_lug(x, side, k) for k in range(_TREAD))])


def _rim(x: float, side: int) -> Mesh:
    (a, b, c), z = (side * y for y in (0.88, 0.915, 0.95)), _WHEEL_R
    dish, hub = rod((x, a, z), (x, b, z), 0.34, 0.30, 22), rod((x, b, z), (x, c, z), 0.13, 0.11, 14)
    return join([dish, hub])


def _lug(x: float, side: int, k: int) -> Mesh:
    turn = 2 * np.pi * k / _TREAD
    c, s = np.cos(turn), np.sin(turn)
    T = np.array([[c, 0, s, x], [0, 1, 0, 0], [-s, 0, c, _WHEEL_R], [0, 0, 0, 1]])
    y0, y1 = sorted((0.47 * side, 0.88 * side))
    return box((-0.045, y0, 0.94 * _WHEEL_R), (0.045, y1, _WHEEL_R)).moved(T)


def _boom(side: int) -> Mesh:
    y0, y1 = sorted((0.28 * side, 0.42 * side))
    arm = _slab([(0.7, 1.05), (2.5, 0.42), (2.6, 0.62), (1.9, 1.05), (0.8, 1.3)], y0, y1)
    return join([arm, rod((0.9, 0, 1.35), (2.45, 0, 0.95), 0.075)])


def _bucket() -> Mesh:
    bottom = _slab([(2.45, 0.06), (3.6, 0.04), (3.62, 0.08), (2.5, 0.14)], -0.92, 0.92)
    back = _slab([(2.40, 0.08), (2.52, 0.08), (2.50, 0.95), (2.38, 0.92)], -0.92, 0.92)
    lip = _slab([(2.38, 0.90), (2.5, 0.88), (2.72, 1.12), (2.66, 1.15)], -0.92, 0.92)
    cheek = [(2.45, 0.08), (3.45, 0.06), (2.68, 1.12), (2.42, 0.92)]
    return join([bottom, back, lip, _slab(cheek, 0.87, 0.92), _slab(cheek, -0.92, -0.87)])
