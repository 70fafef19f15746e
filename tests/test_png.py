"""The fast PNG decoder against libpng (through OpenCV), and against files it must not touch."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from fusion.png import SIGNATURE, decode_plain

LIMIT = 2**20


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def filtered_row(kind: int, row: NDArray[np.int64], above: NDArray[np.int64], back: int) -> NDArray[np.int64]:
    """A row as the PNG specification's section 9 filters it, in plain numpy."""
    left, corner = (np.concatenate([np.zeros(back, np.int64), line[:-back]]) for line in (row, above))
    estimate = left + above - corner
    nearest = np.argmin(np.abs([estimate - left, estimate - above, estimate - corner]), axis=0)
    paeth = np.choose(nearest, [left, above, corner])
    guess = [np.zeros_like(row), left, above, (left + above) // 2, paeth][kind]
    return (row - guess) % 256


def written(image: NDArray[Any], kinds: list[int], **header: int) -> bytes:
    """A PNG of an RGB or grey image whose rows carry the given filters in turn."""
    height, width = image.shape[:2]
    samples = image.astype(image.dtype.newbyteorder(">")).view(np.uint8).reshape(height, -1).astype(np.int64)
    back = samples.shape[1] // width
    above = np.zeros(samples.shape[1], np.int64)
    rows = []
    for y, row in enumerate(samples):
        kind = kinds[y % len(kinds)]
        rows.append(bytes([kind]) + filtered_row(kind, row, above, back).astype(np.uint8).tobytes())
        above = row
    fields = {"bits": 8 * image.itemsize, "colour": 2 if image.ndim == 3 else 0, "interlace": 0, **header}
    ihdr = struct.pack(">IIBBBBB", width, height, fields["bits"], fields["colour"], 0, 0, fields["interlace"])
    packed = zlib.compress(b"".join(rows))
    parts = [chunk(b"IDAT", packed[i : i + 4096]) for i in range(0, len(packed), 4096)]
    return SIGNATURE + chunk(b"IHDR", ihdr) + b"".join(parts) + chunk(b"IEND", b"")


@given(
    st.sampled_from([np.uint8, np.uint16]),
    st.sampled_from([(), (3,)]),
    st.integers(1, 9),
    st.integers(1, 9),
    st.lists(st.integers(0, 4), min_size=1, max_size=5),
    st.integers(0, 2**32 - 1),
)
def test_every_filter_gives_the_pixels_back(
    dtype: type[np.uint8], channels: tuple[int, ...], width: int, height: int, kinds: list[int], seed: int
) -> None:
    top = int(np.iinfo(dtype).max)
    rgb = np.random.default_rng(seed).integers(0, top + 1, (height, width, *channels), dtype)
    decoded = decode_plain(written(rgb, kinds), LIMIT)
    assert decoded is not None
    assert decoded.dtype == dtype
    assert np.array_equal(decoded, rgb[..., ::-1] if channels else rgb)


@pytest.mark.parametrize("kind", range(5))
@pytest.mark.parametrize("shape", [(41, 67), (41, 67, 3)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_libpng_agrees(kind: int, shape: tuple[int, ...], dtype: type[np.uint8]) -> None:
    smooth = np.cumsum(np.random.default_rng(kind).integers(-3, 4, shape), axis=1) + 128
    data = written((smooth % (int(np.iinfo(dtype).max) + 1)).astype(dtype), [kind])
    decoded = decode_plain(data, LIMIT)
    assert decoded is not None
    theirs = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert theirs is not None
    assert np.array_equal(decoded, theirs)


PLAIN = written(np.arange(63, dtype=np.uint8).reshape(7, 9), [4, 1])


def test_no_damaged_file_is_decoded() -> None:
    """Every byte is under a checksum: whichever bit is turned, and wherever the file is cut."""
    for at in range(len(PLAIN)):
        damaged = bytearray(PLAIN)
        damaged[at] ^= 1 << (at % 8)
        assert decode_plain(bytes(damaged), LIMIT) is None, at
        assert decode_plain(PLAIN[:at], LIMIT) is None, at


@pytest.mark.parametrize("header", [{"colour": 3}, {"colour": 4}, {"bits": 4}, {"interlace": 1}])
def test_other_kinds_are_left_to_opencv(header: dict[str, int]) -> None:
    assert decode_plain(written(np.zeros((4, 4), np.uint8), [0], **header), LIMIT) is None


@pytest.mark.parametrize("kind", [b"tRNS", b"PLTE", b"acTL", b"abcD"])
def test_chunks_that_may_change_pixels_are_left_to_opencv(kind: bytes) -> None:
    at = len(SIGNATURE) + 25
    assert decode_plain(PLAIN[:at] + chunk(b"tEXt", b"a\0b") + PLAIN[at:], LIMIT) is not None
    assert decode_plain(PLAIN[:at] + chunk(kind, b"\0\0") + PLAIN[at:], LIMIT) is None


def with_pixels(packed: bytes, width: int = 9, height: int = 7) -> bytes:
    ihdr = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return SIGNATURE + chunk(b"IHDR", ihdr) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


@pytest.mark.parametrize("size", [0, 69, 71, 50_000_000])
def test_too_few_and_too_many_pixels_are_no_picture(size: int) -> None:
    assert decode_plain(with_pixels(zlib.compress(bytes(70))), LIMIT) is not None
    assert decode_plain(with_pixels(zlib.compress(bytes(size))), LIMIT) is None


def test_unknown_filters_and_claims_beyond_the_limit() -> None:
    assert decode_plain(with_pixels(zlib.compress(b"\x05" + bytes(69))), LIMIT) is None
    assert decode_plain(PLAIN, 62) is None
    assert decode_plain(with_pixels(zlib.compress(bytes(70)), 2**31 - 1, 2**31 - 1), 2**63) is None
