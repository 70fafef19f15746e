"""What a seek reads, what is kept in memory, what threads see: of all recordings that are made of chunks."""

from __future__ import annotations

import io
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import ClassVar

import fsspec
import pytest
from fsspec.spec import AbstractFileSystem

from fusion.errors import InputError
from fusion.recordings import chunks, open_recording
from fusion.recordings.base import Topic
from fusion.recordings.chunks import normal_type
from fusion.recordings.files import Faults, inside, stem
from tests.recordings.recorded import (
    SECOND,
    Row,
    in_order,
    read,
    rows_of,
    write_bag,
    write_mcap,
    write_rosbag2,
)


class CountedFile(io.BytesIO):
    """Counts the bytes that are read from it."""

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        CountedFiles.count += len(data)
        CountedFiles.largest = max(CountedFiles.largest, len(data))
        return data

    def getvalue(self) -> bytes:
        raise AssertionError("all of it was taken at once")


class CountedFiles(AbstractFileSystem):
    """A file system of bytes in memory, which counts what is read."""

    protocol: ClassVar[str] = "counted"  # type: ignore[misc]
    held: ClassVar[dict[str, bytes]] = {}
    count = largest = 0

    def open(self, path, *args, **kwargs):  # type: ignore[override]
        return _Raw(CountedFile(self.held[_last(path)]))

    def exists(self, path, **kwargs) -> bool:
        return _last(path) in self.held

    def isdir(self, path) -> bool:
        return False


def _last(path: str) -> str:
    return path.rpartition("/")[2]


class _Raw:
    """A file that is not io.BytesIO, as those of object stores are not."""

    def __init__(self, file: CountedFile) -> None:
        self._file = file

    def __getattr__(self, name: str):
        return getattr(self._file, name)

    def __enter__(self):
        return self

    def __exit__(self, *error) -> None:
        self._file.close()


@pytest.fixture
def counted():
    fsspec.register_implementation("counted", CountedFiles, clobber=True)

    def put(path: Path) -> str:
        CountedFiles.held[path.name] = path.read_bytes()
        return f"counted://{path.name}"

    yield put
    CountedFiles.held.clear()


def many(count: int = 3000) -> list[Row]:
    """Five minutes of three topics."""
    return rows_of(count)


@pytest.mark.parametrize("packing", ["none", "zstd"])
@pytest.mark.parametrize("form", ["bag", "mcap"])
def test_a_seek_reads_a_small_share(tmp_path, counted, form, packing):
    rows = many()
    if form == "bag":
        path = write_bag(tmp_path / "a.bag", rows, "" if packing == "none" else "lz4", chunk_bytes=8000)
    else:
        path = write_mcap(tmp_path / "a.mcap", rows, packing, chunk_size=8000)
    size, url = path.stat().st_size, counted(path)
    CountedFiles.count = 0
    recording = open_recording(url)
    assert CountedFiles.count < 0.15 * size  # the index alone
    for i in (0, 1234, 2990):
        CountedFiles.count = 0
        stop = i + 10
        found = read(recording, start_ns=rows[i].log_ns, end_ns=rows[i].log_ns + SECOND)
        assert found == rows[i:stop]
        assert 0 < CountedFiles.count < 0.06 * size
    CountedFiles.count = CountedFiles.largest = 0
    assert read(recording) == rows
    assert CountedFiles.count < 1.1 * size
    assert CountedFiles.largest < 0.05 * size


@pytest.mark.parametrize("form", ["bag", "mcap"])
def test_chunks_without_a_wanted_topic_are_not_read(tmp_path, counted, form):
    rows = [row for row in many() if row.topic != "/fir"]
    rows[1500] = rows[1500]._replace(topic="/fir")
    path = (write_bag if form == "bag" else write_mcap)(tmp_path / f"a.{form}", rows)
    recording = open_recording(counted(path))
    (fir,) = (topic for topic in recording.topics if topic.name == "/fir")
    CountedFiles.count = 0
    assert read(recording, [fir]) == [rows[1500]]
    assert 0 < CountedFiles.count < 0.02 * path.stat().st_size


def test_loose_messages_are_read_in_runs(tmp_path, counted):
    big = [row._replace(data=row.data * 100) for row in many(300)]
    path = write_mcap(tmp_path / "a.mcap", big, use_chunking=False)
    recording = open_recording(counted(path))
    CountedFiles.count = 0
    assert read(recording, start_ns=big[150].log_ns, end_ns=big[152].log_ns) == big[150:152]
    assert CountedFiles.count < 0.5 * path.stat().st_size


def interleaved(count: int = 400) -> list[Row]:
    """Every chunk spans the whole time: the worst order there is."""
    rows = many(count)
    return [row for start in range(20) for row in rows[start::20]]


@pytest.mark.parametrize("form", ["bag", "mcap"])
def test_chunks_that_overlap_keep_little_in_memory(tmp_path, monkeypatch, form):
    rows = interleaved()
    path = (write_bag if form == "bag" else write_mcap)(tmp_path / f"a.{form}", rows)
    kept: list[int] = []
    let_go = chunks._Merge._let_go

    def watch(self):
        let_go(self)
        kept.append(self.kept)
        assert self.kept >= sum(len(c.contents.data) for c in self.open if c.kept)

    monkeypatch.setattr(chunks._Merge, "_let_go", watch)
    assert read(open_recording(path)) == in_order(rows)
    assert max(kept) > 20_000  # all of it
    kept.clear()
    monkeypatch.setattr(chunks, "KEPT_BYTES", 6000)
    recording = open_recording(path)
    assert read(recording) == in_order(rows)
    assert max(kept) < 6000 + 2500
    assert not recording.faults
    monkeypatch.setattr(chunks, "MAX_READ_AGAIN", 50_000)
    with pytest.raises(InputError, match="too shuffled"):
        read(open_recording(path))


@pytest.mark.parametrize("form", ["bag", "mcap"])
def test_equal_times_come_in_the_order_of_the_file(tmp_path, form):
    rows = [row._replace(log_ns=1_700_000_000 * SECOND + i // 50) for i, row in enumerate(rows_of(200))]
    path = (write_bag if form == "bag" else write_mcap)(tmp_path / f"a.{form}", rows)
    assert read(open_recording(path)) == rows
    shuffled = rows[100:] + rows[:100]
    path = (write_bag if form == "bag" else write_mcap)(tmp_path / f"b.{form}", shuffled)
    assert read(open_recording(path)) == rows


@pytest.mark.parametrize("form", ["bag", "mcap", "db3", "unchunked"])
def test_threads_read_on_their_own(tmp_path, form):
    rows = rows_of(300, jitter_ns=SECOND)
    if form == "db3":
        path = write_rosbag2(tmp_path / "a", rows)
    elif form == "unchunked":
        path = write_mcap(tmp_path / "a.mcap", rows, use_chunking=False)
    else:
        path = (write_bag if form == "bag" else write_mcap)(tmp_path / f"a.{form}", rows)
    recording, expected = open_recording(path), in_order(rows)

    def work(i: int) -> bool:
        if i % 2:
            return read(recording) == expected
        first, last = expected[i].log_ns, expected[i + 100].log_ns
        return read(recording, start_ns=first, end_ns=last) == expected[i : i + 100]

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(work, range(16)))
    one, other = recording.packets(), recording.packets()  # by turns
    assert all(a == b for a, b in zip(one, other, strict=True))


def test_connections_that_agree_are_one_topic(tmp_path):
    from mcap.writer import Writer
    from rosbags.rosbag1 import Writer as BagWriter

    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        kinds = [
            writer.register_schema("a/B", "ros1msg", b"int8 x"),
            writer.register_schema("a/C", "ros1msg", b""),
        ]
        ids = [writer.register_channel("/t", "ros1", kind) for kind in (kinds[0], kinds[0], kinds[1])]
        ids.append(writer.register_channel("/t", "json", 0))
        for i, key in enumerate(ids * 2):
            writer.add_message(key, i, bytes([i]), i)
        writer.finish()
    recording = open_recording(tmp_path / "a.mcap")
    found = [(t.name, t.schema.name, t.encoding, t.count) for t in recording.topics]
    assert found == [("/t", "", "json", 2), ("/t", "a/msg/B", "ros1", 4), ("/t", "a/msg/C", "ros1", 2)]
    assert [p.log_ns for p in recording.packets([recording.topics[1]])] == [0, 1, 4, 5]
    with BagWriter(tmp_path / "a.bag") as bag:
        for i, (kind, md5) in enumerate(
            [("a/msg/B", "1" * 32), ("a/msg/B", "1" * 32), ("a/msg/C", "2" * 32)]
        ):
            connection = bag.add_connection("/t", kind, msgdef="int8 x", md5sum=md5, callerid=f"/node{i}")
            bag.write(connection, i, b"x")
    recording = open_recording(tmp_path / "a.bag")
    assert [(t.schema.name, t.count) for t in recording.topics] == [("a/msg/B", 2), ("a/msg/C", 1)]
    assert recording.topics[0].schema.data == b"int8 x"


def test_a_topic_of_another_recording_is_in_no_message(tmp_path):
    recording = open_recording(write_mcap(tmp_path / "a.mcap", rows_of()))
    other = Topic("/other", recording.topics[0].schema, "cdr")
    assert list(recording.packets([other])) == []
    assert list(recording.packets(start_ns=5, end_ns=5)) == []
    assert list(recording.packets(start_ns=-5, end_ns=0)) == []
    recording.close()
    with pytest.raises(ValueError, match="closed"):
        recording.packets()


@pytest.mark.parametrize(
    ("name", "normal"),
    [
        ("sensor_msgs/Image", "sensor_msgs/msg/Image"),
        ("sensor_msgs/msg/Image", "sensor_msgs/msg/Image"),
        ("foxglove.RawImage", "foxglove.RawImage"),
        ("", ""),
        ("/x", "/x"),
        ("x/", "x/"),
    ],
)
def test_normal_type(name, normal):
    assert normal_type(name) == normal


def test_small_things():
    assert [
        stem(n) for n in ("a/b.bag", "b.bag.active", "x/b.db3.zstd", "s3://u/b.mcap", "d/b/", ".bag")
    ] == [
        *["b"] * 5,
        ".bag",
    ]
    for bad in ("", "..", "a/..", "x\\..", "a\0"):
        with pytest.raises(InputError):
            inside("f", bad)
    assert inside("f/", "a/b") == "f/b"
    faults = Faults()
    for i in range(300):
        faults.add(f"line {i}")
        faults.add(f"line {i}")
    assert (len(faults), faults[0], faults[-1]) == (201, "line 0", "and 100 more faults like these")
    assert list(faults)[:2] == faults[:2] == ["line 0", "line 1"]
