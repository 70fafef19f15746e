"""What is written is what is read back, by us and by Open3D."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusion.clouds import pcd_bytes, read_cloud, write_pcd
from fusion.errors import OutputError
from fusion.frames import PointCloud
from fusion.open3d import load


def cloud(dtype: str = "f4", n: int = 30, **more: np.ndarray) -> PointCloud:
    rng = np.random.default_rng(0)
    fields = {
        "time_s": rng.random(n) + 0.5,
        "ring": np.arange(n, dtype=np.int32),
        "intensity": rng.random(n, dtype=np.float32),
        **more,
    }
    return PointCloud(rng.normal(0, 9, (n, 3)).astype(dtype), fields, "a", 1678067032799619675, n)


@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize("n", [0, 1, 30])
def test_a_cloud_comes_back(dtype: str, n: int, tmp_path: Path) -> None:
    source = cloud(
        dtype, n, seen=np.arange(n) % 2 == 0, echo=np.arange(n, dtype=np.int8), id=np.arange(n) + 2**60
    )
    path = tmp_path / "deep" / f"{source.stamp_ns}.pcd"
    write_pcd(path, source)
    back = read_cloud(path)
    np.testing.assert_array_equal(back.xyz_m, source.xyz_m)
    assert n == 0 or back.xyz_m.dtype == source.xyz_m.dtype
    assert list(back.fields) == ["intensity", "ring", "time_s", "echo", "id", "seen"]
    for name, values in source.fields.items():
        np.testing.assert_array_equal(back.fields[name], values)
        assert back.fields[name].dtype == (np.uint8 if values.dtype == bool else values.dtype)
    assert back.stamp_ns == source.stamp_ns


def test_open3d_reads_it(tmp_path: Path) -> None:
    o3d: Any = load()
    source = cloud()
    write_pcd(tmp_path / "a.pcd", source)
    theirs = o3d.t.io.read_point_cloud(str(tmp_path / "a.pcd")).point
    np.testing.assert_array_equal(theirs["positions"].numpy(), source.xyz_m)
    for name in ("intensity", "ring", "time_s"):
        np.testing.assert_array_equal(theirs[name].numpy()[:, 0], source.fields[name])


def test_the_same_cloud_gives_the_same_bytes_whatever_the_order_of_its_fields() -> None:
    source = cloud()
    xyz_m: Any = np.asfortranarray(source.xyz_m)
    turned = PointCloud(xyz_m, dict(reversed([*source.fields.items()])))
    big = PointCloud(source.xyz_m, {n: v.astype(v.dtype.newbyteorder(">")) for n, v in source.fields.items()})
    assert pcd_bytes(source) == pcd_bytes(turned) == pcd_bytes(big)
    head = pcd_bytes(source).split(b"DATA binary\n")[0].decode()
    assert "FIELDS x y z intensity ring time_s\nSIZE 4 4 4 4 2 8\nTYPE F F F F U F\n" in head


def test_rings_that_need_more_than_16_bits(tmp_path: Path) -> None:
    source = PointCloud(np.ones((2, 3), "f4"), {"ring": np.array([-1, 70_000], np.int32)})
    write_pcd(tmp_path / "a.pcd", source)
    assert read_cloud(tmp_path / "a.pcd").fields["ring_as_stored"].tolist() == [-1, 70_000]


@pytest.mark.parametrize("name", ["_", "x", "xyz", "two words", "", "größe", "a\nDATA"])
def test_names_that_pcd_cannot_bear(name: str) -> None:
    with pytest.raises(ValueError, match="a name of one word"):
        pcd_bytes(PointCloud(np.ones((3, 3)), {name: np.zeros(3)}))
    with pytest.raises(ValueError, match="expected a field of numbers"):
        pcd_bytes(cloud(half=np.zeros(30, "f2")))


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError):
        write_pcd(tmp_path / "file" / "a.pcd", cloud())
