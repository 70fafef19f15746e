"""Our messages as ROS 1 and ROS 2 put them on the wire, by the library rosbags: for recordings that we make
ourselves.

The library makes its code from message definitions; here they are its own, never those of a file.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Literal

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from fusion.geometry import quat_of_rotation
from fusion.messages.base import (
    Bytes,
    CameraInfo,
    CompressedImage,
    Header,
    Message,
    PointField,
    Points,
    RawImage,
    Transform,
    Transforms,
)

_TF = "tf2_msgs/msg/TFMessage"
TYPES: dict[type[Message], str] = {
    RawImage: "sensor_msgs/msg/Image",
    CompressedImage: "sensor_msgs/msg/CompressedImage",
    Points: "sensor_msgs/msg/PointCloud2",
    CameraInfo: "sensor_msgs/msg/CameraInfo",
    Transforms: _TF,
}
# sensor_msgs/PointField: what a type is called there.
_DATATYPES = {
    "int8": 1,
    "uint8": 2,
    "int16": 3,
    "uint16": 4,
    "int32": 5,
    "uint32": 6,
    "float32": 7,
    "float64": 8,
}


@cache
def ros_wire(version: Literal[1, 2]) -> RosWire:
    """The wire of a version of ROS; making one takes a tenth of a second."""
    return RosWire(version)


class RosWire:
    """Serialises messages for ROS `version`; `sequence` of ROS 1's headers counts the messages of each
    topic.
    """

    def __init__(self, version: Literal[1, 2]) -> None:
        self.version = version
        self.store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
        if _TF not in self.store.types:
            self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", _TF))

    def definition(self, kind: type[Message]) -> str:
        """The text of the type and all that it is made of, as recordings carry it."""
        return self.store.generate_msgdef(TYPES[kind], ros_version=self.version)[0]

    def bytes_of(self, message: Message, sequence: int = 0) -> bytes:
        """The message on the wire: ROS 1's, or CDR, little endian."""
        filled = self._filled(message, sequence)
        serialise = self.store.serialize_ros1 if self.version == 1 else self.store.serialize_cdr
        return bytes(serialise(filled, TYPES[type(message)]))

    def _make(self, type_name: str, /, **values: Any) -> Any:
        return self.store.types[type_name](**values)

    def _header(self, header: Header, sequence: int) -> Any:
        sec, nanosec = divmod(header.stamp_ns or 0, 10**9)
        stamp = self._make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        seq = {"seq": sequence} if self.version == 1 else {}
        return self._make("std_msgs/msg/Header", **seq, stamp=stamp, frame_id=header.frame_id)

    def _filled(self, message: Message, sequence: int) -> Any:
        name = TYPES[type(message)]
        if isinstance(message, Transforms):
            return self._make(name, transforms=[self._transform(one, sequence) for one in message.transforms])
        header = self._header(message.header, sequence)
        if isinstance(message, CompressedImage):
            return self._make(name, header=header, format=message.format, data=_octets(message.data))
        size = {"height": message.height, "width": message.width}
        if isinstance(message, RawImage):
            big, data = int(message.big_endian), _octets(message.data)
            form = {"encoding": message.encoding, "is_bigendian": big, "step": message.step}
            return self._make(name, header=header, **size, **form, data=data)
        if isinstance(message, Points):
            return self._make(name, header=header, **size, **self._points(message))
        return self._make(name, header=header, **size, **self._calibration(message))

    def _points(self, points: Points) -> dict[str, Any]:
        return {
            "fields": [self._field(field) for field in points.fields],
            "is_bigendian": False,
            "point_step": points.point_step,
            "row_step": points.row_step,
            "data": _octets(points.data),
            "is_dense": True,
        }

    def _field(self, field: PointField) -> Any:
        values = {"name": field.name, "offset": field.offset, "count": field.count}
        return self._make("sensor_msgs/msg/PointField", datatype=_DATATYPES[field.dtype.name], **values)

    def _calibration(self, info: CameraInfo) -> dict[str, Any]:
        numbers = {name: np.ravel(getattr(info, name)).astype(np.float64) for name in "DKRP"}
        if self.version == 2:
            numbers = {name.lower(): values for name, values in numbers.items()}
        whole = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0)
        roi = self._make("sensor_msgs/msg/RegionOfInterest", **whole, do_rectify=False)
        return {"distortion_model": info.model, **numbers, "binning_x": 0, "binning_y": 0, "roi": roi}

    def _transform(self, one: Transform, sequence: int) -> Any:
        w, x, y, z = (float(n) for n in quat_of_rotation(one.T_parent_child[:3, :3]))
        shift = dict(zip("xyz", map(float, one.T_parent_child[:3, 3]), strict=True))
        return self._make(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(Header(one.stamp_ns, one.parent), sequence),
            child_frame_id=one.child,
            transform=self._make(
                "geometry_msgs/msg/Transform",
                translation=self._make("geometry_msgs/msg/Vector3", **shift),
                rotation=self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
            ),
        )


def _octets(data: Bytes) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.frombuffer(data, np.uint8)
