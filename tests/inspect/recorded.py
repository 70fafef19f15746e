"""Small recordings with known faults, written by rosbags' own writers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from fusion.inspect.base import Finding

START_NS = 1_700_000_000 * 10**9
MS = 1_000_000
RGB, FIR, LIDAR, ODOM = "/camera/image_raw", "/thermal/image_raw", "/velodyne_points", "/odometry"
DELAY_NS = 12 * MS


def streams(finding: Finding) -> dict[str, Any]:
    """The streams of a finding by name."""
    return {stream.name: stream for stream in finding.streams}


def chosen(finding: Finding) -> dict[str, str]:
    """The topic of each role."""
    return {} if finding.roles is None else {role: t.name for role, (t, _) in finding.roles.chosen.items()}


class Robot:
    """A second of a robot: RGB at 20 Hz, thermal at 25 Hz with a gap after its 10th frame, a jump back at its
    16th and frames 20 to 22 that repeat the 19th, clouds at 10 Hz, odometry.
    """

    def __init__(self) -> None:
        rng = np.random.default_rng(1)
        self.rgb = [rng.integers(0, 256, (24, 32, 3)).astype(np.uint8) for _ in range(20)]
        self.fir = [rng.integers(7000, 7400, (40, 48)).astype(np.uint16) for _ in range(25)]
        for k in (20, 21, 22):
            self.fir[k] = self.fir[19]
        self.xyz = [rng.uniform(1, 9, (60, 3)).astype(np.float32) for _ in range(10)]
        self.rgb_ns = [START_NS + 50 * MS * k for k in range(20)]
        self.fir_ns = [START_NS + 40 * MS * k + (200 * MS if k >= 10 else 0) for k in range(25)]
        self.fir_ns[15] -= 60 * MS
        self.lidar_ns = [START_NS + 100 * MS * k for k in range(10)]

    def messages(self, types: dict[str, Any]) -> list[tuple[int, str, Any]]:
        """(log time, topic, message), in the order of log times."""
        found = []
        for ns, pixels in zip(self.rgb_ns, self.rgb, strict=True):
            found.append((ns + DELAY_NS, RGB, _image(types, ns, pixels, "bgr8", "rgb")))
        for k, (ns, pixels) in enumerate(zip(self.fir_ns, self.fir, strict=True)):
            log = START_NS + 40 * MS * k + (200 * MS if k >= 10 else 0) + DELAY_NS
            found.append((log, FIR, _image(types, ns, pixels, "mono16", "fir")))
        for ns, xyz in zip(self.lidar_ns, self.xyz, strict=True):
            found.append((ns + DELAY_NS, LIDAR, _cloud(types, ns, xyz)))
        return sorted(found, key=lambda item: item[0])


def write_bag(path: Path, robot: Robot, *, chunk_bytes: int = 1 << 16) -> Path:
    """The robot as rosbag1."""
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer1(path) as writer:
        writer.chunk_threshold = chunk_bytes
        _write(writer, store, robot.messages(store.types), store.serialize_ros1, typestore=store)
    return path


def write_rosbag2(path: Path, robot: Robot, plugin: StoragePlugin) -> Path:
    """The robot as rosbag2."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        _write(writer, store, robot.messages(store.types), store.serialize_cdr, typestore=store)
    return path


def _write(writer: Any, store: Any, messages: Any, serialize: Any, **kinds: Any) -> None:
    connections: dict[str, Any] = {}
    for log_ns, topic, message in messages:
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, message.__msgtype__, **kinds)
        writer.write(connections[topic], log_ns, serialize(message, message.__msgtype__))
    odometry = store.types["std_msgs/msg/String"](data="x")
    other = writer.add_connection(ODOM, odometry.__msgtype__, **kinds)
    writer.write(other, START_NS + 2 * 10**9, serialize(odometry, odometry.__msgtype__))


def _header(types: dict[str, Any], ns: int, frame: str) -> Any:
    stamp = types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
    kind = types["std_msgs/msg/Header"]
    return kind(seq=0, stamp=stamp, frame_id=frame) if "seq" in kind.__annotations__ else kind(stamp, frame)


def _image(types: dict[str, Any], ns: int, pixels: Any, encoding: str, frame: str) -> Any:
    return types["sensor_msgs/msg/Image"](
        header=_header(types, ns, frame),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=pixels.strides[0],
        data=pixels.reshape(-1).view(np.uint8),
    )


def _cloud(types: dict[str, Any], ns: int, xyz: Any) -> Any:
    field = types["sensor_msgs/msg/PointField"]
    fields = [field(name=n, offset=4 * k, datatype=7, count=1) for k, n in enumerate("xyz")]
    return types["sensor_msgs/msg/PointCloud2"](
        header=_header(types, ns, "lidar"),
        height=1,
        width=len(xyz),
        fields=fields,
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(xyz),
        data=xyz.reshape(-1).view(np.uint8),
        is_dense=True,
    )
