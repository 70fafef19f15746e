"""What was measured beside what was wanted, as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from timing import Sample


@dataclass(frozen=True, slots=True)
class Target:
    """A bound on a ratio: at most or at least `value`."""

    at_most: bool
    value: float
    unit: str = "x"

    def __str__(self) -> str:
        return f"{'≤' if self.at_most else '≥'} {self.value:.3g}{self.unit}"

    def met(self, value: float) -> bool:
        return value <= self.value if self.at_most else value >= self.value


def at_most(value: float, unit: str = "x") -> Target:
    return Target(True, value, unit)


def at_least(value: float, unit: str = "x") -> Target:
    return Target(False, value, unit)


@dataclass(frozen=True, slots=True)
class Row:
    """One figure. Without a `target` it is there for information, without `ratio` `note` says why."""

    what: str
    ours: str
    other: str = ""
    ratio: Sample | None = None
    target: Target | None = None
    note: str = ""

    @property
    def missed(self) -> bool:
        return self.target is not None and self.ratio is not None and not self.target.met(self.ratio.median)

    @property
    def verdict(self) -> str:
        if self.ratio is None:
            return self.note
        if self.target is None:
            return self.note or "for information"
        return "**missed**" if self.missed else "met"

    def cells(self) -> tuple[str, ...]:
        ratio = "" if self.ratio is None else spread(self.ratio, self.target.unit if self.target else "x")
        return self.what, self.ours, self.other, ratio, str(self.target or ""), self.verdict


@dataclass(slots=True)
class Section:
    """A heading, a few words of method, and rows under named columns."""

    title: str
    text: str
    columns: tuple[str, str] = ("ours", "other")
    rows: list[Row] = field(default_factory=list)

    def markdown(self) -> str:
        head = ("what", *self.columns, "ratio (quartiles)", "target", "")
        return f"## {self.title}\n\n{self.text}\n\n{grid(head, (row.cells() for row in self.rows))}"


def grid(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    table = [head, ["---"] * len(head), *lines]
    return "\n".join("| " + " | ".join(cell or " " for cell in line) + " |" for line in table)


def summary(sections: Iterable[Section]) -> str:
    """How many targets are met, and every missed one by its name."""
    rows = [(section, row) for section in sections for row in section.rows if row.target is not None]
    judged = [(section, row) for section, row in rows if row.ratio is not None]
    missed = [
        f"- missed: {section.title}: {row.what}: {row.cells()[3]}, wanted {row.target}"
        for section, row in judged
        if row.missed
    ]
    silent = [
        f"- not measured: {section.title}: {row.what}: {row.note}"
        for section, row in rows
        if row.ratio is None
    ]
    head = f"{len(judged) - len(missed)} of {len(rows)} targets met."
    return "\n".join([head, *([""] if missed or silent else []), *missed, *silent])


def spread(sample: Sample, unit: str = "x") -> str:
    low, high = sample.quartiles
    return f"{sample.median:.3g}{unit} ({low:.3g}–{high:.3g})"


def milliseconds(seconds: Sample) -> str:
    low, high = (1e3 * value for value in seconds.quartiles)
    return f"{1e3 * seconds.median:.3g} ms ({low:.3g}–{high:.3g})"


def per_second(rate: Sample) -> str:
    low, high = rate.quartiles
    return f"{rate.median:.3g} frames/s ({low:.3g}–{high:.3g})"
