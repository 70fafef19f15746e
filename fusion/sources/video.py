"""Video files as a source, with the container's own time stamps and any access order (PyAV)."""

from __future__ import annotations

import threading
from bisect import bisect_left, bisect_right
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fusion.errors import FrameError, InputError
from fusion.frames import Image
from fusion.sources.base import Entry, Role, SourceKind
from fusion.sources.roles import FirColour
from fusion.sources.videoframes import frame_to_role

if TYPE_CHECKING:
    from av import VideoFrame
    from av.container import InputContainer
    from av.packet import Packet

VIDEO_SUFFIXES = frozenset(
    {".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".ts", ".m2ts", ".mts", ".wmv", ".asf"}
    | {".flv", ".ogv", ".3gp", ".mxf", ".nut", ".y4m", ".mjpeg", ".mjpg", ".h264", ".264", ".h265", ".hevc"}
)
_KEPT_BYTES = 96 * 2**20  # decoded frames kept for threads that ask nearly in order
_KEPT_FRAMES = (16, 64)
_NEAR = 16  # a key frame nearer than this is decoded up to: other threads may still want what lies between


@dataclass(frozen=True, slots=True)
class _Index:
    """What the packets say, without decoding; the entries are in order of presentation.

    `pts` and `position` (place in decoding order) belong to entry i; `key` is the entry of the last key
    frame at or before it, from which it can be decoded; `reach` the last entry among those decoded up to
    it, after which all that it builds on has come out; `keys` are the entries that are key frames.
    `damaged` are entries whose packet the container marks as damaged, `announced` is the number of
    frames the header tells of (0: it does not tell), `ignored` counts what else the file holds.
    """

    pts: list[int]
    position: list[int]
    key: list[int]
    reach: list[int]
    keys: list[int]
    damaged: list[int]
    time_base: Fraction
    missing: int
    ignored: int
    frame_bytes: int


@dataclass(frozen=True, slots=True)
class _Row:
    """What one packet says of its frame."""

    pts: int
    key: bool
    damaged: bool
    shown: bool


class VideoSource:
    """The frames of a file's first video stream, in order of presentation.

    Stamps are the stream's own presentation times in ns, not shifted. Pixels are as coded: a rotation
    noted in the container is not applied. `ignored` counts further video streams and frames that share
    their time with another. `read` may be called from several threads: requests that come nearly in
    order share one forward pass. A frame that is damaged, that builds on a damaged one, or that the
    container announces but does not hold, raises `FrameError`, whatever the order of reading. Damage that
    the decoder does not report (ffv1 and vp9 mend it in silence) cannot be seen here, and what it leaves
    in a picture may then hang on that order.
    """

    def __init__(self, spec: str, role: Role, *, fir_colour: FirColour, max_pixels: int) -> None:
        self.name = spec
        self.role: Role = role
        self._fir_colour: FirColour = fir_colour
        self._index = index = _read_index(spec, max_pixels)
        self.ignored = index.ignored
        self.entries: Sequence[Entry] = _entries(spec, index)
        self.frames_decoded = 0
        self._entry_of = {pts: entry for entry, pts in enumerate(index.pts)}
        self._fresh: dict[int, VideoFrame] = {}
        self._kept: OrderedDict[int, VideoFrame] = OrderedDict()
        low, high = _KEPT_FRAMES
        self._kept_frames = max(low, min(high, _KEPT_BYTES // index.frame_bytes))
        self._lock = threading.Lock()
        self._container: InputContainer | None = None
        self._packets: Iterator[Packet] = iter(())
        self._floor = 0  # frames before it come without what they build on, and are not kept
        self._next = 0  # the entry that decoding on would give
        self._damaged: set[int] = set()
        for entry in index.damaged:
            self._note_damage(entry)

    def read(self, index: int) -> Image:
        """Decode entry `index`. Raises `FrameError` when that frame cannot be had unharmed."""
        entry = self.entries[index]
        with self._lock:
            frame = self._frame(range(len(self.entries))[index], entry.where)
        # converting is the larger part of the work, and needs no lock
        pixels, flags = frame_to_role(frame, self.role, entry.where, self._fir_colour)
        return Image(pixels, entry.stem, entry.stamp_ns, flags)

    def close(self) -> None:
        """Close the file. A later `read` opens it again."""
        with self._lock:
            if self._container is not None:
                self._container.close()
            self._container, self._packets = None, iter(())
            self._kept.clear()
            self._fresh.clear()

    def _frame(self, index: int, where: str) -> VideoFrame:
        found = len(self._index.pts)
        if index >= found:
            what = f"missing: the file announces {len(self.entries)} frames and holds {found}"
            raise FrameError(what, where=where, hint="the file is truncated")
        if index not in self._kept and index not in self._damaged:
            self._decode_to(index, where)
        if index in self._damaged:
            raise FrameError("damaged, or builds on a damaged frame", where=where)
        if index not in self._kept:
            raise FrameError("does not decode", where=where, hint="the file is damaged or truncated")
        return self._kept[index]

    def _decode_to(self, index: int, where: str) -> None:
        container = self._container or self._open_at_start(where)
        key = self._index.key[index]
        if index < self._next or key > self._next + _NEAR:
            self._go_to(key, container, where)
        while self._next <= self._index.reach[index] and self._step():
            pass

    def _go_to(self, key: int, container: InputContainer, where: str) -> None:
        """Go to key frame `key`. Where a container seeks badly: to the one before, or to the start."""
        self._floor = self._next = key
        self._fresh.clear()
        keys = self._index.keys
        before = keys[max(bisect_left(keys, key) - 1, 0)] if keys else 0
        if not any(self._seek(container, entry, key) for entry in dict.fromkeys((key, before))):
            container.close()
            self._open_at_start(where)

    def _seek(self, container: InputContainer, entry: int, key: int) -> bool:
        """Seek to `entry`; False when the packets that follow do not begin at or before `key`."""
        from av.error import FFmpegError

        stream = container.streams.video[0]
        try:
            container.seek(self._index.pts[entry], stream=stream)
            packets = container.demux(stream)
            first = next(packets)
        except (FFmpegError, StopIteration):
            return False
        landed = None if first.pts is None else self._entry_of.get(first.pts)
        self._packets = chain([first], packets)
        return landed is not None and self._index.position[landed] <= self._index.position[key]

    def _step(self) -> bool:
        """Decode one packet and keep what comes out; False at the end."""
        from av.error import FFmpegError

        try:
            packet = next(self._packets)
        except (StopIteration, FFmpegError):
            self._next = len(self._index.pts)
            self._release()
            return False
        try:
            frames: Any = packet.decode()
        except FFmpegError:
            self._note_damage(self._entry_of.get(packet.pts, -1) if packet.pts is not None else -1)
            return True
        for frame in frames:
            self._keep(self._entry_of.get(frame.pts, -1), frame)
        return True

    def _keep(self, entry: int, frame: VideoFrame) -> None:
        self.frames_decoded += 1
        if entry < self._floor:
            return
        if frame.is_corrupt:
            self._note_damage(entry)
        self._next = max(self._next, entry + 1)
        self._fresh[entry] = frame
        self._release()

    def _release(self) -> None:
        """Make ready the frames for which all that they may build on has come out, damaged or not."""
        ready = [entry for entry in self._fresh if self._index.reach[entry] < self._next]
        for entry in ready:
            self._kept[entry] = self._fresh.pop(entry)
        while len(self._kept) > self._kept_frames:
            self._kept.popitem(last=False)

    def _note_damage(self, entry: int) -> None:
        """Mark `entry` and all that is decoded after it up to the next key frame: they may build on it."""
        if entry < self._floor:
            return
        at = self._index
        following = [key for key in at.keys if at.position[key] > at.position[entry]]
        end = following[0] if following else len(at.pts)
        self._damaged.update(i for i in range(end) if at.position[i] >= at.position[entry])

    def _open_at_start(self, where: str) -> InputContainer:
        try:
            self._container = container = _open_container(self.name)
        except InputError as error:
            raise FrameError(error.what, where=where, hint=error.hint) from error
        stream = container.streams.video[0]
        if stream.codec_context.name not in ("h264", "hevc"):
            # Decoders paint over damage, most without saying so unless told to stop. h264 and hevc do say
            # so, and would stop for nothing after a seek into an open group of pictures.
            stream.codec_context.options = {"err_detect": "explode"}
        self._floor = self._next = 0
        self._packets = container.demux(stream)
        return container


def _open_container(spec: str) -> InputContainer:
    try:
        import av
        import av.error
    except ImportError as error:
        hint = "pip install 'fusionprep[video]'"
        raise InputError("reading video needs PyAV", where=spec, hint=hint) from error
    try:
        container = av.open(f"file:{spec}")  # a colon in a name is no protocol
    except (av.error.FFmpegError, OSError) as error:
        why = error.strerror or str(error)
        hint = "the file is damaged, truncated or of another kind"
        raise InputError(f"cannot be opened as video: {why}", where=spec, hint=hint) from error
    if not container.streams.video:
        container.close()
        raise InputError("the file holds no video stream", where=spec)
    return container


def _read_index(spec: str, max_pixels: int) -> _Index:
    with _open_container(spec) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        if context.width * context.height > max_pixels:
            size = f"{context.width} x {context.height}"
            raise InputError(f"claims {size} pixels, more than the limit of {max_pixels}", where=spec)
        if stream.time_base is None:
            raise _no_stamps(spec)
        rows = list(_packet_rows(container, spec))
        others = len(container.streams.video) - 1
        missing = max(0, stream.frames - len(rows))
        size = max(1, context.width * context.height * 3 // 2)
        return _index(
            [row for row in rows if row.shown], Fraction(stream.time_base), missing, others, size, spec
        )


def _packet_rows(container: InputContainer, spec: str) -> Iterator[_Row]:
    """One row a packet in decoding order, as far as the file can be read."""
    from av.error import FFmpegError

    packets = container.demux(container.streams.video[0])
    while True:
        try:
            packet = next(packets)
        except (StopIteration, FFmpegError):
            return
        if packet.size == 0:  # the end
            continue
        if packet.pts is None:
            raise _no_stamps(spec)
        # what an edit list cuts away is in the file but not in the video
        yield _Row(packet.pts, packet.is_keyframe, packet.is_corrupt, not packet.is_discard)


def _no_stamps(spec: str) -> InputError:
    hint = "put it into a container: ffmpeg -r RATE -i FILE -c copy out.mkv"
    return InputError("the video has no time stamps", where=spec, hint=hint)


def _index(
    rows: list[_Row], time_base: Fraction, missing: int, others: int, frame_bytes: int, spec: str
) -> _Index:
    positions = {row.pts: position for position, row in reversed(list(enumerate(rows)))}
    if not positions:
        raise InputError("the video holds no frames", where=spec)
    pts = sorted(positions)
    position = [positions[p] for p in pts]
    keys = [i for i, at in enumerate(position) if rows[at].key]
    key = [keys[bisect_right(keys, i) - 1] if keys and keys[0] <= i else 0 for i in range(len(pts))]
    reach, furthest = [0] * len(pts), 0
    for i in sorted(range(len(pts)), key=position.__getitem__):
        reach[i] = furthest = max(furthest, i)
    damaged = [i for i, at in enumerate(position) if rows[at].damaged]
    same_time = len(rows) - len(pts)
    return _Index(
        pts, position, key, reach, keys, damaged, time_base, missing, others + same_time, frame_bytes
    )


def _entries(spec: str, index: _Index) -> list[Entry]:
    """One entry a frame found, then one for each that is announced but not there."""
    name, count = Path(spec).name, len(index.pts) + index.missing
    digits = max(6, len(str(count - 1)))
    stamps = [*(round(pts * index.time_base * 10**9) for pts in index.pts), *[None] * index.missing]
    return [
        Entry(f"frame_{i:0{digits}d}", f"{name} frame {i}", stamp, spec) for i, stamp in enumerate(stamps)
    ]


def _open_video(spec: str, role: Role, *, fir_colour: FirColour, max_pixels: int) -> VideoSource:
    return VideoSource(spec, role, fir_colour=fir_colour, max_pixels=max_pixels)


VIDEO = SourceKind(
    "a video file",
    lambda spec: Path(spec).suffix.lower() in VIDEO_SUFFIXES and Path(spec).is_file(),
    _open_video,
)
