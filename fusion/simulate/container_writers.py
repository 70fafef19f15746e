"""Recordings written by the libraries' own writers, one class a family of containers."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

import yaml
from mcap.writer import CompressionType
from mcap.writer import Writer as McapLibraryWriter
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode, StoragePlugin

from fusion import foxglove
from fusion.messages.base import Message
from fusion.simulate.ros_wire import TYPES, ros_wire

# Form -> the compressions that it is written with.
COMPRESSIONS: dict[str, tuple[str, ...]] = {
    "rosbag1": ("none", "lz4", "bz2"),
    "rosbag2": ("none", "zstd-message", "zstd-file"),
    "rosbag2-mcap": ("none", "zstd", "zstd-message", "zstd-file"),
    **dict.fromkeys(("mcap-ros1", "mcap-ros2", "mcap-protobuf", "mcap-json"), ("none", "lz4", "zstd")),
}


_MODES = {
    "none": CompressionMode.NONE,
    "zstd": CompressionMode.STORAGE,
    "zstd-message": CompressionMode.MESSAGE,
    "zstd-file": CompressionMode.FILE,
}


class MessageWriter(Protocol):
    """An open recording. `sequence` counts the messages of each topic from 0."""

    def write(self, topic: str, message: Message, log_ns: int, sequence: int) -> None: ...


def open_writer(
    path: Path, form: str, compression: str, split_bytes: int | None = None
) -> AbstractContextManager[MessageWriter]:
    """A writer for a new recording at `path`; it is whole when the context ends without an error."""
    if form == "rosbag1":
        return _Rosbag1(path, compression)
    if form.startswith("rosbag2"):
        plugin = StoragePlugin.MCAP if form.endswith("mcap") else StoragePlugin.SQLITE3
        return _Rosbag2(path, plugin, compression, split_bytes)
    return _Mcap(path, _WIRES[form](), compression)


class _Rosbag1:
    def __init__(self, path: Path, compression: str) -> None:
        self._wire, self._connections = ros_wire(1), {}
        self._bag = rosbag1.Writer(path)
        if compression != "none":
            self._bag.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])

    def __enter__(self) -> _Rosbag1:
        self._bag.open()
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self._bag.close()

    def write(self, topic: str, message: Message, log_ns: int, sequence: int) -> None:
        if topic not in self._connections:
            latched = 1 if topic == "/tf_static" else None
            self._connections[topic] = self._bag.add_connection(
                topic, TYPES[type(message)], typestore=self._wire.store, callerid="/robot", latching=latched
            )
        self._bag.write(self._connections[topic], log_ns, self._wire.bytes_of(message, sequence))


class _Rosbag2:
    """A folder; split, its files are written as bags of their own, whose metadata become one."""

    def __init__(self, path: Path, plugin: StoragePlugin, compression: str, split_bytes: int | None) -> None:
        self._path, self._plugin, self._compression, self._limit = path, plugin, compression, split_bytes
        self._wire = ros_wire(2)
        self._parts: list[Path] = []
        self._connections: dict[str, Any] = {}
        self._held = 0

    def __enter__(self) -> _Rosbag2:
        self._next()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bag.__exit__(kind, error, trace)
        if kind is None and self._limit is not None:
            _merge(self._path, self._parts)

    def write(self, topic: str, message: Message, log_ns: int, sequence: int) -> None:
        data = self._wire.bytes_of(message, sequence)  # ROS 2 leaves the count out
        if self._limit is not None and self._held and self._held + len(data) > self._limit:
            self._bag.close()
            self._next()
        if topic not in self._connections:
            kind, store = TYPES[type(message)], self._wire.store
            self._connections[topic] = self._bag.add_connection(topic, kind, typestore=store)
        self._bag.write(self._connections[topic], log_ns, data)
        self._held += len(data)

    def _next(self) -> None:
        """Open the next file: `path` itself where there is only one."""
        name = self._path.name if self._limit is None else f"{self._path.name}_{len(self._parts)}"
        self._parts.append(self._path.with_name(name))
        self._bag = rosbag2.Writer(self._parts[-1], version=9, storage_plugin=self._plugin)
        self._bag.set_compression(_MODES[self._compression], CompressionFormat.ZSTD)
        self._bag.open()
        self._connections, self._held = {}, 0


def _merge(path: Path, parts: list[Path]) -> None:
    """Make one bag of several: their files in one folder, with one metadata.yaml."""
    path.mkdir()
    heads = []
    for part in parts:
        text = (part / "metadata.yaml").read_text(encoding="utf-8")
        head = yaml.safe_load(text)["rosbag2_bagfile_information"]
        for file in head["relative_file_paths"]:
            (part / file).rename(path / file)
        heads.append(head)
    whole = {**heads[0]}
    start = min(head["starting_time"]["nanoseconds_since_epoch"] for head in heads)
    end = max(h["starting_time"]["nanoseconds_since_epoch"] + h["duration"]["nanoseconds"] for h in heads)
    whole["relative_file_paths"] = [file for head in heads for file in head["relative_file_paths"]]
    whole["files"] = [file for head in heads for file in head["files"]]
    whole["starting_time"] = {"nanoseconds_since_epoch": start}
    whole["duration"] = {"nanoseconds": end - start}
    whole["message_count"] = sum(head["message_count"] for head in heads)
    topics: dict[str, Any] = {}
    for head in heads:
        for topic in head["topics_with_message_count"]:
            known = topics.setdefault(topic["topic_metadata"]["name"], {**topic, "message_count": 0})
            known["message_count"] += topic["message_count"]
    whole["topics_with_message_count"] = [*topics.values()]
    text = yaml.safe_dump({"rosbag2_bagfile_information": whole}, sort_keys=False)
    (path / "metadata.yaml").write_text(text, encoding="utf-8")


@dataclass(frozen=True, slots=True)
class _Wire:
    """How an MCAP holds messages: profile, encodings, a kind's schema, the bytes of a message."""

    profile: str
    schema_encoding: str
    encoding: str
    schema: Callable[[type[Message]], tuple[str, bytes]]
    bytes_of: Callable[[Message, int], bytes]


def _ros1() -> _Wire:
    wire = ros_wire(1)
    return _Wire(
        "ros1",
        "ros1msg",
        "ros1",
        lambda kind: (TYPES[kind].replace("/msg/", "/"), wire.definition(kind).encode()),
        wire.bytes_of,
    )


def _ros2() -> _Wire:
    wire = ros_wire(2)
    return _Wire(
        "ros2", "ros2msg", "cdr", lambda kind: (TYPES[kind], wire.definition(kind).encode()), wire.bytes_of
    )


def _protobuf() -> _Wire:
    def schema(kind: type[Message]) -> tuple[str, bytes]:
        name = foxglove.schema_name(kind)
        return name, foxglove.protobuf_schema(name)

    return _Wire("", "protobuf", "protobuf", schema, lambda message, _: foxglove.protobuf_bytes(message))


def _json() -> _Wire:
    def schema(kind: type[Message]) -> tuple[str, bytes]:
        name = foxglove.schema_name(kind)
        return name, foxglove.json_schema(name)

    return _Wire("", "jsonschema", "json", schema, lambda message, _: foxglove.json_bytes(message))


_WIRES: dict[str, Callable[[], _Wire]] = {
    "mcap-ros1": _ros1,
    "mcap-ros2": _ros2,
    "mcap-protobuf": _protobuf,
    "mcap-json": _json,
}


class _Mcap:
    def __init__(self, path: Path, wire: _Wire, compression: str) -> None:
        self._path, self._wire = path, wire
        self._compression = CompressionType[compression.upper()]
        self._schemas: dict[type[Message], int] = {}
        self._channels: dict[str, int] = {}

    def __enter__(self) -> _Mcap:
        self._file = self._path.open("xb")
        self._mcap = McapLibraryWriter(self._file, compression=self._compression)
        self._mcap.start(profile=self._wire.profile)
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        with self._file:
            if kind is None:
                self._mcap.finish()

    def write(self, topic: str, message: Message, log_ns: int, sequence: int) -> None:
        data = self._wire.bytes_of(message, sequence)
        self._mcap.add_message(self._channel(topic, type(message)), log_ns, data, log_ns, sequence)

    def _channel(self, topic: str, kind: type[Message]) -> int:
        if kind not in self._schemas:
            name, data = self._wire.schema(kind)
            self._schemas[kind] = self._mcap.register_schema(name, self._wire.schema_encoding, data)
        if topic not in self._channels:
            self._channels[topic] = self._mcap.register_channel(
                topic, self._wire.encoding, self._schemas[kind]
            )
        return self._channels[topic]
