"""How RGB and coloured thermal become one image: pure pixel methods and the table that names them."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.kernels import blend_indexed
from fusion.tables import lookup


class Blender(Protocol):
    """Blends thermal, given as indices into a colour table, into RGB on the same grid.

    `bgr` is H x W x 3 uint8, `index` H x W uint8, `table_bgr` 256 x 3 uint8, `alpha` the weight [0, 1]
    of RGB, `mask` H x W uint8, non-zero where `index` is defined (None: everywhere). Returns a new
    H x W x 3 uint8 array; no argument is changed. May be called from several threads at once.
    """

    def __call__(
        self,
        bgr: NDArray[np.uint8],
        index: NDArray[np.uint8],
        table_bgr: NDArray[np.uint8],
        alpha: float,
        mask: NDArray[np.uint8] | None,
    ) -> NDArray[np.uint8]: ...


def blend_laplacian(bgr, index, table_bgr, alpha, mask=None):
    raise NotImplementedError


BLENDERS: dict[str, Blender] = {"alpha": blend_indexed, "laplacian": blend_laplacian}


def blender(name: str) -> Blender:
    """The blender called `name`: ours, or one installed under the entry points `fusion.blenders`."""
    return lookup(BLENDERS, "fusion.blenders", name, "blender")
