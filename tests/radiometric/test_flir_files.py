"""Radiometric JPEGs in every form: made here with known content, damaged, and of other kinds."""

from __future__ import annotations

import random
import struct
from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fusion.errors import FrameError
from fusion.radiometric import PictureInPicture, read_flir
from fusion.radiometric.flir import Holds, flir_in, glance, read_planck
from tests.radiometric import flirfile as made

COUNTS, SCENE = made.ramp(), made.scene()


def records(coding: made.Coding = "raw", order: str = "<") -> list[tuple[int, bytes]]:
    return [(made.RAW, made.raw_record(COUNTS, coding, order)), (made.CAMERA, made.camera_record(order))]


@pytest.mark.parametrize("magic", [b"FFF\x00", b"AFF\x00"])
@pytest.mark.parametrize("header", ["<", ">"])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("coding", ["raw", "png", "swapped-png"])
def test_counts_and_constants_in_every_form(
    coding: made.Coding, order: str, header: str, magic: bytes
) -> None:
    data = made.jpeg(made.parts(made.block(records(coding, order), header, magic)))
    image = read_flir(data, "a.jpg")
    assert image.counts.dtype == np.uint16
    assert image.counts.dtype.isnative
    assert np.array_equal(image.counts, COUNTS)
    for name, value in asdict(image.planck).items():
        assert value == pytest.approx(made.CONSTANTS[name], rel=1e-6), name
    assert (image.model, image.serial, image.lens) == ("FLIR T0", "serial 7", "FOL9")
    assert (image.visible_bgr, image.pip, image.stamp_ns) == (None, None, None)
    assert read_planck(data, "a.jpg") == image.planck


def test_degrees_of_a_file_are_those_of_its_constants() -> None:
    image = read_flir(made.flir_jpeg(), "a.jpg")
    assert np.array_equal(image.celsius(), image.planck.celsius(COUNTS))
    assert image.counts_at(float(image.celsius()[3, 5])) == pytest.approx(COUNTS[3, 5], abs=1e-2)


def test_humidity_in_percent() -> None:
    assert read_flir(made.flir_jpeg(humidity=49.0), "").planck.humidity == pytest.approx(0.49)


def test_the_cameras_clock() -> None:
    stamp = 1_504_879_476_266_000_000
    assert read_flir(made.flir_jpeg(stamp_ns=stamp), "").stamp_ns == stamp


@settings(max_examples=30)
@given(st.integers(0, 2**32), st.integers(200, 5000))
def test_parts_in_any_order_among_other_segments(seed: int, size: int) -> None:
    rng = random.Random(seed)
    segments = made.parts(made.block(records()), size)
    segments += [made.segment(0xE0, b"JFIF\x00"), made.segment(0xE1, b"Exif\x00\x00II"), b"\xff" * 3]
    rng.shuffle(segments)
    while segments[-1] == b"\xff" * 3:  # fill bytes stand in front of a marker
        rng.shuffle(segments)
    assert np.array_equal(read_flir(made.jpeg(segments), "").counts, COUNTS)


def test_a_bare_block() -> None:
    assert np.array_equal(read_flir(made.block(records()), "a.fff").counts, COUNTS)


def embedded(payload: bytes, order: str = "<") -> bytes:
    more = (made.EMBEDDED, made.image_record(payload, (48, 36), order))
    return made.jpeg(made.parts(made.block([*records(), more])))


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_visible_image_as_jpeg(order: str) -> None:
    visible = read_flir(embedded(made.jpg(SCENE), order), "").visible_bgr
    assert visible is not None
    assert visible.dtype == np.uint8
    assert np.abs(visible.astype(int) - SCENE).max() < 12
    assert np.abs(visible.astype(int) - SCENE).mean() < 2


def ycbcr(bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """ITU-R BT.601, full range: as a PNG's red, green and blue, so here in the order Cr, Cb, Y."""
    b, g, r = (bgr[..., k].astype(float) for k in range(3))
    y = 0.299 * r + 0.587 * g + 0.114 * b
    channels = ((r - y) / 1.402 + 128, (b - y) / 1.772 + 128, y)
    return np.clip(np.rint(np.stack(channels, -1)), 0, 255).astype(np.uint8)


def test_the_visible_image_as_png_of_luma_and_chroma() -> None:
    visible = read_flir(embedded(made.png(ycbcr(SCENE))), "").visible_bgr
    assert visible is not None
    assert np.abs(visible.astype(int) - SCENE).max() <= 2


def test_a_grey_visible_image() -> None:
    visible = read_flir(embedded(made.png(SCENE[..., 1])), "").visible_bgr
    assert visible is not None
    assert (visible == SCENE[..., 1:2]).all()


def test_the_visible_image_is_left_alone_where_not_wanted() -> None:
    assert read_flir(embedded(b"DAT: unknown pixels"), "", visible=False).visible_bgr is None
    with pytest.raises(FrameError, match="neither JPEG nor PNG"):
        read_flir(embedded(b"DAT: unknown pixels"), "a.jpg")


@pytest.mark.parametrize("size", ["whole", "short", "ratio"])
def test_picture_in_picture(size: str) -> None:
    record = {"whole": made.pip_record(), "short": b"\x00" * 6, "ratio": made.pip_record(float("nan"))}[size]
    pip = read_flir(made.jpeg(made.parts(made.block([*records(), (made.PIP, record)]))), "").pip
    assert pip == (PictureInPicture(float(np.float32(1.4)), (14, -14)) if size == "whole" else None)


def test_the_first_of_two_records_of_a_kind_counts() -> None:
    other = (made.RAW, made.raw_record(made.ramp(start=20000)))
    data = made.jpeg(made.parts(made.block([*records(), other])))
    assert np.array_equal(read_flir(data, "").counts, COUNTS)


# --- what is refused


def cut(data: bytes, at: int, value: bytes) -> bytes:
    return data[:at] + value + data[at + len(value) :]


BLOCK = made.block(records())
RAW_AT = 64 + 32 * 4
BAD_BLOCKS = {
    "begin": (b"XXX\x00" + BLOCK[4:], "do not begin"),
    "short": (BLOCK[:40], "do not begin"),
    "version": (cut(BLOCK, 0x14, struct.pack(">I", 7)), "unknown version 7"),
    "directory": (cut(BLOCK, 0x18, struct.pack(">I", 1 << 30)), "claims 4 records from byte 1073741824"),
    "count": (cut(BLOCK, 0x1C, struct.pack(">I", 0xFFFFFFFF)), "claims 4294967295 records"),
    "records": (made.block(records(), free=1100), "claims 1102 records"),
    "offset": (cut(BLOCK, 64 + 12, struct.pack(">I", 0xFFFFFFF0)), "record 0x01 .* claims"),
    "length": (cut(BLOCK, 64 + 16, struct.pack(">I", 0xFFFFFFFF)), "record 0x01 .* claims"),
    "no-raw": (made.block(records()[1:]), "no thermal counts"),
    "no-camera": (made.block(records()[:1]), "no camera constants"),
    "raw-head": (made.block([(made.RAW, b"\x02\x00"), records()[1]]), "too short"),
    "raw-size": (cut(BLOCK, RAW_AT + 2, struct.pack("<HH", 0, 24)), "claim 0 x 24 pixels"),
    "raw-large": (cut(BLOCK, RAW_AT + 2, struct.pack("<HH", 65535, 65535)), "claim 65535 x 65535"),
    "raw-truncated": (
        cut(BLOCK, RAW_AT + 2, struct.pack("<HH", 33, 24)),
        "bytes of thermal data for 33 x 24",
    ),
    "camera-short": (made.block([records()[0], (made.CAMERA, made.camera_record()[:700])]), "only 700 bytes"),
    "emissivity": (
        made.block([records()[0], (made.CAMERA, made.camera_record(emissivity=0))]),
        "emissivity is 0",
    ),
    "nan": (made.block([records()[0], (made.CAMERA, made.camera_record(b=float("nan")))]), "b is nan"),
}


@pytest.mark.parametrize("name", BAD_BLOCKS)
def test_a_damaged_block_is_named(name: str) -> None:
    data, words = BAD_BLOCKS[name]
    with pytest.raises(FrameError, match=words) as raised:
        read_flir(made.jpeg(made.parts(data)), "dir/a.jpg")
    assert str(raised.value).startswith("dir/a.jpg: ")
    assert raised.value.hint or name == "version"


def png_head(width: int, height: int) -> bytes:
    """A PNG that claims a size and holds next to nothing."""
    whole = made.png(np.zeros((2, 2), np.uint16))
    return cut(whole, 16, struct.pack(">II", width, height))


@pytest.mark.parametrize(
    ("payload", "words"),
    [
        (png_head(60000, 60000), "more than the limit"),
        (made.png(np.zeros((5, 6), np.uint16)), "thermal PNG is .* 32 x 24"),
        (made.png(np.zeros((24, 32), np.uint8)), "thermal PNG is"),
        (made.png(COUNTS)[:300], "truncated|corrupt"),
    ],
    ids=["bomb", "size", "8-bit", "cut"],
)
def test_a_thermal_png_that_is_none(payload: bytes, words: str) -> None:
    raw = struct.pack("<HHH26x", 2, 32, 24) + payload
    data = made.jpeg(made.parts(made.block([(made.RAW, raw), records()[1]])))
    with pytest.raises(FrameError, match=words):
        read_flir(data, "a.jpg")


def test_a_visible_image_beyond_the_limit() -> None:
    with pytest.raises(FrameError, match=r"visible image.*more than the limit"):
        read_flir(embedded(png_head(60000, 60000)), "a.jpg")
    with pytest.raises(FrameError, match="thermal data claim 32 x 24"):
        read_flir(made.flir_jpeg(), "a.jpg", max_pixels=100)


def test_parts_that_are_missing_or_twice() -> None:
    pieces = made.parts(BLOCK)
    with pytest.raises(FrameError, match=r"1 of .* parts .* missing, the first number 2"):
        read_flir(made.jpeg(pieces[:2] + pieces[3:]), "a.jpg")
    with pytest.raises(FrameError, match=r"part 1 .* twice"):
        read_flir(made.jpeg([*pieces, pieces[1]]), "a.jpg")
    beyond = pieces[1].replace(b"FLIR\x00\x01\x01", b"FLIR\x00\x01\xfa")
    with pytest.raises(FrameError, match=r"part 250 .* contradicts"):
        read_flir(made.jpeg([*pieces, beyond]), "a.jpg")
    other = made.parts(BLOCK, 2000)[1]
    with pytest.raises(FrameError, match="contradicts"):
        read_flir(made.jpeg([*pieces[:1], other, *pieces[2:]]), "a.jpg")


def test_a_file_cut_off_among_its_segments() -> None:
    data = made.flir_jpeg()
    for size in range(1, 3000, 131):
        with pytest.raises(FrameError):
            read_flir(data[:size], "a.jpg")


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (made.jpg(SCENE), "a plain JPEG, without FLIR"),
        (made.png(SCENE), "no JPEG"),
        (b"", "no JPEG"),
        (made.jpeg([made.segment(0xE3, bytes(60000))] * 3), "a plain JPEG"),
        (made.dji_jpeg(), "DJI's own radiometric JPEG .* DJI's Thermal SDK .* TIFF"),
    ],
    ids=["jpeg", "png", "empty", "app3", "dji"],
)
def test_other_files_say_what_they_are(data: bytes, words: str) -> None:
    with pytest.raises(FrameError, match=words):
        read_flir(data, "a.jpg")


def test_a_glance_tells_what_a_file_holds() -> None:
    assert glance(made.flir_jpeg()) == Holds(counts=True, visible=False)
    assert glance(made.flir_jpeg(visible=SCENE)[:900]) == Holds(counts=True, visible=True)
    visible = made.block([records()[1], (made.EMBEDDED, made.image_record(made.jpg(SCENE), (48, 36)))])
    assert glance(made.jpeg(made.parts(visible))) == Holds(counts=False, visible=True)
    shuffled = made.parts(made.block(records()))[::-1]
    assert glance(made.jpeg(shuffled)) == Holds(counts=True, visible=False)
    assert glance(made.jpeg(shuffled[:1])) == Holds(counts=True, visible=True)  # its beginning is farther on
    with pytest.raises(FrameError, match="are missing"):
        flir_in(made.jpeg(shuffled[:1]), "a.jpg", 1 << 20)
    assert glance(made.jpg(SCENE)) is None
    assert glance(made.dji_jpeg()) is None
    assert glance(made.jpeg(made.parts(b"XXX\x00" + BLOCK[4:]))) == Holds(counts=True, visible=True)


# --- anything at all


@settings(max_examples=60)
@given(st.data())
def test_mutated_files_are_read_or_refused(data: st.DataObject) -> None:
    form = data.draw(st.sampled_from(["raw", "swapped-png", "block"]))
    whole = BLOCK if form == "block" else made.flir_jpeg(visible=SCENE, coding=form)  # type: ignore[arg-type]
    content = bytearray(whole)
    places = st.integers(0, len(content) - 1) | st.integers(0, 400)
    for place in data.draw(st.lists(places, min_size=1, max_size=12)):
        content[place] = data.draw(st.integers(0, 255))
    content = content[: data.draw(st.integers(0, len(content)) | st.just(len(content)))]
    glance(bytes(content))
    try:
        image = read_flir(bytes(content), "a.jpg")
    except FrameError:
        return
    assert image.counts.ndim == 2
    assert image.celsius().shape == image.counts.shape
