"""Small ROS 1 bags, written by rosbags."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

ROS1 = get_typestore(Stores.ROS1_NOETIC)


def image(topic_stamp_ns: int, encoding: str, width: int, height: int, size: int) -> bytes:
    """A ROS 1 image, serialised by rosbags."""
    types = ROS1.types
    seconds, nanoseconds = divmod(topic_stamp_ns, 10**9)
    header = types["std_msgs/msg/Header"](
        0, types["builtin_interfaces/msg/Time"](int(seconds), int(nanoseconds)), "camera"
    )
    data = np.zeros(width * height * size, np.uint8)
    message = types["sensor_msgs/msg/Image"](header, height, width, encoding, 0, width * size, data)
    return bytes(ROS1.serialize_ros1(message, "sensor_msgs/msg/Image"))


def bag(path: Path, topics: dict[str, tuple[str, int, int, int]], count: int = 3) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with Writer(path) as writer:
        for name, (encoding, width, height, size) in topics.items():
            connection = writer.add_connection(name, "sensor_msgs/msg/Image", typestore=ROS1)
            for k in range(count):
                stamp = 1_700_000_000 * 10**9 + k * 10**8
                writer.write(connection, stamp, image(stamp, encoding, width, height, size))
    return path
