"""MCAP from its beginning to where it ends, for files whose summary is missing, damaged or not all there is.

Message indexes tell what a chunk holds, so that only chunks without them, or with channels not seen before,
are unpacked. Messages in no chunk are gathered to runs of about a mebibyte, which are read like chunks.
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass, field
from typing import BinaryIO

from fusion.recordings import mcap_records as r
from fusion.recordings.chunks import LAST_NS, MAX_OTHERS, Chunk, Contents
from fusion.recordings.files import DamagedError, Faults, read_at
from fusion.recordings.unpack import MAX_CHUNK_BYTES, check_size, crc32, unpack, unpack_beginning

RUN_BYTES = 1 << 20
_MIN_MESSAGE = 22


@dataclass(slots=True)
class Scan:
    """Reads records from `start` to `stop`, and takes what it learns to `known`."""

    file: BinaryIO
    path: str
    known: r.Known
    faults: Faults
    size: int  # of the file
    chunk: Chunk | None = None  # whose message indexes are being read
    indexed: dict[int, int] = field(default_factory=dict)  # its messages by channel
    run: list[int] = field(default_factory=list)  # start, end, offset, length of loose messages
    run_ids: set[int] = field(default_factory=set)

    def over(self, start: int, stop: int) -> int:
        """Returns where it ended: `stop`, after the data's end mark, or where the file breaks off."""
        at = start
        while at < stop:
            try:
                after = self._record(at)
            except DamagedError as damage:
                self._finish_broken()
                self.faults.add(f"{self.path}: {damage}")
                return at
            if after is None:
                break
            at = after
        self._finish_broken()
        return at

    def _finish_broken(self) -> None:
        """Where records end with the indexes of a chunk, some may be missing: it is looked into instead."""
        self.indexed = {}
        self._finish_chunk()
        self._finish_run()

    def _record(self, at: int) -> int | None:
        """Take in the record at `at`; where the next one is, None where the data end here."""
        head = read_at(self.file, at, min(r.MESSAGE_HEAD.size, self.size - at))
        if len(head) < r.HEAD.size:
            raise DamagedError(f"ends at byte {self.size}, inside a record")
        opcode, length = r.HEAD.unpack_from(head)
        body, after = at + r.HEAD.size, at + r.HEAD.size + length
        if opcode == 0:
            raise DamagedError(f"no record at byte {at}: what follows is not read")
        if opcode != r.MESSAGE_INDEX:
            self._finish_chunk()
        if opcode != r.MESSAGE:
            self._finish_run()
        if after > self.size:
            if opcode == r.CHUNK:
                self._cut_chunk(at)
            kind = "the chunk" if opcode == r.CHUNK else "a record"
            raise DamagedError(f"ends at byte {self.size}, inside {kind} at byte {at} of {length} bytes")
        self._take(opcode, at, body, after, head)
        return None if opcode == r.DATA_END else after

    def _take(self, opcode: int, at: int, body: int, after: int, head: bytes) -> None:
        if opcode == r.MESSAGE:
            self._message(at, after, head)
        elif opcode == r.CHUNK:
            start, end = chunk_times(self.file, at, after)
            self.chunk = Chunk(start, end, at, after - at)
        elif opcode == r.MESSAGE_INDEX:
            if after - body < 6:
                raise DamagedError(f"the message index at byte {at} is cut off")
            key = int.from_bytes(head[9:11], "little")
            self.indexed[key] = self.indexed.get(key, 0) + (after - body - 6) // 16
        elif opcode in (r.SCHEMA, r.CHANNEL):
            check_size(after - body)
            self.known.learn(opcode, read_at(self.file, body, after - body))

    def _message(self, at: int, after: int, head: bytes) -> None:
        if after - at < r.MESSAGE_HEAD.size:
            raise DamagedError(f"the message at byte {at} is shorter than its own head")
        _, _, key, _, log_ns, _ = r.MESSAGE_HEAD.unpack(head)
        if self.run and after - self.run[2] > RUN_BYTES:
            self._finish_run()
        if not self.run:
            self.run = [log_ns, log_ns, at, 0]
        run = self.run
        run[0], run[1], run[3] = min(run[0], log_ns), max(run[1], log_ns), after - run[2]
        self.run_ids.add(key)
        self.known.counts[key] = self.known.counts.get(key, 0) + 1

    def _finish_run(self) -> None:
        if self.run:
            start, end, offset, length = self.run
            self.known.chunks[offset] = Chunk(start, end, offset, length, frozenset(self.run_ids), loose=True)
            self.run, self.run_ids = [], set()

    def _finish_chunk(self) -> None:
        """Put the chunk on the list, with what its indexes say; without them, with what is in it."""
        chunk, self.chunk = self.chunk, None
        indexed, self.indexed = self.indexed, {}
        if chunk is None:
            return
        if indexed.keys() <= self.known.channels.keys() and indexed:
            self._list(chunk, indexed)
        else:
            self._look_inside(chunk)

    def _cut_chunk(self, at: int) -> None:
        try:
            start, end = chunk_times(self.file, at, self.size)
        except DamagedError:
            return
        self._look_inside(Chunk(start, end, at, self.size - at, cut=True))

    def _look_inside(self, chunk: Chunk) -> None:
        """Unpack a chunk for its declarations and its messages' channels."""
        try:
            data = chunk_data(self.file, chunk)
        except DamagedError as damage:
            self.faults.add(f"{self.path}: the chunk at byte {chunk.offset} is left out: {damage}")
            return
        counts: dict[int, int] = {}
        rest = MAX_OTHERS
        try:
            for opcode, body in r.records(data):
                if opcode == r.MESSAGE and len(body) >= _MIN_MESSAGE:
                    key = body[0] | body[1] << 8
                    counts[key] = counts.get(key, 0) + 1
                elif (rest := rest - 1) < 0:
                    break
                else:
                    self.known.learn(opcode, body)
        except DamagedError:
            if not chunk.cut:
                self.faults.add(f"{self.path}: {not_whole(chunk)}")
        self._list(chunk, counts)

    def _list(self, chunk: Chunk, counts: dict[int, int]) -> None:
        if counts:
            self.known.chunks[chunk.offset] = chunk._replace(ids=frozenset(counts))
        for key, count in counts.items():
            self.known.counts[key] = self.known.counts.get(key, 0) + count


def not_whole(chunk: Chunk) -> str:
    return f"the chunk at byte {chunk.offset} holds a record that is not whole, and what follows is left out"


def chunk_times(file: BinaryIO, at: int, after: int) -> tuple[int, int]:
    """The first and last log time that a chunk's head claims."""
    if after - at < r.CHUNK_HEAD.size:
        raise DamagedError(f"the chunk at byte {at} is shorter than its own head")
    _, _, start, end, _, _, _ = r.CHUNK_HEAD.unpack(read_at(file, at, r.CHUNK_HEAD.size))
    return start, end


def chunk_data(file: BinaryIO, chunk: Chunk) -> r.Bytes:
    """The records of a chunk, unpacked and checked against their CRC; of one that is cut, what there is."""
    if chunk.length > MAX_CHUNK_BYTES and not chunk.cut:
        raise DamagedError(f"claims {chunk.length} bytes, more than the limit of {MAX_CHUNK_BYTES}")
    record = read_at(file, chunk.offset, min(chunk.length, MAX_CHUNK_BYTES))
    if chunk.loose:
        return record
    form, size, crc, data = _opened(record, chunk)
    if chunk.cut:
        return unpack_beginning(form, data, min(size, MAX_CHUNK_BYTES))
    found = unpack(form, data, size)
    if crc and crc32(found) != crc:
        raise DamagedError("its CRC does not fit its contents")
    return found


def _opened(record: bytes, chunk: Chunk) -> tuple[str, int, int, r.Bytes]:
    """(compression, unpacked size, CRC, packed records) of a chunk's record."""
    if len(record) < r.CHUNK_HEAD.size:
        raise DamagedError("it is shorter than its own head")
    opcode, length, _, _, size, crc, name = r.CHUNK_HEAD.unpack_from(record)
    at = r.CHUNK_HEAD.size + name
    if opcode != r.CHUNK or at + 8 > len(record) or (not chunk.cut and length != chunk.length - r.HEAD.size):
        raise DamagedError("there is no such chunk")
    packed = int.from_bytes(record[at : at + 8], "little")
    if packed > len(record) - at - 8 and not chunk.cut:
        raise DamagedError(f"claims {packed} bytes of records where {len(record) - at - 8} are left")
    data = memoryview(record)[at + 8 : at + 8 + packed]
    return r.text_of(memoryview(record)[r.CHUNK_HEAD.size : at]), size, crc, data


def walk(contents: Contents, start_ns: int, end_ns: int, wanted: Container[int]) -> tuple[set[int], bool]:
    """Note the messages of the channels in `wanted` with `start_ns` <= log time < `end_ns`.

    Returns the channels of all other messages, and whether the data are whole records to their end; if not,
    the messages before that place are noted nevertheless.
    """
    unpack_from, message, head = r.MESSAGE_HEAD.unpack_from, r.MESSAGE, r.HEAD.size
    times, places, keys, others = contents.times, contents.places, contents.keys, set()
    data, at = contents.data, 0
    stop, last = len(data), len(data) - r.MESSAGE_HEAD.size
    rest = MAX_OTHERS
    everything = start_ns == 0 and end_ns == LAST_NS
    while at <= last:
        opcode, size, key, _, log_ns, _ = unpack_from(data, at)
        after = at + head + size
        if opcode == message:
            if size < _MIN_MESSAGE or after > stop:
                return others, False
            if key not in wanted:
                others.add(key)
            elif everything or start_ns <= log_ns < end_ns:
                times.append(log_ns)
                places.append(at)
                keys.append(key)
        elif (rest := rest - 1) < 0:
            return others, False
        at = after
    while at + head <= stop and data[at] != message:  # what is left is too short for a message
        at += head + r.HEAD.unpack_from(data, at)[1]
    return others, at == stop
