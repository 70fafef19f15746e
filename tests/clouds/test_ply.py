"""PLY in its three orders, with other elements around the vertices."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cloud_files import PLY_NAMES, ply, records

from fusion.clouds import read_cloud
from fusion.clouds.ply import read_ply
from fusion.errors import FrameError
from fusion.open3d import load

ORDERS = ("ascii", "binary_little_endian", "binary_big_endian")


@pytest.mark.parametrize("order", ORDERS)
def test_every_type_in_any_order(order: str) -> None:
    rows = np.empty(4, [(f"p{code}", code) for code in PLY_NAMES] + [("z", "f8"), ("x", "f4"), ("y", "i2")])
    rng = np.random.default_rng(0)
    for name in rows.dtype.names or ():
        kind = rows.dtype[name]
        if kind.kind == "f":
            rows[name] = rng.normal(0, 9, 4)
        else:
            limits = np.iinfo(kind)
            rows[name] = [limits.min, limits.max, 0, 1]
    columns = read_ply(ply(rows, order), "a.ply").columns
    for name in rows.dtype.names or ():
        assert columns[name].dtype.newbyteorder("=") == rows.dtype[name]
        np.testing.assert_array_equal(columns[name], rows[name])


FACES = "element face 2\nproperty list uchar int vertex_indices\nproperty uchar red\n"
CAMERA = "element camera 1\nproperty float fx\nproperty double fy\n"
NOTHING = "element nothing 5000000000\n"


def faces(order: str) -> bytes:
    if order == "ascii":
        return b"3 0 1 2 255\n4 0 1 2 3 7\n"
    sign = "<i4" if "little" in order else ">i4"
    three, four = (np.arange(n).astype(sign).tobytes() for n in (3, 4))
    return b"\x03" + three + b"\xff" + b"\x04" + four + b"\x07"


@pytest.mark.parametrize("order", ORDERS)
def test_other_elements_are_passed_over(order: str) -> None:
    rows = records(9)
    camera = b"1.5 2.5\n" if order == "ascii" else bytes(12)
    both = (CAMERA + FACES, camera + faces(order))
    for before, after in ((("", b""), both), (both, ("", b"")), ((FACES, faces(order)), (CAMERA, camera))):
        raw = read_ply(ply(rows, order, before, after), "a.ply")
        assert sorted(raw.left_out) == ["camera", "face"]
        for name in rows.dtype.names or ():
            np.testing.assert_array_equal(raw.columns[name], rows[name])


@pytest.mark.parametrize("order", ORDERS[1:])
def test_an_element_of_nothing_takes_no_time(order: str) -> None:
    np.testing.assert_array_equal(
        read_ply(ply(records(3), order, (NOTHING, b"")), "a").columns["t"], records(3)["t"]
    )


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("count", [3, 50, 0, 10**9, 6 * 10**8])
def test_counts_that_lie(order: str, count: int) -> None:
    with pytest.raises(FrameError, match=r"claims|more than the 500,000,000"):
        read_ply(ply(records(9), order, count=count), "a.ply")


@pytest.mark.parametrize("order", ORDERS)
def test_elements_before_that_lie(order: str) -> None:
    many = FACES.replace("face 2", "face 4000000000")
    with pytest.raises(FrameError, match=r"a\.ply"):
        read_ply(ply(records(9), order, (many, faces(order))), "a.ply")


@pytest.mark.parametrize("order", ORDERS)
def test_a_file_cut_off(order: str) -> None:
    data = ply(records(9), order)
    for keep in (len(data) - 12, data.index(b"end_header") + 11, 60, 3, 0):
        with pytest.raises(FrameError):
            read_ply(data[:keep], "a.ply")


@pytest.mark.parametrize("order", ORDERS)
def test_no_points_are_no_error(order: str, tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(ply(records(0), order))
    assert read_cloud(path).read == 0


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("ply\n", "plx\n", "no PLY header"),
        ("end_header", "end_hea", "no PLY header"),
        ("format binary_little_endian 1.0\n", "", "format comes first"),
        ("binary_little_endian", "binary_middle_endian", "wrong at 'format"),
        ("element vertex 9", "element vertex nine", "no count"),
        ("element vertex 9", "element vertex -9", "no count"),
        ("element vertex 9", "element point 9", "0 elements 'vertex'"),
        ("element vertex 9", "element vertex 9\nelement vertex 9", "2 elements 'vertex'"),
        ("property float x", "property fload x", "fload"),
        ("property float x", "property", "wrong at 'property'"),
        ("property float x", "property list uchar float x", "are lists"),
        ("property float x", "property list float float x", "no whole number"),
        ("property float x", "property float u", "no x, y, z among its fields"),
    ],
)
def test_headers_that_cannot_be_right(old: str, new: str, words: str, tmp_path: Path) -> None:
    data = ply(records(9), "binary_little_endian")
    path = tmp_path / "a.ply"
    path.write_bytes(data.replace(old.encode(), new.encode(), 1))
    with pytest.raises(FrameError, match=words):
        read_cloud(path)


@pytest.mark.parametrize("ascii_", [False, True])
def test_what_open3d_writes(ascii_: bool, tmp_path: Path) -> None:
    o3d: Any = load()
    rng = np.random.default_rng(3)
    points, colours = rng.normal(0, 5, (50, 3)), rng.random((50, 3))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.colors = o3d.utility.Vector3dVector(colours)
    path = tmp_path / "a.ply"
    o3d.io.write_point_cloud(str(path), cloud, write_ascii=ascii_)
    ours, theirs = read_cloud(path), o3d.io.read_point_cloud(str(path))
    assert ours.xyz_m.dtype == np.float64
    np.testing.assert_array_equal(ours.xyz_m, np.asarray(theirs.points))
    np.testing.assert_array_equal(ours.fields["green"], np.rint(np.asarray(theirs.colors)[:, 1] * 255))
