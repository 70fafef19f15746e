"""How a recording is compressed, by what its first file says of its first chunk; nothing is unpacked."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

_MCAP, _BAG = b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n"
_CHUNK_MCAP, _CHUNK_BAG = 0x06, 5
_MOST_RECORDS, _MOST_HEADER = 100_000, 1 << 20


def compression_of(files: Sequence[str]) -> str | None:
    """``none``, ``lz4``, ``zstd``, ``bz2`` (of the first chunk); None where it is not said, or there is no
    chunk.
    """
    suffixes = {Path(file).suffix for file in files}
    if ".zstd" in suffixes:
        return "zstd (whole files)"
    try:
        with Path(files[0]).open("rb") as file:
            start = file.read(16)
            if start.startswith(_MCAP):
                return _mcap(file)
            return _bag(file) if start.startswith(_BAG) else None
    except (OSError, IndexError, struct.error, UnicodeDecodeError):
        return None


def _mcap(file: BinaryIO) -> str | None:
    file.seek(len(_MCAP))
    for _ in range(_MOST_RECORDS):
        opcode, length = struct.unpack("<BQ", file.read(9))
        if opcode == _CHUNK_MCAP:
            # two times, the unpacked size, a checksum, then the name of the compression
            name = file.read(struct.unpack_from("<I", file.read(32), 28)[0] & 0xFF).decode()
            return f"{name or 'none'} (first chunk)"
        file.seek(length, 1)
    return None


def _bag(file: BinaryIO) -> str | None:
    file.seek(len(_BAG))
    for _ in range(_MOST_RECORDS):
        (size,) = struct.unpack("<I", file.read(4))
        if size > _MOST_HEADER:
            return None
        header = _fields(file.read(size))
        if header.get(b"op") == bytes([_CHUNK_BAG]):
            return f"{header.get(b'compression', b'?').decode()} (first chunk)"
        (length,) = struct.unpack("<I", file.read(4))
        file.seek(length, 1)
    return None


def _fields(header: bytes) -> dict[bytes, bytes]:
    found, at = {}, 0
    while at + 4 <= len(header):
        (size,) = struct.unpack_from("<I", header, at)
        name, _, value = header[at + 4 : at + 4 + size].partition(b"=")
        found[name] = value
        at += 4 + size
    return found
