"""What every recording offers: topics, and timed bytes in the order of log times; the table of forms."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol


@dataclass(frozen=True, slots=True)
class Schema:
    """How a message is laid out, as the recording itself says it.

    `name` is in ROS 2's form (``sensor_msgs/msg/Image``; ROS 1's ``sensor_msgs/Image`` is brought to it),
    or as it stands for protobuf and JSON (``foxglove.RawImage``). `form` is MCAP's word for what `data`
    holds: ``ros1msg``, ``ros2msg``, ``ros2idl``, ``protobuf`` (a FileDescriptorSet), ``jsonschema``, or ""
    for none.
    """

    name: str
    form: str = ""
    data: bytes = b""


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic with one type; connections that agree in both are one, and one name may have two types.

    `encoding` is MCAP's word for the bytes of a message: ``ros1``, ``cdr``, ``protobuf``, ``json``, or what
    the file says. `count` is how many messages the file's own index claims, None where it has none.
    """

    name: str
    schema: Schema
    encoding: str
    count: int | None = field(default=None, compare=False)


class Packet(NamedTuple):
    """One message, not read yet. `log_ns` is when it was recorded; `data` may be a view into a chunk."""

    topic: Topic
    log_ns: int
    data: bytes | memoryview


class Recording(Protocol):
    """An open recording. `packets` may be called from several threads; each call reads on its own.

    `span_ns` is [first, last + 1) of the log times, None where there is no message; `faults` says in one line
    each what is damaged, with its place in the file, and how much of it was read nevertheless: it may grow
    while packets are read. `files` are the files that it consists of.
    """

    name: str
    form: str  # its row in `RECORDINGS`, for people: "rosbag1", "rosbag2 (sqlite3)", "MCAP"
    topics: Sequence[Topic]
    span_ns: tuple[int, int] | None
    files: Sequence[str]
    faults: Sequence[str]

    def packets(
        self, topics: Collection[Topic] | None = None, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Packet]:
        """Messages of `topics` (None: all) with `start_ns` <= log time < `end_ns`, in the order of log times;
        equal times in the order of the file. Reads no more than it must, and keeps a chunk or two in memory.
        """
        ...

    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class RecordingKind:
    """One row of the table: what it `expects` in words, whether it `accepts` a path, how to `open` it."""

    expects: str
    accepts: Callable[[str], bool]
    open: Callable[[str], Recording]


# Name -> "module:attribute" of its `RecordingKind`, tried in this order; the entry points of the group
# "fusion.recordings" have the same form and come after them. Text, so that naming one imports none.
RECORDINGS: dict[str, str] = {
    "rosbag1": "fusion.recordings.rosbag1:ROSBAG1",
    "rosbag2": "fusion.recordings.rosbag2:ROSBAG2",
    "mcap": "fusion.recordings.mcap:MCAP",
}
