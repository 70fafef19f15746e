"""The report: one self-contained HTML page with the verdict, the tables and the pictures."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined

from calib.evidence.verdict import Evidence
from calib.report.text import camera_rows, offset_rows, pair_rows
from calib.solve.estimate import Solution

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{{ title }}</title>
<style>
body { font: 15px/1.5 sans-serif; max-width: 1180px; margin: 2em auto; padding: 0 1em; color: #222 }
table { border-collapse: collapse; margin: 1em 0 }
td, th { border: 1px solid #ccc; padding: .25em .6em; text-align: left }
img { max-width: 100%; margin: .4em 0 }
.good { color: #176117 } .usable { color: #8a5a00 } .not { color: #a01010 }
figure { margin: 1.2em 0 } figcaption { color: #555 }
</style></head><body>
<h1>{{ title }}</h1>
<h2 class="{{ grade.split(' ')[0] }}">{{ grade }}</h2>
<ul>
{% for line in good_for %}<li class="good">good for {{ line }}</li>
{% endfor %}{% for line in not_for %}<li class="not">not for {{ line }}</li>
{% endfor %}{% for line in record_next %}<li>next: {{ line }}</li>
{% endfor %}</ul>
{% for heading, head, rows in tables %}<h2>{{ heading }}</h2>
<table><tr>{% for cell in head %}<th>{{ cell }}</th>{% endfor %}</tr>
{% for row in rows %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</table>
{% endfor %}
{% for caption, data in pictures %}<figure>
<img alt="{{ caption }}" src="data:image/{{ kind(data) }};base64,{{ b64(data) }}">
<figcaption>{{ caption }}</figcaption></figure>
{% endfor %}
</body></html>
"""


def page(
    title: str,
    solution: Solution,
    evidence: Evidence,
    pictures: Sequence[tuple[str, bytes]],
    left_out: Sequence[tuple[str, str]] = (),
) -> bytes:
    """The page as bytes. `pictures` are captions with PNG or JPEG bytes; `left_out` more (name, reason)
    than the solution's own."""
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    environment.globals.update(b64=_base64, kind=_kind)
    verdict = evidence.verdict
    tables = [
        ("Cameras", *camera_rows(solution, evidence)),
        ("Sensors to each other", *pair_rows(solution, evidence)),
        ("Parameters", *_parameters(solution)),
    ]
    if solution.estimate.time_offset_s:
        tables.append(("Clocks", *offset_rows(solution)))
    lost = [*left_out, *solution.dropped_views]
    if lost:
        tables.append(("Left out", ("what", "why"), [list(row) for row in lost]))
    return (
        environment.from_string(_PAGE)
        .render(
            title=title,
            grade=verdict.grade,
            good_for=verdict.good_for,
            not_for=verdict.not_for,
            record_next=verdict.record_next,
            tables=tables,
            pictures=pictures,
        )
        .encode()
    )


def _parameters(solution: Solution) -> tuple[Sequence[str], list[list[Any]]]:
    sigma = np.sqrt(np.diag(solution.covariance))
    return ("parameter", "standard deviation"), [
        [name, f"{s:.3g} {_unit(name)}"] for name, s in zip(solution.names, sigma, strict=True)
    ]


def _unit(name: str) -> str:
    part = name.rpartition(".")[2]
    if part in ("fx", "fy", "cx", "cy"):
        return "px"
    if part == "time_offset_s":
        return "s"
    return {"r": "rad", "t": "m"}.get(part[0], "")


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


def _kind(data: bytes) -> str:
    return "png" if data[:4] == b"\x89PNG" else "jpeg"
