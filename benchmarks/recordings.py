"""Reading recordings: ours and the bare libraries', one container after the other."""

from __future__ import annotations

import base64
import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoder
from mcap_ros1.decoder import DecoderFactory as Ros1Decoder
from mcap_ros2.decoder import DecoderFactory as Ros2Decoder
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from table import Row, Section, at_least, spread
from timing import Sample, clocked, interleaved
from workspace import Workspace

from fusion.messages import reader_of
from fusion.messages.base import CompressedImage, Header, Points, RawImage
from fusion.recordings import open_recording
from fusion.simulate.container_writers import open_writer
from fusion.simulate.containers import write_recording
from fusion.simulate.mine.config import MineConfig
from fusion.simulate.mine.recording import make_mine

LEAST = 0.8  # of the bare library's rate
SMALL_WH = (32, 24)
DECODERS = {"mcap-ros1": Ros1Decoder, "mcap-ros2": Ros2Decoder, "mcap-protobuf": ProtobufDecoder}
CONTAINERS = (
    ("rosbag1", "none"),
    ("rosbag1", "lz4"),
    ("rosbag2", "none"),
    ("rosbag2-mcap", "none"),
    *((form, packed) for form in (*DECODERS, "mcap-json") for packed in ("none", "zstd")),
)

TEXT = """\
A simulated flight of {seconds:g} s (RGB of 640x480 at 20 Hz, thermal of 640x512 as 16-bit counts at 25
Hz, clouds of 65,536 rays at 10 Hz), written in each container by `fusion simulate record`; and {small}
images of {w}x{h} bytes, where a message costs more than its contents. Every message of the image and
cloud topics is read and deserialised on one thread, ours to what `fusion.messages` reads, theirs to the
library's own objects: rosbags' `AnyReader` for bags, `make_reader` with the decoders of
mcap-ros1-support, mcap-ros2-support and mcap-protobuf-support for MCAP, `json` and `base64` for JSON. The
recording is open on both sides before the clock starts. Ours checks the CRC of every chunk of an MCAP,
the library's reader does not unless it is told to."""

Read = Callable[[], int]  # reads all messages, and returns the bytes of their images and clouds


@dataclass(frozen=True, slots=True)
class Written:
    """A recording, and in which form it is."""

    path: Path
    form: str


def measure(space: Workspace, seconds: float, small: int, rounds: int) -> Section:
    mine = flight(space, seconds)
    rows = [row(space, mine, form, packed, rounds) for form, packed in CONTAINERS]
    rows += [
        row(space, mine, form, packed, rounds, raw=True) for form, packed in CONTAINERS if packed == "none"
    ]
    rows += [_small_row(space, form, small, rounds) for form in dict(CONTAINERS)]
    text = TEXT.format(seconds=seconds, small=f"{small:,}", w=SMALL_WH[0], h=SMALL_WH[1])
    return Section("Reading recordings", text, ("ours", "library"), rows)


def flight(space: Workspace, seconds: float) -> Path:
    """The folder of a simulated flight; made once."""
    folder = space.root / f"flight-{seconds:g}s"
    if not folder.exists():
        make_mine(folder, MineConfig.of({"duration_s": seconds}))
    return folder


def row(space: Workspace, mine: Path, form: str, packed: str, rounds: int, *, raw: bool = False) -> Row:
    path = write_recording(mine, space.root / "recorded", form, compression=packed, raw=raw).path
    what = "raw images" if raw else "JPEG"
    return _row(f"{form}, {packed}, {what}", Written(path, form), rounds)


def _small_row(space: Workspace, form: str, count: int, rounds: int) -> Row:
    suffix = {"rosbag1": ".bag"}.get(form, "" if form.startswith("rosbag2") else ".mcap")
    path = space.root / f"small{suffix}"
    w, h = SMALL_WH
    pixels = np.arange(w * h, dtype=np.uint8).tobytes()
    with open_writer(path, form, "none", None) as writer:
        for k in range(count):
            stamp = 10**18 + k * 10**6
            image = RawImage(Header(stamp, "camera"), w, h, "mono8", big_endian=False, step=w, data=pixels)
            writer.write("/camera/image", image, stamp, k)
    return _row(f"{form}, none, small messages", Written(path, form), rounds)


def _row(what: str, recording: Written, rounds: int) -> Row:
    """Both rates; the recording is deleted afterwards."""
    try:
        with _ours(recording) as ours, _bare(recording) as bare:
            size = ours()
            if bare() != size:
                raise AssertionError(f"{what}: the library reads {bare()} bytes, we {size}")
            taken = interleaved({"ours": lambda: clocked(ours), "bare": lambda: clocked(bare)}, rounds)
    finally:
        remove = shutil.rmtree if recording.path.is_dir() else Path.unlink
        remove(recording.path)
    rate = {who: _megabytes(seconds.rate(size / 1e6)) for who, seconds in taken.items()}
    ratio = taken["bare"].over(taken["ours"])
    return Row(what, rate["ours"], rate["bare"], ratio, at_least(LEAST))


def _megabytes(rate: Sample) -> str:
    return spread(rate, " MB/s")


@contextmanager
def _ours(recording: Written) -> Iterator[Read]:
    opened = open_recording(recording.path)
    readers = {topic: reader_of(topic) for topic in opened.topics}
    wanted = [t for t, reader in readers.items() if reader.kind in (RawImage, CompressedImage, Points)]

    def read() -> int:
        size = 0
        for topic, _, data in opened.packets(wanted):
            message: Any = readers[topic].message(data)
            size += len(message.data)
        return size

    try:
        yield read
    finally:
        opened.close()


@contextmanager
def _bare(recording: Written) -> Iterator[Read]:
    bags = recording.form.startswith("rosbag")
    with (_rosbags if bags else _mcap)(recording) as read:
        yield read


TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud2")
TOPICS = ("/camera/image", "/camera/image/compressed", "/thermal/image", "/lidar/points")


@contextmanager
def _rosbags(recording: Written) -> Iterator[Read]:
    with AnyReader([recording.path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        wanted = [connection for connection in reader.connections if connection.msgtype in TYPES]

        def read() -> int:
            size = 0
            for connection, _, raw in reader.messages(wanted):
                message: Any = reader.deserialize(raw, connection.msgtype)
                size += len(message.data)
            return size

        yield read


@contextmanager
def _mcap(recording: Written) -> Iterator[Read]:
    with recording.path.open("rb") as file:
        decoder = DECODERS.get(recording.form)
        reader = make_reader(file, decoder_factories=[decoder()] if decoder else [])

        def decoded() -> int:
            return sum(len(message.data) for *_, message in reader.iter_decoded_messages(topics=TOPICS))

        def parsed() -> int:
            size = 0
            for *_, message in reader.iter_messages(topics=TOPICS):
                size += len(base64.b64decode(json.loads(message.data)["data"]))
            return size

        yield decoded if decoder else parsed
