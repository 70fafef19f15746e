"""A simulated mine as a recording: rosbag1, rosbag2 and MCAP, as a robot's recorder would have written it."""

from __future__ import annotations

import heapq
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fusion import foxglove
from fusion.clouds import read_raw
from fusion.codecs import decode_image
from fusion.errors import InputError, OutputError, UsageError
from fusion.files import output_error
from fusion.messages.base import CompressedImage, Header, Message, PointField, Points
from fusion.simulate.container_writers import COMPRESSIONS, MessageWriter, open_writer
from fusion.simulate.mine.truth import Truth

# What a driver takes until its message is logged; a LiDAR's scan is sent when its turn is over.
DELAY_NS = {"rgb": 12_000_000, "fir": 25_000_000, "lidar": 5_000_000}
_SUFFIXES = {"rgb": {".jpg": "jpeg", ".png": "png"}, "fir": {".png": "png"}, "lidar": {".pcd": "pcd"}}
# A point as PCL lays it out: aligned, with gaps after z and ring, and at its end.
_POINT = {"x": ("<f4", 0), "y": ("<f4", 4), "z": ("<f4", 8), "intensity": ("<f4", 16), "ring": ("<u2", 20)}
_POINT["time"] = ("<f4", 24)
_POINT_STEP = 32
_SUFFIX_OF_FORM = {"rosbag1": ".bag", "rosbag2": "", "rosbag2-mcap": ""}
Progress = Callable[[int, int], None]


class Logged(NamedTuple):
    """A message on its topic, and when it is logged."""

    log_ns: int
    topic: str
    message: Message


@dataclass(frozen=True, slots=True)
class Written:
    """What was written, where; `messages` and `size_bytes` count all topics and files."""

    path: Path
    messages: int
    size_bytes: int


def write_recording(
    mine: Path,
    out: Path,
    form: str,
    *,
    compression: str = "none",
    raw: bool = False,
    split_bytes: int | None = None,
    progress: Progress | None = None,
) -> Written:
    """Write the simulated recording in the folder `mine` as `form`, a key of `COMPRESSIONS`.

    Topics: ``/camera/image/compressed`` (the files' own JPEG or PNG bytes; `raw`: ``/camera/image``, bgr8),
    ``/thermal/image`` (mono16), ``/lidar/points`` (x y z intensity ring time, 32 bytes a point),
    ``/camera/camera_info`` and ``/thermal/camera_info`` with each image, ``/tf_static`` once, first. Frames:
    ``rgb``, ``fir``, ``lidar``.

    The header's stamp is the sensor's own, as the file's name has it. It is logged 12 ms (RGB) or 25 ms
    (thermal) later, a scan 5 ms after its turn. Messages are in the order of log times, the same in every
    form; pixels, counts and points are exactly those of the files.

    `compression` is of the container's chunks; rosbag2 also has ``zstd-message`` and ``zstd-file``: each
    message, or each file, on its own. `split_bytes` starts another file of a rosbag2 when one holds more.
    `out` gets the form's suffix (``.bag``, ``.mcap``; a rosbag2 is a folder), must not exist, and is whole or
    not there. The same mine gives the same bytes, given the same libraries.

    Raises `UsageError` for what the form does not offer, `InputError` where `mine` is none or lacks a sensor,
    `FrameError` for a file that cannot be read, `OutputError`.
    """
    _check(form, compression, split_bytes)
    target = _target(Path(out), form)
    streams = _Mine(Path(mine), raw)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            made = tempfile.TemporaryDirectory(prefix=f".{target.name}.", suffix=".tmp", dir=target.parent)
            temporary = Path(stack.enter_context(made)) / target.name
            with open_writer(temporary, form, compression, split_bytes) as writer:
                messages = _write(writer, streams, progress or (lambda _done, _all: None))
            temporary.replace(target)
    except OSError as error:
        raise output_error(error, target) from None
    files = [path for path in target.rglob("*") if path.is_file()] if target.is_dir() else [target]
    return Written(target, messages, sum(path.stat().st_size for path in files))


def logged(mine: Path, raw: bool = False) -> Iterator[Logged]:
    """What `write_recording` writes, in the order of log times. Raises `InputError`, `FrameError`."""
    return _Mine(Path(mine), raw).logged()


def _write(writer: MessageWriter, streams: _Mine, progress: Progress) -> int:
    done = 0
    sequences: dict[str, Iterator[int]] = {}
    for log_ns, topic, message in streams.logged():
        writer.write(topic, message, log_ns, next(sequences.setdefault(topic, count())))
        done += 1
        progress(done, streams.messages)
    return done


def _check(form: str, compression: str, split_bytes: int | None) -> None:
    if form not in COMPRESSIONS:
        raise UsageError(f"unknown form of recording {form!r}", hint=f"one of: {', '.join(COMPRESSIONS)}")
    if compression not in COMPRESSIONS[form]:
        hint = f"one of: {', '.join(COMPRESSIONS[form])}"
        raise UsageError(f"{form} is not written with compression {compression!r}", hint=hint)
    if split_bytes is not None and (not form.startswith("rosbag2") or split_bytes < 1):
        raise UsageError(
            f"{form} is not split at {split_bytes} bytes", hint="only rosbag2, at 1 byte or more"
        )


def _target(out: Path, form: str) -> Path:
    suffix = _SUFFIX_OF_FORM.get(form, ".mcap")
    target = out if out.suffix == suffix or not suffix else out.with_name(out.name + suffix)
    if target.exists():
        raise OutputError("exists already", where=target, hint="choose a new name, or delete it")
    return target


class _Mine:
    """The files of a simulated recording as messages, each read when its turn comes."""

    def __init__(self, folder: Path, raw: bool) -> None:
        self._truth, self._raw = Truth(folder), raw
        self._rig = self._truth.rig
        self._turn_ns = round(1e9 / self._truth.config.lidar.rate_hz)
        self._files = {sensor: _stamped(folder / sensor, sensor) for sensor in DELAY_NS}
        counts = {sensor: len(files) for sensor, files in self._files.items()}
        self.messages = 2 * counts["rgb"] + 2 * counts["fir"] + counts["lidar"] + 1

    def logged(self) -> Iterator[Logged]:
        yield self._static()
        streams = (self._rgb(), self._fir(), self._lidar())
        yield from heapq.merge(*streams, key=lambda one: one.log_ns)  # equal times: in this order

    def _static(self) -> Logged:
        """T of all sensors, latched: logged with the first message."""
        stamps = {sensor: stamp for sensor, files in self._files.items() for stamp, _ in files[:1]}
        log_ns = min(self._log_ns(sensor, stamp) for sensor, stamp in stamps.items())
        return Logged(log_ns, "/tf_static", foxglove.transforms_of(self._rig, min(stamps.values())))

    def _log_ns(self, sensor: str, stamp_ns: int) -> int:
        return stamp_ns + DELAY_NS[sensor] + (self._turn_ns if sensor == "lidar" else 0)

    def _rgb(self) -> Iterator[Logged]:
        for stamp, path in self._files["rgb"]:
            log_ns, header = self._log_ns("rgb", stamp), Header(stamp, "rgb")
            data = path.read_bytes()
            if self._raw:
                image = foxglove.raw_image(header, "bgr8", decode_image(data, str(path)))
                yield Logged(log_ns, "/camera/image", image)
            else:
                form = _SUFFIXES["rgb"][path.suffix]
                yield Logged(log_ns, "/camera/image/compressed", CompressedImage(header, form, data))
            yield from self._info(log_ns, "rgb", "/camera/camera_info", header)

    def _fir(self) -> Iterator[Logged]:
        for stamp, path in self._files["fir"]:
            log_ns, header = self._log_ns("fir", stamp), Header(stamp, "fir")
            counts = decode_image(path.read_bytes(), str(path))
            yield Logged(log_ns, "/thermal/image", foxglove.raw_image(header, "mono16", counts))
            yield from self._info(log_ns, "fir", "/thermal/camera_info", header)

    def _info(self, log_ns: int, camera: str, topic: str, header: Header) -> Iterator[Logged]:
        info = foxglove.calibration_of(self._rig.camera(camera), header)
        if info is not None:
            yield Logged(log_ns, topic, info)

    def _lidar(self) -> Iterator[Logged]:
        for stamp, path in self._files["lidar"]:
            yield Logged(self._log_ns("lidar", stamp), "/lidar/points", _points(path, Header(stamp, "lidar")))


def _stamped(folder: Path, sensor: str) -> list[tuple[int, Path]]:
    """Stamps and files of a sensor, rising."""
    if not folder.is_dir():
        raise InputError(f"there is no folder {sensor}/ in it", where=folder.parent)
    files = [path for path in folder.iterdir() if path.suffix in _SUFFIXES[sensor] and path.stem.isdecimal()]
    if not files:
        raise InputError("holds no file that is named by a stamp", where=folder)
    return sorted((int(path.stem), path) for path in files)


def _points(path: Path, header: Header) -> Points:
    columns = {
        "time" if name == "time_s" else name: values for name, values in read_raw(path).columns.items()
    }
    wrong = [
        name for name, (dtype, _) in _POINT.items() if name not in columns or columns[name].dtype != dtype
    ]
    if wrong or len(columns) != len(_POINT):
        raise InputError(f"its fields are not those of a simulated scan: {', '.join(columns)}", where=path)
    names, forms = [*_POINT], [np.dtype(dtype) for dtype, _ in _POINT.values()]
    offsets = [offset for _, offset in _POINT.values()]
    record = np.dtype({"names": names, "formats": forms, "offsets": offsets, "itemsize": _POINT_STEP})
    rows = np.zeros(len(columns["x"]), record)  # zeros: gaps are the same in every run
    for name in names:
        rows[name] = columns[name]
    fields = tuple(PointField(*field) for field in zip(names, offsets, forms, strict=True))
    return Points(header, len(rows), 1, fields, _POINT_STEP, rows.nbytes, rows.tobytes())
