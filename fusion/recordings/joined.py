"""Several files that are one recording: their topics brought together, their messages merged by log time."""

from __future__ import annotations

import heapq
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from fusion.errors import InputError
from fusion.recordings.base import Packet, Recording, Topic
from fusion.recordings.files import DamagedError, Faults, Workspace
from fusion.recordings.unpack import unpack_message

_new_packet = tuple.__new__


class Part(Recording, Protocol):
    """A recording of one file that can speak of its topics as a larger one does."""

    def adopt(self, names: Mapping[Topic, Topic]) -> None: ...


@dataclass(slots=True)
class PartFile:
    """One of the files. It is opened when it is needed, for it may have to be unpacked first."""

    name: str
    open: Callable[[], Part]
    claimed_ns: tuple[int, int] | None = None  # what the metadata say of it; (0, 0) where it has no message
    part: Part | None = None

    @property
    def span_ns(self) -> tuple[int, int] | None:
        if self.part is not None:
            return self.part.span_ns
        return self.claimed_ns if self.claimed_ns and self.claimed_ns[0] < self.claimed_ns[1] else None


class _AllFaults(Faults):
    """The lines of the whole, and those of its parts."""

    def __init__(self, own: Faults, parts: list[PartFile]) -> None:
        super().__init__()
        self._own, self._parts = own, parts

    def lines(self) -> list[str]:
        return [*self._own, *(line for file in self._parts if file.part for line in file.part.faults)]


@dataclass
class JoinedRecording:
    """See `Recording`. `packing` is how each message is packed on its own, "" where they are not."""

    name: str
    form: str
    files: Sequence[str]
    parts: list[PartFile]
    topics: Sequence[Topic]
    noted: Faults
    packing: str = ""
    workspace: Workspace = field(default_factory=Workspace)

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._closed = False
        self.faults: Sequence[str] = _AllFaults(self.noted, self.parts)
        for file in self.parts:
            if file.part is not None:
                self._adopt(file.part)
        spans = [file.span_ns for file in self.parts if file.span_ns is not None]
        self.span_ns: tuple[int, int] | None = None
        if spans:
            self.span_ns = (min(s[0] for s in spans), max(s[1] for s in spans))

    def _adopt(self, part: Part) -> None:
        """A topic that only this part has, which the metadata should have named, joins the others."""
        known = {topic: topic for topic in self.topics}
        named = {(topic.name, topic.schema.name, topic.encoding): topic for topic in self.topics}
        names: dict[Topic, Topic] = {}
        for topic in part.topics:
            key = topic.name, topic.schema.name, topic.encoding
            like = named.get(key)
            same = known.get(topic) or (
                like if like and not (like.schema.form and topic.schema.form) else None
            )
            names[topic] = same or topic
        self.topics = [*self.topics, *(topic for topic in names.values() if topic not in known)]
        part.adopt(names)

    def _part(self, file: PartFile) -> Part | None:
        with self._lock:
            if file.part is None:
                try:
                    part = file.open()
                except InputError as error:
                    self.noted.add(f"{error}: left out")
                    file.open, file.claimed_ns = _raise(error), None
                    return None
                self._adopt(part)
                file.part = part
            return file.part

    def packets(
        self, topics: Collection[Topic] | None = None, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Packet]:
        """See `Recording.packets`."""
        if self._closed:
            raise ValueError("the recording is closed")
        found = self._merged(topics, start_ns, end_ns)
        return self._unpacked(found) if self.packing else found

    def _unpacked(self, packets: Iterator[Packet]) -> Iterator[Packet]:
        lost: dict[str, int] = {}
        for topic, log_ns, data in packets:
            try:
                yield _new_packet(Packet, (topic, log_ns, unpack_message(self.packing, data)))
            except DamagedError:
                lost[topic.name] = lost.get(topic.name, 0) + 1
        for name, count in lost.items():
            self.noted.add(f"{self.files[0]}: {name}: {count} messages cannot be unpacked and are left out")

    def _merged(
        self, topics: Collection[Topic] | None, start_ns: int | None, end_ns: int | None
    ) -> Iterator[Packet]:
        """Files follow each other; where they overlap in time they are read side by side."""
        waiting = deque(self._touched(start_ns, end_ns))
        if len(waiting) == 1:
            part = self._part(waiting[0][2])
            yield from part.packets(topics, start_ns, end_ns) if part is not None else ()
            return
        active: list[tuple[int, int, Packet, Iterator[Packet]]] = []
        while waiting or active:
            # 1. every file that begins before the next message, or with it, takes part
            while waiting and (not active or waiting[0][0] <= active[0][0]):
                _, order, file = waiting.popleft()
                part = self._part(file)
                if part is not None:
                    self._advance(active, order, part.packets(topics, start_ns, end_ns))
            # 2. one alone is read up to where another begins
            if len(active) == 1:
                _, order, packet, packets = active.pop()
                limit = waiting[0][0] if waiting else None
                while limit is None or packet.log_ns < limit:
                    yield packet
                    following = next(packets, None)
                    if following is None:
                        break
                    packet = following
                else:
                    active.append((packet.log_ns, order, packet, packets))
            elif active:
                _, order, packet, packets = heapq.heappop(active)
                yield packet
                self._advance(active, order, packets)

    def _advance(
        self, active: list[tuple[int, int, Packet, Iterator[Packet]]], order: int, packets: Iterator[Packet]
    ) -> None:
        packet = next(packets, None)
        if packet is not None:
            heapq.heappush(active, (packet.log_ns, order, packet, packets))

    def _touched(self, start_ns: int | None, end_ns: int | None) -> list[tuple[int, int, PartFile]]:
        """(start, order, file) of those with messages in the range, by time."""
        found = []
        for order, file in enumerate(self.parts):
            span = file.span_ns
            if span is None or (end_ns is not None and span[0] >= end_ns):
                continue
            if start_ns is None or span[1] > start_ns:
                found.append((span[0], order, file))
        return sorted(found, key=lambda row: row[:2])

    def close(self) -> None:
        self._closed = True
        for file in self.parts:
            if file.part is not None:
                file.part.close()
        self.workspace.close()


def _raise(error: InputError) -> Callable[[], Part]:
    def opened() -> Part:
        raise error

    return opened
