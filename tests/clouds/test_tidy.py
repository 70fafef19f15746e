"""What is dropped, what fields are called, and what times mean."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from cloud_files import npz, pcd, records

from fusion.clouds import RawCloud, read_cloud
from fusion.clouds.tidy import cloud_of, seconds
from fusion.errors import FrameError, UsageError

NAN = float("nan")


def raw(points: np.ndarray, **fields: np.ndarray) -> RawCloud:
    return RawCloud({**dict(zip("xyz", points.T, strict=True)), **fields})


@pytest.mark.parametrize("dtype", ["<f4", ">f4", "<f8"])
def test_nan_inf_and_zero_are_dropped_and_counted(dtype: str) -> None:
    bad = [[NAN, 2, 3], [0, 0, 0], [0, NAN, 0], [1, np.inf, 3]]
    points = np.array([[1, 2, 3], *bad, [0, 0, 1], [-0.0, 0, -0.0], [0, 5, 0], [1, 2, -np.inf]], dtype)
    cloud = cloud_of(raw(points, intensity=np.arange(9), ring=np.array([3, NAN, 9, 9, 9, 4, 9, 5, 9.5])), "a")
    np.testing.assert_array_equal(cloud.xyz_m, [[1, 2, 3], [0, 0, 1], [0, 5, 0]])
    assert (cloud.read, dict(cloud.dropped)) == (9, {"nan": 4, "zero": 2})
    assert cloud.fields["intensity"].tolist() == [0, 5, 7]
    assert cloud.fields["ring"].tolist() == [3, 4, 5]  # judged by the points that are left


def test_nothing_left_is_an_empty_cloud() -> None:
    for value in (NAN, 0.0, np.inf):
        cloud = cloud_of(raw(np.full((7, 3), value), t=np.arange(7)), "a")
        assert (len(cloud), cloud.read, sum(cloud.dropped.values())) == (0, 7, 7)
        assert cloud.fields["time_s"].shape == (0,)


def test_the_input_is_not_touched_and_the_result_is_its_own(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    kept = points.copy()
    cloud = cloud_of(raw(points, intensity=points[:, 0]), "a")
    cloud.xyz_m[:] = 0
    cloud.fields["intensity"][:] = 0
    np.testing.assert_array_equal(points, kept)
    for kind in ("binary", "binary_compressed"):
        (tmp_path / "a.pcd").write_bytes(pcd(records(), kind))
        cloud = read_cloud(tmp_path / "a.pcd")
        assert all(values.flags.writeable and values.flags.owndata for values in cloud.fields.values())


@pytest.mark.parametrize(
    ("files", "ours"),
    [
        ("intensity", "intensity"),
        ("Intensity", "intensity"),
        ("i", "intensity"),
        ("scalar_Intensity", "intensity"),
        ("reflectivity", "reflectivity"),
        ("ring", "ring"),
        ("channel", "ring"),
        ("laser_id", "ring"),
        ("line", "ring"),
        ("t", "time_s"),
        ("timestamp", "time_s"),
        ("offset_time", "time_s"),
        ("time_us", "time_s"),
        ("rgb", "rgb"),
    ],
)
def test_names(files: str, ours: str) -> None:
    cloud = cloud_of(raw(np.ones((3, 3)), **{files: np.arange(3)}), "a")
    assert list(cloud.fields) == [ours]
    assert len(cloud.fields[ours]) == 3


def test_two_names_for_one_thing_lose_neither() -> None:
    fields = {"i": np.full(3, 1), "intensity": np.full(3, 2), "Intensity": np.full(3, 3)}
    fields |= {"channel": np.full(3, 4), "ring": np.full(3, 5), "t": np.full(3, 6), "time": np.full(3, 7.5)}
    cloud = cloud_of(raw(np.ones((3, 3)), **fields), "a")
    assert {name: values[0] for name, values in cloud.fields.items()} == {
        "i": 1, "intensity": 2, "Intensity": 3, "channel": 4, "ring": 5, "t": 6, "time_s": 0,
    }  # fmt: skip


def test_upper_case_axes_and_missing_ones() -> None:
    points = np.arange(1.0, 10).reshape(3, 3)
    cloud = cloud_of(RawCloud(dict(zip("XYZ", points.T, strict=True))), "a")
    np.testing.assert_array_equal(cloud.xyz_m, points)
    assert not cloud.fields
    with pytest.raises(FrameError, match="no x, y, z among its fields: x, y, range"):
        cloud_of(RawCloud({"x": points[0], "y": points[0], "range": points[0]}), "a")


@pytest.mark.parametrize("values", [[0.5, 1, 2], [-1, 0, 1], [0, 1, 70_000], [0, NAN, 1], [0, 1e30, 1]])
def test_rings_that_are_none_promise_nothing(values: list[float]) -> None:
    cloud = cloud_of(raw(np.ones((3, 3)), ring=np.array(values)), "a")
    np.testing.assert_array_equal(cloud.fields["ring_as_stored"], values)
    assert "ring" not in cloud.fields


EPOCH_S = 1_678_067_032


@pytest.mark.parametrize(
    ("name", "dtype", "values", "passed", "stamp_ns"),
    [
        ("t", "u4", [5000, 0, 100_000_000], [5e-6, 0, 0.1], None),
        ("offset_time", "u4", [4_000_000_000, 4_000_000_500], [0, 5e-7], None),  # never an epoch in 32 bits
        ("time", "f4", [-0.05, 0, 0.05], [0, 0.05, 0.1], None),
        ("time", "f8", [100.0, 700.5], [0, 600.5], None),
        ("time", "f8", [0.0, 1e8], [0, 0.1], None),  # ns as floats
        ("timestamp", "f8", [EPOCH_S + 0.5, EPOCH_S], [0.5, 0], EPOCH_S * 10**9),
        ("timestamp", "f8", [EPOCH_S * 1e9, EPOCH_S * 1e9 + 1e8], [0, 0.1], EPOCH_S * 10**9),
        ("timestamp", "u8", [EPOCH_S * 10**9 + 7, EPOCH_S * 10**9 + 9], [0, 2e-9], EPOCH_S * 10**9 + 7),
        ("timestamp", "i8", [EPOCH_S * 10**6 + 1, EPOCH_S * 10**6], [1e-6, 0], EPOCH_S * 10**9),
        ("timestamp", "i8", [EPOCH_S * 10**3, EPOCH_S * 10**3 + 100], [0, 0.1], EPOCH_S * 10**9),
        ("timestamp", "i8", [EPOCH_S, EPOCH_S + 1], [0, 1], EPOCH_S * 10**9),
        ("time_us", "i4", [10, 100_010], [0, 0.1], None),
        ("time_us", "i8", [EPOCH_S * 10**6, EPOCH_S * 10**6 + 5], [0, 5e-6], EPOCH_S * 10**9),
        ("time_ns", "f8", [0, 5e5], [0, 5e-4], None),
        ("gps_time", "f8", [1.46e9, 1.46e9 + 2], [0, 2], None),
        ("t", "i8", [-(2**63), 2**63 - 1], [0, 18446744073.709551615], None),  # no difference overflows
        ("t", "f8", [NAN, 1.0, 3.0], [NAN, 0, 2], None),
        ("t", "f8", [NAN, NAN], [NAN, NAN], None),
        ("t", "f8", [], [], None),
    ],
)
def test_times(name: str, dtype: str, values: list[float], passed: list[float], stamp_ns: int | None) -> None:
    time_s, stamp = seconds(name, np.array(values, dtype))
    assert time_s.dtype == np.float64
    np.testing.assert_allclose(time_s, passed, rtol=1e-7, atol=1e-12)
    assert stamp == stamp_ns


def test_whose_stamp_counts(tmp_path: Path) -> None:
    points = np.ones((2, 3), "f4")
    named = tmp_path / "1678067032799619675.npz"
    named.write_bytes(npz(xyz=points))
    assert read_cloud(named).stamp_ns == 1678067032799619675
    named.write_bytes(npz(xyz=points, timestamp=np.array([EPOCH_S + 1, EPOCH_S], "i8")))
    assert read_cloud(named).stamp_ns == EPOCH_S * 10**9  # what the points say is nearer to the truth
    assert read_cloud(named, stem="left/7").stem == "left/7"


def test_a_stored_time_s_is_taken_as_it_is() -> None:
    cloud = cloud_of(raw(np.ones((2, 3)), time_s=np.array([0.25, 0.5], "f4")), "a", stamp_ns=5)
    assert cloud.fields["time_s"].tolist() == [0.25, 0.5]
    assert cloud.stamp_ns == 5


def test_points_where_none_can_be() -> None:
    points = np.random.default_rng(0).normal(0, 10, (1000, 3)).astype("f4")
    for share, fails in ((20, False), (300, True)):
        odd = points.copy()
        odd[:share] *= 1e20
        if fails:
            with pytest.raises(FrameError, match="no metres: one of them is"):
                cloud_of(raw(odd), "a")
        else:
            assert len(cloud_of(raw(odd), "a")) == 1000  # a few stray returns are no reason to refuse
    flat = points.copy()
    flat[:, 2] = 1e-17
    assert len(cloud_of(raw(flat), "a")) == 1000


def test_forms_that_are_unknown(tmp_path: Path) -> None:
    path = tmp_path / "a.xyz"
    path.write_text("1 2 3\n")
    with pytest.raises(
        UsageError, match=r"a\.xyz: unknown form of point cloud 'xyz' \(one of: pcd, ply, bin"
    ):
        read_cloud(path)
    with pytest.raises(UsageError, match="'zip'"):
        read_cloud(tmp_path / "a.pcd", "zip")
    with pytest.raises(FrameError, match="cannot be read: No such file"):
        read_cloud(tmp_path / "absent.pcd")
    with pytest.raises(FrameError, match="cannot be read"):
        read_cloud(tmp_path, "pcd")


@pytest.mark.parametrize("kind", ["binary", "binary_compressed", "kitti"])
def test_memory_stays_within_a_small_factor_of_the_file(kind: str, tmp_path: Path) -> None:
    """With points dropped, which costs a copy: at most four times the file's own bytes at any time."""
    rows = np.zeros(200_000, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
    rng = np.random.default_rng(0)
    for name in rows.dtype.names or ():
        rows[name] = rng.random(len(rows))
    rows["x"][::7] = NAN
    path = tmp_path / ("a.bin" if kind == "kitti" else "a.pcd")
    path.write_bytes(
        rows.tobytes() if kind == "kitti" else pcd(rows, "binary") if kind == "binary" else literal(rows)
    )
    read_cloud(path)  # compiled by now
    tracemalloc.start()
    cloud = read_cloud(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert cloud.dropped["nan"] == len(range(0, len(rows), 7))
    assert peak < 4 * path.stat().st_size


def literal(rows: np.ndarray) -> bytes:
    """A compressed PCD of literal runs only, written quickly."""
    from cloud_files import pcd_header

    body = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in rows.dtype.names or ())
    runs = np.frombuffer(body, np.uint8).reshape(-1, 32)
    packed = np.hstack([np.full((len(runs), 1), 31, np.uint8), runs]).tobytes()
    sizes = np.array([len(packed), len(body)], "<u4").tobytes()
    return pcd_header(rows, "binary_compressed") + sizes + packed


def test_signalling_nans_are_no_warning() -> None:
    strange = np.array([0x7F800001, 0xFF9DCCCC, 0x3F800000], np.uint32).view(np.float32)
    points = np.stack([strange, np.ones(3, np.float32), np.ones(3, np.float32)], 1)
    cloud = cloud_of(raw(points, ring=strange[::-1], t=strange[::-1], time_s=strange), "a")
    assert (len(cloud), cloud.dropped["nan"]) == (1, 2)
    assert "ring_as_stored" in cloud.fields
    assert len(cloud_of(raw(np.ones((3, 3)), ring=strange, t=strange), "a")) == 3
