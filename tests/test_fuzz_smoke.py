"""A small part of `make fuzz`, and what its harness must notice: readers broken on purpose."""

from __future__ import annotations

import os
import pickle
import struct
import subprocess
import sys
import zlib
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fusion.errors import FrameError

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "benchmarks"))

fuzz: Any = import_module("fuzz")
fuzz_mutate: Any = import_module("fuzz_mutate")
fuzz_run: Any = import_module("fuzz_run")
READERS: dict[str, Any] = import_module("fuzz_readers").READERS
Reader: Any = import_module("fuzz_readers").Reader
Seed: Any = import_module("fuzz_seeds").Seed
SOUND = b"x" * 32


def _broken(harm: Any) -> Any:
    """A reader that refuses everything, and does harm where the seed is damaged."""

    def read(path: Path, seed: Any) -> str:
        if path.read_bytes() != SOUND:
            harm(path)
        raise FrameError("refused", where=path)

    return read


def _index(_: Path) -> None:
    raise IndexError(1)


def _spin(_: Path) -> None:
    while True:
        pass


def _allocate(_: Path) -> None:
    bytearray(2 << 30)


def _allocate_and_refuse(path: Path) -> None:
    try:
        bytearray(8 << 30)
    except MemoryError:
        raise FrameError("not enough memory", where=path) from None


def _grow(_: Path) -> None:
    b"x" * (300 << 20)


def _crash(_: Path) -> None:
    import ctypes

    ctypes.string_at(0)


def _stuck_in_c(_: Path) -> None:
    """Its own clock cannot stop it: Python does not come to a signal before the sum is done."""
    assert sum(range(10**12))


def _leave(path: Path) -> None:
    (path.parents[1] / "tmp" / "left").write_text("x")
    raise FrameError("refused", where=path)


def _leave_the_folder(path: Path) -> None:
    (path.parent / "../outside").write_text("x")


def _long_words(path: Path) -> None:
    class WordyError(FrameError):
        def __str__(self) -> str:
            return "x\ny"

    raise WordyError("x", where=path)


HARMS: dict[str, tuple[Any, str]] = {
    "index": (_index, "error"),
    "spin": (_spin, "hang"),
    "stuck": (_stuck_in_c, "hang"),
    "allocate": (_allocate, "memory"),
    "refuse": (_allocate_and_refuse, "memory"),
    "grow": (_grow, "memory"),
    "crash": (_crash, "crash"),
    "leave": (_leave, "left behind"),
    "outside": (_leave_the_folder, "left behind"),
    "words": (_long_words, "unclear"),
}
BROKEN = {name: Reader(name, "", _broken(harm), "small", bound_mib=256) for name, (harm, _) in HARMS.items()}


def __getattr__(name: str) -> Any:
    """So that a worker finds its reader by name: ``test_fuzz_smoke:broken_index``."""
    if name.startswith("broken_"):
        return BROKEN[name.removeprefix("broken_")]
    raise AttributeError(name)


def _seeds(folder: Path) -> Path:
    seeds = {"small": [Seed("sound", {"a": SOUND}, "a")]}
    file = folder / "seeds"
    file.write_bytes(pickle.dumps(seeds))
    return file


def test_every_kind_of_harm_is_found(tmp_path: Path) -> None:
    """One input each; the worker that it ends is replaced, and the rest is still done."""
    targets = {name: f"{__name__}:broken_{name}" for name in HARMS}
    task = fuzz_run.Task(1, targets, _seeds(tmp_path), cpu_limit_s=1.5)
    outcomes = list(fuzz_run.run(task, dict.fromkeys(HARMS, 1), tmp_path / "run"))
    found = {(one.reader, one.case): one.kind for one in outcomes if one.case >= 0}
    assert found == {(name, 0): kind for name, (_, kind) in HARMS.items()}


@pytest.mark.parametrize("name", [name for name in READERS if name != "inspect"])
def test_an_input_is_made_again_from_its_number(name: str) -> None:
    text = b'format = "x"\na = 1\n[t]\nb = 2.5\n'
    seeds = {READERS[name].seeds: [Seed("s", {"a.toml": text}, "a.toml")]}
    made = [[fuzz_run.input_of(READERS[name], seeds, 5, case) for case in range(6)] for _ in range(2)]
    assert [(one.name, one.files, repr(one.about)) for one in made[0]] == [
        (one.name, one.files, repr(one.about)) for one in made[1]
    ]
    assert len({repr((one.files, one.about)) for one in made[0]}) > 3


def test_repairs_are_right() -> None:
    """The CRC of a PNG's header is that of its bytes; what is no PNG stays as it is."""
    picture = np.arange(64, dtype=np.uint8).reshape(8, 8)
    data = bytearray(cv2.imencode(".png", picture)[1].tobytes())
    data[29:33] = b"\0\0\0\0"
    repaired = fuzz_mutate.png_repaired(bytes(data))
    assert struct.unpack_from(">I", repaired, 29)[0] == zlib.crc32(repaired[12:29])
    assert fuzz_mutate.png_repaired(b"no picture") == b"no picture"


def test_the_page_says_what_was_found() -> None:
    outcomes = [fuzz_run.Outcome("rows", k, "read", 0.01, 2.0) for k in range(3)]
    outcomes.append(fuzz_run.Outcome("rows", 3, "refused", 0.5, 7.0))
    outcomes.append(fuzz_run.Outcome("rows", 4, "hang", 9.0, 1.0, "words\nthe last"))
    text = fuzz.page(outcomes, {}, 7, 60.0, "real files included")
    assert "| rows | frames.csv | drawn | 5 | 3 | 1 | 1 | 9.00 | 7 | 512 |" in text
    assert "5 inputs, 1 findings, in 1.0 minutes" in text
    assert "- `rows:4` hang: `the last`" in text


def test_a_small_run(tmp_path: Path) -> None:
    """The quicker readers, few inputs, as the command does it: nothing is found, every sound seed is read."""
    names = ("rosbag1", "sqlite", "messages", "settings", "rows", "records", "names")
    page = tmp_path / "fuzz.md"
    command = [sys.executable, "benchmarks/fuzz.py", "--inputs", "150", "--seed", "3", "--workers", "1"]
    command += ["--only", *names]
    command += ["--data", str(tmp_path / "none")]
    done = subprocess.run(
        [*command, "--write", str(page)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env=_environment(),
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [line.split(" | ") for line in page.read_text("utf-8").splitlines() if line.startswith("| ")][2:]
    assert {row[0].removeprefix("| ") for row in rows} == set(names)
    sound = [row[2].split(" of ") for row in rows if row[2] != "drawn"]
    assert len(sound) == len(names) - 1
    assert all(read == there for read, there in sound)
    assert "**no real files**" in page.read_text("utf-8")


def _environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
