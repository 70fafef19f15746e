"""Which files a spec stands for."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusion.clouds import clouds_in
from fusion.errors import InputError


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def test_a_folder_in_natural_order(tmp_path: Path) -> None:
    touch(
        tmp_path,
        "s10.pcd",
        "s2.pcd",
        "S1.PLY",
        "s3.pcd.bin",
        "notes.txt",
        "._s2.pcd",
        "below/s4.pcd",
        "s5.laz",
    )
    found = clouds_in(tmp_path)
    assert found.stems == ("S1", "s2", "s3", "s5", "s10")
    assert [path.name for path in found] == ["S1.PLY", "s2.pcd", "s3.pcd.bin", "s5.laz", "s10.pcd"]
    assert all(path.parent == tmp_path for path in found)
    assert (len(found), found.ignored) == (5, 1)
    assert found.kinds == {".ply": 1, ".pcd": 2, ".pcd.bin": 1, ".laz": 1}
    assert found[0] == tmp_path / "S1.PLY"
    assert found[-2:] == found.paths[3:]


def test_a_pattern_keeps_the_folders_in_the_stems(tmp_path: Path) -> None:
    touch(tmp_path, "a/9.pcd", "a/10.pcd", "b/9.pcd", "b/9.txt", "a/.x.pcd")
    found = clouds_in(f"{tmp_path}/*/*")
    assert found.stems == ("a/9", "a/10", "b/9")
    assert found.ignored == 1
    assert clouds_in(f"{tmp_path}/**").stems == found.stems
    with pytest.raises(InputError, match=r"no point clouds here.*1 other files"):
        clouds_in(f"{tmp_path}/*/*.txt")


def test_a_single_file(tmp_path: Path) -> None:
    touch(tmp_path, "run [1].pcd", "odd.velodyne")
    assert clouds_in(tmp_path / "run [1].pcd").stems == ("run [1]",)
    found = clouds_in(tmp_path / "odd.velodyne")  # a form may be forced
    assert (found.stems, found.kinds) == (("odd",), {".velodyne": 1})


def test_one_name_twice_would_overwrite_one_result(tmp_path: Path) -> None:
    touch(tmp_path, "7.pcd", "7.ply")
    with pytest.raises(InputError, match=r"two clouds bear one name: 7.pcd and 7.ply.*\*.pcd"):
        clouds_in(tmp_path)
    assert clouds_in(f"{tmp_path}/*.ply").stems == ("7",)


def test_nothing_there(tmp_path: Path) -> None:
    touch(tmp_path, "notes.txt")
    for spec, words in (
        ("", "no clouds given"),
        (tmp_path / "absent", "no such file"),
        (tmp_path, "1 other files"),
        ("a\0b.pcd", "looked up|no such"),
        (f"{tmp_path}/**x/*.pcd", "looked up|no point clouds"),
    ):
        with pytest.raises(InputError, match=words):
            clouds_in(spec)
