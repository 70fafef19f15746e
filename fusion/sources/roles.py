"""What an image file's channels mean for the camera it is said to come from."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.codecs import Pixels
from fusion.errors import FrameError
from fusion.sources.base import Role

FirColour = Literal["refuse", "luma"]

GREY_TOLERANCE = 2  # grey levels by which lossy coding may part the channels of a grey 8-bit image
_NO_LUMA = "a coloured thermal picture is no measurement: use the raw one, or --fir-colour luma"


def to_role(pixels: Pixels, role: Role, where: str, fir_colour: FirColour) -> tuple[Pixels, tuple[str, ...]]:
    """Bring decoded pixels (grey, BGR or BGRA; uint8 or uint16) to what `role` stands for.

    ``rgb`` gives H x W x 3 BGR uint8, ``fir`` H x W uint8 or uint16 counts. Returns them with one flag
    for each thing that was done. Raises `FrameError` where a thermal image is truly coloured and
    `fir_colour` is ``refuse``, or where its alpha channel holds data.
    """
    return _to_rgb(pixels) if role == "rgb" else _to_fir(pixels, where, fir_colour)


def _to_rgb(pixels: Pixels) -> tuple[NDArray[np.uint8], tuple[str, ...]]:
    flags = []
    if pixels.ndim == 3 and pixels.shape[2] == 4:
        if not _opaque(pixels):
            flags.append("rgb-alpha-dropped")
        pixels = cv2.cvtColor(pixels, cv2.COLOR_BGRA2BGR)
    if pixels.dtype == np.uint16:
        flags.append("rgb-16bit-to-8")
        pixels = cv2.convertScaleAbs(pixels, alpha=1 / 257)  # exact: v / 257 is never near a half
    if pixels.ndim == 2:
        flags.append("rgb-grey")
        pixels = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR)
    return pixels, tuple(flags)


def _to_fir(pixels: Pixels, where: str, fir_colour: FirColour) -> tuple[Pixels, tuple[str, ...]]:
    if pixels.ndim == 2:
        return pixels, ()
    if pixels.shape[2] == 4:
        if not _opaque(pixels):
            hint = "drop that channel; a file of RGB and thermal together is read as RGB+T"
            raise FrameError("the thermal image has an alpha channel that holds data", where=where, hint=hint)
        pixels = cv2.cvtColor(pixels, cv2.COLOR_BGRA2BGR)
    if _grey(pixels):
        return np.ascontiguousarray(pixels[:, :, 1]), ("fir-grey-stored-as-colour",)
    if fir_colour == "refuse":
        raise FrameError("the thermal image is coloured", where=where, hint=_NO_LUMA)
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), ("fir-colour-to-luma",)


def _opaque(pixels: Pixels) -> bool:
    return bool(pixels[:, :, 3].min() == np.iinfo(pixels.dtype).max)


def _grey(pixels: Pixels) -> bool:
    """Whether the three channels are equal, in 8 bit up to `GREY_TOLERANCE`."""
    blue, green, red = cv2.split(pixels)
    tolerance = GREY_TOLERANCE if pixels.dtype == np.uint8 else 0
    return all(
        cv2.norm(a, b, cv2.NORM_INF) <= tolerance for a, b in ((blue, green), (green, red), (blue, red))
    )
