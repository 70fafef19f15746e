"""Fused frames as one H.264 video with their true times, joined from parts without coding anything twice."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.chunks import Chunk
from fusion.errors import FrameError, OutputError, UsageError
from fusion.sinks.base import Made, Setup
from fusion.sinks.parts import NO_RATE_HZ, JoinedParts, replace_by, stamp_of
from fusion.storage import Storage

if TYPE_CHECKING:
    from av import VideoFrame
    from av.container import InputContainer, OutputContainer
    from av.packet import Packet

NAME = "fused.mp4"
TICKS_PER_S = 90_000  # MP4 counts the time between two frames in 31 bits: this leaves 6.6 hours
LONGEST_PAUSE_S = 3600
_CODEC = "libx264"
# A bit rate would be that of the first part, or of what was joined before: not the same bytes.
_MUXER = {"fflags": "+bitexact", "video_track_timescale": str(TICKS_PER_S), "write_btrt": "0"}
_KEY_S = 2  # between key frames at most: what a player decodes to jump somewhere
# One thread and no choice of instructions: the same frames give the same bytes on any machine.
_CODER = {"preset": "veryfast", "x264-params": "threads=1:cpu-independent=1"}
_BT709, _LIMITED = 1, 1


class _Clip(NamedTuple):
    """Frames `begin` to `begin + frames` of the video at `path`, seen from tick `first` to tick `last`."""

    path: Path
    begin: int
    frames: int
    first: int
    last: int


@dataclass(frozen=True, slots=True)
class VideoOutput:
    """Writes `fused.mp4`. Picklable. Needs the extra ``video``: `UsageError` when made without it.

    H.264, yuv420p in BT.709, constant quality: `quality` 100, 90, 70 are x264's crf 13, 18, 28. An odd width
    or height gets one more column or row, a copy of the last. No picture waits for a later one (no
    B-frames), so parts join exactly.

    A frame is shown at its stamp, counted from the first one, in ticks of 1/90000 s. Where stamps stand
    still or jump back, or pause for more than an hour, the video runs on as if one frame's time had passed;
    the MCAP output and the index have the stamps as they are.

    Parts lie below `parts/video/`, each a video of its own, held in memory until it is whole; see
    `McapOutput` for how they are joined, and where they stay. The bytes are the same whoever made which
    chunk when, given the same libraries.
    """

    setup: Setup

    def __post_init__(self) -> None:
        try:
            from av import codecs_available
        except ImportError:
            hint = "pip install 'fusionprep[video]'"
            raise UsageError("videos need the package av, which is not installed", hint=hint) from None
        if _CODEC not in codecs_available:
            hint = "install PyAV from its wheels, or choose another output"
            raise UsageError(f"this PyAV was built without {_CODEC}: no H.264 can be written", hint=hint)

    def open(self, chunk: Chunk, out: Storage) -> VideoPart:
        return VideoPart(self.setup, chunk, out)

    def finish(self, chunks: Sequence[Chunk], out: Storage) -> Sequence[str]:
        """The name of the joined file, or of the folder of parts; none where there is no frame at all.

        Raises `OutputError` where it cannot be written, a part is missing or damaged, or parts differ in
        size.
        """
        return PARTS.finish(chunks, out, lambda folder, parts: _join(folder, parts, self.setup.rate_hz))


class VideoPart:
    """One chunk's part. Raises `FrameError` for a frame of another size than the first one."""

    def __init__(self, setup: Setup, chunk: Chunk, out: Storage) -> None:
        self._setup, self._chunk, self._out = setup, chunk, out
        self._buffer = io.BytesIO()
        self._size_wh: tuple[int, int] | None = None
        self._container: OutputContainer | None = None
        self._stream: Any = None
        self._shown = self._first = self._last = 0  # in ticks: the video's, and stamps
        self._count = 0

    def add(self, made: Made) -> None:
        bgr = made.fused.bgr
        size_wh = (bgr.shape[1], bgr.shape[0])
        tick = _tick(stamp_of(made, self._chunk, self._count, self._setup.rate_hz))
        if self._size_wh not in (None, size_wh):
            raise FrameError(
                f"is {_times(size_wh)} pixels, the video is {_times(self._size_wh)}",
                where=made.stem,
                hint="a video has one size: choose another output, or sort the input by size",
            )
        if self._stream is None:
            self._size_wh, self._first = size_wh, tick
            self._container, self._stream = _open(self._buffer, bgr, self._setup)
        else:
            self._shown += _step(self._last, tick, self._setup.rate_hz)
        self._last, self._count = tick, self._count + 1
        self._code(_frame(bgr, self._shown))

    def _code(self, frame: VideoFrame | None) -> None:
        for packet in self._stream.encode(frame):
            packet.duration = _ticks_a_frame(self._setup.rate_hz)
            self._container.mux(packet)  # type: ignore[union-attr]

    def close(self) -> Mapping[str, int]:
        """The part, where it stays; nothing in a local folder, where `finish` looks after it. A part without
        a frame is an empty file.
        """
        if self._container is not None:
            self._code(None)
            self._container.close()
        data = self._buffer.getvalue()
        if self._count:
            data += _note({_OWN: (0, self._count, self._first, self._last)})
        return PARTS.store(self._chunk, data, self._out)

    def discard(self) -> None:
        if self._container is not None:
            with suppress(Exception):  # it ends a file that nobody wants
                self._container.close()
        self._buffer.close()


# --- frames


def _tick(stamp_ns: int) -> int:
    return stamp_ns * TICKS_PER_S // 10**9


def _ticks_a_frame(rate_hz: float) -> int:
    return max(round(TICKS_PER_S / _rate(rate_hz)), 1)


def _rate(rate_hz: float) -> Fraction:
    """Frames a second as MP4 can say it."""
    known = 1e-3 < rate_hz < 1e4
    return Fraction(rate_hz if known else NO_RATE_HZ).limit_denominator(1001)


def _step(last: int, tick: int, rate_hz: float) -> int:
    """Ticks that the video goes on from a frame at `last` to one at `tick`."""
    passed = tick - last
    return passed if 0 < passed <= LONGEST_PAUSE_S * TICKS_PER_S else _ticks_a_frame(rate_hz)


def _times(size_wh: tuple[int, int] | None) -> str:
    return "x".join(map(str, size_wh or ()))


def _crf(quality: int) -> float:
    return min(13 + (100 - quality) / 2, 51)


def _open(buffer: io.BytesIO, bgr: NDArray[np.uint8], setup: Setup) -> tuple[OutputContainer, Any]:
    import av

    rate = _rate(setup.rate_hz)
    container = av.open(buffer, "w", format="mp4", options=_MUXER)
    options = {**_CODER, "crf": f"{_crf(setup.quality):g}"}
    stream: Any = container.add_stream(_CODEC, rate=rate, options=options)
    stream.width, stream.height = (n + n % 2 for n in bgr.shape[1::-1])
    stream.pix_fmt = "yuv420p"
    coder = stream.codec_context
    coder.time_base, coder.framerate, coder.thread_count = Fraction(1, TICKS_PER_S), rate, 1
    coder.max_b_frames, coder.gop_size = 0, max(round(_KEY_S * rate), 1)
    coder.color_range = _LIMITED
    coder.colorspace = coder.color_primaries = coder.color_trc = _BT709
    return container, stream


def _frame(bgr: NDArray[np.uint8], tick: int) -> VideoFrame:
    """As the coder takes it: even size, YUV of BT.709 in whole-number arithmetic, chroma averaged."""
    from av import VideoFrame
    from av.video.reformatter import ColorRange, Colorspace, Interpolation

    h, w = bgr.shape[:2]
    if h % 2 or w % 2:
        bgr = np.asarray(cv2.copyMakeBorder(bgr, 0, h % 2, 0, w % 2, cv2.BORDER_REPLICATE), np.uint8)
    exact = Interpolation.AREA | Interpolation.ACCURATE_RND | Interpolation.BITEXACT
    exact |= Interpolation.FULL_CHR_H_INT | Interpolation.FULL_CHR_H_INP
    frame = VideoFrame.from_ndarray(np.ascontiguousarray(bgr), format="bgr24").reformat(
        format="yuv420p",
        interpolation=exact,
        dst_colorspace=Colorspace.ITU709,
        dst_color_range=ColorRange.MPEG,
    )
    frame.pts, frame.time_base = tick, Fraction(1, TICKS_PER_S)
    return frame


# --- parts and what is joined of them

_OWN = "this"  # what a part calls its own frames
_NOTE = "fusion-parts/1"


def _note(clips: Mapping[str, tuple[int, int, int, int]]) -> bytes:
    """A ``free`` box of MP4, which players skip, that says what is in the file; its size again at its end."""
    text = json.dumps({"format": _NOTE, "clips": clips}, separators=(",", ":")).encode()
    size = (len(text) + 12).to_bytes(4, "big")
    return size + b"free" + text + size


def _clips(path: Path) -> dict[str, _Clip]:
    """What the note at the end of a file says; nothing where there is none of ours."""
    try:
        with path.open("rb") as file:
            end = file.seek(0, io.SEEK_END)
            file.seek(max(end - 4, 0))
            size = int.from_bytes(file.read(4), "big")
            file.seek(end - min(size, end))
            box = file.read(size)
        note = json.loads(box[8:-4]) if box[4:8] == b"free" else {}
        clips = note["clips"] if note.get("format") == _NOTE else {}
        return {str(key): _Clip(path, *map(int, numbers)) for key, numbers in clips.items()}
    except (OSError, ValueError, TypeError, AttributeError, KeyError):
        return {}


def _joined(folder: Path) -> tuple[Sequence[str], set[str]]:
    found = set(_clips(folder / NAME))
    return (NAME,) if found else (), found


PARTS = JoinedParts("parts/video", ".mp4", _joined)


def _join(folder: Path, parts: Mapping[str, Path | None], rate_hz: float) -> Sequence[str]:
    """Write `fused.mp4` from parts, and from what it holds already where there is no part (None)."""
    old = _clips(folder / NAME)
    clips = {key: old[key] if path is None else _clip(path) for key, path in parts.items()}
    if not any(clip.frames for clip in clips.values()):
        return ()
    replace_by(folder / NAME, lambda target: _write(target, clips, rate_hz))
    return (NAME,)


def _clip(part: Path) -> _Clip:
    if part.stat().st_size == 0:
        return _Clip(part, 0, 0, 0, 0)
    clips = _clips(part)
    if _OWN not in clips:
        raise _damaged(part, "its end is missing")
    return clips[_OWN]


def _write(target: Path, clips: Mapping[str, _Clip], rate_hz: float) -> None:
    import av

    noted: dict[str, tuple[int, int, int, int]] = {}
    begin = at = 0
    last: _Clip | None = None
    with av.open(str(target), "w", format="mp4", options=_MUXER) as container:
        stream: Any = None
        for key, clip in clips.items():
            noted[key] = (begin, clip.frames, clip.first, clip.last)
            begin += clip.frames
            if clip.frames:
                at += 0 if last is None else _step(last.last, clip.first, rate_hz)
                stream, at = _copy(container, stream, clip, at)
                last = clip
    with target.open("ab") as file:
        file.write(_note(noted))


def _copy(container: OutputContainer, stream: Any, clip: _Clip, at: int) -> tuple[Any, int]:
    """Take a clip's packets over, the first shown at tick `at`; the stream, and when the last is shown."""
    import av
    from av.error import EOFError, InvalidDataError

    count, start, end = 0, None, at
    try:
        with av.open(str(clip.path)) as source:
            stream = _stream_like(source, container, stream, clip.path)
            for packet in _packets(source, clip):
                shown = int(packet.pts or 0)
                start = shown if start is None else start
                end = packet.pts = packet.dts = at + shown - start
                packet.stream = stream
                container.mux(packet)
                count += 1
    except (InvalidDataError, EOFError) as error:
        raise _damaged(clip.path, str(error.strerror)) from None
    if count != clip.frames:
        raise _damaged(clip.path, f"{count} frames of {clip.frames}")
    return stream, end


def _stream_like(source: InputContainer, container: OutputContainer, stream: Any, path: Path) -> Any:
    """The stream of `container`, made after the first source. Raises `OutputError` for one that differs."""
    other: Any = source.streams.video[0]
    if stream is None:
        stream = container.add_stream_from_template(other)
        stream.time_base = other.time_base
        return stream
    a, b = stream.codec_context, other.codec_context
    if (a.width, a.height) != (b.width, b.height):
        raise OutputError(
            f"frames of {_times((b.width, b.height))} pixels after {_times((a.width, a.height))}",
            where=path,
            hint="a video has one size: choose another output, or sort the input by size",
        )
    if a.extradata != b.extradata:
        hint = "give all workers the same PyAV, remove the parts and run the same command again"
        raise OutputError("coded by another build of x264 than the parts before", where=path, hint=hint)
    return stream


def _packets(source: InputContainer, clip: _Clip) -> Iterator[Packet]:
    whole = (packet for packet in source.demux(video=0) if packet.size)
    return islice(whole, clip.begin, clip.begin + clip.frames)


def _damaged(path: Path, why: str) -> OutputError:
    hint = "remove it and run the same command again"
    return OutputError(f"the part is damaged: {why}", where=path, hint=hint)
