"""`fusion datasets check`: every kind of fault is found, named and makes the exit code 1; no fault is not."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from fusion.cli.dataset_checks import Report, check, sample
from fusion.cli.datasets import check_dataset
from fusion.manifest import Manifest, load_manifest
from fusion.rig import save_rig
from tests.dataset_trees import Tree, build, rig_for, write_role


class Answer(NamedTuple):
    code: int
    out: str


@pytest.fixture
def checked(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Answer]:
    monkeypatch.delenv("FUSION_DATASETS", raising=False)

    def call(name: str, root: Path, **options: bool) -> Answer:
        code = 0
        try:
            check_dataset(name, root, **options)
        except SystemExit as ended:
            code = int(ended.code or 0)
        return Answer(code, capsys.readouterr().out)

    return call


def wrong(report: Report) -> list[tuple[str, str]]:
    return [(finding.kind, finding.text) for finding in report.findings if finding.wrong]


def noted(report: Report, kind: str) -> list[str]:
    return [finding.text for finding in report.findings if not finding.wrong and finding.kind == kind]


def altered(manifest: Manifest, **changes: object) -> Manifest:
    return Manifest.model_validate({**manifest.model_dump(exclude_none=True), **changes})


@pytest.fixture
def msrs(tmp_path: Path) -> Tree:
    return build(load_manifest("msrs"), tmp_path / "root")


def rewrite(tree: Tree, role: str, pixels: np.ndarray, k: int = 0) -> Path:
    path = tree.root / tree.frames[k][role]
    assert cv2.imwrite(str(path), pixels)
    return path


# --- files


def test_nothing_is_wrong_with_a_sound_set(msrs: Tree, checked: Callable[..., Answer]) -> None:
    code, out = checked("msrs", msrs.root)
    assert code == 0
    assert out.splitlines()[-1] == "as the manifest says"
    assert "fir with rgb: 4 by stem" in out
    assert "640x480, uint8" in out


@pytest.mark.parametrize(
    ("role", "shape", "dtype", "kind", "said"),
    [
        ("rgb", (480, 320, 3), np.uint8, "size", "rgb images of msrs are 640x480, this one is 320x480"),
        ("fir", (240, 640), np.uint8, "size", "fir images of msrs are 640x480, this one is 640x240"),
        ("fir", (480, 640), np.uint16, "bits", "thermal images of msrs have 8 bits, this one is uint16"),
    ],
)
def test_sizes_and_bits_other_than_stated(
    msrs: Tree, role: str, shape: tuple[int, ...], dtype: type, kind: str, said: str
) -> None:
    path = rewrite(msrs, role, np.full(shape, 9, dtype))
    report = check(load_manifest("msrs"), msrs.root)
    kinds = dict(wrong(report))
    assert kinds[kind].startswith(f"{path}: {said}") or said in str(wrong(report))
    assert not report.ok


def test_thermal_that_lies_on_rgb_must_have_its_size(tmp_path: Path) -> None:
    """RoadScene's sizes vary from pair to pair, and are equal in each."""
    made = load_manifest("roadscene")
    tree = build(made, tmp_path)
    for role in ("rgb", "fir"):
        rewrite(tree, role, np.full((30, 40), 9, np.uint8), 1)
    assert wrong(check(made, tmp_path)) == []
    path = rewrite(tree, "fir", np.full((30, 41), 9, np.uint8), 1)
    assert wrong(check(made, tmp_path)) == [
        ("size", f"{path} is 41x30, its RGB image 40x30: it cannot lie on it")
    ]
    assert wrong(check(altered(made, registered=False), tmp_path)) == []


def test_an_image_that_cannot_be_read_is_named(msrs: Tree, checked: Callable[..., Answer]) -> None:
    path = msrs.root / msrs.frames[0]["fir"]
    path.write_bytes(path.read_bytes()[:100])
    code, out = checked("msrs", msrs.root)
    assert code == 1
    assert f"wrong: {path}: " in out
    assert "not as the manifest says" in out.splitlines()[-1]


def test_counts_are_held_against_what_is_published(msrs: Tree) -> None:
    made = load_manifest("msrs")
    for checks, said in (
        ({"counts": {"pairs": 5}}, "pairs: msrs has 5, found 4"),
        ({"counts": {"rgb": 3}}, "rgb files: msrs has 3, found 4"),
        ({"min_pairs": 1444}, "pairs: msrs has at least 1,444, found 4"),
    ):
        assert wrong(check(altered(made, checks=checks), msrs.root)) == [("count", said)]
    assert (
        wrong(check(altered(made, checks={"counts": {"pairs": 4, "fir": 4}, "min_pairs": 4}), msrs.root))
        == []
    )


def test_names_that_hardly_pair_are_wrong_and_a_few_left_over_are_not(msrs: Tree) -> None:
    made = load_manifest("msrs")
    (msrs.root / msrs.frames[0]["rgb"]).unlink()
    report = check(made, msrs.root)
    assert report.ok
    assert [one["role"] for one in report.pairs[0].unmatched] == ["fir"]
    for k in (1, 2):
        path = msrs.root / msrs.frames[k]["rgb"]
        path.rename(path.with_stem(f"{path.stem}x"))
    report = check(made, msrs.root)
    assert wrong(report) == [("pairs", "only 1 of 4 thermal files pair by stem")]


def test_nothing_that_pairs_is_wrong(msrs: Tree) -> None:
    for frame in msrs.frames:
        path = msrs.root / frame["rgb"]
        path.rename(path.with_stem(f"{path.stem}x"))
    ((kind, text),) = wrong(check(load_manifest("msrs"), msrs.root))
    assert kind == "pairs"
    assert "no pair by stem among 4 RGB" in text


def test_what_is_looked_at_is_the_same_every_time() -> None:
    assert sample(0) == []
    assert sample(3) == [0, 1, 2]
    assert sample(8) == list(range(8))
    picked = sample(1000)
    assert picked == sample(1000)
    assert len(picked) == 8
    assert {0, 1, 998, 999} <= set(picked)


# --- clouds, depth, stamps


def test_clouds_and_depth_maps_that_are_none(tmp_path: Path) -> None:
    made = load_manifest("kitti_raw")
    tree = build(made, tmp_path)
    paths = [tmp_path / frame["lidar"] for frame in tree.frames]
    paths[0].write_bytes(b"x" * 17)
    paths[1].write_bytes(b"")
    report = check(made, tmp_path)
    assert [kind for kind, _ in wrong(report)] == ["unreadable", "unreadable"]
    assert all(str(path) in text for path, (_, text) in zip(paths[:2], wrong(report), strict=True))
    assert next(seen for seen in report.roles if seen.role == "lidar").points == [20, 20]

    made = load_manifest("kitti_depth")
    tree = build(made, tmp_path / "depth")
    path = rewrite(tree, "sparse", np.full((48, 64), 200, np.uint8))
    assert wrong(check(made, tmp_path / "depth")) == [
        ("unreadable", f"{path}: expected a depth map of 16-bit grey, found uint8 of shape (48, 64)")
    ]


def test_depth_must_have_the_size_of_its_rgb_image(tmp_path: Path) -> None:
    made = load_manifest("ms2")
    tree = build(made, tmp_path)
    path = rewrite(tree, "depth", np.full((10, 20), 200, np.uint16))
    assert wrong(check(made, tmp_path)) == [
        ("size", f"{path} is 20x10, its RGB image 64x48: it cannot lie on it")
    ]


def test_time_must_rise(tmp_path: Path) -> None:
    made = load_manifest("kitti_raw")
    build(made, tmp_path)
    path = tmp_path / "1" / "1_sync" / "velodyne_points" / "timestamps.txt"
    path.write_text("2011-09-26 13:02:25.9\n2011-09-26 13:02:25.8\n")
    ((kind, text),) = wrong(check(made, tmp_path))
    assert kind == "stamps"
    assert "lidar: time does not rise at 1 files" in text
    assert "1/1_sync/velodyne_points/data/0000000001.bin" in text
    path.write_text("2011-09-26 13:02:25.9\n2011-09-26 13:02:25.9\n")  # equal times do not rise
    assert [kind for kind, _ in wrong(check(made, tmp_path))] == ["stamps"]
    path.write_text("2001-01-01 00:00:00.1\n2001-01-01 00:00:00.2\n")  # another drive may be older
    assert wrong(check(made, tmp_path)) == []
    path.write_text("soon\n")
    assert ("stamps", "line 1: 'soon' is no time") in [
        (kind, text.split("timestamps.txt ")[-1].split(" (")[0])
        for kind, text in wrong(check(made, tmp_path))
    ]


def test_a_name_without_its_stamp(tmp_path: Path) -> None:
    made = load_manifest("mine")
    tree = build(made, tmp_path)
    write_role(tmp_path / "rgb" / "preview.png", made, "rgb")
    report = check(made, tmp_path)
    assert [kind for kind, _ in wrong(report)] == ["stamps"]
    assert "rgb: 1 of 5 files have no time stamp" in wrong(report)[0][1]
    seen = next(seen for seen in report.roles if seen.role == "rgb")
    stems = [int(Path(frame["rgb"]).stem) for frame in tree.frames]
    assert (seen.first_ns, seen.last_ns) == (stems[0] * 10**9, stems[-1] * 10**9)


def test_stamps_are_looked_for_where_the_keys_point(tmp_path: Path) -> None:
    """A counter of 13 digits at the end of each name would read as a stamp."""
    keys = {"by": "stamp", "rgb_key": "^([0-9]+)_", "fir_key": "^([0-9]+)_"}
    made = altered(load_manifest("mine"), pairing=keys)
    for k in range(3):
        for role in ("rgb", "fir"):
            write_role(tmp_path / role / f"{17 * 10**17 + k * 10**8}_{10**12 - k}.png", made, role)
    report = check(made, tmp_path)
    assert wrong(report) == []
    assert {seen.first_ns for seen in report.roles} == {17 * 10**17}


def test_roles_that_are_not_there_and_sets_that_do_not_pair_are_noted(tmp_path: Path) -> None:
    made = load_manifest("kitti_object")
    tree = build(made, tmp_path)
    for frame in tree.frames:
        (tmp_path / frame["lidar"]).unlink()
    report = check(made, tmp_path)
    assert report.ok
    assert noted(report, "missing") == ["no lidar files: the set can be used without"]

    made = load_manifest("flir_adas_v2_images")
    build(made, tmp_path / "flir")
    report = check(made, tmp_path / "flir")
    assert report.ok
    assert report.pairs == []
    assert "use flir_adas_v2," in noted(report, "unpaired")[0]


# --- calibration


def test_a_calibration_of_other_images_is_wrong(tmp_path: Path) -> None:
    made = load_manifest("mine")
    build(made, tmp_path)
    assert check(made, tmp_path).ok
    other = altered(made, checks={"fir_size_wh": [320, 256]})
    save_rig(tmp_path / "truth" / "rig.toml", rig_for(other))
    rig = tmp_path / "truth" / "rig.toml"
    assert wrong(check(made, tmp_path)) == [
        ("calibration", f"{rig}: it is for fir images of 320x256, these are 64x48")
    ]
    rig.write_text("not a rig")
    ((kind, text),) = wrong(check(made, tmp_path))
    assert (kind, str(rig) in text) == ("calibration", True)
    rig.unlink()
    report = check(made, tmp_path)
    assert report.ok
    assert noted(report, "calibration") == [f"no calibration matches '{rig}'"]


def test_a_calibration_that_is_not_read_is_said_with_the_reason(tmp_path: Path) -> None:
    made = load_manifest("ms2")
    build(made, tmp_path)
    report = check(made, tmp_path)
    assert len(report.calibration) == 1
    assert report.calibration[0].startswith("2 files, not read: calib.npy is a pickled object")


# --- for machines


def test_json_names_every_unmatched_file(msrs: Tree, checked: Callable[..., Answer]) -> None:
    made = load_manifest("msrs")
    for k in range(10):
        write_role(msrs.root / "t0" / "vi" / f"extra{k}.png", made, "rgb")
    code, out = checked("msrs", msrs.root, json=True)
    report = json.loads(out)
    assert (code, report["ok"], report["format"]) == (0, True, "fusion-dataset-check/1")
    lost = report["pairs"][0]["unmatched"]
    assert {Path(one["where"]).stem for one in lost} == {f"extra{k}" for k in range(10)}
    assert {one["reason"][:23] for one in lost} == {"no thermal image with k"}
    assert "and 5 more" in checked("msrs", msrs.root).out
