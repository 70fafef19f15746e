"""Image bytes to arrays and back: oracles are Pillow, hand-built files and the arrays themselves."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import simplejpeg
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image as Pillow

from fusion import codecs, png16
from fusion.codecs import decode_image, encode_jpeg, encode_png
from fusion.errors import FrameError

SIZES = [(1, 1), (1, 37), (37, 1), (3, 5), (479, 641)]
KINDS = {
    "grey8": ((), np.uint8),
    "grey16": ((), np.uint16),
    "bgr": ((3,), np.uint8),
    "bgra": ((4,), np.uint8),
}


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(width: int, height: int, bits: int, colour: int, rows: bytes, before: bytes = b"") -> bytes:
    """A PNG by the letter of its specification; `rows` with their filter bytes."""
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + before + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def tiff(size: tuple[int, int], samples: int, bits: int, body: bytes, **tags: int) -> bytes:
    """An uncompressed little-endian TIFF with one strip; `tags` by number, as t338=1."""
    width, height = size
    entries = {256: width, 257: height, 259: 1, 262: 2 if samples > 2 else 1, 277: samples, 278: height}
    entries |= {279: len(body), 284: 1} | {int(name[1:]): value for name, value in tags.items()}
    kinds = entries.pop(339, 1)
    count = len(entries) + 3
    after = 8 + 2 + 12 * count + 4
    arrays = struct.pack("<4H", *[bits] * 4) + struct.pack("<4H", *[kinds] * 4)
    rows = [(tag, 4, 1, value) for tag, value in entries.items()]
    rows.append((273, 4, 1, after + len(arrays)))
    for tag, value, at in ((258, bits, after), (339, kinds, after + 8)):
        rows.append((tag, 3, samples, value if samples == 1 else value << 16 | value if samples == 2 else at))
    packed = b"".join(struct.pack("<HHII", *row) for row in sorted(rows))
    return b"II*\0" + struct.pack("<IH", 8, count) + packed + bytes(4) + arrays + body


def bmp(pixels: np.ndarray, packing: int = 0) -> bytes:
    """A bottom-up 24-bit BMP."""
    height, width = pixels.shape[:2]
    rows = b"".join(row.tobytes().ljust((width * 3 + 3) // 4 * 4, b"\0") for row in pixels[::-1])
    head = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 24, packing, len(rows), 0, 0, 0, 0)
    return b"BM" + struct.pack("<IHHI", 54 + len(rows), 0, 0, 54) + head + rows


def by_pillow(pixels: np.ndarray, kind: str, **options: object) -> bytes:
    order = pixels if pixels.ndim == 2 else pixels[:, :, [2, 1, 0, 3][: pixels.shape[2]]]
    out = io.BytesIO()
    Pillow.fromarray(np.ascontiguousarray(order)).save(out, kind, **options)
    return out.getvalue()


def by_opencv(data: bytes) -> np.ndarray:
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    return pixels


def noise(size: tuple[int, int], channels: tuple[int, ...], dtype: type, seed: int = 0) -> np.ndarray:
    top = np.iinfo(dtype).max
    return np.random.default_rng(seed).integers(0, top, (*size, *channels), dtype, endpoint=True)


def ramp(channels: tuple[int, ...] = (), dtype: type = np.uint8) -> np.ndarray:
    """A smooth 40 x 60 picture with a little noise: what lossy and lossless coders are made for."""
    rows, columns = np.mgrid[0:40, 0:60]
    steps = [rows * 3 + columns, columns * 4, 250 - rows * 2, rows + 90][: (channels or (1,))[0]]
    picture = np.dstack(steps) + np.random.default_rng(3).integers(0, 4, (40, 60, len(steps)))
    scaled = picture.astype(dtype) * (1 if dtype is np.uint8 else 200)
    return np.squeeze(scaled).astype(dtype)


def same(pixels: np.ndarray, expected: np.ndarray) -> bool:
    return (
        pixels.dtype == expected.dtype and pixels.shape == expected.shape and bool((pixels == expected).all())
    )


# PNG out


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("content", ["noise", "constant"])
@pytest.mark.parametrize("encoder", ["fpng", "opencv"])
def test_png_is_exact_for_every_reader(kind, size, content, encoder, monkeypatch) -> None:
    if encoder == "opencv":
        monkeypatch.setattr(codecs, "fpng", None)
    channels, dtype = KINDS[kind]
    pixels = noise(size, channels, dtype)
    if content == "constant":
        pixels[:] = pixels[0, 0]
    before = pixels.copy()
    data = encode_png(pixels)
    assert same(pixels, before)
    assert same(by_opencv(data), pixels)
    assert same(decode_image(data, "x"), pixels)
    read = np.asarray(Pillow.open(io.BytesIO(data)))
    if pixels.ndim == 3:
        read = read[:, :, [2, 1, 0, 3][: pixels.shape[2]]]
    assert (read == pixels).all()


@given(
    st.integers(1, 40), st.integers(1, 40), st.sampled_from([3, 4]), st.integers(0, 2**32 - 1), st.booleans()
)
@settings(max_examples=40, deadline=None)
def test_colour_png_round_trips_at_any_size(height, width, channels, seed, flat) -> None:
    pixels = noise((height, width), (channels,), np.uint8, seed)
    pixels = pixels // 200 if flat else pixels  # few values: long runs for the encoder
    assert same(decode_image(encode_png(pixels), "x"), pixels)


def test_png_of_a_view_is_that_of_its_copy() -> None:
    pixels = noise((30, 40), (3,), np.uint8)
    assert encode_png(pixels[3:20, 5:31]) == encode_png(pixels[3:20, 5:31].copy())


# JPEG


def test_jpeg_is_close_and_larger_quality_is_closer() -> None:
    bgr = ramp((3,))
    errors = []
    for quality in (30, 90, 95, 100):
        read = by_opencv(encode_jpeg(bgr, quality))
        errors.append(float(np.abs(read.astype(int) - bgr).mean()))
    assert errors == sorted(errors, reverse=True)
    assert errors[1] < 3
    assert errors[-1] < 1


def test_jpeg_keeps_whole_chroma_from_95_on() -> None:
    assert simplejpeg.decode_jpeg_header(encode_jpeg(ramp((3,)), 94))[3] == "420"
    assert simplejpeg.decode_jpeg_header(encode_jpeg(ramp((3,)), 95))[3] == "444"


@pytest.mark.parametrize("quality", [0, 101, -5])
def test_jpeg_quality_out_of_range(quality) -> None:
    with pytest.raises(ValueError, match="1 to 100"):
        encode_jpeg(ramp((3,)), quality)


def test_jpeg_decodes_as_pillow_does() -> None:
    for pixels in (ramp(), ramp((3,))):
        data = by_pillow(pixels, "JPEG", quality=92, subsampling=0)
        expected = np.asarray(Pillow.open(io.BytesIO(data))).astype(int)
        read = decode_image(data, "x")
        assert read.ndim == pixels.ndim
        read = read if read.ndim == 2 else read[:, :, ::-1]
        assert np.abs(read.astype(int) - expected).max() <= 1


def test_jpeg_orientation_is_not_applied() -> None:
    exif = Pillow.Exif()
    exif[274] = 6
    assert decode_image(by_pillow(ramp((3,)), "JPEG", exif=exif), "x").shape == (40, 60, 3)


def test_cmyk_jpeg_is_refused() -> None:
    out = io.BytesIO()
    Pillow.new("CMYK", (8, 8)).save(out, "JPEG")
    with pytest.raises(FrameError, match="CMYK"):
        decode_image(out.getvalue(), "x")


# what is stored is what comes out


@pytest.mark.parametrize("kind", KINDS)
def test_lossless_files_of_pillow_decode_exactly(kind) -> None:
    pixels = noise((13, 17), *KINDS[kind])
    files = {"PNG": [{}], "TIFF": [{"compression": c} for c in ("raw", "tiff_lzw", "tiff_adobe_deflate")]}
    if pixels.dtype == np.uint8:
        files |= (
            {"WEBP": [{"lossless": True, "exact": True}]} if pixels.ndim == 3 else {"PPM": [{}], "BMP": [{}]}
        )
    for name, options in files.items():
        for option in options:
            assert same(decode_image(by_pillow(pixels, name, **option), name), pixels), (name, option)


def test_bmp_both_ways_up() -> None:
    pixels = noise((5, 7), (3,), np.uint8)
    data = bmp(pixels)
    assert same(decode_image(data, "x"), pixels)
    upside = data[:22] + struct.pack("<i", -5) + data[26:]
    assert same(decode_image(upside, "x"), pixels[::-1])


def test_sixteen_bit_colour_of_every_container() -> None:
    pixels = noise((6, 4), (3,), np.uint16)
    rgb = pixels[:, :, ::-1]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in rgb)
    assert same(decode_image(png(4, 6, 16, 2, rows), "x"), pixels)
    assert same(decode_image(tiff((4, 6), 3, 16, rgb.astype("<u2").tobytes()), "x"), pixels)
    assert same(decode_image(b"P6\n4 6\n65535\n" + rgb.astype(">u2").tobytes(), "x"), pixels)


@pytest.mark.parametrize("extra", [0, 1, 2])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_fourth_tiff_channel_is_kept_and_not_multiplied(extra, dtype) -> None:
    pixels = noise((5, 6), (4,), dtype)
    pixels[0, :, 3] = 0
    body = pixels[:, :, [2, 1, 0, 3]].astype(np.dtype(dtype).newbyteorder("<")).tobytes()
    data = tiff((6, 5), 4, np.dtype(dtype).itemsize * 8, body, t338=extra)
    assert same(decode_image(data, "x"), pixels)


@pytest.mark.parametrize("compression", ["raw", "tiff_lzw"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_tiff_orientation_is_not_applied(orientation, compression) -> None:
    pixels = noise((4, 7), (), np.uint16)
    exif = Pillow.Exif()
    exif[274] = orientation
    assert same(decode_image(by_pillow(pixels, "TIFF", exif=exif, compression=compression), "x"), pixels)


def test_turned_tiff_of_16_bit_colour_stays_as_stored() -> None:
    pixels = noise((3, 5), (3,), np.uint16)
    data = tiff((5, 3), 3, 16, pixels[:, :, ::-1].astype("<u2").tobytes(), t274=6)
    assert same(decode_image(data, "x"), pixels)


def test_twelve_bit_tiff_counts_are_not_scaled() -> None:
    data = tiff((2, 1), 1, 12, bytes([0x12, 0x3F, 0xFF]))
    assert decode_image(data, "x").tolist() == [[0x123, 0xFFF]]


def test_big_endian_tiff() -> None:
    pixels = noise((3, 4), (), np.uint16)
    data = bytearray(tiff((4, 3), 1, 16, b""))
    count = struct.unpack_from("<H", data, 8)[0]
    rows = [struct.unpack_from("<HHII", data, 10 + 12 * i) for i in range(count)]
    body = pixels.astype(">u2").tobytes()
    packed = b"".join(
        struct.pack(">HHI", tag, kind, number)
        + (
            struct.pack(">HH", value, 0)
            if kind == 3
            else struct.pack(">I", len(body) if tag == 279 else value)
        )
        for tag, kind, number, value in rows
    )
    swapped = b"MM\0*" + struct.pack(">IH", 8, count) + packed + bytes(data[10 + 12 * count :]) + body
    assert same(decode_image(swapped, "x"), pixels)


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"P5 # made by hand\n# 12\n3 1\n127\n\x00\x3f\x7f", [[0, 63, 127]]),
        (b"P5\n3 1\n1023\n" + struct.pack(">3H", 0, 500, 1023), [[0, 500, 1023]]),
        (b"P5\n2 1\n255\n\x0a\x20", [[10, 32]]),  # pixels that look like white space
        (b"P2\n3 1\n1023\n0 500 1023\n", [[0, 500, 1023]]),
        (b"P2\n3 1\n100 # top\n0 50 # half\n 100", [[0, 50, 100]]),
        (b"P3\n1 1\n255\n1 2 3\n", [[[3, 2, 1]]]),
    ],
)
def test_pnm_values_are_those_stored(data, expected) -> None:
    pixels = decode_image(data, "x")
    assert pixels.tolist() == expected
    assert pixels.dtype == (np.uint16 if b"1023" in data else np.uint8)
    assert pixels.dtype.isnative


@pytest.mark.parametrize("top", [100, 255, 256, 1023, 65535])
def test_pgm_text_and_binary_agree(top) -> None:
    values = np.random.default_rng(top).integers(0, top, (4, 5), endpoint=True)
    text = f"P2 5 4 {top}\n".encode() + " ".join(map(str, values.ravel())).encode()
    binary = f"P5 5 4 {top}\n".encode() + values.astype(np.uint8 if top < 256 else ">u2").tobytes()
    assert decode_image(text, "x").tolist() == decode_image(binary, "x").tolist() == values.tolist()


PALETTE = chunk(b"PLTE", bytes([10, 20, 30, 40, 50, 60]))


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (png(8, 1, 1, 0, b"\0\xa5"), [[255, 0, 255, 0, 0, 255, 0, 255]]),
        (png(4, 1, 2, 0, b"\0\x1b"), [[0, 85, 170, 255]]),
        (png(2, 1, 1, 3, b"\0\x40", PALETTE), [[[30, 20, 10], [60, 50, 40]]]),
        (
            png(2, 1, 8, 3, b"\0\0\1", PALETTE + chunk(b"tRNS", b"\x05")),
            [[[30, 20, 10, 5], [60, 50, 40, 255]]],
        ),
        (png(1, 1, 16, 4, b"\0\x10\x20\x30\x40"), [[[0x1020, 0x1020, 0x1020, 0x3040]]]),
        (png(1, 1, 16, 0, b"\0\1\2", chunk(b"gAMA", struct.pack(">I", 100000))), [[0x102]]),
        (png(1, 1, 16, 0, b"\0\1\2", chunk(b"sBIT", b"\x0c")), [[0x102]]),
        (png(1, 1, 8, 6, b"\0\1\2\3\0"), [[[3, 2, 1, 0]]]),
    ],
)
def test_unusual_png(data, expected) -> None:
    assert decode_image(data, "x").tolist() == expected


def test_png_metadata_neither_harms_nor_speaks(capfd) -> None:
    profile = chunk(b"iCCP", b"x\0\0" + zlib.compress(b"junk" * 40))
    spoilt = chunk(b"tEXt", b"a\0b")[:-1] + b"\0"
    data = png(1, 1, 8, 3, b"\0\1", profile + PALETTE + chunk(b"eXIf", b"nonsense") + spoilt)
    assert decode_image(data, "x").tolist() == [[[60, 50, 40]]]
    assert capfd.readouterr() == ("", "")


def test_bytes_after_the_end_of_a_png_are_harmless() -> None:
    pixels = noise((4, 4), (3,), np.uint8)
    assert same(decode_image(encode_png(pixels) + b"trailer", "x"), pixels)


# what is not whole never comes out


def whole_files() -> dict[str, bytes]:
    grey, bgr, counts = ramp(), ramp((3,)), ramp((), np.uint16)
    webp = cv2.imencode(".webp", bgr, [cv2.IMWRITE_WEBP_QUALITY, 80])[1].tobytes()
    # a text file cut inside its very last number cannot be told from a whole one: one digit there
    text = b"P2 60 40 255\n" + b" ".join(b"%d" % v for v in [*grey.ravel()[:-1], 7])
    return {
        "png8": by_pillow(grey, "PNG"),
        "png24": encode_png(bgr),
        "png16": encode_png(counts),
        "jpeg": encode_jpeg(bgr, 90),
        "jpeg grey": by_pillow(grey, "JPEG"),
        "jpeg progressive": by_pillow(bgr, "JPEG", progressive=True),
        "tiff raw": by_pillow(counts, "TIFF"),
        "tiff lzw": by_pillow(counts, "TIFF", compression="tiff_lzw"),
        "tiff deflate": by_pillow(bgr, "TIFF", compression="tiff_adobe_deflate"),
        "tiff rgb16": tiff((60, 40), 3, 16, ramp((3,), np.uint16).tobytes()),
        "bmp": bmp(bgr),
        "bmp grey": by_pillow(grey, "BMP"),
        "webp": webp,
        "webp lossless": by_pillow(bgr, "WEBP", lossless=True),
        "pgm": by_pillow(grey, "PPM"),
        "pgm16": b"P5 60 40 65535\n" + counts.astype(">u2").tobytes(),
        "pgm text": text,
        "ppm": by_pillow(bgr, "PPM"),
    }


FILES = whole_files()


@pytest.mark.parametrize("name", FILES)
def test_no_truncated_file_gives_a_partial_image(name, capfd) -> None:
    data = FILES[name]
    full = decode_image(data, name)
    cuts = {
        *range(0, len(data) - 1, max(1, len(data) // 25)),
        *range(1, 45),
        *range(len(data) - 6, len(data)),
    }
    refused = []
    for cut in sorted(cuts):
        try:
            pixels = decode_image(data[:cut], name)
        except FrameError as error:
            refused.append(str(error))
        else:
            # the very end of a file may hold nothing of the picture
            assert same(pixels, full), f"{name} cut to {cut} of {len(data)} bytes"
    assert len(refused) >= len(cuts) - 6
    assert all(text.startswith(f"{name}: ") for text in refused)
    if "tiff" not in name:  # libtiff speaks to the terminal whoever calls it
        assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", FILES)
def test_flipped_bits_never_end_in_another_error(name) -> None:
    data, generator = FILES[name], np.random.default_rng(11)
    full, differing = decode_image(data, name), 0
    for at in [*generator.integers(0, 64, 25), *generator.integers(0, len(data), 20)]:
        broken = bytearray(data)
        broken[at] ^= 1 << int(generator.integers(8))
        try:
            differing += not same(decode_image(bytes(broken), name, 10**6), full)
        except FrameError:
            continue
    if name.startswith("png"):  # the one format here whose every byte is guarded by a checksum
        assert differing == 0


def test_damaged_deflate_tiff_is_refused() -> None:
    """OpenCV returns what it has decoded of such a file and only logs."""
    data = bytearray(FILES["tiff deflate"])
    data[len(data) // 2] ^= 0x10
    with pytest.raises(FrameError, match="corrupt"):
        decode_image(bytes(data), "x")


@pytest.mark.parametrize("data", [b"", b"\0", b"hello", b"GIF89a" + bytes(40), b"II*\0", b"P7\n", bytes(100)])
def test_what_is_no_image(data) -> None:
    with pytest.raises(FrameError) as caught:
        decode_image(data, "some name.png")
    assert str(caught.value).startswith("some name.png: ")


def test_empty_file_is_named_so() -> None:
    with pytest.raises(FrameError, match="empty"):
        decode_image(b"", "a.png")


def huge_files() -> dict[str, bytes]:
    side = 100_000
    jpeg = bytearray(encode_jpeg(ramp((3,)), 90))
    at = jpeg.index(b"\xff\xc0\x00\x11")
    jpeg[at + 5 : at + 9] = struct.pack(">HH", 65500, 65500)
    webp = bytearray(by_pillow(ramp((3,)), "WEBP", lossless=True))
    webp[21:25] = (16382 | 16382 << 14).to_bytes(4, "little")
    lossy = bytearray(cv2.imencode(".webp", ramp((3,)), [cv2.IMWRITE_WEBP_QUALITY, 80])[1].tobytes())
    lossy[26:30] = struct.pack("<HH", 16382, 16382)
    wide = bmp(ramp((3,)))
    return {
        "png": png(side, side, 8, 2, b"\0"),
        "jpeg": bytes(jpeg),
        "tiff": tiff((side, side), 1, 8, b"\0"),
        "bmp": wide[:18] + struct.pack("<ii", side, -side) + wide[26:],
        "webp": bytes(webp),
        "webp lossy": bytes(lossy),
        "pgm": b"P5 100000 100000 255\n\0",
    }


@pytest.mark.parametrize("name", huge_files())
def test_claimed_size_is_refused_before_memory_is_taken(name) -> None:
    import resource

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(FrameError, match=r"(100000 x 100000|65500 x 65500|1638\d x 1638\d) pixels"):
        decode_image(huge_files()[name], name)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


@pytest.mark.parametrize("name", FILES)
def test_limit_of_pixels_is_inclusive(name) -> None:
    assert decode_image(FILES[name], name, 2400).shape[:2] == (40, 60)
    with pytest.raises(FrameError, match="60 x 40 pixels, more than the limit of 2399"):
        decode_image(FILES[name], name, 2399)


@pytest.mark.parametrize(
    ("data", "word"),
    [
        (tiff((1, 1), 1, 32, struct.pack("<f", 1.5), t339=3), "32-bit floating point.*convert it to uint16"),
        (tiff((1, 1), 1, 32, struct.pack("<I", 70000)), "32-bit unsigned.*convert it to uint16"),
        (tiff((1, 1), 1, 16, struct.pack("<h", -7), t339=2), "16-bit signed"),
        (tiff((1, 1), 4, 8, bytes(4), t262=5), "unusual colours"),
        (png(0, 1, 8, 0, b""), "0 x 1 pixels"),
        (png(1, 1, 8, 2, b"\0\1\2\3", chunk(b"acTL", struct.pack(">II", 2, 0))), "animated"),
        (bmp(ramp((3,)), packing=1), "run-length"),
        (b"P6 1 1 1023\n" + bytes(6), "1023"),
        (b"P5 1 1 100\n\xc8", "above its largest value"),
        (b"P2 1 1 255\nabc", "no number"),
        (b"P2 1 1 255\n-3", "no number|above"),
        (b"P5 1 1 70000\n\0\0", "70000"),
        (b"P5 0 5 255\n", "0 x 5"),
        (b"RIFF\x04\0\0\0WAVE", "no WebP"),
    ],
)
def test_refused_with_a_word(data, word) -> None:
    with pytest.raises(FrameError, match=word):
        decode_image(data, "x")


def test_several_pages_and_pictures_are_refused() -> None:
    pages = [Pillow.fromarray(noise((4, 4), (3,), np.uint8, seed)) for seed in range(3)]
    for kind, word in (("TIFF", "3 pages"), ("PNG", "animated"), ("WEBP", "animated")):
        out = io.BytesIO()
        pages[0].save(out, kind, save_all=True, append_images=pages[1:])
        with pytest.raises(FrameError, match=word):
            decode_image(out.getvalue(), "x")


# real files


def test_every_real_pair_decodes_as_pillow_reads_it(shared_data: Path) -> None:
    files = sorted((shared_data / "rgbt_pairs").glob("*/*/*.png"))
    assert len(files) == 22
    for file in files[::3]:
        expected = np.asarray(Pillow.open(file))
        expected = expected if expected.ndim == 2 else expected[:, :, ::-1]
        assert same(decode_image(file.read_bytes(), str(file)), expected), file


def test_real_counts_survive(shared_data: Path) -> None:
    counts = decode_image((shared_data / "radiometric" / "example_radiometric.tiff").read_bytes(), "tiff")
    assert (counts.shape, counts.dtype, counts.min(), counts.max()) == ((512, 640), np.uint16, 6743, 7077)
    for file in sorted((shared_data / "thermal_boards").rglob("*.pgm")):
        data = file.read_bytes()
        head, top, _ = data.split(b"65535", 1)[0], b"65535", None
        raw = np.frombuffer(data[len(head) + len(top) + 1 :], ">u2")
        pixels = decode_image(data, str(file))
        assert pixels.dtype == np.uint16
        assert (pixels.ravel() == raw).all(), file


@pytest.mark.parametrize("shape", [(5, 7), (1, 1), (6, 4, 3), (64, 48)])
@pytest.mark.parametrize("packer", ["isal", "opencv"])
def test_16_bit_png_keeps_every_value(
    shape: tuple[int, ...], packer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if packer == "opencv":
        monkeypatch.setattr(png16, "isal_zlib", None)
    pixels = np.random.default_rng(0).integers(0, 65536, shape).astype(np.uint16)
    data = encode_png(pixels)
    back: Any = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(back, pixels)
    assert np.array_equal(decode_image(data, ""), pixels)


def test_16_bit_png_takes_views_and_leaves_them_alone() -> None:
    whole = np.random.default_rng(1).integers(0, 65536, (20, 30, 3)).astype(np.uint16)
    before = whole.copy()
    part = whole[::-1, 3:17, ::-1]
    assert np.array_equal(decode_image(encode_png(part), ""), part)
    assert np.array_equal(whole, before)
