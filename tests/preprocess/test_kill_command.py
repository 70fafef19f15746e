"""`fusion preprocess` itself: killed and started again; by workers that share nothing but an object store."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from machines import Machines, environment, until
from toy_work import tree

from fusion.simulate.containers import write_recording
from fusion.storage import open_storage
from tests.preprocess.flights import flight as flight

POINTS = 6  # a start costs a second or two; test_kill.py has twenty


@pytest.fixture(scope="module")
def bag(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(flight, tmp_path_factory.mktemp("bag") / "flight.bag", "rosbag1").path


def command(source: Path | str, flight: Path, out: Path | str, *more: str) -> list[str]:
    rig = ["--rig", str(flight / "truth/rig.toml")]
    head = [sys.executable, "-m", "fusion", "preprocess", str(source), "-o", str(out)]
    return [*head, *rig, "--chunk-s", "0.2", "--quiet", *more]


def run(words: list[str]) -> None:
    done = subprocess.run(words, env=environment(), capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.fixture(scope="module")
def whole(bag: Path, flight: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What a run leaves that nobody disturbed, with one worker and chunks as they are here."""
    out = tmp_path_factory.mktemp("whole") / "out"
    run(command(bag, flight, out, "--to", "folder", "--to", "mcap", "--workers", "1"))
    return tree(out)


def test_killed_and_started_again(bag: Path, flight: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    chance, out = random.Random(8), tmp_path / "out"
    words = command(bag, flight, out, "--to", "folder", "--to", "mcap", "--workers", "2")
    kills, committed = 0, dict[Path, int]()
    for point in range(POINTS):
        quiet = subprocess.DEVNULL
        process = subprocess.Popen(words, env=environment(), stdout=quiet, stderr=quiet)
        more = len(list(out.glob("fused/*"))) + chance.randint(0 if point else 1, 2)
        while process.poll() is None and len(list(out.glob("fused/*"))) < more:
            time.sleep(0.001)
        process.send_signal(signal.SIGKILL)
        kills += process.wait() == -signal.SIGKILL
        now = {path: path.stat().st_mtime_ns for path in out.glob("chunks/0*.json")}
        assert {path: now[path] for path in committed} == committed
        committed = now
    assert kills == POINTS
    assert committed
    run(words)
    assert tree(out) == whole
    assert not list(out.rglob("*.tmp"))


def test_workers_share_nothing_but_an_object_store(
    bag: Path, flight: Path, whole: dict[str, bytes], tmp_path: Path, s3_endpoint: str
) -> None:
    """The recording lies in one bucket, the frames go to another; a worker and the scheduler die."""
    open_storage("s3://input/flights").write("flight.bag", bag.read_bytes())
    out = open_storage("s3://output/flight")
    with Machines(tmp_path) as machines:
        scheduler = machines.start_scheduler()
        victim = machines.start_worker()
        machines.start_worker()
        words = command("s3://input/flights/flight.bag", flight, out.url)
        first = machines.run(*words, "--scheduler", machines.address)
        until(lambda: len(list(out.names("fused"))) >= 2, first, 0.3)
        victim.kill()
        until(lambda: len(list(out.names("chunks"))) >= 6, first, 0.3)
        scheduler.kill()
        said, complaint = first.communicate(timeout=120)
        assert (first.returncode, said) == (1, "")
        assert f"the scheduler at {machines.address} is gone" in complaint
        machines.start_scheduler()
        machines.start_worker()
        second = machines.run(*words, "--scheduler", machines.address)
        assert second.communicate(timeout=120) == ("", "")
    found = {name: out.read(name) for name in out.names("") if not name.startswith("chunks/")}
    ours = {"run.toml", "fused.mcap"}  # what says which outputs there are, and the one that is not made here
    assert {*found} - ours == {*whole} - ours
    assert [name for name in found if name not in ours and found[name] != whole[name]] == []
    strays = [path.name for path in tmp_path.rglob("*") if path.suffix in (".png", ".csv", ".tmp", ".mcap")]
    assert strays == []
