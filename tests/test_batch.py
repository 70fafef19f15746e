from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fusion import BlendConfig, FolderSink, FrameError, Fuser, InputError, describe_run, open_pairs, run
from fusion.batch import RunReport, opencv_on_one_thread
from fusion.frames import FusedFrame
from fusion.sinks.index import Row, read_rows
from tests.worlds import read, tree, write, write_pairs


def fuse_to(out: Path, rgb: Path, fir: Path, *, workers: int = 1, **groups: Any) -> RunReport:
    fuser = Fuser(open_pairs(rgb, fir), BlendConfig.of(**groups))
    with FolderSink(out, describe_run(fuser)) as sink:
        return run(fuser, sink, workers=workers)


def test_any_number_of_workers_gives_the_same_bytes(tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 12, bits=16, fir_size_wh=(50, 40))
    for workers in (1, 2, 7):
        fuse_to(
            tmp_path / str(workers),
            rgb,
            fir,
            workers=workers,
            thermal={"window": (2, 98), "window_unit": "percentile", "window_over": "running"},
        )
    assert tree(tmp_path / "1") == tree(tmp_path / "2") == tree(tmp_path / "7")
    assert len(tree(tmp_path / "1")) == 12 + 2


def test_unusable_frames_are_skipped_counted_and_named(tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 6)
    (rgb / "f001.png").write_bytes(b"")
    whole = (fir / "f003.png").read_bytes()
    (fir / "f003.png").write_bytes(whole[: len(whole) // 2])
    report = fuse_to(tmp_path / "out", rgb, fir)
    assert (report.fused, [stem for stem, _ in report.skipped]) == (4, ["f001", "f003"])
    rows = {row.stem: row for row in read_rows(tmp_path / "out/frames.csv", Row)}
    assert [rows[f"f{i:03d}"].status for i in range(6)] == [
        "fused",
        "skipped",
        "fused",
        "skipped",
        "fused",
        "fused",
    ]
    assert rows["f001"].reason
    assert rows["f003"].reason


def test_strict_stops_at_the_first_unusable_frame(tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 4)
    (rgb / "f002.png").write_bytes(b"no picture")
    with pytest.raises(FrameError, match=r"f002\.png"):
        fuse_to(tmp_path / "out", rgb, fir, strict=True)


def test_no_usable_frame_is_an_error(tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 3)
    for path in rgb.iterdir():
        path.write_bytes(b"")
    with pytest.raises(InputError, match="none of 3 pairs"):
        fuse_to(tmp_path / "out", rgb, fir)
    assert not (tmp_path / "out").exists()


def test_a_second_run_redoes_only_what_changed(tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 5)
    fixed: dict[str, Any] = {"thermal": {"window": (0.1, 0.9)}}
    fuse_to(tmp_path / "out", rgb, fir, **fixed)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out/fused").iterdir()}
    assert fuse_to(tmp_path / "out", rgb, fir, **fixed).kept == 5
    write(rgb / "f002.png", np.full((48, 64, 3), 200, np.uint8))
    report = fuse_to(tmp_path / "out", rgb, fir, **fixed)
    assert (report.fused, report.kept) == (1, 4)
    after = {path: path.stat().st_mtime_ns for path in (tmp_path / "out/fused").iterdir()}
    assert [path.stem for path in after if after[path] != before[path]] == ["f002"]
    assert read(tmp_path / "out/fused/f002.png").min() >= round(0.85 * 200)


def test_sizes_that_change_midway(tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 4)
    write(rgb / "f002.png", np.zeros((24, 32, 3), np.uint8))
    write(fir / "f002.png", np.zeros((24, 32), np.uint8))
    fixed: dict[str, Any] = {"thermal": {"window": (0.0, 1.0)}}
    assert (
        fuse_to(tmp_path / "aligned", rgb, fir, **fixed).fused == 4
    )  # each pair is its own grid: nothing is lost
    matrix = tmp_path / "H.txt"
    matrix.write_text("1 0 3\n0 1 2\n0 0 1\n")
    report = fuse_to(tmp_path / "warped", rgb, fir, warp={"homography": str(matrix)}, **fixed)
    assert report.skipped[0][0] == "f002"  # a homography holds for one pair of sizes only
    assert "32x24" in report.skipped[0][1]


def test_opencvs_threads_are_given_back() -> None:
    before = cv2.getNumThreads()
    with opencv_on_one_thread():
        assert cv2.getNumThreads() == 1
    assert cv2.getNumThreads() == before


COMMAND = [sys.executable, "-m", "fusion", "blend"]
ROOT = Path(__file__).parents[1]


def test_a_run_killed_at_any_moment_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    """Killed at several random moments, without a chance to clean up; finished frames are not redone."""
    rgb, fir = write_pairs(tmp_path, 48, rgb_size_wh=(640, 480), fir_size_wh=(320, 240), bits=16)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [*COMMAND, str(rgb), str(fir), "--workers", "2", "-o"]
    subprocess.run([*command, str(tmp_path / "whole")], check=True, env=environment, capture_output=True)
    chance = random.Random(4)
    out = tmp_path / "killed"
    kills = 0
    for _ in range(4):
        process = subprocess.Popen(
            [*command, str(out)], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        target = kills * 8 + chance.randint(1, 8)  # frames on disk, not seconds: a slow machine is no failure
        while process.poll() is None and len(list((out / "fused").glob("*.png"))) < target:
            time.sleep(0.001)
        process.send_signal(signal.SIGKILL)
        kills += process.wait() == -signal.SIGKILL
    assert kills == 4
    journal = read_rows(out / ".partial/journal.csv", Row, header=False)
    finished = {row.stem: (out / f"fused/{row.stem}.png").stat().st_mtime_ns for row in journal}
    assert 0 < len(finished) < 48
    subprocess.run([*command, str(out)], check=True, env=environment, capture_output=True)
    assert tree(out) == tree(tmp_path / "whole")
    assert {stem: (out / f"fused/{stem}.png").stat().st_mtime_ns for stem in finished} == finished


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0 or not shutil.which("mount"), reason="mounting needs root"
)
def test_a_full_disk_is_one_line_and_the_run_goes_on_later(tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 30, rgb_size_wh=(320, 240), fir_size_wh=(320, 240))
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)], capture_output=True
    ).returncode:
        pytest.skip("mounting is not allowed here")
    try:
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        command = [*COMMAND, str(rgb), str(fir), "-o", str(disk / "out")]
        full = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert full.returncode == 1
        assert len(full.stderr.strip().splitlines()) == 1
        assert "No space left" in full.stderr
        assert not list((disk / "out/.partial").glob("*.tmp"))
        subprocess.run(["mount", "-o", "remount,size=20m", str(disk)], check=True)
        again = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert again.returncode == 0
        assert "kept from before" in again.stdout
    finally:
        subprocess.run(["umount", str(disk)], check=True)


class Shelf:
    """A sink that keeps frames in memory: that `run` needs no more than the protocol."""

    def __init__(self) -> None:
        self.frames: list[FusedFrame] = []
        self.rows: list[Row] = []

    def expect(self, stems: Iterable[str]) -> None:
        assert len(set(stems)) == 3

    def finished(self, stem: str, changed_ns: int) -> Row | None:
        assert changed_ns > 0
        return Row(stem, stem, "fused", "", "", "", "0", "1", "0", "0", "1") if stem == "f001" else None

    def write(self, frame: FusedFrame, fir_stem: str) -> Row:
        self.frames.append(frame)
        return Row.fused(frame, fir_stem, 0)

    def record(self, row: Row) -> None:
        self.rows.append(row)


def test_any_sink_will_do(tmp_path: Path) -> None:
    shelf = Shelf()
    report = run(Fuser(open_pairs(*write_pairs(tmp_path, 3))), shelf)
    assert (report.fused, report.kept) == (2, 1)
    assert [frame.stem for frame in shelf.frames] == ["f000", "f002"]
    assert [row.stem for row in shelf.rows] == ["f000", "f001", "f002"]


def test_an_interrupted_run_says_so_and_goes_on(tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 48, rgb_size_wh=(640, 480), fir_size_wh=(320, 240))
    out = tmp_path / "out"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [*COMMAND, str(rgb), str(fir), "--workers", "2", "-o", str(out)]
    process = subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    while process.poll() is None and len(list((out / "fused").glob("*.png"))) < 5:
        time.sleep(0.001)
    process.send_signal(signal.SIGINT)
    said = process.communicate()[1]
    assert process.returncode == 130
    assert "fusion: interrupted; the same command goes on" in said
    assert "Traceback" not in said
    again = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert again.returncode == 0
    assert "kept from before" in again.stdout
