"""Which topic of a recording plays which role, and by which clock: as asked for, or as found."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress

from fusion.errors import FrameError, InputError, UsageError
from fusion.messages import reader_of
from fusion.messages.base import CompressedImage, Points, RawImage
from fusion.messages.roles import Roles, Seen, roles_of
from fusion.preprocess.config import StreamsConfig
from fusion.preprocess.recorded import Streams
from fusion.recordings.base import Recording, Topic
from fusion.rig import Rig

KINDS = {"rgb": (RawImage, CompressedImage), "fir": (RawImage, CompressedImage), "lidar": (Points,)}


def resolve_streams(
    recording: Recording, config: StreamsConfig, rig: Rig | None = None, fir_colour: str = "refuse"
) -> tuple[Streams, list[str]]:
    """The streams of `recording` as `config` wants them, and what was guessed, in words.

    The clock of a rig (`time_offset_s`) counts where the configuration does not give another. Raises
    `UsageError` for topics that are not there or are no images or clouds, `InputError` where a camera
    cannot be told.
    """
    topics, said = _topics(recording, config)
    lead = config.lead
    if lead not in topics:
        raise UsageError(f"{lead} cannot lead: the recording has no {lead}", where=recording.name)
    given = {"fir": config.tolerance_ms, "lidar": config.lidar_tolerance_ms}
    if lead == "lidar":  # then RGB is what goes with the clouds, and thermal too
        given = {"rgb": config.lidar_tolerance_ms, "fir": config.lidar_tolerance_ms}
    tolerance = {role: round(1e6 * ms) for role, ms in given.items() if ms is not None and role in topics}
    offsets = {} if rig is None else {role: rig.time_offset_s.get(role, 0.0) for role in topics}
    if config.fir_offset_ms is not None:
        offsets = {**offsets, "fir": config.fir_offset_ms / 1e3, "rgb": 0.0}
    streams = Streams(
        topics,
        lead,
        config.stamp,
        tolerance,
        {role: round(1e9 * s) for role, s in offsets.items() if s},
        {"fir": config.fir_drift_ppm * 1e-6} if config.fir_drift_ppm else {},
        config.keep_frozen,
        fir_colour,
        config.begin_s,
        config.end_s,
    )
    return streams, said


def _topics(recording: Recording, config: StreamsConfig) -> tuple[dict[str, Topic], list[str]]:
    asked = {"rgb": config.rgb, "fir": config.fir, "lidar": config.lidar}
    topics = {role: _named(recording, role, name) for role, name in asked.items() if name}
    open_roles = [role for role, name in asked.items() if name is None]
    said: list[str] = []
    if open_roles:
        roles = roles_of([_seen(recording, topic) for topic in recording.topics])
        for role in open_roles:
            found = _guessed(recording, role, roles, topics)
            if found is not None:
                topics[role] = found
                said.append(f"{role}: {found.name}, {roles.chosen[role][1]}")  # type: ignore[index]
    return topics, said


def _guessed(recording: Recording, role: str, roles: Roles, taken: Mapping[str, Topic]) -> Topic | None:
    ambiguous = roles.ambiguous.get(role)  # type: ignore[call-overload]
    if ambiguous:
        names = ", ".join(guess.topic.name for guess in ambiguous)
        raise InputError(
            f"more than one topic can be {role}: {names}", where=recording.name, hint=f"--{role}"
        )
    found = roles.chosen.get(role)  # type: ignore[call-overload]
    if found is not None and found[0] not in taken.values():
        return found[0]
    if role == "lidar":
        return None
    raise InputError(
        f"no topic can be {role}", where=recording.name, hint=f"--{role} TOPIC; {_listed(recording)}"
    )


def _named(recording: Recording, role: str, name: str) -> Topic:
    found = [topic for topic in recording.topics if topic.name == name]
    if not found:
        raise UsageError(f"no topic {name}", where=f"--{role}", hint=_listed(recording))
    usable = [topic for topic in found if reader_of(topic).kind in KINDS[role]]
    if not usable:
        what = f"{name} is {found[0].schema.name}, which holds no {'points' if role == 'lidar' else 'images'}"
        raise UsageError(what, where=f"--{role}", hint=_listed(recording))
    return usable[0]


def _listed(recording: Recording) -> str:
    listed = [f"{topic.name} ({topic.schema.name})" for topic in recording.topics]
    more = f" and {len(listed) - 30} more" if len(listed) > 30 else ""
    return f"it has {', '.join(listed[:30]) or 'no topics'}{more}"


def _seen(recording: Recording, topic: Topic) -> Seen:
    try:
        reader = reader_of(topic)
    except InputError:
        return Seen(topic, None)
    if reader.kind not in (RawImage, CompressedImage, Points):
        return Seen.of(topic, reader.kind)
    packet = next(iter(recording.packets([topic])), None)
    message = None
    if packet is not None:
        with suppress(FrameError):  # one damaged message says nothing of its topic
            message = reader.message(packet.data)
    return Seen.of(topic, reader.kind, message)
