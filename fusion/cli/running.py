"""What commands that run over many frames share: threads, progress, warnings, and where output may go."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from glob import has_magic
from pathlib import Path

from fusion.batch import no_progress
from fusion.errors import OutputError, UsageError
from fusion.sources.folders import split_pattern

MAX_WORKERS = 256


def threads_of(workers: int | None) -> int:
    """The number asked for, by default one for every core that this process may use."""
    if workers is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if not 1 <= workers <= MAX_WORKERS:
        raise UsageError(f"{workers} is no number of threads", where="--workers", hint=f"1 to {MAX_WORKERS}")
    return workers


def warn(warnings: Iterable[str]) -> None:
    for warning in warnings:
        print(f"fusion: warning: {warning}", file=sys.stderr)


def refuse_overlap(inputs: Sequence[str], out: Path, folders: Sequence[str]) -> None:
    """An output inside an input folder would be read as input the next time; the reverse would overwrite.

    `folders` are those that the run makes in `out`.
    """
    target = out.resolve()
    for spec in inputs:
        folder = fixed_folder(spec)
        if folder is None:
            if any(target / name in Path(spec).resolve().parents for name in folders):
                raise OutputError(f"would overwrite the input {spec}", where=out, hint="choose another -o")
            continue
        if target == folder or folder in target.parents:
            raise OutputError("lies inside the input folder", where=out, hint="choose another -o")
        for ours in (target / name for name in folders):
            if folder == ours or ours in folder.parents:
                raise OutputError(f"would overwrite the input {spec}", where=out, hint="choose another -o")


def refuse_existing(out: Path, overwrite: bool) -> None:
    """Raises `OutputError` where something would be written over."""
    if out.is_dir():
        raise OutputError("is a folder", where=out, hint="-o is the file to write")
    if out.exists() and not overwrite:
        raise OutputError(
            "is there already", where=out, hint="--overwrite replaces it, or choose another name"
        )


def fixed_folder(spec: str) -> Path | None:
    """The folder that a folder or glob specification reads from; None for single files."""
    path = Path(spec)
    if path.is_dir():
        return path.resolve()
    return None if path.exists() or not has_magic(spec) else split_pattern(spec)[0].resolve()


@contextmanager
def progress_bar(what: str, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """A bar with rate and time left on the terminal; nothing where there is none."""
    if quiet or not sys.stderr.isatty():
        yield no_progress
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]:.0f} frames/s"),
        TimeRemainingColumn(),
    )
    with Progress(what, *columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None, rate=0.0)
        began = time.monotonic()

        def advance(done: int, total: int) -> None:
            rate = done / max(time.monotonic() - began, 1e-6)
            bar.update(task, completed=done, total=total, rate=rate)

        yield advance


@contextmanager
def quiet_libraries() -> Iterator[None]:
    """Sends what C libraries write to standard error nowhere; Python's own words still arrive.

    libpng and libtiff announce every damaged file by themselves; the frame is named in our report already.
    """
    sys.stderr.flush()
    before, terminal = sys.stderr, os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        if before is sys.__stderr__:
            sys.stderr = os.fdopen(os.dup(terminal), "w", buffering=1, errors="backslashreplace")
        yield
    finally:
        if sys.stderr is not before:
            sys.stderr.close()
            sys.stderr = before
        os.dup2(terminal, 2)
        os.close(terminal)
        os.close(nowhere)
