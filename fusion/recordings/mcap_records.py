"""MCAP's records as bytes (https://mcap.dev/spec), every length checked against what is there.

The library's reader makes an object of every record, takes memory for what a length claims, and cannot go on
after damage.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from struct import Struct, error
from typing import NamedTuple

from fusion.recordings.base import Schema
from fusion.recordings.chunks import Chunk, normal_type, text_of
from fusion.recordings.files import DamagedError

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)
HEAD = Struct("<BQ")  # opcode, bytes that follow
MESSAGE_HEAD = Struct("<BQHIQQ")  # ..., channel, sequence, log time, publish time: then the data
CHUNK_HEAD = Struct("<BQQQQII")  # ..., start, end, unpacked size, CRC, length of the compression's name
FOOTER_SIZE = HEAD.size + 20 + len(MAGIC)

Bytes = bytes | memoryview
_U16, _U32, _U64 = Struct("<H"), Struct("<I"), Struct("<Q")
_CHUNK_INDEX = Struct("<QQQQI")
_STATISTICS = Struct("<QHIIIIQQI")


class Channel(NamedTuple):
    topic: str
    encoding: str
    schema_id: int


@dataclass(slots=True)
class Statistics:
    messages: int
    chunks: int
    start_ns: int
    end_ns: int  # the last message's
    counts: dict[int, int]


@dataclass(slots=True)
class Known:
    """What has been read of a file: its declarations, and where its chunks are."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: dict[int, Chunk] = field(default_factory=dict)  # by offset
    ends: dict[int, int] = field(default_factory=dict)  # where the indexes behind a chunk end, by its offset
    apart: dict[int, int] = field(default_factory=dict)  # attachments and metadata: offset to length
    counts: dict[int, int] = field(default_factory=dict)  # messages by channel, as far as they were counted
    statistics: Statistics | None = None
    scanned: bool = False  # all of the file, so that `counts` are complete
    _sets: dict[bytes, frozenset[int]] = field(default_factory=dict)

    def set_of(self, pairs: bytes) -> frozenset[int]:
        """The channels of a chunk's list of (u16 channel, u64 offset). Lists return: one object for each."""
        names = pairs[0::10] + pairs[1::10]
        ids = self._sets.get(names)
        if ids is None:
            low_high = zip(pairs[0::10], pairs[1::10], strict=True)
            ids = self._sets[names] = frozenset(low | high << 8 for low, high in low_high)
        return ids

    def learn(self, opcode: int, body: Bytes) -> None:
        """Take in one record of the kinds above; others are passed over. Raises `DamagedError`."""
        reader = _READERS.get(opcode)
        if reader is None:
            return
        try:
            reader(self, body)
        except (error, IndexError, ValueError) as problem:
            raise DamagedError(f"a record of kind {opcode} is malformed: {problem}") from problem


def records(data: Bytes, offset: int = 0) -> Iterator[tuple[int, Bytes]]:
    """(opcode, body) of all whole records; `DamagedError` where the last one is not whole."""
    at = 0
    while at < len(data):
        if at + HEAD.size > len(data):
            raise DamagedError(f"a record at byte {offset + at} is cut off")
        opcode, size = HEAD.unpack_from(data, at)
        body = at + HEAD.size
        if size > len(data) - body:
            raise DamagedError(
                f"a record at byte {offset + at} claims {size} bytes where {len(data) - body} are left"
            )
        yield opcode, data[body : body + size]
        at = body + size


def prefixed(data: Bytes, at: int) -> tuple[Bytes, int]:
    """A piece with its length before it, and where it ends."""
    (size,) = _U32.unpack_from(data, at)
    end = at + 4 + size
    if end > len(data):
        raise ValueError(f"a text of {size} bytes does not fit")
    return data[at + 4 : end], end


def _schema(known: Known, body: Bytes) -> None:
    (key,) = _U16.unpack_from(body)
    name, at = prefixed(body, 2)
    encoding, at = prefixed(body, at)
    data, _ = prefixed(body, at)
    form, title = text_of(encoding), text_of(name)
    ros = form in {"ros1msg", "ros2msg", "ros2idl", "omgidl"}
    known.schemas.setdefault(key, Schema(normal_type(title) if ros else title, form, bytes(data)))


def _channel(known: Known, body: Bytes) -> None:
    key, schema = _U16.unpack_from(body)[0], _U16.unpack_from(body, 2)[0]
    topic, at = prefixed(body, 4)
    encoding, _ = prefixed(body, at)
    known.channels.setdefault(key, Channel(text_of(topic), text_of(encoding), schema))


def _chunk_index(known: Known, body: Bytes) -> None:
    start, end, offset, length, size = _CHUNK_INDEX.unpack_from(body)
    pairs = bytes(body[36 : 36 + size])
    if len(pairs) != size or size % 10:
        raise ValueError("its list of channels is cut off")
    (behind,) = _U64.unpack_from(body, 36 + size)
    # A chunk without message indexes says nothing of its channels.
    known.chunks[offset] = Chunk(start, end, offset, length, known.set_of(pairs) if size else None)
    known.ends[offset] = offset + length + behind


def _statistics(known: Known, body: Bytes) -> None:
    messages, _, _, _, _, chunks, start, end, size = _STATISTICS.unpack_from(body)
    at = _STATISTICS.size
    if size % 10 or at + size > len(body):
        raise ValueError("its list of counts is cut off")
    pairs = (at + 10 * i for i in range(size // 10))
    counts = {_U16.unpack_from(body, p)[0]: _U64.unpack_from(body, p + 2)[0] for p in pairs}
    known.statistics = Statistics(messages, chunks, start, end, counts)


def _apart(known: Known, body: Bytes) -> None:
    offset, length = _U64.unpack_from(body)[0], _U64.unpack_from(body, 8)[0]
    known.apart[offset] = length


_READERS: dict[int, Callable[[Known, Bytes], None]] = {
    SCHEMA: _schema,
    CHANNEL: _channel,
    CHUNK_INDEX: _chunk_index,
    STATISTICS: _statistics,
    ATTACHMENT_INDEX: _apart,
    METADATA_INDEX: _apart,
}
