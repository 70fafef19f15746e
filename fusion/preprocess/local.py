"""Chunks done by threads of this process: in order, at most one a worker under way.

Threads, as in `fusion.batch` and for its reasons. What all executors share is here too: what a failed chunk
is, and the count of frames that progress tells.
"""

from __future__ import annotations

import os
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice

from fusion.batch import opencv_on_one_thread
from fusion.chunks import Chunk, Work
from fusion.errors import FusionError, OutputError
from fusion.preprocess.records import Committed, do_chunk
from fusion.storage import Storage

LOOK_EVERY_S = 0.1  # how often progress is told while chunks are under way
Progress = Callable[[int, int, int, int], None]  # frames done, of all; chunks done, of all


def no_progress(frames_done: int, frames: int, chunks_done: int, chunks: int) -> None:
    """Says nothing."""


@dataclass(frozen=True, slots=True)
class Failed:
    """A chunk that could not be done, and why, in one line. The rest of the campaign goes on.

    `of_output` where it could not be stored: then other chunks will fail in the same way. `trace` is there
    only with ``FUSION_DEBUG``.
    """

    chunk: Chunk
    reason: str
    of_output: bool = False
    trace: str = ""


class Stopped(BaseException):
    """Raised by `tick` inside a chunk when the run is given up: not to be taken for a fault of its frame."""


def attempt(work: Work, chunk: Chunk, out: Storage, tick: Callable[[], None]) -> Committed | Failed:
    """Do a chunk and commit it; an error is the chunk's, not the campaign's."""
    try:
        return do_chunk(work, chunk, out, tick)
    except Exception as error:
        return failed(chunk, error)


def failed(chunk: Chunk, error: BaseException) -> Failed:
    """What `error` made of a chunk. What is not a `FusionError` is a fault of ours, and says so."""
    of_output = isinstance(error, OutputError)
    trace = "".join(traceback.format_exception(error)) if os.environ.get("FUSION_DEBUG") else ""
    if isinstance(error, FusionError):
        return Failed(chunk, str(error), of_output, trace)
    what = " ".join(f"{type(error).__name__}: {error}".split())
    return Failed(chunk, f"a fault of fusion's own: {what}", of_output, trace)


class Tally:
    """Frames and chunks done, for progress: whole chunks as the plan counts them, others by their ticks."""

    def __init__(self, chunks: Sequence[Chunk], todo: Sequence[Chunk], progress: Progress) -> None:
        self._progress = progress
        self._frames, self._chunks = sum(chunk.frames for chunk in chunks), len(chunks)
        self._frames_done = self._frames - sum(chunk.frames for chunk in todo)
        self._chunks_done = self._chunks - len(todo)
        self._ticks: dict[int, int] = {}
        self._told = (-1, -1)
        self._stopped = threading.Event()
        self.tell()

    def of(self, chunk: Chunk) -> Callable[[], None]:
        """The chunk's own tick."""

        def tick() -> None:
            if self._stopped.is_set():
                raise Stopped
            self._ticks[chunk.index] = min(self._ticks.get(chunk.index, 0) + 1, chunk.frames)

        return tick

    def stop(self) -> None:
        """From now on every tick raises `Stopped`."""
        self._stopped.set()

    def finish(self, chunk: Chunk) -> None:
        """The chunk is dealt with."""
        self._ticks.pop(chunk.index, None)
        self._frames_done += chunk.frames
        self._chunks_done += 1
        self.tell()

    def tell(self) -> None:
        """Tell progress, if there is any. From one thread."""
        now = (self._frames_done + sum(list(self._ticks.values())), self._chunks_done)
        if now != self._told:
            self._told = now
            self._progress(now[0], self._frames, now[1], self._chunks)


def run_local(
    work: Work,
    out: Storage,
    todo: Sequence[Chunk],
    workers: int = 1,
    progress: Progress = no_progress,
) -> Iterator[Committed | Failed]:
    """Do the chunks `todo`; what became of each, as they end.

    When the caller stops (or Ctrl-C does), chunks under way are given up at their next frame; what is
    committed stays. `progress` is called from this thread.
    """
    if workers < 1:
        raise ValueError(f"workers must be at least 1, not {workers}")
    tally = Tally(work.chunks, todo, progress)
    waiting = iter(todo)
    with opencv_on_one_thread(), _pool(workers, tally) as pool:

        def start(count: int) -> dict[Future[Committed | Failed], Chunk]:
            some = islice(waiting, count)
            return {pool.submit(attempt, work, chunk, out, tally.of(chunk)): chunk for chunk in some}

        under_way = start(workers)
        while under_way:
            ended, _ = wait(under_way, LOOK_EVERY_S, FIRST_COMPLETED)
            chunks = [under_way.pop(future) for future in ended]
            under_way.update(start(len(ended)))
            for chunk in chunks:
                tally.finish(chunk)
            tally.tell()
            yield from sorted((future.result() for future in ended), key=lambda one: one.chunk.index)


@contextmanager
def _pool(workers: int, tally: Tally) -> Iterator[ThreadPoolExecutor]:
    pool = ThreadPoolExecutor(workers, thread_name_prefix="chunk")
    try:
        yield pool
    finally:
        tally.stop()
        pool.shutdown(wait=True, cancel_futures=True)
