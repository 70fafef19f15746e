"""`fusion preprocess` as a user meets it: what it says, how it ends, what it leaves on disk."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from fusion.simulate.containers import write_recording
from tests.cli.conftest import Answer
from tests.preprocess.flights import flight as flight

Run = Callable[..., Answer]


def run(fusion: Run, line: str, **names: str) -> Answer:
    return fusion(*(word.format(**names) for word in shlex.split(line)))


@pytest.fixture(scope="module")
def mcap(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(flight, tmp_path_factory.mktemp("mcap") / "one.mcap", "mcap-ros2").path


def test_one_command_from_a_recording_to_everything(
    fusion: Run, flight: Path, mcap: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    line = "preprocess {mcap} -o {out} --rig {rig} --to folder --to mcap --to video --chunk-s 1 --workers 2"
    done = run(fusion, line, mcap=str(mcap), out=str(out), rig=str(flight / "truth" / "rig.toml"))
    assert done.code == 0, done.err
    assert "fir: /thermal/image, named thermal, 16 bit (mono16)" in done.out
    assert "frozen: repeats the frame before" in done.out
    kinds = {"fused", "mask", "fir", "depth", "support", "sparse", "chunks"}
    files = {"frames.csv", "lost.csv", "run.toml", "fused.mcap", "fused.mp4"}
    assert {path.name for path in out.iterdir()} == kinds | files
    again = run(fusion, line, mcap=str(mcap), out=str(out), rig=str(flight / "truth" / "rig.toml"))
    assert again.code == 0, again.err
    assert "0 done, " in again.out


def test_a_data_set_brings_its_own_rig(fusion: Run, flight: Path, tmp_path: Path) -> None:
    done = run(fusion, "preprocess mine {flight} -o {out}", flight=str(flight), out=str(tmp_path / "out"))
    assert done.code == 0, done.err
    assert "rig, by depth" in done.out
    assert list((tmp_path / "out" / "depth").iterdir())


def test_a_dry_run_leaves_nothing(fusion: Run, mcap: Path, tmp_path: Path) -> None:
    done = run(fusion, "preprocess {mcap} --dry-run", mcap=str(mcap))
    assert done.code == 0, done.err
    assert "recorded 12.0 to 12.0 ms after its stamp" in done.out
    assert "registration" in done.out
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("line", "code", "words"),
    [
        ("preprocess {mcap}", 2, "no output"),
        ("preprocess nothing.mcap -o out", 1, "no such recording"),
        ("preprocess {folder} -o out", 1, "is no recording"),
        ("preprocess {mcap} -o out --fir /nope", 2, "no topic /nope"),
        ("preprocess {mcap} -o out --to hologram", 2, "unknown output 'hologram'"),
        ("preprocess {mcap} -o out --begin 900", 1, "no messages in that time range"),
        ("preprocess {mcap} -o out --begin 2 --end 1", 2, "no time range"),
        ("preprocess {mcap} -o out --rig nothing.toml", 2, "nothing.toml"),
        ("preprocess {mcap} -o out --cluster local --scheduler tcp://x:1", 2, "exclude each other"),
        ("preprocess {mcap} -o out --workers 0", 2, "--workers"),
        ("preprocess unheard-of {folder} -o out", 2, "no data set is called"),
        ("preprocess {mcap} -o out --tolerance-ms 0.0001", 1, "nothing belongs together"),
    ],
)
def test_bad_input_is_one_clear_line(
    fusion: Run, mcap: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str, code: int, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    done = run(fusion, line, mcap=str(mcap), folder=str(tmp_path / "folder"))
    assert done.code == code, done.err
    assert words in done.err
    assert len(done.err.strip().splitlines()) == 1, done.err
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_a_set_that_is_not_registered_is_refused_with_the_way_out(
    fusion: Run, flight: Path, tmp_path: Path
) -> None:
    bare = tmp_path / "bare"
    shutil.copytree(flight, bare)
    (bare / "truth" / "rig.toml").unlink()
    done = run(fusion, "preprocess mine {bare} -o {out}", bare=str(bare), out=str(tmp_path / "out"))
    assert done.code == 1
    assert "not registered" in done.err
    assert "--rig FILE" in done.err
    assert not (tmp_path / "out").exists()


def test_a_truncated_recording_gives_what_is_whole_and_says_where_it_ends(
    fusion: Run, flight: Path, mcap: Path, tmp_path: Path
) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(mcap.read_bytes()[: mcap.stat().st_size * 2 // 3])
    out = tmp_path / "out"
    done = run(
        fusion,
        "preprocess {cut} -o {out} --rig {rig}",
        cut=str(cut),
        out=str(out),
        rig=str(flight / "truth" / "rig.toml"),
    )
    assert done.code == 0, done.err
    assert 5 < len(list((out / "fused").iterdir())) < 25
    assert "byte" in done.out + done.err


def test_an_output_inside_the_input_is_refused(fusion: Run, flight: Path) -> None:
    done = run(fusion, "preprocess mine {flight} -o {out}", flight=str(flight), out=str(flight / "fused"))
    assert done.code != 0
    assert "lies inside the input" in done.err


def test_damage_is_told_in_every_run(fusion: Run, flight: Path, mcap: Path, tmp_path: Path) -> None:
    data = bytearray(mcap.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 64] = bytes(64)
    hurt = tmp_path / "hurt.mcap"
    hurt.write_bytes(data)
    out, rig = str(tmp_path / "out"), str(flight / "truth" / "rig.toml")
    done = run(fusion, "preprocess {hurt} -o {out} --rig {rig} --chunk-s 1", hurt=str(hurt), out=out, rig=rig)
    assert done.code == 0, done.err
    assert "CRC" in done.err
    again = run(
        fusion, "preprocess {hurt} -o {out} --rig {rig} --chunk-s 1", hurt=str(hurt), out=out, rig=rig
    )
    assert "CRC" in again.err


MANIFEST = """
format = "fusion-dataset/1"
name = "flights"
title = "Two flights of a simulated mine"
licence = "ours"
citation = "none"
registered = false
registration_note = "Two cameras side by side."

[recording]
files = "*.bag"

[recording.topics]
rgb = "/camera/image/compressed"
fir = "/thermal/image"
lidar = "/lidar/points"
"""


def test_one_bad_recording_does_not_stop_the_others(fusion: Run, flight: Path, tmp_path: Path) -> None:
    (tmp_path / "flights.toml").write_text(MANIFEST)
    root = tmp_path / "root"
    write_recording(flight, root / "good.bag", "rosbag1")
    (root / "bad.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    out, rig = tmp_path / "out", str(flight / "truth" / "rig.toml")
    line = "preprocess {manifest} {root} -o {out} --rig {rig}"
    names = {"manifest": str(tmp_path / "flights.toml"), "root": str(root), "out": str(out), "rig": rig}
    done = run(fusion, line, **names)
    assert done.code == 1
    assert len(list((out / "good" / "fused").iterdir())) > 15
    assert not (out / "bad").exists()
    assert "warning: bad: " in done.err
    assert done.err.splitlines()[-1].startswith("fusion: 1 of 2 recordings have failed")


def test_what_folders_cannot_do_is_not_passed_over(fusion: Run, flight: Path, tmp_path: Path) -> None:
    line = "preprocess mine {flight} -o {out} --begin 1"
    done = run(fusion, line, flight=str(flight), out=str(tmp_path / "out"))
    assert done.code == 2
    assert "streams.begin_s is for recordings" in done.err
    assert not (tmp_path / "out").exists()
