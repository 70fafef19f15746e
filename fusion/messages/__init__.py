"""From a recording's bytes to images and clouds: one reader a wire, one meaning for all."""

from __future__ import annotations

from importlib import import_module

from fusion.errors import InputError
from fusion.messages.base import MessageReader
from fusion.recordings.base import Topic

# MCAP's word for a wire -> "module:attribute" of what makes a reader of a topic.
WIRES: dict[str, str] = {
    "ros1": "fusion.messages.ros:RosReader",
    "cdr": "fusion.messages.ros:RosReader",
    "protobuf": "fusion.messages.protobuf:ProtobufReader",
    "json": "fusion.messages.jsons:JsonReader",
}


def reader_of(topic: Topic) -> MessageReader:
    """What reads the messages of `topic`, as its encoding, its type and the definition in the recording say.

    Its `kind` is None for types that are not used here. Raises `InputError` where the encoding is unknown, or
    its definition is missing, damaged, or lacks a field that its type must have.
    """
    what = f"topic of type {topic.schema.name or '(none)'}, encoding {topic.encoding or '(none)'}"
    if topic.encoding not in WIRES:
        raise InputError(
            f"{what}: the encoding is not read", where=topic.name, hint=f"read are: {', '.join(WIRES)}"
        )
    module, attribute = WIRES[topic.encoding].split(":")
    try:
        return getattr(import_module(module), attribute)(topic)
    except InputError as error:
        raise InputError(f"{what}: {error.what}", where=topic.name, hint=error.hint) from None
