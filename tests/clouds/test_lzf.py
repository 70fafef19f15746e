"""The LZF loop against a plain twin, and blocks made to break it."""

from __future__ import annotations

import numpy as np
import pytest
from cloud_files import lzf
from hypothesis import given
from hypothesis import strategies as st

from fusion.clouds.kernels import decompress_lzf
from fusion.errors import FrameError


def twin(block: bytes) -> bytes:
    out, i = bytearray(), 0
    while i < len(block):
        control, i = block[i], i + 1
        if control < 32:
            out += block[i : i + control + 1]
            i += control + 1
            continue
        length = control >> 5
        if length == 7:
            length, i = length + block[i], i + 1
        start, i = len(out) - 256 * (control % 32) - block[i] - 1, i + 1
        for k in range(length + 2):
            out.append(out[start + k])
    return bytes(out)


def tokens(data: st.DataObject) -> bytes:
    """A sound block: literals and references that stay inside what is written."""
    block, written = bytearray(), 0
    for _ in range(data.draw(st.integers(1, 12))):
        if written and data.draw(st.booleans()):
            back = data.draw(st.integers(0, min(written, 8192) - 1))
            length = data.draw(st.sampled_from([1, 2, 6, 7, 8, 100, 262]))
            block += bytes(
                [(min(length, 7) << 5) | back >> 8, *([length - 7] if length >= 7 else []), back % 256]
            )
            written += length + 2
        else:
            run = data.draw(st.binary(min_size=1, max_size=32))
            block += bytes([len(run) - 1]) + run
            written += len(run)
    return bytes(block)


@given(st.data())
def test_sound_blocks_expand_as_the_twin_says(data: st.DataObject) -> None:
    block = tokens(data)
    expected = twin(block)
    assert decompress_lzf(block, len(expected), "a").tobytes() == expected
    with pytest.raises(FrameError, match="past the size it claims"):
        decompress_lzf(block, len(expected) - 1, "a")
    if len(expected) < 88 * len(block):
        with pytest.raises(FrameError, match=f"expands to {len(expected):,} bytes and claims"):
            decompress_lzf(block, len(expected) + 1, "a")


@given(st.binary(max_size=400), st.integers(1, 40))
def test_what_is_compressed_comes_back(data: bytes, times: int) -> None:
    data = data * times
    assert decompress_lzf(lzf(data), len(data), "a").tobytes() == data


@given(st.binary(max_size=200), st.integers(0, 5000))
def test_rubbish_raises_and_nothing_else(block: bytes, size: int) -> None:
    try:
        found = decompress_lzf(block, size, "a").tobytes()
    except FrameError:
        found = None
    assert found is None or found == twin(block)


@pytest.mark.parametrize(
    ("block", "size", "why"),
    [
        (b"\x05abc", 6, "ends in the middle"),
        (b"\x02ab", 3, "ends in the middle"),
        (b"\x00a\x20", 4, "ends in the middle"),
        (b"\x00a\xe0", 4, "ends in the middle"),
        (b"\x00a\xe0\x01", 4, "ends in the middle"),
        (b"\x00a\x20\x01", 4, "before its start"),
        (b"\x20\x00", 3, "before its start"),
        (b"\x00a\xe0\xff\x00", 200, "past the size it claims"),
        (b"\x00a\x00b", 1, "past the size it claims"),
        (b"\x00a", 10**9, "cannot hold the 1,000,000,000"),
        (b"", 1, "cannot hold"),
        (b"\x00a", 2, "expands to 1 bytes and claims 2"),
    ],
)
def test_each_way_of_being_wrong(block: bytes, size: int, why: str) -> None:
    with pytest.raises(FrameError, match=why):
        decompress_lzf(block, size, "a.pcd")


def test_nothing_is_written_behind_the_claim() -> None:
    """The result is as long as claimed, whatever the block asks for, and its neighbours are not touched."""
    out = decompress_lzf(b"\x1f" + bytes(range(32)) + b"\xe0\xff\x1f", 32 + 264, "a")
    assert out.dtype == np.uint8
    assert out[32:].tolist() == (list(range(32)) * 9)[:264]
