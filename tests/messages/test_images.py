"""What an image's numbers mean for a role: rgb, thermal, depth."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion.codecs import encode_jpeg, encode_png
from fusion.errors import FrameError
from fusion.messages.base import CompressedImage, Header, RawImage
from fusion.messages.images import depth_of, image_of
from fusion.messages.pixels import ENCODINGS, YUV

HEADER = Header(77, "camera")


def raw(pixels: np.ndarray, encoding: str, big: bool = False) -> RawImage:
    array = np.ascontiguousarray(pixels)
    array = array.astype(array.dtype.newbyteorder(">" if big else "<"))
    h, w = array.shape[:2]
    return RawImage(HEADER, w, h, encoding, big, array.strides[0], memoryview(array.tobytes()))


def compressed(data: bytes, format: str = "jpeg") -> CompressedImage:
    return CompressedImage(HEADER, format, memoryview(data))


def refused(message: RawImage | CompressedImage, role: str) -> str:
    with pytest.raises(FrameError) as raised:
        image_of(message, role, stem="s", where="/topic 5")  # type: ignore[arg-type]
    return str(raised.value)


COUNTS = np.arange(12, dtype=np.uint16).reshape(3, 4) * 5000
BGR = np.random.default_rng(0).integers(0, 255, (8, 8, 3), np.uint8)


def test_rgb_is_bgr_in_8_bits() -> None:
    image = image_of(raw(BGR[..., ::-1], "rgb8"), "rgb", stem="cam/7", where="a")
    assert np.array_equal(image.pixels, BGR)
    assert (image.stem, image.stamp_ns, image.flags) == ("cam/7", 77, ())
    wide = image_of(raw(BGR.astype(np.uint16) * 257, "bgr16", big=True), "rgb", stem="", where="a")
    assert np.array_equal(wide.pixels, BGR)
    assert wide.flags == ("rgb-16bit-to-8",)
    grey = image_of(raw(BGR[..., 0], "mono8"), "rgb", stem="", where="a")
    assert np.array_equal(grey.pixels, np.repeat(BGR[..., :1], 3, 2))
    assert grey.flags == ("rgb-grey",)
    alpha = np.dstack([BGR, np.full((8, 8), 9, np.uint8)])
    assert image_of(raw(alpha, "8UC4"), "rgb", stem="", where="a").flags == ("rgb-alpha-dropped",)


@pytest.mark.parametrize("encoding", ["8SC1", "16SC1", "32SC1", "32FC1", "64FC1"])
def test_numbers_are_no_rgb(encoding: str) -> None:
    dtype = ENCODINGS[encoding.lower()].dtype
    assert f"/topic 5: an image of the encoding '{encoding}' is no RGB" in refused(
        raw(COUNTS.astype(dtype), encoding), "rgb"
    )


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("encoding", ["mono16", "16UC1"])
def test_thermal_counts_stay(encoding: str, big: bool) -> None:
    message = raw(COUNTS, encoding, big)
    image = image_of(message, "fir", stem="", where="a")
    assert image.pixels.dtype == np.uint16
    assert np.array_equal(image.pixels, COUNTS)
    assert image.flags == ()
    assert not np.shares_memory(image.pixels, np.frombuffer(message.data, np.uint8))  # a chunk can go


@pytest.mark.parametrize("encoding", ["16SC1", "32SC1", "32FC1", "64FC1"])
def test_whole_numbers_of_other_types_are_counts(encoding: str) -> None:
    counts = COUNTS.clip(0, 32767)
    dtype = ENCODINGS[encoding.lower()].dtype
    image = image_of(raw(counts.astype(dtype), encoding), "fir", stem="", where="a")
    assert np.array_equal(image.pixels, counts)
    assert image.flags == (f"fir-from-{encoding.lower()}",)
    below = counts.astype(dtype)
    below[0, 0] = -1
    assert "outside 0 to 65535" in refused(raw(below, encoding), "fir") or "temperatures" in refused(
        raw(below, encoding), "fir"
    )


@pytest.mark.parametrize("value", [293.15, np.nan, np.inf, 65536.0])
def test_temperatures_in_floats_are_refused_with_the_way_out(value: float) -> None:
    text = refused(raw(np.full((3, 4), value, np.float32), "32FC1"), "fir")
    assert "a thermal image of 32FC1 with temperatures" in text
    assert "16UC1" in text


def test_coloured_thermal_is_refused_or_luma() -> None:
    assert "coloured" in refused(raw(BGR, "bgr8"), "fir")
    assert "mosaic" in refused(raw(BGR[..., 0], "bayer_rggb8"), "fir")
    grey = np.repeat(BGR[..., :1], 3, 2)
    image = image_of(raw(grey, "rgb8"), "fir", stem="", where="a")
    assert np.array_equal(image.pixels, BGR[..., 0])
    assert image.flags == ("fir-grey-stored-as-colour",)
    luma = image_of(raw(BGR, "bgr8"), "fir", stem="", where="a", fir_colour="luma")
    assert np.array_equal(luma.pixels, cv2.cvtColor(BGR, cv2.COLOR_BGR2GRAY))


def test_grey_yuv_thermal_keeps_its_luma() -> None:
    """BT.601 would stretch 16..235 and clip the rest: counts would be lost."""
    luma = np.arange(256, dtype=np.uint8).reshape(16, 16)
    yuyv = np.stack([luma, np.full_like(luma, 127)], -1)
    image = image_of(raw(yuyv, "yuv422_yuy2"), "fir", stem="", where="a")
    assert np.array_equal(image.pixels, luma)
    assert image.flags == ("fir-luma-of-yuv",)
    yuyv[0, 0, 1] = 140
    assert "coloured" in refused(raw(yuyv, "yuv422_yuy2"), "fir")


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "tiff"])
@pytest.mark.parametrize("format", ["jpeg", "rgb8; jpeg compressed bgr8", "png", "nonsense", ""])
def test_the_bytes_decide_and_not_the_word(suffix: str, format: str) -> None:
    smooth = cv2.resize(BGR, (64, 64), interpolation=cv2.INTER_CUBIC)
    data = cv2.imencode(f".{suffix}", smooth, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
    image = image_of(compressed(data, format), "rgb", stem="", where="a")
    error = np.abs(image.pixels.astype(int) - smooth).mean()
    assert error < 4 if suffix == "jpg" else error == 0


def test_compressed_thermal() -> None:
    image = image_of(compressed(encode_png(COUNTS), "mono16; png compressed "), "fir", stem="", where="a")
    assert np.array_equal(image.pixels, COUNTS)
    assert image.stamp_ns == 77


@pytest.mark.parametrize("data", [b"", b"\0\0\0\1h264", encode_jpeg(BGR, 90)[:60], encode_png(BGR)[:-20]])
def test_damaged_pictures_are_refused(data: bytes) -> None:
    assert refused(compressed(data), "rgb").startswith("/topic 5: ")


# --- depth


@pytest.mark.parametrize("encoding", ["16UC1", "mono16"])
def test_depth_in_millimetres(encoding: str) -> None:
    depth_m = depth_of(raw(COUNTS, encoding, big=True), where="a")
    assert depth_m.dtype == np.float32
    assert np.allclose(depth_m, COUNTS / 1000, rtol=1e-6)
    assert np.array_equal(image_of(raw(COUNTS, encoding), "depth", stem="", where="a").pixels, COUNTS)
    assert np.array_equal(depth_of(compressed(encode_png(COUNTS)), where="a"), depth_m)


@pytest.mark.parametrize("encoding", ["32FC1", "64FC1"])
@pytest.mark.parametrize("big", [False, True])
def test_depth_in_metres(encoding: str, big: bool) -> None:
    sent = np.array([[1.5, 0, -2, np.nan], [np.inf, -np.inf, 70.0, 0.0124]])
    message = raw(sent.astype(ENCODINGS[encoding.lower()].dtype), encoding, big)
    before = bytes(message.data)
    depth_m = depth_of(message, where="a")
    assert depth_m.tolist() == np.array([[1.5, 0, 0, 0], [0, 0, 70.0, 0.0124]], np.float32).tolist()
    assert bytes(message.data) == before
    image = image_of(message, "depth", stem="", where="a")
    assert image.pixels.tolist() == [[1500, 0, 0, 0], [0, 0, 0, 12]]
    assert image.flags == ("depth-beyond-65m",)


@pytest.mark.parametrize("message", [raw(BGR, "bgr8"), raw(COUNTS, "16SC1"), compressed(encode_png(BGR))])
def test_what_is_no_depth_is_refused(message: RawImage | CompressedImage) -> None:
    assert "is no depth" in refused(message, "depth")


# --- all of it at random


@settings(max_examples=60)
@given(
    st.sampled_from([*ENCODINGS, *YUV, "?"]),
    *(st.integers(0, 9) for _ in range(2)),
    st.integers(0, 80),
    st.binary(max_size=300),
    st.booleans(),
    st.sampled_from(["rgb", "fir", "depth"]),
)
def test_any_image_is_read_or_refused(
    encoding: str, w: int, h: int, step: int, data: bytes, big: bool, role: str
) -> None:
    message = RawImage(HEADER, w, h, encoding, big, step, data)
    try:
        image = image_of(message, role, stem="", where="a")  # type: ignore[arg-type]
    except FrameError:
        return
    assert image.size_wh == (w, h)
