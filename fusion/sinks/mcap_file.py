"""MCAP files of Foxglove's messages: written chunk by chunk, and joined without unpacking what is in them.

The library's own writer numbers channels as they come and cannot take chunks over from another file. Here
the same topic always has the same number, so that parts written on different machines fit together.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import IO, Any, NamedTuple

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from fusion.errors import OutputError
from fusion.foxglove import protobuf_schema

MAGIC = b"\x89MCAP0\r\n"
CHUNK_BYTES = 4 << 20  # a chunk is closed when it holds more: what a reader unpacks to show one moment
PARTS = "fusion.parts"  # the metadata that says which parts a joined file is made of
_LEVEL = 1  # of zstd: most bytes are pictures that are packed already


class Piece(NamedTuple):
    """Chunks `begin` to `end` (exclusive) of the file at `path`, called `key` in what they are joined to."""

    key: str
    path: Path
    begin: int = 0
    end: int | None = None


class McapFile:
    """Writes one MCAP into `stream`; `topics` maps each topic that may come to its schema, in fixed order."""

    def __init__(self, stream: IO[bytes], topics: Mapping[str, str]) -> None:
        self._stream, self._topics = stream, topics
        names = [*dict.fromkeys(topics.values())]
        self._schema_ids = {name: k + 1 for k, name in enumerate(names)}
        self._channel_ids = {topic: k + 1 for k, topic in enumerate(topics)}
        self._at = 0
        self._counts: dict[int, int] = {}
        self._chunks, self._chunk_indexes = 0, bytearray()
        self._metadata: list[MetadataIndex] = []
        self._span: tuple[int, int] | None = None
        self._open = RecordBuilder()
        self._index: dict[int, list[tuple[int, int]]] = {}
        self._known: set[int] = set()
        self._put(MAGIC)
        self._put(_bytes(Header(profile="", library="fusionprep")))

    def add(self, topic: str, time_ns: int, data: bytes) -> None:
        """Add a message; it was logged and published at `time_ns`."""
        channel = self._channel_ids[topic]
        if channel not in self._known:
            self._known.add(channel)
            for record in self._described([channel]):
                record.write(self._open)
        self._index.setdefault(channel, []).append((time_ns, self._open.count))
        # No number: parts do not know how many messages came before them.
        Message(channel, time_ns, data, time_ns, sequence=0).write(self._open)
        self._counts[channel] = self._counts.get(channel, 0) + 1
        if self._open.count > CHUNK_BYTES:
            self._close_chunk()

    def copy(self, piece: Piece) -> int:
        """Take the chunks of a piece over as they are; how many. Raises `OutputError` where it is damaged."""
        with piece.path.open("rb") as file:
            indexes = _chunk_indexes(file, piece.path)[piece.begin : piece.end]
            for index in indexes:
                self._copy_chunk(file, index, piece.path)
        return len(indexes)

    def finish(self, metadata: Mapping[str, str] | None = None) -> None:
        """Write the last chunk, `metadata` under the name `PARTS`, and the summary; the stream stays open."""
        if self._index:
            self._close_chunk()
        if metadata is not None:
            start = self._at
            self._put(_bytes(Metadata(PARTS, dict(metadata))))
            self._metadata.append(MetadataIndex(start, self._at - start, PARTS))
        self._put(_bytes(DataEnd(0)))
        self._put_summary()
        self._put(MAGIC)

    def _put(self, data: bytes | bytearray) -> None:
        self._stream.write(data)
        self._at += len(data)

    def _described(self, channels: Iterable[int]) -> Iterable[McapRecord]:
        """The schema and the channel record of each."""
        topics = [*self._topics.items()]
        for number in channels:
            topic, schema = topics[number - 1]
            at = self._schema_ids[schema]
            yield Schema(id=at, name=schema, encoding="protobuf", data=protobuf_schema(schema))
            yield Channel(id=number, topic=topic, message_encoding="protobuf", metadata={}, schema_id=at)

    def _close_chunk(self) -> None:
        raw, records = self._open.end(), RecordBuilder()
        times = [time for entries in self._index.values() for time, _ in entries]
        packed = zstandard.ZstdCompressor(level=_LEVEL).compress(raw)
        chunk = Chunk("zstd", packed, max(times), min(times), zlib.crc32(raw), len(raw))
        chunk.write(records)
        length, offsets = records.count, {}
        for channel, entries in sorted(self._index.items()):
            offsets[channel] = self._at + records.count
            MessageIndex(channel, entries).write(records)
        self._note(
            ChunkIndex(
                message_start_time=chunk.message_start_time,
                message_end_time=chunk.message_end_time,
                chunk_start_offset=self._at,
                chunk_length=length,
                message_index_offsets=offsets,
                message_index_length=records.count - length,
                compression=chunk.compression,
                compressed_size=len(packed),
                uncompressed_size=len(raw),
            )
        )
        self._put(records.end())
        self._index = {}

    def _copy_chunk(self, file: IO[bytes], index: ChunkIndex, path: Path) -> None:
        file.seek(index.chunk_start_offset)
        data = file.read(index.chunk_length + index.message_index_length)
        if len(data) != index.chunk_length + index.message_index_length:
            raise _damaged(path, "a chunk is cut short")
        self._count(memoryview(data)[index.chunk_length :], index, path)
        moved = self._at - index.chunk_start_offset
        index.chunk_start_offset += moved
        index.message_index_offsets = {c: at + moved for c, at in index.message_index_offsets.items()}
        self._note(index)
        self._put(data)

    def _count(self, indexes: memoryview, index: ChunkIndex, path: Path) -> None:
        """Add up the messages that the message indexes behind a chunk tell of."""
        at = 0
        while at < len(indexes):
            opcode, length, channel, size = struct.unpack_from("<BQHI", indexes, at)
            if opcode != Opcode.MESSAGE_INDEX or channel not in index.message_index_offsets:
                raise _damaged(path, "its message index does not fit")
            self._known.add(channel)
            self._counts[channel] = self._counts.get(channel, 0) + size // 16
            at += 9 + length

    def _note(self, index: ChunkIndex) -> None:
        self._chunks += 1
        self._chunk_indexes += _bytes(index)
        first, last = index.message_start_time, index.message_end_time
        self._span = (
            (first, last) if self._span is None else (min(first, self._span[0]), max(last, self._span[1]))
        )

    def _put_summary(self) -> None:
        start, first_last = self._at, self._span or (0, 0)
        described = [*self._described(sorted(self._known))]
        schemas = {record.id: record for record in described if isinstance(record, Schema)}
        channels = [record for record in described if isinstance(record, Channel)]
        statistics = Statistics(
            message_count=sum(self._counts.values()),
            schema_count=len(schemas),
            channel_count=len(channels),
            attachment_count=0,
            metadata_count=len(self._metadata),
            chunk_count=self._chunks,
            message_start_time=first_last[0],
            message_end_time=first_last[1],
            channel_message_counts=dict(sorted(self._counts.items())),
        )
        groups: list[tuple[int, bytes | bytearray]] = [
            (Opcode.SCHEMA, b"".join(map(_bytes, schemas.values()))),
            (Opcode.CHANNEL, b"".join(map(_bytes, channels))),
            (Opcode.STATISTICS, _bytes(statistics)),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.METADATA_INDEX, b"".join(map(_bytes, self._metadata))),
        ]
        offsets, crc = b"", 0
        for opcode, data in groups:
            if data:
                offsets += _bytes(SummaryOffset(opcode, self._at, len(data)))
                crc = zlib.crc32(data, crc)
                self._put(data)
        at = self._at
        self._put(offsets)
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, at)  # the footer's own beginning counts
        crc = zlib.crc32(head, zlib.crc32(offsets, crc))
        self._put(_bytes(Footer(start, at, crc)))


def join(target: Path, pieces: Iterable[Piece], topics: Mapping[str, str]) -> None:
    """Write the pieces, in their order, as one file; memory holds a chunk and the index (some 200 bytes a
    chunk).
    """
    with target.open("wb") as stream:
        file = McapFile(stream, topics)
        file.finish({piece.key: str(file.copy(piece)) for piece in pieces})


def joined_pieces(path: Path) -> list[Piece]:
    """The parts that the joined file at `path` holds; none where there is no such file, or it is none of
    ours.
    """
    try:
        with path.open("rb") as file:
            found = [record for record in make_reader(file).iter_metadata() if record.name == PARTS]
    except (OSError, McapError, struct.error, ValueError):
        return []
    pieces, begin = [], 0
    for key, count in found[0].metadata.items() if found else ():
        pieces.append(Piece(key, path, begin, begin + int(count)))
        begin += int(count)
    return pieces


def _chunk_indexes(file: IO[bytes], path: Path) -> list[ChunkIndex]:
    try:
        summary = make_reader(file).get_summary()
    except (McapError, struct.error, ValueError) as error:
        raise _damaged(path, error) from None
    if summary is None:
        raise _damaged(path, "it has no index")
    return sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset)


def _damaged(path: Path, why: Any) -> OutputError:
    hint = "remove it and run the same command again"
    return OutputError(f"the part is damaged: {why}", where=path, hint=hint)


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
