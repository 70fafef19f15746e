"""Processes that read input after input, watched: time, memory, exceptions, crashes, files left behind."""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import pickle
import pkgutil
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from random import Random
from typing import NamedTuple

import psutil
from fuzz_mutate import mutated, png_repaired
from fuzz_readers import READERS, Reader
from fuzz_seeds import TEXTS, Seed, Seeds

from fusion.errors import FusionError

CPU_LIMIT_S = 5.0  # of an input
WALL_LIMIT_S = 90.0  # of an input that sleeps instead; the machine may be busy
SPARE_MIB = 1024  # of addresses above a reader's bound: a larger request fails, and is found
MOST_WORDS = 2000  # letters of a refusal: more is no clear line
FRESH_AFTER = 1500  # inputs of one process
_BATCH = 50
_MIB = 1 << 20


class Outcome(NamedTuple):
    """`kind` is ``read``, ``refused`` or a finding: ``error``, ``hang``, ``memory``, ``crash``, ``unclear``,
    ``left behind``. `mib` is how far memory grew, `said` the last words; cases below 0 are sound seeds.
    """

    reader: str
    case: int
    kind: str
    seconds: float = 0.0
    mib: float = 0.0
    said: str = ""


class TooLongError(BaseException):
    """Raised by the clock inside a reader that takes too long."""


@dataclass(frozen=True, slots=True)
class Task:
    """What every worker is told. `readers` are names of `READERS`, or "module:attribute" of others.

    Seeds come in a file: `multiprocessing` waits for ever for a child that dies before it has read its data.
    """

    number: int
    readers: Mapping[str, str]
    seeds_file: Path
    cpu_limit_s: float = CPU_LIMIT_S
    path: Sequence[str] = field(default_factory=lambda: tuple(sys.path))

    def reader(self, name: str) -> Reader:
        target = self.readers[name]
        return READERS[name] if not target else pkgutil.resolve_name(target)


def input_of(reader: Reader, seeds: Seeds, number: int, case: int) -> Seed:
    """The input `case` of a reader under the seed `number`; below 0 the seeds themselves, unharmed."""
    group = seeds.get(reader.seeds, [])
    if case < 0:
        return group[-1 - case]
    rng = Random(f"{number}:{reader.name}:{case}")
    seed = rng.choice(group) if group else Seed("", {})
    if reader.make is not None and rng.random() < reader.made:
        return reader.make(rng, seed)
    name = rng.choice(seed.damaged or sorted(seed.files))
    other = rng.choice(sorted(rng.choice(group).files.items()))[1]
    text = name.endswith(TEXTS) and b"\0" not in seed.files[name]
    data = mutated(seed.files[name], rng, [other], text)
    if rng.random() < 0.5:
        data = png_repaired(data)
    return Seed(seed.name, {**seed.files, name: data}, seed.main, about=seed.about)


def lay_out(seed: Seed, folder: Path) -> Path:
    for name, data in seed.files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder / seed.main


# -- in a worker


class _Worker:
    def __init__(self, task: Task, root: Path) -> None:
        self._task, self._root = task, root
        self._seeds: Seeds = pickle.loads(task.seeds_file.read_bytes())
        self._fired = False
        self._idle_mib = 0.0
        self._warm: set[str] = set()
        (root / "tmp").mkdir()
        signal.signal(signal.SIGPROF, self._clock)

    def _clock(self, *_: object) -> None:
        self._fired = True
        raise TooLongError

    def warm_up(self, name: str) -> list[Outcome]:
        """Every seed unharmed: imports and compilers have run, and what cannot be read at all is said."""
        reader = self._task.reader(name)
        if name in self._warm:
            return []
        self._warm.add(name)
        count = len(self._seeds.get(reader.seeds, []))
        found = [self.run(reader, -1 - k, limited=False) for k in range(count)]
        _read_status()  # the first call must not count as growth
        self._idle_mib = _read_status()["VmRSS"]
        return found

    def run(self, reader: Reader, case: int, limited: bool = True) -> Outcome:
        folder = self._root / "case"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        seed = input_of(reader, self._seeds, self._task.number, case)
        path = lay_out(seed, folder)
        began = time.process_time()
        with _bounded(reader.bound_mib + SPARE_MIB if limited else None):
            _forget_peak()
            kind, said = self._outcome(lambda: reader.read(path, seed), limited)
        seconds = time.process_time() - began
        mib = max(0.0, _read_status()["VmHWM"] - self._idle_mib) if limited else 0.0
        if limited and (self._fired or seconds > self._task.cpu_limit_s):
            kind, said = "hang", said or f"{seconds:.1f} s"
        elif limited and mib > reader.bound_mib:
            kind, said = "memory", said or f"{mib:.0f} MiB"
        elif left := self._left():
            kind, said = "left behind", left
        return Outcome(reader.name, case, kind, seconds, mib, said)

    def _outcome(self, call: Callable[[], str], limited: bool) -> tuple[str, str]:
        self._fired = False
        try:
            try:
                signal.setitimer(signal.ITIMER_PROF, self._task.cpu_limit_s if limited else 0)
                said = call()
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0)
        except FusionError as error:
            return _refusal(error)
        except BaseException as error:
            kind = "memory" if isinstance(error, MemoryError) else "error"
            return kind, traceback.format_exc(limit=-8)
        return ("refused", said) if said else ("read", "")

    def _left(self) -> str:
        """What is in the folder for temporary files, or beside it."""
        names = [path.name for path in self._root.iterdir() if path.name not in ("case", "tmp", "log")]
        names += [f"tmp/{path.name}" for path in (self._root / "tmp").iterdir()]
        for name in names:
            place = self._root / name
            shutil.rmtree(place, ignore_errors=True) if place.is_dir() else place.unlink(missing_ok=True)
        return ", ".join(names)[:500]


def _refusal(error: FusionError) -> tuple[str, str]:
    """Refused, unless memory ran out on the way there, or the words are no line."""
    cause: BaseException | None = error
    for _ in range(20):
        if isinstance(cause, MemoryError):
            return "memory", "".join(traceback.format_exception(error, limit=-8))
        cause = cause and (cause.__cause__ or cause.__context__)
    text = str(error)
    if len(text) > MOST_WORDS or len(text.splitlines()) > 1:
        return "unclear", f"{len(text):,} letters: {text[:300]!r}"
    return "refused", text


class _bounded:  # noqa: N801, reads as the words of a `with`
    """A bound on the addresses of this process, above those in use now."""

    def __init__(self, mib: int | None) -> None:
        self._mib = mib

    def __enter__(self) -> None:
        if self._mib is not None:
            used = int(_read_status()["VmSize"] * _MIB)
            resource.setrlimit(resource.RLIMIT_AS, (used + self._mib * _MIB, resource.RLIM_INFINITY))

    def __exit__(self, *_: object) -> None:
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


def _read_status() -> dict[str, float]:
    """MiB of this process: VmSize, VmRSS and VmHWM, the highest resident size since `_forget_peak`."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return {name: int(rest.split()[0]) / 1024 for name, _, rest in (line.partition(":") for line in lines)
            if name in ("VmSize", "VmRSS", "VmHWM")}  # fmt: skip


def _forget_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def _serve(task: Task, root: str, pipe: Connection) -> None:
    sys.path[:] = task.path
    os.environ["TMPDIR"] = tempfile.tempdir = str(Path(root, "tmp"))
    log = Path(root, "log").open("w")  # noqa: SIM115, to the end of the process
    for stream in (1, 2):  # libraries in C complain there
        os.dup2(log.fileno(), stream)
    faulthandler.enable(log)
    import cv2

    cv2.setNumThreads(1)
    worker = _Worker(task, Path(root))
    while True:
        pipe.send(None)  # idle
        name, cases = pipe.recv()
        pipe.send((name, "warm-up"))
        for outcome in worker.warm_up(name):
            pipe.send(outcome)
        reader = task.reader(name)
        for case in cases:
            pipe.send((name, case))
            pipe.send(worker.run(reader, case))


# -- in the process that watches


class _Watched:
    """One worker, what it does now, and since when; replaced where it must be."""

    def __init__(self, task: Task, root: Path) -> None:
        self.task, self.root = task, root
        self.batch: tuple[str, list[int]] | None = None
        self.doing: tuple[str, int | str] | None = None
        self._began = (0.0, 0.0)
        self._start()

    def _start(self) -> None:
        shutil.rmtree(self.root, ignore_errors=True)
        self.root.mkdir(parents=True)
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process: BaseProcess = context.Process(
            target=_serve, args=(self.task, str(self.root), theirs), daemon=True
        )
        self.process.start()
        theirs.close()
        self.served = 0
        self.doing = None

    def give(self, batch: tuple[str, list[int]]) -> None:
        if self.served > FRESH_AFTER:
            self.stop()
            self._start()
            self.pipe.recv()
        self.batch = batch
        self.served += len(batch[1])
        self.pipe.send(batch)

    def begin(self, doing: tuple[str, int | str]) -> None:
        self.doing, self._began = doing, (time.monotonic(), self._cpu_s())

    def late(self) -> bool:
        """An input that its own clock could not stop."""
        if self.doing is None:
            return False
        wall, cpu = time.monotonic() - self._began[0], self._cpu_s() - self._began[1]
        if self.doing[1] == "warm-up":  # imports and compilers
            return wall > 5 * WALL_LIMIT_S
        return wall > WALL_LIMIT_S or cpu > 3 * self.task.cpu_limit_s

    def gone(self, why: str) -> tuple[Outcome, tuple[str, list[int]] | None]:
        """The input that ended the worker, and what is left of its batch; a new worker is started."""
        self.stop()
        code = self.process.exitcode
        name, case = self.doing or ("", -1)
        log = self.root / "log"
        words = log.read_text("utf-8", "replace").partition("Extension modules:")[0] if log.exists() else ""
        said = f"{words[-2500:].strip()}\nexit code {code}"
        number = case if isinstance(case, int) else -1
        rest = None
        if self.batch is not None and isinstance(case, int):
            rest = (name, [k for k in self.batch[1] if k > case])
        self._start()
        return Outcome(name, number, why, said=said), rest

    def stop(self) -> None:
        if self.process.is_alive():
            self.process.kill()
        self.process.join()
        self.pipe.close()

    def _cpu_s(self) -> float:
        try:
            times = psutil.Process(self.process.pid).cpu_times()
        except psutil.Error:
            return 0.0
        return times.user + times.system


def run(task: Task, counts: Mapping[str, int], root: Path, workers: int = 2) -> Iterator[Outcome]:
    """Outcomes of the first `counts[reader]` inputs of every reader, and of the seeds, as they come."""
    batches = [
        (name, list(range(at, min(at + _BATCH, count))))
        for name, count in counts.items()
        for at in range(0, count, _BATCH)
    ]
    yield from run_batches(task, batches, root, workers)


def run_batches(
    task: Task, batches: list[tuple[str, list[int]]], root: Path, workers: int
) -> Iterator[Outcome]:
    batches = batches[::-1]
    watched = [_Watched(task, root / str(k)) for k in range(workers)]
    busy = set(range(workers))
    try:
        while busy:
            ready = wait([watched[k].pipe for k in busy], timeout=1.0)
            for k in sorted(busy):
                one = watched[k]
                if one.pipe in ready:
                    try:
                        said = one.pipe.recv()
                    except (EOFError, OSError):
                        outcome, rest = one.gone("crash")
                    else:
                        if isinstance(said, Outcome):
                            yield said
                        elif said is not None:
                            one.begin(said)
                        elif batches:
                            one.give(batches.pop())
                        else:
                            busy.discard(k)
                        continue
                elif one.late():
                    outcome, rest = one.gone("hang")
                else:
                    continue
                yield outcome
                if rest is not None and rest[1]:
                    batches.append(rest)
    finally:
        for one in watched:
            one.stop()
