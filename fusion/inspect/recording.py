"""A recording: its topics, their times and contents, what each could be used as."""

from __future__ import annotations

from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any

from fusion.inspect.base import (
    QUICK_BYTES,
    QUICK_ITEMS,
    Asked,
    Finding,
    InspectKind,
    Step,
    steps_of,
)
from fusion.inspect.compression import compression_of
from fusion.inspect.measure import spread
from fusion.inspect.topics import TopicLook
from fusion.messages.base import Role
from fusion.messages.roles import Roles, roles_of
from fusion.recordings import is_recording, open_recording
from fusion.recordings.base import Recording, Topic

WINDOWS = (0.0, 0.25, 0.5, 0.75, 0.98)  # where, along its time, a large recording is looked into
PACKETS = 2_000  # messages that are read there at most
LINKS = 200  # transforms that are read without --full
FAR_S = 60.0  # from a stamp to the log: more is no delay
_OPTIONS: dict[Role, str] = {"rgb": "--rgb", "fir": "--fir", "lidar": "--lidar"}
_NEEDED: dict[Role, str] = {"rgb": "RGB", "fir": "thermal"}


def look_at_recording(path: str | Path, asked: Asked) -> Finding:
    """Topics, times, samples. Raises `InputError` where nothing of it can be read."""
    with closing(open_recording(path)) as recording:
        size = _bytes(recording)
        whole = asked.full or (size is not None and size <= QUICK_BYTES)
        looks = {topic: TopicLook(topic, _numbers(topic, asked.full)) for topic in recording.topics}
        if whole:
            _read_all(recording, looks, asked)
        else:
            _read_some(recording, looks)
        faults = [*recording.faults, *_lost(looks, whole)]
        return _finding(str(path), recording, size, list(looks.values()), faults, whole, asked)


def _numbers(topic: Topic, full: bool) -> set[int] | None:
    """Which messages of a topic are decoded."""
    if full:
        return None
    if "transform" in topic.schema.name.lower() or "tfmessage" in topic.schema.name.lower():
        return set(range(LINKS))
    return set(spread(topic.count, QUICK_ITEMS) if topic.count else range(QUICK_ITEMS))


def _read_all(recording: Recording, looks: dict[Topic, TopicLook], asked: Asked) -> None:
    total = sum(topic.count or 0 for topic in recording.topics)
    for done, packet in enumerate(recording.packets()):
        if done % 64 == 0:
            asked.progress(done, max(total, done + 1))
        looks[packet.topic].add(packet)


def _read_some(recording: Recording, looks: dict[Topic, TopicLook]) -> None:
    """A message of each topic at `WINDOWS` places, where it comes within `PACKETS` messages."""
    if recording.span_ns is None:
        return
    first, end = recording.span_ns
    counted = any(topic.count for topic in looks)
    for look in looks.values():
        look.decode = set(range(len(WINDOWS)))
    starts = [first + round((end - first) * part) for part in WINDOWS]
    for start, stop in zip(starts, [*starts[1:], end], strict=True):
        missing = {topic for topic in looks if topic.count != 0 or not counted}
        for packet in islice(recording.packets(start_ns=start, end_ns=stop), PACKETS):
            if packet.topic in missing:
                looks[packet.topic].add(packet)
                missing.discard(packet.topic)
            if not missing:
                break


def _lost(looks: dict[Topic, TopicLook], whole: bool) -> list[str]:
    """Messages that the index has and the recording has not, and those that are none."""
    lines = [fault for look in looks.values() for fault in look.all_faults()]
    other = [t for t, look in looks.items() if whole and t.count is not None and look.count != t.count]
    if other and any(topic.count for topic in looks):  # an index of nothing but zeros has no counts
        claimed, read = sum(topic.count or 0 for topic in other), sum(looks[topic].count for topic in other)
        named = ", ".join(topic.name for topic in other[:5]) + (", …" if len(other) > 5 else "")
        lines.append(f"its index claims {claimed:,} messages, {read:,} were read, of: {named}")
    return lines


def _finding(
    path: str,
    recording: Recording,
    size: int | None,
    looks: list[TopicLook],
    faults: list[str],
    whole: bool,
    asked: Asked,
) -> Finding:
    streams = tuple(sorted((look.stream(whole, asked.pictures) for look in looks), key=lambda s: s.name))
    counts = [stream.count for stream in streams]
    messages = None if None in counts else sum(count for count in counts if count is not None)
    roles = roles_of([look.seen(whole) for look in looks])
    facts = _facts(recording, size, messages, streams)
    notes = _notes(roles, looks, messages)
    pictures = [picture for look in looks for picture in look.pictures()] if asked.pictures else []
    return Finding(
        path,
        "recording",
        f"{recording.form}, {_many(messages)} on {_topics(recording)}",
        facts,
        streams,
        roles if messages != 0 else None,
        tuple(notes),
        tuple(faults),
        _steps(path, roles),
        tuple(pictures[:24]),
    )


def _facts(recording: Recording, size: int | None, messages: int | None, streams: Any) -> dict[str, Any]:
    facts: dict[str, Any] = {"form": recording.form, "files": len(recording.files)}
    facts |= {"size_bytes": size} if size is not None else {}
    facts |= {"compression": kind} if (kind := compression_of(recording.files)) is not None else {}
    facts["messages"] = messages
    if recording.span_ns is not None:
        first, end = recording.span_ns
        facts |= {"first_ns": first, "last_ns": end - 1, "duration_s": (end - 1 - first) / 1e9}
    facts["topics"] = len({stream.name for stream in streams})
    facts["message_encodings"] = sorted({topic.encoding or "(none)" for topic in recording.topics})
    forms = {topic.schema.form for topic in recording.topics if topic.schema.data}
    without = sorted({topic.schema.name for topic in recording.topics if not _defined(topic)})
    facts["definitions"] = sorted(forms) or "none in the file"
    return facts | ({"types_without_definition": without} if without and forms else {})


def _notes(roles: Roles, looks: list[TopicLook], messages: int | None) -> list[str]:
    if messages == 0:
        return ["no messages"]
    notes = [
        f"which is {role} is not clear: {', '.join(guess.topic.name for guess in tied)}"
        for role, tied in roles.ambiguous.items()
    ]
    thermal = roles.chosen.get("fir")
    image = next((look.image for look in looks if thermal and look.topic == thermal[0]), None)
    if image is not None and image.pixels.dtype.itemsize == 1:
        notes.append("thermal is 8 bit: the camera's own contrast, no counts")
    notes += [
        f"{look.topic.name}: {seconds:,.0f} s lie between its stamps and the log: replayed, or another clock?"
        for look in looks
        if look.kind is not None and abs(seconds := look.delay_s()) > FAR_S
    ]
    missing = [words for role, words in _NEEDED.items() if role not in roles.chosen]
    if missing:
        notes.append(f"nothing here can be fused: no topic can be {' and none '.join(missing)}")
    return notes


def _steps(path: str, roles: Roles) -> tuple[Step, ...]:
    if not _NEEDED.keys() <= roles.chosen.keys():
        return ()
    words: list[object] = ["fusion", "preprocess", path]
    for role, option in _OPTIONS.items():
        if role in roles.chosen:
            words += [option, roles.chosen[role][0].name]
    return steps_of(
        ([*words, "-o", "OUT"], "to fused frames (--rig RIG: how its sensors stand)"),
    )


def _defined(topic: Topic) -> bool:
    """Whether the recording says how its messages are laid out; of an Empty there is nothing to say."""
    return bool(topic.schema.data) or topic.schema.name.rpartition("/")[2] == "Empty"


def _topics(recording: Recording) -> str:
    names = len({topic.name for topic in recording.topics})
    return f"{names} topic{'' if names == 1 else 's'}"


def _bytes(recording: Recording) -> int | None:
    try:
        return sum(Path(file).stat().st_size for file in recording.files)
    except OSError:
        return None


def _many(messages: int | None) -> str:
    if messages is None:
        return "messages that nobody counted"
    return "no messages" if messages == 0 else f"{messages:,} message{'' if messages == 1 else 's'}"


RECORDING = InspectKind("a recording (rosbag1, rosbag2, MCAP)", is_recording, look_at_recording)
