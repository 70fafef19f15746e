"""The video of a run: decoded again, times and pictures compared, joined in any order, killed and damaged."""

from __future__ import annotations

import io
import pickle
import sys
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from made_frames import CHUNKS, SETUP, SIZE_WH, do, file_bytes, frames_of, made, picture, stamp

from fusion.chunks import Chunk
from fusion.errors import FrameError, OutputError, UsageError
from fusion.preprocess.records import record_name
from fusion.sinks.base import Setup
from fusion.sinks.video import PARTS, VideoOutput
from fusion.storage import LocalFolder, open_storage

OUTPUT = VideoOutput(SETUP)
ALL = [k for chunk in CHUNKS for k in frames_of(chunk)]
TICK = Fraction(1, 90_000)


def run(folder: Path, chunks: Sequence[Chunk] = CHUNKS, output: VideoOutput = OUTPUT) -> bytes:
    out = open_storage(folder)
    for chunk in chunks:
        do(output, chunk, out)
    assert output.finish(chunks, out) == ("fused.mp4",)
    return (folder / "fused.mp4").read_bytes()


def decoded(data: bytes) -> tuple[list[Fraction], list[np.ndarray], list[bool]]:
    """Seconds, BGR pictures and key frames; what a decoder sees that knows nothing of us."""
    with av.open(io.BytesIO(data), "r") as container:
        frames = [*container.decode(video=0)]
    times = [Fraction(frame.pts or 0) * (frame.time_base or 0) for frame in frames]
    return (
        times,
        [frame.to_ndarray(format="bgr24") for frame in frames],
        [frame.key_frame for frame in frames],
    )


def psnr_db(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2)))


def video_of(frames: Sequence[tuple[int, tuple[int, int]]], setup: Setup = SETUP) -> bytes:
    """One chunk of pictures, each with its number and size."""
    out = open_storage("memory://video-one")
    part = VideoOutput(setup).open(CHUNKS[0], out)
    for k, size_wh in frames:
        part.add(made(k, size_wh, whole=False))
    part.close()
    return out.read(PARTS.name(CHUNKS[0]))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return run(tmp_path_factory.mktemp("video"))


def test_every_frame_at_its_time(whole: bytes) -> None:
    times, pictures, keys = decoded(whole)
    assert len(pictures) == len(ALL)
    for k, at, bgr in zip(ALL, times, pictures, strict=True):
        assert abs(at - Fraction(stamp(k) - stamp(0), 10**9)) <= TICK
        right, wrong = psnr_db(bgr, picture(k)), psnr_db(bgr, picture(k + 1))
        assert right > 30 > wrong + 8
    assert [k for k, key in zip(ALL, keys, strict=True) if key] == [0, 3, 9]  # each part decodes on its own


def test_a_player_finds_what_it_needs(whole: bytes) -> None:
    with av.open(io.BytesIO(whole), "r") as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.format.name) == ("h264", "yuv420p")
        assert (stream.frames, stream.time_base) == (len(ALL), TICK)
        assert (stream.codec_context.colorspace, stream.codec_context.color_range) == (1, 1)
        assert [p.pts == p.dts for p in container.demux(stream) if p.size] == [True] * len(ALL)
        container.seek(round((stamp(9) - stamp(0)) * 90_000 / 1e9) + 1, stream=stream)
        assert psnr_db(next(container.decode(stream)).to_ndarray(format="bgr24"), picture(9)) > 30


def test_the_same_bytes_whatever_the_order(whole: bytes, tmp_path: Path) -> None:
    out = open_storage(tmp_path)
    for chunk in reversed(CHUNKS):
        assert do(pickle.loads(pickle.dumps(OUTPUT)), chunk, out) == {}
    OUTPUT.finish(CHUNKS[::-1], out)
    assert file_bytes(tmp_path) == {"fused.mp4": whole}
    OUTPUT.finish(CHUNKS, out)
    assert file_bytes(tmp_path) == {"fused.mp4": whole}


def test_a_join_codes_nothing_again(whole: bytes, tmp_path: Path) -> None:
    out = open_storage(tmp_path)
    parts = []
    for chunk in CHUNKS:
        do(OUTPUT, chunk, out)
        parts += packets(out.read(PARTS.name(chunk))) if frames_of(chunk) else []
    assert packets(whole) == parts


def packets(data: bytes) -> list[bytes]:
    with av.open(io.BytesIO(data), "r") as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]


def test_chunks_done_later_take_their_place(whole: bytes, tmp_path: Path) -> None:
    out = open_storage(tmp_path)
    run(tmp_path, [CHUNKS[0], CHUNKS[3]])
    do(OUTPUT, CHUNKS[2], out)
    do(OUTPUT, CHUNKS[1], out)
    OUTPUT.finish(CHUNKS, out)
    assert file_bytes(tmp_path) == {"fused.mp4": whole}


class Stopping(LocalFolder):
    """A folder in which the process dies when the storage is asked for the n-th time."""

    left = 1 << 30

    def _path(self, name: str) -> Path:
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt
        return super()._path(name)


def test_killed_at_any_step_and_started_again(whole: bytes, tmp_path: Path) -> None:
    out, finished, steps = Stopping(str(tmp_path)), False, 0
    for steps in range(60):
        out.left = 1 << 30
        for chunk in CHUNKS:
            do(OUTPUT, chunk, out)
        (tmp_path / "fused.mp4").unlink(missing_ok=True)
        out.left = steps
        try:
            OUTPUT.finish(CHUNKS, out)
            finished = True
        except KeyboardInterrupt:
            out.left = 1 << 30
            OUTPUT.finish(CHUNKS, out)
        assert file_bytes(tmp_path) == {"fused.mp4": whole}
        if finished:
            break
    assert finished
    assert steps > 3


@pytest.mark.parametrize("keep", [5, 300, -1, -30])
def test_a_damaged_part_is_named_and_nothing_is_lost(keep: int, tmp_path: Path) -> None:
    out = open_storage(tmp_path)
    for chunk in CHUNKS:
        do(OUTPUT, chunk, out)
    part = tmp_path / PARTS.name(CHUNKS[1])
    part.write_bytes(part.read_bytes()[:keep])
    before = file_bytes(tmp_path)
    with pytest.raises(OutputError, match=r"000001\.mp4.*damaged"):
        OUTPUT.finish(CHUNKS, out)
    assert file_bytes(tmp_path) == before


@pytest.mark.parametrize(("old", "new"), [(b"moov", b"moof"), (b'"this":[0,3,', b'"this":[0,4,')])
def test_damage_inside_a_part_is_found(old: bytes, new: bytes, tmp_path: Path) -> None:
    out = open_storage(tmp_path)
    for chunk in CHUNKS:
        do(OUTPUT, chunk, out)
    part = tmp_path / PARTS.name(CHUNKS[1])
    part.write_bytes(part.read_bytes().replace(old, new))
    with pytest.raises(OutputError, match=r"000001\.mp4.*damaged"):
        OUTPUT.finish(CHUNKS, out)
    assert not (tmp_path / "fused.mp4").exists()


def test_a_part_that_is_gone_takes_its_record_along(tmp_path: Path) -> None:
    out = open_storage(tmp_path)
    for chunk in CHUNKS:
        do(OUTPUT, chunk, out)
        out.write(record_name(chunk), b"done")
    out.remove(PARTS.name(CHUNKS[3]))
    with pytest.raises(OutputError, match=r"parts/video/000003\.mp4 is gone.*same command"):
        OUTPUT.finish(CHUNKS, out)
    assert [out.size(record_name(chunk)) for chunk in CHUNKS] == [4, 4, 4, None]


def test_elsewhere_the_parts_stay() -> None:
    out = open_storage("memory://video-output")
    sizes = [do(OUTPUT, chunk, out) for chunk in CHUNKS]
    assert OUTPUT.finish(CHUNKS, out) == ("parts/video/",)
    assert sizes == [{PARTS.name(chunk): out.size(PARTS.name(chunk))} for chunk in CHUNKS]
    assert len(decoded(out.read(PARTS.name(CHUNKS[1])))[1]) == 3


def test_no_frame_at_all_is_no_video(tmp_path: Path) -> None:
    out = open_storage(tmp_path)
    do(OUTPUT, CHUNKS[2], out)
    for _ in range(2):
        assert OUTPUT.finish(CHUNKS[2:3], out) == ()
    assert not (tmp_path / "fused.mp4").exists()


@pytest.mark.parametrize("size_wh", [(47, 32), (48, 31), (33, 17)])
def test_an_odd_size_repeats_its_last_row_or_column(size_wh: tuple[int, int]) -> None:
    _, pictures, _ = decoded(video_of([(k, size_wh) for k in range(2)], replace(SETUP, quality=100)))
    w, h = size_wh
    assert pictures[0].shape == (h + h % 2, w + w % 2, 3)
    assert psnr_db(pictures[0][:h, :w], picture(0, size_wh)) > 30
    assert np.abs(pictures[0][:h, -1].astype(int) - pictures[0][:h, w - 1]).mean() < 6


def test_another_size_is_refused_in_a_chunk_and_between_chunks(tmp_path: Path) -> None:
    with pytest.raises(FrameError, match="f1: is 40x32 pixels, the video is 48x32"):
        video_of([(0, SIZE_WH), (1, (40, 32))])
    out = open_storage(tmp_path)
    do(OUTPUT, CHUNKS[0], out)
    part = OUTPUT.open(CHUNKS[1], out)
    part.add(made(5, (40, 32), whole=False))
    part.close()
    with pytest.raises(OutputError, match=r"000001\.mp4: frames of 40x32 pixels after 48x32"):
        OUTPUT.finish(CHUNKS[:2], out)
    assert out.size(PARTS.name(CHUNKS[0]))
    assert not (tmp_path / "fused.mp4").exists()


def test_more_quality_is_more_bytes_and_a_better_picture() -> None:
    sizes, quality = [], []
    for wanted in (30, 70, 90, 100):
        data = video_of([(k, SIZE_WH) for k in range(3)], replace(SETUP, quality=wanted))
        sizes.append(len(data))
        quality.append(psnr_db(decoded(data)[1][2], picture(2)))
    assert sizes == sorted(set(sizes))
    assert quality == sorted(set(quality))


def test_time_that_jumps_runs_on(tmp_path: Path) -> None:
    """Back, still, and a pause of a day, in a chunk and between two: a frame's time each, 50 ms at 20 Hz."""
    second = 10**9
    stamps = [100, 101, 90, 90, 91, 91 + 86_400, 91 + 86_401]
    out = open_storage(tmp_path)
    for chunk, some in ((CHUNKS[0], stamps[:3]), (CHUNKS[1], stamps[3:5]), (CHUNKS[2], stamps[5:])):
        part = OUTPUT.open(chunk, out)
        for k, seconds in enumerate(some):
            part.add(made(k, stamp_ns=seconds * second, whole=False))
        part.close()
    OUTPUT.finish(CHUNKS[:3], out)
    times, _, _ = decoded((tmp_path / "fused.mp4").read_bytes())
    frame = Fraction(1, 20)
    assert times == [0, 1, 1 + frame, 1 + 2 * frame, 2 + 2 * frame, 2 + 3 * frame, 3 + 3 * frame]


def test_frames_without_a_clock_play_at_the_rate() -> None:
    out = open_storage("memory://video-clockless")
    for rate_hz, interval in ((8.0, Fraction(1, 8)), (0.0, Fraction(1, 10)), (float("nan"), Fraction(1, 10))):
        part = VideoOutput(Setup(None, None, rate_hz)).open(Chunk(0, 0, 3, 3), out)
        for k in range(3):
            part.add(made(k, stamp_ns=None, whole=False))
        part.close()
        assert decoded(out.read("parts/video/000000.mp4"))[0] == [0, interval, 2 * interval]


def test_without_the_extra_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(UsageError, match=r"pip install 'fusionprep\[video\]'"):
        VideoOutput(SETUP)


def test_a_build_without_the_coder_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(av, "codecs_available", {"mpeg4"})
    with pytest.raises(UsageError, match="built without libx264"):
        VideoOutput(SETUP)


def test_a_discarded_part_leaves_nothing(tmp_path: Path) -> None:
    part = OUTPUT.open(CHUNKS[0], open_storage(tmp_path))
    part.add(made(0, whole=False))
    part.discard()
    OUTPUT.open(CHUNKS[0], open_storage(tmp_path)).discard()
    assert file_bytes(tmp_path) == {}
