"""A scheduler and workers as processes of their own, each where it would be on a machine of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

HERE = Path(__file__).parent
PATH = os.pathsep.join([str(HERE.parents[1]), str(HERE)])
TOY = [sys.executable, "-m", "toy_work"]


def environment(**more: str) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": PATH, **more}


def until(
    happened: Callable[[], object],
    by: subprocess.Popen[str] | None = None,
    pause_s: float = 0.005,
    seconds: float = 120.0,
) -> None:
    """Wait for what must happen, `by` a process; a machine that is merely slow has time enough."""
    end = time.monotonic() + seconds
    while not happened():
        assert by is None or by.poll() is None, by.communicate()
        assert time.monotonic() < end, "it did not happen"
        time.sleep(pause_s)


class Machines:
    """Processes in folders of their own below `folder`; all are killed at the end."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.address = ""
        self.workers: list[subprocess.Popen[bytes]] = []
        self._stack = ExitStack()
        self._started = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def start_scheduler(self) -> subprocess.Popen[bytes]:
        file = self.folder / f"scheduler{self._started}.json"
        process = self._start(
            "scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file)
        )
        until(lambda: file.exists() and file.read_text().rstrip().endswith("}"))
        self.address = json.loads(file.read_text())["address"]
        return process

    def start_worker(self, **more: str) -> subprocess.Popen[bytes]:
        how = ("--nthreads", "1", "--no-nanny", "--death-timeout", "60")
        self.workers.append(self._start("worker", self.address, *how, **more))
        return self.workers[-1]

    def toy(self, *arguments: str, **more: str) -> subprocess.Popen[str]:
        """The toy's command on these machines, in a folder of its own."""
        return self.run(*TOY, *arguments, "--scheduler", self.address, **more)

    def run(self, *command: str, **more: str) -> subprocess.Popen[str]:
        """A command in a folder of its own, with what it says."""
        folder = self._new_folder("command")
        return self._stack.enter_context(
            _Killed(list(command), cwd=folder, env=environment(**more), text=True)
        )

    def _start(self, role: str, *arguments: str, **more: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "dask", role, *arguments, "--no-dashboard"]
        folder = self._new_folder(role)
        return self._stack.enter_context(_Killed(command, cwd=folder, env=_at_home(folder, more)))

    def _new_folder(self, role: str) -> Path:
        folder = self.folder / f"{role}{self._started}"
        folder.mkdir()
        self._started += 1
        return folder


def _at_home(folder: Path, more: Mapping[str, str]) -> dict[str, str]:
    """Nothing that a process leaves by itself falls into another one's folder."""
    return environment(TMPDIR=str(folder), HOME=str(folder), **more)


class _Killed(subprocess.Popen):  # type: ignore[type-arg]
    def __init__(self, command: list[str], **how: object) -> None:
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        if not how.get("text"):
            pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        super().__init__(command, **pipes, **how)  # type: ignore[arg-type]

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.kill()
        self.wait()
        for pipe in (self.stdout, self.stderr):
            if pipe is not None:
                pipe.close()
