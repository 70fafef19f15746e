"""Manifests: refused unless sound, found by name, and never a way out of the root."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from fusion import manifest as module
from fusion.errors import InputError, UsageError
from fusion.frames import Image
from fusion.manifest import Manifest, list_manifests, load_manifest
from fusion.sources import open_source

GOOD = """
format = "fusion-dataset/1"
name = "good"
title = "A set"
licence = "CC0"
citation = "Nobody, 2020"
url = "https://example.org/good"
registered = true
registration_note = "one lens"
[rgb]
files = "vi/*.png"
[fir]
files = "ir/*.png"
"""
CHANNELS = GOOD.split("[rgb]")[0] + '[rgbt]\nfiles = "images/*.png"\n'


def write(folder: Path, text: str = GOOD, name: str = "good") -> Path:
    path = folder / f"{name}.toml"
    path.write_text(text, encoding="utf-8")
    return path


def touch(root: Path, *names: str) -> None:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"x")


@pytest.fixture
def good(tmp_path: Path) -> Manifest:
    return load_manifest(write(tmp_path))


# --- what is written in the file ------------------------------------------------------------------


def test_a_sound_manifest_says_what_was_written(good: Manifest) -> None:
    assert good.layout() == [("rgb", "vi/*.png"), ("fir", "ir/*.png")]
    assert good.registered is True
    assert good.pairing is None
    assert good.notes is None


@pytest.mark.parametrize(
    "text",
    [
        GOOD.replace("fusion-dataset/1", "fusion-dataset/2"),
        GOOD.replace('title = "A set"', ""),
        GOOD.replace('title = "A set"', 'title = " "'),
        GOOD.replace('title = "A set"', r'title = "\u001b[2J"'),
        GOOD.replace('url = "https://example.org/good"', 'url = "file:///etc/passwd"'),
        GOOD.replace("registered = true", 'registered = "yes"'),
        GOOD.replace("registered = true", "registered = 1"),
        GOOD.replace('registration_note = "one lens"', ""),
        "extra = 1\n" + GOOD,
        GOOD + 'suffix = ".png"\n',
        GOOD + "[checks]\ndepth = 8\n",
        GOOD + "[checks]\nfir_bits = 12\n",
        GOOD + "[checks]\nrgb_size_wh = [640]\n",
        GOOD + "[checks]\nrgb_size_wh = [640, 0]\n",
        GOOD + '[checks]\nrgb_size_wh = ["640", "480"]\n',
        GOOD + '[pairing]\nby = "auto"\n',
        GOOD + '[pairing]\nby = "name"\n',
        GOOD + '[pairing]\nby = "stem"\nrgb_key = "("\n',
        GOOD + '[pairing]\nby = "map"\n',
        GOOD + '[pairing]\nby = "map"\nmap_file = "../map.csv"\n',
        GOOD + '[pairing]\nby = "map"\nmap_file = "*.csv"\n',
        GOOD + '[pairing]\nby = "stamp"\ntolerance_ms = 0\n',
        GOOD + '[pairing]\nby = "stamp"\ntolerance_ms = inf\n',
        GOOD + '[pairing]\nby = "stem"\ntolerance_ms = 5\n',
        GOOD.split("[fir]")[0],
        GOOD + '[rgbt]\nfiles = "all/*.png"\n',
        CHANNELS + '[pairing]\nby = "stem"\n',
        GOOD + "not toml",
        "[" * 100_000,
        "",
    ],
)
def test_unsound_manifests_are_refused_in_one_line(tmp_path: Path, text: str) -> None:
    with pytest.raises(UsageError, match=r"good\.toml") as caught:
        load_manifest(write(tmp_path, text))
    assert "\n" not in str(caught.value)


def test_the_place_of_a_fault_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"checks\.fir_bits.*8 or 16"):
        load_manifest(write(tmp_path, GOOD + "[checks]\nfir_bits = 12\n"))


@pytest.mark.parametrize(
    "pattern",
    [
        "/etc/*.png",
        "../x/*.png",
        "vi/../../x.png",
        "C:/x/*.png",
        "c:x.png",
        "a\\\\b.png",
        "~/x.png",
        "./a.png",
        "a//b.png",
        "",
        "**/*.png",
        "{a,b}/*.png",
        "a\\u0000b.png",
        "a/",
        "..",
    ],
)
def test_patterns_that_could_leave_the_root_or_mislead_are_refused(tmp_path: Path, pattern: str) -> None:
    with pytest.raises(UsageError, match=r"rgb\.files"):
        load_manifest(write(tmp_path, GOOD.replace("vi/*.png", pattern)))


def test_file_name_and_name_must_agree(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="calls itself 'good'"):
        load_manifest(write(tmp_path, name="other"))


def test_files_that_are_no_manifests(tmp_path: Path) -> None:
    big = tmp_path / "big.toml"
    with big.open("wb") as file:
        file.truncate(module.MAX_MANIFEST_BYTES + 1)
    latin = tmp_path / "latin.toml"
    latin.write_bytes(b'name = "\xe9"')
    (tmp_path / "folder.toml").mkdir()
    os.mkfifo(tmp_path / "pipe.toml")
    for name, said in (
        ("big", "over 1 MB"),
        ("latin", "no TOML"),
        ("folder", "no such manifest"),
        ("pipe", "no such manifest"),
        ("gone", "no such manifest"),
    ):
        with pytest.raises(UsageError, match=said):
            load_manifest(tmp_path / f"{name}.toml")


# --- where it is found ----------------------------------------------------------------------------


def test_the_users_folder_comes_first_and_broken_ones_are_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FUSION_DATASETS", str(tmp_path))
    mine = GOOD.replace('"good"', '"msrs"').replace("A set", "My own copy")
    write(tmp_path, mine, "msrs")
    write(tmp_path, "format = 3", "broken")
    write(tmp_path)
    assert load_manifest("msrs").title == "My own copy"
    assert load_manifest("good").title == "A set"
    listed = {item.name: item for item in list_manifests()}
    assert {"good", "broken", "msrs", "pst900"} <= set(listed)
    assert listed["broken"].manifest is None
    assert "broken.toml" in listed["broken"].problem
    assert "template" not in listed


def test_without_the_variable_the_home_folder_is_searched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("FUSION_DATASETS", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    own = tmp_path / ".config" / "fusion" / "datasets"
    own.mkdir(parents=True)
    write(own)
    assert load_manifest("good").name == "good"


def test_an_unknown_name_lists_the_known_and_the_near(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FUSION_DATASETS", raising=False)
    with pytest.raises(
        UsageError, match=r"'MRSS'.*did you mean msrs\b.*known: .*mil_multispectral.*roadscene"
    ):
        load_manifest("MRSS")


def test_a_variable_that_names_no_folder_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FUSION_DATASETS", str(tmp_path / "gone"))
    with pytest.raises(UsageError, match="FUSION_DATASETS"):
        list_manifests()


# --- what it finds below a root -------------------------------------------------------------------


@pytest.mark.parametrize("folder", ["root", "my [set]*", "größe 1"])
def test_globs_find_the_files_whatever_the_root_is_called(
    tmp_path: Path, good: Manifest, folder: str
) -> None:
    root = tmp_path / folder
    touch(root, "vi/1.png", "vi/2.png", "vi/._1.png", "ir/1.png", "vi/note.txt")
    rgb, fir = good.globs(root)
    assert fir is not None
    want = [str(root / "vi" / "1.png"), str(root / "vi" / "2.png")]
    assert [entry.where for entry in open_source(rgb, "rgb").entries] == want
    assert [entry.where for entry in open_source(fir, "fir").entries] == [str(root / "ir" / "1.png")]


def test_four_channel_files_have_one_pattern(tmp_path: Path) -> None:
    manifest = load_manifest(write(tmp_path, CHANNELS))
    touch(tmp_path, "images/1.png")
    assert manifest.globs(tmp_path) == (f"{tmp_path}/images/*.png", None)


def test_a_root_without_the_layout_says_what_was_expected_and_where_to_get_it(
    tmp_path: Path, good: Manifest
) -> None:
    touch(tmp_path / "root", "vi/1.png", "ir/._1.png")
    for root in (tmp_path / "root", tmp_path / "gone"):
        with pytest.raises(InputError) as caught:
            good.globs(root)
        text = str(caught.value)
        assert str(root) in text
        assert "ROOT/vi/*.png and ROOT/ir/*.png" in text
        assert "https://example.org/good" in text


def test_a_root_one_level_off_is_named(tmp_path: Path, good: Manifest) -> None:
    touch(tmp_path / "zip" / "set", "vi/1.png", "ir/1.png")
    for wrong in (tmp_path / "zip", tmp_path / "zip" / "set" / "vi"):
        with pytest.raises(InputError, match="has the layout: give that as the root") as caught:
            good.globs(wrong)
        assert f"{tmp_path}/zip/set has" in str(caught.value)


@pytest.mark.parametrize("linked", ["file", "folder"])
def test_links_out_of_the_root_are_refused_and_links_inside_are_not(
    tmp_path: Path, good: Manifest, linked: str
) -> None:
    root, outside = tmp_path / "root", tmp_path / "outside"
    touch(root, "vi/1.png", "real/1.png")
    touch(outside, "1.png")
    target = outside if linked == "folder" else outside / "1.png"
    inner = root / "real" if linked == "folder" else root / "real" / "1.png"
    link = root / "ir" if linked == "folder" else root / "ir" / "1.png"
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(target)
    with pytest.raises(InputError, match="leads out"):
        good.globs(root)
    link.unlink()
    link.symlink_to(inner)
    assert good.globs(root)[1] == f"{root}/ir/*.png"


def test_a_root_that_is_itself_a_link_is_fine(tmp_path: Path, good: Manifest) -> None:
    touch(tmp_path / "real", "vi/1.png", "ir/1.png")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert good.globs(tmp_path / "link")[0] == f"{tmp_path}/link/vi/*.png"


# --- pairing rule and checks ----------------------------------------------------------------------


def test_pairing_rule_carries_every_part(tmp_path: Path, good: Manifest) -> None:
    assert good.pairing_rule(tmp_path).by == "stem"
    timed = load_manifest(write(tmp_path, GOOD + '[pairing]\nby = "stamp"\ntolerance_ms = 16.7\n'))
    assert timed.pairing_rule(tmp_path).tolerance_ns == 16_700_000
    keyed = load_manifest(write(tmp_path, GOOD + '[pairing]\nby = "index"\nrgb_key = "a"\nfir_key = "b"\n'))
    rule = keyed.pairing_rule(tmp_path)
    assert (rule.by, rule.rgb_key, rule.fir_key) == ("index", "a", "b")


def test_a_mapping_file_must_be_there_and_inside(tmp_path: Path) -> None:
    mapped = load_manifest(write(tmp_path, GOOD + '[pairing]\nby = "map"\nmap_file = "meta/map.json"\n'))
    root = tmp_path / "root"
    root.mkdir()
    with pytest.raises(InputError, match=r"no mapping file 'meta/map\.json'"):
        mapped.pairing_rule(root)
    touch(root, "meta/map.json")
    assert mapped.pairing_rule(root).map_file == str(root / "meta" / "map.json")
    touch(tmp_path, "elsewhere.json")
    (root / "meta" / "map.json").unlink()
    (root / "meta" / "map.json").symlink_to(tmp_path / "elsewhere.json")
    with pytest.raises(InputError, match="leads out"):
        mapped.pairing_rule(root)


def test_differences_from_what_is_known_are_told(tmp_path: Path, good: Manifest) -> None:
    checks = "[checks]\nrgb_size_wh = [8, 6]\nfir_size_wh = [4, 2]\nfir_bits = 16\nmin_pairs = 3\n"
    checked = load_manifest(write(tmp_path, GOOD + checks))
    rgb = Image(np.zeros((6, 8, 3), np.uint8), "a")
    fir = Image(np.zeros((2, 4), np.uint16), "a")
    assert checked.differences(pairs=3, rgb=rgb, fir=fir) == []
    wrong = checked.differences(pairs=2, rgb=Image(np.zeros((8, 6, 3), np.uint8), "a"))
    assert len(wrong) == 2
    assert checked.differences(fir=Image(np.zeros((2, 4), np.uint8), "a")) == [
        "thermal bit depth: good has 16, found 8"
    ]
    assert good.differences(pairs=1, rgb=rgb, fir=fir) == []
    exact = load_manifest(write(tmp_path, GOOD + "[checks.counts]\npairs = 7\n"))
    assert exact.differences(pairs=7) == []
    assert exact.differences(pairs=8) == ["pairs: good has 7, found 8"]
