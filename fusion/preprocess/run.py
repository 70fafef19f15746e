"""A whole campaign: refuse what must not be mixed, do the chunks, put the index and the outputs together."""

from __future__ import annotations

import csv
import io
import tomllib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import tomlkit

from fusion.errors import OutputError
from fusion.preprocess.campaign import Report, Route, run_campaign
from fusion.preprocess.local import Progress, no_progress
from fusion.preprocess.records import rows_of
from fusion.preprocess.rows import FrameRow
from fusion.preprocess.work import FAULT, PreprocessWork
from fusion.sinks.index import columns_of
from fusion.sinks.run_folder import first_difference
from fusion.storage import RunStorage, open_storage

INDEX, LOST, RUN = "frames.csv", "lost.csv", "run.toml"
JOINED = ("fused.mcap", "fused.mp4")


@dataclass(frozen=True, slots=True)
class Result:
    """What became of a campaign; `products` are the outputs' names for people, `url` is where they are."""

    url: str
    report: Report
    products: Sequence[str]
    skipped: Sequence[tuple[str, str]]
    made: int
    troubled: int


def preprocess(
    work: PreprocessWork,
    out: str,
    *,
    route: Route | None = None,
    overwrite: bool = False,
    progress: Progress = no_progress,
    say: Callable[[str], None] | None = None,
) -> Result:
    """Do `work` into `out` (a folder or an fsspec URL); what is done already is kept.

    Raises `OutputError` where another run's frames are there, and what `run_campaign` raises; what became of
    chunks that failed is in the report.
    """
    store = open_storage(out)
    if not overwrite:
        _refuse_another_run(store, work)
    tally = _Tally()

    def closing_up(store: RunStorage, report: Report) -> None:
        if report.whole:
            store.write(INDEX, tally.index(rows_of(store, work, report.whole)))
            store.write(LOST, _lost_csv(report))
        if tally.made:
            whole = [chunk for chunk in work.chunks if chunk.index in report.whole]
            for output in work.parts()[1]:
                tally.products += output.finish(whole, store)

    def opening(store: RunStorage) -> None:
        if overwrite:  # the records are gone, and what they named; this is what no record names
            for name in (INDEX, LOST, *JOINED, *store.names("parts")):
                store.remove(name)
        store.write(RUN, tomlkit.dumps(work.description).encode())

    report = run_campaign(
        work,
        store,
        route=route or Route(),
        overwrite=overwrite,
        progress=progress,
        say=say,
        opening=opening,
        closing_up=closing_up,
    )
    return Result(store.url, report, tally.products, tally.skipped, tally.made, tally.troubled)


class _Tally:
    """Counts the rows of the index while it is written."""

    def __init__(self) -> None:
        self.made = self.troubled = 0
        self.skipped: list[tuple[str, str]] = []
        self.products: list[str] = []

    def index(self, rows: Iterable[Sequence[str]]) -> bytes:
        """`frames.csv`. Raises `OutputError` where two frames bear one name: one overwrote the other."""
        columns = columns_of(FrameRow)
        status, reason = columns.index("status"), columns.index("reason")
        text, seen = io.StringIO(), set[str]()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(columns)
        for row in rows:
            if row[0] in seen:
                hint = "stamps repeat; --stamp log names frames by the time they were recorded at"
                raise OutputError(f"two frames are called {row[0]}", where=INDEX, hint=hint)
            seen.add(row[0])
            writer.writerow(row)
            if row[status] == "made":
                self.made += 1
                self.troubled += bool(row[reason])
            else:
                self.skipped.append((row[0], row[reason]))
        return text.getvalue().encode("utf-8", "surrogateescape")


def _lost_csv(report: Report) -> bytes:
    """What belongs to no frame: role, reason, count."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("role", "reason", "count"))
    counted = sorted((key, count) for key, count in report.lost.items() if not key.startswith(FAULT))
    writer.writerows((*key.partition(": ")[::2], count) for key, count in counted)
    return text.getvalue().encode("utf-8", "surrogateescape")


def _refuse_another_run(store: RunStorage, work: PreprocessWork) -> None:
    hint = "choose another -o, or pass --overwrite to replace that run's frames"
    if store.size(RUN) is None:
        if store.size(INDEX) is not None:
            what = "holds frames, but no run.toml that says whose they are"
            raise OutputError(what, where=store.url, hint=hint)
        return
    try:
        before = tomllib.loads(store.read(RUN).decode())
    except (ValueError, RecursionError) as error:
        raise OutputError(f"its run.toml cannot be read: {error}", where=store.url, hint=hint) from None
    difference = first_difference(before, work.description)
    if difference:
        raise OutputError(f"holds another run ({difference})", where=store.url, hint=hint)
