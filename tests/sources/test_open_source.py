"""Folders, patterns and single files as sources, and the table that names them."""

from __future__ import annotations

import os
import random
import sys
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion.errors import FrameError, InputError
from fusion.sources import SOURCES, Source, open_source
from fusion.sources.folders import FileSource, list_folder, natural_key

GREY = np.arange(48, dtype=np.uint8).reshape(6, 8)


def write(path: Path, pixels: np.ndarray = GREY) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(path.suffix.lower(), pixels)[1].tobytes())
    return path


def stems(source: Source) -> list[str]:
    return [entry.stem for entry in source.entries]


def test_folder_is_sorted_as_people_count(tmp_path: Path) -> None:
    for name in (
        "img10.png",
        "img2.PNG",
        "img1.bmp",
        "Img3.tiff",
        "b.jpg",
        "a 7.webp",
        "温度2.png",
        "温度10.png",
    ):
        write(tmp_path / name)
    source = open_source(tmp_path, "fir")
    assert stems(source) == ["a 7", "b", "img1", "img2", "Img3", "img10", "温度2", "温度10"]
    assert isinstance(source, Source)
    assert (source.read(3).pixels == GREY).all()
    assert source.read(3).stem == "img2"
    assert source.entries[3].stamp_ns is None


def test_folder_looks_past_what_is_no_image(tmp_path: Path) -> None:
    write(tmp_path / "a.png")
    write(tmp_path / ".hidden.png")
    write(tmp_path / "below" / "b.png")
    (tmp_path / "c.png.d").mkdir()
    (tmp_path / "dir.png").mkdir()
    for name in ("notes.txt", "png", "flow.mat", "a.png.part"):
        (tmp_path / name).write_text("x")
    source = open_source(tmp_path, "fir")
    assert stems(source) == ["a"]
    assert isinstance(source, FileSource)
    assert source.ignored == 4


def test_same_stem_twice_stays_twice(tmp_path: Path) -> None:
    write(tmp_path / "a.png")
    write(tmp_path / "a.jpg")
    write(tmp_path / "A.png")
    source = open_source(tmp_path, "fir")
    assert sorted(stems(source)) == ["A", "a", "a"]
    assert len({entry.where for entry in source.entries}) == 3


def test_order_does_not_hang_on_the_file_system(tmp_path: Path) -> None:
    names = ["x01.png", "x1.png", "X1.png", "x001.png", "x1a.png", "x1 a.png", "x.png"]
    orders = set()
    for seed in range(3):
        folder = tmp_path / str(seed)
        random.Random(seed).shuffle(names)
        for name in names:
            write(folder / name)
        orders.add(tuple(stems(open_source(folder, "fir"))))
    assert len(orders) == 1


@given(st.lists(st.text("aA1٣0.-_ /é", min_size=1, max_size=8), max_size=8))
@settings(max_examples=60)
def test_natural_order_is_total(names: list[str]) -> None:
    different = list(dict.fromkeys(names))
    ordered = sorted(different, key=natural_key)
    assert sorted(random.Random(0).sample(different, len(different)), key=natural_key) == ordered


@given(st.lists(st.integers(0, 10**9), unique=True, max_size=20))
@settings(max_examples=40)
def test_natural_order_counts(numbers: list[int]) -> None:
    names = [f"camera 2/frame_{number}_x" for number in numbers]
    assert sorted(names, key=natural_key) == [f"camera 2/frame_{number}_x" for number in sorted(numbers)]


def test_empty_folder_says_what_it_looked_for(tmp_path: Path) -> None:
    (tmp_path / "readme.md").write_text("x")
    with pytest.raises(InputError) as caught:
        open_source(tmp_path, "rgb")
    for part in (str(tmp_path), ".jpeg", ".pgm", "1 other"):
        assert part in str(caught.value)
    assert "did you mean" not in str(caught.value)


def test_folder_of_folders_suggests_them(tmp_path: Path) -> None:
    for below in ("set/ir", "set/vi", "other"):
        write(tmp_path / below / "1.png")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="did you mean") as caught:
        open_source(tmp_path, "rgb")
    hint = caught.value.hint
    assert str(tmp_path / "set" / "ir") in hint
    assert str(tmp_path / "other") in hint
    assert "empty" not in hint


@pytest.mark.parametrize("spec", ["", " ", "nowhere", "nowhere.png", "nowhere.mp4", "a\0b", "x" * 5000])
def test_what_is_not_there(spec, tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "rgb_left").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as caught:
        open_source(spec, "rgb")
    if spec.startswith("nowhere"):
        assert "no such file or folder" in str(caught.value)
        assert "rgb_left" in str(caught.value)
        assert "a folder of images, an image file, a video file, a glob pattern" in str(caught.value)


def test_a_file_of_another_kind(tmp_path: Path) -> None:
    notes = tmp_path / "notes.txt"
    notes.write_text("x")
    with pytest.raises(InputError, match=r"not a source of images.*a video file"):
        open_source(notes, "rgb")


def test_single_image(tmp_path: Path) -> None:
    source = open_source(write(tmp_path / "a b.PNG"), "fir")
    assert stems(source) == ["a b"]
    assert (source.read(0).pixels == GREY).all()


def test_pattern_names_what_differs(tmp_path: Path) -> None:
    for name in (
        "V000/img_10.png",
        "V000/img_2.png",
        "V001/img_1.png",
        "V001/other.png",
        "V001/deep/img_3.png",
    ):
        write(tmp_path / "rgb" / name)
    write(tmp_path / "rgb" / ".V002" / "img_1.png")
    (tmp_path / "rgb" / "V000" / "img_1.txt").write_text("x")
    source = open_source(f"{tmp_path}/rgb/*/img_*", "fir")
    assert stems(source) == ["V000/img_2", "V000/img_10", "V001/img_1"]
    assert isinstance(source, FileSource)
    assert source.ignored == 1
    assert stems(open_source(f"{tmp_path}/rgb/V000/img_*.png", "fir")) == ["img_2", "img_10"]
    deep = ["V000/img_2", "V000/img_10", "V001/deep/img_3", "V001/img_1", "V001/other"]
    assert sorted(stems(open_source(f"{tmp_path}/rgb/**/*.png", "fir"))) == sorted(deep)
    assert stems(open_source(f"{tmp_path}/rgb/**", "fir")) == stems(
        open_source(f"{tmp_path}/rgb/**/*", "fir")
    )
    assert (source.read(1).pixels == GREY).all()


def test_relative_pattern(tmp_path: Path, monkeypatch) -> None:
    write(tmp_path / "a1.png")
    monkeypatch.chdir(tmp_path)
    source = open_source("a?.png", "fir")
    assert stems(source) == ["a1"]
    assert source.read(0).size_wh == (8, 6)


def test_brackets_in_names_are_names_first(tmp_path: Path) -> None:
    write(tmp_path / "set [1]" / "a.png")
    write(tmp_path / "set 1" / "b.png")
    assert stems(open_source(tmp_path / "set [1]", "fir")) == ["a"]
    assert stems(open_source(tmp_path / "set [1]" / "a.png", "fir")) == ["a"]
    assert stems(open_source(f"{tmp_path}/set [1]/*.png", "fir")) == ["a"]
    (tmp_path / "notes[1].txt").write_text("x")
    with pytest.raises(InputError, match="finds no images"):
        open_source(tmp_path / "notes[1].txt", "fir")


def test_pattern_without_a_hit(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(InputError, match="finds 1 files, none an image"):
        open_source(f"{tmp_path}/*", "rgb")
    with pytest.raises(InputError, match="gone is not there"):
        open_source(f"{tmp_path}/gone/*.png", "rgb")
    with pytest.raises(InputError):
        open_source(f"{tmp_path}/../*/../*.png", "rgb")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_folder_without_permission(tmp_path: Path) -> None:
    folder = write(tmp_path / "locked" / "a.png").parent
    folder.chmod(0)
    try:
        with pytest.raises(InputError, match="cannot be read"):
            open_source(folder, "rgb")
    finally:
        folder.chmod(0o755)


def test_unreadable_files_are_frame_errors(tmp_path: Path) -> None:
    (tmp_path / "broken link.png").symlink_to(tmp_path / "nothing.png")
    (tmp_path / "empty.png").touch()
    write(tmp_path / "vanishes.png")
    source = open_source(tmp_path, "rgb")
    assert stems(source) == ["broken link", "empty", "vanishes"]
    (tmp_path / "vanishes.png").unlink()
    for index, word in enumerate(("cannot be read", "empty", "cannot be read")):
        with pytest.raises(FrameError, match=word) as caught:
            source.read(index)
        assert source.entries[index].where in str(caught.value)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_name_that_is_no_text(tmp_path: Path) -> None:
    Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff\xfe.png")).write_bytes(
        write(tmp_path / "a.png").read_bytes()
    )
    with pytest.raises(InputError, match="UTF-8") as caught:
        open_source(tmp_path, "rgb")
    str(caught.value).encode()


def test_limit_of_pixels_reaches_the_decoder(tmp_path: Path) -> None:
    source = open_source(write(tmp_path / "a.png"), "fir", max_pixels=47)
    with pytest.raises(FrameError, match="limit of 47"):
        source.read(0)


def test_entries_are_light(tmp_path: Path) -> None:
    for number in range(2000):
        (tmp_path / f"frame_{number:06d}.png").touch()
    list_folder(str(tmp_path))
    tracemalloc.start()
    entries, _ = list_folder(str(tmp_path))
    held = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert len(entries) == 2000
    assert held / 2000 < 400  # bytes each: 10,000 take less than 4 MB


# the table


def test_every_row_resolves() -> None:
    import pkgutil

    for target in SOURCES.values():
        kind = pkgutil.resolve_name(target)
        assert kind.expects
        assert kind.accepts("no such thing") is False


def test_other_packages_add_sources(tmp_path: Path, monkeypatch) -> None:
    """A real distribution with an entry point, on the path."""
    info = tmp_path / "extra_source-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: extra-source\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[fusion.sources]\nnight = extra_source:NIGHT\n")
    (tmp_path / "extra_source.py").write_text(
        "from fusion.sources import SourceKind, open_source\n"
        "def open_night(spec, role, **options):\n"
        "    return open_source(spec.removeprefix('night:'), role, **options)\n"
        "NIGHT = SourceKind('night:FOLDER', lambda spec: spec.startswith('night:'), open_night)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    images = write(tmp_path / "images" / "a.png").parent
    open_source(images, "fir")
    assert "extra_source" not in sys.modules  # nobody asked for it yet
    assert stems(open_source(f"night:{images}", "fir")) == ["a"]
    with pytest.raises(InputError, match="night:FOLDER"):
        open_source("nowhere", "fir")
    sys.modules.pop("extra_source", None)


def test_real_pairs_open(shared_data: Path) -> None:
    for folder in sorted((shared_data / "rgbt_pairs").glob("*/")):
        if folder.is_dir():
            rgb, fir = open_source(folder / "vi", "rgb"), open_source(folder / "ir", "fir")
            assert stems(rgb) == stems(fir)
            for index in range(len(rgb.entries)):
                assert rgb.read(index).pixels.ndim == 3
                assert fir.read(index).pixels.ndim == 2
