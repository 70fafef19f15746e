"""Writers of cloud files for the tests, independent of the package's readers."""

from __future__ import annotations

import io
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

POINTS = np.array([[1.5, -2.25, 0.5], [10.0, 20.0, -3.0], [0.1, 0.2, 0.3], [-7.0, 0.0, 1e-3]], np.float32)


def records(n: int = 40, seed: int = 0) -> NDArray[Any]:
    """Points as a LiDAR driver packs them: mixed types, none invalid."""
    rng = np.random.default_rng(seed)
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<u2"), ("ring", "u1"), ("t", "<u4")]
    out = np.empty(n, kinds)
    for axis in "xyz":
        out[axis] = rng.normal(0, 20, n)
    out["intensity"] = rng.integers(0, 60000, n)
    out["ring"] = np.arange(n) % 16
    out["t"] = np.arange(n) * 2304
    return out


def lzf(data: bytes) -> bytes:
    """Compress: the longest match within reach, else a literal; every kind of token comes up."""
    out, literals, i = bytearray(), bytearray(), 0

    def flush() -> None:
        for k in range(0, len(literals), 32):
            run = literals[k : k + 32]
            out.append(len(run) - 1)
            out.extend(run)
        literals.clear()

    last: dict[bytes, int] = {}
    while i < len(data):
        at = last.get(data[i : i + 3], -1)
        last[data[i : i + 3]] = i
        length = 0
        if at >= 0 and i - at <= 8192:
            while i + length < len(data) and length < 264 and data[at + length] == data[i + length]:
                length += 1
        if length < 3:
            literals.append(data[i])
            i += 1
            continue
        flush()
        back = i - at - 1
        short = length - 2
        out.extend([(min(short, 7) << 5) | back >> 8, *([short - 7] if short >= 7 else []), back & 255])
        i += length
    flush()
    return bytes(out)


def pcd_header(rows: NDArray[Any], kind: str, **said: object) -> bytes:
    """`said` replaces lines (None leaves one out)."""
    names = rows.dtype.names or ()
    bases = [rows.dtype[name].base for name in names]
    counted = zip(names, bases, strict=True)
    lines: dict[str, object] = {
        "VERSION": "0.7",
        "FIELDS": " ".join("_" if name.startswith("pad") else name for name in names),
        "SIZE": " ".join(str(base.itemsize) for base in bases),
        "TYPE": " ".join(base.kind.upper() for base in bases),
        "COUNT": " ".join(str(rows.dtype[n].itemsize // base.itemsize) for n, base in counted),
        "WIDTH": len(rows),
        "HEIGHT": 1,
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": len(rows),
        "DATA": kind,
    }  # fmt: skip
    lines.update(said)
    text = "".join(f"{key} {value}\n" for key, value in lines.items() if value is not None)
    return b"# .PCD v0.7 - Point Cloud Data file format\n" + text.encode()


def pcd(rows: NDArray[Any], kind: str, **said: object) -> bytes:
    head = pcd_header(rows, kind, **said)
    if kind == "binary":
        return head + rows.tobytes()
    if kind == "ascii":
        lines = (" ".join(_words(row)) for row in rows.tolist())
        return head + "".join(f"{line}\n" for line in lines).encode()
    body = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in rows.dtype.names or ())
    packed = lzf(body)
    return head + struct.pack("<II", len(packed), len(body)) + packed


def _words(row: Sequence[Any]) -> list[str]:
    flat = [
        v for value in row for v in (value.ravel().tolist() if isinstance(value, np.ndarray) else [value])
    ]
    return [repr(value) for value in flat]


PLY_NAMES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint32",
    "f4": "float",
    "f8": "float64",
}


def ply(
    rows: NDArray[Any],
    order: str,
    before: tuple[str, bytes] = ("", b""),
    after: tuple[str, bytes] = ("", b""),
    count: int | None = None,
) -> bytes:
    """`before` and `after` are other elements: their header lines and their bytes."""
    names = rows.dtype.names or ()
    points = len(rows) if count is None else count
    head = f"ply\nformat {order} 1.0\ncomment vertex of nothing\n{before[0]}element vertex {points}\n"
    head += "".join(f"property {PLY_NAMES[rows.dtype[name].str[1:]]} {name}\n" for name in names)
    head += f"{after[0]}end_header\n"
    if order == "ascii":
        body = "".join(" ".join(_words(row)) + "\n" for row in rows.tolist()).encode()
    else:
        sign = "<" if "little" in order else ">"
        body = rows.astype([(name, rows.dtype[name].newbyteorder(sign)) for name in names]).tobytes()
    return head.encode() + before[1] + body + after[1]


def npy(array: NDArray[Any]) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npz(compressed: bool = False, **arrays: NDArray[Any]) -> bytes:
    stream = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(stream, **arrays)  # pyright: ignore[reportArgumentType]
    return stream.getvalue()


def las(
    xyz: NDArray[np.float64],
    compressed: bool = False,
    point_format: int = 1,
    version: str = "1.2",
    **fields: NDArray[Any],
) -> bytes:
    import importlib

    laspy: Any = importlib.import_module("laspy")
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(xyz.mean(axis=0)) if len(xyz) else np.zeros(3)
    for name, values in fields.items():
        if name not in header.point_format.dimension_names:
            header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=values.dtype))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = xyz.T if len(xyz) else np.empty((3, 0))
    for name, values in fields.items():
        cloud[name] = values
    stream = io.BytesIO()
    cloud.write(stream, do_compress=compressed)
    return stream.getvalue()
