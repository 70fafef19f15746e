"""rosbag2's metadata.yaml: which files a recording consists of, and what they are claimed to hold."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from fusion.recordings.chunks import normal_type
from fusion.recordings.files import DamagedError

NAME = "metadata.yaml"
ROOT = "rosbag2_bagfile_information"
MAX_BYTES = 1 << 24
_DEEPEST = 32
NEWEST = 9  # the version of rosbag2's metadata that is known


@dataclass(frozen=True, slots=True)
class Metadata:
    """`counts` by (topic, type), the encoding of each in `encodings`; `spans` [start, end) by file name."""

    files: tuple[str, ...] = ()
    storage: str = ""
    version: int = 0
    packing: str = ""  # "zstd"
    packed: str = ""  # "file" or "message"
    counts: Mapping[tuple[str, str], int] = field(default_factory=dict)
    encodings: Mapping[tuple[str, str], str] = field(default_factory=dict)
    spans: Mapping[str, tuple[int, int]] = field(default_factory=dict)


def parse(text: str | bytes) -> Metadata:
    """Of the file's text, or of the copy in a .db3 without the outermost key. Raises `DamagedError`."""
    tree = _tree(text)
    root = tree.get(ROOT, tree)
    if not isinstance(root, dict) or "relative_file_paths" not in root:
        raise DamagedError(f"it lacks {ROOT!r} with 'relative_file_paths'")
    try:
        return _metadata(root)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DamagedError(f"it is malformed: {type(error).__name__} {error}") from None


def last_part(name: str) -> str:
    """A file's name without its folders, whatever separates them."""
    return re.split(r"[/\\]", name.rstrip("/\\"))[-1]


def _tree(text: str | bytes) -> dict[str, Any]:
    import yaml

    if len(text) > MAX_BYTES:
        raise DamagedError(f"its {len(text)} bytes are above the limit of {MAX_BYTES}")
    # Merged keys can double with every line, tags can build what was not meant: no rosbag2 writes either.
    marks = (b"<<", b"!!", b"!<") if isinstance(text, bytes) else ("<<", "!!", "!<")
    if any(mark in text for mark in marks):  # type: ignore[operator]
        raise DamagedError("it holds YAML tags or merged keys")
    try:
        _check_depth(yaml.parse(text, Loader=getattr(yaml, "CBaseLoader", yaml.BaseLoader)))
        tree = yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))  # noqa: S506 - both are safe
    except (yaml.YAMLError, ValueError, RecursionError, TypeError, OverflowError) as error:
        raise DamagedError(f"it is no YAML: {' '.join(str(error).split())[:120]}") from None
    if not isinstance(tree, dict):
        raise DamagedError("it is no table")
    return tree


def _check_depth(events: Iterable[Any]) -> None:
    """A loader in C builds nested nodes by recursion, and ends the process where its stack ends."""
    depth = 0
    for event in events:
        kind = type(event).__name__
        depth += kind.endswith(("SequenceStartEvent", "MappingStartEvent"))
        depth -= kind.endswith(("SequenceEndEvent", "MappingEndEvent"))
        if depth > _DEEPEST:
            raise DamagedError(f"it is nested more than {_DEEPEST} deep")


def _word(value: Any) -> str:
    """Text of a plain value: that of a list which refers to lists could be as long as one likes."""
    if isinstance(value, list | dict | set | tuple):
        raise TypeError("a list or table stands where a word should")
    return str(value)


def _metadata(root: dict[str, Any]) -> Metadata:
    topics = root.get("topics_with_message_count") or []
    counts: dict[tuple[str, str], int] = {}
    encodings: dict[tuple[str, str], str] = {}
    for row in topics:
        topic = row["topic_metadata"]
        key = _word(topic["name"]), normal_type(_word(topic["type"]))
        counts[key] = counts.get(key, 0) + int(row["message_count"])
        encodings[key] = _word(topic.get("serialization_format", "cdr"))
    spans: dict[str, tuple[int, int]] = {}
    for row in root.get("files") or []:
        start = int(row["starting_time"]["nanoseconds_since_epoch"])
        end = start + int(row["duration"]["nanoseconds"]) + 1
        spans[last_part(_word(row["path"]))] = (start, end) if int(row["message_count"]) else (0, 0)
    mode = _word(root.get("compression_mode") or "").lower()
    return Metadata(
        tuple(_word(name) for name in root["relative_file_paths"] or []),
        _word(root.get("storage_identifier", "")),
        int(root.get("version", 0)),
        _word(root.get("compression_format") or "").lower(),
        "" if mode == "none" else mode,
        counts,
        encodings,
        spans,
    )
