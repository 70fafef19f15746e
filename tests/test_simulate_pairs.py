"""The simulated pairs: the same bytes again, and a truth that the images bear out."""

from __future__ import annotations

import csv
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fusion.errors import FusionError, OutputError, UsageError
from fusion.simulate.pairs import PairsTruth, Scene, make_pairs

RGB_WH, FIR_WH = (160, 120), (160, 128)


def small(out: Path, **options: Any) -> PairsTruth:
    return make_pairs(out, **{"frames": 3, "rgb_size_wh": RGB_WH, "fir_size_wh": FIR_WH, **options})


def files(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def through(H: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Plain float64 homography, the oracle of everything below."""
    p = np.column_stack([xy, np.ones(len(xy))]) @ np.asarray(H, np.float64).T
    return p[:, :2] / p[:, 2:]


def degc(counts: np.ndarray) -> np.ndarray:
    return counts.astype(np.float64) / 25 - 273.15


def frame_corners(size_wh: tuple[int, int]) -> np.ndarray:
    w, h = size_wh
    return np.array([[0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1]], np.float64)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, PairsTruth]:
    out = tmp_path_factory.mktemp("pairs") / "out"
    return out, small(out)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(frames=12, rgb_size_wh=(320, 240), fir_size_wh=(320, 256), seed=0)


def test_the_files_are_what_the_truth_says(pairs: tuple[Path, PairsTruth]) -> None:
    out, truth = pairs
    names = {f"{role}/{role}_{k:06d}.png" for role in ("rgb", "fir") for k in range(3)}
    assert set(files(out)) == names | {"points.csv", "truth.toml"}
    bgr = cv2.imread(str(out / "rgb/rgb_000002.png"), cv2.IMREAD_UNCHANGED)
    fir = cv2.imread(str(out / "fir/fir_000002.png"), cv2.IMREAD_UNCHANGED)
    assert bgr is not None
    assert fir is not None
    assert (bgr.shape, bgr.dtype) == ((120, 160, 3), np.uint8)
    assert (fir.shape, fir.dtype) == ((128, 160), np.uint16)
    assert fir.max() < 2**14
    table = tomllib.loads((out / "truth.toml").read_text())
    assert table["format"] == "fusion-pairs-truth/1"
    np.testing.assert_array_equal(table["H_rgb_fir"], truth.H_rgb_fir)
    assert table["rgb_size_wh"] == [160, 120]
    assert table["fir_size_wh"] == [160, 128]
    assert table["stamps_ns"] == [0, 100_000_000, 200_000_000]
    assert 1 / table["kelvin_per_count"] == pytest.approx(25)
    assert len(table["level_kelvin"]) == 3


def test_same_seed_same_bytes_other_seed_other_images(pairs: tuple[Path, PairsTruth], tmp_path: Path) -> None:
    out, truth = pairs
    small(tmp_path / "again")
    other = small(tmp_path / "other", seed=1)
    assert files(tmp_path / "again") == files(out)
    assert not np.array_equal(other.H_rgb_fir, truth.H_rgb_fir)
    for name, data in files(tmp_path / "other").items():
        assert data != files(out)[name], name


def test_frames_differ_and_do_not_depend_on_their_order(pairs: tuple[Path, PairsTruth]) -> None:
    scene = Scene(frames=3, rgb_size_wh=RGB_WH, fir_size_wh=FIR_WH, seed=0)
    last, first = scene.counts(2), scene.counts(0)
    np.testing.assert_array_equal(
        last, cv2.imread(str(pairs[0] / "fir/fir_000002.png"), cv2.IMREAD_UNCHANGED)
    )
    np.testing.assert_array_equal(
        scene.bgr(0), cv2.imread(str(pairs[0] / "rgb/rgb_000000.png"), cv2.IMREAD_UNCHANGED)
    )
    assert not np.array_equal(last, first)


def test_a_fit_to_the_good_points_gives_the_true_homography(pairs: tuple[Path, PairsTruth]) -> None:
    out, truth = pairs
    with (out / "points.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["rgb_x", "rgb_y", "fir_x", "fir_y"]
    rgb = np.array([[float(r["rgb_x"]), float(r["rgb_y"])] for r in rows])
    fir = np.array([[float(r["fir_x"]), float(r["fir_y"])] for r in rows])
    error = np.linalg.norm(through(truth.H_rgb_fir, fir) - rgb, axis=1)
    assert tuple(np.flatnonzero(error > 2)) == truth.outliers
    assert len(truth.outliers) == 2
    good = np.delete(np.arange(len(rows)), truth.outliers)
    # 0.4 px in each coordinate is 0.57 px in the plane; 22 points scatter a tenth around that.
    assert np.sqrt(np.mean(error[good] ** 2)) == pytest.approx(0.4 * np.sqrt(2), rel=0.4)
    exact, _ = cv2.findHomography(fir[good], through(truth.H_rgb_fir, fir[good]))
    corners = frame_corners(FIR_WH)
    np.testing.assert_allclose(through(exact, corners), through(truth.H_rgb_fir, corners), atol=1e-3)
    fitted, _ = cv2.findHomography(fir[good], rgb[good])
    assert np.linalg.norm(through(fitted, corners) - through(truth.H_rgb_fir, corners), axis=1).max() < 2.0
    assert (rgb >= 0).all()
    assert (rgb <= np.array(RGB_WH) - 1).all()
    assert (fir >= 0).all()
    assert (fir <= np.array(FIR_WH) - 1).all()


@pytest.mark.parametrize("index", [0, 5, 11])
def test_warped_thermal_lies_on_the_person_in_rgb(scene: Scene, index: int) -> None:
    mask = scene.person_mask(index)
    warped = cv2.warpPerspective(scene.counts(index), scene.H_rgb_fir, scene.rgb_size_wh)
    near = cv2.dilate(mask.astype(np.uint8), np.ones((9, 9))) > 0  # the pipe and the machine are warm too
    celsius = degc(warped) - scene.level_kelvin(index)
    warm = near & (celsius > 22) & (celsius < 38)
    iou = (warm & mask).sum() / (warm | mask).sum()
    assert mask.sum() > 1000
    assert iou > 0.8
    moved = np.roll(mask, 8, axis=1)  # the measure must see a misalignment
    assert (warm & moved).sum() / (warm | moved).sum() < 0.7


def test_the_person_is_hardly_visible_in_rgb_and_plain_in_thermal(scene: Scene) -> None:
    mask = scene.person_mask(6)
    ring = (cv2.dilate(mask.astype(np.uint8), np.ones((15, 15))) > 0) & ~mask
    grey = scene.bgr(6).mean(axis=2)
    warped = degc(cv2.warpPerspective(scene.counts(6), scene.H_rgb_fir, scene.rgb_size_wh))
    assert 15 < grey.mean() < 70  # dim, not black
    assert abs(grey[mask].mean() - grey[ring].mean()) < grey[ring].std()
    assert np.median(warped[mask]) - np.median(warped[ring]) > 10


@pytest.mark.parametrize("index", [0, 11])
def test_counts_inside_the_person_are_its_temperature(scene: Scene, index: int) -> None:
    H_fir_rgb = np.linalg.inv(scene.H_rgb_fir)
    core = cv2.erode(scene.person_mask(index).astype(np.uint8), np.ones((3, 3)))
    inside = cv2.warpPerspective(core, H_fir_rgb, scene.fir_size_wh, flags=cv2.INTER_NEAREST) > 0
    emitted, reflected = 0.97 * (32 + 273.15) ** 4, 0.03 * (11 + 273.15) ** 4
    expected = (emitted + reflected) ** 0.25 - 273.15 + scene.level_kelvin(index)
    # Clothes and skin differ from the mean by up to 1.3 K; the lens's rim and dead pixels add 0.2 K.
    assert degc(scene.counts(index)[inside]).mean() == pytest.approx(expected, abs=0.5)


def test_thermal_errors_have_the_sizes_they_should(scene: Scene) -> None:
    def error(index: int) -> np.ndarray:
        return degc(scene.counts(index)) - scene.thermal_view(index)

    first, last = error(0), error(11)
    assert np.median(last - first) == pytest.approx(1.5, abs=0.01)  # the level's drift
    spread = 1.4826 * np.median(np.abs(last - first - np.median(last - first)))
    # Two draws of 50 mK, each rounded to 40 mK steps; the fixed pattern cancels in the difference.
    assert spread == pytest.approx(np.sqrt(2 * (0.05**2 + 0.04**2 / 12)), rel=0.1)
    fixed = np.median([error(k) - np.median(error(k)) for k in range(0, 12, 2)], axis=0)
    assert 0.03 < fixed.mean(axis=0).std() < 0.15  # columns stand
    dead = (scene.counts(0) == scene.counts(11)) & (np.abs(first) > 5)
    assert 1 <= dead.sum() <= 4


@pytest.mark.parametrize(
    ("rgb_wh", "fir_wh"), [((160, 120), (160, 128)), ((200, 100), (96, 192)), ((96, 192), (160, 96))]
)
def test_the_thermal_view_lies_inside_rgb_and_rgb_inside_the_painting(
    rgb_wh: tuple[int, int], fir_wh: tuple[int, int]
) -> None:
    for seed in range(3):
        scene = Scene(frames=400, rgb_size_wh=rgb_wh, fir_size_wh=fir_wh, seed=seed)
        seen = through(scene.H_rgb_fir, frame_corners(fir_wh))
        assert (seen > 0).all()
        assert (seen < np.array(rgb_wh) - 1).all()
        painted_wh = np.array([round(side * 1.24) for side in rgb_wh])
        for index in range(0, 400, 7):
            world = through(np.linalg.inv(scene.homography_rgb_world(index)), frame_corners(rgb_wh))
            assert (world >= 0).all()
            assert (world <= painted_wh - 1).all()
        assert scene.bgr(399).shape == (rgb_wh[1], rgb_wh[0], 3)


@pytest.mark.parametrize("fir_wh", [(96, 96), (160, 128), (320, 256)])
def test_only_the_named_outliers_are_gross(fir_wh: tuple[int, int]) -> None:
    for seed in range(4):
        scene = Scene(frames=1, rgb_size_wh=(160, 120), fir_size_wh=fir_wh, seed=seed)
        points, outliers = scene.picked_points()
        error = np.linalg.norm(through(scene.H_rgb_fir, points[:, 2:]) - points[:, :2], axis=1)
        assert points.shape == (24, 4)
        assert tuple(np.flatnonzero(error > 2)) == outliers


def test_the_camera_moves_smoothly_and_the_person_walks(scene: Scene) -> None:
    centre = np.array([[160.0, 120.0]])
    at_rest = through(np.linalg.inv(scene.homography_rgb_world(0)), centre)
    path = np.vstack([through(scene.homography_rgb_world(k), at_rest) for k in range(12)])
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert steps.min() > 0
    assert steps.max() < 0.015 * 320
    x = [np.flatnonzero(scene.person_mask(k).any(axis=0)).mean() for k in (0, 6, 11)]
    assert x[0] + 20 < x[1]
    assert x[1] + 20 < x[2]


@pytest.mark.parametrize(
    "options",
    [
        {"frames": 0},
        {"frames": -1},
        {"frames": 1_000_001},
        {"seed": -1},
        {"rgb_size_wh": (161, 120)},
        {"rgb_size_wh": (160, 0)},
        {"rgb_size_wh": (4096, 3072)},
        {"rgb_size_wh": (400, 120)},
        {"fir_size_wh": (64, 64)},
        {"fir_size_wh": (160, -128)},
    ],
)
def test_what_cannot_be_is_refused_and_nothing_is_written(tmp_path: Path, options: dict[str, Any]) -> None:
    with pytest.raises(UsageError) as caught:
        small(tmp_path / "out", **options)
    assert caught.value.hint
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["rgb", "fir", "points.csv", "truth.toml"])
def test_nothing_is_written_over(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(OutputError, match=name):
        small(tmp_path)
    assert files(tmp_path) == {name: b"mine"}


def test_a_folder_with_other_things_is_taken(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    done: list[tuple[int, int]] = []
    small(tmp_path, frames=2, progress=lambda k, n: done.append((k, n)))
    assert files(tmp_path)["notes.txt"] == b"mine"
    assert done == [(1, 2), (2, 2)]


def test_an_unusable_out_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FusionError) as caught:
        small(tmp_path / "file" / "out")
    assert "file" in str(caught.value)


def test_one_frame_has_no_drift(tmp_path: Path) -> None:
    assert small(tmp_path / "out", frames=1).level_kelvin == (0.0,)


def test_the_command_writes_the_same_files(
    pairs: tuple[Path, PairsTruth], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from fusion.cli.simulate import simulate_pairs

    simulate_pairs(tmp_path / "out", frames=3, rgb_size=RGB_WH, fir_size=FIR_WH)
    assert files(tmp_path / "out") == files(pairs[0])
    assert str(tmp_path / "out") in capsys.readouterr().out
