"""`fusion blend` as a user meets it: good runs, and every kind of bad input in one clear line."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import sys
import tomllib
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from fusion.radiometric import read_flir
from tests.cli.conftest import Answer
from tests.worlds import read, tree, write, write_pairs

Fusion = Callable[..., Answer]


def one_line(answer: Answer, *words: str, code: int | None = None) -> None:
    """A refusal: non-zero exit, a single line that names what it must, no traceback."""
    lines = answer.err.strip().splitlines()
    assert answer.code == code if code is not None else answer.code in (1, 2), answer
    assert len(lines) == 1, answer.err
    assert lines[0].startswith("fusion: ")
    for word in words:
        assert word in lines[0], lines[0]


def test_blend_writes_what_the_readme_says(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 5, bits=16, fir_size_wh=(50, 40))
    answer = fusion("blend", rgb, fir, "-o", tmp_path / "out", "--preview", "--workers", 2)
    assert answer.code == 0, answer.err
    names = tree(tmp_path / "out")
    assert sorted(names) == [
        "frames.csv",
        *(f"fused/f{i:03d}.png" for i in range(5)),
        "preview.png",
        "run.toml",
    ]
    assert "NOT REGISTERED" in answer.err  # 50x40 onto 64x48 is scaled to fit, said loudly
    run = tomllib.loads(names["run.toml"].decode())
    assert run["config"]["preset"] == "auto"
    assert run["registration"]["kind"] == "scale"
    assert str(tmp_path) not in names["run.toml"].decode()
    assert str(tmp_path) not in names["frames.csv"].decode()


def test_thesis_preset_equals_the_thesis_in_float64(fusion: Fusion, tmp_path: Path) -> None:
    """METHOD section 1 in plain numpy, to the grey level, on aligned 8-bit pairs."""
    rgb, fir = write_pairs(tmp_path, 2)
    assert fusion("blend", rgb, fir, "-o", tmp_path / "out", "--preset", "thesis").code == 0
    for name in ("f000.png", "f001.png"):
        bgr, grey = read(rgb / name).astype(np.float64), read(fir / name).astype(np.float64) / 255
        s = np.clip((grey - 0.3) / 0.3, 0, 1)
        hue = np.floor(255 * s + 0.5) / 256
        sector = np.abs(
            (6 * hue[..., None] - np.array([4, 2, 0]) + 3) % 6 - 3
        )  # distance to blue, green, red
        colour = np.floor(255 * np.clip(2 - sector, 0, 1) + 0.5)
        exact = 0.85 * bgr + 0.15 * colour
        fused = read(tmp_path / "out/fused" / name)
        assert np.abs(fused - exact).max() <= 0.5 + 1e-9


def test_points_and_policies(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 2, fir_size_wh=(40, 30))
    points = tmp_path / "points.csv"
    points.write_text("fir_x,fir_y,rgb_x,rgb_y\n0,0,12,9\n39,0,51,9\n39,29,51,38\n0,29,12,38\n")
    results = {}
    for outside in ("crop", "keep", "fill"):
        answer = fusion(
            "blend",
            rgb,
            fir,
            "-o",
            tmp_path / outside,
            "--points",
            points,
            "--outside",
            outside,
            "--fill-bgr",
            9,
            8,
            7,
        )
        assert answer.code == 0, answer.err
        assert "left 12, top 9, right 12, bottom 9 px" in answer.out
        results[outside] = read(tmp_path / outside / "fused/f000.png")
    original = read(rgb / "f000.png")
    assert results["crop"].shape == (30, 40, 3)
    assert np.array_equal(results["crop"], results["keep"][9:39, 12:52])
    mask = read(tmp_path / "keep/mask/f000.png")
    assert mask.sum() == 255 * 30 * 40
    assert np.array_equal(results["keep"][mask == 0], original[mask == 0])
    assert (results["fill"][mask == 0] == (9, 8, 7)).all()
    assert not (tmp_path / "crop/mask").exists()


def test_single_pair_globs_and_four_channels(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 3)
    assert fusion("blend", rgb / "f000.png", fir / "f001.png", "-o", tmp_path / "one").code == 0
    assert list(tree(tmp_path / "one"))[1] == "fused/f000.png"
    assert fusion("blend", rgb / "f*.png", fir / "f*[12].png", "-o", tmp_path / "glob").code == 0
    assert [p.name for p in sorted((tmp_path / "glob/fused").iterdir())] == ["f001.png", "f002.png"]
    assert "f000" in (tmp_path / "glob/unmatched.csv").read_text()
    both = tmp_path / "rgbt"
    both.mkdir()
    for name in ("f000.png", "f001.png", "f002.png"):
        write(both / name, np.dstack([read(rgb / name), read(fir / name)]))
    assert fusion("blend", both, "-o", tmp_path / "four").code == 0
    assert fusion("blend", rgb, fir, "-o", tmp_path / "two").code == 0
    assert read(tmp_path / "four/fused/f001.png").tobytes() == read(tmp_path / "two/fused/f001.png").tobytes()


def test_dry_run_reports_and_writes_nothing(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 4)
    (fir / "f003.png").unlink()
    answer = fusion("blend", rgb, fir, "--dry-run", "-o", tmp_path / "out")
    assert answer.code == 0
    assert "f003" in answer.out
    assert not (tmp_path / "out").exists()
    assert fusion("blend", rgb, fir, "--dry-run", "--preview", "-o", tmp_path / "out").code == 0
    assert list(tree(tmp_path / "out")) == ["preview.png"]


def test_config_file_equals_options(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 2)
    config = tmp_path / "c.toml"
    config.write_text('format = "fusion-blend/1"\n[blend]\nalpha = 0.5\n[thermal]\ncolormap = "cv:jet"\n')
    assert fusion("blend", rgb, fir, "-o", tmp_path / "a", "--config", config).code == 0
    assert fusion("blend", rgb, fir, "-o", tmp_path / "b", "--alpha", 0.5, "--colormap", "cv:jet").code == 0
    assert tree(tmp_path / "a") == tree(tmp_path / "b")


def test_clipping_above_a_third_is_a_warning_with_a_way_out(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 2, bits=16)  # 7000 to 7400 of 65535: all below 0.3
    answer = fusion("blend", rgb, fir, "-o", tmp_path / "out", "--preset", "thesis")
    assert answer.code == 0
    assert "--preset auto" in answer.err
    assert fusion("blend", rgb, fir, "-o", tmp_path / "auto").err == ""


def test_strict_refuses_unmatched(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 3)
    (fir / "f001.png").unlink()
    one_line(fusion("blend", rgb, fir, "-o", tmp_path / "out", "--strict"), "f001", "partner")
    assert not (tmp_path / "out").exists()


# --- bad input


def test_folders_that_hold_nothing(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 2)
    (tmp_path / "empty").mkdir()
    one_line(fusion("blend", tmp_path / "empty", fir, "-o", tmp_path / "out"), "empty")
    one_line(fusion("blend", rgb, tmp_path / "nowhere", "-o", tmp_path / "out"), "nowhere")
    one_line(fusion("blend", rgb, fir / "*.tif", "-o", tmp_path / "out"), "*.tif")
    assert not (tmp_path / "out").exists()


def test_no_pair_names_a_rule_that_would_match(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 3)
    for path in fir.iterdir():
        path.rename(path.with_name("thermal_" + path.name))
    one_line(fusion("blend", rgb, fir, "-o", tmp_path / "out"), "--pair index")


def test_counts_that_differ_in_order(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 3)
    (fir / "f000.png").unlink()
    one_line(fusion("blend", rgb, fir, "-o", tmp_path / "out", "--pair", "order"), "3", "2")


def test_thermal_in_colour_is_refused_or_converted_on_request(fusion: Fusion, tmp_path: Path) -> None:
    rgb, _ = write_pairs(tmp_path, 2)
    one_line(fusion("blend", rgb, rgb, "-o", tmp_path / "out"), "--fir-colour luma")
    assert fusion("blend", rgb, rgb, "-o", tmp_path / "out", "--fir-colour", "luma").code == 0
    assert "fir-colour-to-luma" in (tmp_path / "out/frames.csv").read_text()


def test_an_image_that_claims_to_be_huge_takes_no_memory(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 2)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0))
    (rgb / "f000.png").write_bytes(
        b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")
    )
    answer = fusion("blend", rgb, fir, "-o", tmp_path / "out")
    assert answer.code == 0
    assert "100000x100000" in answer.err.replace(" ", "")
    one_line(fusion("blend", rgb, fir, "-o", tmp_path / "out2", "--strict"), "f000.png")


def test_damaged_files_are_reported_by_us_alone(tmp_path: Path) -> None:
    """libpng and libtiff would write lines of their own to the terminal."""
    rgb, fir = write_pairs(tmp_path, 4)
    for folder, name in ((rgb, "f000.png"), (fir, "f002.png")):
        data = bytearray((folder / name).read_bytes())
        data[len(data) // 2] ^= 255
        (folder / name).write_bytes(data)
    command = [sys.executable, "-m", "fusion", "blend", str(rgb), str(fir), "-o", str(tmp_path / "out")]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    assert all(line.startswith("fusion: warning: ") for line in lines), done.stderr
    assert [name for name in ("f000", "f002") if any(f"skipped {name}" in line for line in lines)] == [
        "f000",
        "f002",
    ]


def test_output_inside_the_input(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 2)
    before = tree(tmp_path)
    one_line(fusion("blend", rgb, fir, "-o", rgb), "inside the input")
    one_line(fusion("blend", rgb, fir, "-o", fir / "out"), "inside the input")
    one_line(fusion("blend", rgb / "*.png", fir, "-o", rgb / "x"), "inside the input")
    (tmp_path / "o").mkdir()
    (rgb).rename(tmp_path / "o/fused")
    one_line(fusion("blend", tmp_path / "o/fused", fir, "-o", tmp_path / "o"), "overwrite")
    assert sorted(tree(tmp_path).values()) == sorted(before.values())


@pytest.mark.parametrize(
    ("matrix", "word"),
    [
        ("1 0 0\n0 1 0\n0 0 0\n", ""),
        ("1 2 3\n2 4 6\n0 0 1\n", "singular"),
        ("1 0 0\n0 1 0\n-0.05 0 1\n", ""),
        ("nan 0 0\n0 1 0\n0 0 1\n", ""),
        ("1 0 5000\n0 1 0\n0 0 1\n", ""),
        ("1 0\n0 1\n", "3x3"),
        ("hello\n", ""),
    ],
)
def test_absurd_homographies(fusion: Fusion, tmp_path: Path, matrix: str, word: str) -> None:
    rgb, fir = write_pairs(tmp_path, 2)
    (tmp_path / "H.txt").write_text(matrix)
    one_line(
        fusion("blend", rgb, fir, "-o", tmp_path / "out", "--homography", tmp_path / "H.txt"), word, code=2
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "options",
    [
        ["--window", "0.6", "0.3"],
        ["--window", "7000", "7400"],
        ["--window", "20", "30", "--window-unit", "celsius"],
        ["--alpha", "2"],
        ["--alpha", "x"],
        ["--colormap", "rainbwo"],
        ["--method", "poisson"],
        ["--workers", "0"],
        ["--quality", "101"],
        ["--alhpa", "1"],
        ["--homography", "missing.txt"],
        ["--points", "missing.csv"],
        ["--config", "missing.toml"],
        ["--dataset", "mssr"],
        ["--tolerance-ms", "-1"],
        ["--rgb-key", "("],
    ],
)
def test_options_that_cannot_be(fusion: Fusion, tmp_path: Path, options: list[str]) -> None:
    rgb, fir = write_pairs(tmp_path, 2)
    one_line(fusion("blend", rgb, fir, "-o", tmp_path / "out", *options))
    assert not (tmp_path / "out").exists()


def test_names_with_spaces_other_alphabets_and_only_a_difference_in_case(
    fusion: Fusion, tmp_path: Path
) -> None:
    rgb, fir = write_pairs(tmp_path, 4)
    for old, new in zip(("f000", "f001", "f002", "f003"), ("два слова", "鉱山 1", "A b", "a b"), strict=True):
        for folder in (rgb, fir):
            (folder / f"{old}.png").rename(folder / f"{new}.png")
    answer = fusion("blend", rgb, fir, "-o", tmp_path / "out dir")
    assert answer.code == 0, answer.err
    assert {p.stem for p in (tmp_path / "out dir/fused").iterdir()} == {"два слова", "鉱山 1", "A b", "a b"}
    assert "case" in answer.out


@pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() == 0, reason="root may read and write everything")
def test_folders_that_may_not_be_written(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 2)
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    one_line(fusion("blend", rgb, fir, "-o", locked / "out"), "locked")


def test_an_output_that_cannot_be_a_folder(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 2)
    (tmp_path / "file").write_text("mine")
    one_line(fusion("blend", rgb, fir, "-o", tmp_path / "file"), "file")
    one_line(fusion("blend", rgb, fir, "-o", tmp_path / "file/out"), "file")
    one_line(fusion("blend", rgb, fir, "-o", "/proc/nowhere/out"), "/proc")
    assert (tmp_path / "file").read_text() == "mine"


def test_no_output_named(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 2)
    one_line(fusion("blend", rgb, fir), "-o OUT", code=2)


def test_an_unregistered_data_set_needs_a_registration(fusion: Fusion, tmp_path: Path) -> None:
    root = tmp_path / "set" / "ir_det_dataset" / "Images"
    write_pairs(root, 2)
    top, out = tmp_path / "set" / "ir_det_dataset", tmp_path / "out"
    one_line(
        fusion("blend", "--dataset", "mil_multispectral", top, "-o", out), "mil_multispectral", "--homography"
    )
    (tmp_path / "H.txt").write_text("1 0 1\n0 1 1\n0 0 1\n")
    answer = fusion(
        "blend", "--dataset", "mil_multispectral", top, "-o", out, "--homography", tmp_path / "H.txt"
    )
    assert answer.code == 0, answer.err


def test_a_data_set_that_is_not_as_known_is_told(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path / "set" / "train", 2)
    rgb.rename(rgb.with_name("vi"))
    fir.rename(fir.with_name("ir"))
    answer = fusion("blend", "--dataset", "msrs", tmp_path / "set", "-o", tmp_path / "out")
    assert answer.code == 0, answer.err
    assert "RGB size: msrs has (640, 480), found (64, 48)" in answer.err
    assert sorted(p.name for p in (tmp_path / "out/fused/train/vi").iterdir()) == ["f000.png", "f001.png"]


def test_help_is_there_and_loads_nothing_heavy() -> None:
    code = (
        "import sys\nsys.argv = ['fusion', '--help']\nfrom fusion.cli.main import main\n"
        "try: main()\nexcept SystemExit: pass\n"
        "heavy = {'numpy', 'cv2', 'numba', 'pydantic', 'matplotlib', 'scipy', 'open3d', 'av', 'PIL'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    said = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    ).stdout
    assert "blend" in said
    assert said.strip().endswith("[]")


def test_blend_help_shows_worked_examples(fusion: Fusion) -> None:
    answer = fusion("blend", "--help")
    assert answer.code == 0
    assert answer.out.count("fusion blend ") >= 8
    assert "--outside" in answer.out


# --- real pairs


@pytest.mark.parametrize("name", ["MSRS", "RoadScene", "TNO"])
@pytest.mark.parametrize("preset", ["auto", "thesis"])
def test_real_aligned_pairs(
    fusion: Fusion, tmp_path: Path, shared_data: Path, name: str, preset: str
) -> None:
    folder = shared_data / "rgbt_pairs" / name
    answer = fusion("blend", folder / "vi", folder / "ir", "-o", tmp_path / "out", "--preset", preset)
    assert answer.code == 0, answer.err
    fused = sorted((tmp_path / "out/fused").iterdir())
    assert [p.name for p in fused] == sorted(p.name for p in (folder / "vi").iterdir())
    for path in fused:
        bgr = cv2.imread(str(folder / "vi" / path.name), cv2.IMREAD_COLOR)
        assert bgr is not None
        assert np.abs(read(path) - 0.85 * bgr - 0.15 * 127.5).max() <= 0.15 * 127.5 + 0.5


def test_real_radiometric_counts(fusion: Fusion, tmp_path: Path, shared_data: Path) -> None:
    tiff = shared_data / "radiometric" / "example_radiometric.tiff"
    rgb = write(tmp_path / "scene.png", np.full((512, 640, 3), 90, np.uint8))
    scale = ["--celsius-per-count", 0.04, "--celsius-at-zero", -273.15]
    answer = fusion(
        "blend", rgb, tiff, "-o", tmp_path / "c", "--window", 0, 8, "--window-unit", "celsius", *scale
    )
    assert answer.code == 0, answer.err
    row = (tmp_path / "c/frames.csv").read_text().splitlines()[1].split(",")
    assert (float(row[6]), float(row[7])) == pytest.approx((273.15 / 0.04, 281.15 / 0.04), rel=1e-9)
    answer = fusion("blend", rgb, tiff, "-o", tmp_path / "a")
    assert answer.code == 0
    assert np.unique(read(tmp_path / "a/fused/scene.png").reshape(-1, 3), axis=0).shape[0] > 100


def test_a_window_in_degrees_by_what_radiometric_files_say(
    fusion: Fusion, shared_data: Path, tmp_path: Path
) -> None:
    """Counts and degrees are not proportional there: the camera's constants tell."""
    photos = tmp_path / "photos"
    photos.mkdir()
    shutil.copy(shared_data / "radiometric" / "FLIR.jpg", photos)
    window = ("--window", 26, 50, "--window-unit", "celsius")
    done = fusion("blend", photos, "-o", tmp_path / "out", *window)
    assert done.code == 0, done.err
    with (tmp_path / "out" / "run.toml").open("rb") as file:
        lo, hi = tomllib.load(file)["config"]["thermal"]["window"]
    flir = read_flir((photos / "FLIR.jpg").read_bytes(), "FLIR.jpg")
    degrees = flir.celsius()
    low, high = (flir.counts <= lo), (flir.counts >= hi)
    assert degrees[low].max() <= 26 + 0.1 < degrees[~low].min() + 0.2
    assert degrees[high].min() >= 50 - 0.1


def test_a_window_in_degrees_of_plain_images_needs_a_scale(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_pairs(tmp_path, 2)
    window = ("--window", 26, 50, "--window-unit", "celsius")
    done = fusion("blend", rgb, fir, "-o", tmp_path / "out", *window)
    assert done.code == 2
    assert "--celsius-per-count" in done.err
    assert not (tmp_path / "out").exists()
