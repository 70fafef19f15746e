"""The same chunks by Dask workers: the same bytes, whoever dies, and a clear word where it cannot work."""

from __future__ import annotations

import logging
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from machines import Machines, until
from toy_work import ToyWork, chunks_of, run_toy, tree

from fusion.cli.running import quiet_libraries
from fusion.errors import InputError, UsageError
from fusion.preprocess.campaign import Route
from fusion.storage import open_storage

pytest.importorskip("distributed")
from dask import config

from fusion.preprocess.dask import run_dask

WORK = ToyWork(chunks_of(8, 3))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What threads make of the same work."""
    folder = tmp_path_factory.mktemp("whole")
    run_toy(WORK, str(folder))
    return tree(folder)


@pytest.fixture(scope="module")
def machines(tmp_path_factory: pytest.TempPathFactory, s3_endpoint: str) -> Iterator[Machines]:
    with Machines(tmp_path_factory.mktemp("machines")) as machines:
        machines.start_scheduler()
        machines.start_worker()
        machines.start_worker()
        yield machines


def test_a_cluster_made_here(
    tmp_path: Path, whole: dict[str, bytes], capfd: pytest.CaptureFixture[str]
) -> None:
    """One chunk has bad input, one kills its worker once, one whoever tries it: the rest is done."""
    levels = [logging.getLogger(name).level for name in ("distributed", "distributed.client")]
    work = ToyWork(WORK.chunks, faults=((1, "die once"), (3, "input"), (5, "die")))
    told: list[tuple[int, ...]] = []
    # As the command runs it: what a worker process says that is ended while it starts goes nowhere.
    with config.set({"distributed.scheduler.allowed-failures": 1}), quiet_libraries():
        report = run_toy(
            work, str(tmp_path), Route(2, cluster=True), progress=lambda *counts: told.append(counts)
        )
    reasons = {one.chunk.index: one.reason for one in report.failed}
    assert set(reasons) == {3, 5}
    assert reasons[3] == "toy.bag: no such message"
    assert reasons[5].startswith("every worker that tried it died")
    assert (report.done, report.rows) == (6, 18)
    assert (told[0], told[-1]) == ((0, 24, 0, 8), (24, 24, 8, 8))
    assert open_storage(tmp_path).size("died/000001") == 0
    assert capfd.readouterr().err == ""
    assert levels == [logging.getLogger(name).level for name in ("distributed", "distributed.client")]
    run_toy(WORK, str(tmp_path))
    assert tree(tmp_path) == whole


def test_a_scheduler_that_is_there(tmp_path: Path, machines: Machines, whole: dict[str, bytes]) -> None:
    report = run_toy(WORK, str(tmp_path), Route(scheduler=machines.address))
    assert (report.done, report.failed) == (8, [])
    assert tree(tmp_path) == whole
    assert run_toy(WORK, str(tmp_path), Route(scheduler="tcp://127.0.0.1:1")).kept == 8  # needs nobody


def test_many_more_chunks_than_workers(tmp_path: Path, machines: Machines) -> None:
    work = ToyWork(chunks_of(60, 1))
    report = run_toy(work, str(tmp_path), Route(scheduler=machines.address))
    assert (report.done, report.rows) == (60, 60)


def test_a_folder_that_workers_do_not_see(tmp_path: Path, machines: Machines) -> None:
    out = open_storage(tmp_path)  # nobody claimed it, as if the workers' folder of that name were another one
    with pytest.raises(UsageError, match=r"is not the output that the command sees.*s3://"):
        list(run_dask(WORK, out, WORK.chunks, scheduler=machines.address))
    assert out.names("") == []


def test_no_scheduler(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"tcp://127.0.0.1:1: no scheduler answers.*dask scheduler"):
        run_toy(WORK, str(tmp_path), Route(scheduler="tcp://127.0.0.1:1", wait_s=0.5))
    with pytest.raises(InputError, match="no scheduler answers"):
        run_toy(WORK, str(tmp_path), Route(scheduler="nonsense://x", wait_s=0.5))


def test_workers_that_cannot_do_it(tmp_path: Path) -> None:
    """None at all, one without fusion, one with another version of it."""
    none, other = tmp_path / "none", tmp_path / "other"
    none.mkdir()
    (none / "fusion.py").write_text("raise ModuleNotFoundError('No module named fusion', name='fusion')")
    (other / "fusionprep-99.0.dist-info").mkdir(parents=True)
    (other / "fusionprep-99.0.dist-info/METADATA").write_text("Name: fusionprep\nVersion: 99.0\n")
    with Machines(tmp_path) as machines:
        machines.start_scheduler()
        with pytest.raises(InputError, match=r"has no worker after 0.5 s \(start some: dask worker tcp://"):
            run_toy(WORK, str(tmp_path / "out"), Route(scheduler=machines.address, wait_s=0.5))
        worker = machines.start_worker(PYTHONPATH=str(none))
        with pytest.raises(UsageError, match=r"a worker has no fusion.*pip install"):
            run_toy(WORK, str(tmp_path / "out"), Route(scheduler=machines.address, wait_s=30))
        worker.kill()
        worker.wait()
        machines.start_worker(PYTHONPATH=str(other))
        with pytest.raises(UsageError, match=r"has fusionprep 99\.0, the command"):
            run_toy(WORK, str(tmp_path / "out"), Route(scheduler=machines.address, wait_s=30))


def test_without_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match=r"pip install 'fusionprep\[dask\]'"):
        run_toy(WORK, str(tmp_path), Route(cluster=True))


def test_nobody_shares_a_disk(tmp_path: Path, machines: Machines) -> None:
    """Input and output are in the object store; processes live in folders of their own and leave nothing
    there.
    """
    source, out = open_storage("s3://input/run"), open_storage("s3://output/run")
    for number in range(24):
        source.write(f"{number:06d}.bin", b"input %d" % number)
    run_toy(ToyWork(WORK.chunks, source=source.url), str(tmp_path))
    command = machines.toy(out.url, "--source", source.url, "--chunks", "8", "--frames", "3")
    assert command.communicate(timeout=60) == ("done 8 kept 0 failed 0\n", "")
    found = {name: out.read(name) for name in out.names("") if not name.startswith("chunks/")}
    assert found == tree(tmp_path)
    strays = {path.suffix for path in machines.folder.rglob("*") if path.is_file()} - {".json"}
    assert strays & {".bin", ".csv", ".tmp"} == set()


def test_a_worker_is_killed(tmp_path: Path, machines: Machines, whole: dict[str, bytes]) -> None:
    victim, folder = machines.start_worker(), tmp_path / "out"
    command = machines.toy(str(folder), "--chunks", "8", "--frames", "3", "--delay", "0.1")
    until(lambda: len(list(folder.glob("fused/*.bin"))) >= 5, command)
    victim.send_signal(signal.SIGKILL)
    said, complaint = command.communicate(timeout=60)
    assert (said, complaint) == ("done 8 kept 0 failed 0\n", "")
    assert tree(folder) == whole


def test_the_scheduler_is_killed(tmp_path: Path, whole: dict[str, bytes]) -> None:
    folder = tmp_path / "out"
    with Machines(tmp_path) as machines:
        scheduler = machines.start_scheduler()
        machines.start_worker()
        command = machines.toy(str(folder), "--chunks", "8", "--frames", "3", "--delay", "0.05")
        until(lambda: len(list(folder.glob("chunks/0*.json"))) >= 2, command)
        scheduler.send_signal(signal.SIGKILL)
        said, complaint = command.communicate(timeout=60)
        assert command.returncode == 1
        where = f"the scheduler at {machines.address} is gone"
        assert (said, complaint) == (
            "",
            f"fusion: {where} (the same command goes on where this one stopped)\n",
        )
        committed = len(list(folder.glob("chunks/0*.json")))
        machines.start_scheduler()
        machines.start_worker()
        again = machines.toy(str(folder), "--chunks", "8", "--frames", "3")
        said, complaint = again.communicate(timeout=60)
        assert complaint == ""
        assert committed <= int(said.split()[3]) < 8
    assert tree(folder) == whole
