"""Does a whole sequence into a sink: in order, resumable, with several threads.

The work is decoding, a few kernels and encoding. All but fpng release the interpreter lock while they
work, so threads scale until its share, about a fifth of a PNG frame, is all that is left. OpenCV's own pool
is held to one thread meanwhile, because pools that fight cost more than they give. At most a few frames
are in flight, so memory does not grow with the sequence.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol, TypeVar

import cv2

from fusion.errors import FrameError, InputError
from fusion.sinks.index import IndexRow, Row

if TYPE_CHECKING:
    from fusion.frames import FusedFrame
    from fusion.pipeline import Fuser

IN_FLIGHT_PER_WORKER = 3
T = TypeVar("T")
RowT = TypeVar("RowT", bound=IndexRow)
MadeT = TypeVar("MadeT", bound=IndexRow, covariant=True)


@dataclass(slots=True)
class RunReport:
    """What a run did. Shares are [0, 1], means over the fused frames, kept ones included."""

    pairs: int = 0
    fused: int = 0
    kept: int = 0
    skipped: list[tuple[str, str]] = field(default_factory=list)
    flags: Counter[str] = field(default_factory=Counter)
    clipped_below: float = 0.0
    clipped_above: float = 0.0
    window_lo: tuple[float, float] | None = None
    window_hi: tuple[float, float] | None = None

    def add(self, row: Row, kept: bool) -> None:
        if not row.done:
            self.skipped.append((row.stem, row.reason))
            return
        self.fused += not kept
        self.kept += kept
        done = self.fused + self.kept
        self.flags.update(flag for flag in row.flags.split(";") if flag)
        self.clipped_below += (float(row.clipped_below) - self.clipped_below) / done
        self.clipped_above += (float(row.clipped_above) - self.clipped_above) / done
        self.window_lo = _widened(self.window_lo, float(row.window_lo))
        self.window_hi = _widened(self.window_hi, float(row.window_hi))


def no_progress(done: int, total: int) -> None:
    """Says nothing."""


class Job(Protocol[MadeT]):
    """A sequence of frames, each made and stored on its own, by any thread."""

    strict: bool

    def __len__(self) -> int: ...

    def stem(self, index: int) -> str: ...

    def changed_ns(self, index: int) -> int:
        """When the inputs of a frame were last written."""
        ...

    def make(self, index: int) -> MadeT:
        """Make and store a frame; its row of the index. Raises `FrameError` where it cannot be used."""
        ...

    def skip(self, index: int, error: FrameError) -> MadeT:
        """The row of a frame that cannot be used."""
        ...


class Sink(Protocol[RowT]):
    """Where a job's frames go; see `fusion.sinks.run_folder.RunFolder`."""

    def expect(self, stems: Iterable[str]) -> None:
        """Refuse names that this sink cannot keep apart. Raises `OutputError`."""
        ...

    def finished(self, stem: str, changed_ns: int) -> RowT | None:
        """The row of a frame that is there already and no older than `changed_ns`, else None."""
        ...

    def record(self, row: RowT) -> None:
        """Enter a row, of a frame stored or skipped, into the index. In order, from one thread."""
        ...


def rows_of(job: Job[RowT], sink: Sink[RowT], workers: int = 1) -> Iterator[tuple[RowT, bool]]:
    """Do a job into an open sink: the row of every frame, in order, and whether it was there already.

    A frame that cannot be used is skipped, with its reason in its row, or raised when the job is strict.
    Raises `OutputError` when the sink cannot be written.
    """
    sink.expect(job.stem(index) for index in range(len(job)))

    def work(index: int) -> tuple[RowT, bool]:
        row = sink.finished(job.stem(index), job.changed_ns(index))
        if row is not None:
            return row, True
        try:
            return job.make(index), False
        except FrameError as error:
            if job.strict:
                raise
            return job.skip(index, error), False

    with opencv_on_one_thread():
        for row, kept in in_order(work, len(job), workers):
            sink.record(row)
            yield row, kept


class FusedSink(Sink[Row], Protocol):
    """A sink of fused frames; `write` may be called from several threads."""

    def write(self, frame: FusedFrame, fir_stem: str) -> Row:
        """Store one frame and return its row of the index. Raises `OutputError`."""
        ...


class FuseJob:
    """The pairs of a `Fuser` into a folder of fused frames."""

    def __init__(self, fuser: Fuser, sink: FusedSink) -> None:
        self.fuser, self.sink, self.strict = fuser, sink, fuser.config.strict

    def __len__(self) -> int:
        return len(self.fuser)

    def stem(self, index: int) -> str:
        return self.fuser.pairs.stems(index)[0]

    def changed_ns(self, index: int) -> int:
        return self.fuser.pairs.changed_ns(index)

    def make(self, index: int) -> Row:
        return self.sink.write(self.fuser.fuse(index), self.fuser.pairs.stems(index)[1])

    def skip(self, index: int, error: FrameError) -> Row:
        return Row.skipped(*self.fuser.pairs.stems(index), error)


def run(
    fuser: Fuser,
    sink: FusedSink,
    *,
    workers: int = 1,
    progress: Callable[[int, int], None] = no_progress,
) -> RunReport:
    """Fuse every pair of `fuser` into the open `sink`; frames that are there already are kept.

    A frame that cannot be used is skipped and counted, or raised when the configuration is strict.
    `progress(done, total)` is called in order, from this thread. Raises `InputError` when no frame at
    all could be fused, `OutputError` when the sink cannot be written.
    """
    report = RunReport(pairs=len(fuser))
    for done, (row, kept) in enumerate(rows_of(FuseJob(fuser, sink), sink, workers), start=1):
        report.add(row, kept)
        progress(done, len(fuser))
    if report.fused + report.kept == 0:
        stem, reason = report.skipped[0]
        raise InputError(f"no frame could be fused; the first, {stem!r}: {reason}")
    return report


def in_order(work: Callable[[int], T], count: int, workers: int) -> Iterator[T]:
    """`work(0), work(1), …` by `workers` threads, at most a few ahead of what has been taken."""
    if workers == 1:
        yield from map(work, range(count))
        return
    pool = ThreadPoolExecutor(workers, thread_name_prefix="fuse")
    try:
        pending: deque[Future[T]] = deque()
        for index in range(count):
            pending.append(pool.submit(work, index))
            if len(pending) >= workers * IN_FLIGHT_PER_WORKER:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def opencv_on_one_thread() -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _widened(span: tuple[float, float] | None, value: float) -> tuple[float, float]:
    return (value, value) if span is None else (min(span[0], value), max(span[1], value))
