"""Videos made here by the real encoders; the oracle is a plain decode from the first frame to the last."""

from __future__ import annotations

import random
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusion.errors import FrameError, InputError
from fusion.sources import open_source
from fusion.sources.video import VideoSource

av = pytest.importorskip("av")

WIDTH, HEIGHT, COUNT = 64, 48, 30
ROWS, COLUMNS = np.mgrid[0:HEIGHT, 0:WIDTH]


def colour(number: int) -> np.ndarray:
    """A picture that tells its number: a bar that moves over a still background."""
    picture = np.dstack([ROWS * 4, COLUMNS * 3, 255 - ROWS * 3]).astype(np.uint8)
    picture[:, (number * 2) % 60 : (number * 2) % 60 + 4] = (255, 255 - number % 32 * 8, number % 32 * 8)
    return picture


def grey(number: int) -> np.ndarray:
    return (ROWS * 2 + COLUMNS + number * 3).astype(np.uint8)


def counts(number: int) -> np.ndarray:
    return ((ROWS * WIDTH + COLUMNS) * 21 + number * 331).astype(np.uint16)


def make(
    path: Path,
    codec: str,
    pix_fmt: str,
    picture: Callable[[int], np.ndarray] = colour,
    *,
    count: int = COUNT,
    rate: Fraction | int = 25,
    start: int = 0,
    muxer: dict[str, str] | None = None,
    **options: str,
) -> Path:
    """Encode `count` pictures with a key frame every 10."""
    name = {(3, "uint8"): "bgr24", (2, "uint8"): "gray", (2, "uint16"): "gray16le"}
    with av.open(f"file:{path}", "w", options=muxer or {}) as container:
        stream: Any = container.add_stream(codec, rate=rate, options=options)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, pix_fmt
        stream.gop_size = 10
        for number in range(count):
            pixels = picture(number)
            frame = av.VideoFrame.from_ndarray(pixels, format=name[pixels.ndim, str(pixels.dtype)])
            frame.pts, frame.time_base = number + start, 1 / Fraction(rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def planes(
    path: Path, values: tuple[int, ...] | list[np.ndarray], pix_fmt: str, colour_range: int = 0
) -> Path:
    """A lossless one-frame video of given planes."""
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, pix_fmt
        stream.codec_context.color_range = colour_range
        frame = av.VideoFrame(WIDTH, HEIGHT, pix_fmt)
        for plane, value in zip(frame.planes, values, strict=True):
            whole = np.zeros((plane.height, plane.line_size), np.uint8)
            if isinstance(value, np.ndarray):
                whole[:, : value.shape[1] * value.itemsize] = np.ascontiguousarray(value).view(np.uint8)
            else:
                whole[:] = value
            plane.update(whole.tobytes())
        frame.pts, frame.color_range = 0, colour_range
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def decoded(path: Path) -> list[Any]:
    with av.open(str(path)) as container:
        return list(container.decode(video=0))


def as_bgr(path: Path) -> list[np.ndarray]:
    return [frame.to_ndarray(format="bgr24") for frame in decoded(path)]


def as_video(path: Path, role: Any = "rgb", **options: Any) -> VideoSource:
    source = open_source(path, role, **options)
    assert isinstance(source, VideoSource)
    return source


VIDEOS = {
    "h264, B-frames": ("a.mp4", "libx264", "yuv420p", {"bf": "3"}),
    "h264, open groups": ("b.mkv", "libx264", "yuv420p", {"bf": "3", "x264-params": "open-gop=1"}),
    "h264, transport stream": ("c.ts", "libx264", "yuv420p", {"bf": "2"}),
    "mpeg4, B-frames": ("d.avi", "mpeg4", "yuv420p", {"bf": "2"}),
    "mjpeg": ("e.mov", "mjpeg", "yuvj420p", {}),
    "ffv1": ("f.mkv", "ffv1", "bgr0", {}),
}


@pytest.fixture(scope="module", params=VIDEOS)
def video(request, tmp_path_factory) -> Path:
    name, codec, pix_fmt, options = VIDEOS[request.param]
    if codec not in av.codecs_available:
        pytest.skip(f"this PyAV has no {codec}")
    return make(tmp_path_factory.mktemp("video") / name, codec, pix_fmt, **options)


def test_any_order_gives_the_frames_of_a_plain_decode(video: Path) -> None:
    expected = as_bgr(video)
    source = as_video(video)
    assert len(source.entries) == len(expected) == COUNT
    order = [*range(COUNT), *random.Random(2).sample(range(COUNT), COUNT), 0, COUNT - 1, 0]
    for number in order:
        assert (source.read(number).pixels == expected[number]).all(), number
    fresh = as_video(video)
    for number in order[COUNT:]:
        assert (fresh.read(number).pixels == expected[number]).all(), number


def test_threads_share_one_pass(video: Path) -> None:
    expected = as_bgr(video)
    source = as_video(video)
    with ThreadPoolExecutor(4) as pool:
        for number, image in enumerate(pool.map(source.read, range(COUNT))):
            assert (image.pixels == expected[number]).all()
    assert source.frames_decoded == COUNT


def test_nearly_in_order_is_one_pass_too(video: Path) -> None:
    expected = as_bgr(video)
    source = as_video(video)
    for number in (first + step for first in range(0, COUNT, 3) for step in (2, 0, 1)):
        assert (source.read(number).pixels == expected[number]).all()
    assert source.frames_decoded == COUNT


def test_stamps_are_those_of_the_frames(video: Path) -> None:
    source = as_video(video)
    expected = [round(Fraction(frame.pts) * frame.time_base * 10**9) for frame in decoded(video)]
    assert [entry.stamp_ns for entry in source.entries] == expected
    assert np.diff(expected).tolist() == [40_000_000] * (COUNT - 1)
    assert [source.read(n).stamp_ns for n in (5, 3)] == [expected[5], expected[3]]
    assert source.entries[12].stem == "frame_000012"
    assert source.entries[12].where == f"{video.name} frame 12"


def test_stamps_are_exact_and_not_shifted(tmp_path: Path) -> None:
    path = make(
        tmp_path / "a.mp4", "mpeg4", "yuv420p", rate=Fraction(30000, 1001), start=300, count=5, bf="0"
    )
    stamps = [entry.stamp_ns for entry in as_video(path).entries]
    assert stamps == [(2 * n * 1001 * 10**9 + 30000) // 60000 for n in range(300, 305)]


def test_far_jumps_do_not_decode_all_between(tmp_path: Path) -> None:
    path = make(tmp_path / "long.mkv", "mpeg4", "yuv420p", count=200, bf="0")
    source, expected = as_video(path), as_bgr(path)
    assert (source.read(195).pixels == expected[195]).all()
    assert source.frames_decoded <= 10
    assert (source.read(33).pixels == expected[33]).all()
    assert source.frames_decoded <= 20


def test_kept_frames_are_bounded(tmp_path: Path) -> None:
    path = make(tmp_path / "long.mkv", "mpeg4", "yuv420p", count=120, bf="0")
    source = as_video(path)
    for number in range(120):
        source.read(number)
    assert len(source._kept) + len(source._fresh) <= 64


def test_reading_after_close_opens_again(video: Path) -> None:
    source = as_video(video)
    first = source.read(4).pixels
    source.close()
    source.close()
    assert (source.read(4).pixels == first).all()


# thermal


@pytest.mark.parametrize("name", ["a.mkv", "a.avi"])
def test_16_bit_counts_survive(tmp_path: Path, name: str) -> None:
    source = as_video(make(tmp_path / name, "ffv1", "gray16le", counts), "fir")
    for number in [*range(COUNT), *random.Random(3).sample(range(COUNT), COUNT)]:
        image = source.read(number)
        assert image.pixels.dtype == np.uint16
        assert (image.pixels == counts(number)).all()
        assert image.flags == ()


@pytest.mark.parametrize("pix_fmt", ["gray10le", "gray12le"])
def test_10_and_12_bit_counts_are_as_stored(tmp_path: Path, pix_fmt: str) -> None:
    stored = (counts(0) % (1024 if "10" in pix_fmt else 4096)).astype("<u2")
    image = as_video(planes(tmp_path / "a.mkv", [stored], pix_fmt), "fir").read(0)
    assert (image.pixels == stored).all()
    assert image.pixels.dtype == np.uint16


def test_8_bit_grey_is_as_stored(tmp_path: Path) -> None:
    source = as_video(make(tmp_path / "a.mkv", "ffv1", "gray", grey), "fir")
    assert (source.read(7).pixels == grey(7)).all()
    assert source.read(7).flags == ()


def neutral(pix_fmt: str, by: int = 0) -> list[np.ndarray]:
    wide = "10" in pix_fmt
    luma = (COLUMNS * 15 + ROWS) if wide else np.clip(COLUMNS * 4 + ROWS, 0, 255)
    chroma = np.full((HEIGHT // 2, WIDTH // 2), 512 if wide else 128)
    chroma[3, 4] += by
    return [a.astype("<u2" if wide else np.uint8) for a in (luma, chroma, chroma)]


def test_grey_stored_as_colour_gives_full_range_luma(tmp_path: Path) -> None:
    stored = neutral("yuv420p", by=2)
    limited = as_video(planes(tmp_path / "a.mkv", stored, "yuv420p"), "fir").read(0)
    expected = np.clip(np.rint((stored[0].astype(float) - 16) * 255 / 219), 0, 255)
    assert (limited.pixels == expected).all()
    assert limited.flags == ("fir-grey-stored-as-colour",)
    full = as_video(planes(tmp_path / "b.mkv", stored, "yuv420p", colour_range=2), "fir").read(0)
    assert (full.pixels == stored[0]).all()


def test_grey_stored_as_10_bit_colour_is_not_scaled(tmp_path: Path) -> None:
    stored = neutral("yuv420p10le")
    image = as_video(planes(tmp_path / "a.mkv", stored, "yuv420p10le"), "fir").read(0)
    assert (image.pixels == stored[0]).all()
    assert image.flags == ("fir-grey-stored-as-colour",)


def test_coloured_thermal_video(tmp_path: Path) -> None:
    path = planes(tmp_path / "a.mkv", neutral("yuv420p", by=3), "yuv420p")
    source = as_video(path, "fir")
    with pytest.raises(FrameError, match=r"a\.mkv frame 0: .*coloured.*--fir-colour luma"):
        source.read(0)
    image = as_video(path, "fir", fir_colour="luma").read(0)
    assert image.flags == ("fir-colour-to-luma",)
    expected = as_bgr(path)[0].astype(float) @ [0.114, 0.587, 0.299]
    assert np.abs(image.pixels - expected).max() <= 0.51


# RGB


@pytest.mark.parametrize("colour_range", [1, 2])
def test_rgb_follows_the_range(tmp_path: Path, colour_range: int) -> None:
    path = planes(tmp_path / "a.mkv", (120, 100, 160), "yuv444p", colour_range)
    luma = 120.0 if colour_range == 2 else (120 - 16) * 255 / 219
    blue, red = ((v - 128) * (1.0 if colour_range == 2 else 255 / 224) for v in (100, 160))
    expected = [luma + 1.772 * blue, luma - 0.344136 * blue - 0.714136 * red, luma + 1.402 * red]
    assert np.abs(as_video(path).read(0).pixels - np.array(expected)).max() <= 1


def test_rgb_of_deeper_and_grey_video_says_so(tmp_path: Path) -> None:
    image = as_video(make(tmp_path / "a.mkv", "ffv1", "gray16le", counts, count=2)).read(1)
    assert (image.pixels == ((counts(1).astype(int) * 2 + 257) // 514)[:, :, None]).all()
    assert image.flags == ("rgb-16bit-to-8", "rgb-grey")
    ten = as_video(planes(tmp_path / "b.mkv", neutral("yuv420p10le"), "yuv420p10le")).read(0)
    assert ten.flags == ("rgb-10bit-to-8",)


def test_rgb_alpha_of_video(tmp_path: Path) -> None:
    stored = [np.full((HEIGHT, WIDTH * 4), 77, np.uint8)]
    assert as_video(planes(tmp_path / "a.mkv", stored, "bgra")).read(0).flags == ("rgb-alpha-dropped",)


# damage


def served(source: VideoSource, order: list[int]) -> dict[int, np.ndarray | None]:
    found: dict[int, np.ndarray | None] = {}
    for number in order:
        try:
            found[number] = source.read(number).pixels
        except FrameError:
            found[number] = None
    return found


def test_truncated_file_serves_what_is_there(tmp_path: Path) -> None:
    whole = make(tmp_path / "a.mp4", "mpeg4", "yuv420p", muxer={"movflags": "faststart"}, bf="2")
    expected, data = as_bgr(whole), whole.read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) * 7 // 10])
    source = as_video(tmp_path / "cut.mp4")
    assert len(source.entries) == COUNT
    found = served(source, list(range(COUNT)))
    good = [number for number, pixels in found.items() if pixels is not None]
    assert 5 < len(good) < 28
    assert good == list(range(len(good)))
    assert all((found[number] == expected[number]).all() for number in good)
    with pytest.raises(
        FrameError, match=r"cut\.mp4 frame 29: missing: the file announces 30 frames and holds"
    ):
        source.read(29)


@pytest.mark.parametrize("name", ["a.mkv", "a.ts"])
def test_cut_stream_serves_what_is_there(tmp_path: Path, name: str) -> None:
    whole = make(tmp_path / name, "libx264", "yuv420p", bf="2")
    expected, data = as_bgr(whole), whole.read_bytes()
    cut = tmp_path / f"cut_{name}"
    cut.write_bytes(data[: len(data) * 6 // 10])
    source = as_video(cut)
    found = served(source, list(range(len(source.entries))))
    good = [number for number, pixels in found.items() if pixels is not None]
    assert 5 < len(good) < COUNT
    assert all((found[number] == expected[number]).all() for number in good)


def test_damage_is_named_in_every_order_and_goes_no_further(tmp_path: Path) -> None:
    """A spoilt frame takes with it what is decoded after it, up to the next key frame, and nothing else."""
    whole = make(tmp_path / "a.mp4", "libx264", "yuv420p", bf="2")
    expected, data = as_bgr(whole), bytearray(whole.read_bytes())
    with av.open(str(whole)) as container:
        packets = [(p.pos, p.size, p.pts) for p in container.demux(video=0) if p.size]
    position, size, pts = packets[13]
    data[position + 20 : position + size] = bytes(0x55 ^ v for v in data[position + 20 : position + size])
    spoilt = tmp_path / "b.mp4"
    spoilt.write_bytes(bytes(data))
    orders = [list(range(COUNT)), *(random.Random(seed).sample(range(COUNT), COUNT) for seed in range(4))]
    results = [served(as_video(spoilt), order) for order in orders]
    refused = {number for number, pixels in results[0].items() if pixels is None}
    stamp = round(pts * decoded(whole)[0].time_base * 25)
    assert stamp in refused
    assert refused <= set(range(10, 20))
    for result in results:
        assert {number for number, pixels in result.items() if pixels is None} == refused
        for number in set(range(COUNT)) - refused:
            assert (result[number] == expected[number]).all()


@pytest.mark.parametrize("content", [b"", b"hello world" * 200, bytes(5000)])
def test_what_is_no_video(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.mp4"):
        open_source(path, "rgb")


def test_cut_mp4_without_its_table(tmp_path: Path) -> None:
    data = make(tmp_path / "a.mp4", "mpeg4", "yuv420p").read_bytes()
    (tmp_path / "b.mp4").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="truncated"):
        open_source(tmp_path / "b.mp4", "rgb")


def test_sound_alone_is_no_video(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "a.avi"), "w") as container:
        stream: Any = container.add_stream("pcm_s16le", rate=8000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(InputError, match="no video stream"):
        open_source(tmp_path / "a.avi", "rgb")


def test_stream_without_stamps_is_refused(tmp_path: Path) -> None:
    path = make(tmp_path / "a.h264", "libx264", "yuv420p")
    with pytest.raises(InputError, match=r"no time stamps.*ffmpeg"):
        open_source(path, "rgb")


def test_video_beyond_the_limit_of_pixels(tmp_path: Path) -> None:
    path = make(tmp_path / "a.mkv", "mpeg4", "yuv420p", count=2)
    with pytest.raises(InputError, match="64 x 48 pixels, more than the limit of 3071"):
        open_source(path, "rgb", max_pixels=3071)


def test_file_that_vanishes(tmp_path: Path) -> None:
    path = make(tmp_path / "a.mkv", "mpeg4", "yuv420p", count=3)
    source = as_video(path)
    path.unlink()
    with pytest.raises(FrameError, match="frame 1"):
        source.read(1)


def test_unusual_names(tmp_path: Path) -> None:
    source = as_video(make(tmp_path / "12:30 видео #1.MKV", "mpeg4", "yuv420p", count=2))
    assert source.read(1).size_wh == (WIDTH, HEIGHT)


def test_without_pyav(tmp_path: Path, monkeypatch) -> None:
    path = make(tmp_path / "a.mkv", "mpeg4", "yuv420p", count=2)
    monkeypatch.setitem(sys.modules, "av", None)  # what Python itself takes for "not installed"
    with pytest.raises(InputError, match=r"pip install 'fusionprep\[video\]'"):
        open_source(path, "rgb")
