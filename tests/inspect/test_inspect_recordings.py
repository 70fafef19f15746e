"""Recordings whose truth is known: written here with faults, and the real ones against others' readers."""

from __future__ import annotations

import json
import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin

from fusion.errors import InputError
from fusion.inspect import inspect
from fusion.inspect import recording as module
from fusion.inspect.record import record_of
from tests.inspect.recorded import (
    DELAY_NS,
    FIR,
    LIDAR,
    ODOM,
    RGB,
    START_NS,
    Robot,
    chosen,
    streams,
    write_bag,
    write_rosbag2,
)


@pytest.fixture(scope="module")
def robot():
    return Robot()


@pytest.fixture(scope="module")
def bags(robot, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bags")
    return {
        "rosbag1": write_bag(folder / "a.bag", robot),
        "sqlite3": write_rosbag2(folder / "b", robot, StoragePlugin.SQLITE3),
        "mcap": write_rosbag2(folder / "c", robot, StoragePlugin.MCAP),
    }


@pytest.mark.parametrize("form", ["rosbag1", "sqlite3", "mcap"])
@pytest.mark.parametrize("full", [False, True])
def test_what_is_said_is_true(bags, robot, form, full):
    found = inspect(bags[form], full=full, pictures=True)
    topics = streams(found)
    assert found.facts["messages"] == 56
    assert {name: s.count for name, s in topics.items()} == {RGB: 20, FIR: 25, LIDAR: 10, ODOM: 1}
    fir = topics[FIR]
    assert fir.facts["size_wh"] == [48, 40]
    assert fir.facts["encoding"] == "mono16"
    assert fir.facts["frame_id"] == "fir"
    seen = robot.fir if full else [robot.fir[round(k * 24 / 19)] for k in range(20)]
    assert fir.facts["values"]["least"] == min(a.min() for a in seen)
    assert fir.facts["values"]["most"] == max(a.max() for a in seen)
    assert fir.looked.seen == (25 if full else 20)
    assert topics[RGB].facts["values"]["most"] <= 255
    assert topics[LIDAR].facts["points"] == [60, 60]
    r = np.linalg.norm(robot.xyz[0].astype(float), axis=1)
    assert topics[LIDAR].facts["first_cloud_range_m"]["most"] == pytest.approx(r.max(), abs=5e-4)
    assert (topics[ODOM].used, topics[ODOM].type) == ("", "std_msgs/msg/String")
    assert not found.faults


@pytest.mark.parametrize("form", ["rosbag1", "sqlite3", "mcap"])
def test_clocks_and_gaps(bags, robot, form):
    fir = streams(inspect(bags[form]))[FIR].times
    assert (fir.clock, fir.looked.seen, fir.looked.of) == ("header", 25, 25)
    assert fir.rate_hz == pytest.approx(25.0)
    assert fir.gap_count == 1  # 240 ms after the tenth; what follows the jump back is 100 ms, 2.5 steps
    assert fir.gaps_ns[0] == (robot.fir_ns[9], robot.fir_ns[10])
    assert (fir.backwards, fir.duplicates) == (1, 0)
    rgb = streams(inspect(bags[form]))[RGB].times
    assert (rgb.gap_count, rgb.backwards) == (0, 0)
    assert rgb.delay_ms == (pytest.approx(DELAY_NS / 1e6), pytest.approx(0))
    odometry = streams(inspect(bags[form]))[ODOM].times
    assert (odometry.clock, odometry.first_ns) == ("log", START_NS + 2 * 10**9)


def test_freezes_are_found_by_full_and_not_spoken_of_without(bags):
    assert "frozen_frames" not in streams(inspect(bags["mcap"]))[FIR].facts
    facts = streams(inspect(bags["mcap"], full=True))[FIR].facts
    assert (facts["frozen_frames"], facts["frozen_from_to"]) == (3, [[19, 22]])


class Broken(Robot):
    """The fifth thermal message has only half of its pixels."""

    def messages(self, types):
        found = super().messages(types)
        fifth = [message for _, topic, message in found if topic == FIR][4]
        fifth.data = fifth.data[: len(fifth.data) // 2]
        return found


def test_with_a_broken_picture_freezes_are_not_spoken_of_and_it_is_named(tmp_path):
    found = inspect(write_bag(tmp_path / "a.bag", Broken()), full=True)
    fir = streams(found)[FIR]
    assert "frozen_frames" not in fir.facts
    assert any("frozen frames were not looked for" in note for note in fir.notes)
    assert [FIR in fault and "message 4" in fault for fault in found.faults] == [True]
    assert fir.count == 25
    assert chosen(found)["fir"] == FIR


def test_roles_and_the_next_command(bags):
    found = inspect(bags["rosbag1"], full=True)
    assert chosen(found) == {
        "rgb": RGB,
        "fir": FIR,
        "lidar": LIDAR,
    }
    words = ("--rgb", RGB, "--fir", FIR, "--lidar", LIDAR, "-o", "OUT")
    assert found.steps[0].words == ("fusion", "preprocess", str(bags["rosbag1"]), *words)
    assert inspect(bags["rosbag1"]).steps[-1].words[-1] == "--full"


@pytest.mark.parametrize("form", ["rosbag1", "sqlite3", "mcap"])
def test_a_large_one_is_sampled_and_says_so(bags, form, monkeypatch):
    monkeypatch.setattr(module, "QUICK_BYTES", 1)
    found = inspect(bags[form])
    fir = streams(found)[FIR]
    # its 1.2 s are the first 3 of 5 places: only odometry goes on to 2 s
    assert (fir.looked.seen, fir.looked.of, fir.count) == (3, 25, 25)
    assert fir.times.looked.seen == 3
    assert streams(found)[ODOM].times.looked.seen == 1  # and not once for each place before it
    assert fir.times.rate_hz is fir.times.gap_count is fir.times.backwards is None
    assert fir.times.first_ns == START_NS
    assert found.steps[-1].words[-1] == "--full"


def test_a_cut_off_bag_says_where_and_how_much(bags, tmp_path):
    data = bags["rosbag1"].read_bytes()
    path = tmp_path / "cut.bag"
    path.write_bytes(data[: len(data) * 6 // 10])
    found = inspect(path)
    read = sum(stream.count for stream in streams(found).values())
    assert 0 < read < 56
    assert found.facts["messages"] == read
    assert found.faults


def test_no_recording_at_all(tmp_path):
    path = tmp_path / "a.bag"
    path.write_bytes(b"not a bag, but long enough to be one" * 4)
    with pytest.raises(InputError):
        inspect(path)


def test_it_is_json(bags):
    record = json.loads(json.dumps(record_of(inspect(bags["mcap"], full=True)), allow_nan=False))
    assert record["format"] == "fusion-inspect/1"
    assert list(record) == [
        "format",
        "path",
        "kind",
        "title",
        "facts",
        "streams",
        "roles",
        "notes",
        "faults",
        "next",
    ]
    fir = next(stream for stream in record["streams"] if stream["name"] == FIR)
    assert fir["times"]["gap_count"] == 1
    assert record["roles"]["chosen"]["fir"]["topic"] == FIR


# --- the real ones


def real(shared: Path) -> list[Path]:
    folder = shared / "recordings"
    bags = sorted(folder.glob("*.bag"))
    return [*bags, *sorted(path.parent for path in folder.rglob("metadata.yaml"))]


def oracle(path: Path) -> Iterator[tuple[str, str, int]]:
    """(topic, type, log time) by the containers' own libraries; rosbags finds nothing in the talkers."""
    for file in sorted(path.glob("*.mcap")):
        with file.open("rb") as stream:
            read: Any = make_reader(stream).iter_messages()
            for schema, channel, message in read:
                yield channel.topic, schema.name, message.log_time
    for file in sorted(path.glob("*.db3")):
        with closing(sqlite3.connect(f"file:{file}?mode=ro&immutable=1", uri=True)) as database:
            query = "SELECT name, type, timestamp FROM messages JOIN topics ON topics.id = topic_id"
            yield from database.execute(query)
    if path.is_file():
        with AnyReader([path]) as reader:
            for connection, ns, _ in reader.messages():
                yield connection.topic, connection.msgtype, ns


def test_every_real_recording_against_rosbags(shared_data):
    checked = 0
    for path in real(shared_data):
        found = inspect(path, full=path.stat().st_size < 10**4)
        messages = list(oracle(path))
        counts = Counter((topic, kind) for topic, kind, _ in messages)
        first = min((ns for _, _, ns in messages), default=None)
        last = max((ns for _, _, ns in messages), default=None)
        said = {(s.name, s.type): s.count for s in found.streams if s.count}
        assert said == counts, path
        assert found.facts["messages"] == sum(counts.values())
        assert (found.facts.get("first_ns"), found.facts.get("last_ns")) == (first, last)
        checked += 1
    assert checked >= 9


def test_the_real_cloud(shared_data):
    found = inspect(shared_data / "recordings/PointCloud2.bag", pictures=True)
    (stream,) = found.streams
    assert stream.type == "sensor_msgs/msg/PointCloud2"
    assert stream.facts["points"] == [124_914, 124_914]
    assert stream.facts["point_bytes"] == 32
    assert "ring uint16" in stream.facts["fields"]
    assert found.roles is not None
    assert "with ring" in found.roles.chosen["lidar"][1]
    assert found.facts["compression"] == "lz4 (first chunk)"
    assert found.pictures


def test_real_words(shared_data):
    folder = shared_data / "recordings"
    empty = inspect(folder / "no-messages.bag")
    assert empty.notes == ("no messages",)
    assert empty.facts["messages"] == 0
    assert empty.roles is None
    assert not empty.steps
    turtle = inspect(folder / "example-bz2.bag")
    assert turtle.facts["messages"] == 8_647
    assert turtle.facts["compression"] == "bz2 (first chunk)"
    assert "no topic can be RGB and none thermal" in turtle.notes[-1]
    assert not any("preprocess" in step.words for step in turtle.steps)
    split = inspect(folder / "rosbag2_official/mcap/wbag")
    assert (split.facts["messages"], split.facts["files"]) == (6_074, 5)
    assert split.facts["compression"] == "zstd (first chunk)"


def test_pictures_that_are_none_are_faults_and_play_no_role(shared_data):
    found = inspect(shared_data / "recordings/rosbag2_geocam/test_bag_mcap")
    assert sum("/test/sensor_msgs/image" in fault for fault in found.faults) == 2
    assert chosen(found) == {}  # of the cloud, its three points all are (0, 0, 0)
    info = streams(found)["/test/sensor_msgs/camera_info"]
    assert (info.facts["size_wh"], info.facts["fx"]) == ([640, 480], 525.0)
