"""Small recordings for the tests: made by the libraries' own writers, read by the libraries' own readers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_typestore

from fusion.recordings.base import Recording

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
TYPES = {
    "/rgb": "sensor_msgs/msg/CompressedImage",
    "/fir": "sensor_msgs/msg/Image",
    "/imu": "sensor_msgs/msg/Imu",
}
SECOND = 10**9


class Row(NamedTuple):
    topic: str
    log_ns: int
    data: bytes


def rows_of(count: int = 60, seed: int = 0, jitter_ns: int = 0) -> list[Row]:
    """Messages of three topics, ten a second; `jitter_ns` shuffles their times in the file."""
    rng = np.random.default_rng(seed)
    rows = []
    for i in range(count):
        topic = ("/rgb", "/fir", "/imu")[i % 3]
        late = int(rng.integers(0, jitter_ns + 1))
        size = int(rng.integers(40, 400))
        body = np.cumsum(rng.integers(0, 2, size)).astype(np.uint8).tobytes()
        rows.append(Row(topic, 1_700_000_000 * SECOND + i * SECOND // 10 + late, b"\0\1\0\0" + body))
    return rows


def in_order(rows: Sequence[Row]) -> list[Row]:
    return sorted(rows, key=lambda row: row.log_ns)


def read(recording: Recording, *args: object, **more: object) -> list[Row]:
    return [Row(p.topic.name, p.log_ns, bytes(p.data)) for p in recording.packets(*args, **more)]  # type: ignore[arg-type]


def write_bag(path: Path, rows: Sequence[Row], packing: str = "", chunk_bytes: int = 2000) -> Path:
    writer = Bag1Writer(path)
    if packing:
        writer.set_compression(Bag1Writer.CompressionFormat[packing.upper()])
    writer.chunk_threshold = chunk_bytes
    with writer:
        connections = {
            name: writer.add_connection(name, kind, typestore=ROS1) for name, kind in TYPES.items()
        }
        for row in rows:
            writer.write(connections[row.topic], row.log_ns, row.data)
    return path


def write_rosbag2(
    path: Path, rows: Sequence[Row], storage: str = "sqlite3", mode: str = "none", version: int = 9
) -> Path:
    writer = Bag2Writer(path, version=version, storage_plugin=StoragePlugin[storage.upper()])  # type: ignore[arg-type]
    writer.set_compression(CompressionMode[mode.upper()], CompressionFormat.ZSTD)
    with writer:
        connections = {
            name: writer.add_connection(name, kind, typestore=ROS2) for name, kind in TYPES.items()
        }
        for row in rows:
            writer.write(connections[row.topic], row.log_ns, row.data)
    return path


def write_mcap(
    path: Path, rows: Sequence[Row], packing: str = "zstd", chunk_size: int = 2000, **options
) -> Path:
    with path.open("wb") as file:
        writer = McapWriter(
            file, compression=CompressionType[packing.upper()], chunk_size=chunk_size, **options
        )
        writer.start("ros2", "tests")
        channels = {}
        for name, kind in TYPES.items():
            definition = ROS2.generate_msgdef(kind, ros_version=2)[0].encode()
            schema = writer.register_schema(kind, "ros2msg", definition)
            channels[name] = writer.register_channel(name, "cdr", schema)
        for row in rows:
            writer.add_message(channels[row.topic], row.log_ns, row.data, row.log_ns)
        writer.finish()
    return path


def by_library(path: Path) -> list[Row]:
    """What the libraries' readers say, in the order of log times."""
    return in_order(list(_by_library(path)))


def _by_library(path: Path) -> Iterator[Row]:
    if path.suffix == ".mcap":
        with path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages():
                yield Row(channel.topic, message.log_time, bytes(message.data))
        return
    with AnyReader([path], default_typestore=ROS2) as reader:
        for connection, log_ns, data in reader.messages():
            yield Row(connection.topic, log_ns, bytes(data))
