"""Whether recordings have the topics that a manifest gives roles to, and what their first messages hold."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from fusion.cli.dataset_checks import RoleSeen
from fusion.errors import FusionError
from fusion.messages import reader_of
from fusion.messages.base import CameraInfo, CompressedImage, Message, Points, RawImage
from fusion.messages.roles import Seen
from fusion.recordings import open_recording

if TYPE_CHECKING:
    from fusion.cli.dataset_checks import Report
    from fusion.manifest import Layout
    from fusion.recordings.base import Recording, Topic

_KINDS: dict[str, tuple[type[Message], ...]] = {
    "rgb": (RawImage, CompressedImage),
    "fir": (RawImage, CompressedImage),
    "depth": (RawImage, CompressedImage),
    "lidar": (Points,),
    "rgb_info": (CameraInfo,),
    "fir_info": (CameraInfo,),
}


def check_recordings(layout: Layout, report: Report) -> None:
    """Open every recording; of each topic with a role read the first message. Findings go to `report`."""
    plan = layout.recording
    if plan is None:
        raise ValueError("the layout has no recordings")
    counts: Counter[str] = Counter()
    first: dict[str, Seen] = {}
    for path in plan.files:
        try:
            recording = open_recording(path)
        except FusionError as error:
            report.wrong("unreadable", str(error))
            continue
        try:
            for role, name in plan.topics.items():
                counts[role] += _topic(recording, path, role, name, first, report)
            for fault in recording.faults:
                report.wrong("damage", f"{path}: {fault}")
        finally:
            recording.close()
    for role, name in plan.topics.items():
        report.roles.append(_role(role, name, counts[role], first.get(role)))
        _fits(layout, role, first.get(role), report)
    from fusion.cli.dataset_calibration import check_calibration

    sizes = {role: seen.size_wh for role, seen in first.items() if role in ("rgb", "fir") and seen.size_wh}
    check_calibration(layout, sizes, report)


def _topic(
    recording: Recording, path: Path, role: str, name: str, first: dict[str, Seen], report: Report
) -> int:
    """How many messages the topic has, as far as the recording says; its first one as `first[role]`."""
    found = [topic for topic in recording.topics if topic.name == name]
    if not found:
        there = ", ".join(f"{topic.name} ({topic.schema.name})" for topic in recording.topics[:12]) or "none"
        report.wrong("topic", f"{path}: no topic {name} for {role}; it has {there}")
        return 0
    try:
        reader = reader_of(found[0])
        if reader.kind is None or not issubclass(reader.kind, _KINDS[role]):
            what = f"{path}: {name} is {found[0].schema.name}, which cannot be {role}"
            report.wrong("topic", what)
            return 0
        packet = next(iter(recording.packets(found[:1])), None)
        if packet is None:
            report.wrong("topic", f"{path}: {name}, for {role}, has no message")
            return 0
        if role not in first:
            first[role] = Seen.of(found[0], reader.kind, reader.message(packet.data))
    except FusionError as error:
        report.wrong("unreadable", f"{path}: {error}")
    return _messages(found[0])


def _messages(topic: Topic) -> int:
    return topic.count or 0


def _role(role: str, name: str, count: int, seen: Seen | None) -> RoleSeen:
    if seen is None or seen.size_wh is None:
        return RoleSeen(role, name, count or None)
    size = {"{}x{}".format(*seen.size_wh): 1}
    return RoleSeen(role, name, count or None, 1, size, {seen.encoding or "not known": 1})


def _fits(layout: Layout, role: str, seen: Seen | None, report: Report) -> None:
    """The first image's size and bits against the manifest's checks."""
    checks = layout.manifest.checks
    wanted = getattr(checks, f"{role}_size_wh", None)
    if seen is None or seen.size_wh is None:
        return
    if wanted is not None and tuple(wanted) != tuple(seen.size_wh):
        want, got = ("{}x{}".format(*size) for size in (wanted, seen.size_wh))
        report.wrong("size", f"{role} images of {layout.manifest.name} are {want}, those recorded are {got}")
    word = seen.encoding.lower()
    bits = {"mono8": 8, "8uc1": 8, "mono16": 16, "16uc1": 16}.get(word)
    if role == "fir" and None not in (bits, checks.fir_bits) and bits != checks.fir_bits:
        text = f"thermal images of {layout.manifest.name} have {checks.fir_bits} bits, those recorded {bits}"
        report.wrong("bits", text)
