"""JSON messages: foxglove's types as their JSON schemas write them, bytes in base64; the header of others."""

from __future__ import annotations

import binascii
import json
from typing import Any

from fusion.errors import FrameError, InputError
from fusion.messages import foxglove
from fusion.messages.base import Bytes, Header, Message, Transforms
from fusion.recordings.base import Topic

MAX_JSON = 1 << 26  # bytes of a message: what they become takes up to 30 times as much


class JsonReader:
    """`MessageReader` of a topic in JSON. The schema is not needed: names decide, and values are checked."""

    def __init__(self, topic: Topic) -> None:
        if topic.schema.form not in ("", "jsonschema"):
            raise InputError(f"its definition has the form {topic.schema.form!r}, not 'jsonschema'")
        self._where = topic.name
        package, _, name = topic.schema.name.replace("/", ".").rpartition(".")
        ours = package.startswith("foxglove")
        self._shape = foxglove.SHAPES.get(name) if ours else None
        self.kind: type[Message] | None = self._shape and self._shape.kind

    def header(self, data: Bytes) -> Header:
        if self.kind is Transforms:
            return self.message(data).header
        values = self._parsed(data)
        if self.kind is None and not {"timestamp", "frame_id"} <= values.keys():
            return Header()
        return self._made(foxglove.HEADER, foxglove.header, values)

    def message(self, data: Bytes) -> Message:
        if self._shape is None:
            raise FrameError("messages of this type are not read", where=self._where)
        return self._made(self._shape.tree, self._shape.make, self._parsed(data))

    def _parsed(self, data: Bytes) -> dict[str, Any]:
        if len(data) > MAX_JSON:
            raise FrameError(
                f"a JSON message of {len(data):,} bytes, more than {MAX_JSON:,}", where=self._where
            )
        try:
            values = json.loads(bytes(data))
        except (ValueError, RecursionError) as error:
            raise FrameError(f"it is no JSON: {str(error)[:100]}", where=self._where) from None
        if not isinstance(values, dict):
            raise FrameError("it is JSON, but no object", where=self._where)
        return values

    def _made(self, tree: foxglove.Tree, make: Any, values: dict[str, Any]) -> Any:
        try:
            return make(_checked(tree, values, ""))
        except FrameError as error:
            raise FrameError(error.what, where=self._where) from None
        except OverflowError:
            raise FrameError("one of its numbers is larger than any measure", where=self._where) from None


def _checked(wanted: Any, value: Any, path: str) -> Any:
    """`value` as the tree `wanted` needs it: base64 decoded; other keys are left out, absent ones 0."""
    if isinstance(wanted, list):
        if not isinstance(value, list | None) or len(value or ()) > foxglove.MAX_PARTS:
            raise FrameError(f"its {path} is no list of at most {foxglove.MAX_PARTS:,}")
        return [_checked(wanted[0], each, path) for each in value or ()]
    if not isinstance(wanted, type):
        if not isinstance(value, dict | None):
            raise FrameError(f"its {path} is no object")
        parts = value or {}
        return {
            key: _checked(inner, parts.get(key), f"{path}.{key}".lstrip(".")) for key, inner in wanted.items()
        }
    if value is None:
        return wanted()
    kinds = {float: (int, float), bytes: str}.get(wanted, wanted)
    if not isinstance(value, kinds) or isinstance(value, bool):
        raise FrameError(f"its {path} is of the type {type(value).__name__}, not {_WORDS[wanted]}")
    return _base64(value, path) if wanted is bytes else wanted(value)


def _base64(text: str, path: str) -> bytes:
    try:
        return binascii.a2b_base64(text, strict_mode=True)
    except ValueError as error:
        raise FrameError(f"its {path} is no base64: {error}") from None


_WORDS = {int: "a whole number", float: "a number", str: "text", bytes: "base64"}
