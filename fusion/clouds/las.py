"""LAS and LAZ 1.0 to 1.4 (ASPRS), through laspy and lazrs, which are optional."""

from __future__ import annotations

import importlib
import io
import math
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.clouds.base import RawCloud, add_column, checked_count, wrong_count
from fusion.errors import FrameError, FusionError

_KEPT = (
    *("intensity", "gps_time", "return_number", "number_of_returns", "classification"),
    *("point_source_id", "red", "green", "blue"),
)
_CHUNK = 1 << 20  # points unpacked at a time
_COMPRESSED = 0x80  # set in the point format's number
_LAYERS = {
    10: 9,
    11: 1,
    12: 2,
    13: 1,
    14: 0,
}  # of the parts that LASzip 3 compresses in layers; 0: one a byte


def read_las(data: bytes, where: str) -> RawCloud:
    """x, y, z (float64, scale and offset applied), intensity, gps_time, returns, classification, colours,
    extra values.

    Raises `FrameError` where header and file disagree, `FusionError` where laspy is not installed. Nothing
    that the header claims is believed before it is compared with the file's size.
    """
    laspy = _laspy()
    count = _checked_header(data, where)
    try:
        return _read(laspy, data, count)
    except (KeyboardInterrupt, SystemExit, MemoryError):
        raise
    except BaseException as error:  # lazrs panics past Exception
        what = f"it cannot be decoded: {type(error).__name__} {' '.join(str(error).split())[:200]}"
        raise FrameError(what, where=where, hint="copy it again") from None


def _laspy() -> Any:
    try:
        importlib.import_module("lazrs")  # laspy finds it by itself
        return importlib.import_module("laspy")
    except ImportError as error:
        hint = "pip install 'fusionprep[las]'"
        raise FusionError(f"LAS and LAZ need laspy with lazrs: {error}", hint=hint) from None


def _checked_header(data: bytes, where: str) -> int:
    """How many points there are, if the header's numbers fit into the file."""
    if len(data) < 227 or data[:4] != b"LASF":
        raise FrameError("no LAS header", where=where)
    minor = data[25]
    size, start, records = struct.unpack_from("<HII", data, 94)
    kind, step, count = struct.unpack_from("<BHI", data, 104)
    if minor >= 4 and size >= 375 and len(data) >= 375:
        count = struct.unpack_from("<Q", data, 247)[0]
    if not np.isfinite(struct.unpack_from("<6d", data, 131)).all():
        raise FrameError("the LAS header's scale or offset is no number", where=where)
    if not size <= start <= len(data) or _after_records(data, size, records) > start:
        raise FrameError("the LAS header's sizes do not fit into the file", where=where, hint="cut off?")
    checked_count(count, where)
    found = (len(data) - start) // max(step, 1)
    if kind & _COMPRESSED:
        _check_chunks(data, start, size, records, count, where)
    elif found < count:  # more is lawful: waveforms and extended records come after the points
        raise wrong_count(count, found, where)
    return count


def _after_records(data: bytes, at: int, records: int) -> int:
    """The byte behind the variable length records; infinity's stand-in where they leave the file."""
    for _ in range(min(records, len(data) // 54 + 1)):
        if at + 54 > len(data):
            return len(data) + 1
        at += 54 + struct.unpack_from("<H", data, at + 20)[0]
    return at


def _check_chunks(data: bytes, start: int, at: int, records: int, count: int, where: str) -> None:
    """Compare the points with what the compressed chunks say, which the decoder would believe."""
    if count == 0:
        return
    layered, chunk, items = _laszip(data, at, records)
    step = struct.unpack_from("<H", data, 105)[0]
    if sum(size for _, size in items) != step or (layered and not all(kind in _LAYERS for kind, _ in items)):
        raise FrameError("the LASzip record does not fit the point format", where=where)
    table = struct.unpack_from("<q", data.ljust(start + 8, b"\0"), start)[0]
    if table == -1:  # written as a stream: its place stands at the end
        table = struct.unpack_from("<q", data, len(data) - 8)[0]
    if chunk == 0 or not start < table <= len(data) - 8:
        raise FrameError(
            "the table of compressed chunks is missing", where=where, hint="cut off while written?"
        )
    chunks = struct.unpack_from("<I", data, table + 4)[0]
    if chunks > len(data) or (chunk != 0xFFFFFFFF and chunks != math.ceil(count / chunk)):
        what = f"the header claims {count:,} points, the file has {chunks:,} chunks of {chunk:,}"
        raise FrameError(what, where=where, hint="cut off while it was written or copied?")
    if layered:
        layers = sum(_LAYERS[kind] or size for kind, size in items)
        found = _count_layered(memoryview(data)[:table], start + 8, step, layers, chunks)
        if found != count:
            raise wrong_count(count, found, where)


def _count_layered(data: memoryview, at: int, step: int, layers: int, chunks: int) -> int:
    """The points of all chunks. Each is its first point, its count, the bytes of each layer, the layers."""
    points = 0
    for _ in range(chunks):
        sizes = np.frombuffer(data[at + step : at + step + 4 + 4 * layers], "<u4").astype(np.int64)
        if len(sizes) != 1 + layers or (end := at + step + 4 + 4 * layers + int(sizes[1:].sum())) > len(data):
            break
        points, at = points + int(sizes[0]), end
    return points


def _laszip(data: bytes, at: int, records: int) -> tuple[bool, int, list[tuple[int, int]]]:
    """Whether chunks are in layers, the points of one (0: not said), kind and size of a point's parts."""
    for _ in range(records):
        user, kind, length = struct.unpack_from("<16sHH", data, at + 2)
        at += 54
        if user.rstrip(b"\0") == b"laszip encoded" and kind == 22204 and length >= 34:
            numbers = np.frombuffer(data, "<u2", 3 * ((length - 34) // 6), at + 34).reshape(-1, 3)
            parts = numbers[: struct.unpack_from("<H", data, at + 32)[0], :2].tolist()
            chunk = struct.unpack_from("<I", data, at + 12)[0]
            return struct.unpack_from("<H", data, at)[0] == 3, chunk, [(int(k), int(n)) for k, n in parts]
        at += length
    return False, 0, []


def _read(laspy: Any, data: bytes, count: int) -> RawCloud:
    found: dict[str, list[NDArray[Any]]] = {axis: [np.empty(0)] for axis in "xyz"}
    stream = io.BytesIO(data)  # shares the bytes
    backend = laspy.LazBackend.Lazrs  # in this thread: pools of threads fight
    with laspy.open(stream, laz_backend=backend, read_evlrs=False) as reader:
        header = reader.header
        names = list(header.point_format.dimension_names)
        wanted = [n for n in names if n in _KEPT or n in set(header.point_format.extra_dimension_names)]
        for chunk in reader.chunk_iterator(_CHUNK):
            parts: dict[str, NDArray[Any]] = {}
            for k, axis in enumerate("xyz"):
                with np.errstate(over="ignore"):  # infinite, and dropped as such
                    parts[axis] = chunk.array[axis.upper()] * header.scales[k] + header.offsets[k]
            for name in wanted:
                _split(parts, name, np.asarray(chunk[name]))
            for name, values in parts.items():
                found.setdefault(name, []).append(values)
    columns = {name: np.concatenate(found.pop(name)) for name in list(found)}
    if len(columns["x"]) != count:
        raise ValueError(f"the header claims {count:,} points, the file has {len(columns['x']):,}")
    left_out = tuple(name for name in names if name not in (*wanted, "X", "Y", "Z"))
    return RawCloud(columns, left_out)


def _split(parts: dict[str, NDArray[Any]], name: str, values: NDArray[Any]) -> None:
    if values.ndim == 1:
        add_column(parts, name, values)
    else:
        for k in range(values.shape[1]):
            add_column(parts, f"{name}_{k}", values[:, k])
