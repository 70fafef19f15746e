"""NPY and NPZ: shapes, names, and what is no array of numbers."""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
from cloud_files import npy, npz, records

from fusion.clouds import read_cloud
from fusion.clouds.arrays import read_npy, read_npz
from fusion.errors import FrameError

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("dtype", ["<f4", ">f4", "<f8", ">f8", "<f2", "<i2", "<i4"])
@pytest.mark.parametrize("columns", [3, 4, 5, 7])
@pytest.mark.parametrize("order", ["C", "F"])
def test_columns_by_position(dtype: str, columns: int, order: str, tmp_path: Path) -> None:
    values = (RNG.integers(1, 90, (6, columns)) + (0.25 if dtype[1] == "f" else 0)).astype(dtype)
    values[:, 4:5] = np.arange(6)[:, None]
    path = tmp_path / "a.npy"
    path.write_bytes(npy(np.asarray(values, order=order)))  # type: ignore[call-overload]
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.xyz_m, values[:, :3])
    assert cloud.xyz_m.dtype == (np.float64 if dtype[1:] in ("f8", "i4") else np.float32)
    names = ["intensity", "ring", "column_5", "column_6"][: columns - 3]
    assert list(cloud.fields) == names
    for k, name in enumerate(names):
        np.testing.assert_array_equal(cloud.fields[name], values[:, 3 + k])
        assert cloud.fields[name].dtype.isnative
        assert cloud.fields[name].flags.writeable


def test_records_and_organised_arrays() -> None:
    rows = records(12)
    for array in (rows, rows.reshape(3, 4)):
        columns = read_npy(npy(array), "a").columns
        for name in rows.dtype.names or ():
            np.testing.assert_array_equal(columns[name], rows[name])
    grid = RNG.normal(size=(3, 4, 4)).astype("f4")
    np.testing.assert_array_equal(read_npy(npy(grid), "a").columns["y"], grid[..., 1].ravel())


def test_records_with_vectors_flags_and_text() -> None:
    rows = np.zeros(
        3, [("xyz", "<f4", 3), ("normal", "<f4", (3,)), ("seen", "?"), ("name", "U4"), ("grid", "f4", (2, 2))]
    )
    rows["xyz"] = RNG.normal(size=(3, 3))
    rows["seen"] = [True, False, True]
    raw = read_npy(npy(rows), "a")
    assert list(raw.columns) == ["x", "y", "z", "normal_0", "normal_1", "normal_2", "seen"]
    assert raw.left_out == ("name", "grid")
    assert raw.columns["seen"].tolist() == [1, 0, 1]
    np.testing.assert_array_equal(raw.columns["z"], rows["xyz"][:, 2])


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("key", ["xyz", "points", "xyz_m", "arr_0"])
def test_archives(compressed: bool, key: str, tmp_path: Path) -> None:
    xyz, rings = RNG.normal(0, 9, (8, 3)), np.arange(8)
    path = tmp_path / "a.npz"
    others = {"ring": rings, "camera": np.eye(3), "name": np.array("drift"), "few": np.arange(5.0)}
    path.write_bytes(npz(compressed, **{key: xyz}, **others))
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.xyz_m, xyz)
    np.testing.assert_array_equal(cloud.fields["ring"], rings)
    assert list(cloud.fields) == ["ring"]
    assert read_npz(path.read_bytes(), "a").left_out == ("camera", "name", "few")


def test_an_archive_of_single_columns(tmp_path: Path) -> None:
    x, y, z = RNG.normal(0, 9, (3, 5)).astype("f4")
    path = tmp_path / "a.npz"
    path.write_bytes(npz(Z=z, i=np.arange(5), x=x, y=y, one=np.ones(1)))
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.xyz_m, np.stack([x, y, z], 1))
    assert list(cloud.fields) == ["intensity"]
    path.write_bytes(npz(x=x, y=y, z=z[:4]))
    with pytest.raises(FrameError, match="no x, y, z"):
        read_cloud(path)


class Evil:
    def __reduce__(self) -> tuple[object, ...]:
        return (pytest.fail, ("it was unpickled",))


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    array = np.array([Evil(), 1, 2], object)
    for name, data in (("a.npy", npy(array)), ("a.npz", npz(xyz=array)), ("b.npy", pickle.dumps(Evil()))):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(FrameError, match=r"never unpickled|no NPY header"):
            read_cloud(tmp_path / name)


NO_POINTS = (
    *(np.zeros(shape) for shape in ((3, 40), (5, 2), (9,), (9, 17), ())),
    *(np.zeros((4, 3), dtype) for dtype in ("c8", "U2", "M8[s]")),
)


@pytest.mark.parametrize("array", NO_POINTS)
def test_shapes_and_types_that_are_no_points(array: np.ndarray) -> None:
    with pytest.raises(FrameError) as caught:
        read_npy(npy(array), "a.npy")
    assert str(array.shape) in str(caught.value)


def test_no_points_are_no_error(tmp_path: Path) -> None:
    for name, data in (
        ("a.npy", npy(np.zeros((0, 4)))),
        ("a.npz", npz(xyz=np.zeros((0, 3)))),
        ("b.npy", npy(records(0))),
    ):
        (tmp_path / name).write_bytes(data)
        assert read_cloud(tmp_path / name).read == 0


def claimed(data: bytes, old: bytes, new: bytes) -> bytes:
    """The header with another shape, of the same length."""
    at = data.index(old)
    return data[:at] + new + data[at + len(old) + (len(new) - len(old)) :]


def test_headers_that_lie() -> None:
    data = npy(np.ones((40, 3), "f4"))
    for rows, words in (
        (50, "claims 50 points, the file has 40"),
        (30, "claims 30 points, the file has 40"),
        (400_000_000, "claims 400,000,000"),
        (900_000_000, "900,000,000 points are more than"),
        (-40, "claims"),
    ):
        with pytest.raises(FrameError, match=words):
            read_npy(claimed(data, b"(40, 3), }", b"(%d, 3), }" % rows), "a.npy")
    for keep in (len(data) - 1, 128, 100, 7, 0):
        with pytest.raises(FrameError):
            read_npy(data[:keep], "a.npy")


def test_archives_that_claim_what_they_cannot_hold() -> None:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xyz.npy", claimed(npy(np.ones((40, 3), "f8")), b"(40, 3), }", b"(400000000, 3), }"))
    with pytest.raises(FrameError, match="claims 400,000,000 points"):
        read_npz(stream.getvalue(), "a.npz")
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("xyz.npy", npy(np.ones((40, 3))))
    with pytest.raises(FrameError, match="in a way that NumPy does not write"):
        read_npz(stream.getvalue(), "a.npz")
    sound = npz(xyz=np.ones((40, 3)))
    for keep in (len(sound) - 30, 100, 3, 0):
        with pytest.raises(FrameError, match="archive is damaged"):
            read_npz(sound[:keep], "a.npz")
    with pytest.raises(FrameError, match="no points under its keys depth"):
        read_npz(npz(depth=np.ones((40, 3))), "a.npz")
