"""Image files as bytes to pixel arrays and back. Knows nothing of folders, roles or frames.

The format is told from the data's first bytes, never from a file name. What a decoder would repair,
rescale or complete in silence is refused here, so that an array that comes out is what was stored.
"""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from fusion.errors import FrameError
from fusion.png import decode_plain
from fusion.png16 import encode_png16

try:
    import fpng
except ImportError:  # no wheel for this platform: OpenCV's encoder takes over
    fpng = None

Pixels = NDArray[Any]  # uint8 or uint16

MAX_PIXELS = 2**27

_PNG_END = b"\x00\x00\x00\x00IEND\xaeB\x60\x82"
_PNG_PALETTE = (b"PLTE", b"tRNS")  # what decides about pixels besides IHDR and IDAT
_PNG_QUIET = (*_PNG_PALETTE, b"pHYs", b"tIME", b"sBIT", b"bKGD")
_PNG_FAST = (
    *(cv2.IMWRITE_PNG_COMPRESSION, 1),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY),
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP),
)
# both TIFF readers turn an image by its orientation tag; these undo it
_TURN_BACK: dict[int, Callable[[Pixels], Pixels]] = {
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: np.rot90(a, 1),
    7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
    8: lambda a: np.rot90(a, -1),
}
_PNM_HEADER = re.compile(rb"P([2356])" + rb"(?:\s|#[^\n\r]*[\n\r])+(\d{1,9})" * 3 + rb"\s")


def decode_image(data: bytes, where: str, max_pixels: int = MAX_PIXELS) -> Pixels:
    """Decode a PNG, JPEG, TIFF, BMP, WebP, PGM or PPM file held in memory.

    Returns H x W, H x W x 3 (BGR) or H x W x 4 (BGRA), uint8 or uint16. Values are those stored: 16-bit
    data and 12-bit counts in 16-bit words are not rescaled; only 1, 2 and 4-bit grey spreads over 0..255,
    and palettes become their colours. Pixels stay as stored: an EXIF or TIFF orientation is not applied.

    `where` names the image in messages; `max_pixels` bounds width x height, checked before pixel memory
    is taken. Raises `FrameError` for empty, truncated, corrupt, too large, animated, multi-page, CMYK,
    float, signed and 32-bit images. Damage inside formats without a checksum (BMP, PGM, WebP, most JPEG
    and TIFF) can go unseen as long as the length and the structure are right.
    """
    if not data:
        raise FrameError("the file is empty (0 bytes)", where=where)
    for magic, decode in _DECODERS.items():
        if data.startswith(magic):
            return decode(data, where, max_pixels)
    raise FrameError(
        "the content is no image of a known format",
        where=where,
        hint="expected PNG, JPEG, TIFF, BMP, WebP, PGM or PPM",
    )


def encode_png(pixels: Pixels) -> bytes:
    """Encode losslessly as PNG: H x W, H x W x 3 (BGR) or H x W x 4 (BGRA), uint8 or uint16.

    8-bit colour goes through fpng, 16 bits through ISA-L, where they are installed; the bytes of the file
    (not its pixels) depend on which encoder is there.
    """
    if fpng is not None and pixels.ndim == 3 and pixels.dtype == np.uint8:
        order = cv2.COLOR_BGR2RGB if pixels.shape[2] == 3 else cv2.COLOR_BGRA2RGBA
        return fpng.from_ndarray(cv2.cvtColor(pixels, order))
    if pixels.dtype == np.uint16:
        packed = encode_png16(pixels)
        if packed is not None:
            return packed
    # one channel of 8 bits is a mask here: OpenCV's own choice of filter is far smaller and faster on those
    options = () if pixels.ndim == 2 and pixels.dtype == np.uint8 else _PNG_FAST
    done, data = cv2.imencode(".png", pixels, options)
    if not done:
        raise ValueError(f"cannot encode {pixels.shape} {pixels.dtype} as PNG")
    return data.tobytes()


def encode_jpeg(bgr: NDArray[np.uint8], quality: int) -> bytes:
    """Encode H x W x 3 BGR uint8 as baseline JPEG, `quality` 1 to 100. Lossy.

    Chroma is halved both ways (4:2:0) up to quality 94, as cameras and ffmpeg do and as viewers expect;
    from 95 on it is kept whole (4:4:4): who asks for that quality wants the colour map's edges.
    """
    if not 1 <= quality <= 100:
        raise ValueError(f"JPEG quality is 1 to 100, got {quality}")
    sampling = "444" if quality >= 95 else "420"
    return simplejpeg.encode_jpeg(np.ascontiguousarray(bgr), quality, "BGR", sampling)


def _check_size(width: int, height: int, where: str, max_pixels: int) -> None:
    if width <= 0 or height <= 0:
        raise FrameError(f"claims a size of {width} x {height} pixels", where=where)
    if width * height > max_pixels:
        raise FrameError(
            f"claims {width} x {height} pixels, more than the limit of {max_pixels}",
            where=where,
            hint="the file is damaged or not meant for this; raise max_pixels if it is right",
        )


def _truncated(where: str) -> FrameError:
    return FrameError("the file is truncated", where=where, hint="copy it again from its origin")


def _corrupt(where: str, why: object = "") -> FrameError:
    text = f": {why}" if str(why) else ""
    return FrameError(f"the image data is corrupt{text}", where=where, hint="copy it again from its origin")


def _by_opencv(data: bytes, where: str) -> Pixels:
    try:
        pixels: Any = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise _corrupt(where, error.err) from error
    if pixels is None:
        raise _corrupt(where)
    return pixels


def _decode_png(data: bytes, where: str, max_pixels: int) -> Pixels:
    if len(data) < 33:
        raise _truncated(where)
    length, kind, width, height = struct.unpack_from(">I4sII", data, 8)
    if kind != b"IHDR" or length != 13:
        raise _corrupt(where, "the PNG header is damaged")
    _check_size(width, height, where, max_pixels)
    plain = decode_plain(data, max_pixels)
    if plain is not None:
        return plain
    if not data.endswith(_PNG_END) and _PNG_END not in data:
        raise _truncated(where)
    return _by_opencv(_without_png_metadata(data, where), where)


def _without_png_metadata(data: bytes, where: str) -> bytes:
    """The same PNG without the metadata in front of its pixels; `data` itself if there is none.

    libpng writes complaints about metadata (colour profiles above all) straight to the terminal.
    """
    kept, noisy, at = [data[:33]], False, 33
    while data[at + 4 : at + 8] != b"IDAT":
        if at + 12 > len(data):
            raise _corrupt(where, "no pixel data found")
        length, kind = struct.unpack_from(">I4s", data, at)
        if kind == b"acTL" and data[at + 8 : at + 12] > b"\x00\x00\x00\x01":
            raise FrameError("an animated PNG is not one image", where=where, hint="split it into frames")
        ancillary = bool(kind[0] & 0x20) and kind not in _PNG_PALETTE
        noisy |= kind not in _PNG_QUIET and ancillary
        if not ancillary:
            kept.append(data[at : at + 12 + length])
        at += 12 + length
    return b"".join((*kept, data[at:])) if noisy else data


def _decode_jpeg(data: bytes, where: str, max_pixels: int) -> Pixels:
    try:
        height, width, space, _ = simplejpeg.decode_jpeg_header(data)
        _check_size(int(width), int(height), where, max_pixels)
        if space == "Gray":
            return simplejpeg.decode_jpeg(data, "GRAY")[:, :, 0]
        if space in ("CMYK", "YCCK"):
            raise FrameError("the JPEG holds print colours (CMYK)", where=where, hint="convert it to RGB")
        return simplejpeg.decode_jpeg(data, "BGR")
    except ValueError as error:
        raise _corrupt(where, error) from error


def _decode_webp(data: bytes, where: str, max_pixels: int) -> Pixels:
    if data[8:12] != b"WEBP":
        raise FrameError("a RIFF file, but no WebP image", where=where)
    if len(data) < 30 or len(data) < 8 + int.from_bytes(data[4:8], "little"):
        raise _truncated(where)
    kind, bits = data[12:16], int.from_bytes(data[21:25], "little")
    if kind == b"VP8X":
        if data[20] & 0x02:
            raise FrameError("an animated WebP is not one image", where=where, hint="split it into frames")
        width, height = (int.from_bytes(data[i : i + 3], "little") + 1 for i in (24, 27))
    elif kind == b"VP8L":
        width, height = (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    else:
        width, height = (value & 0x3FFF for value in struct.unpack_from("<HH", data, 26))
    _check_size(width, height, where, max_pixels)
    return _by_opencv(data, where)


def _decode_bmp(data: bytes, where: str, max_pixels: int) -> Pixels:
    if len(data) < 34:
        raise _truncated(where)
    offset, header = struct.unpack_from("<II", data, 10)
    if header < 40:
        raise FrameError("a BMP of the OS/2 kind", where=where, hint="save it as PNG")
    width, height, _, bits, packing = struct.unpack_from("<iiHHI", data, 18)
    height = abs(height)  # negative: rows from top to bottom
    _check_size(width, height, where, max_pixels)
    if packing not in (0, 3):
        raise FrameError("a run-length coded BMP", where=where, hint="save it as PNG")  # cv2 completes them
    if len(data) < offset + (width * bits + 31) // 32 * 4 * height:
        raise _truncated(where)
    return _by_opencv(data, where)


def _decode_pnm(data: bytes, where: str, max_pixels: int) -> Pixels:
    """PGM and PPM, binary and text. Read here, for OpenCV stretches text files over 0..255."""
    head = _PNM_HEADER.match(data)
    if head is None:
        raise _corrupt(where, "the PGM/PPM header is damaged")
    kind, width, height, top = (int(value) for value in head.groups())
    _check_size(width, height, where, max_pixels)
    channels = 3 if kind in (3, 6) else 1
    if not 0 < top < 65536 or (channels == 3 and top not in (255, 65535)):
        raise FrameError(f"a largest value of {top} is not supported", where=where, hint="convert it to PNG")
    dtype = np.dtype(np.uint8 if top < 256 else ">u2")
    count = width * height * channels
    body = data[head.end() :]
    values = _pnm_text(body, where) if kind < 4 else np.frombuffer(body, dtype, len(body) // dtype.itemsize)
    if values.size < count:
        raise _truncated(where)
    values = values[:count]
    if values.max() > top:
        raise _corrupt(where, f"values above its largest value {top}")
    pixels = values.astype(dtype.newbyteorder("="))
    if channels == 1:
        return pixels.reshape(height, width)
    return np.ascontiguousarray(pixels.reshape(height, width, 3)[:, :, ::-1])


def _pnm_text(body: bytes, where: str) -> NDArray[np.uint32]:
    words = re.sub(rb"#[^\n\r]*", b"", body).split()
    try:
        return np.array(words, dtype="S10").astype(np.uint32)
    except (ValueError, OverflowError) as error:
        raise _corrupt(where, "a value is no number") from error


def _decode_tiff(data: bytes, where: str, max_pixels: int) -> Pixels:
    """TIFF by Pillow: OpenCV returns half-filled images, scales 12 bit to 16 and multiplies by alpha."""
    from PIL import TiffImagePlugin

    try:
        image = TiffImagePlugin.TiffImageFile(io.BytesIO(data))
        _check_size(*image.size, where, max_pixels)
        if image.n_frames > 1:
            raise FrameError(
                f"the TIFF holds {image.n_frames} pages", where=where, hint="split it into files"
            )
        orientation, kind = image.tag_v2.get(274, 1), _tiff_kind(image.tag_v2, where)
        image.load()
    except FrameError:
        raise
    except Exception as error:  # Pillow raises what its parsers happen to meet: nearly every kind
        raise _corrupt(where, error) from error
    # where Pillow would lose values it has at least checked that the data is whole
    pixels = _by_opencv(data, where) if kind == "opencv" else _from_pillow(image, where)
    return np.ascontiguousarray(_TURN_BACK.get(orientation, np.asarray)(pixels))


def _tiff_kind(tags: Any, where: str) -> str:
    """Which library reads this TIFF without losing anything: ``pillow`` or ``opencv``."""
    samples, bits = tags.get(277, 1), tags.get(258, (1,))
    if set(tags.get(339, (1,))) - {1, 4} or max(bits) > 16:
        kind = {2: "signed", 3: "floating point"}.get(tags.get(339, (1,))[0], "unsigned")
        hint = "convert it to uint16 counts and note the scale"
        raise FrameError(f"the TIFF holds {max(bits)}-bit {kind} values", where=where, hint=hint)
    if tags.get(262) not in (0, 1, 2, 3, 6) or samples not in (1, 2, 3, 4):
        hint = "save it as grey, RGB or RGBA"
        raise FrameError(f"a TIFF of {samples} samples a pixel in unusual colours", where=where, hint=hint)
    extra = tags.get(338, (2,))
    lossy = (samples > 1 and max(bits) > 8) or (samples == 4 and extra[0] != 2)
    if lossy and (samples == 2 or tags.get(284, 1) != 1):
        raise FrameError("a TIFF with this order of samples", where=where, hint="save it as PNG")
    return "opencv" if lossy else "pillow"


def _from_pillow(image: Any, where: str) -> Pixels:
    if image.mode in ("1", "P", "PA", "LA", "YCbCr"):
        image = image.convert({"1": "L", "P": "RGB", "YCbCr": "RGB"}.get(image.mode, "RGBA"))
    pixels = np.array(image)
    if pixels.ndim == 2 and pixels.dtype.kind == "u" and pixels.dtype.itemsize <= 2:
        return pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    if image.mode in ("RGB", "RGBA"):
        return cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR if image.mode == "RGB" else cv2.COLOR_RGBA2BGRA)
    raise FrameError(f"a TIFF of the kind {image.mode}", where=where, hint="save it as grey, RGB or RGBA")


_DECODERS: dict[bytes, Callable[[bytes, str, int], Pixels]] = {
    b"\x89PNG\r\n\x1a\n": _decode_png,
    b"\xff\xd8": _decode_jpeg,
    b"II*\x00": _decode_tiff,
    b"MM\x00*": _decode_tiff,
    b"BM": _decode_bmp,
    b"RIFF": _decode_webp,
    b"P2": _decode_pnm,
    b"P3": _decode_pnm,
    b"P5": _decode_pnm,
    b"P6": _decode_pnm,
}
