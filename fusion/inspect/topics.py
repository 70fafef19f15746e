"""One topic of a recording, message by message: stamps of all that come by, pixels and points of some."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from fusion.errors import FrameError, InputError
from fusion.frames import Image, PointCloud
from fusion.inspect.base import Looked, Picture, Stream
from fusion.inspect.measure import PixelTally, freezes_said, points_of, times_of
from fusion.inspect.pictures import histogram, thumbnail, top_view
from fusion.messages import reader_of
from fusion.messages.base import (
    CameraInfo,
    CompressedImage,
    Message,
    MessageReader,
    Points,
    RawImage,
    Transforms,
)
from fusion.messages.clouds import cloud_of_points
from fusion.messages.images import image_of
from fusion.messages.roles import Seen, is_colour
from fusion.recordings.base import Packet, Topic
from fusion.timing.freeze import FreezeFinder, Step

FAULTS_NAMED = 5
LINKS_NAMED = 30
USED = {
    RawImage: "image",
    CompressedImage: "image",
    Points: "cloud",
    CameraInfo: "info",
    Transforms: "transforms",
}


class TopicLook:
    """What was seen of `topic`. `decode` is which of its messages (by number) are read whole; None: all of
    them.
    """

    def __init__(self, topic: Topic, decode: Collection[int] | None) -> None:
        self.topic, self.decode = topic, decode
        self.count, self.bytes, self.tried, self.decoded = 0, 0, 0, 0
        self.log_ns: list[int] = []
        self.stamps: list[int | None] = []
        self.faults: list[str] = []
        self.bad = 0
        self.first: Message | None = None
        self.facts: dict[str, set[Any]] = {}
        self.clouds: dict[str, Any] = {}
        self.tally, self.steps, self._freeze = PixelTally(), list[Step](), FreezeFinder()
        self.image: Image | None = None
        self.cloud: PointCloud | None = None
        self.reader, self.why = _reader(topic)
        self.kind = None if self.reader is None else self.reader.kind

    def add(self, packet: Packet) -> None:
        number, self.count = self.count, self.count + 1
        self.bytes += len(packet.data)
        self.log_ns.append(packet.log_ns)
        self.stamps.append(None)
        if self.reader is None:
            return
        try:
            self.stamps[-1] = self.reader.header(packet.data).stamp_ns
            if self.kind is not None and (self.decode is None or number in self.decode):
                self.tried += 1
                self._look(self.reader.message(packet.data), number)
        except FrameError as error:
            self.bad += 1
            if len(self.faults) < FAULTS_NAMED and self.kind is not None:
                self.faults.append(f"{self.topic.name}, message {number}: {error.what}")

    def stream(self, looked_at_all: bool, with_stamps: bool) -> Stream:
        """What it comes to; with `looked_at_all` every message came by, and `count` is measured."""
        count = self.count if looked_at_all else self.topic.count
        came = Looked(self.count, count, "messages")
        stamped = any(stamp is not None for stamp in self.stamps)
        times = times_of(
            self.stamps if stamped else self.log_ns, "header" if stamped else "log", came, self.log_ns
        )
        return Stream(
            self.topic.name,
            self.topic.schema.name or "(no type)",
            USED.get(self.kind, "") if self.kind is not None else "",
            count,
            self.topic.encoding,
            Looked(self.tried, count, "messages") if self.kind is not None else None,
            self._said(count),
            times if self.count else None,
            tuple(self._notes(stamped)),
            np.array(self.log_ns, np.int64) if with_stamps and self.kind is not None else None,
        )

    def seen(self, looked_at_all: bool) -> Seen:
        """For guessing roles. What none of its messages can be read as, it cannot be used as."""
        counted = looked_at_all or self.count > 0
        topic = replace(self.topic, count=self.count) if counted else self.topic
        useless = (self.bad > 0 and not self.decoded) or self.clouds.get("valid_points", [0, 1])[1] == 0
        kind = None if useless else self.kind
        return Seen.of(topic, kind, self.first, _share_of_zeros(self.image))

    def delay_s(self) -> float:
        """Median of log time minus stamp, of what was seen; 0 where nothing has a stamp."""
        known = [
            log - stamp for log, stamp in zip(self.log_ns, self.stamps, strict=True) if stamp is not None
        ]
        return float(np.median(known)) / 1e9 if known else 0.0

    def all_faults(self) -> list[str]:
        more = self.bad - len(self.faults)
        named = bool(self.faults)
        return self.faults + (
            [f"{self.topic.name}: {more} more messages cannot be read"] if named and more else []
        )

    def pictures(self) -> list[Picture]:
        made: list[Picture | None] = []
        if self.image is not None:
            made.append(thumbnail(self.topic.name, self.image.pixels))
            if self.image.pixels.ndim == 2:
                made.append(histogram(f"{self.topic.name}: counts", self.tally))
        if self.cloud is not None:
            made.append(top_view(self.topic.name, self.cloud))
        return [picture for picture in made if picture is not None]

    def _look(self, message: Message, number: int) -> None:
        self.first = self.first or message
        self._note("frame_id", message.header.frame_id)
        if isinstance(message, RawImage | CompressedImage):
            self._look_at_image(message, number)
        elif isinstance(message, Points):
            self._look_at_cloud(message, number)
        elif isinstance(message, CameraInfo):
            self._note("size_wh", (message.width, message.height))
            self._note("model", message.model or "none")
            self._note("fx", round(float(message.K[0, 0]), 3))
        else:
            for link in message.transforms:
                self._note("links", f"{link.parent} <- {link.child}")
        self.decoded += 1

    def _look_at_image(self, message: RawImage | CompressedImage, number: int) -> None:
        seen = Seen.of(self.topic, self.kind, message)
        self._note("encoding", seen.encoding)
        if isinstance(message, CompressedImage):
            self._note("format", message.format)
        where = f"{self.topic.name}, message {number}"
        image = image_of(message, _read_as(seen.encoding), stem=str(number), where=where)
        self._note("size_wh", image.size_wh)
        self.tally.add(image.pixels)
        if image.pixels.ndim == 2 and self.decode is None:
            self.steps.append(self._freeze.add(image.pixels))
        self.image = self.image or image

    def _look_at_cloud(self, message: Points, number: int) -> None:
        self._note("fields", tuple(f"{part.name} {part.dtype.name}" for part in message.fields))
        self._note("point_bytes", message.point_step)
        self._note("rows", message.height)
        cloud = cloud_of_points(message, stem=str(number), where=f"{self.topic.name}, message {number}")
        said = points_of(cloud)
        for key in ("points", "valid_points", "rings"):
            if key in said:
                least, most = self.clouds.get(key, (said[key], said[key]))
                self.clouds[key] = [min(least, said[key]), max(most, said[key])]
        for key in ("range_m", "extent_m", "intensity", "scan_s", "dropped"):
            if key in said:
                self.clouds.setdefault(f"first_cloud_{key}", said[key])
        self.cloud = self.cloud or cloud

    def _note(self, key: str, value: Any) -> None:
        values = self.facts.setdefault(key, set())
        if value != "" and len(values) < LINKS_NAMED:
            values.add(value)

    def _said(self, count: int | None) -> dict[str, Any]:
        said: dict[str, Any] = {}
        for key, values in self.facts.items():
            items = [list(v) if isinstance(v, tuple) else v for v in sorted(values, key=str)]
            if items:
                said[key] = items[0] if len(items) == 1 and key != "links" else items
        said |= self.clouds
        values = self.tally.facts()
        encoding = Seen.of(self.topic, self.kind, self.first).encoding
        said |= {"values_mm" if _read_as(encoding) == "depth" else "values": values} if values else {}
        if self.steps and self.decoded == count and not self.bad:
            said |= freezes_said(self.steps)
        if self.count:
            said["mean_message_bytes"] = round(self.bytes / self.count)
        return said

    def _notes(self, stamped: bool) -> list[str]:
        notes = [self.why] if self.why else []
        if self.kind is not None and self.count and not stamped and self.kind is not Transforms:
            notes.append("no message that was seen has a stamp in its header: log times are used")
        if self.kind is CameraInfo and 0.0 in self.facts.get("fx", ()):
            notes.append("K begins with 0: this camera is not calibrated")
        if self.clouds.get("valid_points", [0, 1])[1] == 0:
            notes.append("no valid point in any cloud that was looked at")
        if self.steps and self.bad:
            notes.append("frozen frames were not looked for: some messages cannot be read")
        return notes


def _reader(topic: Topic) -> tuple[MessageReader | None, str]:
    try:
        return reader_of(topic), ""
    except InputError as error:
        return None, f"not read: {error.what}"


def _read_as(encoding: str) -> Literal["rgb", "fir", "depth"]:
    """How to read pixels so that their numbers stay what they are; depth comes in whole millimetres."""
    if is_colour(encoding):
        return "rgb"
    word = encoding.lower()
    return "depth" if "compresseddepth" in word or word.startswith(("32f", "64f")) else "fir"


def _share_of_zeros(image: Image | None) -> float | None:
    return None if image is None or image.pixels.ndim != 2 else float(np.mean(image.pixels == 0))
