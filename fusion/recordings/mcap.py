"""MCAP files: opened by their summary, read by their chunk index; scanned where either is missing or bad."""

from __future__ import annotations

import threading
import zlib
from collections.abc import Iterator, Mapping, Sequence
from struct import Struct
from typing import BinaryIO

from fusion.errors import InputError
from fusion.recordings import mcap_records as r
from fusion.recordings.base import Packet, Recording, RecordingKind, Schema, Topic
from fusion.recordings.chunks import Chunk, ChunkedRecording, Contents, Layout, Request, merge_topics
from fusion.recordings.files import DamagedError, byte_size, first_bytes, open_bytes, read_at
from fusion.recordings.mcap_scan import Scan, chunk_data, not_whole, walk

MAX_SUMMARY_BYTES = 1 << 28
_FOOTER = Struct("<BQQQI")  # opcode, 20, where the summary begins, where its offsets begin, CRC
_LENGTH = Struct("<Q")
_new_packet = tuple.__new__  # half the cost of calling Packet


class McapRecording(ChunkedRecording):
    """See `Recording`. Channels of one topic with one schema are one topic."""

    form = "MCAP"

    def __init__(self, path: str, shown: str | None = None) -> None:
        super().__init__(path, shown)
        self._lock = threading.Lock()
        self._gaps: list[tuple[int, int]] = []  # not looked at yet
        with open_bytes(path) as file:
            self._size = byte_size(file)
            _check_magic(self.shown, file, self._size)
            self._known = self._by_summary(file) or self._by_scan(file)
        if self.faults and not self._known.channels:
            raise InputError(f"nothing of it can be read: {self.faults[0]}", where=self.shown)
        self._list_topics()
        self._chunks = list(self._known.chunks.values())

    def _by_summary(self, file: BinaryIO) -> r.Known | None:
        """What the summary says, None where there is none that says enough."""
        try:
            footer = _read_footer(file, self._size)
            known = _read_summary(file, *footer, self._size) if footer[0] else None
        except DamagedError as damage:
            self.noted.add(f"{self.shown}: {damage}: read from its beginning instead")
            return None
        if known is None or not _is_enough(known):
            return None
        self._drop_outside(known)
        self._gaps = _gaps(known, footer[0])
        return known

    def _by_scan(self, file: BinaryIO) -> r.Known:
        known = r.Known(scanned=True)
        Scan(file, self.shown, known, self.noted, self._size).over(len(r.MAGIC), self._size)
        return known

    def _drop_outside(self, known: r.Known) -> None:
        for offset, chunk in list(known.chunks.items()):
            if offset < len(r.MAGIC) or offset + chunk.length > self._size or chunk.start_ns > chunk.end_ns:
                self.noted.add(f"{self.shown}: its index names a chunk at byte {offset} that cannot be there")
                del known.chunks[offset]

    def _list_topics(self) -> None:
        known, statistics = self._known, self._known.statistics
        counts = statistics.counts if statistics else known.counts if known.scanned else None
        connections: dict[int, Topic] = {}
        for key, channel in known.channels.items():
            schema = known.schemas.get(channel.schema_id) or Schema("")
            if channel.schema_id and channel.schema_id not in known.schemas:
                self.noted.add(f"{self.shown}: topic {channel.topic}: its schema is not in the file")
            connections[key] = Topic(channel.topic, schema, channel.encoding)
        self.topics, self.ids = merge_topics(connections, lambda key: connections[key].schema, counts)
        self.span_ns = _span(known)

    def chunks(self, file: BinaryIO) -> Sequence[Chunk]:
        """Those of the index, and what stands between them: messages need not be in chunks."""
        with self._lock:
            gaps, self._gaps = self._gaps, []
            for start, stop in gaps:
                found = r.Known(self._known.schemas, self._known.channels)
                Scan(file, self.shown, found, self.noted, self._size).over(start, stop)
                self._chunks += found.chunks.values()
            return self._chunks

    def _layout(self) -> Layout:
        return self

    def contents(self, file: BinaryIO, chunk: Chunk, request: Request) -> Contents:
        """See `Layout`."""
        contents = Contents(chunk_data(file, chunk))
        others, whole = walk(contents, request.start_ns, request.end_ns, request.topics.keys())
        for key in others - self.ids.keys():
            self.noted.add(f"{self.shown}: messages of channel {key} are left out: it is declared nowhere")
        if not whole and not chunk.cut:
            self.noted.add(f"{self.shown}: {not_whole(chunk)}")
        return contents

    def data(self, file: BinaryIO, chunk: Chunk) -> bytes | memoryview:
        """See `Layout`."""
        return chunk_data(file, chunk)

    def emit(
        self, contents: Contents, first: int, stop: int, topics: Mapping[int, Topic]
    ) -> Iterator[Packet]:
        """See `Layout`."""
        data, view, length = contents.data, memoryview(contents.data), _LENGTH.unpack_from
        head, begin = r.HEAD.size, r.MESSAGE_HEAD.size
        for key, log_ns, at in contents.rows(first, stop):
            end = at + head + length(data, at + 1)[0]
            yield _new_packet(Packet, (topics[key], log_ns, view[at + begin : end]))


def _check_magic(path: str, file: BinaryIO, size: int) -> None:
    try:
        found = read_at(file, 0, min(size, len(r.MAGIC)))
    except DamagedError as damage:
        raise InputError(f"cannot be read: {damage}", where=path) from None
    if found == r.MAGIC:
        return
    if found[:5] == r.MAGIC[:5] and len(found) == len(r.MAGIC) and found[6:] == r.MAGIC[6:]:
        raise InputError(f"is MCAP of version {chr(found[5])!r}; only version 0 is known", where=path)
    what = f"begins with {found!r}" if found else "is empty"
    raise InputError(f"is no MCAP file: it {what}", where=path)


def _read_footer(file: BinaryIO, size: int) -> tuple[int, bytes]:
    """Where the summary begins (0: there is none), and the footer's bytes."""
    cut = f"ends at byte {size} without an end mark: it was not finished or is cut off"
    if size < len(r.MAGIC) + r.FOOTER_SIZE:
        raise DamagedError(cut)
    data = read_at(file, size - r.FOOTER_SIZE, r.FOOTER_SIZE)
    opcode, length, start, _, _ = _FOOTER.unpack_from(data)
    if data[-len(r.MAGIC) :] != r.MAGIC or opcode != r.FOOTER or length != 20:
        raise DamagedError(cut)
    if start and not len(r.MAGIC) <= start <= size - r.FOOTER_SIZE:
        raise DamagedError(f"its summary should be at byte {start}, where it cannot be")
    return start, data


def _read_summary(file: BinaryIO, start: int, footer: bytes, size: int) -> r.Known:
    length = size - r.FOOTER_SIZE - start
    if length > MAX_SUMMARY_BYTES:
        raise DamagedError(f"its summary of {length} bytes is above the limit of {MAX_SUMMARY_BYTES}")
    data = read_at(file, start, length)
    (_, _, _, _, crc) = _FOOTER.unpack_from(footer)
    if crc and zlib.crc32(footer[: _FOOTER.size - 4], zlib.crc32(data)) != crc:
        raise DamagedError("its summary is damaged, which its CRC tells")
    known = r.Known()
    for opcode, body in r.records(data, start):
        known.learn(opcode, body)
    return known


def _is_enough(known: r.Known) -> bool:
    """Whether all that occurs is declared, and where things are is known."""
    used = set(known.statistics.counts) if known.statistics else set()
    used.update(*{chunk.ids for chunk in known.chunks.values() if chunk.ids is not None})
    schemas = {known.channels[key].schema_id for key in used & known.channels.keys()} - {0}
    declared = used <= known.channels.keys() and schemas <= known.schemas.keys()
    return declared and (known.statistics is not None or bool(known.chunks))


def _gaps(known: r.Known, stop: int) -> list[tuple[int, int]]:
    """The stretches before the summary that are no chunks with their indexes, no attachments, no metadata."""
    taken = [(offset, known.ends[offset]) for offset in known.chunks]
    taken += [(offset, offset + length) for offset, length in known.apart.items()]
    gaps, at = [], len(r.MAGIC)
    for start, end in sorted(taken):
        if start > at:
            gaps.append((at, start))
        at = max(at, end)
    return [*gaps, (at, stop)] if at < stop else gaps


def _span(known: r.Known) -> tuple[int, int] | None:
    statistics = known.statistics
    if statistics is not None:
        first, last = statistics.start_ns, statistics.end_ns
        return (first, max(first, last) + 1) if statistics.messages else None
    chunks = [chunk for chunk in known.chunks.values() if chunk.ids is None or chunk.ids]
    if not chunks:
        return None
    return min(chunk.start_ns for chunk in chunks), max(chunk.end_ns for chunk in chunks) + 1


def _accepts(path: str) -> bool:
    head = first_bytes(path, len(r.MAGIC))
    return head.startswith(r.MAGIC[:5]) or path.lower().endswith((".mcap", ".mcap.active"))


def _open(path: str) -> Recording:
    return McapRecording(path)


MCAP = RecordingKind("MCAP (.mcap)", _accepts, _open)
