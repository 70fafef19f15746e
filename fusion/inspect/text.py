"""A finding in plain text, for terminals and logs. Names come from files: what is not printable is
escaped.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from typing import Any

from fusion.inspect.base import Facts, Finding, Step, Stream, Times
from fusion.messages.base import Role
from fusion.report.table import table

_STREAM_WORDS = {"recording": "topics"}
_CLOCKS = {"header": "stamps in headers", "log": "log times", "name": "stamps in names"}
ORDER: tuple[Role, ...] = ("rgb", "fir", "lidar", "depth")
_NAMED_TOPICS = 40  # more that are not used are only counted, by type


def text_of(finding: Finding) -> list[str]:
    """The lines of a finding, most important first."""
    lines = [shown(f"{finding.path}: {finding.title}")]
    if finding.facts:
        lines += _indented(table(rows_of(finding.facts)), 2)
    lines += [shown(f"fault: {fault}") for fault in finding.faults]
    if finding.streams:
        lines += ["", _STREAM_WORDS.get(finding.kind, "holds")]
        for line in _streams(finding.streams):
            lines += [f"  {line}"]
    lines += _roles(finding)
    lines += [shown(f"note: {note}") for note in finding.notes]
    if finding.steps:
        lines += ["", "next"]
        for step in finding.steps:
            lines += [f"  {command_of(step)}", f"      {shown(step.why)}"]
    return lines


def command_of(step: Step) -> str:
    """The command line of a step as a shell takes it."""
    return " ".join(quoted(word) for word in step.words)


def quoted(word: str) -> str:
    """One word for a POSIX shell; with $'…' where it holds what a terminal does not show."""
    if word.isprintable():
        return shlex.quote(word)
    octets = word.encode("utf-8", "surrogateescape")
    return (
        "$'" + "".join(chr(b) if 32 <= b < 127 and b not in b"'\\" else f"\\x{b:02x}" for b in octets) + "'"
    )


def shown(text: str) -> str:
    """The text with everything escaped that a terminal would act upon or cannot show."""
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape", "backslashreplace").decode() for c in text
    )


def rows_of(facts: Facts) -> list[tuple[str, str]]:
    """(label, text) of facts: the unit goes from the key to the value."""
    rows = []
    for key, value in facts.items():
        label, words = said(key, value)
        rows.append((shown(label), shown(words)))
    return rows


def said(key: str, value: Any, otherwise: Callable[[Any], str] | None = None) -> tuple[str, str]:
    """A fact as a label and words; the unit is the end of the key, else that of the table it stands in."""
    for suffix, words in _UNITS.items():
        if key.endswith(suffix):
            return key.removesuffix(suffix).replace("_", " ") or suffix.strip("_"), _spoken(value, words)
    return key.replace("_", " "), _spoken(value, otherwise or _number)


def times_rows(times: Times) -> list[tuple[str, str]]:
    """What is said of a stream's stamps."""
    duration_s = (times.last_ns - times.first_ns) / 1e9
    words = f"{_stamp(times.first_ns)} to {_stamp(times.last_ns)}, {duration_s:.3f} s"
    rows = [("stamps", f"{words} ({_CLOCKS[times.clock]}, {times.looked})")]
    if times.rate_hz is not None:
        jitter = "" if times.jitter_ms is None else f", jitter {times.jitter_ms:.3g} ms"
        rows.append(("rate", f"{times.rate_hz:.4g} Hz (median step {1e3 / times.rate_hz:.4g} ms{jitter})"))
    if times.gap_count:
        named = ", ".join(
            f"{(end - begin) / 1e6:.4g} ms at {(begin - times.first_ns) / 1e9:.3f} s"
            for begin, end in times.gaps_ns
        )
        rows.append(("gaps", f"{times.gap_count:,}; the longest: {named}"))
    elif times.gap_count == 0:
        rows.append(("gaps", "none"))
    if times.backwards:
        rows.append(("jumps back", f"{times.backwards:,} stamps lie before the one they follow"))
    if times.duplicates:
        rows.append(("repeated", f"{times.duplicates:,} stamps equal the one they follow"))
    if times.without:
        rows.append(("no stamp", f"{times.without:,} of {times.looked}"))
    if times.delay_ms is not None and times.clock == "header":
        median, spread = times.delay_ms
        within = f" (median; 90 % lie within {_span(spread)})" if times.looked.seen > 1 else ""
        rows.append(
            ("logged", f"{_span(abs(median))} {'after' if median >= 0 else 'before'} the stamp{within}")
        )
    return rows


def _streams(streams: tuple[Stream, ...]) -> Iterator[str]:
    used = [stream for stream in streams if stream.used]
    others = [stream for stream in streams if not stream.used]
    for stream in used:
        yield from _stream(stream)
    for stream in others[:_NAMED_TOPICS]:
        yield shown(f"{stream.name}  {stream.type}{_count(stream)}, not used")
    if len(others) > _NAMED_TOPICS:
        yield f"… and {len(others) - _NAMED_TOPICS} more that are not used (--json names all)"


def _stream(stream: Stream) -> Iterator[str]:
    yield shown(f"{stream.name}  {stream.type}{_count(stream)}")
    rows = rows_of(stream.facts)
    if stream.looked is not None:
        rows.insert(0, ("looked at", str(stream.looked)))
    if stream.times is not None:
        rows += times_rows(stream.times)
    if rows:
        yield from _indented(table(rows), 4)
    for note in stream.notes:
        yield shown(f"    note: {note}")


def _count(stream: Stream) -> str:
    return "" if stream.count is None else f", {stream.count:,}"


def _roles(finding: Finding) -> list[str]:
    roles = finding.roles
    if roles is None:
        return []
    chosen = [(role, *roles.chosen[role]) for role in ORDER if role in roles.chosen]
    rows = [(role, f"{topic.name}: {why}") for role, topic, why in chosen]
    rows += [(f"info of {role}", topic.name) for role, (topic, _) in roles.infos.items()]
    rows += [("transforms", topic.name) for topic in roles.transforms]
    for role, tied in roles.ambiguous.items():
        rows.append((f"or as {role}", "as good: " + ", ".join(guess.topic.name for guess in tied[1:])))
    rows = [(label, shown(text)) for label, text in rows] or [
        ("none", "nothing here can be rgb, fir or lidar")
    ]
    return ["", "roles", *_indented(table(rows), 2)]


def _indented(lines: list[str], by: int) -> list[str]:
    return [" " * by + line for line in lines]


def _spoken(value: Any, words: Callable[[Any], str]) -> str:
    if isinstance(value, Mapping):
        return ", ".join(" ".join(said(str(key), inner, words)) for key, inner in value.items()) or "none"
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return {True: "yes", False: "no", None: "unknown"}.get(value, str(value)) if value != "" else "none"
    if words is _size:
        return words(value)
    if isinstance(value, list | tuple):
        pair = len(value) == 2 and all(isinstance(v, int | float) for v in value)
        parts = [_spoken(inner, words) for inner in value]
        return (" to " if pair else ", ").join(dict.fromkeys(parts) if pair else parts) or "none"
    return words(value)


def _number(value: float) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:.6g}"


def _size(value: Any) -> str:
    pair = isinstance(value, list | tuple) and len(value) == 2 and isinstance(value[0], int)
    return "{}x{}".format(*value) if pair else ", ".join(_size(inner) for inner in value)


def _bytes(value: int) -> str:
    for unit, size in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if value >= size:
            return f"{value / size:.3g} {unit} ({value:,} bytes)"
    return f"{value:,} bytes"


def _stamp(value: int) -> str:
    """UTC where it can be a date since 1990, else plain seconds."""
    seconds, rest = divmod(value, 10**9)
    if 631_152_000 <= seconds < 4_102_444_800:
        return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M:%S}.{rest // 1000:06d}"
    return f"{value / 1e9:.6f} s"


def _span(ms: float) -> str:
    return f"{ms:.4g} ms" if ms < 10_000 else f"{ms / 1e3:,.1f} s"


def _unit(unit: str, form: str = ".6g") -> Callable[[float], str]:
    return lambda value: f"{value:{form}} {unit}"


_UNITS: dict[str, Callable[[Any], str]] = {
    "_wh": _size,
    "_bytes": _bytes,
    "_ns": _stamp,
    "_ms": _unit("ms", ".4g"),
    "_mm": _unit("mm"),
    "_hz": _unit("Hz", ".4g"),
    "_celsius": _unit("°C", ".4g"),
    "_share": lambda value: f"{value:.1%}",
    "_deg": _unit("°", ".4g"),
    "_px": _unit("px"),
    "_m": _unit("m"),
    "_s": _unit("s"),
}
