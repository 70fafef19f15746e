"""rosbag1's records as bytes (http://wiki.ros.org/Bags/Format/2.0), all lengths checked against the file.

The `rosbags` reader refuses bags without an index, keeps an entry of every message of the file in memory, and
takes memory for what a length claims; none of that can be helped from outside.
"""

from __future__ import annotations

from collections.abc import Callable, Container
from itertools import permutations
from struct import Struct, error
from typing import BinaryIO, NamedTuple

import numpy as np

from fusion.recordings.base import Schema, Topic
from fusion.recordings.chunks import MAX_OTHERS, Contents, normal_type, text_of
from fusion.recordings.files import DamagedError, read_at

MAGIC = b"#ROSBAG V"
MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = range(2, 8)
MAX_HEADER_BYTES = 1 << 20
SECOND = 10**9

Bytes = bytes | memoryview
U32, _TIME, _U64 = Struct("<I"), Struct("<II"), Struct("<Q")
_PAIR = Struct("<II")


class Fields(dict[bytes, bytes]):
    """A record's header."""

    def u32(self, name: bytes) -> int:
        return self._number(name, 4)

    def u64(self, name: bytes) -> int:
        return self._number(name, 8)

    @property
    def op(self) -> int:
        return self._number(b"op", 1)

    def time_ns(self, name: bytes) -> int:
        both = self._number(name, 8)
        return (both & 0xFFFFFFFF) * SECOND + (both >> 32)

    def text(self, name: bytes) -> str:
        if name not in self:
            raise DamagedError(f"a record lacks its field {name.decode()!r}")
        return text_of(self[name])

    def _number(self, name: bytes, size: int) -> int:
        value = self.get(name, b"")
        if len(value) != size:
            raise DamagedError(f"a record's field {name.decode()!r} is missing or malformed")
        return int.from_bytes(value, "little")


class Record(NamedTuple):
    """`fields`, and where its data are: [`start`, `stop`) in the file or chunk it was found in."""

    fields: Fields
    start: int
    stop: int


def parse_fields(data: Bytes) -> Fields:
    """``name=value`` pieces, each with its length before it."""
    fields, at = Fields(), 0
    while at < len(data):
        if at + 4 > len(data):
            raise DamagedError("a record's header is malformed")
        (size,) = U32.unpack_from(data, at)
        piece = bytes(data[at + 4 : at + 4 + size])
        name, equals, value = piece.partition(b"=")
        if len(piece) != size or not equals:
            raise DamagedError("a record's header is malformed")
        fields[name] = value
        at += 4 + size
    return fields


def read_record(file: BinaryIO, at: int, size: int) -> Record:
    """The record at `at` of a file of `size` bytes; its data may reach beyond the end: callers check."""
    if size - at < 4:
        raise DamagedError(f"ends at byte {size}, inside the record at byte {at}")
    (length,) = U32.unpack(read_at(file, at, 4))
    start = at + 4 + length + 4
    if length > MAX_HEADER_BYTES:
        raise DamagedError(f"there is no record at byte {at}")
    if start > size:
        raise DamagedError(f"ends at byte {size}, inside the record at byte {at}")
    both = read_at(file, at + 4, length + 4)
    try:
        fields = parse_fields(memoryview(both)[:length])
        _ = fields.op
    except DamagedError as damage:
        raise DamagedError(f"no whole record at byte {at}: {damage}") from None
    return Record(fields, start, start + U32.unpack_from(both, length)[0])


def record_in(data: Bytes, at: int) -> Record:
    """The record at `at` in an unpacked chunk, all of it there."""
    try:
        (length,) = U32.unpack_from(data, at)
        start = at + 8 + length
        (size,) = U32.unpack_from(data, at + 4 + length)
    except error:
        raise DamagedError(f"a record at byte {at} of it is cut off") from None
    if start + size > len(data):
        raise DamagedError(f"a record at byte {at} of it is cut off")
    return Record(parse_fields(data[at + 4 : at + 4 + length]), start, start + size)


def connection(fields: Fields, data: Bytes) -> tuple[int, Topic, str]:
    """Number, topic and md5sum of a connection record."""
    inner = parse_fields(data)
    definition = inner.get(b"message_definition", b"")
    schema = Schema(normal_type(inner.text(b"type")), "ros1msg" if definition else "", definition)
    md5 = text_of(inner.get(b"md5sum", b""))
    return fields.u32(b"conn"), Topic(fields.text(b"topic"), schema, "ros1"), md5


def chunk_info(record: Fields, data: Bytes) -> tuple[int, int, int, dict[int, int]]:
    """Offset of the chunk, its first and last log time, messages by connection."""
    if record.u32(b"ver") != 1:
        raise DamagedError(f"chunk infos of version {record.u32(b'ver')} are not known")
    if len(data) != 8 * record.u32(b"count"):
        raise DamagedError("a chunk info is malformed")
    counts: dict[int, int] = {}
    for key, count in _PAIR.iter_unpack(data):
        counts[key] = counts.get(key, 0) + count
    return record.u64(b"chunk_pos"), record.time_ns(b"start_time"), record.time_ns(b"end_time"), counts


def index_times(fields: Fields, data: Bytes) -> tuple[int, int, int, int]:
    """Connection, messages, first and last log time of the index record behind a chunk."""
    if fields.u32(b"ver") != 1 or len(data) != 12 * fields.u32(b"count"):
        raise DamagedError("an index record is malformed")
    both = np.frombuffer(data, "<u4").reshape(-1, 3)[:, :2].astype(np.int64)
    if not len(both):
        return fields.u32(b"conn"), 0, 0, 0
    times = both[:, 0] * SECOND + both[:, 1]
    return fields.u32(b"conn"), len(times), int(times.min()), int(times.max())


class _Order(NamedTuple):
    """A message's header, 38 bytes of three fields in one of six orders, and the length of its data."""

    parse: Struct
    conn: int  # where in the parsed values each field is: its name, then its value
    op: int
    time: int


def _order(names: tuple[str, ...]) -> _Order:
    forms = {"conn": "4x5sI", "op": "4x3sB", "time": "4x5sII"}
    at, places = 1, {}
    for name in names:
        places[name] = at
        at += 3 if name == "time" else 2
    return _Order(Struct("<I" + "".join(forms[name] for name in names) + "I"), **places)


_ORDERS = [_order(names) for names in permutations(("conn", "op", "time"))]
HEAD_BYTES = 4 + 38 + 4


def _order_at(data: Bytes, at: int) -> _Order | None:
    """In which order the fields of the message at `at` stand; None where it is none of the common kind."""
    for order in _ORDERS if at + HEAD_BYTES <= len(data) else ():
        found = order.parse.unpack_from(data, at)
        names = (found[order.conn], found[order.op], found[order.time])
        if (found[0], *names, found[order.op + 1]) == (38, b"conn=", b"op=", b"time=", MESSAGE):
            return order
    return None


def walk(
    contents: Contents,
    span_ns: tuple[int, int],
    wanted: Container[int],
    learn: Callable[[Fields, Bytes], None] | None = None,
) -> tuple[set[int], str]:
    """Note the messages of the connections in `wanted` with `span_ns[0]` <= log time < `span_ns[1]`; `learn`
    gets the connection records.

    Returns the connections of all other messages, and what is wrong where records end before the data do;
    messages before that place are noted nevertheless.
    """
    data, at, others, rest = contents.data, 0, set[int](), MAX_OTHERS
    while at < len(data):
        # 1. messages with the header that all writers make; the order of its fields changes with the writer
        order = _order_at(data, at)
        if order is not None:
            after = _walk_alike(contents, span_ns, wanted, others, order, at)
            if after == at:
                return others, f"the message at byte {at} of it is cut off"
            at = after
            continue
        # 2. any other record
        rest -= 1
        if rest < 0:
            return others, f"more than {MAX_OTHERS} records of it are no messages as they should be"
        try:
            record = record_in(data, at)
            if record.fields.op == MESSAGE:
                key, log_ns = record.fields.u32(b"conn"), record.fields.time_ns(b"time")
                if key not in wanted:
                    others.add(key)
                elif span_ns[0] <= log_ns < span_ns[1]:
                    _note(contents, log_ns, at, key)
            elif record.fields.op == CONNECTION and learn is not None:
                learn(record.fields, data[record.start : record.stop])
        except DamagedError as damage:
            return others, str(damage)
        at = record.stop
    return others, ""


def _note(contents: Contents, log_ns: int, at: int, key: int) -> None:
    contents.times.append(log_ns)
    contents.places.append(at)
    contents.keys.append(key)


def _walk_alike(
    contents: Contents,
    span_ns: tuple[int, int],
    wanted: Container[int],
    others: set[int],
    order: _Order,
    at: int,
) -> int:
    """Note whole messages from `at` on as long as their headers are alike; returns where that ends."""
    data, times, places, keys = contents.data, contents.times, contents.places, contents.keys
    parse, conn, op, time = order.parse.unpack_from, order.conn, order.op, order.time
    stop, (start_ns, end_ns) = len(data), span_ns
    last = stop - HEAD_BYTES
    while at <= last:
        found = parse(data, at)
        after = at + HEAD_BYTES + found[-1]
        if found[op + 1] != MESSAGE or found[0] != 38 or found[conn] != b"conn=" or after > stop:
            break
        key = found[conn + 1]
        log_ns = found[time + 1] * SECOND + found[time + 2]
        if key not in wanted:
            others.add(key)
        elif start_ns <= log_ns < end_ns:
            times.append(log_ns)
            places.append(at)
            keys.append(key)
        at = after
    return at
