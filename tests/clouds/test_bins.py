"""Bare float32 records: four columns, five, and neither."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusion.clouds import read_cloud
from fusion.errors import FrameError


def kitti(n: int) -> np.ndarray:
    rng = np.random.default_rng(n)
    return np.column_stack([rng.normal(0, 20, (n, 3)), rng.integers(0, 100, n) / 100]).astype("<f4")


def nuscenes(n: int) -> np.ndarray:
    rng = np.random.default_rng(n)
    return np.column_stack([rng.normal(0, 20, (n, 3)), rng.integers(0, 256, n), np.arange(n) % 32]).astype(
        "<f4"
    )


def saved(folder: Path, name: str, data: np.ndarray | bytes) -> Path:
    (folder / name).write_bytes(bytes(data) if isinstance(data, bytes) else data.tobytes())
    return folder / name


@pytest.mark.parametrize("n", [1, 2, 4, 5, 20, 40, 99, 100, 4000])  # 20, 40, 100, 4000: the size fits both
def test_which_of_the_two_is_seen(n: int, tmp_path: Path) -> None:
    four, five = kitti(n), nuscenes(n)
    cloud = read_cloud(saved(tmp_path, "a.bin", four))
    np.testing.assert_array_equal(cloud.xyz_m, four[:, :3])
    np.testing.assert_array_equal(cloud.fields["intensity"], four[:, 3])
    assert list(cloud.fields) == ["intensity"]
    for name in ("b.bin", "b.pcd.bin", "b.PCD.BIN"):
        cloud = read_cloud(saved(tmp_path, name, five))
        assert cloud.stem == "b"
        np.testing.assert_array_equal(cloud.xyz_m, five[:, :3])
        np.testing.assert_array_equal(cloud.fields["ring"], five[:, 4])
        assert cloud.fields["ring"].dtype == np.int32


def test_four_columns_in_front_of_the_sensor_are_no_rings(tmp_path: Path) -> None:
    """The size fits both, and every number lies where a ring might: only whole numbers are one."""
    rows = np.abs(kitti(40)) + np.float32(0.125)
    np.testing.assert_array_equal(read_cloud(saved(tmp_path, "a.bin", rows)).xyz_m, rows[:, :3])


def test_a_form_is_forced(tmp_path: Path) -> None:
    rows = nuscenes(40)
    path = saved(tmp_path, "a.bin", rows)
    np.testing.assert_array_equal(read_cloud(path, "kitti").xyz_m, rows.reshape(-1, 4)[:, :3])
    rows[:, 4] += 0.5  # the fifth may be anything where one insists
    path = saved(tmp_path, "b.bin", rows)
    np.testing.assert_array_equal(read_cloud(path, "nuscenes").fields["ring_as_stored"], rows[:, 4])
    assert "ring" not in read_cloud(path, "nuscenes").fields


@pytest.mark.parametrize("rows", [kitti(41), kitti(40), nuscenes(40), nuscenes(41)])
def test_swapped_bytes_are_named(rows: np.ndarray, tmp_path: Path) -> None:
    path = saved(tmp_path, "a.bin", rows.byteswap())
    with pytest.raises(FrameError, match="byte-swapped") as caught:
        read_cloud(path)
    assert str(caught.value).startswith(f"{path}: ")
    mixed = rows.copy()
    mixed[: len(rows) // 2] = mixed[: len(rows) // 2].byteswap()  # half of it, and neither order is right
    with pytest.raises(FrameError, match=r"no metres|byte-swapped|no ring|no whole number"):
        read_cloud(saved(tmp_path, "b.bin", mixed))


def test_sizes_that_fit_neither(tmp_path: Path) -> None:
    data = kitti(40).tobytes()
    for keep, words in (
        (639, "639 bytes are no whole number"),
        (627, "627"),
        (620, "no ring"),
        (3, "3 bytes"),
    ):
        with pytest.raises(FrameError, match=words):
            read_cloud(saved(tmp_path, "a.bin", data[:keep]))
    with pytest.raises(FrameError, match="5 float32"):
        read_cloud(saved(tmp_path, "a.bin", data[:-16]), "nuscenes")
    with pytest.raises(FrameError, match="4 float32"):
        read_cloud(saved(tmp_path, "a.bin", data[:-4]), "kitti")


def test_text_under_a_wrong_name_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FrameError):
        read_cloud(
            saved(tmp_path, "a.bin", b"# this is a text and no cloud at all, of 64 characters in all..\n")
        )
    noise = np.random.default_rng(0).bytes(16 * 999)
    with pytest.raises(FrameError, match="no metres"):
        read_cloud(saved(tmp_path, "a.bin", noise))


def test_an_empty_file_has_no_points(tmp_path: Path) -> None:
    cloud = read_cloud(saved(tmp_path, "a.bin", b""))
    assert (len(cloud), cloud.read, dict(cloud.dropped)) == (0, 0, {"nan": 0, "zero": 0})


def test_the_real_kitti_scan(shared_data: Path) -> None:
    path = shared_data / "kitti_object" / "velodyne" / "000000.bin"
    rows = np.fromfile(path, "<f4").reshape(-1, 4)
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.xyz_m, rows[:, :3])
    np.testing.assert_array_equal(cloud.fields["intensity"], rows[:, 3])
    assert (cloud.stem, cloud.read) == ("000000", len(rows))
