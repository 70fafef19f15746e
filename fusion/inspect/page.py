"""A finding as one self-contained HTML page. What stands in it comes from data: everything is escaped."""

from __future__ import annotations

import base64
from typing import Any

from jinja2 import Environment, StrictUndefined
from numpy.typing import NDArray

from fusion.inspect.base import Finding, Picture, Stream
from fusion.inspect.measure import times_of
from fusion.inspect.pictures import strip
from fusion.inspect.text import ORDER, command_of, rows_of, shown, times_rows

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{{ title }}</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body { font: 15px/1.5 sans-serif; max-width: 1180px; margin: 2em auto; padding: 0 1em; color: #222 }
h1 { font-size: 1.5em; overflow-wrap: anywhere } h2 { font-size: 1.15em; margin-top: 1.6em }
table { border-collapse: collapse; margin: .6em 0; max-width: 100% }
td, th { border: 1px solid #ddd; padding: .2em .6em; text-align: left; vertical-align: top;
 overflow-wrap: anywhere }
th { background: #f4f4f4; font-weight: 600 }
.line td { border: 0; padding: .1em .6em .1em 0 } .line img { display: block }
.fault { color: #a01010 } .note { color: #8a5a00 } .small { color: #555 }
pre { background: #f4f4f4; padding: .5em .8em; margin: .4em 0 0; white-space: pre-wrap;
 overflow-wrap: anywhere }
.pictures { display: flex; flex-wrap: wrap; gap: 1em } figure { margin: 0; max-width: 100% }
figcaption { color: #555; max-width: 480px; overflow-wrap: anywhere }
img { max-width: 100%; border: 1px solid #ddd }
</style></head><body>
<h1>{{ title }}</h1>
<p class="small">{{ path }}</p>
<table>{% for label, text in facts %}<tr><th>{{ label }}</th><td>{{ text }}</td></tr>
{% endfor %}</table>
{% for line in faults %}<p class="fault">fault: {{ line }}</p>
{% endfor %}{% for line in notes %}<p class="note">note: {{ line }}</p>
{% endfor %}
{% if steps %}<h2>Next</h2>
{% for command, why in steps %}<pre>{{ command }}</pre><p class="small">{{ why }}</p>
{% endfor %}{% endif %}
{% if roles is not none %}<h2>Roles</h2>
<table><tr><th>role</th><th>topic</th><th>why</th></tr>
{% for row in roles %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</table>{% endif %}
{% if pictures %}<h2>Pictures</h2><div class="pictures">
{% for p in pictures %}<figure><img alt="{{ p.title }}" src="{{ uri(p.data) }}">
<figcaption><b>{{ p.title }}</b><br>{{ p.caption }}</figcaption></figure>
{% endfor %}</div>{% endif %}
{% if lines %}<h2>Along time</h2><table class="line">
{% for name, data in lines %}<tr><td>{{ name }}</td>
<td><img alt="times of {{ name }}" src="{{ uri(data) }}"></td></tr>
{% endfor %}<tr><td></td>
<td class="small">{{ span_s }} s from left to right: what was looked at; gaps are red</td></tr></table>
{% endif %}
{% for stream in streams %}<h2>{{ stream.name }}</h2>
<p class="small">{{ stream.words }}</p>
{% if stream.rows %}<table>
{% for label, text in stream.rows %}<tr><th>{{ label }}</th><td>{{ text }}</td></tr>
{% endfor %}</table>{% endif %}{% for line in stream.notes %}<p class="note">note: {{ line }}</p>
{% endfor %}{% endfor %}
{% if unused %}<h2>Not used</h2><table><tr><th>name</th><th>type</th><th>count</th></tr>
{% for row in unused %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</table>{% endif %}
</body></html>
"""


def page_of(finding: Finding) -> bytes:
    """The page as UTF-8. Pictures are those that the finding has; nothing is loaded from elsewhere."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.globals.update(uri=_uri)
    span, lines = _lines(finding.streams)
    html = environment.from_string(_PAGE).render(
        title=shown(finding.title),
        path=shown(finding.path),
        facts=rows_of(finding.facts),
        faults=[shown(line) for line in finding.faults],
        notes=[shown(line) for line in finding.notes],
        steps=[(command_of(step), shown(step.why)) for step in finding.steps],
        roles=_roles(finding),
        pictures=[Picture(shown(p.title), shown(p.caption), p.data) for p in finding.pictures],
        lines=lines,
        span_s=f"{(span[1] - span[0]) / 1e9:.3f}",
        streams=[_stream(stream) for stream in finding.streams if stream.used],
        unused=[_unused(stream) for stream in finding.streams if not stream.used],
    )
    return html.encode("utf-8", "backslashreplace")


def _lines(streams: tuple[Stream, ...]) -> tuple[tuple[int, int], list[tuple[str, bytes]]]:
    known = [(stream, stream.stamps_ns) for stream in streams if stream.stamps_ns is not None]
    known = [(stream, stamps) for stream, stamps in known if len(stamps)]
    if not known:
        return (0, 0), []
    span = min(int(s.min()) for _, s in known), max(int(s.max()) for _, s in known)
    return span, [
        (shown(stream.name), strip(stamps, span, _gaps(stream, stamps))) for stream, stamps in known
    ]


def _gaps(stream: Stream, stamps_ns: NDArray[Any]) -> tuple[tuple[int, int], ...]:
    """The longest steps of the times that are drawn; none where only some of the messages were looked at."""
    looked = stream.times.looked if stream.times else None
    if looked is None or looked.seen != looked.of:
        return ()
    drawn = times_of(stamps_ns.tolist(), "log", looked)
    return drawn.gaps_ns if drawn else ()


def _stream(stream: Stream) -> dict[str, Any]:
    rows = rows_of(stream.facts)
    if stream.looked is not None:
        rows.insert(0, ("looked at", str(stream.looked)))
    rows += times_rows(stream.times) if stream.times is not None else []
    count = "" if stream.count is None else f", {stream.count:,}"
    words = f"{stream.type}{count}" + (f", {stream.encoding}" if stream.encoding else "")
    return {
        "name": shown(stream.name),
        "words": shown(words),
        "rows": rows,
        "notes": map(shown, stream.notes),
    }


def _unused(stream: Stream) -> tuple[str, str, str]:
    return shown(stream.name), shown(stream.type), "" if stream.count is None else f"{stream.count:,}"


def _roles(finding: Finding) -> list[tuple[str, str, str]] | None:
    roles = finding.roles
    if roles is None:
        return None
    chosen = {(role, topic.name) for role, (topic, _) in roles.chosen.items()}
    best = [(role, *roles.chosen[role]) for role in ORDER if role in roles.chosen]
    rows = [(role, shown(topic.name), shown(why)) for role, topic, why in best]
    rows += [(f"info of {role}", shown(topic.name), why) for role, (topic, why) in roles.infos.items()]
    rows += [("transforms", shown(topic.name), "") for topic in roles.transforms]
    for guess in roles.guesses:
        if guess.role not in ("info", "transforms") and (guess.role, guess.topic.name) not in chosen:
            rows.append((f"could be {guess.role}", shown(guess.topic.name), shown(guess.reason)))
    return rows


def _uri(data: bytes) -> str:
    kind = "png" if data[:4] == b"\x89PNG" else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
