"""Compressed bytes to bytes, never more of them than were claimed, never more than a stated limit.

The libraries' one-call forms take the size from the frame itself (lz4, zstandard) or have no limit (bz2): all
three are held to the size that the recording claims, which the caller has held to `MAX_CHUNK_BYTES`.
"""

from __future__ import annotations

import bz2
import io
import zlib
from collections.abc import Callable
from contextlib import suppress
from typing import Any, BinaryIO

import lz4.frame
import zstandard

from fusion.errors import InputError
from fusion.recordings.files import DamagedError

Bytes = bytes | memoryview
_fast: Any = zlib
with suppress(ImportError):  # no wheel for this platform
    from isal import isal_zlib as _fast
crc32: Callable[[Bytes], int] = _fast.crc32  # ISA-L's is several times as fast as zlib's

MAX_CHUNK_BYTES = 1 << 30  # one chunk, or one message, unpacked
MAX_RATIO = 1000  # of a packed file
_DAMAGES = (zstandard.ZstdError, RuntimeError, EOFError)
_FAILURES = (*_DAMAGES, OSError, ValueError, MemoryError)


def unpack(form: str, data: Bytes, size: int) -> Bytes:
    """`data` unpacked, which is exactly `size` bytes; "" and "none" are as they are.

    Raises `DamagedError` where `data` is no such stream, or is one of another size.
    """
    check_size(size)
    try:
        found = _ALL[form](data, size)
    except KeyError:
        raise DamagedError(
            f"compression {form!r} is not known (known: {', '.join(filter(None, _ALL))})"
        ) from None
    except _FAILURES as error:
        raise DamagedError(f"its {form} stream is damaged: {error}") from error
    if len(found) != size:
        raise DamagedError(f"unpacks to {len(found)} bytes and should to {size}")
    return found


def unpack_beginning(form: str, data: Bytes, size: int) -> Bytes:
    """As much of a stream that was cut off as can be had, at most `size` bytes."""
    check_size(size)
    if form in {"", "none"}:
        return data[:size]
    if form not in _STREAMS:
        raise DamagedError(f"compression {form!r} is not known")
    found = io.BytesIO()
    try:
        read = _STREAMS[form](io.BytesIO(data))
        while found.tell() < size and (piece := read(min(_PIECE, size - found.tell()))):
            found.write(piece)
    except _FAILURES:
        pass  # what came before is whole
    return found.getvalue()


def unpack_message(form: str, data: Bytes) -> Bytes:
    """One message that was packed on its own."""
    size = _claimed(data) if form == "zstd" else -1
    if size >= 0:
        return unpack(form, data, size)
    found = io.BytesIO()
    try:
        read = _STREAMS[form](io.BytesIO(data))
        while piece := read(_PIECE):
            found.write(piece)
            check_size(found.tell())
    except _FAILURES as error:
        raise DamagedError(f"its {form} stream is damaged: {error}") from error
    return found.getvalue()


def check_size(size: int) -> None:
    if size > MAX_CHUNK_BYTES:
        raise DamagedError(f"claims {size} bytes unpacked, more than the limit of {MAX_CHUNK_BYTES}")


def _claimed(data: Bytes) -> int:
    """The size that a zstd frame claims for itself, -1 where it says none; never above the limit."""
    try:
        size = zstandard.frame_content_size(bytes(data[:18]))
    except zstandard.ZstdError as error:
        raise DamagedError(f"its zstd stream is damaged: {error}") from error
    check_size(size)
    return size


def _as_is(data: Bytes, size: int) -> Bytes:
    del size
    return data


def _zstd(data: Bytes, size: int) -> bytes:
    # The library takes memory for what the frame claims, not for what is allowed.
    if _claimed(data) > size:
        raise ValueError(f"its frame claims more than {size} bytes")
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=size) if size else b""


def _lz4(data: Bytes, size: int) -> bytes:
    return _to_its_end(lz4.frame.LZ4FrameDecompressor(), data, size)


def _bz2(data: Bytes, size: int) -> bytes:
    return _to_its_end(bz2.BZ2Decompressor(), data, size)


def _to_its_end(stream: Any, data: Bytes, size: int) -> bytes:
    found = stream.decompress(data, max_length=size)
    if not stream.eof and stream.decompress(b"", max_length=1):
        raise ValueError(f"it yields more than {size} bytes")
    return found


def _zstd_stream(source: BinaryIO) -> Callable[[int], bytes]:
    return (
        zstandard.ZstdDecompressor(max_window_size=1 << 27)
        .stream_reader(source, read_across_frames=True)
        .read
    )


def _stream(make: Callable[[], Any]) -> Callable[[BinaryIO], Callable[[int], bytes]]:
    def begin(source: BinaryIO) -> Callable[[int], bytes]:
        stream = make()

        def read(count: int) -> bytes:
            while not stream.eof:
                data = source.read(_FED) if stream.needs_input else b""
                if stream.needs_input and not data:
                    break
                if piece := stream.decompress(data, count):
                    return piece
            return b""

        return read

    return begin


_PIECE = 1 << 20
_FED = 1 << 16
_ALL: dict[str, Callable[[Bytes, int], Bytes]] = {
    "": _as_is,
    "none": _as_is,
    "zstd": _zstd,
    "lz4": _lz4,
    "bz2": _bz2,
}
_STREAMS: dict[str, Callable[[BinaryIO], Callable[[int], bytes]]] = {
    "zstd": _zstd_stream,
    "lz4": _stream(lz4.frame.LZ4FrameDecompressor),
    "bz2": _stream(bz2.BZ2Decompressor),
}


def unpack_file(form: str, source: BinaryIO, target: BinaryIO, shown: str) -> None:
    """A packed file unpacked into another, piece by piece, up to `MAX_RATIO` times its size (1 GiB always).

    What was cut off ends early. Raises `InputError` above the limit, or where nothing can be unpacked.
    """
    limit = max(MAX_CHUNK_BYTES, MAX_RATIO * source.seek(0, 2))
    source.seek(0)
    read, done = _STREAMS[form](source), 0
    try:
        while piece := read(_PIECE):
            done += target.write(piece)
            if done > limit:
                raise InputError(f"unpacks to more than {limit} bytes, which is not believed", where=shown)
    except _DAMAGES as error:
        if not done:
            raise InputError(f"cannot be unpacked: {error}", where=shown) from error
