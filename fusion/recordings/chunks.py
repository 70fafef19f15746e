"""Messages of a file made of chunks, in the order of their log times, with few chunks in memory.

rosbag1 and MCAP are both lists of chunks that say what they hold. The libraries' readers merge single
messages (rosbags: an index of all messages of the file in memory; mcap: a heap of messages that are objects).
Here whole chunks are merged: where they do not overlap in time, which is the rule, one is read to its end.
"""

from __future__ import annotations

import heapq
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import BinaryIO, NamedTuple, Protocol

import numpy as np

from fusion.errors import InputError
from fusion.recordings.base import Packet, Topic
from fusion.recordings.files import DamagedError, Faults, open_bytes, stem

KEPT_BYTES = 1 << 28  # unpacked chunks that overlap in time and are kept; others are read again when needed
MAX_READ_AGAIN = 1 << 33  # bytes unpacked more than once before a recording is refused as hopelessly shuffled
MAX_OTHERS = 1 << 20  # records of one chunk that are no messages
LAST_NS = 1 << 64  # after every log time


class Chunk(NamedTuple):
    """A piece of a file that is read at once: `length` bytes from `offset`, with log times in
    [`start_ns`, `end_ns`]. `ids` are its connections, None where that is not known. `loose` is a run of
    records that stand in no chunk; `cut` one that the file ends in.
    """

    start_ns: int
    end_ns: int
    offset: int
    length: int
    ids: frozenset[int] | None = None
    loose: bool = False
    cut: bool = False

    def key(self) -> tuple[int, int]:
        return self.start_ns, self.offset


@dataclass(slots=True)
class Contents:
    """An unpacked chunk and which of its messages are wanted: the record at `places[i]` in `data` was logged
    at `times[i]` by connection `keys[i]`."""

    data: bytes | memoryview
    times: array[int] = field(default_factory=lambda: array("Q"))
    places: array[int] = field(default_factory=lambda: array("I"))  # a chunk is at most 1 GiB
    keys: array[int] = field(default_factory=lambda: array("I"))

    def rows(self, first: int, stop: int) -> Iterator[tuple[int, int, int]]:
        """(connection, log time, place) of the messages `first` to `stop`."""
        return zip(self.keys[first:stop], self.times[first:stop], self.places[first:stop], strict=True)

    def sort(self) -> None:
        """By log time; what is equal stays in its order."""
        times = np.frombuffer(self.times, np.uint64)
        if len(times) > 1 and np.any(times[1:] < times[:-1]):
            order = np.argsort(times, kind="stable")
            self.times = array("Q", times[order].tobytes())
            self.places = array("I", np.frombuffer(self.places, np.uint32)[order].tobytes())
            self.keys = array("I", np.frombuffer(self.keys, np.uint32)[order].tobytes())


class Request(NamedTuple):
    """What one call of `packets` asks for: topics by connection, log times in [`start_ns`, `end_ns`)."""

    topics: Mapping[int, Topic]
    start_ns: int
    end_ns: int

    def touches(self, chunk: Chunk) -> bool:
        """Whether it can hold anything that was asked for."""
        within = chunk.start_ns < self.end_ns and chunk.end_ns >= self.start_ns
        return within and (chunk.ids is None or not chunk.ids.isdisjoint(self.topics))


class Layout(Protocol):
    """What a format knows of its chunks."""

    def contents(self, file: BinaryIO, chunk: Chunk, request: Request) -> Contents:
        """Read, unpack and walk through a chunk; raises `DamagedError`. What is odd goes to the faults."""
        ...

    def data(self, file: BinaryIO, chunk: Chunk) -> bytes | memoryview:
        """Read and unpack it once more, without walking."""
        ...

    def emit(
        self, contents: Contents, first: int, stop: int, topics: Mapping[int, Topic]
    ) -> Iterator[Packet]:
        """The messages `first` to `stop` of a chunk."""
        ...


class ChunkedRecording:
    """A `Recording` of chunks; the formats fill it and are its `Layout`."""

    form = ""

    def __init__(self, path: str, shown: str | None = None) -> None:
        """`shown` is what messages call the file, where `path` is a copy of it."""
        self.path, self.shown = path, shown or path
        self.name = stem(self.shown)
        self.files: Sequence[str] = (self.shown,)
        self.topics: Sequence[Topic] = ()
        self.span_ns: tuple[int, int] | None = None
        self.noted = Faults()
        self.faults: Sequence[str] = self.noted
        self.ids: dict[int, Topic] = {}  # connections: several may be one topic
        self._closed = False

    def packets(
        self, topics: Collection[Topic] | None = None, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Packet]:
        """See `Recording.packets`."""
        if self._closed:
            raise ValueError("the recording is closed")
        wanted = None if topics is None else set(topics)
        ids = {key: topic for key, topic in self.ids.items() if wanted is None or topic in wanted}
        request = Request(ids, max(start_ns or 0, 0), LAST_NS if end_ns is None else end_ns)
        return self._read(request) if ids and request.start_ns < request.end_ns else iter(())

    def _read(self, request: Request) -> Iterator[Packet]:
        with open_bytes(self.path) as file:
            chunks = sorted(filter(request.touches, self.chunks(file)), key=Chunk.key)
            yield from _Merge(self._layout(), file, request, self.noted, self.shown).run(chunks)

    def adopt(self, names: Mapping[Topic, Topic]) -> None:
        """Say the equal topics of a larger recording instead of its own."""
        self.ids = {key: names[topic] for key, topic in self.ids.items()}
        self.topics = tuple(names[topic] for topic in self.topics)

    def chunks(self, file: BinaryIO) -> Sequence[Chunk]:
        """All chunks of the file."""
        raise NotImplementedError

    def _layout(self) -> Layout:
        raise NotImplementedError

    def close(self) -> None:
        self._closed = True


@dataclass(slots=True)
class _Cursor:
    """How far a chunk has been read. `data` of the contents may have been let go."""

    chunk: Chunk
    contents: Contents
    at: int = 0
    kept: bool = True

    def key(self) -> tuple[int, int]:
        return self.contents.times[self.at], self.chunk.offset

    def __lt__(self, other: _Cursor) -> bool:
        return self.key() < other.key()


class _Merge:
    """Reads chunks in the order of their times; those that overlap are read side by side."""

    def __init__(self, layout: Layout, file: BinaryIO, request: Request, faults: Faults, path: str) -> None:
        self.layout, self.file, self.request, self.noted, self.path = layout, file, request, faults, path
        self.open: list[_Cursor] = []  # a heap by the next message
        self.kept = self.again = 0

    def run(self, chunks: Sequence[Chunk]) -> Iterator[Packet]:
        """`chunks` are sorted by `start_ns`."""
        waiting = iter(chunks)
        following = next(waiting, None)
        while self.open or following is not None:
            # 1. every chunk that may begin before the next message, or with it, takes part
            while following is not None and (
                not self.open or following.start_ns <= self.open[0].contents.times[self.open[0].at]
            ):
                self._begin(following)
                following = next(waiting, None)
            if not self.open:
                continue
            # 2. of the chunk with the next message, all until another one has its turn
            cursor = heapq.heappop(self.open)
            stop = self._turn(cursor, following)
            contents = self._held(cursor)
            yield from self.layout.emit(contents, cursor.at, stop, self.request.topics)
            cursor.at = stop
            if stop < len(contents.times):
                heapq.heappush(self.open, cursor)
            elif cursor.kept:
                self.kept -= len(contents.data)

    def _begin(self, chunk: Chunk) -> None:
        try:
            contents = self.layout.contents(self.file, chunk, self.request)
        except DamagedError as damage:
            self.noted.add(f"{self.path}: the chunk at byte {chunk.offset} is left out: {damage}")
            return
        contents.sort()
        if len(contents.times):
            if contents.times[0] < chunk.start_ns or contents.times[-1] > chunk.end_ns:
                odd = "holds log times outside those it claims: order and seeks may miss them"
                self.noted.add(f"{self.path}: the chunk at byte {chunk.offset} {odd}")
            heapq.heappush(self.open, _Cursor(chunk, contents))
            self.kept += len(contents.data)
            self._let_go()

    def _turn(self, cursor: _Cursor, following: Chunk | None) -> int:
        """Up to which message of `cursor`'s chunk nothing else comes between."""
        times, stop = cursor.contents.times, len(cursor.contents.times)
        if following is not None:
            stop = bisect_left(times, following.start_ns, cursor.at)
        if self.open:
            other = self.open[0]
            limit, offset = other.key()
            first = bisect_right if cursor.chunk.offset < offset else bisect_left
            stop = min(stop, first(times, limit, cursor.at))
        return max(stop, cursor.at + 1)

    def _held(self, cursor: _Cursor) -> Contents:
        """Its contents, read again where they had been let go."""
        if not cursor.kept:
            try:
                cursor.contents.data = self.layout.data(self.file, cursor.chunk)
            except DamagedError as damage:  # it was whole a moment ago
                raise InputError(f"changed while it was read: {damage}", where=self.path) from None
            cursor.kept = True
            self.kept += len(cursor.contents.data)
            self.again += len(cursor.contents.data)
            if self.again > MAX_READ_AGAIN:
                hint = "write it again with its messages in the order of their times"
                raise InputError("its chunks are too shuffled in time", where=self.path, hint=hint)
            self._let_go()
        return cursor.contents

    def _let_go(self) -> None:
        """Keep the chunks that come first, up to `KEPT_BYTES`; the others are read again at their turn."""
        if self.kept <= KEPT_BYTES:
            return
        for cursor in sorted((cursor for cursor in self.open if cursor.kept), reverse=True)[:-1]:
            if self.kept <= KEPT_BYTES:
                break
            self.kept -= len(cursor.contents.data)
            cursor.contents.data, cursor.kept = b"", False


def merge_topics(
    connections: Mapping[int, Topic], same: Callable[[int], object], counts: Mapping[int, int] | None
) -> tuple[Sequence[Topic], dict[int, Topic]]:
    """Topics by name, and each connection's topic; connections for which `same` is equal become one.

    `counts` are messages by connection, None where the file does not say.
    """
    groups: dict[object, list[int]] = {}
    for key, topic in connections.items():
        groups.setdefault((topic.name, topic.schema.name, topic.encoding, same(key)), []).append(key)
    ids: dict[int, Topic] = {}
    for keys in groups.values():
        first = connections[keys[0]]
        count = None if counts is None else sum(counts.get(key, 0) for key in keys)
        topic = Topic(first.name, first.schema, first.encoding, count)
        ids.update(dict.fromkeys(keys, topic))
    return tuple(sorted(set(ids.values()), key=lambda topic: (topic.name, topic.schema.name))), ids


def normal_type(name: str) -> str:
    """``sensor_msgs/Image`` as ROS 2 has it: ``sensor_msgs/msg/Image``; all other names as they are."""
    package, slash, rest = name.partition("/")
    return f"{package}/msg/{rest}" if slash and rest and "/" not in rest and package else name


def text_of(data: bytes | memoryview) -> str:
    """A name in a recording; what is no UTF-8 is replaced, so that it can be shown."""
    with suppress(UnicodeDecodeError):
        return str(data, "utf-8")
    return str(data, "utf-8", "replace")
