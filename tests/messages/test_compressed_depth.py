"""compressedDepth: RVL against a plain decoder and an encoder of the published code; ROS's quantisation."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fusion.codecs import encode_png
from fusion.errors import FrameError
from fusion.messages.base import CompressedImage, Header
from fusion.messages.compressed_depth import is_compressed_depth, stored_depth
from fusion.messages.images import depth_of, image_of


def nibbles_of(value: int) -> list[int]:
    found = []
    while True:
        value, low = value >> 3, value & 7
        found.append(low | (8 if value else 0))
        if not value:
            return found


def encoded(depth: NDArray[np.uint16]) -> bytes:
    """RVL as the paper's listing describes it, slowly."""
    nibbles: list[int] = []
    flat, at, previous = [int(v) for v in depth.ravel()], 0, 0
    while at < len(flat):
        zeros = 0
        while at + zeros < len(flat) and not flat[at + zeros]:
            zeros += 1
        at += zeros
        others = 0
        while at + others < len(flat) and flat[at + others]:
            others += 1
        nibbles += nibbles_of(zeros) + nibbles_of(others)
        for value in flat[at : at + others]:
            change = value - previous
            nibbles += nibbles_of(2 * change if change >= 0 else -2 * change - 1)
            previous = value
        at += others
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{n:x}" for n in nibbles[k : k + 8]), 16) for k in range(0, len(nibbles), 8)]
    return struct.pack(f"<{len(words)}I", *words)


def message(payload: bytes, format: str, a: float = 0, b: float = 0) -> CompressedImage:
    return CompressedImage(Header(5), format, memoryview(struct.pack("<iff", 0, a, b) + payload))


def rvl(depth: NDArray[np.uint16]) -> bytes:
    h, w = depth.shape
    return struct.pack("<ii", w, h) + encoded(depth)


def holes(seed: int, h: int, w: int, top: int = 65535) -> NDArray[np.uint16]:
    random = np.random.default_rng(seed)
    depth = random.integers(1, top, (h, w)).astype(np.uint16)
    depth[random.random((h, w)) < 0.4] = 0
    return depth


def test_the_papers_code_by_hand() -> None:
    """0 0 5 4: two zeros, two others, +5 (zigzag 10: nibbles A and 1), -1 (zigzag 1)."""
    payload = struct.pack("<ii", 4, 1) + struct.pack("<I", 0x22A11000)
    assert stored_depth(message(payload, "16UC1; compressedDepth rvl"), "a").steps.tolist() == [[0, 0, 5, 4]]


@settings(max_examples=30)
@given(st.integers(0, 1 << 30), st.integers(1, 12), st.integers(1, 12), st.sampled_from([3, 300, 65535]))
def test_rvl_gives_back_what_was_coded(seed: int, h: int, w: int, top: int) -> None:
    depth = holes(seed, h, w, top)
    stored = stored_depth(message(rvl(depth), "16UC1; compressedDepth rvl"), "a")
    assert stored.inverse is None
    assert np.array_equal(stored.steps, depth)


@pytest.mark.parametrize("value", [0, 1, 65535])
def test_rvl_of_one_value(value: int) -> None:
    depth = np.full((48, 64), value, np.uint16)
    assert np.array_equal(stored_depth(message(rvl(depth), "16UC1; compressedDepth rvl"), "a").steps, depth)


@pytest.mark.parametrize("code", ["png", "rvl"])
def test_millimetres(code: str) -> None:
    depth = holes(3, 20, 30)
    payload = encode_png(depth) if code == "png" else rvl(depth)
    sent = message(payload, f"16UC1; compressedDepth {code}", a=float("nan"))  # not set for millimetres
    assert is_compressed_depth(sent)
    assert np.allclose(depth_of(sent, where="a"), depth / 1000, rtol=1e-6)
    assert np.array_equal(image_of(sent, "depth", stem="", where="a").pixels, depth)
    # thermal goes this way too: no other transport keeps 16 bits
    assert np.array_equal(image_of(sent, "fir", stem="", where="a").pixels, depth)
    with pytest.raises(FrameError, match="no rgb image"):
        image_of(sent, "rgb", stem="", where="a")


@pytest.mark.parametrize("code", ["png", "rvl"])
def test_metres_by_inverse_depth(code: str) -> None:
    """As ROS codes it: a = q (q + 1), b = 1 - a / depth_max, step = a / depth + b."""
    quantisation, depth_max = 100.0, 10.0
    a = quantisation * (quantisation + 1)
    b = 1 - a / depth_max
    depth_m = np.random.default_rng(2).uniform(0.5, 10, (20, 30))
    steps = (a / depth_m + b).astype(np.uint16)
    steps[:3] = 0
    payload = encode_png(steps) if code == "png" else rvl(steps)
    got = depth_of(message(payload, "32FC1; compressedDepth " + code, a, b), where="a")
    assert (got[:3] == 0).all()
    step_m = depth_m[3:] ** 2 / a
    assert (np.abs(got[3:] - depth_m[3:]) <= step_m * 1.2).all()
    with pytest.raises(FrameError, match="no fir image"):
        image_of(message(payload, "32FC1; compressedDepth", a, b), "fir", stem="", where="a")


@pytest.mark.parametrize(
    ("sent", "words"),
    [
        (message(b"", "16UC1; compressedDepth"), "12 bytes"),
        (message(b"abc", "16UC1; compressedDepth"), "no size"),
        (message(struct.pack("<ii", 1 << 20, 1 << 20) + bytes(99), "compressedDepth"), "1048576 x 1048576"),
        (
            message(struct.pack("<ii", 8000, 8000) + bytes(99), "compressedDepth"),
            "99 bytes claims 8000 x 8000",
        ),
        (message(struct.pack("<ii", -4, -4) + bytes(99), "compressedDepth"), "-4 x -4"),
        (message(rvl(holes(1, 9, 9))[:-8], "16UC1; compressedDepth rvl"), "damaged or cut off"),
        (message(struct.pack("<ii", 9, 9) + bytes(40), "compressedDepth"), "damaged or cut off"),  # runs of 0
        (message(struct.pack("<ii", 9, 9) + b"\xff" * 40, "compressedDepth"), "damaged or cut off"),
        (message(encode_png(np.zeros((4, 4), np.uint8)), "16UC1; compressedDepth"), "not 16-bit depth"),
        (message(encode_png(holes(1, 9, 9))[:60], "16UC1; compressedDepth png"), "a: "),
        (
            message(encode_png(holes(1, 9, 9)), "32FC1; compressedDepth", float("nan"), 0),
            "quantisation is none",
        ),
        (message(encode_png(holes(1, 9, 9)), "32FC1; compressedDepth", 0, 0), "quantisation is none"),
    ],
)
def test_what_is_damaged_is_refused(sent: CompressedImage, words: str) -> None:
    with pytest.raises(FrameError) as raised:
        depth_of(sent, where="a")
    assert words in str(raised.value)


@settings(max_examples=100)
@given(st.binary(max_size=200), st.integers(1, 40), st.integers(1, 40))
def test_any_code_is_read_as_the_plain_decoder_reads_it(code: bytes, w: int, h: int) -> None:
    expected = decoded(code, w * h)
    try:
        got = stored_depth(message(struct.pack("<ii", w, h) + code, "16UC1; compressedDepth rvl"), "a")
    except FrameError:
        assert expected is None or len(code) < w * h / 4096
    else:
        assert got.steps.ravel().tolist() == expected


def decoded(code: bytes, n: int) -> list[int] | None:
    """The plain decoder: None where the code is none for n pixels."""
    words = struct.unpack(f"<{len(code) // 4}I", code[: len(code) // 4 * 4])
    nibbles = iter([word >> shift & 15 for word in words for shift in range(28, -1, -4)])

    def number() -> int:
        value = 0
        for shift in range(0, 30, 3):
            nibble = next(nibbles)
            value |= (nibble & 7) << shift
            if nibble < 8:
                return value
        raise StopIteration

    out: list[int] = []
    previous = 0
    try:
        while len(out) < n:
            zeros, others = number(), number()
            if zeros + others == 0 or len(out) + zeros + others > n:
                return None
            out += [0] * zeros
            for _ in range(others):
                change = number()
                previous = (previous + ((change >> 1) ^ -(change & 1))) & 0xFFFF
                out.append(previous)
    except StopIteration:
        return None
    return out
