"""A data set of folders through the whole campaign: every frame made as its parts alone would make it."""

from __future__ import annotations

import csv
import io
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fusion.clouds import read_cloud
from fusion.errors import InputError, OutputError, UsageError
from fusion.fusing import FrameFuser
from fusion.lidar.config import DepthConfig
from fusion.lidar.lane import DepthLane
from fusion.manifest import load_manifest
from fusion.preprocess.campaign import Route
from fusion.preprocess.config import PreprocessConfig
from fusion.preprocess.footage import SetFootage
from fusion.preprocess.run import Result, preprocess
from fusion.preprocess.work import PreprocessWork, make_plan
from fusion.rig import load_rig
from tests.preprocess.flights import flight as flight
from tests.preprocess.flights import tree


def settings(flight: Path, **groups: Any) -> PreprocessConfig:
    return PreprocessConfig.of({"fuse": {"warp": {"rig": str(flight / "truth" / "rig.toml")}}, **groups})


def work_of(flight: Path, config: PreprocessConfig, **kwargs: Any) -> PreprocessWork:
    footage = SetFootage(load_manifest("mine"), flight, **kwargs)
    rig = load_rig(str(config.fuse.warp.rig)) if config.fuse.warp.rig else None
    return PreprocessWork(footage, config, make_plan(footage, config), rig)


def rows(out: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO((out / "frames.csv").read_text())))


def picture(path: Path) -> np.ndarray:
    found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert found is not None, path
    return found


@pytest.fixture(scope="module")
def run(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, PreprocessWork, Result]:
    out = tmp_path_factory.mktemp("out") / "run"
    work = work_of(flight, settings(flight, chunk_s=1.0))
    return out, work, preprocess(work, str(out))


def test_every_pair_is_a_frame_or_counted(flight: Path, run: tuple[Path, PreprocessWork, Result]) -> None:
    out, work, result = run
    made = [row for row in rows(out) if row["status"] == "made"]
    pairs = work.footage.pairs  # type: ignore[attr-defined]
    frozen = sum(n for reason, n in result.report.lost.items() if "frozen" in reason)
    assert len(made) == result.made > 10
    assert result.made + frozen == len(pairs)
    assert frozen > 0
    unmatched = sum(n for reason, n in result.report.lost.items() if "frozen" not in reason)
    assert unmatched == len(pairs.pairing.unmatched)
    assert [row["stem"] for row in made] == sorted(path.stem for path in (out / "fused").iterdir())


def test_frozen_frames_are_those_that_truly_repeat(
    flight: Path, run: tuple[Path, PreprocessWork, Result]
) -> None:
    out, work, _ = run
    pairs = work.footage.pairs  # type: ignore[attr-defined]
    stems = [pairs.stems(index) for index in range(len(pairs))]
    pixels = [pairs.read_fir(index).pixels for index in range(len(pairs))]
    repeats = {stems[k][0] for k in range(1, len(stems)) if np.array_equal(pixels[k], pixels[k - 1])}
    assert repeats
    assert {row["stem"] for row in rows(out)} == {rgb for rgb, _ in stems} - repeats


def test_a_frame_is_what_its_parts_make_of_it(flight: Path, run: tuple[Path, PreprocessWork, Result]) -> None:
    out, work, _ = run
    row = next(row for row in rows(out) if row["lidar_stamp_ns"])
    rig, config = load_rig(flight / "truth" / "rig.toml"), work.config
    stems = [work.footage.pairs.stems(k)[0] for k in range(work.footage.positions)]  # type: ignore[attr-defined]
    index = stems.index(row["stem"])
    frames = work.footage.pairs.read(index)  # type: ignore[attr-defined]
    scan = flight / "lidar" / f"{row['lidar_stamp_ns']}.pcd"
    lane = DepthLane(DepthConfig.of(camera={"rig": "rig", "sensor": "rgb"}), rig)
    depth_m = lane.of_cloud(read_cloud(scan)).dense.value_m
    fuser = FrameFuser(config.fuse, work.plan.sizes, rig, None, lane.value)
    window = work.plan.windows.window(index, frames.counts)
    stages = fuser.stages(frames, window, depth_m, with_counts=True)

    def read(kind: str) -> np.ndarray:
        return picture(out / kind / f"{row['stem']}.png")

    np.testing.assert_array_equal(read("fused"), stages.fused.bgr)
    np.testing.assert_array_equal(read("fir"), stages.fir_counts)
    np.testing.assert_array_equal(read("mask"), stages.mask)
    np.testing.assert_allclose(read("depth") / 256, depth_m, atol=1 / 512 + 1e-6)
    with np.load(out / "sparse" / f"{row['stem']}.npz") as sparse:
        assert len(sparse["value_m"]) == int(row["visible"])


def test_clouds_are_the_nearest_in_time(run: tuple[Path, PreprocessWork, Result]) -> None:
    out, _, _ = run
    with_cloud = [row for row in rows(out) if row["lidar_stamp_ns"]]
    assert len(with_cloud) > 10
    assert all(abs(int(row["lidar_dt_ns"])) <= 50_000_000 for row in with_cloud)
    assert len({row["lidar_stamp_ns"] for row in with_cloud}) == len(with_cloud)
    assert all("depth-missing" in row["flags"] for row in rows(out) if not row["lidar_stamp_ns"])


@pytest.mark.parametrize(("workers", "chunk_s"), [(2, 1.0), (3, 0.3)])
def test_frames_depend_on_neither_workers_nor_chunks(
    flight: Path, run: tuple[Path, PreprocessWork, Result], tmp_path: Path, workers: int, chunk_s: float
) -> None:
    preprocess(work_of(flight, settings(flight, chunk_s=chunk_s)), str(tmp_path), route=Route(workers))
    ours, theirs = (
        {
            name: data
            for name, data in tree(folder).items()
            if name.partition("/")[0] not in ("chunks", "run.toml")
        }
        for folder in (tmp_path, run[0])
    )
    assert ours == theirs


def test_a_run_that_is_done_makes_nothing_again(
    flight: Path, run: tuple[Path, PreprocessWork, Result]
) -> None:
    out, work, first = run
    before = {path: path.stat().st_mtime_ns for path in (out / "fused").iterdir()}
    again = preprocess(work, str(out))
    assert again.report.frames_made == 0
    assert again.report.kept == len(work.chunks)
    assert again.made == first.made
    assert {path: path.stat().st_mtime_ns for path in (out / "fused").iterdir()} == before


def test_a_lost_frame_is_made_again(flight: Path, tmp_path: Path) -> None:
    work = work_of(flight, settings(flight, chunk_s=1.0))
    preprocess(work, str(tmp_path))
    victim = sorted((tmp_path / "fused").iterdir())[3]
    whole = tree(tmp_path)
    victim.unlink()
    result = preprocess(work, str(tmp_path))
    assert result.report.done == 1
    now = tree(tmp_path)
    assert {k: v for k, v in now.items() if "chunks/" not in k} == {
        k: v for k, v in whole.items() if "chunks/" not in k
    }


def test_another_run_is_refused_with_the_difference(
    flight: Path, run: tuple[Path, PreprocessWork, Result], tmp_path: Path
) -> None:
    other = work_of(flight, settings(flight, chunk_s=1.0, streams={"keep_frozen": True}), keep_frozen=True)
    with pytest.raises(OutputError, match=r"another run .*keep_frozen was False, is True"):
        preprocess(other, str(run[0]))
    whole = tree(run[0])
    assert tree(run[0]) == whole


def test_overwrite_leaves_nothing_of_the_other_run(flight: Path, tmp_path: Path) -> None:
    preprocess(work_of(flight, settings(flight)), str(tmp_path / "a"))
    jpg = settings(
        flight,
        fuse={
            "warp": {"mode": "infinity", "rig": str(flight / "truth" / "rig.toml")},
            "output": {"format": "jpg"},
        },
    )
    preprocess(work_of(flight, jpg), str(tmp_path / "b"))
    preprocess(work_of(flight, jpg), str(tmp_path / "a"), overwrite=True)
    without_seconds = [
        {name: data for name, data in tree(tmp_path / run).items() if not name.startswith("chunks/")}
        for run in ("a", "b")
    ]
    assert without_seconds[0] == without_seconds[1]


def test_an_unreadable_frame_is_skipped_and_named(flight: Path, tmp_path: Path) -> None:
    copy = tmp_path / "mine"
    shutil.copytree(flight, copy)
    victim = sorted((copy / "rgb").iterdir())[12]
    victim.write_bytes(victim.read_bytes()[:200])
    result = preprocess(work_of(copy, settings(copy)), str(tmp_path / "out"))
    assert [stem for stem, _ in result.skipped] == [victim.stem]
    assert victim.stem not in {path.stem for path in (tmp_path / "out" / "fused").iterdir()}


def test_a_damaged_cloud_costs_the_frame_only_its_depth(flight: Path, tmp_path: Path) -> None:
    copy = tmp_path / "mine"
    shutil.copytree(flight, copy)
    preprocess(work_of(copy, settings(copy)), str(tmp_path / "whole"))
    used = next(row["lidar_stamp_ns"] for row in rows(tmp_path / "whole") if row["lidar_stamp_ns"])
    victim = copy / "lidar" / f"{used}.pcd"
    victim.write_bytes(victim.read_bytes()[:400])
    result = preprocess(work_of(copy, settings(copy)), str(tmp_path / "out"))
    hit = [row for row in rows(tmp_path / "out") if row["reason"]]
    assert len(hit) == result.troubled == 1
    assert not result.skipped
    assert "depth-failed" in hit[0]["flags"]


def test_without_a_rig_depth_is_of_a_virtual_camera(flight: Path, tmp_path: Path) -> None:
    config = PreprocessConfig.of(depth={"camera": {"size_wh": (160, 120)}})
    preprocess(work_of(flight, config), str(tmp_path))
    depth = next((tmp_path / "depth").iterdir())
    assert picture(depth).shape == (120, 160)


@pytest.mark.parametrize(
    ("groups", "words"),
    [
        ({"streams": {"lead": "sonar"}}, "streams.lead"),
        ({"outputs": {"kinds": ["hologram"]}}, "unknown output 'hologram'"),
        ({"outputs": {"kinds": []}}, "outputs.kinds"),
        ({"chunk_s": 0}, "chunk_s"),
        ({"streams": {"begin_s": 3, "end_s": 2}}, "no time range"),
        ({"depth": {"camera": {"rig": "rig.toml"}}}, "given once"),
        ({"fuse": 3}, "no table"),
        ({"colour": True}, "colour"),
    ],
)
def test_settings_that_cannot_hold_are_refused(groups: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        PreprocessConfig.of(groups)


def test_nothing_that_pairs_says_why(flight: Path, tmp_path: Path) -> None:
    copy = tmp_path / "mine"
    shutil.copytree(flight, copy)
    for path in (copy / "fir").iterdir():
        path.rename(path.with_name(f"{int(path.stem) + 10**12}.png"))
    with pytest.raises(InputError, match="do not overlap in time"):
        work_of(copy, settings(copy))
