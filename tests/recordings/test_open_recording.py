"""Every form of recording, message by message against the libraries' own readers."""

from __future__ import annotations

import shutil
from pathlib import Path

import fsspec
import lz4.frame
import pytest
import zstandard
from mcap.writer import IndexType

from fusion.errors import InputError
from fusion.recordings import is_recording, open_recording
from fusion.recordings.base import RECORDINGS
from tests.recordings.recorded import (
    TYPES,
    by_library,
    in_order,
    read,
    rows_of,
    write_bag,
    write_mcap,
    write_rosbag2,
)

BAGS = ["", "bz2", "lz4"]
MCAP_OPTIONS = {
    "all": {},
    "unchunked": {"use_chunking": False},
    "no message index": {"index_types": IndexType.CHUNK},
    "no chunk index": {"index_types": IndexType.MESSAGE},
    "no index": {"index_types": IndexType.NONE},
    "no statistics": {"use_statistics": False},
    "no repetition": {"repeat_channels": False, "repeat_schemas": False},
    "no summary": {
        "index_types": IndexType.NONE,
        "use_statistics": False,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_summary_offsets": False,
    },
    "unchunked, no summary": {
        "use_chunking": False,
        "use_statistics": False,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_summary_offsets": False,
    },
    "no CRC": {"enable_crcs": False},
}
JITTERS = [0, 10**9]


def check(path: Path | str, rows, kinds=TYPES) -> None:
    """All messages in order, topics with types and counts, the span; the same by topic and by range."""
    expected = in_order(rows)
    recording = open_recording(path)
    try:
        assert read(recording) == expected
        assert not list(recording.faults)
        assert {topic.name: topic.schema.name for topic in recording.topics} == kinds
        for topic in recording.topics:
            mine = [row for row in expected if row.topic == topic.name]
            assert read(recording, [topic]) == mine
            assert topic.count in (None, len(mine))
        assert recording.span_ns == (expected[0].log_ns, expected[-1].log_ns + 1)
        first, last = expected[len(rows) // 3].log_ns, expected[len(rows) // 2].log_ns
        within = [row for row in expected if first <= row.log_ns < last]
        assert read(recording, start_ns=first, end_ns=last) == within
        assert read(recording, None, last) == [row for row in expected if row.log_ns >= last]
        assert read(recording, [], first) == []
    finally:
        recording.close()


@pytest.mark.parametrize("jitter_ns", JITTERS)
@pytest.mark.parametrize("packing", BAGS)
def test_rosbag1(tmp_path, packing, jitter_ns):
    rows = rows_of(jitter_ns=jitter_ns)
    path = write_bag(tmp_path / "a.bag", rows, packing)
    assert by_library(path) == in_order(rows)
    check(path, rows)
    assert open_recording(path).form == "rosbag1"


@pytest.mark.parametrize("jitter_ns", JITTERS)
@pytest.mark.parametrize("options", MCAP_OPTIONS.values(), ids=MCAP_OPTIONS)
@pytest.mark.parametrize("packing", ["none", "lz4", "zstd"])
def test_mcap(tmp_path, packing, options, jitter_ns):
    rows = rows_of(jitter_ns=jitter_ns)
    path = write_mcap(tmp_path / "a.mcap", rows, packing, **options)
    if "repeat_channels" not in options or "index_types" in options:  # the library needs them repeated
        assert by_library(path) == in_order(rows)
    check(path, rows)
    recording = open_recording(path)
    assert (recording.form, recording.name, list(recording.files)) == ("MCAP", "a", [str(path)])
    assert {topic.encoding for topic in recording.topics} == {"cdr"}
    assert all(topic.schema.form == "ros2msg" and topic.schema.data for topic in recording.topics)


@pytest.mark.parametrize("version", [8, 9])
@pytest.mark.parametrize("mode", ["none", "file", "message", "storage"])
@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_rosbag2(tmp_path, storage, mode, version):
    if (storage, mode) == ("sqlite3", "storage"):
        pytest.skip("sqlite3 has no compression of its own")
    rows = rows_of(jitter_ns=10**9)
    path = write_rosbag2(tmp_path / "flight", rows, storage, mode, version)
    assert by_library(path) == in_order(rows)
    check(path, rows)
    recording = open_recording(path)
    assert recording.form == f"rosbag2 ({'MCAP' if storage == 'mcap' else storage})"
    assert recording.name == "flight"
    assert [topic.count for topic in recording.topics] == [20, 20, 20]
    recording.close()


@pytest.mark.parametrize("mode", ["none", "file", "message"])
def test_a_bare_db3(tmp_path, mode):
    rows = rows_of()
    folder = write_rosbag2(tmp_path / "flight", rows, mode=mode)
    (bare,) = (path for path in folder.iterdir() if ".db3" in path.name)
    check(bare, rows)
    (folder / "metadata.yaml").unlink()  # the .db3 holds a copy
    check(bare, rows)


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("mode", ["none", "file"])
def test_a_folder_without_metadata(tmp_path, storage, mode):
    rows = rows_of()
    folder = write_rosbag2(tmp_path / "flight", rows, storage, mode)
    (folder / "metadata.yaml").unlink()
    recording = open_recording(folder)
    assert read(recording) == rows
    assert [line for line in recording.faults if "no metadata.yaml" in line]
    recording.close()


def test_a_file_packed_with_lz4(tmp_path):
    rows = rows_of()
    folder = write_rosbag2(tmp_path / "flight", rows)
    (bare,) = folder.glob("*.db3")
    (folder / f"{bare.name}.lz4").write_bytes(lz4.frame.compress(bare.read_bytes()))
    bare.unlink()
    check(folder, rows)


def test_a_file_packed_in_two_frames(tmp_path):
    rows = rows_of()
    folder = write_rosbag2(tmp_path / "flight", rows)
    (bare,) = folder.glob("*.db3")
    data = bare.read_bytes()
    halves = [zstandard.compress(data[:5000]), zstandard.compress(data[5000:])]
    (folder / f"{bare.name}.zstd").write_bytes(b"".join(halves))
    bare.unlink()
    check(folder, rows)


def split(folder: Path, rows, storage: str, mode: str, count: int = 4) -> Path:
    """A recording of `count` files that overlap by some messages, with metadata as rosbag2 writes it."""
    import yaml

    folder.mkdir()
    whole = None
    for i in range(count):
        part = write_rosbag2(
            folder / str(i), rows[i::count] if count == 2 else _share(rows, i, count), storage, mode
        )
        text = yaml.safe_load((part / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
        (file,) = (path for path in part.iterdir() if path.name != "metadata.yaml")
        name = f"flight_{i}.{file.name.partition('.')[2]}"
        shutil.move(file, folder / name)
        shutil.rmtree(part)
        text["files"][0]["path"] = name
        if whole is None:
            whole = text | {"relative_file_paths": [name]}
        else:
            whole["relative_file_paths"].append(name)
            whole["files"] += text["files"]
            for mine, other in zip(
                whole["topics_with_message_count"], text["topics_with_message_count"], strict=True
            ):
                mine["message_count"] += other["message_count"]
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": whole}))
    return folder


def _share(rows, i: int, count: int):
    return rows[i * len(rows) // count : (i + 1) * len(rows) // count]


@pytest.mark.parametrize("count", [2, 5])  # two: every other message; five: one after the other
@pytest.mark.parametrize("mode", ["none", "file", "message"])
@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_split_files(tmp_path, storage, mode, count):
    rows = rows_of(jitter_ns=3 * 10**8)
    folder = split(tmp_path / "flight", rows, storage, mode, count)
    assert by_library(folder) == in_order(rows)
    check(folder, rows)
    recording = open_recording(folder)
    assert len(recording.files) == count
    assert len(recording.topics) == 3
    recording.close()


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_missing_split_files_are_named_and_the_rest_is_read(tmp_path, storage):
    rows = rows_of()
    folder = split(tmp_path / "flight", rows, storage, "none", 5)
    end = "db3" if storage == "sqlite3" else "mcap"
    (folder / f"flight_1.{end}").unlink()
    recording = open_recording(folder)
    assert read(recording) == rows[:12] + rows[24:]
    assert list(recording.faults) == [f"{folder}: its file flight_1.{end} is missing"]
    for i in (0, 2, 3, 4):
        (folder / f"flight_{i}.{end}").unlink()
    with pytest.raises(InputError, match=f"none of its files is there: flight_0.{end}, .*flight_4"):
        open_recording(folder)


def test_packed_split_files_are_unpacked_only_when_needed(tmp_path):
    rows = rows_of()
    folder = split(tmp_path / "flight", rows, "mcap", "file", 5)
    for i in (1, 2, 4):
        (folder / f"flight_{i}.mcap.zstd").write_bytes(b"not zstd")
    recording = open_recording(folder)
    assert read(recording, end_ns=rows[12].log_ns) == rows[:12]
    assert read(recording, start_ns=rows[36].log_ns, end_ns=rows[48].log_ns) == rows[36:48]
    assert not recording.faults
    assert read(recording) == rows[:12] + rows[36:48]
    assert len([line for line in recording.faults if "cannot be unpacked" in line]) == 3
    recording.close()


def test_names_in_metadata_never_leave_the_folder(tmp_path):
    rows = rows_of()
    folder = write_rosbag2(tmp_path / "flight", rows)
    secret = write_rosbag2(tmp_path / "secret", rows_of(seed=1))
    text = (folder / "metadata.yaml").read_text()
    for name in (str(secret / "secret.db3"), "../secret/secret.db3", "..\\secret\\secret.db3"):
        (folder / "metadata.yaml").write_text(text.replace("flight.db3", name))
        with pytest.raises(InputError, match=r"none of its files is there: secret\.db3"):
            open_recording(folder)
    (folder / "metadata.yaml").write_text(text.replace("flight.db3", "old/place/flight.db3"))
    assert read(open_recording(folder)) == rows


@pytest.mark.parametrize("form", ["bag", "mcap", "db3", "rosbag2"])
def test_urls(tmp_path, form):
    rows = rows_of()
    if form in ("bag", "mcap"):
        path = (write_bag if form == "bag" else write_mcap)(tmp_path / f"flight.{form}", rows)
    else:
        path = write_rosbag2(tmp_path / "flight", rows)
    memory = fsspec.filesystem("memory")
    root = f"/{tmp_path.name}-{form}"
    memory.put(str(path), f"{root}/{path.name}", recursive=True)
    url = f"memory:/{root}/{path.name}" + ("/flight.db3" if form == "db3" else "")
    try:
        assert is_recording(url)
        check(url, rows)
        with pytest.raises(InputError, match="no such file"):
            open_recording(url + "x")
    finally:
        memory.rm(root, recursive=True)


def test_protocols_that_nobody_knows(tmp_path):
    with pytest.raises(InputError, match="nosuch"):
        open_recording("nosuch://bucket/a.mcap")
    assert not is_recording("nosuch://bucket/a.mcap")


REFUSED = {
    "a.bag": (b"#ROSBAG V1.2\n" + b"x" * 50, "bag of version 1.2"),
    "b.bag": (b"#ROSRECORD V1.1\n" + b"x" * 50, "bag of version 1.1"),
    "c.bag": (b"", "it is empty"),
    "d.bag": (b"PNG", "it begins with b'PNG'"),
    "e.mcap": (b"\x89MCAP1\r\n" + b"x" * 50, "MCAP of version '1'"),
    "f.mcap": (b"\x89MCA", "it begins with"),
    "g.mcap": (b"", "it is empty"),
    "h.db3": (b"", "is no SQLite file"),
    "i.db3": (b"SQLite format 3\0" + b"\0" * 200, "."),
    "j.png": (b"\x89PNG\r\n", "is no recording: it begins with b'.x89PNG"),
    "k.bag": (b"#ROSBAG V2.0\n", "nothing of it can be read: .*ends at byte 13"),
    "l.mcap": (b"\x89MCAP0\r\n", "nothing of it can be read: .*without an end mark"),
    "m.db3.zstd": (b"abc", "cannot be unpacked"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_recording_is_refused_with_what_was_found(tmp_path, name):
    data, text = REFUSED[name]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=text) as error:
        open_recording(tmp_path / name)
    assert name in str(error.value)


def test_folders(tmp_path):
    (tmp_path / "a.png").write_bytes(b"")
    assert not is_recording(tmp_path)
    assert not is_recording(tmp_path / "nothing.bag")
    with pytest.raises(InputError, match="is no recording"):
        open_recording(tmp_path)
    with pytest.raises(InputError, match="no such file"):
        open_recording(tmp_path / "nothing.bag")
    write_mcap(tmp_path / "a.mcap", rows_of())
    assert is_recording(tmp_path)
    (tmp_path / "a.db3").write_bytes(b"")
    with pytest.raises(InputError, match="side by side"):
        open_recording(tmp_path)


def test_the_content_decides_not_the_suffix(tmp_path):
    rows = rows_of()
    path = write_mcap(tmp_path / "a.mcap", rows).rename(tmp_path / "a.bag")
    assert open_recording(path).form == "MCAP"
    assert read(open_recording(path)) == rows
    assert list(RECORDINGS) == ["rosbag1", "rosbag2", "mcap"]


def by_topic(row):
    return row.topic, row.log_ns


def test_real_recordings(shared_data):
    folder = shared_data / "recordings"
    for path in [*folder.glob("*.bag"), *folder.rglob("*.mcap")]:
        assert read(open_recording(path)) == by_library(path), path
    bags = [open_recording(path) for path in sorted(folder.glob("example*.bag"))]
    assert len(bags) >= 2
    first = read(bags[0])
    assert len(first) == 8647
    assert all(read(bag) == first and bag.topics == bags[0].topics for bag in bags)
    names = {topic.name: topic.count for topic in bags[0].topics}
    assert names["/tf"] == 2688
    assert sum(topic.count or 0 for topic in bags[0].topics) == 8647
    empty = open_recording(folder / "no-messages.bag")
    assert (read(empty), empty.span_ns, list(empty.topics), list(empty.faults)) == ([], None, [], [])


def test_real_rosbag2(shared_data):
    geocam = shared_data / "recordings" / "rosbag2_geocam"
    paths = [geocam / name for name in ("test_bag_sqlite3", "test_bag_mcap")]
    ours = [open_recording(path) for path in paths]
    both = [read(recording) for recording in ours]
    assert all(sorted(rows) == sorted(by_library(path)) for rows, path in zip(both, paths, strict=True))
    assert len(both[0]) == len(both[1]) == 188
    assert [(t.name, t.schema.name, t.count) for t in ours[0].topics] == [
        (t.name, t.schema.name, t.count) for t in ours[1].topics
    ]
    # The two were written one after the other: only the stamps inside the messages differ.
    for mine, other in zip(sorted(both[0], key=by_topic), sorted(both[1], key=by_topic), strict=True):
        assert (mine.topic, len(mine.data)) == (other.topic, len(other.data))
        assert sum(a != b for a, b in zip(mine.data, other.data, strict=True)) <= 12
    official = shared_data / "recordings" / "rosbag2_official"
    for name, count in (("wbag", 6074), ("talker", 20)):
        pair = [open_recording(official / storage / name) for storage in ("sqlite3", "mcap")]
        both = [read(recording) for recording in pair]
        assert len(both[0]) == count
        assert sorted(both[0]) == sorted(both[1])
        assert [row.log_ns for row in both[0]] == [row.log_ns for row in both[1]]
        files = (official / "mcap" / name).glob("*.mcap")
        assert sorted(both[0]) == sorted(row for file in files for row in by_library(file))
        assert sum(topic.count or 0 for topic in pair[0].topics) == count
