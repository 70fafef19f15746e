"""What `make fuzz` found in the readers of recordings, one case each."""

from __future__ import annotations

import sqlite3
import subprocess
import sys

import pytest

from fusion.errors import InputError
from fusion.recordings import open_recording
from fusion.recordings.files import DamagedError
from fusion.recordings.metadata import parse
from tests.recordings.recorded import read, rows_of, write_rosbag2

ROWS = rows_of(20)


def test_metadata_nested_deeper_than_the_stack_of_a_parser_in_c():
    """It ended the process: a child of our own is asked."""
    code = "from fusion.recordings.metadata import parse\n"
    code += "try: parse('[' * 30_000)\nexcept Exception as error: print(error)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "it is nested more than 32 deep")
    with pytest.raises(DamagedError, match="nested"):
        parse("a: {b: [" * 40)


def test_metadata_whose_words_are_lists_of_lists():
    """Nine times nine times ... references, which only become long as text."""
    lines = ["a0: &a0 [x,x,x,x,x,x,x,x,x]"]
    lines += [f"a{k}: &a{k} [{','.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 12)]
    text = "\n".join([*lines, "relative_file_paths: [a.db3]", "storage_identifier: *a11"])
    with pytest.raises(DamagedError, match="where a word should"):
        parse(text)


def test_a_schema_that_is_no_text(tmp_path):
    """sqlite quotes the bytes in its own error, which Python then cannot decode."""
    path = tmp_path / "b.db3"
    data = (write_rosbag2(tmp_path / "a", ROWS) / "a.db3").read_bytes()
    assert data.count(b"CREATE TABLE messages(") == 1
    path.write_bytes(data.replace(b"CREATE TABLE messages(", b"CREATE TABLE mess\xffges("))
    with pytest.raises(InputError, match="nothing of it can be read"):
        open_recording(path)


def test_an_index_by_time_that_contradicts_itself(tmp_path, monkeypatch):
    """The least time is found, the greatest is not: all rows are looked at."""
    folder = write_rosbag2(tmp_path / "a", ROWS)
    real = sqlite3.connect

    class Halved(sqlite3.Connection):
        def execute(self, query, *values):  # as a b-tree does whose last page is another's
            return super().execute("SELECT NULL" if "max(timestamp)" in query else query, *values)

    monkeypatch.setattr(sqlite3, "connect", lambda *a, **k: real(*a, **k, factory=Halved))
    recording = open_recording(folder / "a.db3")
    assert any("contradicts itself" in line for line in recording.faults)
    assert recording.span_ns == (min(row[1] for row in ROWS), max(row[1] for row in ROWS) + 1)
    assert read(recording) == ROWS
