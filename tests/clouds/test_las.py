"""LAS and LAZ, written by laspy."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from cloud_files import las

from fusion.clouds import read_cloud, read_raw
from fusion.errors import FrameError, FusionError

pytest.importorskip("laspy")
XYZ = np.random.default_rng(0).normal(0, 20, (60, 3)) + np.array((674_000.0, 5_400_000.0, 300.0))


def saved(folder: Path, data: bytes, name: str = "a.laz") -> Path:
    (folder / name).write_bytes(data)
    return folder / name


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(
    ("point_format", "version"), [(0, "1.2"), (1, "1.2"), (3, "1.3"), (6, "1.4"), (7, "1.4")]
)
def test_formats_and_versions(compressed: bool, point_format: int, version: str, tmp_path: Path) -> None:
    intensity = np.arange(60, dtype=np.uint16) * 1000
    fields = {"intensity": intensity, "classification": np.arange(60, dtype=np.uint8) % 20}
    if point_format:
        fields["gps_time"] = 1.46e9 + np.arange(60) * 1e-3
    path = saved(tmp_path, las(XYZ, compressed, point_format, version, **fields))
    cloud = read_cloud(path)
    assert cloud.xyz_m.dtype == np.float64
    np.testing.assert_allclose(cloud.xyz_m, XYZ, atol=0.000_501)  # stored in steps of a millimetre
    np.testing.assert_array_equal(cloud.fields["intensity"], intensity)
    np.testing.assert_array_equal(cloud.fields["classification"], fields["classification"])
    assert cloud.stamp_ns is None  # GPS time does not count from 1970
    if point_format:
        np.testing.assert_allclose(cloud.fields["time_s"], np.arange(60) * 1e-3, atol=1e-6)
    else:
        assert "time_s" not in cloud.fields
    assert "user_data" in read_raw(path).left_out


@pytest.mark.parametrize("compressed", [False, True])
def test_extra_values_are_kept(compressed: bool, tmp_path: Path) -> None:
    ring, echo = np.arange(60, dtype=np.uint8) % 16, np.linspace(0, 1, 60).astype("f4")
    cloud = read_cloud(saved(tmp_path, las(XYZ, compressed, ring=ring, echo=echo)))
    np.testing.assert_array_equal(cloud.fields["ring"], ring)
    np.testing.assert_array_equal(cloud.fields["echo"], echo)


@pytest.mark.parametrize("compressed", [False, True])
def test_no_points_are_no_error(compressed: bool, tmp_path: Path) -> None:
    cloud = read_cloud(saved(tmp_path, las(np.empty((0, 3)), compressed)))
    assert (len(cloud), cloud.read) == (0, 0)


@pytest.mark.parametrize("version", ["1.2", "1.4"])
@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("count", [61, 50_000, 100_000, 400_000_000, 4_000_000_000])
def test_counts_that_lie(version: str, compressed: bool, count: int, tmp_path: Path) -> None:
    if compressed and version == "1.2" and count == 61:
        pytest.skip("a LAZ of that version does not say how many points its last chunk has")
    data = bytearray(las(XYZ, compressed, 6 if version == "1.4" else 1, version))
    struct.pack_into("<I", data, 107, count)
    if version == "1.4":
        struct.pack_into("<Q", data, 247, count)

    with pytest.raises(FrameError) as caught:
        read_cloud(saved(tmp_path, bytes(data)))
    assert "\n" not in str(caught.value)


WRONG = (
    (0, "<I", 0),  # the signature
    (94, "<H", 1),  # sizes of the header, of what comes before the points, number of records
    (96, "<I", 10**9),
    (96, "<I", 0),
    (100, "<I", 2**32 - 1),
    (104, "<B", 99),  # the form and size of a point
    (105, "<H", 1),
    (131, "<d", np.nan),  # scale and offset
    (155, "<d", np.inf),
)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(("place", "form", "value"), WRONG)
def test_headers_that_cannot_be_right(
    compressed: bool, place: int, form: str, value: float, tmp_path: Path
) -> None:
    data = bytearray(las(XYZ, compressed))
    struct.pack_into(form, data, place, value)
    with pytest.raises(FrameError) as caught:
        read_cloud(saved(tmp_path, bytes(data)))
    assert str(caught.value).startswith(str(tmp_path))


def test_layers_that_ask_for_much_memory(tmp_path: Path) -> None:
    """Behind a layered chunk's first point stand its number of points and the bytes of each layer."""
    data = bytearray(las(XYZ, True, 6, "1.4"))
    start, step = struct.unpack_from("<I", data, 96)[0], struct.unpack_from("<H", data, 105)[0]
    assert struct.unpack_from("<I", data, start + 8 + step)[0] == 60
    struct.pack_into("<I", data, start + 8 + step + 4, 2**32 - 1)
    with pytest.raises(FrameError, match="claims 60 points, the file has 0"):
        read_cloud(saved(tmp_path, bytes(data)))


def test_many_chunks_and_a_last_one_that_lies(tmp_path: Path) -> None:
    xyz = np.random.default_rng(0).normal(0, 20, (100_500, 3))
    data = bytearray(las(xyz, True, 6, "1.4"))
    np.testing.assert_allclose(read_cloud(saved(tmp_path, bytes(data))).xyz_m, xyz, atol=0.000_501)
    struct.pack_into("<Q", data, 247, 100_600)
    with pytest.raises(FrameError, match="claims 100,600 points, the file has 100,500"):
        read_cloud(saved(tmp_path, bytes(data)))


@pytest.mark.parametrize("compressed", [False, True])
def test_a_file_cut_off(compressed: bool, tmp_path: Path) -> None:
    data = las(XYZ, compressed)
    for keep in (len(data) - 1, len(data) // 2, 300, 200, 0):
        with pytest.raises(FrameError):
            read_cloud(saved(tmp_path, data[:keep]))


def test_a_table_of_chunks_that_asks_for_much_memory(tmp_path: Path) -> None:
    data = bytearray(las(XYZ, compressed=True))
    start = struct.unpack_from("<I", data, 96)[0]
    table = struct.unpack_from("<q", data, start)[0]
    struct.pack_into("<I", data, table + 4, 2**32 - 1)
    with pytest.raises(FrameError, match="4,294,967,295 chunks"):
        read_cloud(saved(tmp_path, bytes(data)))


def test_without_laspy_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = saved(tmp_path, las(XYZ))
    monkeypatch.setitem(sys.modules, "lazrs", None)
    with pytest.raises(FusionError, match=r"pip install 'fusionprep\[las\]'"):
        read_cloud(path)
