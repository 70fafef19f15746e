"""The same flight from every container: one command each, identical frames, nothing dropped in silence."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fusion.chunks import Chunk
from fusion.cli.preprocessing import run_preprocess
from fusion.errors import InputError, UsageError
from fusion.preprocess.campaign import Route
from fusion.preprocess.config import PreprocessConfig, StreamsConfig
from fusion.preprocess.footage import Dropped, Moment
from fusion.preprocess.recorded import RecordedFootage
from fusion.preprocess.streams import resolve_streams
from fusion.preprocess.work import PreprocessWork, make_plan
from fusion.recordings import open_recording
from fusion.recordings.base import Packet
from fusion.rig import load_rig
from fusion.simulate.containers import COMPRESSIONS, write_recording
from fusion.storage import open_storage
from tests.preprocess.flights import flight as flight
from tests.preprocess.flights import tree

# Every form plain, and in the last of its compressions; tests/simulate/test_containers.py reads them all.
FORMS = [(form, compression) for form, kinds in COMPRESSIONS.items() for compression in (kinds[0], kinds[-1])]


def command(source: Path, flight: Path, out: Path, **groups: Any) -> None:
    """What `fusion preprocess SOURCE -o OUT --rig …` does."""
    rig = {"warp": {"rig": str(flight / "truth" / "rig.toml")}}
    config = PreprocessConfig.of({"fuse": rig, "chunk_s": 1.0, **groups})
    run_preprocess(
        config, str(source), None, str(out), route=Route(2), overwrite=False, dry_run=False, quiet=True
    )


def frames_of(out: Path) -> dict[str, bytes]:
    """All that was made of the pictures: everything but the campaign's own records."""
    return {name: data for name, data in tree(out).items() if not name.startswith("chunks/")}


def footage_of(path: Path, **streams: Any) -> RecordedFootage:
    with closing(open_recording(path)) as recording:
        resolved, _ = resolve_streams(recording, StreamsConfig(**streams))
    return RecordedFootage(str(path), resolved)


@pytest.fixture(scope="module")
def bag(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(flight, tmp_path_factory.mktemp("bag") / "mine.bag", "rosbag1").path


@pytest.fixture(scope="module")
def from_bag(bag: Path, flight: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    out = tmp_path_factory.mktemp("from_bag") / "out"
    command(bag, flight, out)
    return frames_of(out)


@pytest.mark.parametrize(("form", "compression"), FORMS)
def test_every_container_gives_the_same_frames(
    flight: Path, from_bag: dict[str, bytes], tmp_path: Path, form: str, compression: str
) -> None:
    written = write_recording(flight, tmp_path / "mine", form, compression=compression)
    command(written.path, flight, tmp_path / "out")
    ours = frames_of(tmp_path / "out")
    assert sum(name.startswith("fused/") for name in ours) > 15
    assert sorted(ours) == sorted(from_bag)
    assert [name for name in ours if ours[name] != from_bag[name]] == []


@pytest.mark.parametrize("form", ["rosbag1", "mcap-ros2", "mcap-json"])
def test_raw_pictures_give_the_same_frames(
    flight: Path, from_bag: dict[str, bytes], tmp_path: Path, form: str
) -> None:
    written = write_recording(flight, tmp_path / "mine", form, raw=True)
    command(written.path, flight, tmp_path / "out")
    ours = frames_of(tmp_path / "out")
    assert [
        n for n in ours if n != "run.toml" and ours[n] != from_bag[n]
    ] == []  # its topics have other names


def test_split_files_give_the_same_frames(flight: Path, from_bag: dict[str, bytes], tmp_path: Path) -> None:
    written = write_recording(flight, tmp_path / "mine", "rosbag2", split_bytes=300_000)
    assert len(list(written.path.glob("*.db3"))) > 2
    command(written.path, flight, tmp_path / "out")
    assert frames_of(tmp_path / "out") == from_bag


def test_folders_give_the_same_pictures_as_recordings(
    flight: Path, from_bag: dict[str, bytes], tmp_path: Path
) -> None:
    """The window is planned from other samples, so frames are compared by a window that is fixed."""
    fuse = {
        "warp": {"rig": str(flight / "truth" / "rig.toml")},
        "thermal": {"window": (7000.0, 7700.0), "window_unit": "counts"},
    }
    config = PreprocessConfig.of(fuse=fuse)
    for source, root, name in (
        ("mine", flight, "set"),
        (str(write_recording(flight, tmp_path / "mine.mcap", "mcap-ros1").path), None, "recording"),
    ):
        run_preprocess(
            config,
            source,
            root,
            str(tmp_path / name),
            route=Route(2),
            overwrite=False,
            dry_run=False,
            quiet=True,
        )
    a, b = frames_of(tmp_path / "set"), frames_of(tmp_path / "recording")
    shared = [name for name in a if name in b and not name.endswith((".csv", ".toml"))]
    assert len([name for name in shared if name.startswith("fused/")]) > 15
    assert [name for name in shared if a[name] != b[name]] == []


def test_every_message_is_in_a_frame_or_counted(flight: Path, bag: Path, tmp_path: Path) -> None:
    command(bag, flight, tmp_path)
    rows = list(csv.DictReader(io.StringIO((tmp_path / "frames.csv").read_text())))
    lost = Counter[str]()
    for line in csv.DictReader(io.StringIO((tmp_path / "lost.csv").read_text())):
        lost[line["role"]] += int(line["count"])
    for role in ("rgb", "fir", "lidar"):
        used = len({row[f"{role}_stamp_ns"] for row in rows} - {""})
        assert used + lost[role] == len(list((flight / role).iterdir())), role
    assert "frozen" in (tmp_path / "lost.csv").read_text()


@pytest.mark.parametrize("chunk_s", [0.13, 0.7, 10.0])
def test_moments_do_not_depend_on_chunks(bag: Path, chunk_s: float) -> None:
    footage = footage_of(bag)
    told = [each for chunk in footage.chunks(chunk_s) for each in footage.moments(chunk)]
    whole = list(footage.moments(Chunk(0, footage.begin_ns, footage.end_ns, 0)))
    assert [m.stem for m in told if isinstance(m, Moment)] == [m.stem for m in whole if isinstance(m, Moment)]
    assert Counter(m for m in told if isinstance(m, Dropped)) == Counter(
        m for m in whole if isinstance(m, Dropped)
    )


def test_a_time_range_is_half_open_and_named_by_seconds(bag: Path) -> None:
    footage = footage_of(bag)
    some = footage_of(bag, begin_s=1.0, end_s=2.0)
    assert (some.begin_ns, some.end_ns) == (footage.begin_ns + 10**9, footage.begin_ns + 2 * 10**9)
    inside = [m for m in some.moments(Chunk(0, some.begin_ns, some.end_ns, 0)) if isinstance(m, Moment)]
    assert 5 < len(inside) <= 10
    with pytest.raises(InputError, match="no messages in that time range"):
        footage_of(bag, begin_s=100.0)


def test_a_lidar_can_lead(bag: Path) -> None:
    footage = footage_of(bag, lead="lidar")
    moments = [
        m for m in footage.moments(Chunk(0, footage.begin_ns, footage.end_ns, 0)) if isinstance(m, Moment)
    ]
    assert moments
    assert all(m.cloud is not None for m in moments)
    first = moments[0].cloud
    assert first is not None
    assert first().stamp_ns == int(moments[0].stem)


def test_an_offset_moves_thermal_to_the_clock_of_rgb(flight: Path, bag: Path) -> None:
    plain, moved = footage_of(bag), footage_of(bag, fir_offset_ms=-37.0)
    own = {int(path.stem) for path in (flight / "fir").iterdir()}

    def stamps(footage: RecordedFootage) -> list[tuple[int, int]]:
        found = [
            m for m in footage.moments(Chunk(0, plain.begin_ns, plain.end_ns, 0)) if isinstance(m, Moment)
        ]
        return [(int(m.stem), m.images().fir.stamp_ns or 0) for m in found]

    assert {fir for _, fir in stamps(plain)} <= own
    assert {fir + 37_000_000 for _, fir in stamps(moved)} <= own
    # 20 thermal frames a second on the clock of RGB: none is farther than half their interval.
    assert max(abs(fir - rgb) for rgb, fir in stamps(moved)) <= 25_000_000


def test_log_times_can_be_the_clock(bag: Path) -> None:
    footage = footage_of(bag, stamp="log")
    first = next(
        m for m in footage.moments(Chunk(0, footage.begin_ns, footage.end_ns, 0)) if isinstance(m, Moment)
    )
    header = footage_of(bag)
    theirs = next(
        m for m in header.moments(Chunk(0, header.begin_ns, header.end_ns, 0)) if isinstance(m, Moment)
    )
    assert abs(int(first.stem) - int(theirs.stem)) < 10**8
    assert int(first.stem) != int(theirs.stem)


def test_frozen_frames_can_be_kept(bag: Path) -> None:
    chunk_of = lambda f: Chunk(0, f.begin_ns, f.end_ns, 0)  # noqa: E731
    kept, left = footage_of(bag, keep_frozen=True), footage_of(bag)
    counts = [sum(isinstance(m, Moment) for m in f.moments(chunk_of(f))) for f in (kept, left)]
    assert counts[0] > counts[1]


def test_a_topic_that_is_not_there_lists_what_is(bag: Path) -> None:
    with pytest.raises(UsageError, match=r"no topic /nope .*/thermal/image \(sensor_msgs/msg/Image\)"):
        footage_of(bag, fir="/nope")
    with pytest.raises(UsageError, match="holds no images"):
        footage_of(bag, fir="/lidar/points")
    with pytest.raises(UsageError, match="holds no points"):
        footage_of(bag, lidar="/thermal/image")


def test_lidar_can_be_left_out(bag: Path) -> None:
    footage = footage_of(bag, lidar="")
    assert not footage.has_lidar
    with pytest.raises(UsageError, match="lidar cannot lead"):
        footage_of(bag, lidar="", lead="lidar")


def test_clocks_that_are_apart_are_told(bag: Path) -> None:
    with closing(open_recording(bag)) as recording:
        streams, _ = resolve_streams(recording, StreamsConfig())
    with pytest.raises(InputError, match=r"stamps lie 100\.\d s apart"):
        RecordedFootage(str(bag), replace(streams, offset_ns={"fir": 100 * 10**9}))


def test_damage_that_is_met_on_the_way_is_in_the_chunk_that_met_it(
    flight: Path, bag: Path, tmp_path: Path
) -> None:
    """Planning looks here and there: of a long recording it does not see every chunk."""
    config = PreprocessConfig.of(fuse={"warp": {"rig": str(flight / "truth" / "rig.toml")}})
    footage = footage_of(bag)
    work = PreprocessWork(
        footage, config, make_plan(footage, config), load_rig(flight / "truth" / "rig.toml")
    )
    told = iter([[], ["chunk at byte 7 is damaged"]])
    footage.notes = lambda: next(told)  # type: ignore[method-assign]  # before, and after
    done = work.do(work.chunks[0], open_storage(tmp_path), lambda: None)
    assert done.lost["recording: chunk at byte 7 is damaged"] == 1
    assert done.rows


def test_a_damaged_first_message_does_not_end_the_run(bag: Path) -> None:
    """Which topic is what is told from first messages; the other two lanes do not depend on this one."""
    with closing(open_recording(bag)) as recording:
        whole = recording.packets

        def cut(topics: Any = None, start_ns: Any = None, end_ns: Any = None) -> Iterator[Packet]:
            for k, packet in enumerate(whole(topics, start_ns, end_ns)):
                hurt = k == 0 and packet.topic.name == "/lidar/points"
                yield packet._replace(data=bytes(packet.data[:40])) if hurt else packet

        recording.packets = cut  # type: ignore[method-assign]
        streams, _ = resolve_streams(recording, StreamsConfig())
    assert {role: topic.name for role, topic in streams.topics.items()} == {
        "rgb": "/camera/image/compressed",
        "fir": "/thermal/image",
        "lidar": "/lidar/points",
    }
