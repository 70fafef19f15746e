"""A simulated mine in every container, read back by libraries that know nothing of us."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoder
from mcap_ros1.decoder import DecoderFactory as Ros1Decoder
from mcap_ros2.decoder import DecoderFactory as Ros2Decoder
from rosbags import rosbag1
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from fusion.cli.record import simulate_record
from fusion.clouds import write_pcd
from fusion.codecs import decode_image, encode_jpeg, encode_png
from fusion.errors import FrameError, FusionError, InputError, OutputError, UsageError
from fusion.frames import PointCloud
from fusion.geometry import FisheyeCamera, PinholeCamera, pose
from fusion.rig import Rig, save_rig
from fusion.simulate.container_writers import COMPRESSIONS
from fusion.simulate.containers import logged, write_recording
from fusion.simulate.mine.config import MineConfig

EVERY = [(form, compression) for form, known in COMPRESSIONS.items() for compression in known]
T0 = 1_700_000_000_000_000_000
STORE = get_typestore(Stores.ROS2_HUMBLE)
STAMPS = {
    "rgb": [T0 + 50_000_000 * k + 13 for k in range(4)],
    "fir": [T0 + 5_000_777 + 40_000_000 * k for k in range(5)],
    "lidar": [T0 - 3_000_000, T0 + 97_000_001],
}
DELAY_NS = {"rgb": 12_000_000, "fir": 25_000_000, "lidar": 105_000_000}  # 10 turns a second
CAMERAS = {
    "rgb": PinholeCamera((30, 20), 25.0, 26.0, 14.5, 9.25, (-0.1, 0.01, 0.001, 0.002, 0.003, 0.1, 0.2, 0.3)),
    "fir": FisheyeCamera((16, 12), 20.0, 21.0, 7.5, 5.5, (0.01, 0.02, 0.03, 0.04)),
}
T_RGB_FIR = pose(Rotation.from_euler("xyz", [0.1, -0.2, 0.3]).as_matrix(), [0.07, -0.02, 0.01])
T_RGB_LIDAR = pose([[0, -1, 0], [0, 0, -1], [1, 0, 0]], [0.05, 0.1, -0.2])


def rgb(k: int) -> np.ndarray:
    return np.random.default_rng(k).integers(0, 256, (20, 30, 3), np.uint8)


def fir(k: int) -> np.ndarray:
    return np.random.default_rng(k).integers(6000, 65536, (12, 16), np.uint16)


def scan(k: int) -> dict[str, np.ndarray]:
    """Floats of all sizes, so that one that lost a bit is seen."""
    rng = np.random.default_rng(k)
    n = 50 + k
    xyz = (rng.normal(0, 1, (n, 3)) * 10.0 ** rng.integers(-3, 3, (n, 3))).astype(np.float32)
    fields = {
        "intensity": rng.uniform(0, 255, n).astype(np.float32),
        "time": np.linspace(0, 0.1, n, dtype="f4"),
    }
    return {
        **dict(zip("xyz", xyz.T, strict=True)),
        **fields,
        "ring": rng.integers(0, 65535, n).astype(np.uint16),
    }


@pytest.fixture(scope="module")
def mine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mine(tmp_path_factory.mktemp("mines") / "mine")


def write_mine(folder: Path) -> Path:
    for sensor in ("rgb", "fir", "lidar", "truth"):
        (folder / sensor).mkdir(parents=True)
    for k, stamp in enumerate(STAMPS["rgb"]):
        name, data = (
            (f"{stamp}.jpg", encode_jpeg(rgb(k), 90)) if k % 2 else (f"{stamp}.png", encode_png(rgb(k)))
        )
        (folder / "rgb" / name).write_bytes(data)
    for k, stamp in enumerate(STAMPS["fir"]):
        (folder / "fir" / f"{stamp}.png").write_bytes(encode_png(fir(k)))
    for k, stamp in enumerate(STAMPS["lidar"]):
        c = scan(k)
        fields = {"intensity": c["intensity"], "ring": c["ring"], "time_s": c["time"]}
        write_pcd(
            folder / "lidar" / f"{stamp}.pcd", PointCloud(np.stack([c["x"], c["y"], c["z"]], -1), fields)
        )
    (folder / "truth" / "mine.toml").write_text(MineConfig.of(lidar={"rate_hz": 10}).toml())
    save_rig(
        folder / "truth" / "rig.toml", Rig(CAMERAS, {"T_rgb_fir": T_RGB_FIR, "T_rgb_lidar": T_RGB_LIDAR})
    )
    return folder


# --- reading back: (log time, topic, message), in the file's order


class Read(NamedTuple):
    log_ns: int
    topic: str
    message: Any


def read_ros(path: Path) -> Iterator[Read]:
    with AnyReader([path], default_typestore=STORE) as reader:
        for connection, log_ns, data in reader.messages():
            yield Read(log_ns, connection.topic, reader.deserialize(data, connection.msgtype))


def read_mcap(path: Path) -> Iterator[Read]:
    factories = [Ros1Decoder(), Ros2Decoder(), ProtobufDecoder()]
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=factories)
        for _, channel, message, content in reader.iter_decoded_messages():
            yield Read(message.log_time, channel.topic, content)


def read_json(path: Path) -> Iterator[Read]:
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None
            content = json.loads(message.data)
            assert set(content) == set(json.loads(schema.data)["properties"])
            yield Read(message.log_time, channel.topic, content)


def reader_of(form: str) -> Callable[[Path], Iterator[Read]]:
    if form.startswith("rosbag"):
        return read_ros
    return read_json if form == "mcap-json" else read_mcap


def get(message: Any, *names: str) -> Any:
    """The first of the fields that the message has: wires name and spell them otherwise."""
    for name in names:
        if isinstance(message, dict) and name in message:
            return message[name]
        if not isinstance(message, dict) and hasattr(message, name):
            return getattr(message, name)
    raise KeyError(names)


def header_of(message: Any) -> tuple[int, str]:
    try:
        header = get(message, "header")
        stamp, frame = header.stamp, header.frame_id
    except KeyError:
        stamp, frame = get(message, "timestamp"), get(message, "frame_id", "parent_frame_id")
    seconds, rest = get(stamp, "sec", "seconds", "secs"), get(stamp, "nanosec", "nanos", "nsec", "nsecs")
    return seconds * 10**9 + rest, frame


def data_of(message: Any) -> bytes:
    data = get(message, "data")
    return base64.b64decode(data) if isinstance(data, str) else bytes(data)


def columns_of(message: Any, foxglove: bool) -> dict[str, np.ndarray]:
    types = {7: "<f4", 3 if foxglove else 4: "<u2"}  # Foxglove's NumericType, ROS's PointField
    fields = get(message, "fields")
    layout: Any = {
        "names": [get(f, "name") for f in fields],
        "formats": [types[get(f, "type", "datatype")] for f in fields],
        "offsets": [get(f, "offset") for f in fields],
        "itemsize": get(message, "point_stride", "point_step"),
    }
    rows = np.frombuffer(data_of(message), np.dtype(layout))
    return {name: rows[name] for name in layout["names"]}


def transform_of(one: Any) -> tuple[str, str, np.ndarray]:
    """Parent, child, T_parent_child."""
    child = get(one, "child_frame_id")
    inner = one if not hasattr(one, "transform") else one.transform
    q, t = get(inner, "rotation"), get(inner, "translation")
    R = Rotation.from_quat([get(q, axis) for axis in "xyzw"]).as_matrix()
    return header_of(one)[1], child, pose(R, [get(t, axis) for axis in "xyz"])


@pytest.mark.parametrize(("form", "compression"), EVERY)
def test_all_comes_back_as_it_was(form: str, compression: str, mine: Path, tmp_path: Path) -> None:
    written = write_recording(mine, tmp_path / "flight", form, compression=compression)
    found: dict[str, list[Read]] = {}
    for read in reader_of(form)(written.path):
        found.setdefault(read.topic, []).append(read)
    assert sum(map(len, found.values())) == written.messages
    check_images(found["/camera/image/compressed"], found["/thermal/image"])
    check_scans(found["/lidar/points"], foxglove=form in ("mcap-protobuf", "mcap-json"))
    check_calibration(found, "equidistant" if "ros" in form else "kannala_brandt")
    check_static(found["/tf_static"])


def check_images(rgbs: list[Read], firs: list[Read]) -> None:
    for k, read in enumerate(rgbs):
        assert header_of(read.message) == (STAMPS["rgb"][k], "rgb")
        assert read.log_ns == STAMPS["rgb"][k] + DELAY_NS["rgb"]
        assert get(read.message, "format") == ("jpeg" if k % 2 else "png")
        file = encode_jpeg(rgb(k), 90) if k % 2 else encode_png(rgb(k))
        assert data_of(read.message) == file
    for k, read in enumerate(firs):
        assert header_of(read.message) == (STAMPS["fir"][k], "fir")
        assert read.log_ns == STAMPS["fir"][k] + DELAY_NS["fir"]
        assert (get(read.message, "encoding"), get(read.message, "step")) == ("mono16", 32)
        assert (get(read.message, "width"), get(read.message, "height")) == (16, 12)
        np.testing.assert_array_equal(np.frombuffer(data_of(read.message), "<u2").reshape(12, 16), fir(k))
    assert (len(rgbs), len(firs)) == (4, 5)


def check_scans(scans: list[Read], foxglove: bool) -> None:
    assert len(scans) == 2
    for k, read in enumerate(scans):
        assert header_of(read.message) == (STAMPS["lidar"][k], "lidar")
        assert read.log_ns == STAMPS["lidar"][k] + DELAY_NS["lidar"]
        columns, truth = columns_of(read.message, foxglove), scan(k)
        assert set(columns) == set(truth)
        for name, values in truth.items():
            np.testing.assert_array_equal(columns[name], values)
        if foxglove:
            assert get(get(get(read.message, "pose"), "orientation"), "w") == 1
        else:
            assert (read.message.width, read.message.height) == (50 + k, 1)
            assert read.message.row_step == 32 * (50 + k)


def check_calibration(found: dict[str, list[Read]], fisheye: str) -> None:
    for sensor, topic, model in (
        ("rgb", "/camera/camera_info", "rational_polynomial"),
        ("fir", "/thermal/camera_info", fisheye),
    ):
        camera = CAMERAS[sensor]
        assert len(found[topic]) == len(STAMPS[sensor])
        for k, read in enumerate(found[topic]):
            info = read.message
            assert header_of(info) == (STAMPS[sensor][k], sensor)
            assert (get(info, "width"), get(info, "height")) == camera.size_wh
            assert get(info, "distortion_model") == model
            assert list(get(info, "D", "d")) == list(camera.distortion)
            K = [camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1]
            assert list(get(info, "K", "k")) == K
            assert list(get(info, "R", "r")) == [*np.eye(3).ravel()]
            assert list(get(info, "P", "p")) == [*K[:3], 0, *K[3:6], 0, *K[6:], 0]


def check_static(reads: list[Read]) -> None:
    assert len(reads) == 1
    first = min(stamps[0] + DELAY_NS[sensor] for sensor, stamps in STAMPS.items())
    assert reads[0].log_ns == first
    found = {
        child: (parent, T) for parent, child, T in map(transform_of, get(reads[0].message, "transforms"))
    }
    assert {child: parent for child, (parent, _) in found.items()} == {"fir": "rgb", "lidar": "rgb"}
    np.testing.assert_allclose(found["fir"][1], T_RGB_FIR, atol=1e-12)
    np.testing.assert_allclose(found["lidar"][1], T_RGB_LIDAR, atol=1e-12)


@pytest.mark.parametrize("form", ["rosbag1", "rosbag2", "mcap-ros2", "mcap-json"])
def test_raw_pictures_are_the_decoded_files(form: str, mine: Path, tmp_path: Path) -> None:
    written = write_recording(mine, tmp_path / "flight", form, raw=True)
    reads = [read for read in reader_of(form)(written.path) if read.topic.startswith("/camera/image")]
    assert {read.topic for read in reads} == {"/camera/image"}
    for k, read in enumerate(reads):
        assert (get(read.message, "encoding"), get(read.message, "step")) == ("bgr8", 90)
        truth = rgb(k) if k % 2 == 0 else decode_image(encode_jpeg(rgb(k), 90), "")
        np.testing.assert_array_equal(np.frombuffer(data_of(read.message), "u1").reshape(20, 30, 3), truth)


def test_every_form_has_the_same_messages_in_the_order_of_log_times(mine: Path, tmp_path: Path) -> None:
    orders = {}
    for form in COMPRESSIONS:
        written = write_recording(mine, tmp_path / form, form)
        orders[form] = [(read.log_ns, read.topic) for read in reader_of(form)(written.path)]
    said = [(one.log_ns, one.topic) for one in logged(mine)]
    assert said == sorted(said, key=lambda one: one[0])
    assert said[0][1] == "/tf_static"
    # Readers may order equal times as they like.
    assert {form: sorted(order) for form, order in orders.items()} == dict.fromkeys(
        COMPRESSIONS, sorted(said)
    )


@pytest.mark.parametrize(("form", "compression"), EVERY)
def test_the_same_mine_gives_the_same_bytes(form: str, compression: str, mine: Path, tmp_path: Path) -> None:
    trees = []
    for folder in ("a", "b"):
        path = write_recording(mine, tmp_path / folder / "flight", form, compression=compression).path
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        trees.append({file.relative_to(tmp_path / folder): file.read_bytes() for file in files})
        assert {p.name for p in (tmp_path / folder).iterdir()} == {path.name}  # nothing temporary
    assert trees[0] == trees[1]


@pytest.mark.parametrize("compression", ["none", "zstd-file"])
@pytest.mark.parametrize("form", ["rosbag2", "rosbag2-mcap"])
def test_a_split_bag_is_one_bag(form: str, compression: str, mine: Path, tmp_path: Path) -> None:
    whole = write_recording(mine, tmp_path / "whole", form)
    split = write_recording(mine, tmp_path / "split", form, compression=compression, split_bytes=8000)
    assert len([*split.path.iterdir()]) > 3
    assert {p.name for p in tmp_path.iterdir()} == {"whole", "split"}
    with AnyReader([split.path], default_typestore=STORE) as reader:
        assert reader.message_count == split.messages == whole.messages
        assert {t: info.msgcount for t, info in reader.topics.items()}["/thermal/image"] == 5
    before = [(r.log_ns, r.topic, repr(r.message)) for r in read_ros(whole.path)]
    after = [(r.log_ns, r.topic, repr(r.message)) for r in read_ros(split.path)]
    assert sorted(after) == sorted(before)


def test_a_bag_says_that_transformations_stay_true(mine: Path, tmp_path: Path) -> None:
    with rosbag1.Reader(write_recording(mine, tmp_path / "flight", "rosbag1").path) as reader:
        latched = {c.topic: getattr(c.ext, "latching", None) for c in reader.connections}
    assert latched.pop("/tf_static") == 1
    assert set(latched.values()) == {None}


# --- refusals


@pytest.mark.parametrize(
    ("form", "options", "text"),
    [
        ("rosbag3", {}, "unknown form of recording 'rosbag3'.*mcap-json"),
        (
            "rosbag1",
            {"compression": "zstd"},
            "rosbag1 is not written.*'zstd'.*none, lz4, bz2",
        ),
        ("rosbag2", {"compression": "zstd"}, "zstd-message"),
        ("mcap-ros1", {"compression": "bz2"}, "none, lz4, zstd"),
        ("mcap-ros1", {"split_bytes": 1000}, "only rosbag2"),
        ("rosbag2", {"split_bytes": 0}, "at 1 byte or more"),
    ],
)
def test_what_a_form_does_not_offer(
    form: str, options: dict[str, Any], text: str, mine: Path, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=text):
        write_recording(mine, tmp_path / "out", form, **options)
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize("form", ["rosbag1", "rosbag2", "mcap-json"])
def test_nothing_is_written_over(form: str, mine: Path, tmp_path: Path) -> None:
    path = write_recording(mine, tmp_path / "flight", form).path
    with pytest.raises(OutputError, match=f"{path.name}: exists already"):
        write_recording(mine, path, form)


def test_a_folder_that_is_no_mine(mine: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no recording of `fusion simulate mine`"):
        write_recording(tmp_path / "empty", tmp_path / "out", "rosbag1")


def break_nothing_left(mine: Path) -> None:
    (mine / "lidar").rename(mine / "gone")


def break_no_files(mine: Path) -> None:
    for path in (mine / "fir").iterdir():
        path.unlink()


def break_picture(mine: Path) -> None:
    (mine / "fir" / f"{STAMPS['fir'][3]}.png").write_bytes(b"\x89PNG\r\n\x1a\nbroken")


def break_scan(mine: Path) -> None:
    write_pcd(mine / "lidar" / f"{STAMPS['lidar'][1]}.pcd", PointCloud(np.ones((3, 3), np.float32)))


def break_rig(mine: Path) -> None:
    (mine / "truth" / "rig.toml").write_text("format = 'fusion-rig/1'\n")


@pytest.mark.parametrize("form", ["rosbag1", "rosbag2", "rosbag2-mcap", "mcap-protobuf"])
@pytest.mark.parametrize(
    ("damage", "kind", "text"),
    [
        (break_nothing_left, InputError, "no folder lidar/"),
        (break_no_files, InputError, "fir: holds no file that is named by a stamp"),
        (break_picture, FrameError, rf"{STAMPS['fir'][3]}\.png"),
        (break_scan, InputError, rf"{STAMPS['lidar'][1]}\.pcd: its fields are not those of a simulated scan"),
        (break_rig, UsageError, "no camera 'rgb'"),
    ],
)
def test_a_mine_that_is_damaged_leaves_nothing_behind(
    form: str, damage: Callable[[Path], None], kind: type[FusionError], text: str, tmp_path: Path
) -> None:
    mine = write_mine(tmp_path / "mine")
    damage(mine)
    with pytest.raises(kind, match=text):
        write_recording(mine, tmp_path / "out" / "flight", form)
    assert [*(tmp_path / "out").glob("*")] == []


def test_other_files_beside_the_images_are_left_alone(tmp_path: Path) -> None:
    mine = write_mine(tmp_path / "mine")
    for name in ("notes.txt", "picture.jpg", ".hidden.jpg"):
        (mine / "rgb" / name).write_bytes(b"?")
    assert sum(one.topic == "/camera/image/compressed" for one in logged(mine)) == 4


def test_the_command(mine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    simulate_record(mine, tmp_path / "flight.mcap", form="mcap-protobuf", compression="zstd")
    said = capsys.readouterr()
    assert said.out.startswith("21 messages, ")
    assert said.out.strip().endswith(f"in {tmp_path / 'flight.mcap'}")
    simulate_record(mine, tmp_path / "split", form="rosbag2", split_mb=0.005, raw=True, quiet=True)
    assert capsys.readouterr().out == ""
    assert len([*(tmp_path / "split").glob("*.db3")]) > 3
