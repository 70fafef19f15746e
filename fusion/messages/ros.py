"""ROS 1's serialisation and CDR (ROS 2's) to messages, laid out as the recording's own definitions say.

rosbags reads both too, but compiles Python from the definitions in the file; here they only become plans.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple, TypeVar

from fusion.errors import FrameError, InputError
from fusion.messages import make
from fusion.messages.base import (
    Bytes,
    CameraInfo,
    CompressedImage,
    Header,
    Message,
    Points,
    RawImage,
    Transforms,
)
from fusion.messages.definitions import Definitions, common, key_of, parse, standard
from fusion.messages.layout import Plan, Want, plan_of
from fusion.recordings.base import Topic

T = TypeVar("T")
_INTEGER, _NUMBER, _TEXT = Want("integer"), Want("number"), Want("text")
_BYTES, _NUMBERS = Want("bytes"), Want("numbers")


def _header(stamp: str, frame_id: str) -> dict[str, Want]:
    return {f"{stamp}.sec": _INTEGER, f"{stamp}.nanosec": _INTEGER, frame_id: _TEXT}


_HEADER = _header("header.stamp", "header.frame_id")
_SIZE = {"height": _INTEGER, "width": _INTEGER}
_IMAGE = {**_HEADER, **_SIZE, "encoding": _TEXT, "is_bigendian": _INTEGER, "step": _INTEGER, "data": _BYTES}
_COMPRESSED = {**_HEADER, "format": _TEXT, "data": _BYTES}
_FIELDS = {"name": _TEXT, "offset": _INTEGER, "datatype": _INTEGER, "count": _INTEGER}
_POINTS = {
    **_HEADER,
    **_SIZE,
    "fields": Want("items", _FIELDS),
    "is_bigendian": _INTEGER,
    "point_step": _INTEGER,
    "row_step": _INTEGER,
    "data": _BYTES,
}
_LIVOX: dict[str, Want] = dict.fromkeys(
    ("offset_time", "x", "y", "z", "reflectivity", "tag", "line"), _NUMBER
)
_TRANSFORM = {
    **_HEADER,
    "child_frame_id": _TEXT,
    **{f"transform.translation.{axis}": _NUMBER for axis in "xyz"},
    **{f"transform.rotation.{axis}": _NUMBER for axis in "xyzw"},
}


def _camera(letters: str) -> dict[str, Want]:
    return {**_HEADER, **_SIZE, "distortion_model": _TEXT, **dict.fromkeys(letters, _NUMBERS)}


def _headed(function: Callable[..., T]) -> Callable[..., T]:
    """`function` of a header, from one of the header's values."""
    return lambda sec, nsec, frame_id, *values: function(make.header(sec, nsec, frame_id), *values)


def _first_header(items: Sequence[tuple[int, int, str]]) -> Header:
    return make.header(*items[0]) if items else Header()


class _Shape(NamedTuple):
    """A type as its needed fields, whatever it is called and what else it has; `make` takes their values."""

    name: str  # the last part of its usual name
    kind: type[Message]
    needs: Mapping[str, Want]
    make: Callable[..., Message]


_SHAPES = (
    _Shape("Image", RawImage, _IMAGE, _headed(make.image)),
    _Shape("CompressedImage", CompressedImage, _COMPRESSED, _headed(make.compressed)),
    _Shape("PointCloud2", Points, _POINTS, _headed(make.points)),
    _Shape("CustomMsg", Points, {**_HEADER, "points": Want("records", _LIVOX)}, _headed(make.livox)),
    _Shape("CameraInfo", CameraInfo, _camera("DKRP"), _headed(make.camera)),
    _Shape("CameraInfo", CameraInfo, _camera("dkrp"), _headed(make.camera)),
    _Shape("TFMessage", Transforms, {"transforms": Want("items", _TRANSFORM)}, make.transforms),
    _Shape("TransformStamped", Transforms, _TRANSFORM, lambda *values: make.transforms([values])),
)
_STANDARD = (
    *(f"sensor_msgs/{name}" for name in ("Image", "CompressedImage", "PointCloud2", "CameraInfo")),
    *("tf2_msgs/TFMessage", "geometry_msgs/TransformStamped"),
    *("livox_ros_driver/CustomMsg", "livox_ros_driver2/CustomMsg"),
)
_FORMS = {"ros1": ("", "ros1msg"), "cdr": ("", "ros2msg", "ros2idl")}
# The second byte of CDR's encapsulation (DDS-XTypes 7.6.3.1.2), but for 0 and 1: big and little endian CDR.
_REFUSED = {**dict.fromkeys((2, 3), "PL_CDR"), **dict.fromkeys(range(6, 12), "XCDR version 2")}


class _Program(NamedTuple):
    """How to read one thing: a plan for each byte order (0 big, 1 little), and what to make of its values."""

    plans: tuple[Plan, Plan]
    order: tuple[int, ...]  # of the values in the message
    make: Callable[..., Any]


class RosReader:
    """`MessageReader` of a topic in ROS 1's serialisation or CDR; the header is None where there is none."""

    def __init__(self, topic: Topic) -> None:
        self._where, self._cdr = topic.name, topic.encoding == "cdr"
        self._type = key_of(topic.schema.name)
        self._definitions = _definitions(topic)
        shape, self._program = self._shape()
        self.kind: type[Message] | None = shape and shape.kind
        self._head = self._header_program()

    def header(self, data: Bytes) -> Header:
        if self._head is not None:
            return self._run(self._head, data)
        return Header()

    def message(self, data: Bytes) -> Message:
        if self._program is None:
            raise FrameError(f"messages of the type {self._type} are not read", where=self._where)
        return self._run(self._program, data)

    def _run(self, program: _Program, data: Bytes) -> Any:
        view, little = memoryview(data), 1
        if self._cdr:
            little = self._byte_order(view)
            view = view[4:]
        values: list[Any] = []
        try:
            program.plans[little].walk(view, 0, values)
            return program.make(*[values[k] for k in program.order])
        except struct.error:
            raise FrameError(f"its {len(view):,} bytes end too early", where=self._where) from None
        except FrameError as error:
            raise FrameError(error.what, where=self._where) from None

    def _byte_order(self, view: memoryview) -> int:
        if len(view) < 4:
            raise FrameError(f"its {len(view)} bytes are no CDR", where=self._where)
        if view[0] == 0 and view[1] < 2:
            return view[1]
        kind = _REFUSED.get(view[1], "unknown") if view[0] == 0 else "unknown"
        what = f"its encapsulation is {kind} (0x{view[0]:02x}{view[1]:02x}); plain CDR is read"
        raise FrameError(what, where=self._where)

    # --- once a topic

    def _shape(self) -> tuple[_Shape | None, _Program | None]:
        """Whichever of our types it is, by its fields; those of its own name are tried first."""
        name = self._type.split("/")[-1]
        why = ""
        for shape in sorted(_SHAPES, key=lambda shape: shape.name != name):
            try:
                return shape, self._programmed(shape.needs, shape.make)
            except KeyError as error:
                why = why or f"the definition of {self._type} has no field {error.args[0]} of the usual type"
            except InputError as error:
                why = why or error.what
        if self._type in _STANDARD:
            raise InputError(why)
        return None, None

    def _header_program(self) -> _Program | None:
        first = self._definitions[self._type][:1]
        paths = [("header.stamp", "header.frame_id"), ("stamp", "frame_id")]
        if first and first[0].type == "std_msgs/Header" and first[0].count is None:
            paths.insert(0, (f"{first[0].name}.stamp", f"{first[0].name}.frame_id"))
        for stamp, frame_id in paths:
            with suppress(KeyError, InputError):
                return self._programmed(_header(stamp, frame_id), make.header)
        if self.kind is Transforms:
            return self._programmed({"transforms": Want("items", _HEADER)}, _first_header)
        return None

    def _programmed(self, needs: Mapping[str, Want], function: Callable[..., Any]) -> _Program:
        big, little = (
            plan_of(self._definitions, self._type, needs, order=order, cdr=self._cdr) for order in "><"
        )
        return _Program((big, little), tuple(little.paths.index(path) for path in needs), function)


def _definitions(topic: Topic) -> Definitions:
    """Those of the recording, else (it holds none) those of ROS itself."""
    schema, ros = topic.schema, 1 if topic.encoding == "ros1" else 2
    if schema.form not in _FORMS[topic.encoding]:
        forms = " or ".join(filter(None, _FORMS[topic.encoding]))
        raise InputError(f"its definition has the form {schema.form!r}, not {forms}")
    key = key_of(schema.name)
    if schema.data.strip():
        found = parse(schema.form or _FORMS[topic.encoding][1], schema.name, schema.data)
        if key in found:
            return found
        raise InputError(f"its definition does not define {schema.name}")
    for known in (common(ros), standard(ros)) if key not in common(ros) else (common(ros),):
        if key in known:
            return known
    if schema.form:
        return {key: ()}  # the recording says that it has no fields
    raise InputError(
        f"the recording has no definition of {schema.name}", hint="record it with its definition"
    )
