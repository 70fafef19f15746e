"""Killed without a chance to clean up, then started again: nothing lost, nothing twice, nothing left over."""

from __future__ import annotations

import random
import signal
import subprocess
import time
from pathlib import Path

import pytest
from machines import TOY, environment, until
from toy_work import ToyWork, chunks_of, run_toy, tree

from fusion.preprocess.records import finished
from fusion.storage import open_storage

CHUNKS, FRAMES, KILLS = 60, 4, 20
WORK = ToyWork(chunks_of(CHUNKS, FRAMES))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The output of a run that nobody disturbed."""
    folder = tmp_path_factory.mktemp("whole")
    run_toy(WORK, str(folder))
    return tree(folder)


def start(out: Path, *arguments: str) -> subprocess.Popen[bytes]:
    command = [*TOY, str(out), "--chunks", str(CHUNKS), "--frames", str(FRAMES), *arguments]
    quiet = subprocess.DEVNULL
    return subprocess.Popen(command, env=environment(), stdout=quiet, stderr=quiet, start_new_session=True)


def files(out: Path) -> int:
    return sum(1 for _ in out.glob("[df]*/*"))


def changed_ns(out: Path) -> dict[str, int]:
    """When the files of committed chunks were written."""
    store = open_storage(out)
    done = finished(store, WORK).done.values()
    stems = [f"{n:06d}" for one in done for n in range(one.chunk.begin, one.chunk.end)]
    names = [f"{kind}/{stem}.bin" for stem in stems for kind in ("fused", "depth")]
    return {name: (out / name).stat().st_mtime_ns for name in names}


def test_killed_at_twenty_points(tmp_path: Path, whole: dict[str, bytes]) -> None:
    """Half of the points are so many files further, half a time after the start: in its imports, too."""
    chance, out, committed = random.Random(5), tmp_path / "out", dict[str, int]()
    reached = set[int]()
    for kill in range(KILLS):
        process = start(out, "--delay", "0.05")
        before = files(out)
        if kill % 2:
            more = before + chance.randint(1, 16)
            while process.poll() is None and files(out) < more:
                time.sleep(0.001)
        else:
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(chance.uniform(0.0, 0.5))
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL  # it was not done by itself before
        reached.add(files(out))
        now = changed_ns(out)
        assert {name: now[name] for name in committed} == committed  # what was committed is not done again
        committed = now
    assert len(reached) > KILLS // 2
    assert 0 < len(committed) < len(whole)
    assert start(out).wait() == 0
    assert tree(out) == whole
    assert not list(out.rglob("*.tmp"))
    now = changed_ns(out)
    assert {name: now[name] for name in committed} == committed


def test_killed_with_a_cluster_of_its_own(tmp_path: Path, whole: dict[str, bytes]) -> None:
    """The workers end with the command that started them; nobody goes on writing behind its back."""
    out = tmp_path / "out"
    process = start(out, "--delay", "0.03", "--cluster")
    until(lambda: files(out) >= 30)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    until(lambda: not alive(process.pid))
    left = files(out)
    assert 30 <= left < len(whole)
    assert start(out).wait() == 0
    assert tree(out) == whole
    assert not list(out.rglob("*.tmp"))


def alive(group: int) -> list[int]:
    """The processes of a group that still run."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:  # ended meanwhile
            continue
        if int(fields[2]) == group and fields[0] != "Z":
            found.append(int(path.parent.name))
    return found


def test_two_commands_at_once(tmp_path: Path, whole: dict[str, bytes]) -> None:
    """The second is told so. Who is killed keeps nobody out."""
    out = tmp_path / "out"
    first = start(out, "--delay", "0.2")
    until(lambda: files(out) >= 4)
    command = [*TOY, str(out), "--chunks", str(CHUNKS), "--frames", str(FRAMES)]
    second = subprocess.run(command, env=environment(), capture_output=True, text=True, check=False)
    first.kill()
    assert (first.wait(), second.returncode) == (-signal.SIGKILL, 1)
    assert "another run is writing here" in second.stderr
    assert start(out).wait() == 0
    assert tree(out) == whole
