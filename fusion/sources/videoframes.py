"""Decoded video frames to pixel arrays, without rescaling thermal values."""

from __future__ import annotations

import re
import threading
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from fusion.codecs import Pixels
from fusion.errors import FrameError
from fusion.sources.base import Role
from fusion.sources.roles import GREY_TOLERANCE, FirColour, to_role

if TYPE_CHECKING:
    from av import VideoFrame
    from av.video.reformatter import VideoReformatter

_GREY = re.compile(r"gray(?:9|1[0246])?(?:le|be)?")
_YUV = re.compile(r"yuvj?4\d\dp(?:9|1[0246])?(?:le|be)?|nv12|nv21|nv16|nv24")
_FULL_RANGE = 2  # ffmpeg's AVCOL_RANGE_JPEG
# limited range keeps black at 16 and white at 235; what lies outside is clipped, as every player does
_TO_FULL = np.rint((np.arange(256.0) - 16) * 255 / 219).clip(0, 255).astype(np.uint8)
_per_thread = threading.local()


def frame_to_role(
    frame: VideoFrame, role: Role, where: str, fir_colour: FirColour
) -> tuple[Pixels, tuple[str, ...]]:
    """Pixels of a decoded frame as `role` wants them, with flags for what was done.

    ``rgb``: H x W x 3 BGR uint8, by the frame's own colour matrix and range. ``fir``: grey frames give
    the stored values, 8 bit as uint8, more (9 to 16) as uint16 without rescaling. Y'CbCr frames whose
    chroma is neutral give their luma: 8 bit stretched to full range where it is limited, more bits as
    stored. Truly coloured frames follow `fir_colour`, as files do. Raises `FrameError` for those and for
    floating point.
    """
    bits = max(component.bits for component in frame.format.components)
    if bits > 16:
        raise FrameError(f"the pixel format {frame.format.name} is not supported", where=where)
    if _GREY.fullmatch(frame.format.name) and (role == "fir" or bits in (8, 16)):
        return to_role(_plane(frame, 0, bits), role, where, fir_colour)
    if role == "fir" and _YUV.fullmatch(frame.format.name) and _neutral(frame, bits):
        return _luma(frame, bits), ("fir-grey-stored-as-colour",)
    pixels, flags = to_role(_colour(frame, role, bits), role, where, fir_colour)
    return pixels, flags if role == "fir" or bits in (8, 16) else (*flags, *_lowered(frame, bits))


def _lowered(frame: VideoFrame, bits: int) -> list[str]:
    """What `_colour` did to an RGB frame that is neither 8 nor 16 bits deep."""
    flags = [f"rgb-{bits}bit-to-8"] if bits > 8 else []
    return [*flags, "rgb-grey"] if _GREY.fullmatch(frame.format.name) else flags


def _colour(frame: VideoFrame, role: Role, bits: int) -> Pixels:
    """BGR or BGRA of any format: 16-bit where thermal values would else be lost, or rounding is ours."""
    wide = bits == 16 or (bits > 8 and role == "fir")
    alpha = frame.format.has_palette or any(component.is_alpha for component in frame.format.components)
    name = {(0, 0): "bgr24", (0, 1): "bgra", (1, 0): "bgr48le", (1, 1): "bgra64le"}[wide, alpha]
    return _converter().reformat(frame, format=name).to_ndarray()


def _converter() -> VideoReformatter:
    """This thread's converter: it keeps its tables from frame to frame, and cannot be shared."""
    from av.video.reformatter import VideoReformatter

    if not hasattr(_per_thread, "converter"):
        _per_thread.converter = VideoReformatter()
    return _per_thread.converter


def _neutral(frame: VideoFrame, bits: int) -> bool:
    middle, tolerance = 1 << (bits - 1), GREY_TOLERANCE << (bits - 8)
    planes = [_plane(frame, i, bits) for i in range(1, len(frame.planes))]
    return all(max(int(p.max()) - middle, middle - int(p.min())) <= tolerance for p in planes)


def _luma(frame: VideoFrame, bits: int) -> Pixels:
    luma = _plane(frame, 0, bits)
    full = frame.color_range == _FULL_RANGE or frame.format.name.startswith("yuvj")
    return luma if full or bits > 8 else cv2.LUT(luma, _TO_FULL)


def _plane(frame: VideoFrame, number: int, bits: int) -> Pixels:
    """A copy of one plane as stored, in the machine's byte order; interleaved chroma lies side by side."""
    plane: Any = frame.planes[number]
    wide = 2 if number and frame.format.name.startswith("nv") else 1
    dtype = np.dtype(np.uint8 if bits == 8 else ">u2" if frame.format.name.endswith("be") else "<u2")
    rows = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)
    values = np.ascontiguousarray(rows[:, : plane.width * wide * dtype.itemsize]).view(dtype)
    return values.astype(dtype.newbyteorder("="))
