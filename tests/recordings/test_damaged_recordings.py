"""Truncated, flipped, half-written and hostile recordings: what is whole is read, the rest is said."""

from __future__ import annotations

import shutil
import sqlite3
import struct
import tracemalloc
import zlib
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import IndexType
from rosbags.rosbag1 import Reader

from fusion.errors import InputError
from fusion.recordings import mcap_scan, open_recording, rosbag1_records
from fusion.recordings.unpack import MAX_CHUNK_BYTES
from tests.recordings.recorded import (
    Row,
    in_order,
    read,
    rows_of,
    write_bag,
    write_mcap,
    write_rosbag2,
)

ROWS = rows_of(60)
WRITERS = {
    "bag": lambda folder: write_bag(folder / "a.bag", ROWS),
    "bag lz4": lambda folder: write_bag(folder / "a.bag", ROWS, "lz4"),
    "bag bz2": lambda folder: write_bag(folder / "a.bag", ROWS, "bz2"),
    "mcap": lambda folder: write_mcap(folder / "a.mcap", ROWS, "none"),
    "mcap lz4": lambda folder: write_mcap(folder / "a.mcap", ROWS, "lz4"),
    "mcap zstd": lambda folder: write_mcap(folder / "a.mcap", ROWS, "zstd"),
    "mcap unchunked": lambda folder: write_mcap(folder / "a.mcap", ROWS, use_chunking=False),
    "mcap no index": lambda folder: write_mcap(folder / "a.mcap", ROWS, "zstd", index_types=IndexType.NONE),
    "db3": lambda folder: write_rosbag2(folder / "a", ROWS, version=8) / "a.db3",
    "db3 zstd": lambda folder: write_rosbag2(folder / "a", ROWS, mode="file") / "a.db3.zstd",
}


def attempt(path: Path) -> tuple[list[Row], list[str]]:
    """Rows and faults; of one that is refused no rows, and the one clear line that says why."""
    try:
        recording = open_recording(path)
    except InputError as error:
        return [], [_clear(str(error), path)]
    try:
        return read(recording), list(recording.faults)
    finally:
        recording.close()


def _clear(line: str, path: Path) -> str:
    assert "\n" not in line
    assert path.name in line
    return line


@pytest.mark.parametrize("form", WRITERS)
def test_cut_anywhere_gives_a_beginning_and_says_so(tmp_path, form):
    path = WRITERS[form](tmp_path)
    data, counts = path.read_bytes(), []
    for stop in np.linspace(0, len(data) - 1, 16).astype(int).tolist():
        path.write_bytes(data[:stop])
        rows, faults = attempt(path)
        assert rows == ROWS[: len(rows)], stop
        assert faults
        counts.append(len(rows))
    assert counts == sorted(counts)
    assert counts[0] == 0
    assert counts[-1] == len(ROWS) or "db3" in form
    # What is lost is no more than the last piece: half of the file still gives a good part of its messages.
    lowest = {"db3": 0, "db3 zstd": 0, "bag bz2": 15}.get(form, 20)
    assert counts[11] >= lowest


@pytest.mark.parametrize("form", ["mcap", "bag", "mcap unchunked"])
def test_uncompressed_pieces_are_read_to_the_last_whole_message(tmp_path, form):
    path = WRITERS[form](tmp_path)
    data = path.read_bytes()
    for i in (3, 17, 40):
        end = data.index(ROWS[i].data) + len(ROWS[i].data)
        for cut, count in ((end, i + 1), (end - 1, i)):
            path.write_bytes(data[:cut])
            rows, faults = attempt(path)
            assert rows == ROWS[:count]
            assert any(f"ends at byte {cut}" in line for line in faults)


@pytest.mark.parametrize("form", ["mcap", "mcap lz4", "mcap zstd", "bag", "bag lz4"])
def test_a_bag_being_written_has_its_chunk_open(tmp_path, form):
    """The last chunk is cut in its middle: what of it can be unpacked is read."""
    path = WRITERS[form](tmp_path)
    data = path.read_bytes()
    marks = [
        at for at in range(len(data)) if data.startswith(b"\x06" if "mcap" in form else b"compression=", at)
    ]
    path.write_bytes(data[: len(data) // 2])
    rows, faults = attempt(path)
    assert marks
    assert 10 < len(rows) < 50
    assert len(faults) == 2


@pytest.mark.parametrize("form", ["mcap zstd", "bag lz4"])
def test_a_file_cut_between_the_indexes_of_a_chunk_loses_none_of_its_messages(tmp_path, form):
    """What stands behind a chunk by then is not all that is in it."""
    path = WRITERS[form](tmp_path)
    data = path.read_bytes()
    if path.suffix == ".mcap":
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        chunk = sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset)[3]
        start = chunk.chunk_start_offset + chunk.chunk_length
        stop = start + chunk.message_index_length
    else:
        with Reader(path) as reader:
            places = sorted(reader.chunks.items())
        start, stop = places[3][1].datapos + places[3][1].datasize, places[4][0]
    path.write_bytes(data[:stop])
    expected, _ = attempt(path)
    assert 10 < len(expected) < 50
    for cut in range(start, stop, 7):
        path.write_bytes(data[:cut])
        recording = open_recording(path)
        assert recording.faults
        for topic in recording.topics:  # a chunk that is thought to lack a topic is not read for it
            assert read(recording, [topic]) == [row for row in expected if row.topic == topic.name]


def test_a_bag_whose_recorder_was_killed(tmp_path):
    """ROS 1 writes a chunk's sizes when it is full: until then they are 0, and the bag has no index."""
    path = write_bag(tmp_path / "a.bag.active", ROWS, chunk_bytes=10**6)
    data = bytearray(path.read_bytes())
    head = data.index(b"op=\x05") - 8
    length_at = head + 4 + struct.unpack_from("<I", data, head)[0]
    size_at = data.index(b"size=", head)
    assert head < size_at < length_at
    data[size_at + 5 : size_at + 9] = bytes(4)
    (length,) = struct.unpack_from("<I", data, length_at)
    data[length_at : length_at + 4] = bytes(4)
    place = data.index(b"index_pos=") + 10
    data[place : place + 8] = bytes(8)
    path.write_bytes(data[: length_at + 4 + length - 100])
    rows, faults = attempt(path)
    assert rows == ROWS[: len(rows)]
    assert len(rows) >= len(ROWS) - 2
    assert any("has no index" in line for line in faults)
    assert open_recording(path).name == "a"


@pytest.mark.parametrize("form", WRITERS)
def test_flipped_bits(tmp_path, form):
    """No traceback, no message that was never written, and nothing lost without a word."""
    path = WRITERS[form](tmp_path)
    data = path.read_bytes()
    rng = np.random.default_rng(5)
    checked = "db3" not in form and "bag" not in form and form != "mcap unchunked"
    for at in rng.integers(0, len(data), 25).tolist():
        path.write_bytes(data[:at] + bytes([data[at] ^ (1 << int(rng.integers(8)))]) + data[at + 1 :])
        rows, faults = attempt(path)
        if checked:  # a CRC or a packed stream tells
            names = {row.topic for row in rows}
            assert {row[1:] for row in rows} <= {row[1:] for row in ROWS} or not names <= {
                "/rgb",
                "/fir",
                "/imu",
            }
            assert len(rows) == len(ROWS) or faults, at


def test_a_damaged_chunk_is_left_out_and_named(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", ROWS, "none")
    data = bytearray(path.read_bytes())
    at = data.index(ROWS[20].data)
    data[at + 10] ^= 1
    path.write_bytes(data)
    recording = open_recording(path)
    assert not recording.faults
    rows = read(recording)
    assert rows == [row for row in ROWS if row in rows]
    assert ROWS[20] not in rows
    assert 45 < len(rows) < 60
    (line,) = recording.faults
    assert "CRC" in line
    offset = int(line.split("chunk at byte ")[1].split()[0])
    assert offset < at < offset + 2600
    assert read(recording) == rows
    assert len(recording.faults) == 1  # once, however often it is read


def test_a_damaged_summary_is_not_believed(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", ROWS)
    data = bytearray(path.read_bytes())
    (start,) = struct.unpack_from("<Q", data, len(data) - 28)
    data[start + 40] ^= 4
    path.write_bytes(data)
    rows, faults = attempt(path)
    assert rows == ROWS
    assert any("summary is damaged" in line for line in faults)


def test_zeros_behind_the_data(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", ROWS)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2] + bytes(5000))
    rows, faults = attempt(path)
    assert rows == ROWS[: len(rows)]
    assert 10 < len(rows) < 60
    assert faults


def test_a_damaged_index_of_a_bag_is_not_believed(tmp_path):
    path = write_bag(tmp_path / "a.bag", ROWS)
    data = bytearray(path.read_bytes())
    (place,) = struct.unpack_from("<Q", data, data.index(b"index_pos=") + 10)
    data[place + 20] ^= 255
    path.write_bytes(data)
    rows, faults = attempt(path)
    assert rows == ROWS
    assert faults


def test_encrypted_bags_are_refused(tmp_path):
    path = write_bag(tmp_path / "a.bag", ROWS)
    data = path.read_bytes()
    length, header = struct.unpack_from("<I", data, 13)[0], data[17:]
    field = b"encryptor=rosbag/AesCbcEncryptor"
    header = header[:length] + struct.pack("<I", len(field)) + field + header[length:]
    path.write_bytes(data[:13] + struct.pack("<I", length + 4 + len(field)) + header)
    with pytest.raises(InputError, match="is encrypted with 'rosbag/AesCbcEncryptor'"):
        open_recording(path)


# sqlite3


def test_a_database_cut_in_half(tmp_path):
    rows = rows_of(2000)
    path = write_rosbag2(tmp_path / "a", rows, version=8) / "a.db3"
    data = path.read_bytes()
    for share in (0.3, 0.5, 0.9):
        path.write_bytes(data[: int(len(data) * share)])
        found, faults = attempt(path)
        assert found == rows[: len(found)]
        assert len(found) > 0.5 * share * len(rows)
        assert any("ends at byte" in line for line in faults)


def test_a_database_with_a_bad_page_loses_little(tmp_path):
    rows = rows_of(2000)
    path = write_rosbag2(tmp_path / "a", rows, version=8) / "a.db3"
    data = bytearray(path.read_bytes())
    at = data.index(rows[1000].data) // 4096 * 4096
    data[at : at + 4096] = b"\xff" * 4096
    path.write_bytes(data)
    found, faults = attempt(path)
    assert set(found) < set(rows)
    assert found == in_order(found)
    assert len(found) > 1900
    assert len(found) == len(set(found))
    assert any("damaged" in line for line in faults)


def test_a_database_without_an_index(tmp_path):
    rows = rows_of(jitter_ns=10**9)
    path = write_rosbag2(tmp_path / "a", rows) / "a.db3"
    with sqlite3.connect(path) as db:
        db.execute("DROP INDEX timestamp_idx")
    db.close()
    recording = open_recording(path)
    assert read(recording) == in_order(rows)
    middle = in_order(rows)[30].log_ns
    assert read(recording, start_ns=middle) == in_order(rows)[30:]
    assert read(recording, [recording.topics[0]], end_ns=middle) == [
        row for row in in_order(rows)[:30] if row.topic == recording.topics[0].name
    ]
    assert "no index by time" in recording.faults[0]


@pytest.mark.parametrize("end", ["-wal", "-journal"])
def test_what_a_killed_writer_left_beside_it(tmp_path, end):
    path = write_rosbag2(tmp_path / "a", ROWS[:40]) / "a.db3"
    copy = tmp_path / "b" / "a.db3"
    copy.parent.mkdir()
    db = sqlite3.connect(path, isolation_level=None)
    db.execute(f"PRAGMA journal_mode = {'WAL' if end == '-wal' else 'DELETE'}")
    db.execute("PRAGMA cache_size = 1")
    db.execute("BEGIN")
    for row in ROWS[40:]:
        topic = ["/rgb", "/fir", "/imu"].index(row.topic) + 1
        db.execute("INSERT INTO messages VALUES (NULL, ?, ?, ?)", (topic, row.log_ns, row.data))
    if end == "-wal":
        db.execute("COMMIT")
    shutil.copy(path, copy)
    shutil.copy(f"{path}{end}", f"{copy}{end}")
    db.close()
    before = {file.name: file.read_bytes() for file in copy.parent.iterdir()}
    recording = open_recording(copy)
    assert read(recording) == (ROWS if end == "-wal" else ROWS[:40])
    assert [line for line in recording.faults if f"read with a.db3{end}" in line]
    recording.close()
    assert {file.name: file.read_bytes() for file in copy.parent.iterdir()} == before


def test_databases_that_are_no_recordings(tmp_path):
    path = tmp_path / "a.db3"
    with sqlite3.connect(path) as db:
        db.execute("CREATE TABLE topics (id INTEGER)")
    with pytest.raises(InputError, match="no table 'messages'"):
        open_recording(path)
    with db:  # a view that never ends
        db.execute(
            "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i FROM n)"
            " SELECT * FROM n"
        )
    db.close()
    with pytest.raises(InputError, match="no plain table"):
        open_recording(path)


def test_rows_that_are_no_messages_are_counted(tmp_path):
    path = write_rosbag2(tmp_path / "a", ROWS) / "a.db3"
    with sqlite3.connect(path) as db:
        middle = ROWS[30].log_ns
        values = [(99, middle, b"x"), (1, middle, "text"), (1, -5, b"x"), (1, "soon", b"x")]
        db.executemany("INSERT INTO messages VALUES (NULL, ?, ?, ?)", values)
    db.close()
    recording = open_recording(path)
    assert read(recording) == ROWS
    assert any("2 messages without a possible time" in line for line in recording.faults)
    assert any("2 messages of an unknown topic or without bytes" in line for line in recording.faults)


# Sizes that cannot be


def mcap_chunk(packing: str, packed: bytes, size: int, crc: int = 0) -> bytes:
    body = struct.pack("<QQQI", 0, 2**63, size, crc) + struct.pack("<I", len(packing)) + packing.encode()
    body += struct.pack("<Q", len(packed)) + packed
    return b"\x06" + struct.pack("<Q", len(body)) + body


def mcap_of(*records: bytes) -> bytes:
    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode()

    def record(opcode: int, body: bytes) -> bytes:
        return bytes([opcode]) + struct.pack("<Q", len(body)) + body

    magic = b"\x89MCAP0\r\n"
    head = record(1, text("") + text(""))
    schema = record(3, struct.pack("<H", 1) + text("a/B") + text("ros2msg") + text(""))
    channel = record(4, struct.pack("<HH", 1, 1) + text("/a") + text("cdr") + text(""))
    tail = record(15, bytes(4)) + record(2, bytes(20))
    return magic + head + schema + channel + b"".join(records) + tail + magic


def peak_of(path: Path) -> tuple[int, list[str], int]:
    """Messages, faults, and the most memory that Python took."""
    tracemalloc.start()
    try:
        recording = open_recording(path)
        count = sum(1 for _ in recording.packets())
        return count, list(recording.faults), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


ZEROS = bytes(1 << 22)
ABSURD = {
    "chunk beyond the end": (mcap_chunk("", b"", 0)[:1] + struct.pack("<Q", 2**62), "inside the chunk"),
    "message beyond the end": (b"\x05" + struct.pack("<Q", 2**63), "inside a record"),
    "claims too much": (mcap_chunk("zstd", zstandard.compress(b"abc"), 2**40), "more than the limit"),
    "claims the limit": (
        mcap_chunk("zstd", zstandard.compress(b"abc"), MAX_CHUNK_BYTES),
        "unpacks to 3 bytes",
    ),
    "zstd bomb": (mcap_chunk("zstd", zstandard.compress(ZEROS), 1000), "claims more than 1000"),
    "lz4 bomb": (mcap_chunk("lz4", lz4.frame.compress(ZEROS), 1000), "yields more than 1000"),
    "less than claimed": (mcap_chunk("lz4", lz4.frame.compress(b"abc"), 1000), "unpacks to 3 bytes"),
    "plain of another size": (mcap_chunk("", b"abc", 1000), "unpacks to 3 bytes"),
    "unknown compression": (mcap_chunk("rar", b"abc", 1000), "compression 'rar' is not known"),
    "short message": (mcap_chunk("", b"\x05" + struct.pack("<Q", 3) + b"abc" * 20, 69), "not whole"),
    "record in a chunk": (mcap_chunk("", b"\x05" + struct.pack("<Q", 2**60) + b"abc" * 20, 69), "not whole"),
}


@pytest.mark.parametrize("name", ABSURD)
def test_absurd_sizes_take_no_memory(tmp_path, name):
    data, text = ABSURD[name]
    good = struct.pack("<HIQQ", 1, 0, 5, 5) + b"fine"
    (tmp_path / "a.mcap").write_bytes(mcap_of(b"\x05" + struct.pack("<Q", len(good)) + good, data))
    count, faults, peak = peak_of(tmp_path / "a.mcap")
    assert count == 1
    assert any(text in line for line in faults), faults
    assert peak < 4 << 20


def test_more_records_that_are_no_messages_than_can_be_meant(tmp_path, monkeypatch):
    for module in (mcap_scan, rosbag1_records):
        monkeypatch.setattr(module, "MAX_OTHERS", 50)
    strange = bytes([200]) + bytes(8)
    (tmp_path / "a.mcap").write_bytes(mcap_of(mcap_chunk("", strange * 40, 360)))
    assert peak_of(tmp_path / "a.mcap")[:2] == (0, [])
    good = struct.pack("<HIQQ", 1, 0, 5, 5) + b"fine"
    good = b"\x05" + struct.pack("<Q", len(good)) + good
    for count, found in ((40, 2), (60, 1)):
        body = good + strange * count + good
        (tmp_path / "a.mcap").write_bytes(mcap_of(mcap_chunk("", body, len(body))))
        messages, faults, _ = peak_of(tmp_path / "a.mcap")
        assert (messages, len(faults)) == (found, 2 - found)


def test_crc_of_a_chunk_is_the_unpacked_one(tmp_path):
    good = struct.pack("<HIQQ", 1, 0, 5, 5) + b"fine"
    record = b"\x05" + struct.pack("<Q", len(good)) + good
    for crc, count in ((zlib.crc32(record), 1), (zlib.crc32(record) ^ 1, 0), (0, 1)):
        chunk = mcap_chunk("zstd", zstandard.compress(record), len(record), crc)
        (tmp_path / "a.mcap").write_bytes(mcap_of(chunk))
        assert peak_of(tmp_path / "a.mcap")[0] == count


def test_metadata_that_would_explode(tmp_path):
    folder = write_rosbag2(tmp_path / "a", ROWS)
    text = (folder / "metadata.yaml").read_text()
    for bad, reason in (
        ("a: &a {k: 1}\nb: {<<: [*a, *a]}\n" + text, "tags or merged keys"),
        ("a: !!python/object/apply:os.system ['true']\n" + text, "tags or merged keys"),
        ("[" * 3000 + text, "nested more than"),
        ("a: " + "9" * 5000 + "\n" + text, "no YAML"),
        (text.replace("message_count: 60", "message_count: many"), "malformed"),
        ("", "lacks|no table"),
    ):
        (folder / "metadata.yaml").write_text(bad)
        recording = open_recording(folder)
        assert read(recording) == ROWS
        if bad:
            assert any(reason in line for line in recording.faults), recording.faults
    for version, faults in ((9, 0), (12, 1)):
        (folder / "metadata.yaml").write_text(text.replace("version: 9", f"version: {version}"))
        assert len(open_recording(folder).faults) == faults
    (folder / "metadata.yaml").write_text(text.replace("compression_format: ''", "compression_format: rar"))
    with pytest.raises(InputError, match="packed by 'rar'; known: lz4, zstd"):
        open_recording(folder)


def test_databases_whose_columns_are_computed(tmp_path):
    path = tmp_path / "a.db3"
    with sqlite3.connect(path) as db:
        db.execute("CREATE TABLE topics (id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
        db.execute("CREATE TABLE messages (topic_id, timestamp, data AS (zeroblob(900000000)))")
    db.close()
    with pytest.raises(InputError, match="no plain table"):
        open_recording(path)
