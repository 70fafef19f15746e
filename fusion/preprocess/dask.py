"""Chunks done by Dask workers, on this machine or on many.

The work travels as one task whose result all chunks take as input: the scheduler can make it again when the
worker that holds it dies, which it could not with scattered data. What is handed to the scheduler are calls
of the standard library: it needs no fusion, and a worker that has none fails with a word instead of breaking
off. Workers store and commit chunks themselves; only a summary comes back. No more chunks are handed out than
there are threads: a long campaign costs the scheduler no memory, and a chunk that kills its worker brings no
other one, waiting there, into the suspicion that it did.
"""

from __future__ import annotations

import logging
import operator
import os
import pickle
import signal
import socket
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from itertools import islice
from queue import Empty, SimpleQueue
from typing import Any

from fusion.batch import opencv_on_one_thread
from fusion.chunks import Chunk, Work
from fusion.errors import FusionError, InputError, UsageError
from fusion.preprocess.local import Failed, Progress, Tally, attempt, failed, no_progress
from fusion.preprocess.records import Committed, owner_of
from fusion.storage import RunStorage, Storage

Say = Callable[[str], None] | None
Client = Any  # distributed's, whose types do not tell its blocking from its asynchronous use
Future = Any

GOES_ON = "the same command goes on where this one stopped"
DEADLY = "every worker that tried it died (out of memory? the worker's log says)"
LOOK_EVERY_S = 1.0  # how often the scheduler is looked after while no chunk ends
CONNECT_S = 30.0  # for a scheduler to answer
SOON_S = 5.0  # for the first worker to join before anything is said
COUNT_EVERY_S = 5.0  # how often the workers are counted
LOGGERS = ("distributed", "distributed.client", "tornado.application")


def run_dask(
    work: Work,
    out: RunStorage,
    todo: Sequence[Chunk],
    *,
    scheduler: str = "",
    workers: int = 1,
    wait_s: float = 600.0,
    progress: Progress = no_progress,
    say: Say = None,
) -> Iterator[Committed | Failed]:
    """Do the chunks `todo` by workers of `scheduler` (``tcp://…``), or of a cluster of `workers` processes
    here.

    What became of each chunk, as they end. The chunk of a worker that dies goes to another one; a chunk that
    takes several workers with it, at last when it alone is done, is failed. `wait_s` is how long to wait for
    the scheduler and its first worker; when all workers are gone later, `say` says so and the campaign waits
    for new ones. Raises `InputError` when the scheduler does not answer or is gone, `UsageError` when a
    worker has another fusion or none, when it sees another output, or when the extra is not installed.
    """
    with _quiet(), _connected(scheduler, workers, wait_s, say) as client:
        _refuse_other_versions(client)
        tally = Tally(work.chunks, todo, progress)
        hand = Hand(client, Handed(work, out, version("fusionprep")), say)
        suspects: list[Chunk] = []
        for chunk, future in hand.out(todo):
            outcome = _outcome(client, chunk, future)
            if outcome is None:
                suspects.append(chunk)
                continue
            tally.finish(chunk)
            yield outcome
        # A worker that died may have had other chunks waiting: who took it along shows when each is alone.
        for suspect in suspects:
            for chunk, future in hand.out([suspect]):
                outcome = _outcome(client, chunk, future) or Failed(chunk, DEADLY)
                tally.finish(chunk)
                yield outcome


@dataclass(frozen=True, slots=True)
class Handed:
    """What a worker gets once, and is called with the index of each chunk."""

    work: Work
    out: Storage
    version: str

    def __call__(self, position: int) -> Committed | Failed:
        self._check()
        chunk = self.work.chunks[position]
        with opencv_on_one_thread():
            outcome = attempt(self.work, chunk, self.out, lambda: None)
            if isinstance(outcome, Failed) and outcome.of_output:  # object stores have bad moments
                outcome = attempt(self.work, chunk, self.out, lambda: None)
        return outcome

    def _check(self) -> None:
        """Raises `UsageError` where this worker would do its chunks in vain."""
        host, here = socket.gethostname(), version("fusionprep")
        if here != self.version:
            raise UsageError(f"the worker on {host} has fusionprep {here}, the command {self.version}")
        try:
            owner = owner_of(self.out)
        except FusionError as error:
            raise UsageError(f"the worker on {host} cannot read the output: {error}") from None
        if owner != self.work.run_id:
            what = "is not the output that the command sees" if owner is None else "holds another run by now"
            hint = "a folder must be on a disk that all share; s3://bucket/run needs none"
            raise UsageError(f"{what}, says the worker on {host}", where=self.out.url, hint=hint)


# --- chunks out and back


class Hand:
    """Hands chunks out and takes back what became of them."""

    def __init__(self, client: Client, handed: Handed, say: Say) -> None:
        self._client = client
        self._position = {chunk.index: place for place, chunk in enumerate(handed.work.chunks)}
        self._shared = client.submit(pickle.loads, _pickled(handed), pure=False)
        self._room = Room(client, say)

    def out(self, todo: Sequence[Chunk]) -> Iterator[tuple[Chunk, Future]]:
        """Hand `todo` out in order; each with its future when that has ended in whatever way."""
        waiting, under_way, ended = iter(todo), dict[str, tuple[Chunk, Future]](), SimpleQueue[Any]()
        while True:
            for chunk in islice(waiting, max(0, self._room() - len(under_way))):
                place = self._position[chunk.index]
                future = self._client.submit(operator.call, self._shared, place, pure=False)
                under_way[future.key] = (chunk, future)
                future.add_done_callback(ended.put)
            if not under_way:
                return
            try:
                key = ended.get(timeout=LOOK_EVERY_S).key
            except Empty:
                if self._client.status != "running":
                    raise _gone(self._client) from None
                continue
            yield under_way.pop(key)


class Room:
    """How many chunks may be handed out at a time: it follows the workers as they come and go."""

    def __init__(self, client: Client, say: Say) -> None:
        self._client, self._say = client, say
        self._threads, self._counted_s, self._alone = 0, -COUNT_EVERY_S, False

    def __call__(self) -> int:
        now = time.monotonic()
        if now - self._counted_s >= COUNT_EVERY_S:
            self._counted_s = now
            try:
                self._threads = sum(self._client.nthreads().values())
            except Exception:
                raise _gone(self._client) from None
            if not self._threads and not self._alone:
                _tell(self._say, f"no worker is left at {_address(self._client)}: waiting for one to join")
            self._alone = not self._threads
        return max(1, self._threads)


def _outcome(client: Client, chunk: Chunk, future: Future) -> Committed | Failed | None:
    """What became of a chunk; None where the workers that had it died."""
    from distributed import CancelledError, KilledWorker

    try:
        return future.result()
    except CancelledError:
        raise _gone(client) from None
    except UsageError:
        raise
    except KilledWorker:
        return None
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] == "fusion":
            raise _without_fusion("a worker") from None
        return failed(chunk, error)
    except Exception as error:
        return failed(chunk, error)


def _pickled(handed: Handed) -> bytes:
    import cloudpickle  # for works that were defined in a script

    return cloudpickle.dumps(handed)


# --- cluster and scheduler


@contextmanager
def _connected(scheduler: str, workers: int, wait_s: float, say: Say) -> Iterator[Client]:
    """A client of a scheduler that has at least one worker."""
    with ExitStack() as stack:
        address = scheduler or stack.enter_context(_cluster(workers))
        client = _client_of(address, min(wait_s, CONNECT_S))
        stack.callback(client.close, timeout=2)
        _wait_for_a_worker(client, wait_s, say)
        yield client


def _wait_for_a_worker(client: Client, wait_s: float, say: Say) -> None:
    """Machines of a queue may come hours later; who forgot to start them is told so at once."""
    hint = f"start some: dask worker {_address(client)}"
    soon_s = min(wait_s, SOON_S)
    try:
        client.wait_for_workers(1, timeout=soon_s)
    except TimeoutError:
        if wait_s > soon_s:
            _tell(say, f"no worker yet at {_address(client)}: waiting for one ({hint})")
    else:
        return
    try:
        client.wait_for_workers(1, timeout=max(wait_s - soon_s, 0.01))
    except TimeoutError:
        raise InputError(f"has no worker after {wait_s:g} s", where=_address(client), hint=hint) from None


def _cluster(workers: int) -> Any:
    try:
        return _distributed().LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,
            preload=[__name__],
            silence_logs=False if _debugging() else logging.CRITICAL,
        )
    except (OSError, RuntimeError) as error:
        raise InputError(
            f"no cluster could be started here: {error}", hint="FUSION_DEBUG=1 shows more"
        ) from error


def dask_setup(worker: object) -> None:  # noqa: ARG001 - Dask calls it in each worker process that it starts
    """Ctrl-C in the terminal reaches all its processes: the command ends the workers, in order."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _client_of(address: Any, wait_s: float) -> Client:
    distributed = _distributed()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of other versions; those that matter are refused below
            return distributed.Client(address, timeout=wait_s, set_as_default=False)
    except (OSError, ValueError, TypeError, ImportError) as error:
        what = " ".join(str(error).split())[:200]
        hint = "start it with: dask scheduler"
        raise InputError(f"no scheduler answers: {what}", where=address, hint=hint) from None


def _refuse_other_versions(client: Client) -> None:
    """All must speak the same Dask, and workers have the fusion that the command has."""
    found = client.get_versions(check=False)
    own = found["client"]["packages"]["distributed"]
    others = {_address(client): found["scheduler"], **found["workers"]}
    for address, facts in others.items():
        theirs = facts["packages"]["distributed"]
        if theirs != own:
            what = f"has distributed {theirs}, the command {own}"
            raise UsageError(what, where=address, hint="install the same on all machines")
    own = version("fusionprep")
    for address, theirs in client.run(version, "fusionprep", on_error="return").items():
        if isinstance(theirs, Exception):
            raise _without_fusion(address)
        if theirs != own:
            what = f"has fusionprep {theirs}, the command {own}"
            raise UsageError(what, where=address, hint="install the same on all machines")


def _tell(say: Say, words: str) -> None:
    if say is not None:
        say(words)


def _without_fusion(who: str) -> UsageError:
    return UsageError(f"{who} has no fusion", hint="pip install 'fusionprep[dask]' where workers run")


def _gone(client: Client) -> InputError:
    return InputError(f"the scheduler at {_address(client)} is gone", hint=GOES_ON)


def _address(client: Client) -> str:
    return client.scheduler.address if client.scheduler else "?"


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        hint = "pip install 'fusionprep[dask]'"
        raise UsageError(f"Dask is not installed: {error}", hint=hint) from None
    return distributed


def _debugging() -> bool:
    return bool(os.environ.get("FUSION_DEBUG"))


@contextmanager
def _quiet() -> Iterator[None]:
    """Dask's own log would bury ours; with FUSION_DEBUG it is heard."""
    _distributed()
    if _debugging():
        yield
        return
    loggers = [logging.getLogger(name) for name in LOGGERS]
    before = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.CRITICAL + 1)
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)
