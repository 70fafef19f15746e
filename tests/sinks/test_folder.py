from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusion.errors import FrameError, OutputError
from fusion.frames import FusedFrame, Window
from fusion.sinks.folder import FolderSink
from fusion.sinks.index import Row, columns_of, read_rows, to_csv
from fusion.sinks.run_folder import first_difference
from tests.worlds import read, tree


def frame(stem: str, value: int = 7, mask: bool = False) -> FusedFrame:
    bgr = np.full((6, 9, 3), value, np.uint8)
    bgr[2, 3] = (1, 2, 3)
    seen = np.full((6, 9), 255, np.uint8)
    seen[:, 0] = 0
    return FusedFrame(
        stem, bgr, seen if mask else None, Window(1.5, 9), 0.25, 0.125, 0.9, 10, 14, ("rgb-grey",)
    )


def write_all(out: Path, *frames: FusedFrame, **options: object) -> None:
    with FolderSink(out, {"config": {"alpha": 0.85}}, **options) as sink:  # type: ignore[arg-type]
        for one in frames:
            sink.record(sink.write(one, "t_" + one.stem))


def test_layout_and_index(tmp_path: Path) -> None:
    write_all(tmp_path / "out", frame("a b"), frame("sub/ä", mask=True))
    assert sorted(tree(tmp_path / "out")) == [
        "frames.csv",
        "fused/a b.png",
        "fused/sub/ä.png",
        "mask/sub/ä.png",
        "run.toml",
    ]
    assert np.array_equal(read(tmp_path / "out/fused/sub/ä.png"), frame("x").bgr)
    assert np.array_equal(read(tmp_path / "out/mask/sub/ä.png")[:, :2], np.tile([[0, 255]], (6, 1)))
    row = read_rows(tmp_path / "out/frames.csv", Row)[0]
    assert (row.stem, row.fir_stem, row.status, row.dt_ns, row.window_lo, row.coverage) == (
        "a b",
        "t_a b",
        "fused",
        "4",
        "1.5",
        "0.900000",
    )
    assert (row.clipped_below, row.clipped_above, row.flags) == ("0.250000", "0.125000", "rgb-grey")
    assert int(row.size) == (tmp_path / "out/fused/a b.png").stat().st_size


def test_names_with_commas_quotes_and_newlines_survive_the_index(tmp_path: Path) -> None:
    rows = [
        Row('a,"b"', "c\nd", "fused"),
        Row.skipped("x", "y", FrameError("half a file", where="/secret/path")),
    ]
    (tmp_path / "i.csv").write_text(to_csv(rows, Row), encoding="utf-8")
    assert read_rows(tmp_path / "i.csv", Row) == rows
    assert "/secret" not in to_csv(rows, Row)


@pytest.mark.parametrize("cut", range(1, 30, 3))
def test_a_half_written_last_row_does_not_count(tmp_path: Path, cut: int) -> None:
    text = to_csv([Row("a", "b", "fused", size="1"), Row("c", "d", "fused", size="2")], Row, header=False)
    (tmp_path / "j.csv").write_text(text[:-cut])
    assert [row.stem for row in read_rows(tmp_path / "j.csv", Row, header=False)] in (
        [["a"]] if cut < 20 else [["a"], []]
    )


def test_leaving_on_an_error_keeps_the_journal_and_the_next_run_goes_on(tmp_path: Path) -> None:
    out = tmp_path / "out"
    sink = FolderSink(out)
    sink.__enter__()
    sink.record(sink.write(frame("a"), "a"))
    sink.__exit__(RuntimeError)
    assert not (out / "frames.csv").exists()
    with FolderSink(out) as sink:
        kept = sink.finished("a", 0)
        assert kept is not None
        assert sink.finished("b", 0) is None
        sink.record(kept)
    assert not (out / ".partial").exists()
    assert [row.stem for row in read_rows(out / "frames.csv", Row)] == ["a"]


def test_a_finished_frame_counts_only_when_whole_and_newer_than_its_inputs(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write_all(out, frame("a"), frame("b"), frame("c"))
    (out / "fused/b.png").write_bytes(b"cut")
    (out / "fused/c.png").unlink()
    stamp = (out / "fused/a.png").stat().st_mtime_ns
    with FolderSink(out, {"config": {"alpha": 0.85}}) as sink:
        assert sink.finished("a", stamp) is not None
        assert sink.finished("a", stamp + 1) is None
        assert sink.finished("b", 0) is None
        assert sink.finished("c", 0) is None


def test_another_runs_folder_is_refused_untouched_with_the_difference_named(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write_all(out, frame("a"))
    before = tree(out)
    with (
        pytest.raises(OutputError, match=r"config\.alpha was 0\.85, is 0\.5.*--overwrite"),
        FolderSink(out, {"config": {"alpha": 0.5}}),
    ):
        pass
    assert tree(out) == before


def test_frames_of_unknown_origin_are_refused(tmp_path: Path) -> None:
    (tmp_path / "fused").mkdir()
    (tmp_path / "fused" / "mine.png").write_bytes(b"precious")
    with pytest.raises(OutputError, match=r"no run\.toml"), FolderSink(tmp_path):
        pass
    assert tree(tmp_path) == {"fused/mine.png": b"precious"}


def test_overwrite_deletes_what_the_index_lists_and_nothing_else(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write_all(out, frame("a", mask=True), frame("b"))
    (out / "fused" / "mine.png").write_bytes(b"precious")
    write_all(out, frame("b", 9), overwrite=True)
    assert sorted(tree(out)) == ["frames.csv", "fused/b.png", "fused/mine.png", "run.toml"]
    assert read(out / "fused/b.png")[0, 0, 0] == 9


@pytest.mark.parametrize("stem", ["../a", "/a", "a/../../b", ""])
def test_names_stay_inside_the_folder(tmp_path: Path, stem: str) -> None:
    with pytest.raises(OutputError, match="leads out"), FolderSink(tmp_path / "out") as sink:
        sink.write(frame(stem), "t")
    assert not (tmp_path / "a.png").exists()


def test_two_runs_into_one_folder_are_kept_apart(tmp_path: Path) -> None:
    with (
        FolderSink(tmp_path / "out"),
        pytest.raises(OutputError, match="another run"),
        FolderSink(tmp_path / "out"),
    ):
        pass
    with FolderSink(tmp_path / "out"):
        pass


def test_a_file_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    with pytest.raises(OutputError, match="is a file"), FolderSink(tmp_path / "out"):
        pass
    assert (tmp_path / "out").read_text() == "mine"


def test_record_needs_an_open_sink(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="with block"):
        FolderSink(tmp_path).record(Row("a", "b", "fused"))


def test_jpeg_suffix_and_quality(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    noisy = FusedFrame("a", rng.integers(0, 256, (64, 64, 3), np.uint8), None, Window(0, 1), 0, 0, 1)
    sizes = []
    for quality in (40, 95):
        out = tmp_path / str(quality)
        write_all(out, noisy, image_format="jpg", quality=quality)
        sizes.append((out / "fused/a.jpg").stat().st_size)
    assert sizes[0] < sizes[1] / 1.5


def test_first_difference_names_the_deepest_key() -> None:
    assert first_difference({"a": {"b": [1, 2]}}, {"a": {"b": (1, 2)}}) is None
    assert first_difference({"a": {"b": [1, 2]}}, {"a": {"b": [1, 3]}}) == "a.b was 2, is 3"
    assert first_difference({"a": 1}, {}) == "a was 1, is not there"
    assert len(columns_of(Row)) == 15


def test_two_pairs_of_one_name_are_refused_before_one_overwrites_the_other(tmp_path: Path) -> None:
    sink = FolderSink(tmp_path / "out")
    with pytest.raises(OutputError, match="'a' and 'a' would be one file"), sink:
        sink.expect(["a", "b", "a"])
    with FolderSink(tmp_path / "out") as again:
        again.expect(["a", "A"])  # this disk tells them apart


def test_a_frame_whose_mask_is_gone_is_not_finished(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write_all(out, frame("a", mask=True))
    with FolderSink(out, {"config": {"alpha": 0.85}}) as sink:
        assert sink.finished("a", 0) is not None
        (out / "mask/a.png").unlink()
        assert sink.finished("a", 0) is None


def test_a_frame_that_is_skipped_now_leaves_nothing_stale(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write_all(out, frame("a", mask=True), frame("b"))
    with FolderSink(out, {"config": {"alpha": 0.85}}) as sink:
        sink.record(Row.skipped("a", "a", FrameError("gone bad")))
        kept = sink.finished("b", 0)
        assert kept is not None
        sink.record(kept)
    assert sorted(tree(out)) == ["frames.csv", "fused/b.png", "run.toml"]
