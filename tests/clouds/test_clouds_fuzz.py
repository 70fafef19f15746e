"""Damaged files of every form: an error of ours or a cloud, never anything else, never much memory."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cloud_files import las, npy, npz, pcd, ply, records

from fusion.clouds import read_cloud
from fusion.errors import FusionError

ROWS = records(24)
XYZ = np.stack([ROWS[axis].astype("f8") for axis in "xyz"], 1)
FACES = "element face 2\nproperty list uchar int vertex_indices\n"
FACED = b"\1\0\0\0\0\0"  # a list of one, a list of none
MADE: dict[str, Callable[[], bytes]] = {
    "ascii.pcd": lambda: pcd(ROWS, "ascii"),
    "binary.pcd": lambda: pcd(ROWS, "binary"),
    "compressed.pcd": lambda: pcd(ROWS, "binary_compressed"),
    "ascii.ply": lambda: ply(ROWS, "ascii", (FACES, b"3 0 1 2\n3 2 1 0\n")),
    "little.ply": lambda: ply(ROWS, "binary_little_endian", (FACES, FACED)),
    "big.ply": lambda: ply(ROWS, "binary_big_endian"),
    "four.bin": lambda: np.column_stack([XYZ, XYZ[:, 0]]).astype("<f4").tobytes(),
    "five.pcd.bin": lambda: np.column_stack([XYZ, XYZ[:, 0], ROWS["ring"]]).astype("<f4").tobytes(),
    "plain.npy": lambda: npy(XYZ),
    "records.npy": lambda: npy(ROWS),
    "stored.npz": lambda: npz(xyz=XYZ, ring=ROWS["ring"]),
    "deflated.npz": lambda: npz(True, xyz=XYZ, ring=ROWS["ring"]),
    "a.las": lambda: las(XYZ, extra=ROWS["t"]),
    "a.laz": lambda: las(XYZ, compressed=True, gps_time=XYZ[:, 0]),
    "b.laz": lambda: las(XYZ, compressed=True, point_format=6, version="1.4"),
}


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut off, lengthened, or with a few bytes changed, more often in the header than behind it."""
    way = rng.integers(0, 8)
    if way == 0:
        return data[: rng.integers(0, len(data))]
    if way == 1:
        return data + rng.bytes(int(rng.integers(1, 60)))
    spoilt = bytearray(data)
    for _ in range(rng.integers(1, 6)):
        reach = len(data) if way < 4 else min(len(data), 420)
        at = int(rng.integers(0, reach))
        anything = int(rng.integers(0, 256))
        spoilt[at] = (anything, 0, 255, 128, *b"9 \n")[rng.integers(0, 7)]
    return bytes(spoilt)


@pytest.mark.parametrize("name", MADE)
def test_damage(name: str, tmp_path: Path) -> None:
    if ".la" in name:
        pytest.importorskip("laspy")
    data, rng = MADE[name](), np.random.default_rng(len(name))
    path = tmp_path / name
    path.write_bytes(data)
    assert len(read_cloud(path)) == 24
    tracemalloc.start()
    refused = 0
    for _ in range(40):
        path.write_bytes(damaged(data, rng))
        message = said(path)
        refused += bool(message)
        assert not message or (str(path) in message and "\n" not in message)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert refused > 3
    assert peak < 50_000_000


def said(path: Path) -> str:
    """What the reader says of the file; nothing where it gives a cloud, which is then a sound one."""
    try:
        cloud = read_cloud(path)
    except FusionError as error:
        return str(error)
    assert np.isfinite(cloud.xyz_m).all()
    assert cloud.xyz_m.any(axis=1).all()
    assert len(cloud) + sum(cloud.dropped.values()) == cloud.read
    return ""


def test_bytes_of_no_form_at_all(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for name in MADE:
        for size in (0, 1, 20, 500):
            (tmp_path / name).write_bytes(rng.bytes(size))
            message = said(tmp_path / name)
            assert str(tmp_path / name) in message or size == 0 or name.endswith(".bin")
