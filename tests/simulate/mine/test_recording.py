"""A whole recording: names, clocks, freezes, and the same bytes whatever the threads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_worlds import Line, Room, small

from fusion.clouds import read_cloud
from fusion.codecs import decode_image
from fusion.errors import OutputError, UsageError
from fusion.simulate.mine.config import load_mine_config
from fusion.simulate.mine.recording import World, make_mine
from fusion.simulate.mine.truth import Truth

WORLD = World(Room(), Line((1.0, 0, 0), turn=0.4))


def written(folder: Path) -> dict[str, bytes]:
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()
    }


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("mine") / "recording"
    make_mine(out, small(), world=WORLD)
    return out


def test_same_seed_same_bytes_whatever_the_threads(recording: Path, tmp_path: Path) -> None:
    make_mine(tmp_path / "one", small(), world=WORLD, threads=1)
    first, second = written(recording), written(tmp_path / "one")
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []


def test_another_seed_another_noise(recording: Path, tmp_path: Path) -> None:
    make_mine(tmp_path / "other", small(seed=1, truth=False), world=WORLD)
    first, second = written(recording), written(tmp_path / "other")
    pictures = [name for name in second if name.endswith((".jpg", ".pcd"))]
    assert pictures
    assert all(first[name] != second[name] for name in pictures if name in first)
    assert not any("depth" in name for name in second)


def test_everything_is_there_and_counted(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    report = make_mine(
        tmp_path / "r", small(rgb={"file": "png"}), world=WORLD, progress=lambda a, b: seen.append((a, b))
    )
    count = {k: len(list((tmp_path / "r" / k).iterdir())) for k in ("rgb", "fir", "lidar")}
    assert (
        count
        == {"rgb": report.rgb, "fir": report.fir, "lidar": report.lidar}
        == {"rgb": 4, "fir": 8, "lidar": 3}
    )
    truth = {p.name: len(list(p.iterdir())) for p in (tmp_path / "r" / "truth").iterdir() if p.is_dir()}
    assert truth == {"depth_rgb": 4, "depth_fir": 8, "temperature_fir": 8, "flow_rgb": 3, "occluded_rgb": 3}
    assert seen == [(k + 1, 15) for k in range(15)]
    clouds = [read_cloud(p) for p in (tmp_path / "r" / "lidar").iterdir()]
    assert sum(map(len, clouds)) == report.points
    assert {"intensity", "ring", "time_s"} <= set(clouds[0].fields)
    first = min((tmp_path / "r" / "rgb").iterdir())
    assert decode_image(first.read_bytes(), "").shape == (48, 64, 3)


def test_frozen_frames_repeat_their_bytes(recording: Path) -> None:
    truth = Truth(recording)
    assert truth.freezes
    for stamp, shown in truth.freezes.items():
        assert shown < stamp
        assert (recording / f"fir/{stamp}.png").read_bytes() == (recording / f"fir/{shown}.png").read_bytes()
    moving = [s for s in truth.stamps("fir") if s not in truth.freezes]
    assert len({(recording / f"fir/{s}.png").read_bytes() for s in moving}) == len(moving)


def test_names_are_stamps_of_the_own_clocks(recording: Path) -> None:
    truth, config = Truth(recording), load_mine_config(recording / "truth" / "mine.toml")
    assert config == small()
    for sensor, suffix in (("rgb", "jpg"), ("fir", "png"), ("lidar", "pcd")):
        names = sorted(int(p.stem) for p in (recording / sensor).glob(f"*.{suffix}"))
        assert names == truth.stamps(sensor)
        group = {"rgb": config.rgb, "fir": config.thermal, "lidar": config.lidar}[sensor]
        true = np.array([truth.true_s(sensor, s) for s in names])
        offset_ns = round(group.clock.offset_s * 1e9)  # apart: float64 has no nanoseconds beside an epoch
        own = true * (1 + group.clock.drift_ppm * 1e-6) * 1e9
        assert np.abs(own - (np.array(names) - offset_ns)).max() < 1
        assert np.abs(np.diff(names) - 1e9 / group.rate_hz).max() <= 1


def test_used_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="not empty") as caught:
        make_mine(tmp_path, small(), world=WORLD)
    assert "\n" not in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
    with pytest.raises(OutputError):
        make_mine(tmp_path / "notes.txt", small(), world=WORLD)


def test_recording_without_a_frame_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="duration_s"):
        make_mine(tmp_path / "r", small(duration_s=0.05), world=WORLD)
    assert not (tmp_path / "r").exists()


def test_an_error_of_a_worker_ends_the_run(tmp_path: Path) -> None:
    class Broken(Room):
        def cast(self, rays, **options):
            raise OutputError("the disk is full")

    with pytest.raises(OutputError, match="disk is full"):
        make_mine(tmp_path / "r", small(rgb={"shadows": False}), world=World(Broken(), Line()))
