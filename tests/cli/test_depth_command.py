"""`fusion depth` as a user meets it: exact numbers, and every bad input in one clear line."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import binary_erosion

from fusion.sinks.depth import DepthRow
from fusion.sinks.index import read_rows
from tests.cli.conftest import Answer
from tests.cli.test_blend_command import one_line
from tests.worlds import read, tree, write

Fusion = Callable[..., Answer]
Floats = NDArray[np.float64]
W, H = 96, 72
F = W / 2 / math.tan(math.radians(60))
SMALL = ["--size", W, H]
PLAIN = [*SMALL, "--method", "linear", "--visibility", "none"]


def scene(count: int = 900, seed: int = 0) -> Floats:
    """A wall at 6 m with a box in front of it at 3 m, seen from the origin along +x: each ray's first hit."""
    rng = np.random.default_rng(seed)
    across, up = rng.uniform(-2, 2, count), rng.uniform(-1.1, 1.1, count)
    box = (np.abs(across) < 0.3) & (np.abs(up) < 0.25)
    return np.where(box, 3.0, 6.0)[:, None] * np.stack([np.ones(count), -across, -up], -1)


def pixels(xyz: Floats) -> tuple[Floats, Floats]:
    """Columns and rows in the virtual camera, x forward to z, y left to -x, z up to -y."""
    return -F * xyz[:, 1] / xyz[:, 0] + (W - 1) / 2, -F * xyz[:, 2] / xyz[:, 0] + (H - 1) / 2


def write_clouds(folder: Path, count: int, points: int = 900) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(count):
        np.save(folder / f"c{k:02d}.npy", scene(points, seed=k))
    return folder


def write_sparse(folder: Path, count: int = 1, size_wh: tuple[int, int] = (W, H)) -> Path:
    """Sparse depth PNGs of a slanted wall, a tenth of the pixels."""
    folder.mkdir(parents=True, exist_ok=True)
    v, u = np.mgrid[: size_wh[1], : size_wh[0]]
    for k in range(count):
        known = np.random.default_rng(k).random(u.shape) < 0.1
        write(folder / f"c{k:02d}.png", np.where(known, 256 * (2 + u * 0.05 + v * 0.02), 0).astype(np.uint16))
    return folder


# --- numbers


def test_range_linear_equals_an_independent_twin(fusion: Fusion, tmp_path: Path) -> None:
    """The list (r, c, d) exactly, and the map to half a step of the file, against SciPy."""
    xyz = scene()
    np.save(tmp_path / "a.npy", xyz)
    out = tmp_path / "out"
    answer = fusion("depth", tmp_path / "a.npy", "-o", out, *PLAIN, "--value", "range", "--max-gap", 1000)
    assert answer.code == 0, answer.err
    u, v = pixels(xyz)
    d = np.sqrt((xyz**2).sum(1))
    seen = (u >= -0.5) & (u < W - 0.5) & (v >= -0.5) & (v < H - 0.5)
    assert 100 < seen.sum() < len(xyz)
    with np.load(out / "sparse/a.npz") as npz:
        assert npz["row"].dtype == npz["col"].dtype == np.float64
        np.testing.assert_array_equal(npz["index"], np.flatnonzero(seen))
        np.testing.assert_allclose(npz["col"], u[seen], rtol=0, atol=1e-11)
        np.testing.assert_allclose(npz["row"], v[seen], rtol=0, atol=1e-11)
        np.testing.assert_array_equal(npz["value_m"], d[seen].astype(np.float32))
        assert (str(npz["value"]), npz["size_wh"].tolist()) == ("range", [W, H])
    twin = LinearNDInterpolator(np.stack([u, v], -1)[seen], d[seen])
    rows, columns = np.mgrid[:H, :W]
    exact = twin(columns, rows)
    counts = read(out / "depth/a.png")
    filled = counts > 0
    inside = ~np.isnan(exact)
    assert not (filled & ~inside).any()
    assert filled[binary_erosion(inside)].all()
    assert np.abs(counts[filled] - 256 * exact[filled]).max() <= 0.5 + 1e-3
    np.testing.assert_array_equal(read(out / "support/a.png") > 0, filled)
    row = read_rows(out / "frames.csv", DepthRow)[0]
    assert int(row.covered) == filled.sum()
    assert (row.read, row.in_front, row.in_frame) == ("900", "900", str(seen.sum()))
    assert float(row.most_m) == pytest.approx(np.nanmax(exact[filled]), abs=6e-4)


def test_the_thesis_preset_is_that_with_linear_extrapolation(fusion: Fusion, tmp_path: Path) -> None:
    """METHOD section 2: a range that is affine over the picture comes back affine, beyond the samples too."""
    rng = np.random.default_rng(2)
    u, v = rng.uniform(20, 70, 300), rng.uniform(15, 50, 300)
    d = 3 + 0.03 * u + 0.05 * v
    ray = np.stack([np.ones(300), -(u - (W - 1) / 2) / F, -(v - (H - 1) / 2) / F], -1)
    np.save(tmp_path / "a.npy", ray * (d / np.linalg.norm(ray, axis=1))[:, None])
    assert fusion("depth", tmp_path / "a.npy", "-o", tmp_path / "t", *SMALL, "--preset", "thesis").code == 0
    rows, columns = np.mgrid[:H, :W]
    exact = 256 * (3 + 0.03 * columns + 0.05 * rows)
    assert np.abs(read(tmp_path / "t/depth/a.png") - exact).max() <= 0.5 + 0.01
    support = read(tmp_path / "t/support/a.png") > 0
    assert not support[:14].any()
    assert not support[:, :19].any()
    assert support[20:45, 25:65].all()
    options = [*PLAIN, "--value", "range", "--extrapolate", "linear", "--max-gap", 1e5]
    assert fusion("depth", tmp_path / "a.npy", "-o", tmp_path / "o", *options).code == 0
    assert read(tmp_path / "t/depth/a.png").tobytes() == read(tmp_path / "o/depth/a.png").tobytes()


def test_depth_of_a_wall_is_its_distance_by_every_method(fusion: Fusion, tmp_path: Path) -> None:
    xyz = scene()
    np.save(tmp_path / "a.npy", xyz[xyz[:, 0] > 5])
    for method in ("plane", "natural", "natural-discrete", "linear", "nearest", "scan"):
        out = tmp_path / method
        options = [*SMALL, "--visibility", "none", "--method", method]
        assert fusion("depth", tmp_path / "a.npy", "-o", out, *options).code == 0, method
        counts = read(out / "depth/a.png")
        assert (np.abs(counts[counts > 0].astype(int) - 6 * 256) <= 1).all(), method
        assert (counts > 0).mean() > 0.1, method


# --- what is written and said


def test_files_index_and_closing_table(fusion: Fusion, tmp_path: Path) -> None:
    clouds, out = write_clouds(tmp_path / "in", 3), tmp_path / "out"
    (clouds / "notes.txt").write_text("x")
    bad = scene(50)
    bad[:20] = np.nan
    bad[20:25] = 0
    np.save(clouds / "c01.npy", bad)
    answer = fusion("depth", clouds, "-o", out, *PLAIN)
    assert (answer.code, answer.err) == (0, "")
    assert sorted(tree(out)) == sorted(
        [f"{kind}/c{k:02d}.{suffix}" for k in range(3) for kind, suffix in
         (("depth", "png"), ("support", "png"), ("picture", "png"), ("sparse", "npz"))]
        + ["frames.csv", "run.toml"]
    )  # fmt: skip
    said = " ".join(answer.out.split())
    for words in ("3, and 1 other files ignored", "points read 1850", "finite 1825 (98.6%)",
                  "dropped: nan 20", "dropped: zero 5", "pinhole, 120 degrees, 96x72"):  # fmt: skip
        assert words in said
    run = tomllib.loads((out / "run.toml").read_text())
    assert run["config"]["dense"]["method"] == "linear"
    assert run["camera"]["fx"] == pytest.approx(F)
    assert str(tmp_path) not in (out / "run.toml").read_text() + (out / "frames.csv").read_text()
    assert read(out / "picture/c00.png").shape[0] == 120


def test_any_number_of_workers_gives_the_same_bytes(fusion: Fusion, tmp_path: Path) -> None:
    clouds = write_clouds(tmp_path / "in", 5)
    for workers in (1, 2, 3):
        answer = fusion("depth", clouds, "-o", tmp_path / str(workers), *SMALL, "--workers", workers)
        assert answer.code == 0, answer.err
        one = [clouds / "c00.npy", "-o", tmp_path / f"one{workers}", *SMALL, "--workers", workers]
        assert fusion("depth", *one, "--method", "natural", "--quiet").out == ""
    assert tree(tmp_path / "1") == tree(tmp_path / "2") == tree(tmp_path / "3")
    assert tree(tmp_path / "one1") == tree(tmp_path / "one2") == tree(tmp_path / "one3")


def test_a_second_run_redoes_only_what_changed(fusion: Fusion, tmp_path: Path) -> None:
    clouds, out = write_clouds(tmp_path / "in", 3), tmp_path / "out"
    fusion("depth", clouds, "-o", out, *PLAIN)
    before = {path: path.stat().st_mtime_ns for path in (out / "depth").iterdir()}
    assert "0, and 3 kept from before" in fusion("depth", clouds, "-o", out, *PLAIN).out
    np.save(clouds / "c01.npy", scene(seed=9) * 1.5)
    answer = fusion("depth", clouds, "-o", out, *PLAIN)
    assert "1, and 2 kept from before" in answer.out
    assert "points read 2700" in " ".join(answer.out.split())  # the kept ones are counted as well
    changed = [path.stem for path in before if path.stat().st_mtime_ns != before[path]]
    assert changed == ["c01"]
    assert read(out / "depth/c01.png").max() == 9 * 256


def test_unusable_clouds_are_skipped_counted_and_named(fusion: Fusion, tmp_path: Path) -> None:
    clouds, out = write_clouds(tmp_path / "in", 4), tmp_path / "out"
    (clouds / "c01.npy").write_bytes(b"junk")
    np.save(clouds / "c02.npy", np.full((9, 3), np.nan))
    answer = fusion("depth", clouds, "-o", out, *PLAIN)
    assert answer.code == 0
    assert [line.split(":")[2] for line in answer.err.splitlines()] == [" skipped c01", " skipped c02"]
    rows = {row.stem: row for row in read_rows(out / "frames.csv", DepthRow)}
    assert [rows[f"c{k:02d}"].status for k in range(4)] == ["made", "skipped", "skipped", "made"]
    assert "invalid" in rows["c02"].reason
    one_line(fusion("depth", clouds, "-o", tmp_path / "s", *PLAIN, "--strict", "--workers", 1), "c01.npy")


def test_another_run_is_refused_untouched_unless_overwritten(fusion: Fusion, tmp_path: Path) -> None:
    clouds, out = write_clouds(tmp_path / "in", 2), tmp_path / "out"
    fusion("depth", clouds, "-o", out, *PLAIN)
    before = tree(out)
    one_line(fusion("depth", clouds, "-o", out, *PLAIN, "--fov", 90), "another run", "--overwrite", code=1)
    assert tree(out) == before
    for wrong in (
        ["--colormap", "rainbwo"],
        ["--form", "obj"],
        ["--method", "guided"],
        ["--score", "missing"],
    ):
        one_line(fusion("depth", clouds, "-o", out, *SMALL, *wrong, "--overwrite"))
        assert tree(out) == before  # nothing is deleted for the sake of a run that cannot be
    (out / "depth/mine.png").write_bytes(b"precious")
    assert fusion("depth", clouds, "-o", out, *PLAIN, "--fov", 90, "--overwrite").code == 0
    assert tree(out)["depth/mine.png"] == b"precious"
    assert tree(out)["depth/c00.png"] != before["depth/c00.png"]


def test_an_interrupted_run_says_so_and_goes_on_to_the_same_bytes(fusion: Fusion, tmp_path: Path) -> None:
    clouds, out = write_clouds(tmp_path / "in", 60), tmp_path / "out"
    options = [*PLAIN, "--workers", 2]
    command = [sys.executable, "-m", "fusion", "depth", clouds, "-o", out, *options]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    process = subprocess.Popen(
        [*map(str, command)], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    while process.poll() is None and len(list((out / "depth").glob("*.png"))) < 5:
        time.sleep(0.001)
    process.send_signal(signal.SIGINT)
    said = process.communicate()[1]
    assert process.returncode == 130
    assert said.splitlines() == ["fusion: interrupted; the same command goes on where this one stopped"]
    assert not (out / "frames.csv").exists()
    again = fusion("depth", clouds, "-o", out, *options)
    assert "kept from before" in again.out
    fusion("depth", clouds, "-o", tmp_path / "whole", *options)
    assert tree(out) == tree(tmp_path / "whole")


def test_files_folders_and_patterns_together_and_names_of_all_kinds(fusion: Fusion, tmp_path: Path) -> None:
    folder, top = write_clouds(tmp_path / "in", 1), tmp_path / "top"
    (top / "other").mkdir(parents=True)
    for name in ("a.b.c.npy", "два слова.npy", "鉱山 1.npy", "-o.npy", "c00.npy"):
        np.save(top / "other" / name, scene())
    np.save(tmp_path / "single.npy", scene())
    out = tmp_path / "out dir"
    answer = fusion("depth", folder, tmp_path / "single.npy", top / "*/[!c]*.npy", "-o", out, *PLAIN)
    assert answer.code == 0, answer.err
    found = {p.relative_to(out / "depth").as_posix() for p in (out / "depth").rglob("*.png")}
    assert found == {"c00.png", "single.png", "other/a.b.c.png", "other/два слова.png", "other/鉱山 1.png",
                     "other/-o.png"}  # fmt: skip


def test_a_configuration_file_equals_its_options(fusion: Fusion, tmp_path: Path) -> None:
    cloud = write_clouds(tmp_path / "in", 1)
    path = tmp_path / "c.toml"
    path.write_text(
        f'format = "fusion-depth/1"\n[camera]\nsize_wh = [{W}, {H}]\nlook_deg = [10, 0, 0]\n'
        '[samples]\nvisibility = "none"\n[dense]\nmethod = "nearest"\n'
    )
    assert fusion("depth", cloud, "-o", tmp_path / "a", "--config", path, "--method", "linear").code == 0
    assert fusion("depth", cloud, "-o", tmp_path / "b", *PLAIN, "--look", 10, 0, 0).code == 0
    assert tree(tmp_path / "a") == tree(tmp_path / "b")


# --- sparse pictures, guide, truth, overlay


def test_sparse_pictures_guided_and_scored(fusion: Fusion, tmp_path: Path) -> None:
    sparse = write_sparse(tmp_path / "sparse", 2)
    v, u = np.mgrid[:H, :W]
    truth = 256 * (2 + u * 0.05 + v * 0.02)
    for k, more in ((0, 0), (1, 256)):
        (tmp_path / "truth").mkdir(exist_ok=True)
        write(tmp_path / f"truth/c{k:02d}.png", (truth + more).astype(np.uint16))
        (tmp_path / "rgb").mkdir(exist_ok=True)
        write(tmp_path / f"rgb/c{k:02d}.png", np.full((H, W, 3), 90, np.uint8))
    options = ["--sparse", sparse, "--visibility", "none", "--score", tmp_path / "truth"]
    answer = fusion("depth", *options, "--method", "linear", "-o", tmp_path / "out")
    assert answer.code == 0, answer.err
    assert "that of the pictures" in answer.out
    table = {line.split()[0]: line.split()[1:] for line in answer.out.splitlines()[-4:]}
    assert list(table) == ["map", "c00", "c01", "mean"]
    assert float(table["c00"][1]) < 4  # mm; the file's steps are 3.9
    assert float(table["c01"][0]) == pytest.approx(1000, abs=4)
    assert float(table["mean"][0]) == pytest.approx(
        (float(table["c00"][0]) + float(table["c01"][0])) / 2, abs=0.01
    )
    covered = (read(tmp_path / "out/depth/c00.png") > 0).mean()
    assert table["c00"][-1] == f"{covered:.2%}"
    again = fusion("depth", *options, "--method", "linear", "-o", tmp_path / "out")
    assert again.out.splitlines()[-4:] == answer.out.splitlines()[-4:]  # kept maps are scored as well
    alone = fusion("depth", *options, "--method", "linear", "--quiet")
    assert alone.out.splitlines() == answer.out.splitlines()[-4:]
    guided = fusion(
        "depth", *options, "--guide", tmp_path / "rgb", "--method", "guided", "-o", tmp_path / "g"
    )
    assert guided.code == 0, guided.err
    assert (read(tmp_path / "g/depth/c00.png") > 0).mean() > 0.8


def test_a_truth_that_cannot_be_used_costs_the_score_not_the_map(fusion: Fusion, tmp_path: Path) -> None:
    sparse = write_sparse(tmp_path / "sparse", 5)
    truth = write_sparse(tmp_path / "truth", 5)
    write(truth / "c01.png", np.full((H, W), 9, np.uint8))
    write(truth / "c02.png", np.full((H, W + 2), 900, np.uint16))
    write(truth / "c03.png", np.zeros((H, W), np.uint16))
    (truth / "c04.png").unlink()
    options = ["--sparse", sparse, "--visibility", "none", "--method", "linear", "--score", truth]
    for _ in range(2):  # made, then kept
        answer = fusion("depth", *options, "-o", tmp_path / "out")
        assert answer.code == 0
        for words in (
            "1 of 5 inputs have no image",
            "c01 is not scored: an 8-bit picture",
            "c02 is not scored: the truth is 98x72, the map 96x72",
            "c03 is not scored",
        ):
            assert words in answer.err
        assert len(answer.err.splitlines()) == 4
        assert "c00" in answer.out
        assert len(list((tmp_path / "out/depth").iterdir())) == 5
    (truth / "c00.png").unlink()
    none = fusion("depth", *options, "-o", tmp_path / "out")
    assert none.code == 1
    assert none.err.splitlines()[-1].startswith("fusion: --score")
    assert (tmp_path / "out/frames.csv").exists()  # the maps themselves are whole


RIG = """format = "fusion-rig/1"
[cameras.rgb]
model = "pinhole"
size_wh = [96, 72]
focal_px = [50.0, 50.0]
centre_px = [47.5, 35.5]
[transforms]
T_rgb_lidar = [[0, -1, 0, 0.1], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]
"""


def test_overlay_with_a_rig_lays_dots_where_the_points_fall(fusion: Fusion, tmp_path: Path) -> None:
    clouds = write_clouds(tmp_path / "in", 2, points=40)
    image = np.full((H, W, 3), 77, np.uint8)
    (tmp_path / "rgb").mkdir()
    write(tmp_path / "rgb/c00.png", image)
    (tmp_path / "rig.toml").write_text(RIG)
    options = ["--method", "linear", "--visibility", "none", "--rig", tmp_path / "rig.toml"]
    answer = fusion("depth", clouds, "-o", tmp_path / "out", *options, "--overlay", tmp_path / "rgb")
    assert answer.code == 0, answer.err
    assert "1 of 2 inputs have no image" in answer.err
    assert [p.name for p in (tmp_path / "out/overlay").iterdir()] == ["c00.png"]
    xyz = scene(40)
    u = 50 * (-xyz[:, 1] + 0.1) / xyz[:, 0] + 47.5
    v = 50 * -xyz[:, 2] / xyz[:, 0] + 35.5
    kept = (u >= -0.5) & (u < W - 0.5) & (v >= -0.5) & (v < H - 0.5)
    dots = (read(tmp_path / "out/overlay/c00.png") != image).any(-1)
    at = np.rint(np.stack([v, u], -1)[kept]).astype(int)
    assert dots[at[:, 0], at[:, 1]].all()
    away = np.abs(np.argwhere(dots)[:, None] - at).max(-1).min(1)
    assert away.max() <= 1


def test_overlay_without_a_rig_is_told_to_fit_nothing(fusion: Fusion, tmp_path: Path) -> None:
    cloud = write_clouds(tmp_path / "in", 1)
    image = write(tmp_path / "i.png", np.zeros((H, W, 3), np.uint8))
    answer = fusion("depth", cloud, "-o", tmp_path / "out", *PLAIN, "--overlay", image)
    assert answer.code == 0
    assert "--overlay without --rig" in answer.err


# --- bad input


@pytest.mark.parametrize(
    "options",
    [
        ["--size", 0, 0], ["--size", 640], ["--size", 32768, 32768], ["--fov", "nan"], ["--fov", 0],
        ["--fov", 180], ["--fov", -5], ["--fov", 360], ["--camera", "fisheye", "--fov", 360],
        ["--camera", "spherical", "--fov", 361], ["--camera", "spherical", "--value", "depth"],
        ["--camera", "orthographic"], ["--range", 5, 1], ["--box", 1, 1, 1, 0, 0, 0], ["--box", 0, 0, 0, 1],
        ["--voxel", 0], ["--voxel", -1], ["--voxel", "nan"], ["--outliers", 1, 2], ["--outliers", 20, -1],
        ["--rig", "missing.toml"], ["--rig", "x.toml", "--look", 0, 0, 0], ["--rig", "x.toml", "--fov", 90],
        ["--sensor", "fir"], ["--look", "nan", 0, 0], ["--value", "height"], ["--limits", 5, 5],
        ["--limits", 0, 1e9], ["--visibility", "some"], ["--method", "poisson"], ["--method", "guided"],
        ["--guide", "g.png"], ["--method", "plane", "--extrapolate", "linear"],
        ["--preset", "thesis", "--method", "scan"], ["--max-gap", 0], ["--colormap", "rainbwo"],
        ["--show", 1, 1], ["--show", 0, 1e300], ["--form", "obj"], ["--workers", 0], ["--workers", "x"],
        ["--config", "missing.toml"], ["--preset", "matlab"], ["--vexol", 1], ["--sparse", "x.png"],
        ["--overlay", "missing.png"], ["--score", "missing"],
    ],
    ids=lambda options: " ".join(map(str, options)),
)  # fmt: skip
def test_options_that_cannot_be(fusion: Fusion, tmp_path: Path, options: list[Any]) -> None:
    cloud = write_clouds(tmp_path / "in", 1)
    one_line(fusion("depth", cloud, "-o", tmp_path / "out", *options))
    assert not (tmp_path / "out").exists()


CLOUDS: dict[str, tuple[Any, str]] = {
    "empty": (np.zeros((0, 3)), "no points"),
    "nan": (np.full((5, 3), np.nan), "invalid"),
    "zero": (np.zeros((5, 3)), "invalid"),
    "one": ([[5, 0.013, 0]], "three points"),
    "two": ([[5, 0, 0], [5, 1, 1]], "three points"),
    "line": ([[5, k * 0.1, k * 0.1] for k in range(20)], "one line"),
    "behind": ([[-5, k, 1] for k in range(20)], "behind the camera"),
    "beside": ([[0.01, 50 + k, 1] for k in range(20)], "outside the picture"),
    "far": ([[5000, k, k % 3] for k in range(20)], "outside the limits"),
    "huge": ([[1e30, k * 1e29, 1e29] for k in range(20)], "no metres"),
    "text": ([["a", "b", "c"]] * 4, ""),
    "flat": ([1.0, 2.0, 3.0], "N x 3"),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_clouds_that_give_no_map(fusion: Fusion, tmp_path: Path, name: str) -> None:
    points, word = CLOUDS[name]
    np.save(tmp_path / f"{name}.npy", np.array(points))
    one_line(
        fusion("depth", tmp_path / f"{name}.npy", "-o", tmp_path / "out", *PLAIN), f"'{name}'", word, code=1
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("method", ["plane", "natural", "natural-discrete", "linear", "nearest", "scan"])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_hardly_any_points_give_a_map_or_one_line(
    fusion: Fusion, tmp_path: Path, method: str, count: int
) -> None:
    np.save(tmp_path / "few.npy", np.array([[5, 0, 0.0], [5, 1, 1], [5, -1, 1]])[:count])
    options = [*SMALL, "--visibility", "none", "--method", method]
    answer = fusion("depth", tmp_path / "few.npy", "-o", tmp_path / "out", *options)
    if answer.code:
        one_line(answer, "few", code=1)
        assert not (tmp_path / "out").exists()
    else:
        assert read(tmp_path / "out/depth/few.png").any()


def test_a_point_out_of_this_world_costs_only_itself(fusion: Fusion, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.vstack([scene(), [[1e300, 1e300, 0], [1e30, 0, 0]]]))
    answer = fusion("depth", tmp_path / "a.npy", "-o", tmp_path / "out", *PLAIN)
    assert answer.code == 0, answer.err
    assert read(tmp_path / "out/depth/a.png").max() <= 6 * 256


def test_folders_that_hold_nothing(fusion: Fusion, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    out = ["-o", tmp_path / "out", *PLAIN]
    one_line(fusion("depth", tmp_path / "empty", *out), "empty", ".pcd")
    one_line(fusion("depth", tmp_path / "nowhere", *out), "nowhere")
    one_line(fusion("depth", tmp_path / "empty/*.las", *out), "*.las")
    one_line(fusion("depth", "--sparse", tmp_path / "empty", "-o", tmp_path / "out"), "empty")
    one_line(fusion("depth", *out), "CLOUD", code=2)
    one_line(fusion("depth", write_clouds(tmp_path / "in", 1), *PLAIN), "-o OUT", code=2)
    assert not (tmp_path / "out").exists()


def test_one_name_for_two_clouds(fusion: Fusion, tmp_path: Path) -> None:
    a, b = write_clouds(tmp_path / "in/a", 1), write_clouds(tmp_path / "in/b", 1)
    out = ["-o", tmp_path / "out", *PLAIN]
    one_line(fusion("depth", a, b, *out), str(a / "c00.npy"), str(b / "c00.npy"))
    one_line(fusion("depth", a, a / "c00.npy", *out), "c00.npy")
    np.savez(a / "c00.npz", xyz=scene())
    one_line(fusion("depth", a, *out), "c00.npy", "c00.npz")
    assert not (tmp_path / "out").exists()
    assert fusion("depth", tmp_path / "in/*/c00.npy", *out).code == 0


def test_output_that_would_harm_the_input(fusion: Fusion, tmp_path: Path) -> None:
    clouds = write_clouds(tmp_path / "run/sparse", 1)
    pictures = write_sparse(tmp_path / "run/picture")
    np.savez(clouds / "a.npz", xyz=scene())
    before = tree(tmp_path)
    for words in (
        [clouds, "-o", clouds],
        [clouds, "-o", clouds / "out"],
        [clouds / "*.npy", "-o", clouds / "x"],
        [clouds, "-o", tmp_path / "run"],
        [clouds / "a.npz", "-o", tmp_path / "run", "--overwrite"],
        ["--sparse", pictures / "c00.png", "-o", tmp_path / "run", "--overwrite"],
    ):
        one_line(fusion("depth", *words), "-o", code=1)
        assert tree(tmp_path) == before


def test_an_output_that_cannot_be_a_folder_or_is_somebody_elses(fusion: Fusion, tmp_path: Path) -> None:
    cloud = write_clouds(tmp_path / "in", 1)
    (tmp_path / "file").write_text("mine")
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs/frames.csv").write_text("their,table\n")
    before = tree(tmp_path)
    for out in ("file", "file/out", "theirs"):
        one_line(fusion("depth", cloud, "-o", tmp_path / out, *PLAIN), out)
    one_line(fusion("depth", cloud, "-o", "/proc/nowhere/out", *PLAIN), "/proc")
    assert tree(tmp_path) == before


@pytest.mark.parametrize(
    ("pixels", "word"),
    [
        (np.zeros((H, W), np.uint16), "no points"),
        (np.full((H, W), 9, np.uint8), "8-bit picture is no depth map (16-bit"),
        (np.arange(H * W * 3).reshape(H, W, 3).astype(np.uint8), "coloured picture is no depth map"),
        (np.arange(H * W * 3).reshape(H, W, 3).astype(np.uint16), "coloured picture is no depth map"),
    ],
    ids=["zero", "8-bit", "colour", "16-bit colour"],
)
def test_pictures_that_are_no_sparse_depth(fusion: Fusion, tmp_path: Path, pixels: Any, word: str) -> None:
    write(tmp_path / "p.png", pixels)
    one_line(fusion("depth", "--sparse", tmp_path / "p.png", "-o", tmp_path / "out"), "'p'", word, code=1)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "options",
    [
        ["--voxel", 1], ["--range", 1, 5], ["--fov", 90], ["--camera", "spherical"], ["--rig", "r.toml"],
        ["--look", 0, 0, 0], ["--visibility", "map"], ["--form", "pcd"],
    ],
    ids=lambda options: options[0],
)  # fmt: skip
def test_what_means_nothing_for_sparse_pictures(fusion: Fusion, tmp_path: Path, options: list[Any]) -> None:
    sparse = write_sparse(tmp_path / "sparse")
    one_line(fusion("depth", "--sparse", sparse, "-o", tmp_path / "out", *options), "--", code=2)
    assert not (tmp_path / "out").exists()


def test_pictures_of_another_size(fusion: Fusion, tmp_path: Path) -> None:
    sparse = write_sparse(tmp_path / "sparse") / "c00.png"
    big = write(tmp_path / "big.png", np.zeros((H, 2 * W, 3), np.uint8))
    out = ["-o", tmp_path / "out", "--visibility", "none"]
    guided = ["--method", "guided", "--guide", big]
    one_line(fusion("depth", "--sparse", sparse, *guided, *out), "192x72", "96x72")
    one_line(fusion("depth", "--sparse", sparse, "--method", "linear", "--overlay", big, *out), "192x72")
    cloud = write_clouds(tmp_path / "in", 1)
    (tmp_path / "rig.toml").write_text(RIG)
    one_line(
        fusion("depth", cloud, "--rig", tmp_path / "rig.toml", "--overlay", big, *out), "rig.toml", "96x72"
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("[0, -1, 0, 0.1]", "[0, -2, 0, 0.1]", "not rigid"),
        ("[0, -1, 0, 0.1]", "[0, 0, 0, 0.1]", "not rigid"),
        ("T_rgb_lidar", "T_rgb_fir", "rgb stands to lidar"),
        ("cameras.rgb", "cameras.fir", "the rig has fir"),
        ("focal_px", "focal", "focal"),
        ("format", "formt", ""),
    ],
)
def test_rigs_that_cannot_be(fusion: Fusion, tmp_path: Path, old: str, new: str, word: str) -> None:
    cloud = write_clouds(tmp_path / "in", 1)
    (tmp_path / "rig.toml").write_text(RIG.replace(old, new))
    one_line(fusion("depth", cloud, "-o", tmp_path / "out", "--rig", tmp_path / "rig.toml"), word, code=2)
    assert not (tmp_path / "out").exists()


def test_a_failed_try_does_not_stand_in_the_way_of_the_next(fusion: Fusion, tmp_path: Path) -> None:
    cloud, out = write_clouds(tmp_path / "in", 1), tmp_path / "out"
    one_line(fusion("depth", cloud, "-o", out, *PLAIN, "--look", 180, 0, 0), "behind the camera", "--look")
    assert fusion("depth", cloud, "-o", out, *PLAIN).code == 0


def test_help_shows_worked_examples(fusion: Fusion) -> None:
    answer = fusion("depth", "--help")
    assert answer.code == 0
    assert answer.out.count("fusion depth ") >= 6
    assert "--extrapolate" in answer.out


# --- real scans


def test_a_real_scan_over_its_image(fusion: Fusion, tmp_path: Path, shared_data: Path) -> None:
    folder = shared_data / "kitti_object"
    cloud = sorted((folder / "velodyne").glob("*.bin"))[0]
    image = next((folder / "image_2").glob(f"{cloud.stem}.*"))
    options = ["--rig", folder / f"calib/{cloud.stem}.txt", "--overlay", image, "--method", "scan"]
    answer = fusion("depth", cloud, "-o", tmp_path / "out", *options)
    assert answer.code == 0, answer.err
    row = read_rows(tmp_path / "out/frames.csv", DepthRow)[0]
    assert int(row.visible) > 10_000
    assert int(row.supported) > 0.4 * int(row.pixels)
    assert read(tmp_path / f"out/overlay/{cloud.stem}.png").shape == read(image).shape
