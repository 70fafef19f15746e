"""Chunks done by threads, and what a campaign makes of them."""

from __future__ import annotations

import pickle
import threading
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest
from machines import until
from toy_work import ToyWork, chunks_of, content, run_toy, tree

from fusion.chunks import Chunk, Done
from fusion.errors import FusionError, InputError, OutputError, UsageError
from fusion.preprocess.campaign import UNSTORED_IN_A_ROW, Pace, Report, Route, run_campaign
from fusion.preprocess.local import Failed, Stopped, Tally, run_local
from fusion.preprocess.records import Committed, claim, finished
from fusion.storage import RunStorage, Storage, open_storage

WORK = ToyWork(chunks_of(6, 3))


def expected(work: ToyWork) -> dict[str, bytes]:
    """The whole output, by the toy's own rule."""
    stems = [f"{n:06d}" for chunk in work.chunks for n in range(chunk.begin, chunk.end)]
    files = {f"{kind}/{stem}.bin": content(stem, kind) for stem in stems for kind in ("fused", "depth")}
    return files | {"frames.csv": "".join(f"{stem},made,{int(stem)}\n" for stem in stems).encode()}


@pytest.mark.parametrize("workers", [1, 2, 5, 20])
def test_any_number_of_workers_makes_the_same(tmp_path: Path, workers: int) -> None:
    report = run_toy(WORK, str(tmp_path), Route(workers))
    assert tree(tmp_path) == expected(WORK)
    assert (report.chunks, report.done, report.kept, report.rows) == (6, 6, 0, 18)
    assert report.size_bytes == sum(len(data) for name, data in expected(WORK).items() if "/" in name)
    assert report.lost == {"fir: frozen": 6}
    assert report.problem() is None


def test_what_is_done_is_kept(tmp_path: Path) -> None:
    run_toy(WORK, str(tmp_path))
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.bin")}
    (tmp_path / "chunks/000001.json").unlink()
    (tmp_path / "fused/000010.bin").write_bytes(b"short")
    report = run_toy(WORK, str(tmp_path))
    assert (report.done, report.kept, report.rows, report.again) == (2, 4, 18, {"file of another size": 1})
    assert tree(tmp_path) == expected(WORK)
    redone = {int(path.stem) // 3 for path, time_ns in before.items() if path.stat().st_mtime_ns != time_ns}
    assert redone == {1, 3}


def test_a_failed_chunk_is_reported_and_the_rest_done(tmp_path: Path) -> None:
    faults = ((1, "input"), (3, "fault"), (4, "output"))
    report = run_toy(ToyWork(WORK.chunks, faults=faults), str(tmp_path), Route(2))
    assert sorted((one.chunk.index, one.reason) for one in report.failed) == [
        (1, "toy.bag: no such message"),
        (3, "a fault of fusion's own: KeyError: 'a fault\\nin two lines'"),
        (4, "the name '../outside' leads out of the output (rename the input it comes from)"),
    ]
    assert [one.of_output for one in sorted(report.failed, key=lambda one: one.chunk.index)] == [0, 0, 1]
    assert not any(one.trace for one in report.failed)
    assert sorted(report.whole) == [0, 2, 5]
    problem = report.problem()
    assert isinstance(problem, FusionError)
    assert "3 of 6 chunks failed; the first, 000001: toy.bag: no such message" in str(problem)
    assert problem.exit_code == 1
    again = run_toy(WORK, str(tmp_path))  # their cause is gone
    assert (again.done, again.kept, again.failed) == (3, 3, [])
    assert tree(tmp_path) == expected(WORK)


def test_the_traceback_is_there_for_who_asks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FUSION_DEBUG", "1")
    report = run_toy(ToyWork(WORK.chunks, faults=((3, "fault"),)), str(tmp_path))
    assert "raise KeyError" in report.failed[0].trace


def test_a_store_that_takes_nothing_ends_the_campaign(tmp_path: Path) -> None:
    faults = tuple((index, "output") for index in range(2, 40))
    work = ToyWork(chunks_of(40, 1), faults=faults)
    words = f"{UNSTORED_IN_A_ROW} chunks in a row could not be stored"
    with pytest.raises(OutputError, match=words) as caught:
        run_toy(work, str(tmp_path))
    assert "goes on where this one stopped" in str(caught.value)
    assert len(finished(open_storage(tmp_path), work).done) == 2
    now_and_then = tuple((index, "output") for index in range(40) if index % 8)
    assert len(run_toy(ToyWork(work.chunks, "b", faults=now_and_then), str(tmp_path / "b")).failed) == 35


def test_no_frame_is_an_error(tmp_path: Path) -> None:
    class Nothing(ToyWork):
        def do(self, chunk: Chunk, out: Storage, tick: Callable[[], None]) -> Done:
            return Done(chunk, [], {}, {"fir: frozen": 2}, 0.0)

    problem = run_toy(Nothing(WORK.chunks), str(tmp_path)).problem()
    assert isinstance(problem, InputError)
    assert str(problem) == "no frame could be made: 12 fir: frozen"
    assert isinstance(Report().problem(), InputError)


class Watched(ToyWork):
    """Says how many of its chunks are under way at a time, and in which order they began."""

    def do(self, chunk: Chunk, out: Storage, tick: Callable[[], None]) -> Done:
        with LOCK:
            BEGUN.append(chunk.index)
            UNDER_WAY.append(chunk.index)
            MOST.append(len(UNDER_WAY))
            THREADS.append(cv2.getNumThreads())
        try:
            return super().do(chunk, out, tick)
        finally:
            with LOCK:
                UNDER_WAY.remove(chunk.index)


LOCK = threading.Lock()
BEGUN: list[int] = []
UNDER_WAY: list[int] = []
MOST: list[int] = []
THREADS: list[int] = []


@pytest.fixture(autouse=True)
def nothing_watched() -> None:
    for watched in (BEGUN, UNDER_WAY, MOST, THREADS):
        watched.clear()


def test_chunks_begin_in_order_and_few_at_a_time(tmp_path: Path) -> None:
    run_toy(Watched(chunks_of(12, 3), delay_s=0.002), str(tmp_path), Route(3))
    assert sorted(BEGUN) == list(range(12))
    # Handed out in order; two threads that are given theirs at once may begin in either order.
    assert all(abs(place - index) < 3 for place, index in enumerate(BEGUN))
    assert max(MOST) == 3
    assert set(THREADS) == {1}


def test_when_the_caller_stops_chunks_are_given_up_at_their_next_frame(tmp_path: Path) -> None:
    work, out = Watched(chunks_of(8, 50), delay_s=0.01), open_storage(tmp_path)
    claim(out, work.run_id)
    outcomes = run_local(work, out, work.chunks, 2)
    first = next(outcomes)
    until(lambda: len(BEGUN) > 2 and UNDER_WAY)
    outcomes.close()  # type: ignore[attr-defined]
    assert isinstance(first, Committed)
    assert UNDER_WAY == []
    assert len(BEGUN) < 8
    kept = finished(out, work).done
    assert first.chunk.index in kept
    assert len(kept) < len(BEGUN)
    report = run_toy(ToyWork(work.chunks), str(tmp_path), Route(2))
    assert report.kept == len(kept)
    assert tree(tmp_path) == expected(work)


def test_progress_counts_frames_and_chunks(tmp_path: Path) -> None:
    told: list[tuple[int, ...]] = []
    threads = set[int]()

    def progress(*counts: int) -> None:
        told.append(counts)
        threads.add(threading.get_ident())

    work = ToyWork(chunks_of(4, 20), delay_s=0.02, faults=((3, "input"),))
    run_toy(work, str(tmp_path), Route(2), progress=progress)
    assert told[0] == (0, 80, 0, 4)
    assert told[-1] == (80, 80, 4, 4)
    assert told == sorted(told)
    assert {counts[0] % 20 for counts in told} != {0}  # within chunks, too
    assert threads == {threading.get_ident()}
    told.clear()
    run_toy(work, str(tmp_path), progress=progress)
    assert told[0] == (60, 80, 3, 4)


def test_a_chunk_with_more_frames_than_planned_does_not_overshoot() -> None:
    told: list[tuple[int, ...]] = []
    chunks = chunks_of(2, 3)
    tally = Tally(chunks, chunks, lambda *counts: told.append(counts))
    tick = tally.of(chunks[0])
    for _ in range(10):
        tick()
    tally.tell()
    tally.tell()
    tally.finish(chunks[0])
    assert told == [(0, 6, 0, 2), (3, 6, 0, 2), (3, 6, 1, 2)]
    tally.stop()
    with pytest.raises(Stopped):
        tick()
    assert not issubclass(Stopped, Exception)  # a frame's own handler must not take it


def test_pace_counts_from_its_first_word() -> None:
    now = iter([100.0, 100.0, 110.0, 120.0])
    pace = Pace(lambda: next(now))
    assert pace(500, 1000) == (0.0, None)
    assert pace(500, 1000) == (0.0, None)
    assert pace(600, 1000) == (10.0, 40.0)
    assert pace(1000, 1000) == (25.0, 0.0)


# --- the campaign


def test_another_runs_output_is_refused_or_replaced(tmp_path: Path) -> None:
    run_toy(WORK, str(tmp_path))
    (tmp_path / "fused/mine.txt").write_bytes(b"1")
    other = ToyWork(chunks_of(2, 3), run_id="other")
    with pytest.raises(OutputError, match="another run's chunks"):
        run_toy(other, str(tmp_path))
    assert set(tree(tmp_path)) == {*expected(WORK), "fused/mine.txt"}
    run_toy(other, str(tmp_path), overwrite=True)
    assert tree(tmp_path) == expected(other) | {"fused/mine.txt": b"1"}


def test_leftovers_are_cleaned_and_other_runs_kept_out(tmp_path: Path) -> None:
    (tmp_path / "fused").mkdir()
    (tmp_path / f"fused/.{uuid.uuid4().hex}.tmp").write_bytes(b"half a frame")
    seen: list[str] = []

    def opening(out: RunStorage) -> None:
        seen.append("opening")
        assert out.names("fused") == []
        with pytest.raises(OutputError, match="another run is writing here"):
            run_toy(WORK, str(tmp_path))

    def closing_up(out: RunStorage, report: Report) -> None:
        seen.append("closing up")
        assert report.done == 6
        with pytest.raises(OutputError, match="another run is writing here"):
            run_toy(WORK, str(tmp_path))

    run_campaign(WORK, str(tmp_path), opening=opening, closing_up=closing_up)
    assert seen == ["opening", "closing up"]
    assert not list(tmp_path.rglob("*.tmp"))


def test_into_memory(tmp_path: Path) -> None:
    url = f"memory://{uuid.uuid4().hex}"
    run_toy(WORK, url, Route(2))
    out = open_storage(url)
    found = {name: out.read(name) for name in out.names("") if not name.startswith("chunks/")}
    assert found == expected(WORK)
    assert run_toy(WORK, url).kept == 6


def test_two_runs_at_once_where_nothing_locks(tmp_path: Path) -> None:
    """As in an object store: both do the same work, and neither harms the other."""
    url, reports = f"memory://{uuid.uuid4().hex}", list[Report]()
    work = ToyWork(chunks_of(10, 5), delay_s=0.002)
    threads = [threading.Thread(target=lambda: reports.append(run_toy(work, url))) for _ in range(2)]
    for thread in threads:
        thread.start()
        time.sleep(0.02)
    for thread in threads:
        thread.join()
    out = open_storage(url)
    found = {name: out.read(name) for name in out.names("") if not name.startswith("chunks/")}
    assert found == expected(work)
    assert [report.problem() for report in reports] == [None, None]


def test_routes_that_cannot_be(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="exclude each other"):
        Route(cluster=True, scheduler="tcp://127.0.0.1:1")
    with pytest.raises(UsageError, match="--workers"):
        Route(0)
    with pytest.raises(UsageError, match="own memory"):
        run_toy(WORK, f"memory://{uuid.uuid4().hex}", Route(2, cluster=True))


def test_failures_travel(tmp_path: Path) -> None:
    out = open_storage(tmp_path)
    outcomes: list[Any] = list(run_local(ToyWork(WORK.chunks, faults=((1, "input"),)), out, WORK.chunks))
    assert pickle.loads(pickle.dumps(outcomes)) == outcomes
    assert [type(one) for one in outcomes[:2]] == [Committed, Failed]
