"""A campaign whose frames are a few bytes: what the tests of executors kill, and a command that runs it."""

from __future__ import annotations

import argparse
import csv
import hashlib
import io
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fusion.chunks import Chunk, Done
from fusion.errors import FusionError, InputError
from fusion.preprocess.campaign import Report, Route, run_campaign
from fusion.preprocess.records import rows_of
from fusion.storage import RunStorage, Storage, open_storage


def chunks_of(count: int, frames: int) -> tuple[Chunk, ...]:
    return tuple(Chunk(index, index * frames, (index + 1) * frames, frames) for index in range(count))


def content(stem: str, kind: str) -> bytes:
    """A frame's bytes: its own, and of its own length."""
    digest = hashlib.sha256(f"{kind}/{stem}".encode()).digest()
    return digest * (1 + digest[0] % 40)


@dataclass
class ToyWork:
    """Two files a frame. `faults` says which chunks do what else; `source` is where inputs are read, if
    anywhere.
    """

    chunks: Sequence[Chunk]
    run_id: str = "toy"
    delay_s: float = 0.0
    faults: tuple[tuple[int, str], ...] = ()
    source: str = ""

    def do(self, chunk: Chunk, out: Storage, tick: Callable[[], None]) -> Done:
        rows, files = [], {}
        for number in range(chunk.begin, chunk.end):
            stem = f"{number:06d}"
            for kind in ("fused", "depth"):
                data = content(stem, kind)
                if self.source:
                    data = open_storage(self.source).read(f"{stem}.bin")[::-1] + data
                name = f"{kind}/{stem}.bin"
                out.write(name, data)
                files[name] = len(data)
            rows.append((stem, "made", str(number)))
            time.sleep(self.delay_s)
            self._fail(chunk, out)
            tick()
        return Done(chunk, rows, files, {"fir: frozen": 1}, 0.0)

    def _fail(self, chunk: Chunk, out: Storage) -> None:
        fault = dict(self.faults).get(chunk.index, "")
        if fault == "input":
            raise InputError("no such message", where="toy.bag")
        if fault == "fault":
            raise KeyError("a fault\nin two lines")
        if fault == "output":
            out.write("../outside", b"")
        if fault == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if fault == "die once" and out.size(f"died/{chunk.name}") is None:
            out.write(f"died/{chunk.name}", b"")
            os.kill(os.getpid(), signal.SIGKILL)


def run_toy(work: ToyWork, url: str, route: Route | None = None, **how: object) -> Report:
    """A campaign with its index, as the real command makes one."""

    def index(out: RunStorage, report: Report) -> None:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(rows_of(out, work, report.whole))
        out.write("frames.csv", text.getvalue().encode())

    return run_campaign(work, url, route=route or Route(), closing_up=index, **how)  # type: ignore[arg-type]


def tree(folder: Path) -> dict[str, bytes]:
    """Everything below `folder` but the records, whose seconds differ from run to run."""
    files = (path for path in folder.rglob("*") if path.is_file())
    found = {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}
    return {name: data for name, data in found.items() if not name.startswith(("chunks/", "died/"))}


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("out")
    parser.add_argument("--chunks", type=int, default=8)
    parser.add_argument("--frames", type=int, default=5)
    parser.add_argument("--delay", type=float, default=0.0)
    parser.add_argument("--source", default="")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cluster", action="store_true")
    parser.add_argument("--scheduler", default="")
    given = parser.parse_args()
    work = ToyWork(chunks_of(given.chunks, given.frames), delay_s=given.delay, source=given.source)
    try:
        report = run_toy(work, given.out, Route(given.workers, given.cluster, given.scheduler, 20.0))
    except FusionError as error:
        sys.stderr.write(f"fusion: {error}\n")
        return error.exit_code
    sys.stdout.write(f"done {report.done} kept {report.kept} failed {len(report.failed)}\n")
    return 0 if report.problem() is None else 1


if __name__ == "__main__":
    from toy_work import main as by_its_name  # so that workers find the class, too

    sys.exit(by_its_name())
