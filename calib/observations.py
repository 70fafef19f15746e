"""What sensors saw of a board: the rows that every solver takes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fusion.geometry import Floats

Ids = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """A board found in an image.

    `ids` (N,) are rows of `Board.points_m`, each once; `uv` (N, 2) float64 the pixels where they are.
    Labels are right up to the board's symmetries (`Board.symmetries`). `method` says who found it.
    """

    ids: Ids
    uv: Floats
    method: str
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.uv.shape != (len(self.ids), 2) or len(np.unique(self.ids)) != len(self.ids):
            raise ValueError(
                f"expected N different ids and N x 2 pixels, got {len(self.ids)}, {self.uv.shape}"
            )


@dataclass(frozen=True, slots=True)
class Refusal:
    """No board in an image: why, in a few words for the user."""

    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A board seen by a camera.

    `camera` is its name in the rig (``rgb``, ``fir``). Views and clouds of one `moment` see the board in
    one pose; where it moved between them, `lag_s` is this view's own stamp minus the moment's stamp, seconds.
    `size_wh` is the image's size, `file` where it came from.
    """

    camera: str
    moment: str
    ids: Ids
    uv: Floats
    size_wh: tuple[int, int]
    lag_s: float = 0.0
    file: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class CloudView:
    """A board seen by a LiDAR: points in metres of the sensor's frame.

    `plane_m` (N, 3) lie on the front; `edge_m` (M, 3) on the rim of the plate, `edge_of` (M,) says on which
    of its sides: 0 top, 1 right, 2 bottom, 3 left of `Board.plate_m`.
    """

    moment: str
    plane_m: Floats
    edge_m: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    edge_of: Ids = field(default_factory=lambda: np.zeros(0, np.intp))
    sensor: str = "lidar"
    file: str = ""
