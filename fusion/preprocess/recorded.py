"""A recording as footage: its streams matched while they are read, with a bounded look ahead."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.chunks import Chunk
from fusion.errors import FrameError, InputError
from fusion.frames import FrameSet, Image, PointCloud
from fusion.messages import reader_of
from fusion.messages.base import CompressedImage, MessageReader, Points, RawImage
from fusion.messages.clouds import cloud_of_points
from fusion.messages.images import image_of
from fusion.preprocess.footage import Dropped, Moment
from fusion.recordings import open_recording
from fusion.recordings.base import Packet, Recording, Topic
from fusion.timing.match import margin_ns, match_streams

PLACES, LOOKED_AT = 5, 12  # where streams are looked at for their rates and delays; messages there
SLACK_NS = 300_000_000  # how much beyond the delays seen a message may be late
LONGEST_LOOK_NS = 3_000_000_000
MOST_APART_NS = 30_000_000_000
LIDAR_TOLERANCE_NS = 50_000_000  # half the turn of a scanner at ten a second


@dataclass(frozen=True, slots=True)
class Streams:
    """Which topic plays which role, and how stamps are taken: all in nanoseconds, resolved.

    Roles without a `tolerance_ns` get half the interval of the denser of their stream and the leader's,
    clouds half a turn. `offset_ns` and `drift` bring a role's stamps to the reference's clock:
    own + offset + drift * (own - the recording's begin).
    """

    topics: Mapping[str, Topic]
    lead: str
    stamp: str
    tolerance_ns: Mapping[str, int]
    offset_ns: Mapping[str, int] = field(default_factory=dict)
    drift: Mapping[str, float] = field(default_factory=dict)
    keep_frozen: bool = False
    fir_colour: str = "refuse"
    begin_s: float | None = None
    end_s: float | None = None


@dataclass(slots=True)
class _Item:
    """A message that waits for its partners."""

    role: str
    log_ns: int
    stamp_ns: int | None
    data: bytes | memoryview
    taken: bool = False


@dataclass(frozen=True, slots=True)
class Pace:
    """What samples of a stream tell: its median interval, and log time minus stamp on the reference's clock.

    `delay_ns` is the least and most of it, None where nothing has a stamp.
    """

    interval_ns: int
    delay_ns: tuple[int, int] | None


class RecordedFootage:
    """The moments of the recording at `path`.

    A chunk owns the messages whose log time lies in it, and reads a margin beyond either end, so that whom a
    message belongs to does not depend on how the recording is cut.
    """

    def __init__(self, path: str, streams: Streams, recording: Recording | None = None) -> None:
        """`recording` is the one at `path` where it is open already: it is closed with the footage."""
        self._path, self.streams, self.has_lidar = path, streams, "lidar" in streams.topics
        self._open(recording)
        if self._recording.span_ns is None:
            raise InputError("the recording has no messages", where=path)
        begin, end = self._recording.span_ns
        self.begin_ns = begin + round(1e9 * (streams.begin_s or 0.0))
        self.end_ns = end if streams.end_s is None else min(end, begin + round(1e9 * streams.end_s))
        if self.begin_ns >= self.end_ns:
            hint = f"the recording lasts {(end - begin) / 1e9:.3f} s"
            raise InputError("no messages in that time range", where=path, hint=hint)
        self.paces = self._paces()
        self.tolerance_ns = {
            role: self._tolerance_ns(role) for role in streams.topics if role != streams.lead
        }
        self._reach_ns = self._reach()
        self.rate_hz = 1e9 / self.paces[streams.lead].interval_ns
        self.positions = 1 + (self.end_ns - 1 - self.begin_ns) // self.paces["fir"].interval_ns

    def _open(self, recording: Recording | None = None) -> None:
        self._recording: Recording = recording or open_recording(self._path)
        self.name = self._recording.name
        self._readers: dict[str, MessageReader] = {}
        self._role: dict[Topic, str] = {}
        for role, topic in self.streams.topics.items():
            self._readers[role], self._role[topic] = reader_of(topic), role

    def __getstate__(self) -> dict[str, Any]:
        opened = ("_recording", "_readers", "_role")
        return {name: value for name, value in self.__dict__.items() if name not in opened}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._open()

    @property
    def recording(self) -> Recording:
        return self._recording

    def pictures(self, role: str, longest_s: float) -> Iterator[Image]:
        """The images of one stream as they come, with their stamps; unreadable ones are left out."""
        end = min(self.end_ns, self.begin_ns + round(1e9 * longest_s))
        for packet in self._recording.packets([self.streams.topics[role]], self.begin_ns, end):
            with suppress(FrameError):
                yield self._image(role, packet.data, packet.log_ns, self._stamp_ns(role, packet))

    def close(self) -> None:
        self._recording.close()

    def describe(self) -> Mapping[str, Any]:
        """The same recording in another container is the same footage: only what was recorded counts."""
        streams = self.streams
        return {
            "kind": "recording",
            "topics": {role: topic.name for role, topic in streams.topics.items()},
            "begin_ns": self.begin_ns,
            "end_ns": self.end_ns,
            "lead": streams.lead,
            "stamp": streams.stamp,
            "tolerance_ns": dict(self.tolerance_ns),
            "offset_ns": dict(streams.offset_ns),
            "drift": dict(streams.drift),
            "keep_frozen": streams.keep_frozen,
        }

    def notes(self) -> Sequence[str]:
        return [*self._recording.faults]

    def chunks(self, chunk_s: float) -> list[Chunk]:
        step = round(1e9 * chunk_s)
        begins = range(self.begin_ns, self.end_ns, step)
        ends = [min(begin + step, self.end_ns) for begin in begins]
        return [
            Chunk(k, begin, end, max(1, round((end - begin) * 1e-9 * self.rate_hz)))
            for k, (begin, end) in enumerate(zip(begins, ends, strict=True))
        ]

    def fir_at(self, position: int) -> Image:
        start = self.begin_ns + position * self.paces["fir"].interval_ns
        packet = next(self._recording.packets([self.streams.topics["fir"]], start, self.end_ns), None)
        if packet is None:
            raise FrameError("no thermal message from there on", where=self._where("fir", start))
        return self._image("fir", packet.data, packet.log_ns, None)

    def moments(self, chunk: Chunk) -> Iterator[Moment | Dropped]:
        waiting: list[_Item] = []
        lost: list[Dropped] = []
        reach, before = self._reach_ns, None
        until = chunk.begin - reach
        for packet in self._recording.packets([*self._role], until, chunk.end + reach):
            if packet.log_ns >= until + 2 * reach:
                until = packet.log_ns - reach
                yield from self._settled(waiting, chunk, until)
                waiting = [item for item in waiting if item.log_ns >= until - reach]
            item, reason = self._item(packet)
            if not reason and item.role == "fir" and not self.streams.keep_frozen:
                content = self._content(packet.data)
                if before is not None and content is not None and np.array_equal(before, content):
                    reason = "frozen: repeats the frame before"
                before = content
            if not reason:
                waiting.append(item)
            elif chunk.begin <= item.log_ns < chunk.end:
                lost.append(Dropped(item.role, self._where(item.role, item.log_ns), reason))
        yield from self._settled(waiting, chunk, chunk.end + 2 * reach)
        yield from lost

    # --- messages

    def _item(self, packet: Packet) -> tuple[_Item, str]:
        role = self._role[packet.topic]
        stamp, reason = None, ""
        try:
            stamp = self._stamp_ns(role, packet)
            if stamp is None:
                reason = "no stamp in its header (--stamp log takes log times)"
            elif not self._plausible(role, packet.log_ns - stamp):
                reason = "its stamp jumps away from the time it was recorded at (--stamp log takes log times)"
        except FrameError as error:
            reason = error.what
        return _Item(role, packet.log_ns, stamp, packet.data), reason

    def _plausible(self, role: str, delay_ns: int) -> bool:
        seen = self.paces[role].delay_ns
        return seen is None or seen[0] - SLACK_NS <= delay_ns <= seen[1] + SLACK_NS

    def _stamp_ns(self, role: str, packet: Packet) -> int | None:
        own = packet.log_ns
        if self.streams.stamp == "header":
            header = self._readers[role].header(packet.data).stamp_ns
            if header is None:
                return None
            own = header
        drifted = round(self.streams.drift.get(role, 0.0) * (own - self.begin_ns))
        return own + self.streams.offset_ns.get(role, 0) + drifted

    def _content(self, data: bytes | memoryview) -> NDArray[np.uint8] | None:
        """What a camera that shows its last picture again repeats: not the telemetry in the outermost
        rows."""
        try:
            message = self._readers["fir"].message(data)
        except FrameError:
            return None
        if isinstance(message, RawImage):
            edge = message.step * (message.height // 20)
            return np.frombuffer(message.data, np.uint8)[edge : len(message.data) - edge]
        return np.frombuffer(message.data, np.uint8) if isinstance(message, CompressedImage) else None

    def _image(self, role: Any, data: bytes | memoryview, log_ns: int, stamp_ns: int | None) -> Image:
        where = self._where(role, log_ns)
        message = self._readers[role].message(data)
        if not isinstance(message, RawImage | CompressedImage):
            raise FrameError(f"expected an image, got {type(message).__name__}", where=where)
        stem = str(log_ns if stamp_ns is None else stamp_ns)
        colour: Any = self.streams.fir_colour
        image = image_of(message, role, stem=stem, where=where, fir_colour=colour)
        return replace(image, stamp_ns=stamp_ns)

    def _where(self, role: str, log_ns: int) -> str:
        return f"{self.name} {self.streams.topics[role].name} at {log_ns / 1e9:.6f}"

    # --- matching

    def _settled(self, waiting: list[_Item], chunk: Chunk, until: int) -> Iterator[Moment | Dropped]:
        """What has log times before `until`, is this chunk's, and was not told before."""
        roles = {role: [item for item in waiting if item.role == role] for role in self.streams.topics}
        stamps = {role: [item.stamp_ns for item in items] for role, items in roles.items()}
        optional = frozenset({"lidar"} if self.streams.lead != "lidar" else ())
        matched = match_streams(stamps, self.streams.lead, self.tolerance_ns, optional)

        def ours(item: _Item) -> bool:
            return chunk.begin <= item.log_ns < chunk.end and item.log_ns < until and not item.taken

        for members in matched.sets:
            items = {role: roles[role][index] for role, index in members.items()}
            lead = items[self.streams.lead]
            if ours(lead):
                yield self._moment(lead, items)
            for item in items.values():  # the leader may be forgotten before those that came later
                item.taken = item.taken or item.log_ns < until
        for lost in matched.lost:
            item = roles[lost.role][lost.index]
            if ours(item):
                item.taken = True
                yield Dropped(lost.role, self._where(lost.role, item.log_ns), lost.reason)

    def _moment(self, lead: _Item, items: Mapping[str, _Item]) -> Moment:
        position = (items["fir"].log_ns - self.begin_ns) // self.paces["fir"].interval_ns
        scan = items.get("lidar")
        return Moment(
            str(lead.stamp_ns),
            max(0, position),
            partial(self._images, items["rgb"], items["fir"]),
            None if scan is None else partial(self._cloud, scan),
        )

    def _images(self, rgb: _Item, fir: _Item) -> FrameSet:
        return FrameSet(
            self._image("rgb", rgb.data, rgb.log_ns, rgb.stamp_ns),
            self._image("fir", fir.data, fir.log_ns, fir.stamp_ns),
        )

    def _cloud(self, scan: _Item) -> PointCloud:
        where = self._where("lidar", scan.log_ns)
        message = self._readers["lidar"].message(scan.data)
        if not isinstance(message, Points):
            raise FrameError(f"expected a cloud, got {type(message).__name__}", where=where)
        cloud = cloud_of_points(message, stem=str(scan.stamp_ns), where=where)
        return replace(cloud, stamp_ns=scan.stamp_ns)

    # --- what samples tell

    def _paces(self) -> dict[str, Pace]:
        steps: dict[str, list[int]] = {role: [] for role in self.streams.topics}
        delays: dict[str, list[int]] = {role: [] for role in self.streams.topics}
        seen = Counter[str]()

        def count(role: str, some: Sequence[Packet]) -> None:
            seen[role] += len(some)
            steps[role].extend(later.log_ns - packet.log_ns for packet, later in pairwise(some))
            delays[role].extend(d for d in (self._delay(role, packet) for packet in some) if d is not None)

        for place in range(PLACES):
            for role, some in self._some(place).items():
                count(role, some)
        for role, topic in self.streams.topics.items():
            if not seen[role]:  # it is none of the places: wherever it begins
                packets = self._recording.packets([topic], self.begin_ns, self.end_ns)
                count(role, list(islice(packets, LOOKED_AT)))
            if not seen[role]:
                raise InputError(f"no message on {topic.name}", where=self.name, hint="--begin, --end")
        return {role: self._pace(steps[role], delays[role]) for role in steps}

    def _some(self, place: int) -> dict[str, list[Packet]]:
        """The first messages of each stream from a place in the recording on."""
        span = self.end_ns - self.begin_ns
        found: dict[str, list[Packet]] = {role: [] for role in self.streams.topics}
        start = self.begin_ns + span * place // PLACES
        for packet in self._recording.packets([*self._role], start, self.end_ns):
            some = found[self._role[packet.topic]]
            if len(some) < LOOKED_AT:
                some.append(packet)
            if packet.log_ns > start + LONGEST_LOOK_NS or all(len(s) >= LOOKED_AT for s in found.values()):
                break
        return found

    def _pace(self, steps: Sequence[int], delays: Sequence[int]) -> Pace:
        interval = int(np.median(steps)) if steps else self.end_ns - self.begin_ns
        usual = int(np.median(delays)) if delays else 0
        near = [d for d in delays if abs(d - usual) <= MOST_APART_NS]
        return Pace(max(interval, 1), (min(near), max(near)) if near else None)

    def _tolerance_ns(self, role: str) -> int:
        given = self.streams.tolerance_ns.get(role)
        if given is not None:
            return given
        if "lidar" in (role, self.streams.lead):
            return LIDAR_TOLERANCE_NS
        return min(self.paces[role].interval_ns, self.paces[self.streams.lead].interval_ns) // 2

    def _delay(self, role: str, packet: Packet) -> int | None:
        try:
            stamp = self._stamp_ns(role, packet)
        except FrameError:
            return None
        return None if stamp is None else packet.log_ns - stamp

    def _reach(self) -> int:
        """How far in log time from a message its partners, and their rivals, may lie."""
        delays = [d for pace in self.paces.values() if pace.delay_ns is not None for d in pace.delay_ns]
        apart = max(delays) - min(delays) if delays else 0
        if apart > MOST_APART_NS:
            hint = "--stamp log takes log times; --fir-offset-ms brings thermal to RGB's clock"
            raise InputError(f"the streams' stamps lie {apart / 1e9:.1f} s apart", where=self.name, hint=hint)
        return margin_ns(self.tolerance_ns) + apart + 2 * SLACK_NS
