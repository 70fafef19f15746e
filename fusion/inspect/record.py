"""A finding for machines: plain JSON with stable keys."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from fusion.inspect.base import FORMAT, Finding, Looked, Stream, Times
from fusion.inspect.text import command_of
from fusion.messages.roles import Guess, Roles


def json_of(finding: Finding) -> str:
    """The finding as one JSON document, two spaces of indentation; what is not finite is null."""
    return json.dumps(record_of(finding), indent=2, allow_nan=False)


def record_of(finding: Finding) -> dict[str, Any]:
    """The finding as tables, lists, texts and numbers; the keys are always all there."""
    return _plain(
        {
            "format": FORMAT,
            "path": finding.path,
            "kind": finding.kind,
            "title": finding.title,
            "facts": finding.facts,
            "streams": [_stream(stream) for stream in finding.streams],
            "roles": None if finding.roles is None else _roles(finding.roles),
            "notes": finding.notes,
            "faults": finding.faults,
            "next": [
                {"command": command_of(step), "words": step.words, "why": step.why} for step in finding.steps
            ],
        }
    )


def _stream(stream: Stream) -> dict[str, Any]:
    return {
        "name": stream.name,
        "type": stream.type,
        "encoding": stream.encoding,
        "used": stream.used,
        "count": stream.count,
        "looked": _looked(stream.looked),
        "facts": stream.facts,
        "times": None if stream.times is None else _times(stream.times),
        "notes": stream.notes,
    }


def _looked(looked: Looked | None) -> dict[str, Any] | None:
    return None if looked is None else {"seen": looked.seen, "of": looked.of, "things": looked.things}


def _times(times: Times) -> dict[str, Any]:
    values = {name: getattr(times, name) for name in Times.__dataclass_fields__}
    return {**values, "looked": _looked(times.looked)}


def _roles(roles: Roles) -> dict[str, Any]:
    return {
        "chosen": {role: {"topic": topic.name, "why": why} for role, (topic, why) in roles.chosen.items()},
        "ambiguous": {role: [guess.topic.name for guess in tied] for role, tied in roles.ambiguous.items()},
        "infos": {role: topic.name for role, (topic, _) in roles.infos.items()},
        "transforms": [topic.name for topic in roles.transforms],
        "possible": [_guess(guess) for guess in roles.guesses],
    }


def _guess(guess: Guess) -> dict[str, Any]:
    return {"role": guess.role, "topic": guess.topic.name, "points": guess.points, "why": guess.reason}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
