"""`fusion blend --rig` as a user meets it: every mode, what it says, what it refuses, and how it resumes."""

from __future__ import annotations

import csv
import os
import tomllib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import tomlkit

from fusion.geometry import PinholeCamera, pose
from fusion.rig import Rig, save_rig
from fusion.rig_warp import DepthWarp, RigWarp
from tests.cli.conftest import Answer
from tests.worlds import read, tree, write, write_pairs

Fusion = Callable[..., Answer]

RGB = PinholeCamera((64, 48), 60, 60, 31, 24, (-0.1, 0.01, 0, 0, 0))
FIR = PinholeCamera((50, 40), 50, 50, 24.5, 19.5, (-0.05, 0, 0, 0))
RIG = Rig({"rgb": RGB, "fir": FIR}, {"T_rgb_fir": pose(np.eye(3), (0.08, 0.01, 0))})


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """rgb/ and fir/ of three pairs, depth/ of a wall at 2 m with a panel at 0.8 m, rig.toml; we are there."""
    write_pairs(tmp_path, 3, bits=16, fir_size_wh=FIR.size_wh)
    save_rig(tmp_path / "rig.toml", RIG)
    (tmp_path / "depth").mkdir()
    for k in range(3):
        write(tmp_path / "depth" / f"f{k:03d}.png", (depth_m(k) * 256).astype(np.uint16))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def depth_m(k: int) -> np.ndarray:
    depth = np.full((48, 64), 2, np.float32)
    depth[15:35, 30 + k : 45 + k] = 0.75
    depth[40:, :5] = 0
    return depth


def one_line(answer: Answer, *words: str, code: int = 2) -> None:
    lines = answer.err.strip().splitlines()
    assert answer.code == code, answer
    assert len(lines) == 1, answer.err
    assert lines[0].startswith("fusion: ")
    for word in words:
        assert word in lines[0], lines[0]


def rows(folder: str = "out") -> list[dict[str, str]]:
    with Path(folder, "frames.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def blend(fusion: Fusion, *words: object, out: str = "out") -> Answer:
    return fusion("blend", "rgb", "fir", "-o", out, "--rig", "rig.toml", *words)


@pytest.mark.parametrize(
    ("words", "mode", "metres"), [((), "infinity", None), (("--distance", 2), "distance", 2.0)]
)
def test_a_fixed_warp_masks_what_the_rig_says_and_tells_the_parallax(
    fusion: Fusion, world: Path, words: tuple, mode: str, metres: float | None
) -> None:
    answer = blend(fusion, *words, "--window", 7000, 7400, "--window-unit", "counts")
    assert answer.code == 0, answer.err
    warp = RigWarp.fixed(RIG, FIR.size_wh, RGB.size_wh, mode, metres)  # type: ignore[arg-type]
    assert np.array_equal(read(world / "out/mask/f000.png"), warp.mask)
    fused, rgb = read(world / "out/fused/f000.png"), read(world / "rgb/f000.png")
    assert np.array_equal(fused[warp.mask == 0], rgb[warp.mask == 0])
    assert (fused != rgb).any(axis=-1)[warp.mask > 0].mean() > 0.9
    run = tomllib.loads((world / "out/run.toml").read_text())
    assert run["config"]["warp"].get("mode") == mode
    assert "rig" not in run["config"]["warp"]  # known by its numbers
    assert run["registration"]["kind"] == "rig"
    assert run["registration"]["cameras"]["fir"]["fx"] == 50
    assert run["registration"]["T_rgb_fir"] == RIG.pose("rgb", "fir").tolist()
    assert run["registration"]["crop_xywh"] == list(warp.crop_xywh)
    assert str(world) not in (world / "out/run.toml").read_text()
    said = {"infinity": "infinity", "distance": "2 m"}[mode]
    assert f"registration  rig, {said}\n" in answer.out
    # f b / z: 60 px x 0.0806 m
    at_one = 60 * np.hypot(0.08, 0.01) * abs(1 - (0 if metres is None else 1 / metres))
    (line,) = (line for line in answer.out.splitlines() if line.endswith("for things at 1 m"))
    assert float(line.removeprefix("parallax").split()[0]) == pytest.approx(at_one, rel=0.1)
    assert "0.0 px for things at " + said in answer.out


def test_by_depth_each_frame_has_a_mask_of_its_own(fusion: Fusion, world: Path) -> None:
    answer = blend(fusion, "--depth", "depth", "--workers", 2, "--preview")
    assert answer.code == 0, answer.err
    assert "rig, by depth, nothing where there is none" in answer.out
    assert "parallax" not in answer.out
    warp, hidden, unknown = DepthWarp(RIG, FIR.size_wh, RGB.size_wh), 0, 0
    for k, row in enumerate(rows()):
        by_depth = warp.apply(np.zeros((40, 50), np.uint8), depth_m(k))
        assert np.array_equal(read(world / f"out/mask/f{k:03d}.png"), by_depth.mask)
        assert float(row["coverage"]) == pytest.approx(np.mean(by_depth.mask > 0), abs=1e-6)
        hidden, unknown = hidden + by_depth.hidden, unknown + by_depth.unknown
    assert hidden > 100
    total = 3 * 64 * 48
    assert f"{hidden / total:.1%} hidden from thermal, {unknown / total:.1%} without depth" in answer.out
    assert "of 3 frames made now" in answer.out  # those of the preview are not
    run = tomllib.loads((world / "out/run.toml").read_text())
    assert run["registration"]["value"] == "depth"
    assert run["inputs"]["depth_maps"] == 3


def test_any_number_of_workers_gives_the_same_bytes(fusion: Fusion, world: Path) -> None:
    for out, workers in (("one", 1), ("four", 4)):
        assert blend(fusion, "--depth", "depth", "--undistort", "--workers", workers, out=out).code == 0
    assert tree(world / "one") == tree(world / "four")


@pytest.mark.parametrize("outside", ["crop", "fill"])
def test_crop_and_fill_by_depth(fusion: Fusion, world: Path, outside: str) -> None:
    more = ("--fill-bgr", 1, 2, 3) if outside == "fill" else ()
    assert blend(fusion, "--depth", "depth", "--outside", outside, *more).code == 0
    fused, rgb, mask = (read(world / p) for p in ("out/fused/f000.png", "rgb/f000.png", "out/mask/f000.png"))
    warp = DepthWarp(RIG, FIR.size_wh, RGB.size_wh)
    truly = warp.apply(np.zeros((40, 50), np.uint8), depth_m(0)).mask
    if outside == "fill":
        assert np.array_equal(mask, truly)
        assert (fused[mask == 0] == (1, 2, 3)).all()
        return
    x, y, w, h = warp.crop_xywh
    inside = np.s_[y : y + h, x : x + w]
    assert fused.shape == (h, w, 3)
    assert np.array_equal(mask, truly[inside])
    assert np.array_equal(fused[mask == 0], rgb[inside][mask == 0])


def test_undistorted_frames_are_on_the_pinholes_grid(fusion: Fusion, world: Path) -> None:
    answer = blend(fusion, "--distance", 2, "--undistort")
    assert answer.code == 0, answer.err
    assert "RGB undistorted" in answer.out
    warp = RigWarp.fixed(RIG, FIR.size_wh, RGB.size_wh, "distance", 2.0, undistort=True)
    rgb = read(world / "rgb/f001.png")
    straight, mask = warp.rgb(rgb), read(world / "out/mask/f001.png")
    assert (straight != rgb).any()
    fused = read(world / "out/fused/f001.png")
    assert np.array_equal(fused[mask == 0], straight[mask == 0])
    run = tomllib.loads((world / "out/run.toml").read_text())
    assert run["registration"]["output"]["distortion"] == []


def test_what_has_no_depth_may_be_taken_to_be_at_a_distance(fusion: Fusion, world: Path) -> None:
    (world / "depth/f002.png").unlink()
    answer = blend(fusion, "--depth", "depth", "--distance", 2)
    assert answer.code == 0, answer.err
    assert "taken to be at 2 m" in answer.out
    assert "warning: --depth: 1 of 3 inputs have no image there" in answer.err
    fixed = RigWarp.fixed(RIG, FIR.size_wh, RGB.size_wh, "distance", 2.0)
    assert np.array_equal(read(world / "out/mask/f002.png"), fixed.mask)
    assert [row["flags"] for row in rows()] == ["", "", "depth-missing"]
    assert "depth-missing  1 of 3 frames" in answer.out


def test_a_frame_without_a_map_is_skipped_by_name(fusion: Fusion, world: Path) -> None:
    (world / "depth/f002.png").unlink()
    write(world / "depth/f001.png", np.zeros((24, 32), np.uint16))
    answer = blend(fusion, "--depth", "depth")
    assert answer.code == 0
    assert [row["status"] for row in rows()] == ["fused", "skipped", "skipped"]
    assert rows()[1]["reason"] == "the depth map is 32x24, the RGB camera 64x48"
    assert rows()[2]["reason"] == "no depth map belongs to it"
    strict = blend(fusion, "--depth", "depth", "--strict", out="strict")
    assert strict.code == 1
    assert strict.err.splitlines()[-1].startswith("fusion: f001: the depth map is 32x24")


def test_pictures_that_are_no_depth_are_refused(fusion: Fusion, world: Path) -> None:
    for k in range(3):
        write(world / f"depth/f{k:03d}.png", np.full((48, 64), 9, np.uint8))
    one_line(blend(fusion, "--depth", "depth"), "no frame could be fused", "no depth map", code=1)


def test_finished_means_no_older_than_the_depth_map(fusion: Fusion, world: Path) -> None:
    assert "fused       3" in blend(fusion, "--depth", "depth").out
    assert "and 3 kept from before" in blend(fusion, "--depth", "depth").out
    newer = (world / "out/fused/f001.png").stat().st_mtime_ns + 2_000_000_000
    os.utime(world / "depth/f001.png", ns=(newer, newer))
    assert "fused       1, and 2 kept from before" in blend(fusion, "--depth", "depth").out


def test_another_rig_is_another_run(fusion: Fusion, world: Path) -> None:
    assert blend(fusion).code == 0
    save_rig(world / "moved.toml", RIG)
    (world / "rig.toml").unlink()
    (world / "moved.toml").rename(world / "rig.toml")
    assert blend(fusion).code == 0  # the same numbers in another file
    save_rig(world / "rig.toml", Rig(RIG.cameras, {"T_rgb_fir": pose(np.eye(3), (0.081, 0.01, 0))}))
    answer = blend(fusion)
    assert answer.code != 0
    assert "T_rgb_fir" in answer.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--rig", "rig.toml", "--homography", "H.txt"), "homography and rig exclude each other"),
        (("--rig", "rig.toml", "--points", "p.csv"), "points and rig exclude each other"),
        (("--distance", 5), "--rig FILE"),
        (("--depth", "depth"), "--rig FILE"),
        (("--undistort",), "--rig FILE"),
        (("--warp", "infinity"), "--rig FILE"),
        (("--rig", "rig.toml", "--warp", "distance"), "--distance METRES"),
        (("--rig", "rig.toml", "--warp", "depth"), "--depth FOLDER"),
        (("--rig", "rig.toml", "--warp", "infinity", "--distance", 3), "warp.distance_m means nothing"),
        (("--rig", "rig.toml", "--warp", "distance", "--distance", 3, "--depth", "depth"), "warp.depth"),
        (("--rig", "rig.toml", "--distance", 0), "warp.distance_m"),
        (("--rig", "rig.toml", "--distance", "inf"), "warp.distance_m"),
        (("--rig", "none.toml"), "none.toml"),
    ],
)
def test_contradictions_are_refused_in_one_line(fusion: Fusion, world: Path, words: tuple, said: str) -> None:
    one_line(fusion("blend", "rgb", "fir", "-o", "out", *words), said)
    assert not Path("out").exists()


def test_a_rig_that_does_not_say_enough_or_is_stale(fusion: Fusion, world: Path) -> None:
    save_rig(world / "rig.toml", Rig({"rgb": RGB}, {}))
    one_line(blend(fusion), "rig.toml", "no camera 'fir'", "the rig has rgb")
    save_rig(world / "rig.toml", Rig(RIG.cameras, {}))
    one_line(blend(fusion), "rig.toml", "how rgb stands to fir")
    larger = PinholeCamera((128, 96), 120, 120, 62.5, 48.5)
    save_rig(world / "rig.toml", Rig({"rgb": larger, "fir": FIR}, RIG.transforms))
    one_line(blend(fusion), "rig.toml", "RGB camera has 128x96 pixels, the images 64x48")
    turned = pose(np.diag([-1.0, 1, -1]), (0, 0, 0))
    save_rig(world / "rig.toml", Rig(RIG.cameras, {"T_rgb_fir": turned}))
    one_line(blend(fusion), "share no view", "T_rgb_fir")


def test_frames_of_another_size_midway_are_skipped(fusion: Fusion, world: Path) -> None:
    write(world / "rgb/f001.png", cv2.resize(read(world / "rgb/f001.png"), (32, 24)))
    assert blend(fusion).code == 0
    assert [row["status"] for row in rows()] == ["fused", "skipped", "fused"]


def test_the_output_of_fusion_depth_is_known_by_its_run(fusion: Fusion, world: Path) -> None:
    """The folder itself or its depth/; what the maps hold; and whose camera they were made for."""
    (world / "made").mkdir()
    (world / "depth").rename(world / "made/depth")
    camera = {"kind": "PinholeCamera", "size_wh": [64, 48], "fx": 60.0, "fy": 60.0, "cx": 31.0, "cy": 24.0}
    run = {"value": "range", "camera": {**camera, "distortion": [-0.1, 0.01, 0.0, 0.0, 0.0]}}
    (world / "made/run.toml").write_text(tomlkit.dumps(run))
    answer = blend(fusion, "--depth", "made")
    assert answer.code == 0, answer.err
    assert "rig, by range" in answer.out
    warp = DepthWarp(RIG, FIR.size_wh, RGB.size_wh, value="range")
    by_range = warp.apply(np.zeros((40, 50), np.uint8), depth_m(0))
    assert np.array_equal(read(world / "out/mask/f000.png"), by_range.mask)
    assert blend(fusion, "--depth", "made/depth", out="out").code == 0  # the same run
    run["camera"] = {**camera, "distortion": []}  # type: ignore[dict-item]
    (world / "made/run.toml").write_text(tomlkit.dumps(run))
    one_line(blend(fusion, "--depth", "made"), "another camera than the rig's rgb", "fusion depth", code=1)


def test_a_run_may_not_write_into_its_depth(fusion: Fusion, world: Path) -> None:
    one_line(blend(fusion, "--depth", "depth", out="depth/out"), "inside the input folder", code=1)
    one_line(blend(fusion, "--depth", "rgb/none"), "no such file or folder", code=1)


def test_a_configuration_file_says_the_same(fusion: Fusion, world: Path) -> None:
    (world / "sub").mkdir()
    files = 'rig = "../rig.toml"\ndepth = "../depth"\n'
    text = f'format = "fusion-blend/1"\n[warp]\n{files}mode = "depth"\ndistance_m = 2.0\nundistort = true\n'
    (world / "sub/run.toml").write_text(text)
    assert fusion("blend", "rgb", "fir", "-o", "file", "--config", "sub/run.toml").code == 0
    words = ("--warp", "depth", "--depth", "depth", "--distance", 2, "--undistort")
    assert blend(fusion, *words, out="options").code == 0
    assert tree(world / "file") == tree(world / "options")
