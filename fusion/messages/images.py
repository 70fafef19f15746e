"""From images as they were sent to what their camera's role needs."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fusion.codecs import Pixels, decode_image
from fusion.errors import FrameError
from fusion.frames import Image
from fusion.messages.base import CompressedImage, RawImage
from fusion.messages.compressed_depth import is_compressed_depth, metres, stored_depth
from fusion.messages.pixels import ENCODINGS, YUV, colours_of, encoding_of, luma_of_yuv, numbers_of
from fusion.sources.roles import GREY_TOLERANCE, FirColour, to_role

_MILLIMETRES = ("mono16", "16uc1")
_METRES = ("32fc1", "64fc1")


def image_of(
    message: RawImage | CompressedImage,
    role: Literal["rgb", "fir", "depth"],
    *,
    stem: str,
    where: str,
    fir_colour: FirColour = "refuse",
) -> Image:
    """The image of a message, its stamp the header's; `flags` say what was done to it.

    ``rgb`` gives H x W x 3 BGR uint8: mosaics interpolated, YUV as BT.601 of limited range, 16 bits scaled
    to 8. ``fir`` gives H x W uint8 or uint16 counts as they were sent: luma of YUV without colour; signed,
    32-bit and float numbers where they are whole and fit. Others, temperatures in floats above all, are
    refused: what they measure stands nowhere. Colour is treated as in files (`fusion.sources.roles.to_role`).
    ``depth`` gives uint16 millimetres, rounded, 0 = none (beyond 65.535 m too, flagged); `depth_of` metres.

    Raises `FrameError` for encodings that are not known or mean nothing for the role, sizes and rows that do
    not fit, bytes that are too few, and whatever `fusion.codecs.decode_image` refuses.
    """
    if role == "depth":
        pixels, flags = _millimetres(depth_of(message, where=where))
    elif isinstance(message, CompressedImage):
        pixels, flags = to_role(_decoded(message, role, where), role, where, fir_colour)
    elif role == "fir":
        pixels, flags = _counts(message, where, fir_colour)
    else:
        pixels, flags = to_role(_colours(message, where), role, where, fir_colour)
    return Image(pixels, stem, message.header.stamp_ns, flags)


def depth_of(message: RawImage | CompressedImage, *, where: str) -> NDArray[np.float32]:
    """H x W float32 metres along the optical axis, 0 = none (also for NaN, infinite and negative ones).

    From 16 bits in millimetres, floats in metres, compressedDepth, or a 16-bit grey picture in millimetres.
    Raises `FrameError` for all else.
    """
    if isinstance(message, CompressedImage):
        if is_compressed_depth(message):
            return metres(stored_depth(message, where))
        pixels = decode_image(bytes(message.data), where)
        if pixels.ndim == 2 and pixels.dtype == np.uint16:
            return pixels.astype(np.float32) * np.float32(0.001)
        raise FrameError("a picture of 8 bits or in colour is no depth", where=where)
    word = encoding_of(message, where)
    if word in _MILLIMETRES:
        return numbers_of(message, ENCODINGS[word], where).astype(np.float32) * np.float32(0.001)
    if word not in _METRES:
        hint = "depth is 16UC1 in millimetres or 32FC1 in metres"
        raise FrameError(f"an image of the encoding {message.encoding!r} is no depth", where=where, hint=hint)
    with np.errstate(all="ignore"):  # a float64 may be too large for float32
        depth_m = numbers_of(message, ENCODINGS[word], where).astype(np.float32)  # always a copy of ours
        depth_m[~(np.isfinite(depth_m) & (depth_m > 0))] = 0
    return depth_m


def _millimetres(depth_m: NDArray[np.float32]) -> tuple[NDArray[np.uint16], tuple[str, ...]]:
    mm = np.floor(depth_m.astype(np.float64) * 1000 + 0.5)
    far = mm > 65535
    mm[far] = 0
    return mm.astype(np.uint16), ("depth-beyond-65m",) if far.any() else ()


def _decoded(message: CompressedImage, role: str, where: str) -> Pixels:
    if not is_compressed_depth(message):
        return decode_image(bytes(message.data), where)
    stored = stored_depth(message, where)
    if role == "fir" and stored.inverse is None:
        return stored.steps  # 16 bits through the only transport that keeps them
    raise FrameError(f"a compressedDepth image is no {role} image", where=where, hint="use it as depth")


def _colours(message: RawImage, where: str) -> Pixels:
    pixels = colours_of(message, where)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise FrameError(f"an image of the encoding {message.encoding!r} is no RGB image", where=where)
    return np.ascontiguousarray(pixels)


def _counts(message: RawImage, where: str, fir_colour: FirColour) -> tuple[Pixels, tuple[str, ...]]:
    word = encoding_of(message, where)
    if word in YUV:
        return _luma(message, where, fir_colour)
    if ENCODINGS[word].mosaic:
        raise FrameError(f"a colour mosaic ({message.encoding}) is no thermal image", where=where)
    pixels = colours_of(message, where)
    if pixels.dtype in (np.uint8, np.uint16):
        pixels, flags = to_role(pixels, "fir", where, fir_colour)
        return np.array(pixels, order="C"), flags  # a copy: the message's memory is not ours to keep
    if pixels.ndim != 2:
        raise FrameError(f"an image of the encoding {message.encoding!r} is no thermal image", where=where)
    return _whole(pixels, message.encoding, where), (f"fir-from-{word}",)


def _whole(pixels: NDArray[Any], encoding: str, where: str) -> NDArray[np.uint16]:
    """Numbers of another type as uint16, if each is one."""
    fits = bool(((pixels >= 0) & (pixels <= 65535)).all())
    if not fits or (pixels.dtype.kind == "f" and not (pixels == np.floor(pixels)).all()):
        kind = "temperatures or other measures" if pixels.dtype.kind == "f" else "numbers outside 0 to 65535"
        hint = "record the camera's counts (16UC1), or temperatures as counts, (0.01 K say), with their scale"
        raise FrameError(f"a thermal image of {encoding} with {kind}", where=where, hint=hint)
    return pixels.astype(np.uint16)


def _luma(message: RawImage, where: str, fir_colour: FirColour) -> tuple[Pixels, tuple[str, ...]]:
    luma, chroma = luma_of_yuv(message, where)
    low, high = int(chroma.min()), int(chroma.max())
    grey = max(128 - low, high - 128) <= GREY_TOLERANCE
    if not grey and fir_colour == "refuse":
        hint = "a coloured thermal picture is no measurement: use the raw one, or --fir-colour luma"
        raise FrameError("the thermal image is coloured", where=where, hint=hint)
    return np.array(luma, order="C"), ("fir-luma-of-yuv" if grey else "fir-colour-to-luma",)
