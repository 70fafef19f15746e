"""Records of chunks: which of them count, and what they bring back."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from toy_work import ToyWork, chunks_of

from fusion.chunks import Chunk, Done
from fusion.errors import InputError, OutputError
from fusion.preprocess.records import (
    CAMPAIGN,
    claim,
    discard,
    do_chunk,
    finished,
    owner_of,
    read_record,
    record_name,
    rows_of,
    write_record,
)
from fusion.storage import LocalFolder, RunStorage, open_storage

WORK = ToyWork(chunks_of(6, 3))


@pytest.fixture
def done(tmp_path: Path) -> RunStorage:
    """An output in which all chunks of `WORK` are done."""
    out = open_storage(tmp_path / "out")
    claim(out, WORK.run_id)
    for chunk in WORK.chunks:
        do_chunk(WORK, chunk, out, lambda: None)
    return out


def test_all_that_was_committed_counts(done: RunStorage) -> None:
    there = finished(done, WORK)
    assert sorted(there.done) == [0, 1, 2, 3, 4, 5]
    assert there.again == {}
    assert [there.done[index].chunk for index in range(6)] == list(WORK.chunks)
    assert {one.rows for one in there.done.values()} == {3}
    files = {name: size for name, size in done.sizes("").items() if not name.startswith("chunks/")}
    assert sum(one.size_bytes for one in there.done.values()) == sum(files.values())
    assert dict(there.done[2].lost) == {"fir: frozen": 1}


def test_rows_come_in_the_order_of_the_chunks(done: RunStorage) -> None:
    rows = [tuple(row) for row in rows_of(done, WORK, [4, 0, 2])]
    assert rows == [(f"{n:06d}", "made", str(n)) for n in (0, 1, 2, 6, 7, 8, 12, 13, 14)]


def test_rows_of_a_record_that_went_meanwhile(done: RunStorage) -> None:
    done.write("chunks/000002.json", b"{}")
    with pytest.raises(InputError, match=r"chunks/000002.json: damaged record"):
        list(rows_of(done, WORK, range(6)))


def damage(out: RunStorage, name: str, **change: Any) -> None:
    record = json.loads(out.read(name)) | change
    out.write(name, json.dumps(record).encode())


def test_what_does_not_count_is_counted(done: RunStorage) -> None:
    data = done.read("chunks/000000.json")
    done.write("chunks/000000.json", data[: len(data) // 2])
    damage(done, "chunks/000001.json", run_id="another")
    done.remove("fused/000007.bin")
    done.write("depth/000010.bin", b"short")
    damage(done, "chunks/000004.json", chunk=[4, 12, 16, 4])
    there = finished(done, WORK)
    assert sorted(there.done) == [5]
    assert there.again == {
        "damaged record": 2,
        "another run": 1,
        "file is gone": 1,
        "file of another size": 1,
    }


@pytest.mark.parametrize(
    "change",
    [
        {"format": "fusion-chunk/2"},
        {"run_id": 7},
        {"rows": [["a", 1]]},
        {"rows": "abc"},
        {"rows": None},
        {"files": {"a": -1}},
        {"files": {"a": True}},
        {"files": ["a"]},
        {"lost": {"a": 1.5}},
        {"seconds": "1"},
        {"seconds": float("nan")},
        {"chunk": [0, 0, 3]},
    ],
)
def test_a_record_with_a_wrong_value_is_damaged(done: RunStorage, change: dict[str, Any]) -> None:
    damage(done, "chunks/000000.json", **change)
    there = finished(done, WORK)
    assert there.again == {"damaged record": 1}
    assert 0 not in there.done


@pytest.mark.parametrize("data", [b"", b"[" * 200_000, b"\xff\xfe", b"null", b"[]", b"9" * 9999])
def test_a_record_that_is_none(data: bytes) -> None:
    assert read_record(data, "toy", WORK.chunks[0]) == "damaged record"


@given(st.integers(0, 2**32))
def test_bytes_changed_anywhere_raise_nothing(seed: int) -> None:
    record = {"format": "fusion-chunk/1", "run_id": "toy", "chunk": [0, 0, 3, 3], "seconds": 0.5}
    record |= {"lost": {"fir: frozen": 1}, "files": {"a/b": 3}, "rows": [["a", "b"]]}
    data = bytearray(json.dumps(record).encode())
    assert isinstance(read_record(bytes(data), "toy", WORK.chunks[0]), Done)
    chance = random.Random(seed)
    for _ in range(chance.randint(1, 4)):
        data[chance.randrange(len(data))] = chance.randrange(256)
    found = read_record(bytes(data), "toy", WORK.chunks[0])
    assert found in ("damaged record", "another run") or isinstance(found, Done)


def test_names_and_rows_of_any_text_come_back(tmp_path: Path) -> None:
    out, chunk = open_storage(tmp_path), WORK.chunks[0]
    rows = (("é\n,\"'", "\udce4 from a file's name", ""), ("\u2028", "😀", "x" * 1000))
    made = Done(chunk, rows, {"a/é.png": 0, "b": 1 << 40}, {"rgb: torn; twice": 3}, 1.25)
    write_record(out, "toy", made)
    found = read_record(out.read(record_name(chunk)), "toy", chunk)
    assert isinstance(found, Done)
    assert (found.files, found.lost, found.seconds) == (made.files, made.lost, made.seconds)
    assert [tuple(row) for row in found.rows] == list(rows)


def test_what_could_not_be_read_back_is_not_written(tmp_path: Path) -> None:
    out, chunk = open_storage(tmp_path), WORK.chunks[0]
    cell: Any = 1
    for wrong in (Done(chunk, [[cell]], {}, {}, 0.0), Done(chunk, [], {"a": -1}, {}, 0.0)):
        with pytest.raises(ValueError, match="rows must be of str"):
            write_record(out, "toy", wrong)
    assert out.names("") == []


def test_the_work_must_do_the_chunk_it_was_asked_for(tmp_path: Path) -> None:
    class Wrong(ToyWork):
        def do(self, chunk: Chunk, out: Any, tick: Any) -> Done:
            return Done(self.chunks[0], [], {}, {}, 0.0)

    with pytest.raises(ValueError, match="000001"):
        do_chunk(Wrong(WORK.chunks), WORK.chunks[1], open_storage(tmp_path), lambda: None)
    assert open_storage(tmp_path).names("") == []


class Counting(LocalFolder):
    """Counts what it is asked for."""

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self.asked: list[str] = []

    def size(self, name: str) -> int | None:
        self.asked.append("size")
        return super().size(name)

    def sizes(self, folder: str) -> dict[str, int]:
        self.asked.append("sizes")
        return super().sizes(folder)


def test_one_listing_finds_all_files(done: RunStorage) -> None:
    out = Counting(done.url)
    assert len(finished(out, WORK).done) == 6
    assert out.asked == ["sizes"]


# --- whose output it is


def test_an_output_belongs_to_one_run(done: RunStorage) -> None:
    claim(done, WORK.run_id)
    with pytest.raises(OutputError, match=r"another run's chunks.*--overwrite"):
        claim(done, "another")
    assert owner_of(done) == WORK.run_id


def test_a_run_that_came_to_nothing_protects_nothing(tmp_path: Path) -> None:
    out = open_storage(tmp_path)
    assert owner_of(out) is None
    claim(out, "first")
    out.write("run.toml", b"")
    claim(out, "second")
    assert owner_of(out) == "second"


@pytest.mark.parametrize("data", [b"", b"{}", b"[1]", b'{"format": "fusion-campaign/1"}', b"[" * 200_000])
def test_a_damaged_mark_is_somebody_elses(done: RunStorage, data: bytes) -> None:
    done.write(CAMPAIGN, data)
    assert owner_of(done) == ""
    with pytest.raises(OutputError, match="another run"):
        claim(done, WORK.run_id)


def test_discarding_takes_what_records_name_and_nothing_else(done: RunStorage) -> None:
    done.write("fused/mine.txt", b"not of the run")
    outside = Path(done.url).parent / "outside"
    outside.write_bytes(b"precious")
    damage(done, "chunks/000000.json", files={"../outside": 8, "fused/000000.bin": 1})
    done.write("chunks/000001.json", b"damaged")
    discard(done)
    assert outside.exists()
    left = ["fused/mine.txt", *(f"{kind}/{n:06d}.bin" for n in range(6) for kind in ("fused", "depth"))]
    assert done.names("") == sorted(left)  # of records that name what no run wrote, nothing is believed
