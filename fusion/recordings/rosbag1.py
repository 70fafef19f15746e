"""rosbag1 (.bag, version 2.0): opened and read by its index, scanned where it has none or a damaged one."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import BinaryIO

from fusion.errors import InputError
from fusion.recordings import rosbag1_records as r
from fusion.recordings.base import Packet, Recording, RecordingKind, Topic
from fusion.recordings.chunks import LAST_NS, Chunk, ChunkedRecording, Contents, Layout, Request, merge_topics
from fusion.recordings.files import DamagedError, byte_size, first_bytes, open_bytes, read_at
from fusion.recordings.unpack import MAX_CHUNK_BYTES, unpack, unpack_beginning

MAX_INDEX_BYTES = 1 << 28
_FIRST = len("#ROSBAG V2.0\n")
_HEADER_BYTES = 4096  # what all writers pad the bag's header to
_new_packet = tuple.__new__  # half the cost of calling Packet


class Rosbag1(ChunkedRecording):
    """See `Recording`. Connections of one topic and type whose md5 sums agree are one topic."""

    form = "rosbag1"

    def __init__(self, path: str, shown: str | None = None) -> None:
        super().__init__(path, shown)
        self._connections: dict[int, tuple[Topic, str]] = {}  # with their md5 sums
        self._chunks: list[Chunk] = []
        self._counts: dict[int, int] = {}
        with open_bytes(path) as file:
            self._size = byte_size(file)
            _check_magic(self.shown, file, self._size)
            if not self._by_index(file):
                self._scan(file)
        if self.faults and not self._connections:
            raise InputError(f"nothing of it can be read: {self.faults[0]}", where=self.shown)
        self._list_topics()

    def _list_topics(self) -> None:
        topics = {key: topic for key, (topic, _) in self._connections.items()}
        sums = {key: md5 or topic.schema for key, (topic, md5) in self._connections.items()}
        self.topics, self.ids = merge_topics(topics, sums.__getitem__, self._counts)
        if self._chunks:
            first, last = min(c.start_ns for c in self._chunks), max(c.end_ns for c in self._chunks)
            self.span_ns: tuple[int, int] | None = (first, last + 1)

    # Opening by the index

    def _by_index(self, file: BinaryIO) -> bool:
        try:
            header = r.read_record(file, _FIRST, self._size).fields
            if header.op != r.BAG_HEADER:
                raise DamagedError(f"there is no header at byte {_FIRST}")
            if encryptor := header.get(b"encryptor"):
                hint = "decrypt it with the ROS tools first"
                what = f"is encrypted with {r.text_of(encryptor)!r}"
                raise InputError(what, where=self.shown, hint=hint)
            place = header.u64(b"index_pos")
            if place == 0:
                raise DamagedError("was not finished: it has no index")
            self._read_index(file, place, header.u32(b"conn_count"), header.u32(b"chunk_count"))
        except DamagedError as damage:
            self._connections, self._chunks, self._counts = {}, [], {}
            self.noted.add(f"{self.shown}: {damage}: read from its beginning instead")
            return False
        return True

    def _read_index(self, file: BinaryIO, place: int, connections: int, chunks: int) -> None:
        """All of it must be there and make sense, or `DamagedError`."""
        if not _FIRST < place <= self._size:
            raise DamagedError(f"its index should be at byte {place}, and it ends at byte {self._size}")
        if self._size - place > MAX_INDEX_BYTES:
            raise DamagedError(
                f"its index of {self._size - place} bytes is above the limit of {MAX_INDEX_BYTES}"
            )
        data = memoryview(read_at(file, place, self._size - place))
        at, infos = 0, 0
        for _ in range(connections + chunks):
            record = r.record_in(data, at)
            body = data[record.start : record.stop]
            if record.fields.op == r.CONNECTION:
                self._learn(record.fields, body)
            elif record.fields.op == r.CHUNK_INFO:
                self._info(record.fields, body, place)
                infos += 1
            at = record.stop
        if infos != chunks or self._counts.keys() - self._connections.keys():
            raise DamagedError("its index is damaged: chunks or connections are missing")

    def _learn(self, fields: r.Fields, data: r.Bytes) -> None:
        key, topic, md5 = r.connection(fields, data)
        self._connections.setdefault(key, (topic, md5))

    def _info(self, fields: r.Fields, data: r.Bytes, place: int) -> None:
        offset, start, end, counts = r.chunk_info(fields, data)
        if not _FIRST < offset < place or start > end:
            raise DamagedError(f"its index names a chunk at byte {offset} that cannot be there")
        if counts:
            self._chunks.append(Chunk(start, end, offset, 0, frozenset(counts)))
            self._add(counts)

    def _add(self, counts: Mapping[int, int]) -> None:
        for key, count in counts.items():
            self._counts[key] = self._counts.get(key, 0) + count

    # Opening without one

    def _scan(self, file: BinaryIO) -> None:
        """From record to record; behind each chunk stands what is in it, by connection."""
        at, chunk, behind = self._after_header(file), None, {}
        try:
            while at < self._size:
                record = r.read_record(file, at, self._size)
                if record.fields.op != r.INDEX:
                    self._finish(file, chunk, behind)
                    chunk, behind = None, {}
                if record.fields.op == r.CHUNK:
                    chunk = Chunk(0, 0, at, record.stop - at, cut=self._is_cut(record))
                    if chunk.cut:
                        raise DamagedError(f"ends at byte {self._size}, inside the chunk at byte {at}")
                elif record.stop > self._size:
                    raise DamagedError(f"ends at byte {self._size}, inside the record at byte {at}")
                elif record.fields.op in (r.INDEX, r.CONNECTION):
                    self._take(file, record, behind)
                at = record.stop
        except DamagedError as damage:
            self.noted.add(f"{self.shown}: {damage}")
        # Where records end behind a chunk, some of its indexes may be missing: it is looked into instead.
        self._finish(file, chunk, {})

    def _after_header(self, file: BinaryIO) -> int:
        try:
            return r.read_record(file, _FIRST, self._size).stop
        except DamagedError:
            return _FIRST + _HEADER_BYTES

    def _is_cut(self, record: r.Record) -> bool:
        # A recorder writes the sizes of a chunk when it closes it: until then both are 0.
        unfinished = record.start == record.stop < self._size and record.fields.u32(b"size") == 0
        return record.stop > self._size or unfinished

    def _take(self, file: BinaryIO, record: r.Record, behind: dict[int, tuple[int, int, int]]) -> None:
        length = record.stop - record.start
        if length > MAX_INDEX_BYTES:
            raise DamagedError(f"a record of {length} bytes is above the limit of {MAX_INDEX_BYTES}")
        data = read_at(file, record.start, length)
        if record.fields.op == r.CONNECTION:
            self._learn(record.fields, data)
        else:
            key, *rest = r.index_times(record.fields, data)
            behind[key] = (rest[0], rest[1], rest[2])

    def _finish(self, file: BinaryIO, chunk: Chunk | None, behind: dict[int, tuple[int, int, int]]) -> None:
        """Put a chunk on the list: by what stands behind it, or else by what is in it."""
        if chunk is None:
            return
        if behind and behind.keys() <= self._connections.keys():
            start, end = min(row[1] for row in behind.values()), max(row[2] for row in behind.values())
            self._chunks.append(chunk._replace(start_ns=start, end_ns=end, ids=frozenset(behind)))
            self._add({key: row[0] for key, row in behind.items()})
            return
        try:
            contents = Contents(self._unpacked(file, chunk))
        except DamagedError as damage:
            self.noted.add(f"{self.shown}: the chunk at byte {chunk.offset} is left out: {damage}")
            return
        r.walk(contents, (0, LAST_NS), range(1 << 32), self._learn)
        contents.sort()
        counts = {key: contents.keys.count(key) for key in set(contents.keys)}
        if counts:
            start, end = contents.times[0], contents.times[-1]
            self._chunks.append(chunk._replace(start_ns=start, end_ns=end, ids=frozenset(counts)))
            self._add(counts)

    # Reading

    def chunks(self, file: BinaryIO) -> Sequence[Chunk]:
        """See `ChunkedRecording`."""
        del file
        return self._chunks

    def _layout(self) -> Layout:
        return self

    def _unpacked(self, file: BinaryIO, chunk: Chunk) -> r.Bytes:
        record = r.read_record(file, chunk.offset, self._size)
        if record.fields.op != r.CHUNK:
            raise DamagedError("there is no chunk")
        form, size = record.fields.text(b"compression"), record.fields.u32(b"size")
        if chunk.cut:
            data = read_at(file, record.start, min(self._size - record.start, MAX_CHUNK_BYTES))
            return unpack_beginning(form, data, size or MAX_CHUNK_BYTES)
        length = record.stop - record.start
        if length > MAX_CHUNK_BYTES or record.stop > self._size:
            raise DamagedError(
                f"claims {length} bytes, which is beyond the end or the limit of {MAX_CHUNK_BYTES}"
            )
        return unpack(form, read_at(file, record.start, length), size)

    def contents(self, file: BinaryIO, chunk: Chunk, request: Request) -> Contents:
        """See `Layout`."""
        contents = Contents(self._unpacked(file, chunk))
        span = request.start_ns, request.end_ns
        others, problem = r.walk(contents, span, request.topics.keys())
        if missing := others - self._connections.keys():
            which = ", ".join(map(str, sorted(missing)[:5]))
            self.noted.add(f"{self.shown}: messages of undeclared connections are left out: {which}")
        if problem and not chunk.cut:
            self.noted.add(f"{self.shown}: the chunk at byte {chunk.offset} is damaged: {problem}")
        return contents

    def data(self, file: BinaryIO, chunk: Chunk) -> r.Bytes:
        """See `Layout`."""
        return self._unpacked(file, chunk)

    def emit(
        self, contents: Contents, first: int, stop: int, topics: Mapping[int, Topic]
    ) -> Iterator[Packet]:
        """See `Layout`."""
        data, view, number = contents.data, memoryview(contents.data), r.U32.unpack_from
        for key, log_ns, at in contents.rows(first, stop):
            begin = at + 8 + number(data, at)[0]
            end = begin + number(data, begin - 4)[0]
            yield _new_packet(Packet, (topics[key], log_ns, view[begin:end]))


def _check_magic(path: str, file: BinaryIO, size: int) -> None:
    try:
        found = read_at(file, 0, min(size, _FIRST + 8))
    except DamagedError as damage:
        raise InputError(f"cannot be read: {damage}", where=path) from None
    if found.startswith(b"#ROSBAG V2.0\n"):
        return
    if version := re.match(rb"#ROS(?:BAG|RECORD) V(\d+\.\d+)", found):
        hint = "bring it to version 2.0 with `rosbag fix` where ROS 1 is installed"
        raise InputError(
            f"is a bag of version {version[1].decode()}, which is not known", where=path, hint=hint
        )
    raise InputError(f"is no bag: it {f'begins with {found[:12]!r}' if found else 'is empty'}", where=path)


def _accepts(path: str) -> bool:
    head = first_bytes(path)
    return head.startswith((b"#ROSBAG V", b"#ROSRECORD V")) or (
        path.lower().endswith((".bag", ".bag.active"))
        and not head.startswith((b"\x89MCAP", b"SQLite format 3"))
    )


def _open(path: str) -> Recording:
    return Rosbag1(path)


ROSBAG1 = RecordingKind("rosbag1 (.bag)", _accepts, _open)
