"""Frames as one MCAP that opens in Foxglove: pictures, depth, thermal, cloud, calibration, frames."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.chunks import Chunk
from fusion.codecs import encode_jpeg, encode_png
from fusion.errors import FrameError
from fusion.foxglove import calibration_of, protobuf_bytes, raw_image, schema_name, transforms_of
from fusion.frames import PointCloud
from fusion.geometry import Camera
from fusion.lidar.lane import DepthFrame
from fusion.messages.base import (
    CameraInfo,
    CompressedImage,
    Header,
    Message,
    PointField,
    Points,
    RawImage,
    Transforms,
)
from fusion.sinks.base import Made, Setup
from fusion.sinks.mcap_file import McapFile, Piece, join, joined_pieces
from fusion.sinks.parts import JoinedParts, replace_by, stamp_of
from fusion.storage import Storage

NAME = "fused.mcap"
TOPICS: Mapping[str, str] = {
    topic: schema_name(kind)
    for topic, kind in {
        "/fused": CompressedImage,
        "/fused/mask": CompressedImage,
        "/depth": RawImage,
        "/depth/support": CompressedImage,
        "/thermal": RawImage,
        "/points": Points,
        "/calibration/rgb": CameraInfo,
        "/calibration/depth": CameraInfo,
        "/tf": Transforms,
    }.items()
}
_MM = 1000
_KEPT = ("u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8")  # types that Foxglove has


@dataclass(frozen=True, slots=True)
class McapOutput:
    """Writes `fused.mcap`; see `messages_of` for what is in it. Picklable.

    Each chunk becomes a part below `parts/mcap/`, an MCAP of its own, held in memory until it is whole. In a
    local folder `finish` joins them in the order of the chunks; in any other storage they stay as they are,
    for there a file cannot be written piece by piece. The bytes do not depend on who made which chunk when,
    given the same libraries. `JoinedParts` says what becomes of a killed `finish`.
    """

    setup: Setup

    def open(self, chunk: Chunk, out: Storage) -> McapPart:
        return McapPart(self.setup, chunk, out)

    def finish(self, chunks: Sequence[Chunk], out: Storage) -> Sequence[str]:
        """The name of the joined file, or of the folder of parts.

        Raises `OutputError` where it cannot be written, or a part is missing or damaged.
        """
        return PARTS.finish(chunks, out, _join)


def _join(folder: Path, sources: Mapping[str, Path | None]) -> Sequence[str]:
    """Write `fused.mcap` from parts, and from what it holds already where there is no part (None)."""
    old = {piece.key: piece for piece in joined_pieces(folder / NAME)}
    pieces = [old[key] if path is None else Piece(key, path) for key, path in sources.items()]
    replace_by(folder / NAME, lambda path: join(path, pieces, TOPICS))
    return (NAME,)


def _joined(folder: Path) -> tuple[Sequence[str], set[str]]:
    return (NAME,), {piece.key for piece in joined_pieces(folder / NAME)}


PARTS = JoinedParts("parts/mcap", ".mcap", _joined)


class McapPart:
    """One chunk's part. `FrameError` for a frame with a stamp before 1970, which MCAP cannot hold."""

    def __init__(self, setup: Setup, chunk: Chunk, out: Storage) -> None:
        self._setup, self._chunk, self._out = setup, chunk, out
        self._buffer = io.BytesIO()
        self._file = McapFile(self._buffer, TOPICS)
        self._frames = 0

    def add(self, made: Made) -> None:
        stamp_ns = stamp_of(made, self._chunk, self._frames, self._setup.rate_hz)
        self._frames += 1
        # all of them first: a frame is in the file with everything, or not at all
        found = [
            (topic, _stamp(message), protobuf_bytes(message))
            for topic, message in messages_of(made, self._setup, stamp_ns)
        ]
        for topic, at_ns, data in found:
            self._file.add(topic, at_ns, data)

    def close(self) -> Mapping[str, int]:
        """The part, where it stays; nothing in a local folder, where `finish` looks after it."""
        self._file.finish()
        return PARTS.store(self._chunk, self._buffer.getvalue(), self._out)

    def discard(self) -> None:
        self._buffer.close()


def _stamp(message: Message) -> int:
    stamp_ns = message.header.stamp_ns
    assert stamp_ns is not None  # noqa: S101 - all that are made below have one
    return stamp_ns


def messages_of(made: Made, setup: Setup, stamp_ns: int) -> Iterator[tuple[str, Message]]:
    """The messages of one frame by topic; log time, publish time and header stamp are the same.

    ``/fused``, ``/fused/mask``, ``/depth/support``: foxglove.CompressedImage, the bytes of the files as they
    are. ``/depth``: foxglove.RawImage 16UC1, millimetres along the camera's axis as ROS (REP 118) and
    Foxglove read it, 0 where there is none, or more than 65.535 m. Metres x 256, as files have it, would be
    shown 3.9 times too near. ``/thermal``: foxglove.RawImage mono16, counts as measured, on the RGB grid, 0
    outside. ``/points``: foxglove.PointCloud, x y z in metres, intensity and ring where known, at the
    cloud's own stamp. ``/calibration/rgb``: foxglove.CameraCalibration, at each frame, so that a view from
    the middle has it; left out where frames are cropped. ``/calibration/depth`` where depth has a camera of
    its own. ``/tf``: foxglove.FrameTransforms from ``rgb`` to what else the rig has, at each frame, no later
    than its cloud. Pictures are in the frame ``rgb`` (depth of a camera of its own: ``depth``), the cloud is
    in ``lidar``.
    """
    cloud, rig = made.frames.cloud, setup.rig
    cloud_ns = stamp_ns if cloud is None or cloud.stamp_ns is None else cloud.stamp_ns
    if min(stamp_ns, cloud_ns) < 0:
        raise FrameError("its stamp lies before 1970", where=made.stem, hint="MCAP cannot hold it")
    if rig is not None and rig.transforms:
        yield "/tf", transforms_of(rig, min(stamp_ns, cloud_ns))
    header = Header(stamp_ns, "rgb")
    camera = rig.cameras.get("rgb") if rig is not None else None
    info = calibration_of(camera, header) if camera is not None else None
    if info is not None and (info.width, info.height) == made.fused.bgr.shape[1::-1]:
        yield "/calibration/rgb", info
    for topic, data in _pictures(made, setup).items():
        yield topic, CompressedImage(header, "png" if data.startswith(b"\x89PNG") else "jpeg", data)
    if made.depth is not None:
        own = setup.camera not in (None, camera)
        yield from _depth(made.depth, setup, Header(stamp_ns, "depth") if own else header)
    if made.fir_counts is not None:
        yield "/thermal", raw_image(header, "mono16", made.fir_counts)
    if cloud is not None:
        yield "/points", points_of(cloud, Header(cloud_ns, "lidar"))


def _pictures(made: Made, setup: Setup) -> dict[str, bytes]:
    """As they are stored, or encoded here where nobody stored them."""
    fused = made.encoded.get("fused")
    if fused is None:
        jpeg = setup.image_format in ("jpg", "jpeg")
        fused = encode_jpeg(made.fused.bgr, setup.quality) if jpeg else encode_png(made.fused.bgr)
    found = {"/fused": fused}
    if "mask" in made.encoded or made.fused.mask is not None:
        found["/fused/mask"] = made.encoded.get("mask") or encode_png(np.asarray(made.fused.mask))
    if "support" in made.encoded:
        found["/depth/support"] = made.encoded["support"]
    return found


def _depth(depth: DepthFrame, setup: Setup, header: Header) -> Iterator[tuple[str, Message]]:
    if header.frame_id == "depth" and setup.camera is not None:
        info = calibration_of(setup.camera, header)
        if info is not None:
            yield "/calibration/depth", info
    yield "/depth", raw_image(header, "16UC1", depth_mm(depth, setup.camera))


def depth_mm(depth: DepthFrame, camera: Camera | None) -> NDArray[np.uint16]:
    """H x W millimetres along the axis, rounded half up, 0 = none; at least 1 where there is depth.

    Ranges are turned into depth by the rays of `camera`; they stay ranges where it is None, or sees behind
    itself.
    """
    z_m = depth.dense.value_m
    if depth.dense.value == "range" and camera is not None and camera.has_axis:
        z_m = z_m * _axis_share(camera)
    mm = np.floor(z_m * np.float32(_MM) + np.float32(0.5))
    seen = (z_m > 0) & (mm <= np.iinfo(np.uint16).max)
    return np.where(seen, np.maximum(mm, 1), 0).astype(np.uint16)


@lru_cache(maxsize=4)
def _axis_share(camera: Camera) -> NDArray[np.float32]:
    """Depth over range of each pixel, H x W; 0 where no ray falls."""
    w, h = camera.size_wh
    v, u = np.mgrid[:h, :w]
    z = camera.unproject(np.stack([u.ravel(), v.ravel()], -1).astype(np.float64))[:, 2]
    return np.nan_to_num(z).reshape(h, w).astype(np.float32)


def points_of(cloud: PointCloud, header: Header) -> Points:
    """x y z as the cloud has them (float32, float64 where it is large), then intensity and ring, packed."""
    columns: dict[str, NDArray[Any]] = dict(zip("xyz", cloud.xyz_m.T, strict=True))
    columns |= {name: cloud.fields[name] for name in ("intensity", "ring") if name in cloud.fields}
    types = {name: _shown(values.dtype) for name, values in columns.items()}
    record = np.dtype([*types.items()])
    rows = np.empty(len(cloud), record)
    for name, values in columns.items():
        rows[name] = values
    offsets = np.cumsum([0, *(dtype.itemsize for dtype in types.values())])
    fields = tuple(PointField(name, int(at), types[name]) for name, at in zip(types, offsets, strict=False))
    return Points(header, len(cloud), 1, fields, record.itemsize, rows.nbytes, rows.tobytes())


def _shown(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """A type that Foxglove has, little endian: itself where it can be, else float64."""
    return dtype.newbyteorder("<") if dtype.str[1:] in _KEPT else np.dtype("<f8")
