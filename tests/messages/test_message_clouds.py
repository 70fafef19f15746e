"""Points of messages as clouds, against the structured array they were made of."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader

from fusion.errors import FrameError
from fusion.messages import reader_of
from fusion.messages.base import Header, PointField, Points
from fusion.messages.clouds import cloud_of_points
from fusion.recordings.base import Schema, Topic
from tests.messages import samples

STAMP = 1_700_000_000_000_000_005


def points_of(array: np.ndarray, *, step: int = 0, row_padding: int = 0, cut: int = 0) -> Points:
    """The message of an H x W structured array; points of `step` bytes, `cut` bytes left out at the end."""
    h, w = array.shape
    size = array.dtype.itemsize
    step = step or size
    rows = []
    for row in array:
        padded = np.full((w, step), 0xEE, np.uint8)
        padded[:, :size] = row.view(np.uint8).reshape(w, size)
        rows.append(padded.tobytes() + b"\xee" * row_padding)
    data = b"".join(rows)[: -cut or None]
    fields = []
    for name, (dtype, offset, *_) in (array.dtype.fields or {}).items():
        fields.append(PointField(name, offset, dtype.base, int(np.prod(dtype.shape))))
    return Points(Header(STAMP, "lidar"), w, h, tuple(fields), step, w * step + row_padding, data)


def array_of(kinds: list[tuple], h: int, w: int) -> np.ndarray:
    random, array = np.random.default_rng(3), np.zeros((h, w), kinds)
    for name in array.dtype.names or ():
        array[name] = random.integers(1, 100, array[name].shape)
    return array


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("step", "row_padding"), [(0, 0), (48, 0), (0, 5), (48, 16)])
@pytest.mark.parametrize("h", [1, 3])
def test_any_layout(order: str, step: int, row_padding: int, h: int) -> None:
    kinds = [("ring", f"{order}u2"), ("z", f"{order}f4"), ("n", f"{order}i2", (2,)), ("x", f"{order}f4")]
    array = array_of([*kinds, ("y", f"{order}f4"), ("intensity", "u1"), ("t", f"{order}u4")], h, 4)
    array["x"][0, 1] = np.nan
    array[0, 2] = 0
    points = points_of(array, step=step, row_padding=row_padding)
    cloud = cloud_of_points(points, stem="lidar/5", where="a")
    kept = array.reshape(-1)[[k for k in range(4 * h) if k not in (1, 2)]]
    assert (cloud.stem, cloud.stamp_ns, cloud.read) == ("lidar/5", STAMP, 4 * h)
    assert cloud.dropped == {"nan": 1, "zero": 1}
    assert np.array_equal(cloud.xyz_m, np.stack([kept[axis] for axis in "xyz"], -1))
    assert cloud.xyz_m.dtype == np.float32
    assert np.array_equal(cloud.fields["ring"], kept["ring"])
    assert np.array_equal(cloud.fields["intensity"], kept["intensity"])
    assert np.array_equal(cloud.fields["n_0"], kept["n"][:, 0])
    assert np.array_equal(cloud.fields["n_1"], kept["n"][:, 1])
    t = kept["t"].astype(np.float64)
    assert np.allclose(cloud.fields["time_s"], (t - t.min()) * 1e-9, rtol=0, atol=1e-15)


def test_the_last_point_need_not_be_padded() -> None:
    array = array_of([("x", "<f4"), ("y", "<f4"), ("z", "<f4")], 2, 3)
    whole = points_of(array, step=16, row_padding=8)
    cut = points_of(array, step=16, row_padding=8, cut=8 + 4)
    assert np.array_equal(
        cloud_of_points(cut, stem="", where="").xyz_m, cloud_of_points(whole, stem="", where="").xyz_m
    )
    with pytest.raises(FrameError, match="bytes, it has"):
        cloud_of_points(points_of(array, step=16, row_padding=8, cut=13), stem="", where="a")


def test_points_that_tell_their_own_time() -> None:
    array = array_of([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("timestamp", "<f8")], 1, 5)
    array["timestamp"] = 1_600_000_000.5 + np.arange(5) * 0.25
    cloud = cloud_of_points(points_of(array), stem="", where="")
    assert cloud.stamp_ns == 1_600_000_000_500_000_000
    assert cloud.fields["time_s"].tolist() == [0, 0.25, 0.5, 0.75, 1]


@pytest.mark.parametrize("wire", samples.WIRES)
def test_livox(wire: str) -> None:
    values = {"offset_time": 2000, "reflectivity": 40, "tag": 16, "line": 3}
    point = "livox_ros_driver2/CustomPoint"
    each = [
        samples.made(wire, point, x=k + 1.5, y=2, z=-k, **values | {"offset_time": k * 1000})
        for k in range(7)
    ]
    rest = {"timebase": 9, "point_num": 7, "lidar_id": 0, "rsvd": np.zeros(3, np.uint8)}
    data = samples.sent(wire, samples.made(wire, samples.LIVOX, points=each, **rest))
    message = reader_of(samples.topic(wire, samples.LIVOX)).message(data)
    assert isinstance(message, Points)
    cloud = cloud_of_points(message, stem="", where="a")
    assert cloud.xyz_m.tolist() == [[k + 1.5, 2, -k] for k in range(7)]
    assert np.allclose(cloud.fields["time_s"], np.arange(7) * 1e-6, rtol=0, atol=1e-15)
    assert cloud.fields["intensity"].tolist() == [40] * 7
    assert cloud.fields["ring"].tolist() == [3] * 7
    assert cloud.fields["tag"].tolist() == [16] * 7
    assert cloud.stamp_ns == samples.STAMP_NS


def test_a_pose_moves_the_points() -> None:
    array = array_of([("x", "<f4"), ("y", "<f4"), ("z", "<f4")], 1, 4)
    T = np.array([[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1.0]])
    still = points_of(array)
    moved = replace(still, T_frame_points=T)
    expected = [[10 - y, 20 + x, 30 + z] for x, y, z in array.reshape(-1).tolist()]
    cloud = cloud_of_points(moved, stem="", where="")
    assert cloud.xyz_m.tolist() == expected
    assert cloud.xyz_m.dtype == np.float32


F4 = np.dtype("<f4")
XYZ = tuple(PointField(name, 4 * k, F4) for k, name in enumerate("xyz"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"width": 0}, "0 x 1 points"),
        ({"height": 0}, "2 x 0 points"),
        ({"width": (1 << 32) - 1}, "more than the 500,000,000"),
        ({"width": 400_000_000}, "need 4,800,000,000 bytes, it has 24"),
        ({"point_step": 0}, "0 bytes apart"),
        ({"point_step": (1 << 64) - 1, "width": 1}, "bytes apart"),
        ({"point_step": 11}, "'z' ends at byte 12 of points of 11"),
        ({"height": 2, "width": 1, "row_step": 4}, "its rows are 4 bytes apart"),
        ({"row_step": 1 << 40, "height": 2}, "bytes, it has 24"),
        ({"data": bytes(23)}, "need 24 bytes, it has 23"),
        ({"fields": XYZ[:2]}, "no x, y, z among its fields: x, y"),
        ({"fields": ()}, "no x, y, z"),
        ({"fields": (*XYZ, PointField("a", -4, F4))}, "'a' ends at byte 0"),
        ({"fields": (*XYZ, PointField("a", 0, F4, (1 << 32) - 1))}, "more than 1024 numbers"),
    ],
)
def test_what_does_not_fit_is_refused(change: dict, words: str) -> None:
    values = {"width": 2, "height": 1, "fields": XYZ, "point_step": 12, "row_step": 24, "data": bytes(24)}
    with pytest.raises(FrameError) as raised:
        cloud_of_points(Points(Header(), **values | change), stem="", where="/points 9")
    assert words in str(raised.value)
    assert str(raised.value).startswith("/points 9: ")


@settings(max_examples=60)
@given(
    *(st.integers(0, 5) for _ in range(2)),
    *(st.integers(0, 40) for _ in range(2)),
    st.lists(
        st.tuples(st.sampled_from("xyzti"), st.integers(-2, 20), st.sampled_from(["<f4", ">f8", "u1"])),
        max_size=6,
    ),
    st.binary(max_size=300),
)
def test_any_points_are_a_cloud_or_a_frame_error(
    w: int, h: int, step: int, row_step: int, fields: list, data: bytes
) -> None:
    made = tuple(PointField(name, offset, np.dtype(kind)) for name, offset, kind in fields)
    try:
        cloud = cloud_of_points(Points(Header(), w, h, made, step, row_step, data), stem="", where="a")
    except FrameError:
        return
    assert cloud.read == w * h


def test_a_real_cloud(shared_data: Path) -> None:
    """124,914 points with padding, against the same bytes read as a structured array."""
    with AnyReader([shared_data / "recordings" / "PointCloud2.bag"]) as bag:
        ((connection, _, data),) = bag.messages()
        schema = Schema(connection.msgtype, "ros1msg", connection.msgdef.data.encode())
    message = reader_of(Topic(connection.topic, schema, "ros1")).message(data)
    assert isinstance(message, Points)
    cloud = cloud_of_points(message, stem="", where="a")
    names, kinds = ["x", "y", "z", "intensity", "ring"], ["<f4"] * 4 + ["<u2"]
    layout = np.dtype({"names": names, "formats": kinds, "offsets": [0, 4, 8, 16, 20], "itemsize": 32})
    array = np.frombuffer(message.data, layout)
    xyz = np.stack([array[axis] for axis in "xyz"], -1)
    keep = np.isfinite(xyz).all(1) & xyz.any(1)
    assert cloud.read == 124_914
    assert np.array_equal(cloud.xyz_m, xyz[keep])
    assert np.array_equal(cloud.fields["ring"], array["ring"][keep])
    assert np.array_equal(cloud.fields["intensity"], array["intensity"][keep])
