"""What a scene is put together from: pieces of one material that belong to a named object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from fusion.simulate.mine.meshes import Floats, Mesh


@dataclass(frozen=True, slots=True)
class Part:
    """A mesh in the world, the object that it belongs to and the material it is made of."""

    owner: str
    material: str
    mesh: Mesh


class Reach(Protocol):
    """How far the bare rock is from N x 3 points along N x 3 unit directions (N metres)."""

    def __call__(self, points: Floats, directions: Floats) -> Floats: ...


class Floor(Protocol):
    """The floor's height at N x 2 points (N metres)."""

    def __call__(self, xy: Floats) -> Floats: ...
