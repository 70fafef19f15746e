"""Every manifest in `datasets/`: its layout is built in miniature, and must be found and used as it says."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from shutil import copytree
from typing import NamedTuple

import numpy as np
import pytest
from pydantic import BaseModel

from fusion.cli.blending import manifest_of, open_inputs
from fusion.cli.datasets import check_dataset, list_datasets, show_dataset
from fusion.config import BlendConfig
from fusion.errors import FusionError, InputError
from fusion.manifest import ROLES, TEMPLATES, Manifest, load_manifest
from fusion.pairing import PairingRule, pair
from fusion.sources import open_source
from tests.dataset_recipes import RECIPES, STATES
from tests.dataset_trees import COUNT, PICKLED, Tree, build, frame_files, from_pattern, write_role

DATASETS = Path(__file__).parents[1] / "datasets"
PATHS = sorted(DATASETS.glob("*.toml"))
MANIFESTS = {path.stem: load_manifest(path) for path in PATHS}
OF_FILES = [name for name, manifest in MANIFESTS.items() if manifest.recording is None]
PAIRED = [name for name in OF_FILES if MANIFESTS[name].fir is not None and MANIFESTS[name].paired]
SECOND = {  # of each set of files a role that goes with the leading one
    name: next(role for role, _ in MANIFESTS[name].layout() if role != MANIFESTS[name].lead())
    for name in OF_FILES
    if len(MANIFESTS[name].layout()) > 1 and MANIFESTS[name].paired
}


class Answer(NamedTuple):
    code: int
    out: str
    err: str


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Answer]:
    """Call a command's function; gives its exit code and what it printed."""
    monkeypatch.delenv("FUSION_DATASETS", raising=False)

    def call(function: Callable[..., None], *words: object, **options: object) -> Answer:
        code = 0
        try:
            function(*words, **options)
        except SystemExit as ended:
            code = int(ended.code or 0)
        said = capsys.readouterr()
        return Answer(code, said.out, said.err)

    return call


def relative(root: Path, path: str | Path) -> str:
    return Path(path).relative_to(root).as_posix()


def pairs_below(manifest: Manifest, root: Path, role: str) -> list[tuple[str, str]]:
    partners = manifest.plan(root).partners(role)
    return sorted(
        (relative(root, partners.lead[i]), relative(root, partners.files[j]))
        for i, j, _ in partners.pairing.pairs
    )


def checked(command: Callable[..., Answer], name: str, root: Path) -> tuple[int, dict]:
    answer = command(check_dataset, str(DATASETS / f"{name}.toml"), root, json=True)
    return answer.code, json.loads(answer.out)


# --- the files are found, and go together as they should


@pytest.mark.parametrize("folder", ["root", "my [copy] 1"])
@pytest.mark.parametrize("name", OF_FILES)
def test_what_is_built_is_found_and_pairs(name: str, folder: str, tmp_path: Path) -> None:
    manifest, root = MANIFESTS[name], tmp_path / folder
    tree = build(manifest, root)
    layout = manifest.plan(root)
    assert layout.missing == ()
    for role, _ in manifest.layout():
        assert [relative(root, p) for p in layout[role].files] == [frame[role] for frame in tree.frames]
        if role != layout.lead and manifest.paired:
            assert pairs_below(manifest, root, role) == sorted(tree.pairs(layout.lead, role))
    sequences = {layout.sequence_of(path) for path in layout[layout.lead].files}
    several = "*" in manifest.files_of(layout.lead).files.rpartition("/")[0]
    assert len(sequences) == (2 if several else 1)


@pytest.mark.parametrize("name", PAIRED)
def test_blend_gets_the_pairs_with_their_pixels(name: str, tmp_path: Path) -> None:
    """Through the same functions as the command: colour, counts of the right depth, the sizes stated."""
    manifest = MANIFESTS[name]
    build(manifest, tmp_path)
    pairs = open_inputs(BlendConfig.of(), [str(tmp_path)], manifest)
    assert len(pairs) == COUNT
    assert not pairs.pairing.unmatched
    frames = pairs.read(0)
    assert frames.bgr.shape[2] == 3
    mosaic = manifest.rgb is not None and manifest.rgb.bayer is not None
    assert ("rgb-demosaiced" in frames.rgb.flags) is mosaic
    assert frames.counts.dtype == (np.uint16 if manifest.checks.fir_bits == 16 else np.uint8)
    fits = manifest.differences(rgb=frames.rgb, fir=frames.fir)
    assert fits == []


@pytest.mark.parametrize("name", OF_FILES)
def test_check_finds_nothing_wrong_but_that_it_is_small(
    name: str, tmp_path: Path, command: Callable[..., Answer]
) -> None:
    manifest = MANIFESTS[name]
    build(manifest, tmp_path)
    code, report = checked(command, name, tmp_path)
    wrong = [finding for finding in report["findings"] if finding["wrong"]]
    published = [value for value in manifest.checks.counts.model_dump().values() if value is not None]
    assert len(wrong) == len(published)
    assert {finding["kind"] for finding in wrong} <= {"count"}
    assert code == (1 if published else 0)
    assert report["ok"] is not bool(published)
    assert {seen["role"]: seen["files"] for seen in report["roles"]} == {
        r: COUNT for r, _ in manifest.layout()
    }
    assert not (tmp_path / PICKLED).exists()


@pytest.mark.parametrize("name", sorted(SECOND))
def test_a_file_without_a_partner_is_reported_with_its_reason(
    name: str, tmp_path: Path, command: Callable[..., Answer]
) -> None:
    manifest, role = MANIFESTS[name], SECOND[name]
    tree = build(manifest, tmp_path)
    extra = frame_files(manifest, 5)[role]  # a third sequence, or a minute later
    write_role(tmp_path / extra, manifest, role)
    _, report = checked(command, name, tmp_path)
    (seen,) = [pairs for pairs in report["pairs"] if pairs["role"] == role]
    assert seen["pairs"] == COUNT
    ((lost),) = seen["unmatched"]
    assert (lost["role"], relative(tmp_path, lost["where"])) == (role, extra)
    assert len(lost["reason"]) > 10
    assert extra not in [frame[role] for frame in tree.frames]
    told = command(check_dataset, str(DATASETS / f"{name}.toml"), tmp_path).out
    assert lost["reason"] in told


@pytest.mark.parametrize("name", sorted(RECIPES))
def test_a_known_set_pairs_its_real_names_and_nothing_else(name: str, tmp_path: Path) -> None:
    manifest, (pairs, others) = MANIFESTS[name], RECIPES[name]
    for rgb, fir in pairs:
        write_role(tmp_path / rgb, manifest, "rgb")
        write_role(tmp_path / fir, manifest, "fir")
    for other in others:
        (tmp_path / other).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / other).write_bytes(b"not to be read")
    assert pairs_below(manifest, tmp_path, "fir") == sorted(pairs)
    assert not manifest.plan(tmp_path).partners("fir").pairing.unmatched


@pytest.mark.parametrize("name", sorted(RECIPES))
def test_a_frame_without_its_thermal_image_is_reported(name: str, tmp_path: Path) -> None:
    manifest, (first, *rest) = MANIFESTS[name], RECIPES[name][0]
    write_role(tmp_path / first[0], manifest, "rgb")
    for rgb, fir in rest:
        write_role(tmp_path / rgb, manifest, "rgb")
        write_role(tmp_path / fir, manifest, "fir")
    if name == "sthereo":  # two stamps are left, from which a tolerance follows
        assert len(rest) == 2
    partners = manifest.plan(tmp_path).partners("fir")
    assert [(u.role, relative(tmp_path, u.where)) for u in partners.pairing.unmatched] == [("rgb", first[0])]


# --- what cannot be blended is refused, with the way out


def refusal(name: str, **warp: object) -> str:
    with pytest.raises(InputError) as caught:
        manifest_of(str(DATASETS / f"{name}.toml"), BlendConfig.of(warp=warp), ["root"])
    return str(caught.value)


@pytest.mark.parametrize("name", [n for n, m in MANIFESTS.items() if m.state == "unregistered"])
def test_an_unregistered_set_is_refused_without_a_registration(name: str) -> None:
    assert re.search(r"not registered.*--rig FILE.*--homography FILE.*--align", refusal(name))
    assert manifest_of(str(DATASETS / f"{name}.toml"), BlendConfig.of(warp={"align": True}), ["root"])


@pytest.mark.parametrize("name", [n for n, m in MANIFESTS.items() if m.state == "lidar only"])
def test_a_set_without_thermal_images_is_refused_whatever_is_given(name: str) -> None:
    assert re.search(r"no thermal images.*fusion depth", refusal(name))
    assert "no thermal images" in refusal(name, align=True)


def test_a_set_that_does_not_pair_is_refused_whatever_is_given() -> None:
    (name,) = (n for n, m in MANIFESTS.items() if m.state == "unpaired")
    for warp in ({}, {"align": True}):
        assert re.search(r"are not pairs \(use flir_adas_v2,", refusal(name, **warp))


def test_a_recording_is_sent_to_preprocess(tmp_path: Path) -> None:
    manifest = MANIFESTS["template_recording"]
    path = tmp_path / from_pattern("flight_*/*.bag", 0)
    path.parent.mkdir()
    path.write_bytes(b"")
    with pytest.raises(InputError, match="fusion preprocess template_recording ROOT"):
        open_inputs(BlendConfig.of(), [str(tmp_path)], manifest)


@pytest.mark.parametrize("name", sorted(MANIFESTS))
def test_an_empty_root_says_what_was_expected(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"does not hold {name}: .*expected ROOT/"):
        MANIFESTS[name].plan(tmp_path)


# --- the files themselves


def test_every_set_is_there_and_in_its_state() -> None:
    assert {name: m.state for name, m in MANIFESTS.items() if name not in TEMPLATES} == STATES
    assert set(MANIFESTS) >= TEMPLATES


@pytest.mark.parametrize("name", sorted(MANIFESTS))
def test_licence_citation_and_reason_are_stated(name: str) -> None:
    manifest = MANIFESTS[name]
    assert len(manifest.licence) > 2
    assert re.search(r"20\d\d|year", manifest.citation)
    assert "\n" not in manifest.title + manifest.licence + manifest.registration_note
    assert manifest.url is not None or name in ("mine", "template_recording")


def keys_of(model: type[BaseModel]) -> set[str]:
    """Every key of a model and of the tables in it."""
    keys: set[str] = set()
    for key, field in model.model_fields.items():
        keys.add(key)
        kinds = (field.annotation, *getattr(field.annotation, "__args__", ()))
        for kind in kinds:
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                keys |= keys_of(kind)
    return keys


def test_the_templates_explain_every_key() -> None:
    """Every key of the model stands in one of the templates, set or commented out."""
    lines = [line for name in TEMPLATES for line in (DATASETS / f"{name}.toml").read_text().splitlines()]
    written = {m[1] for line in lines if (m := re.match(r"(?:# )?\[?(?:\w+\.)?([a-z_]+)\]?(?: =|$)", line))}
    in_a_sentence = {"rgb", "fir", "rgbt", "lidar", "depth", "sparse", "pairs"}  # of [checks.counts]
    assert keys_of(Manifest) - in_a_sentence <= written


@pytest.mark.parametrize("name", sorted(TEMPLATES))
def test_what_a_template_leaves_out_may_be_put_in(name: str, tmp_path: Path) -> None:
    """A commented line that has a value is right in its table, where it does not contradict what is there."""
    text = (DATASETS / f"{name}.toml").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if re.match(r"# [a-z_]+ = ", line)]
    assert len(lines) >= 2
    contradicting = (
        "stamp_files",
        "map_file",
        "unpaired_note",
        "files",
        "per_metre",
        "value",
        "tolerance_ms = 20.0",
    )
    for line in lines:
        if line.removeprefix("# ").startswith(contradicting):
            continue
        path = tmp_path / f"{name}.toml"
        path.write_text(text.replace(line, line.removeprefix("# "), 1), encoding="utf-8")
        assert load_manifest(path).name == name


def test_no_python_and_nothing_unexpected_under_datasets() -> None:
    files = [path for path in DATASETS.rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".toml", ".md"}
    assert len(files) == len(PATHS) + 1


def test_real_msrs_frames_fit_the_checks(shared_data: Path) -> None:
    manifest = MANIFESTS["msrs"]
    folder = shared_data / "rgbt_pairs" / "MSRS"
    rgb, fir = open_source(folder / "vi", "rgb"), open_source(folder / "ir", "fir")
    got = pair(rgb.entries, fir.entries, PairingRule("stem"))
    assert len(got.pairs) == 5
    assert not got.unmatched
    assert manifest.differences(rgb=rgb.read(0), fir=fir.read(0)) == []


def test_real_kitti_frames_fit_their_manifests(
    shared_data: Path, tmp_path: Path, command: Callable[..., Answer]
) -> None:
    for kind in ("image_2", "velodyne", "calib"):
        copytree(shared_data / "kitti_object" / kind, tmp_path / "training" / kind)
    code, report = checked(command, "kitti_object", tmp_path)
    assert (code, [f["text"] for f in report["findings"] if f["wrong"]]) == (0, [])
    assert report["pairs"][0]["pairs"] == 1
    lidar = next(seen for seen in report["roles"] if seen["role"] == "lidar")
    size = (tmp_path / "training" / "velodyne" / "000000.bin").stat().st_size
    assert lidar["points"] == [size // 16]  # four float32 a point


# --- the commands


def test_list_shows_every_set_with_its_state(command: Callable[..., Answer]) -> None:
    rows = [re.split(r"\s{2,}", line, maxsplit=2) for line in command(list_datasets).out.splitlines()]
    ours = {row[0]: row[1] for row in rows if row[0] in STATES}
    assert ours == STATES
    assert not {row[0] for row in rows} & TEMPLATES


@pytest.mark.parametrize("name", sorted(MANIFESTS))
def test_show_says_what_the_manifest_says(name: str, command: Callable[..., Answer]) -> None:
    manifest = MANIFESTS[name]
    shown = command(show_dataset, name).out
    for _, pattern in manifest.layout():
        assert f"ROOT/{pattern}" in shown
    for text in (
        manifest.title,
        manifest.licence,
        manifest.citation,
        manifest.registration_note,
        manifest.state,
    ):
        assert text in shown
    for role in set(ROLES) - {role for role, _ in manifest.layout()}:
        assert not re.search(rf"^{role} +ROOT", shown, re.MULTILINE)
    if manifest.calibration is not None:
        assert manifest.calibration.files in shown


def test_check_of_a_root_that_is_not_the_set(tmp_path: Path, command: Callable[..., Answer]) -> None:
    code, report = checked(command, "kaist", tmp_path)
    assert (code, report["ok"]) == (1, False)
    assert "does not hold kaist" in report["findings"][0]["text"]


def test_the_commands_parse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Registered as they will be: a name, a root, two flags."""
    from cyclopts import App

    app = App(name="datasets")
    app.command(check_dataset, name="check")
    bound = app.parse_args(["check", "msrs", "root", "--json", "--alignment"], exit_on_error=False)[1]
    assert bound.arguments == {"name": "msrs", "root": Path("root"), "json": True, "alignment": True}
    assert "fusion.cli.dataset_checks" in sys.modules
    monkeypatch.undo()


@pytest.fixture
def kaist(tmp_path: Path) -> Tree:
    return build(MANIFESTS["kaist"], tmp_path)


def test_a_link_out_of_the_root_is_wrong(
    kaist: Tree, tmp_path_factory: pytest.TempPathFactory, command: Callable[..., Answer]
) -> None:
    outside = tmp_path_factory.mktemp("outside") / "I9.jpg"
    write_role(outside, MANIFESTS["kaist"], "rgb")
    (kaist.root / "images" / "set0" / "V0" / "visible" / "I9.jpg").symlink_to(outside)
    code, report = checked(command, "kaist", kaist.root)
    assert code == 1
    assert "leads out of the data set's root" in report["findings"][0]["text"]
    with pytest.raises(FusionError, match="leads out"):
        MANIFESTS["kaist"].plan(kaist.root)
