"""A miner, standing: 1.8 m with helmet, in overalls and vest, cap lamp on."""

from __future__ import annotations

import numpy as np

from fusion.simulate.mine.meshes import Floats, Mesh, box, capsule, ellipsoid, join, prism, rod, tube
from fusion.simulate.mine.parts import Part

_SIDES = (1, -1)


def person(T_world_person: Floats) -> list[Part]:
    """The parts of a person who stands at the origin of his frame and looks along its x axis (z up)."""
    made: dict[str, list[Mesh]] = {
        "boot": [_boot(side) for side in _SIDES],
        "overall": [_leg(side) for side in _SIDES] + [_arm(side) for side in _SIDES] + [_trunk()],
        "vest": [ellipsoid((0.0, 0, 1.27), (0.142, 0.212, 0.235), 24)],
        "tape": [_band(z, wide) for z, wide in ((1.12, 0.176), (1.24, 0.217))],
        "skin": [_head(), *(ellipsoid((0.16, 0.285 * side, 0.90), (0.05, 0.032, 0.085)) for side in _SIDES)],
        "helmet": [_helmet(), box((-0.17, -0.09, 1.02), (-0.13, 0.09, 1.2))],
        "lamp": [rod((0.125, 0, 1.745), (0.16, 0, 1.745), 0.026)],
    }
    return [Part("person", material, join(meshes).moved(T_world_person)) for material, meshes in made.items()]


def _leg(side: int) -> Mesh:
    hip, knee, ankle = (0.0, 0.095 * side, 0.90), (0.025, 0.115 * side, 0.50), (-0.015, 0.125 * side, 0.20)
    return join([capsule(hip, knee, 0.098, 0.072), capsule(knee, ankle, 0.072, 0.066)])


def _boot(side: int) -> Mesh:
    shaft = capsule((-0.015, 0.125 * side, 0.10), (-0.015, 0.125 * side, 0.30), 0.066, 0.076)
    foot = capsule((-0.04, 0.125 * side, 0.052), (0.16, 0.145 * side, 0.046), 0.052, 0.046)
    return join([shaft, foot])


def _arm(side: int) -> Mesh:
    shoulder, elbow, wrist = (0.0, 0.215 * side, 1.43), (-0.04, 0.285 * side, 1.15), (0.13, 0.28 * side, 0.97)
    return join([capsule(shoulder, elbow, 0.068, 0.052), capsule(elbow, wrist, 0.05, 0.042)])


def _trunk() -> Mesh:
    pelvis = ellipsoid((0, 0, 0.97), (0.125, 0.18, 0.14), 20)
    chest = ellipsoid((0, 0, 1.25), (0.128, 0.195, 0.27), 20)
    shoulders = capsule((0, -0.16, 1.44), (0, 0.16, 1.44), 0.07, 0.07)
    return join([pelvis, chest, shoulders])


def _band(z: float, wide: float) -> Mesh:
    angle = np.linspace(0, 2 * np.pi, 25)[:-1]
    return prism(np.c_[0.145 * wide / 0.212 * np.cos(angle), wide * np.sin(angle)], z - 0.025, z + 0.025)


def _head() -> Mesh:
    skull, jaw = (
        ellipsoid((0.01, 0, 1.65), (0.098, 0.078, 0.112)),
        ellipsoid((0.04, 0, 1.59), (0.06, 0.058, 0.07)),
    )
    return join(
        [
            skull,
            jaw,
            rod((-0.01, 0, 1.45), (0.0, 0, 1.60), 0.058),
            ellipsoid((0.108, 0, 1.63), (0.02, 0.014, 0.025)),
        ]
    )


def _helmet() -> Mesh:
    angle = np.linspace(0, 2 * np.pi, 25)[:-1]
    brim = prism(np.c_[0.02 + 0.158 * np.cos(angle), 0.125 * np.sin(angle)], 1.685, 1.70)
    up = np.linspace(0, 1.45, 8)
    dome = tube(np.c_[np.zeros((8, 2)), np.sin(up)], np.cos(up), 20)
    return join([brim, Mesh(dome.vertices * (0.135, 0.11, 0.125) + (0.01, 0, 1.69), dome.triangles)])
