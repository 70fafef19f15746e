"""A campaign: what is done is kept, an executor does the rest, a report says what became of it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field

from fusion.chunks import Chunk, Work
from fusion.errors import FusionError, InputError, OutputError, UsageError
from fusion.preprocess.local import Failed, Progress, no_progress, run_local
from fusion.preprocess.records import Committed, claim, discard, finished
from fusion.storage import RunStorage, open_storage

GOES_ON = "the same command goes on where this one stopped"
# So many chunks in a row that could not be stored, and not one that could: the store is at fault, no chunk.
UNSTORED_IN_A_ROW = 10


@dataclass(frozen=True, slots=True)
class Route:
    """Who does the chunks: threads of this process, a Dask cluster made here, or a scheduler that is there.

    `workers` are threads, or processes of the cluster made here; a scheduler has its own. `wait_s` is how
    long to wait for the scheduler and its first worker.
    """

    workers: int = 1
    cluster: bool = False
    scheduler: str = ""
    wait_s: float = 600.0

    def __post_init__(self) -> None:
        if self.cluster and self.scheduler:
            raise UsageError("a cluster made here and a scheduler exclude each other", hint="name one")
        if self.workers < 1:
            raise UsageError(f"--workers must be at least 1, not {self.workers}")


@dataclass(slots=True)
class Report:
    """What became of a campaign. Sums are over all chunks that are done, kept ones of earlier runs included.

    `again` counts records that did not count, by reason; `lost` what belongs to no frame, by role and reason;
    `seconds` is this run's time.
    """

    chunks: int = 0
    kept: int = 0
    done: int = 0
    rows: int = 0
    size_bytes: int = 0
    seconds: float = 0.0
    frames_made: int = 0
    lost: Counter[str] = field(default_factory=Counter)
    again: Mapping[str, int] = field(default_factory=dict)
    failed: list[Failed] = field(default_factory=list)
    whole: set[int] = field(default_factory=set)

    def keep(self, chunk: Committed) -> None:
        self.kept += 1
        self._count(chunk)

    def add(self, outcome: Committed | Failed) -> None:
        if isinstance(outcome, Failed):
            self.failed.append(outcome)
            return
        self.done += 1
        self.frames_made += outcome.rows
        self._count(outcome)

    def _count(self, chunk: Committed) -> None:
        self.rows += chunk.rows
        self.size_bytes += chunk.size_bytes
        self.lost.update(chunk.lost)
        self.whole.add(chunk.chunk.index)

    @property
    def frames_per_s(self) -> float:
        """Of this run alone."""
        return self.frames_made / self.seconds if self.seconds > 0 else 0.0

    def problem(self) -> FusionError | None:
        """What a command must end with though it did all it could: chunks failed, or nothing came out."""
        if self.failed:
            first = min(self.failed, key=lambda one: one.chunk.index)
            what = f"{len(self.failed)} of {self.chunks} chunks failed; the first, {first.chunk.name}: "
            return FusionError(what + first.reason, hint="the same command tries them again, and only them")
        if not self.rows:
            reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(self.lost.items()))
            return InputError(f"no frame could be made: {reasons or 'the input has none'}")
        return None


def run_campaign(
    work: Work,
    out: str | RunStorage,
    *,
    route: Route = Route(),
    overwrite: bool = False,
    progress: Progress = no_progress,
    say: Callable[[str], None] | None = None,
    opening: Callable[[RunStorage], None] | None = None,
    closing_up: Callable[[RunStorage, Report], None] | None = None,
) -> Report:
    """Do all chunks of `work` that `out` does not hold yet; failed ones are in the report and raise nothing.

    `progress(frames done, of all, chunks done, of all)` and `say(words)`, for what a user should know
    meanwhile, are called from this thread. `opening` is called before the first and `closing_up` after the
    last chunk, while other runs are kept out: the place to say what the run is, and to put indexes together.
    `overwrite` first removes the chunks of whatever run is there. Raises `OutputError` when another run's
    chunks are there, another run is under way, or nothing can be stored; `InputError` when the scheduler is
    gone or has no workers; `UsageError` for what cannot work.
    """
    store = open_storage(out) if isinstance(out, str) else out
    begun = time.monotonic()
    with store.lock():
        if overwrite:
            discard(store)
        claim(store, work.run_id)
        store.clean()
        if opening is not None:
            opening(store)
        there = finished(store, work)
        report = Report(chunks=len(work.chunks), again=there.again)
        for chunk in there.done.values():
            report.keep(chunk)
        todo = [chunk for chunk in work.chunks if chunk.index not in there.done]
        with closing(_outcomes(work, store, todo, route, progress, say)) as outcomes:
            _gather(outcomes, report)
        report.seconds = time.monotonic() - begun
        if closing_up is not None:
            closing_up(store, report)
    return report


def _gather(outcomes: Iterator[Committed | Failed], report: Report) -> None:
    unstored = 0
    for outcome in outcomes:
        report.add(outcome)
        unstored = unstored + 1 if isinstance(outcome, Failed) and outcome.of_output else 0
        if unstored >= UNSTORED_IN_A_ROW and isinstance(outcome, Failed):
            what = f"{unstored} chunks in a row could not be stored: {outcome.reason}"
            raise OutputError(what, hint=GOES_ON)


def _outcomes(
    work: Work,
    out: RunStorage,
    todo: Sequence[Chunk],
    route: Route,
    progress: Progress,
    say: Callable[[str], None] | None,
) -> Generator[Committed | Failed]:
    if not (route.cluster or route.scheduler) or not todo:  # a campaign that is done needs no cluster
        yield from run_local(work, out, todo, route.workers, progress)
        return
    from fusion.preprocess.dask import run_dask  # here: the extra may not be installed

    if not out.shared:
        hint = "choose a folder on a shared disk, or an object store such as s3://bucket/run"
        raise UsageError("is this process's own memory: no worker can write there", where=out.url, hint=hint)
    yield from run_dask(
        work,
        out,
        todo,
        scheduler=route.scheduler,
        workers=route.workers,
        wait_s=route.wait_s,
        progress=progress,
        say=say,
    )


class Pace:
    """Rate and time left from what progress tells; what was done before the first call counts for neither."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._start: tuple[float, int] | None = None

    def __call__(self, frames_done: int, frames: int) -> tuple[float, float | None]:
        """Frames per second, and the seconds left; None while nobody can tell."""
        now = self._clock()
        if self._start is None:
            self._start = (now, frames_done)
        seconds, made = now - self._start[0], frames_done - self._start[1]
        rate = made / seconds if seconds > 0 else 0.0
        return rate, (frames - frames_done) / rate if rate > 0 else None
