"""What a folder of depth maps holds, to the bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusion.errors import FrameError, OutputError
from fusion.lidar.lane import DepthFrame
from fusion.lidar.sparse import DenseDepth, SparseDepth
from fusion.sinks.depth import KINDS, DepthRow, DepthSink, quantised
from fusion.sinks.index import read_rows
from tests.worlds import read, tree

STEPS = ("read", "finite", "in_front", "in_frame", "in_range", "visible")
PICTURE = np.full((6, 9, 3), 50, np.uint8)


def frame(stem: str, value_m: float = 2.5, ring: Any = None) -> DepthFrame:
    counts: dict[str, int] = dict(zip(STEPS, (9, 8, 7, 6, 5, 3), strict=True))
    u, v = np.array([1.25, 2.0, 7.75]), np.array([0.1, 3.5, 5.4])
    samples = np.array([value_m, 3.3, 4.4], np.float32)
    sparse = SparseDepth((9, 6), u, v, samples, "depth", np.array([4, 0, 7]), ring, counts)
    dense = np.zeros((6, 9), np.float32)
    dense[1:4, 2:7] = value_m
    support = dense > 0
    support[1] = False
    return DepthFrame(stem, sparse, DenseDepth(dense, support, "depth"), 17, {"nan": 2, "zero": 0})


def write_all(out: Path, *frames: DepthFrame, run: str = "a", **options: Any) -> None:
    with DepthSink(out, {"config": {"method": run}}, **options) as sink:
        for one in frames:
            sink.record(sink.write(one, PICTURE))


def test_files_and_what_is_in_them(tmp_path: Path) -> None:
    ring = np.array([3, 0, 1], np.int32)
    with DepthSink(tmp_path / "out") as sink:
        sink.record(sink.write(frame("sub/ä b.c", ring=ring), PICTURE, PICTURE[::-1].copy()))
        sink.record(sink.write(frame("x"), PICTURE))
    assert sorted(tree(tmp_path / "out")) == sorted(
        [
            "frames.csv",
            "run.toml",
            *(f"{kind}/sub/ä b.c{suffix}" for kind, suffix in KINDS.items()),
            *(f"{kind}/x{suffix}" for kind, suffix in KINDS.items() if kind != "overlay"),
        ]
    )
    depth, support = read(tmp_path / "out/depth/x.png"), read(tmp_path / "out/support/x.png")
    assert (depth.dtype, support.dtype) == (np.uint16, np.uint8)
    np.testing.assert_array_equal(depth, np.where(frame("x").dense.value_m > 0, 640, 0))
    np.testing.assert_array_equal(support, np.where(frame("x").dense.support, 255, 0))
    with np.load(tmp_path / "out/sparse/sub/ä b.c.npz") as npz:
        assert sorted(npz) == ["col", "index", "ring", "row", "size_wh", "value", "value_m"]
        assert npz["row"].tolist() == [0.1, 3.5, 5.4]
        assert npz["col"].tolist() == [1.25, 2.0, 7.75]
        assert npz["row"].dtype == npz["col"].dtype == np.float64
        assert npz["index"].tolist() == [4, 0, 7]
        assert npz["ring"].tolist() == [3, 0, 1]
        np.testing.assert_array_equal(npz["value_m"], np.array([2.5, 3.3, 4.4], np.float32))
        assert (str(npz["value"]), npz["size_wh"].tolist()) == ("depth", [9, 6])
    with np.load(tmp_path / "out/sparse/x.npz") as npz:
        assert npz["ring"].tolist() == [-1, -1, -1]


def test_the_index_says_what_was_counted(tmp_path: Path) -> None:
    write_all(tmp_path / "out", frame("x"))
    (row,) = read_rows(tmp_path / "out/frames.csv", DepthRow)
    assert [getattr(row, name) for name in STEPS] == ["9", "8", "7", "6", "5", "3"]
    assert (row.status, row.stamp_ns, row.value, row.dropped) == ("made", "17", "depth", "nan=2")
    assert (row.covered, row.supported, row.pixels) == ("15", "10", "54")
    assert (row.least_m, row.most_m) == ("2.500", "2.500")
    sizes = {kind: (tmp_path / f"out/{kind}/x{suffix}").stat().st_size for kind, suffix in KINDS.items()
             if kind != "overlay"}  # fmt: skip
    assert {kind: int(getattr(row, f"{kind}_size")) for kind in sizes} == sizes
    assert row.overlay_size == ""


@pytest.mark.parametrize(
    ("metres", "counts"),
    [
        (0, 0),
        (1e-6, 1),
        (1 / 256, 1),
        (1.5 / 256, 2),
        (1.499 / 256, 1),
        (10, 2560),
        (255.99609375, 65535),
        (256, 65535),
        (1e30, 65535),
    ],
)
def test_metres_become_counts_half_up_and_a_value_never_becomes_none(metres: float, counts: int) -> None:
    assert quantised(np.array([[metres]], np.float32)).tolist() == [[counts]]


def test_the_same_frame_gives_the_same_bytes(tmp_path: Path) -> None:
    write_all(tmp_path / "a", frame("x"), frame("y", 3.0))
    write_all(tmp_path / "b", frame("x"), frame("y", 3.0))
    assert tree(tmp_path / "a") == tree(tmp_path / "b")


def test_a_map_is_finished_when_all_its_files_are_whole(tmp_path: Path) -> None:
    out, run = tmp_path / "out", {"config": {"method": "a"}}
    names = [f"gone-{kind}" for kind in KINDS if kind != "overlay"]
    write_all(out, frame("whole"), *(frame(name) for name in names))
    for kind, name in zip((k for k in KINDS if k != "overlay"), names, strict=True):
        (out / kind / f"{name}{KINDS[kind]}").unlink()
    stamp = (out / "support/whole.png").stat().st_mtime_ns
    with DepthSink(out, run) as sink:
        assert sink.finished("whole", stamp) is not None
        assert sink.finished("whole", stamp + 1) is None
        assert [sink.finished(name, 0) for name in names] == [None] * len(names)


@pytest.mark.parametrize(
    ("column", "text"),
    [
        ("read", ""),
        ("read", "many"),
        ("pixels", "-1"),
        ("depth_size", ""),
        ("sparse_size", "x"),
        ("status", "?"),
    ],
)
def test_a_row_that_is_not_ours_is_made_again(tmp_path: Path, column: str, text: str) -> None:
    out = tmp_path / "out"
    write_all(out, frame("a"))
    (row,) = read_rows(out / "frames.csv", DepthRow)
    spoilt = replace(row, **{column: text})
    index = (out / "frames.csv").read_text()
    head = index.splitlines()[0]
    values = ",".join(getattr(spoilt, name) for name in head.split(","))
    (out / "frames.csv").write_text(f"{head}\n{values}\n")
    with DepthSink(out, {"config": {"method": "a"}}) as sink:
        assert sink.finished("a", 0) is None


def test_a_skipped_cloud_says_why_and_what_to_do_but_not_where(tmp_path: Path) -> None:
    row = DepthRow.skipped("a", FrameError("cut off", where="/secret/a.pcd", hint="copy it again"))
    assert (row.status, row.reason) == ("skipped", "cut off (copy it again)")
    write_all(tmp_path / "out", frame("a"), frame("b"))
    with DepthSink(tmp_path / "out", {"config": {"method": "a"}}) as sink:
        sink.record(row)
        kept = sink.finished("b", 0)
        assert kept is not None
        sink.record(kept)
    left = tree(tmp_path / "out")
    assert not [name for name in left if "/a." in name]
    assert "secret" not in left["frames.csv"].decode()


def test_overwrite_deletes_what_the_index_lists_and_nothing_else(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write_all(out, frame("a"), frame("b"))
    (out / "depth/mine.png").write_bytes(b"precious")
    with pytest.raises(OutputError, match=r"config\.method was 'a', is 'b'.*--overwrite"):
        write_all(out, frame("b"), run="b")
    write_all(out, frame("b"), run="b", overwrite=True)
    left = tree(out)
    assert left["depth/mine.png"] == b"precious"
    assert not [name for name in left if name.endswith(("/a.png", "/a.npz"))]


def test_a_table_of_somebody_else_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "frames.csv").write_text("my,own\n1,2\n")
    with pytest.raises(OutputError, match=r"no run\.toml"):
        write_all(tmp_path, frame("a"))
    assert tree(tmp_path) == {"frames.csv": b"my,own\n1,2\n"}
    (tmp_path / "frames.csv").unlink()
    (tmp_path / "run.toml").write_text('format = "mine/1"\n')
    with pytest.raises(OutputError, match="another run"):
        write_all(tmp_path, frame("a"))
    assert tree(tmp_path) == {"run.toml": b'format = "mine/1"\n'}


def test_a_run_that_made_nothing_leaves_nothing(tmp_path: Path) -> None:
    before = tmp_path / "there"
    before.mkdir()
    for out in (before, tmp_path / "new"):
        sink = DepthSink(out, {"config": {"method": "a"}})
        sink.__enter__()
        sink.expect(["a"])
        sink.record(DepthRow.skipped("a", FrameError("bad")))
        sink.__exit__(FrameError)
    assert before.is_dir()
    assert not list(tmp_path.rglob("*"))[1:]


def test_a_run_that_came_to_nothing_stands_in_nobodys_way(tmp_path: Path) -> None:
    """Killed before its first frame, so that it could not clean up."""
    sink = DepthSink(tmp_path, {"config": {"method": "a"}})
    sink.__enter__()
    sink._close()  # as the end of the process would
    assert (tmp_path / "run.toml").exists()
    write_all(tmp_path, frame("a"), run="b")
    assert (tmp_path / "depth/a.png").exists()


def test_an_error_after_a_frame_keeps_it(tmp_path: Path) -> None:
    sink = DepthSink(tmp_path / "out")
    sink.__enter__()
    sink.record(sink.write(frame("a"), PICTURE))
    sink.__exit__(RuntimeError)
    with DepthSink(tmp_path / "out") as again:
        assert again.finished("a", 0) is not None
