"""Every manifest in `datasets/`: its layout is built in miniature and must pair as the manifest says."""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest

from fusion.cli.datasets import list_datasets, show_dataset
from fusion.manifest import Manifest, load_manifest
from fusion.pairing import Pairing, PairingRule, pair
from fusion.sources import open_source
from fusion.sources.base import Source

DATASETS = Path(__file__).parents[1] / "datasets"
PATHS = sorted(DATASETS.glob("*.toml"))
REGISTERED = {"mil_multispectral": False, "msrs": True, "pst900": True, "roadscene": True}

# What lies in the real sets, by their own listings: pairs, and files that must not be taken for images.
RECIPES: dict[str, tuple[list[tuple[str, str]], list[str]]] = {
    "mil_multispectral": (
        [("Images/rgb/04005.png", "Images/fir/04005.png"), ("Images/rgb/04006.png", "Images/fir/04006.png")],
        ["Images/nir/04005.png", "Images/mir/04005.png", "labels/rgb/04005.txt"],
    ),
    "msrs": (
        [
            ("test/vi/00537D.png", "test/ir/00537D.png"),
            ("train/vi/00537D.png", "train/ir/00537D.png"),  # one name in both parts is two pairs
            ("train/vi/00881N.png", "train/ir/00881N.png"),
        ],
        [
            "detection/vi/1042.png",
            "detection/ir/1042.png",
            "test/Segmentation_labels/00537D.png",
            "README.md",
        ],
    ),
    "pst900": (
        [
            (f"{part}/rgb/{name}.png", f"{part}/thermal/{name}.png")
            for part in ("test", "train")
            for name in ("31_bag1a_rect_rgb_frame0000000007", "31_bag1a_rect_rgb_frame0000000012")
        ],
        [f"test/{kind}/31_bag1a_rect_rgb_frame0000000007.png" for kind in ("thermal_raw", "depth", "labels")],
    ),
    "roadscene": (
        [(f"crop_LR_visible/FLIR_{k}.jpg", f"cropinfrared/FLIR_{k}.jpg") for k in ("00006", "05164")],
        ["crop_HR_visible/FLIR_05164.jpg"],
    ),
}


def write_image(path: Path, manifest: Manifest, role: str) -> None:
    """A small image of the role's kind, of no size in particular."""
    path.parent.mkdir(parents=True, exist_ok=True)
    shape = {"rgb": (6, 8, 3), "fir": (6, 8), "rgbt": (6, 8, 4)}[role]
    deep = role == "fir" and manifest.checks.fir_bits == 16
    ramp = np.arange(np.prod(shape)).reshape(shape)
    assert cv2.imwrite(str(path), (ramp * 100).astype(np.uint16) if deep else ramp.astype(np.uint8))


def from_pattern(pattern: str, k: int) -> str:
    """The k-th file that a pattern stands for; what `*` becomes also reads as a time stamp in seconds."""
    assert not re.search(r"\[[!^]", pattern), "name a set without negation"
    return (
        re.sub(r"\[(.)[^]]*\]", r"\1", pattern).replace("?", str(k)).replace("*", str(1_600_000_000 + 60 * k))
    )


def miniature(manifest: Manifest, root: Path) -> list[list[str]]:
    """Build the layout with three frames from the manifest's own patterns; gives the files of each frame."""
    frames = [[from_pattern(pattern, k) for _, pattern in manifest.layout()] for k in range(3)]
    for frame in frames:
        for (role, _), name in zip(manifest.layout(), frame, strict=True):
            write_image(root / name, manifest, role)
    if manifest.pairing is not None and manifest.pairing.map_file is not None:
        table = root / manifest.pairing.map_file
        table.parent.mkdir(parents=True, exist_ok=True)
        csv = "\n".join(["rgb,fir", *(",".join(frame) for frame in frames)])
        table.write_text(
            json.dumps({frame[0]: frame[1] for frame in frames}) if table.suffix == ".json" else csv
        )
    return frames


def pair_below(manifest: Manifest, root: Path) -> tuple[Pairing, Source, Source, list[tuple[str, str]]]:
    """Pair `root` as the command does; the last item is the paired files relative to `root`."""
    rgb_glob, fir_glob = manifest.globs(root)
    assert fir_glob is not None
    rgb, fir = open_source(rgb_glob, "rgb"), open_source(fir_glob, "fir")
    got = pair(rgb.entries, fir.entries, manifest.pairing_rule(root))
    names = [
        tuple(
            Path(source.entries[k].where).relative_to(root).as_posix() for source, k in ((rgb, i), (fir, j))
        )
        for i, j, _ in got.pairs
    ]
    return got, rgb, fir, [(a, b) for a, b in names]


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_a_manifest_pairs_the_layout_it_describes(path: Path, tmp_path: Path) -> None:
    manifest = load_manifest(path)
    frames = miniature(manifest, tmp_path / "root")
    if manifest.rgbt is not None:
        assert manifest.globs(tmp_path / "root")[1] is None
        return
    got, rgb, fir, names = pair_below(manifest, tmp_path / "root")
    assert sorted(names) == sorted((a, b) for a, b in frames)
    assert not got.unmatched
    i, j, _ = got.pairs[0]
    assert rgb.read(i).pixels.shape == (6, 8, 3)
    assert fir.read(j).pixels.dtype == (np.uint16 if manifest.checks.fir_bits == 16 else np.uint8)


@pytest.mark.parametrize("name", sorted(RECIPES))
@pytest.mark.parametrize("folder", ["root", "my [copy] 1"])
def test_a_known_set_pairs_its_real_names_and_nothing_else(name: str, folder: str, tmp_path: Path) -> None:
    manifest = load_manifest(DATASETS / f"{name}.toml")
    root, (pairs, others) = tmp_path / folder, RECIPES[name]
    for rgb, fir in pairs:
        write_image(root / rgb, manifest, "rgb")
        write_image(root / fir, manifest, "fir")
    for other in others:
        (root / other).parent.mkdir(parents=True, exist_ok=True)
        (root / other).write_bytes(b"not to be read")
    got, _, _, names = pair_below(manifest, root)
    assert sorted(names) == sorted(pairs)
    assert not got.unmatched
    assert manifest.registered is REGISTERED[name]


@pytest.mark.parametrize("name", sorted(RECIPES))
def test_a_frame_without_its_thermal_image_is_reported(name: str, tmp_path: Path) -> None:
    manifest = load_manifest(DATASETS / f"{name}.toml")
    (first, *rest), _ = RECIPES[name]
    write_image(tmp_path / first[0], manifest, "rgb")
    for rgb, fir in rest:
        write_image(tmp_path / rgb, manifest, "rgb")
        write_image(tmp_path / fir, manifest, "fir")
    got, _, _, names = pair_below(manifest, tmp_path)
    assert sorted(names) == sorted(rest)
    assert [(u.role, u.where) for u in got.unmatched] == [("rgb", str(tmp_path / first[0]))]


def test_the_four_sets_and_the_template_are_there() -> None:
    assert {path.stem for path in PATHS} >= {*RECIPES, "template"}


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_licence_citation_and_reason_are_stated(path: Path) -> None:
    manifest = load_manifest(path)
    assert len(manifest.licence) > 2
    assert re.search(r"20\d\d|year", manifest.citation)
    assert "\n" not in manifest.title + manifest.licence + manifest.registration_note


def test_the_template_explains_every_key() -> None:
    """Every key of the model stands in the template, set or commented out, below a comment."""
    lines = (DATASETS / "template.toml").read_text(encoding="utf-8").splitlines()
    keys = Counter(m[1] for line in lines if (m := re.match(r"(?:# )?\[?([a-z_]+)\]?(?: =|$)", line)))
    wanted = set(Manifest.model_fields)
    for part in Manifest.model_fields["pairing"].annotation, Manifest.model_fields["checks"].annotation:
        for model in getattr(part, "__args__", (part,)):
            wanted |= set(getattr(model, "model_fields", ()))
    assert wanted <= set(keys)


def test_no_python_and_nothing_unexpected_under_datasets() -> None:
    files = [path for path in DATASETS.rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".toml", ".md"}
    assert len(files) == len(PATHS) + 1


def test_real_msrs_frames_fit_the_checks(shared_data: Path) -> None:
    manifest = load_manifest(DATASETS / "msrs.toml")
    folder = shared_data / "rgbt_pairs" / "MSRS"
    rgb, fir = open_source(folder / "vi", "rgb"), open_source(folder / "ir", "fir")
    got = pair(rgb.entries, fir.entries, PairingRule("stem"))
    assert len(got.pairs) == 5
    assert not got.unmatched
    assert manifest.differences(pairs=5, rgb=rgb.read(0), fir=fir.read(0)) == []


def test_the_commands_list_and_show_every_set(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("FUSION_DATASETS", raising=False)
    list_datasets()
    listed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in listed if line.split()[0] in RECIPES] == sorted(RECIPES)
    assert {line.split()[0] for line in listed if line.split()[1] == "unregistered"} >= {"mil_multispectral"}
    assert not any(line.startswith("template") for line in listed)
    show_dataset("mil_multispectral")
    shown = capsys.readouterr().out
    for text in (
        "Images/fir/*.png",
        "https://www.mi.t.u-tokyo.ac.jp",
        "Takumi",
        "registered",
        "--homography",
    ):
        assert text in shown
