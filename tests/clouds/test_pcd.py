"""PCD in all its kinds, against files written here and by Open3D, and headers that lie."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cloud_files import POINTS, pcd, pcd_header, records

from fusion.clouds import read_cloud, read_raw
from fusion.clouds.pcd import read_pcd
from fusion.errors import FrameError
from fusion.open3d import load

KINDS = ("ascii", "binary", "binary_compressed")


def plain(points: np.ndarray = POINTS) -> np.ndarray:
    return np.ascontiguousarray(points).view([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])[:, 0]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", ["i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8"])
def test_every_type_comes_back_exactly(kind: str, dtype: str) -> None:
    rows = np.empty(5, [("value", f"<{dtype}"), ("x", "<f4"), ("y", "<f8"), ("z", "<f4")])
    rng = np.random.default_rng(1)
    for axis in "xyz":
        rows[axis] = rng.normal(0, 9, 5)
    limits = np.finfo(dtype) if dtype[0] == "f" else np.iinfo(dtype)
    rows["value"] = [limits.min, limits.max, 0, 1, 3]  # 64-bit integers have more digits than float64
    columns = read_pcd(pcd(rows, kind), "a.pcd").columns
    for name in rows.dtype.names or ():
        assert columns[name].dtype == rows.dtype[name]
        np.testing.assert_array_equal(columns[name], rows[name])


@pytest.mark.parametrize("kind", KINDS)
def test_vectors_are_split_and_padding_left_out(kind: str) -> None:
    fields = [
        ("pad1", "u1", 3),
        ("x", "<f4"),
        ("normal", "<f4", 3),
        ("y", "<f4"),
        ("pad2", "<f4"),
        ("z", "<f4"),
    ]
    rows = np.zeros(6, fields)
    rng = np.random.default_rng(2)
    for name in ("x", "y", "z"):
        rows[name] = rng.normal(size=6)
    rows["normal"] = rng.normal(size=(6, 3))
    rows["pad1"], rows["pad2"] = 7, 8
    columns = read_pcd(pcd(rows, kind), "a.pcd").columns
    assert list(columns) == ["x", "normal_0", "normal_1", "normal_2", "y", "z"]
    for k in range(3):
        np.testing.assert_array_equal(columns[f"normal_{k}"], rows["normal"][:, k])
    np.testing.assert_array_equal(columns["z"], rows["z"])


@pytest.mark.parametrize("kind", KINDS)
def test_a_scan_with_driver_fields(kind: str, tmp_path: Path) -> None:
    rows = records()
    path = tmp_path / "scan_7.pcd"
    path.write_bytes(pcd(rows, kind))
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.xyz_m, np.stack([rows["x"], rows["y"], rows["z"]], 1))
    np.testing.assert_array_equal(cloud.fields["intensity"], rows["intensity"])
    np.testing.assert_array_equal(cloud.fields["ring"], rows["ring"])
    np.testing.assert_array_equal(cloud.fields["time_s"], rows["t"] / 1e9)
    assert (cloud.stem, cloud.stamp_ns, cloud.read, dict(cloud.dropped)) == (
        "scan_7",
        None,
        40,
        {"nan": 0, "zero": 0},
    )


@pytest.mark.parametrize("kind", KINDS)
def test_organised_and_windows_line_ends_and_old_headers(kind: str) -> None:
    rows = records(12)
    for said in (
        {"WIDTH": 4, "HEIGHT": 3},
        {"POINTS": None},
        {"WIDTH": None, "HEIGHT": None},
        {"VIEWPOINT": None},
        {"COUNT": None},
    ):
        np.testing.assert_array_equal(read_pcd(pcd(rows, kind, **said), "a").columns["t"], rows["t"])
    head = pcd_header(rows, kind)
    crlf = head.replace(b"\n", b"\r\n") + pcd(rows, kind)[len(head) :]
    np.testing.assert_array_equal(read_pcd(crlf, "a").columns["t"], rows["t"])


def test_the_viewpoint_is_handed_on_and_not_applied() -> None:
    rows = plain()
    assert read_pcd(pcd(rows, "binary"), "a").viewpoint is None
    raw = read_pcd(pcd(rows, "binary", VIEWPOINT="1 2 3 0 1 0 0"), "a")
    assert raw.viewpoint == (1, 2, 3, 0, 1, 0, 0)
    np.testing.assert_array_equal(raw.columns["x"], rows["x"])


def test_a_name_borne_twice_loses_neither() -> None:
    columns = read_pcd(pcd(records(3), "binary", FIELDS="x y z ring ring t"), "a").columns
    assert list(columns) == ["x", "y", "z", "ring", "ring_2", "t"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("claimed", "found"), [(50, 40), (30, 40), (0, 40), (41, 40)])
def test_counts_that_lie(kind: str, claimed: int, found: int) -> None:
    data = pcd(records(), kind, WIDTH=claimed, POINTS=claimed)
    with pytest.raises(FrameError, match=f"claims {claimed} points, the file has {found}"):
        read_pcd(data, "a.pcd")


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_cut_off(kind: str) -> None:
    data = pcd(records(), kind)
    for keep in (len(pcd_header(records(), kind)), len(data) - 30, len(data) // 2, 40, 0):
        with pytest.raises(FrameError):
            read_pcd(data[:keep], "a.pcd")


@pytest.mark.parametrize("kind", KINDS)
def test_no_points_are_no_error(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "a.pcd"
    path.write_bytes(pcd(records(0), kind))
    cloud = read_cloud(path)
    assert (len(cloud), cloud.read) == (0, 0)
    assert cloud.fields["ring"].dtype == np.int32


def test_what_follows_a_compressed_block_is_no_point() -> None:
    rows = records()
    np.testing.assert_array_equal(
        read_pcd(pcd(rows, "binary_compressed") + b"\0" * 500, "a").columns["t"], rows["t"]
    )


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"WIDTH": 20, "HEIGHT": 3}, "POINTS 40 is not WIDTH 20 x HEIGHT 3"),
        ({"WIDTH": None, "POINTS": None}, "neither POINTS nor WIDTH"),
        ({"POINTS": "-4", "WIDTH": "-4"}, "'-4' is no count"),
        ({"POINTS": "9" * 30, "WIDTH": None}, "is no count"),
        ({"POINTS": 600_000_000, "WIDTH": 600_000_000}, "600,000,000 points are more than the 500,000,000"),
        ({"SIZE": "4 4 4 2 1"}, "6 FIELDS, but 5 words in SIZE"),
        ({"TYPE": "F F F U U Q"}, "TYPE Q SIZE 4"),
        ({"SIZE": "1 4 4 2 1 4"}, "TYPE F SIZE 1"),
        ({"COUNT": "1 1 1 1 1 99999999"}, "65,536 values"),
        ({"FIELDS": ""}, "names no FIELDS"),
        ({"VIEWPOINT": "here"}, "could not convert"),
        ({"DATA": "binary_zstd"}, "unknown kind 'binary_zstd'"),
        ({"DATA": None}, "no line DATA"),
    ],
)  # fmt: skip
def test_headers_that_cannot_be_right(said: dict[str, Any], words: str) -> None:
    with pytest.raises(FrameError, match=words) as caught:
        read_pcd(pcd(records(), "binary", **said), "folder/a.pcd")
    assert str(caught.value).startswith("folder/a.pcd: ")
    assert "\n" not in str(caught.value)


def test_text_that_is_no_number() -> None:
    good = pcd(plain(), "ascii")
    for old, new in ((b"10.0", b"ten"), (b"10.0", b"10.0 4"), (b"10.0 ", b"")):
        with pytest.raises(FrameError, match="cannot be read"):
            read_pcd(good.replace(old, new), "a.pcd")
    text = pcd(records(3), "ascii").replace(b" 2304\n", b" 23040000000\n")
    with pytest.raises(FrameError, match="do not fit the type uint32"):
        read_pcd(text, "a.pcd")


def test_text_spells_what_programs_write() -> None:
    head = pcd_header(records(3), "ascii")
    body = b"nan NaN -nan 1 1 5\n\n+1e0 2. .5 12.0 3 6\r\n  -inf inf 0 1\t2 3  "
    columns = read_pcd(head + body, "a.pcd").columns
    assert np.isnan(columns["x"][0])
    assert columns["x"][1:].tolist() == [1, -np.inf]
    assert columns["intensity"].tolist() == [1, 12, 1]


def test_no_memory_is_taken_for_what_is_not_there() -> None:
    """A hundred million points of 64 KiB each are claimed; the file has a few bytes."""
    said = {"POINTS": 100_000_000, "WIDTH": 100_000_000, "COUNT": "1 1 1 1 1 16000"}
    for kind in KINDS:
        with pytest.raises(FrameError):
            read_pcd(pcd_header(records(1), kind, **said) + b"\xff" * 64, "a.pcd")


@pytest.mark.parametrize("ascii_", [False, True])
@pytest.mark.parametrize("compressed", [False, True])
def test_what_open3d_writes(ascii_: bool, compressed: bool, tmp_path: Path) -> None:
    o3d: Any = load()
    rng = np.random.default_rng(3)
    points = (rng.normal(0, 5, (500, 3)) // 0.25 * 0.25).astype(np.float32)  # repeats: back references
    points += np.float32(0.125)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    cloud.point["intensity"] = o3d.core.Tensor(rng.random((500, 1)).astype(np.float32))
    path = tmp_path / "a.pcd"
    o3d.t.io.write_point_cloud(str(path), cloud, write_ascii=ascii_, compressed=compressed)
    ours = read_cloud(path)
    close = 1e-4 if ascii_ else 0  # Open3D writes few digits
    np.testing.assert_allclose(ours.xyz_m, points, rtol=close)
    np.testing.assert_allclose(ours.fields["intensity"], cloud.point["intensity"].numpy()[:, 0], atol=close)


@pytest.mark.parametrize("name", ["lidar_camera/1/calib.pcd", "lidar_camera/2/calib.pcd"])
def test_real_scans_agree_with_open3d_to_the_bit(name: str, shared_data: Path) -> None:
    o3d: Any = load()
    theirs = o3d.t.io.read_point_cloud(str(shared_data / name)).point
    columns = read_raw(shared_data / name).columns
    for k, axis in enumerate("xyz"):
        np.testing.assert_array_equal(columns[axis], theirs["positions"].numpy()[:, k])
    for field in ("intensity", "ring", "timestamp"):
        np.testing.assert_array_equal(columns[field], theirs[field].numpy()[:, 0])
    cloud = read_cloud(shared_data / name)
    stamps = theirs["timestamp"].numpy()[:, 0]
    assert cloud.stamp_ns == int(np.floor(stamps.min())) * 10**9 + round((stamps.min() % 1) * 1e9)
    assert cloud.fields["time_s"].min() == 0
    assert 0.09 < cloud.fields["time_s"].max() < 0.11  # a turn at 10 Hz


def test_the_real_mine_map_agrees_with_open3d(shared_data: Path) -> None:
    o3d: Any = load()
    path = shared_data / "mine_lidar" / "2025-04-21-11-04-46.pcd"
    cloud = read_cloud(path)
    theirs = np.asarray(o3d.io.read_point_cloud(str(path)).points)
    np.testing.assert_array_equal(cloud.xyz_m.astype(np.float64), theirs)
    assert len(cloud) == cloud.read == 176_758
    assert cloud.stamp_ns is None
