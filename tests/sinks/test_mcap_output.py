"""What opens in Foxglove: read back by MCAP's own reader and protobuf's decoder, killed at every step."""

from __future__ import annotations

import io
import pickle
import subprocess
import sys
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_frames import (
    CAMERA,
    CHUNKS,
    FIRST_NS,
    RATE_HZ,
    RIG,
    SETUP,
    SIZE_WH,
    T_RGB_FIR,
    T_RGB_LIDAR,
    cloud,
    depth,
    do,
    file_bytes,
    frames_of,
    made,
    picture,
    stamp,
)
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from fusion.chunks import Chunk
from fusion.codecs import decode_image, encode_png
from fusion.errors import FrameError, OutputError
from fusion.frames import FrameSet, Image
from fusion.geometry import FisheyeCamera, PinholeCamera
from fusion.preprocess.records import record_name
from fusion.sinks import mcap_file
from fusion.sinks.base import Made, Setup
from fusion.sinks.mcap import PARTS, McapOutput, depth_mm
from fusion.storage import LocalFolder, Storage, open_storage

OUTPUT = McapOutput(SETUP)
ALL = [k for chunk in CHUNKS for k in frames_of(chunk)]


def run(folder: Path, chunks: Sequence[Chunk] = CHUNKS, output: McapOutput = OUTPUT) -> bytes:
    out = open_storage(folder)
    for chunk in chunks:
        do(output, chunk, out)
    assert output.finish(chunks, out) == ("fused.mcap",)
    return (folder / "fused.mcap").read_bytes()


def read(data: bytes, **selection: Any) -> dict[str, list[Any]]:
    """Topic -> (log time, message), in the order of log times; checksums are looked at."""
    reader = make_reader(io.BytesIO(data), decoder_factories=[DecoderFactory()], validate_crcs=True)
    found: dict[str, list[Any]] = {}
    for _, channel, message, content in reader.iter_decoded_messages(**selection):
        assert message.publish_time == message.log_time
        found.setdefault(channel.topic, []).append((message.log_time, content))
    return found


def nanoseconds(time: Any) -> int:
    return time.seconds * 10**9 + time.nanos


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return run(tmp_path_factory.mktemp("mcap"))


def test_every_frame_is_there_with_all_that_was_made_of_it(whole: bytes) -> None:
    topics = read(whole)
    with_cloud = [k for k in ALL if k % 2 == 0]
    counts = dict.fromkeys(
        ["/fused", "/fused/mask", "/depth/support", "/thermal", "/calibration/rgb", "/tf"], 9
    )
    assert {t: len(m) for t, m in topics.items()} == {
        **counts,
        "/depth": len(with_cloud),
        "/points": len(with_cloud),
    }
    for k, (at, image) in zip(ALL, topics["/fused"], strict=True):
        assert at == nanoseconds(image.timestamp) == stamp(k)
        assert (image.format, image.frame_id, image.data) == ("png", "rgb", made(k).encoded["fused"])
        np.testing.assert_array_equal(decode_image(image.data, ""), picture(k))
    for k, (at, image) in zip(ALL, topics["/thermal"], strict=True):
        assert (at, image.encoding, image.frame_id, image.step) == (stamp(k), "mono16", "rgb", 2 * SIZE_WH[0])
        counts = np.frombuffer(image.data, "<u2").reshape(image.height, image.width)
        np.testing.assert_array_equal(counts, made(k).fir_counts)
    masks = [message.data for _, message in topics["/fused/mask"]]
    assert masks == [made(k).encoded["mask"] for k in ALL]


def test_depth_is_millimetres_along_the_axis(whole: bytes) -> None:
    for k, (at, image) in zip([k for k in ALL if k % 2 == 0], read(whole)["/depth"], strict=True):
        assert (at, image.encoding, image.frame_id) == (stamp(k), "16UC1", "rgb")
        mm = np.frombuffer(image.data, "<u2").reshape(image.height, image.width)
        z = depth(k).dense.value_m.astype(np.float64)
        near = (z > 0) & (z < 65.535)
        assert (z > 65.6).any()
        np.testing.assert_allclose(mm[near], 1000 * z[near], atol=0.51)
        assert (mm[z == 0] == 0).all()
        assert (mm[z > 65.536] == 0).all()


@pytest.mark.parametrize("camera", [CAMERA, FisheyeCamera(SIZE_WH, 20.0, 20.0, 23.0, 15.5, (0.01, 0, 0, 0))])
def test_ranges_become_depth(camera: PinholeCamera | FisheyeCamera) -> None:
    mm = depth_mm(depth(0, "range"), camera).astype(np.float64)
    u, v = 40, 3
    ray = camera.unproject(np.array([[u, v]], np.float64))[0]
    range_m = depth(0, "range").dense.value_m[v, u]
    assert ray[2] < 0.95
    assert mm[v, u] == pytest.approx(1000 * range_m * ray[2], abs=1)
    assert (depth_mm(depth(0, "range"), None) == depth_mm(depth(0), None)).all()


def test_points_come_back_exactly_at_the_clouds_own_stamp(whole: bytes) -> None:
    types = {7: "<f4", 6: "<i4"}  # foxglove.PackedElementField.NumericType
    for k, (at, message) in zip([k for k in ALL if k % 2 == 0], read(whole)["/points"], strict=True):
        assert at == nanoseconds(message.timestamp) == stamp(k) - 30_000_000
        assert message.frame_id == "lidar"
        assert (message.pose.orientation.w, message.pose.position.x) == (1, 0)
        names, offsets = [f.name for f in message.fields], [f.offset for f in message.fields]
        formats = [types[f.type] for f in message.fields]
        record = np.dtype(
            {"names": names, "formats": formats, "offsets": offsets, "itemsize": message.point_stride}
        )
        rows, truth = np.frombuffer(message.data, record), cloud(k)
        np.testing.assert_array_equal(np.stack([rows[a] for a in "xyz"], -1), truth.xyz_m)
        for name in ("intensity", "ring"):
            np.testing.assert_array_equal(rows[name], truth.fields[name])


def test_the_calibration_is_the_rigs(whole: bytes) -> None:
    for k, (at, info) in zip(ALL, read(whole)["/calibration/rgb"], strict=True):
        assert (at, info.frame_id, info.width, info.height) == (stamp(k), "rgb", *SIZE_WH)
        assert (info.distortion_model, list(info.D)) == ("plumb_bob", list(CAMERA.distortion))
        np.testing.assert_array_equal(np.reshape(info.K, (3, 3)), CAMERA.matrix())
        np.testing.assert_array_equal(np.reshape(info.P, (3, 4)), np.c_[CAMERA.matrix(), np.zeros(3)])
        np.testing.assert_array_equal(np.reshape(info.R, (3, 3)), np.eye(3))


def test_transformations_take_the_child_to_the_parent_and_precede_every_cloud(whole: bytes) -> None:
    topics = read(whole)
    truth = {"lidar": T_RGB_LIDAR, "fir": T_RGB_FIR}
    for k, (at, message) in zip(ALL, topics["/tf"], strict=True):
        assert at == stamp(k) - (30_000_000 if k % 2 == 0 else 0)
        assert {t.child_frame_id for t in message.transforms} == set(truth)
        for one in message.transforms:
            q, t = one.rotation, one.translation
            R = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()  # SciPy's order: w last
            assert one.parent_frame_id == "rgb"
            assert nanoseconds(one.timestamp) == at
            np.testing.assert_allclose(R, truth[one.child_frame_id][:3, :3], atol=1e-12)
            np.testing.assert_allclose([t.x, t.y, t.z], truth[one.child_frame_id][:3, 3], atol=1e-12)
    assert topics["/tf"][0][0] <= min(messages[0][0] for messages in topics.values())


def test_the_index_finds_any_moment(whole: bytes, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(mcap_file, "CHUNK_BYTES", 9000)  # several chunks a part
    data = run(tmp_path)
    summary = make_reader(io.BytesIO(data)).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    every = [(topic, at) for topic, messages in read(whole).items() for at, _ in messages]
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count > len(CHUNKS)
    topic_of = {number: channel.topic for number, channel in summary.channels.items()}
    counts = {topic_of[n]: count for n, count in summary.statistics.channel_message_counts.items()}
    assert counts == Counter(topic for topic, _ in every)
    assert summary.statistics.message_start_time == min(at for _, at in every)
    assert summary.statistics.message_end_time == max(at for _, at in every)
    for start, end in ((stamp(2), stamp(5)), (stamp(4) + 1, stamp(4) + 2), (0, stamp(0)), (stamp(9), 2**63)):
        found = [(t, at) for t, m in read(data, starting_at=start, ending_before=end).items() for at, _ in m]
        assert sorted(found) == sorted((t, at) for t, at in every if start <= at < end)


def test_offsets_lead_to_their_records_and_the_summary_has_its_checksum(whole: bytes) -> None:
    summary = make_reader(io.BytesIO(whole)).get_summary()
    assert summary is not None
    for index in summary.chunk_indexes:
        assert whole[index.chunk_start_offset] == 0x06
        for channel, at in index.message_index_offsets.items():
            assert (whole[at], int.from_bytes(whole[at + 9 : at + 11], "little")) == (0x07, channel)
    footer = len(whole) - 8 - 29  # opcode, length, two offsets, checksum; the magic
    assert whole[footer] == 0x02
    start = int.from_bytes(whole[footer + 9 : footer + 17], "little")
    checksum = int.from_bytes(whole[footer + 25 : footer + 29], "little")
    assert checksum == zlib.crc32(whole[start : footer + 25])


def test_a_reader_that_knows_no_index_reads_the_same(whole: bytes) -> None:
    records = [*StreamReader(io.BytesIO(whole), validate_crcs=True).records]
    messages = [record for record in records if isinstance(record, Message)]
    assert len(messages) == sum(map(len, read(whole).values()))


def test_the_same_bytes_whatever_the_order(whole: bytes, tmp_path: Path) -> None:
    out = open_storage(tmp_path)
    for chunk in reversed(CHUNKS):
        assert do(pickle.loads(pickle.dumps(OUTPUT)), chunk, out) == {}  # no record names what goes
    assert {*out.names("")} == {PARTS.name(chunk) for chunk in CHUNKS}
    OUTPUT.finish(CHUNKS[::-1], out)
    assert file_bytes(tmp_path) == {"fused.mcap": whole}


def test_finishing_again_needs_no_part_and_writes_nothing(tmp_path: Path) -> None:
    run(tmp_path)
    before = (tmp_path / "fused.mcap").stat()
    assert OUTPUT.finish(CHUNKS, open_storage(tmp_path)) == ("fused.mcap",)
    assert (tmp_path / "fused.mcap").stat().st_mtime_ns == before.st_mtime_ns
    assert (tmp_path / "fused.mcap").stat().st_ino == before.st_ino


class Stopping(LocalFolder):
    """A folder in which the process dies when the storage is asked for the n-th time."""

    left = 0

    def _path(self, name: str) -> Path:
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt
        return super()._path(name)


def test_killed_at_any_step_and_started_again(whole: bytes, tmp_path: Path) -> None:
    out, finished, steps = Stopping(str(tmp_path)), False, 0
    for steps in range(60):
        out.left = 1 << 30
        for chunk in CHUNKS:
            do(OUTPUT, chunk, out)
        (tmp_path / "fused.mcap").unlink(missing_ok=True)
        out.left = steps
        try:
            OUTPUT.finish(CHUNKS, out)
            finished = True
        except KeyboardInterrupt:
            out.left = 1 << 30
            OUTPUT.finish(CHUNKS, out)
        assert file_bytes(tmp_path) == {"fused.mcap": whole}
        if finished:
            break
    assert finished
    assert steps > len(CHUNKS)


def test_what_a_killed_join_left_is_written_over(whole: bytes, tmp_path: Path) -> None:
    out = open_storage(tmp_path)
    for chunk in CHUNKS:
        do(OUTPUT, chunk, out)
    code = (
        "import os, sys; from pathlib import Path; from fusion.sinks.parts import replace_by\n"
        "replace_by(Path(sys.argv[1]), lambda at: (at.write_bytes(b'x' * 10**6), os.kill(os.getpid(), 9)))"
    )
    killed = subprocess.run([sys.executable, "-c", code, tmp_path / "fused.mcap"], check=False)
    assert killed.returncode == -9
    left = set(file_bytes(tmp_path)) - {PARTS.name(chunk) for chunk in CHUNKS}
    assert len(left) == 1
    assert left.isdisjoint(out.names(""))  # no file of the output, and cleared by the next run
    OUTPUT.finish(CHUNKS, out)
    assert file_bytes(tmp_path) == {"fused.mcap": whole}


def test_a_file_of_another_program_is_replaced(whole: bytes, tmp_path: Path) -> None:
    (tmp_path / "fused.mcap").write_bytes(b"half of another file")
    assert run(tmp_path) == whole


def test_chunks_done_later_or_again_take_their_place(whole: bytes, tmp_path: Path) -> None:
    out = open_storage(tmp_path)
    some = [CHUNKS[0], CHUNKS[3]]
    assert len(read(run(tmp_path, some))["/fused"]) == 6
    do(OUTPUT, CHUNKS[1], out)
    do(OUTPUT, CHUNKS[2], out)
    do(McapOutput(replace(SETUP, rig=None)), CHUNKS[3], out)  # what is newer wins
    OUTPUT.finish(CHUNKS, out)
    assert len(read((tmp_path / "fused.mcap").read_bytes())["/tf"]) == 6
    do(OUTPUT, CHUNKS[3], out)
    OUTPUT.finish(CHUNKS, out)
    assert file_bytes(tmp_path) == {"fused.mcap": whole}


def test_chunks_of_another_plan_are_not_taken(tmp_path: Path) -> None:
    run(tmp_path)
    other = [replace(chunk, end=chunk.end + 1) for chunk in CHUNKS]
    with pytest.raises(OutputError, match=r"000000\.mcap and 3 more is gone.*same command again"):
        OUTPUT.finish(other, open_storage(tmp_path))


def test_a_part_that_is_gone_takes_its_record_along(tmp_path: Path) -> None:
    out = open_storage(tmp_path)
    for chunk in CHUNKS:
        do(OUTPUT, chunk, out)
        out.write(record_name(chunk), b"done")
    out.remove(PARTS.name(CHUNKS[1]))
    with pytest.raises(OutputError, match=r"parts/mcap/000001\.mcap is gone"):
        OUTPUT.finish(CHUNKS, out)
    assert [out.size(record_name(chunk)) for chunk in CHUNKS] == [4, None, 4, 4]
    assert out.size(PARTS.name(CHUNKS[0]))


@pytest.mark.parametrize("keep", [0, 7, 200, -1, -40])
def test_a_damaged_part_is_named_and_nothing_is_lost(keep: int, tmp_path: Path) -> None:
    out = open_storage(tmp_path)
    for chunk in CHUNKS:
        do(OUTPUT, chunk, out)
    part = tmp_path / PARTS.name(CHUNKS[1])
    part.write_bytes(part.read_bytes()[:keep])
    before = file_bytes(tmp_path)
    with pytest.raises(OutputError, match=r"000001\.mcap.*damaged"):
        OUTPUT.finish(CHUNKS, out)
    assert file_bytes(tmp_path) == before


def test_elsewhere_the_parts_stay_and_are_named() -> None:
    out: Storage = open_storage("memory://mcap-output")
    sizes = [do(OUTPUT, chunk, out) for chunk in CHUNKS]
    assert OUTPUT.finish(CHUNKS, out) == ("parts/mcap/",)
    assert [*out.names("")] == [PARTS.name(chunk) for chunk in CHUNKS]
    assert sizes == [{PARTS.name(chunk): out.size(PARTS.name(chunk))} for chunk in CHUNKS]
    assert len(read(out.read(PARTS.name(CHUNKS[1])))["/fused"]) == 3  # each opens on its own


def messages_of_one(frame: Made, setup: Setup, chunk: Chunk = CHUNKS[0]) -> dict[str, list[Any]]:
    out = open_storage("memory://mcap-one")
    part = McapOutput(setup).open(chunk, out)
    part.add(frame)
    part.close()
    return read(out.read(PARTS.name(chunk)))


def test_frames_without_a_clock_play_in_order() -> None:
    out = open_storage("memory://mcap-clockless")
    part = OUTPUT.open(Chunk(1, 100, 200, 100), out)
    for k in range(3):
        part.add(made(k, stamp_ns=None))
    part.close()
    times = [at for at, _ in read(out.read("parts/mcap/000001.mcap"))["/fused"]]
    assert times == [round((100 + k) / RATE_HZ * 1e9) for k in range(3)]


def test_a_stamp_before_1970_is_refused_and_leaves_nothing_of_its_frame() -> None:
    out = open_storage("memory://mcap-1969")
    part = OUTPUT.open(CHUNKS[0], out)
    with pytest.raises(FrameError, match=r"f1: its stamp lies before 1970"):
        part.add(made(1, stamp_ns=-5))
    with pytest.raises(FrameError, match="1970"):
        part.add(made(2, stamp_ns=5))  # its cloud was measured before
    part.add(made(1))
    part.close()
    found = read(out.read(PARTS.name(CHUNKS[0])))
    assert {topic: len(messages) for topic, messages in found.items()}["/tf"] == 1
    assert {len(messages) for messages in found.values()} == {1}


def test_without_a_rig_there_is_neither_calibration_nor_transformation() -> None:
    found = messages_of_one(made(0), Setup(None, None, 0.0))
    assert set(found) == {"/fused", "/fused/mask", "/depth/support", "/depth", "/thermal", "/points"}


def test_a_cropped_frame_gets_no_calibration_that_does_not_fit() -> None:
    found = messages_of_one(made(1, (40, 30)), SETUP)
    assert "/calibration/rgb" not in found
    assert found["/fused"]


def test_depth_of_a_camera_of_its_own_is_in_a_frame_of_its_own() -> None:
    virtual = PinholeCamera.of_fov(SIZE_WH, 120)
    found = messages_of_one(made(0), Setup(RIG, virtual, RATE_HZ))
    assert found["/depth"][0][1].frame_id == found["/calibration/depth"][0][1].frame_id == "depth"
    assert found["/calibration/depth"][0][1].K[0] == virtual.fx
    assert found["/calibration/rgb"][0][1].frame_id == "rgb"


def test_pictures_that_nobody_stored_are_made_here() -> None:
    frame = replace(made(1, whole=False), encoded={})
    image = messages_of_one(frame, SETUP)["/fused"][0][1]
    assert (image.format, image.data) == ("png", encode_png(picture(1)))
    image = messages_of_one(frame, replace(SETUP, image_format="jpg"))["/fused"][0][1]
    assert (image.format, image.data[:2]) == ("jpeg", b"\xff\xd8")
    assert messages_of_one(made(1, jpeg=True), SETUP)["/fused"][0][1].format == "jpeg"


def test_large_coordinates_and_odd_types_are_kept() -> None:
    from fusion.frames import PointCloud

    xyz = np.array([[4e6 + 1 / 3, 5e5, 100.25]])
    scan = PointCloud(xyz, {"intensity": np.array([1 << 40], np.int64)}, stamp_ns=FIRST_NS)
    frame = made(1)
    frames = FrameSet(frame.frames.rgb, Image(frame.frames.fir.pixels, "t", FIRST_NS), scan)
    message = messages_of_one(replace(frame, frames=frames), SETUP)["/points"][0][1]
    assert [(f.name, f.type) for f in message.fields] == [(n, 8) for n in ("x", "y", "z", "intensity")]
    np.testing.assert_array_equal(np.frombuffer(message.data, "<f8"), [*xyz[0], 1 << 40])


def test_a_discarded_part_leaves_nothing(tmp_path: Path) -> None:
    part = OUTPUT.open(CHUNKS[0], open_storage(tmp_path))
    part.add(made(0))
    part.discard()
    assert file_bytes(tmp_path) == {}
