"""Message definitions as a recording holds them (ROS's .msg, and IDL in `idl`) become plain field lists.

Own parsers, for text from a file must neither become code (rosbags compiles its readers from it) nor be able
to make the parser slow; they read what decides about the bytes, and skip constants, defaults and comments.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import lru_cache

from fusion.errors import InputError

MAX_DEFINITION = 1 << 20  # bytes; the longest real ones are some ten thousand
SEQUENCE = -1
DUMMY = "structure_needs_at_least_one_member"  # the byte that ROS 2 sends for no fields


@dataclass(frozen=True, slots=True)
class Field:
    """`type` is a primitive's name or a key of `Definitions`. `count` is None for one value, the size of a
    fixed array, `SEQUENCE` for an array that says its own length.
    """

    name: str
    type: str
    count: int | None = None


# Type, as `key_of` names it -> its fields in order.
Definitions = dict[str, tuple[Field, ...]]

# ROS's name -> `struct`'s letter; "byte" and "char" as ROS 1 and 2 mean them: signed and unsigned 8 bit.
NUMBERS = {
    "bool": "B",
    "byte": "b",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
TEXTS = ("string", "wstring")

_TIMES = {
    "time": (Field("sec", "uint32"), Field("nanosec", "uint32")),
    "duration": (Field("sec", "int32"), Field("nanosec", "int32")),
    "builtin_interfaces/Time": (Field("sec", "int32"), Field("nanosec", "uint32")),
    "builtin_interfaces/Duration": (Field("sec", "int32"), Field("nanosec", "uint32")),
}
_SECTION = re.compile(r"^=+[ \t]*\r?\n(?:MSG|IDL)[ \t]*:[ \t]*(\S+)[ \t]*\r?$", re.MULTILINE)
_LINE = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?P<array>\[(?P<bound><=)?(?P<size>\d{0,10})\])?"
    r"\s+(?P<name>[A-Za-z]\w*)\s*(?P<rest>.?)"
)


def key_of(name: str) -> str:
    """A type's name without what lies between: ``std_msgs/msg/Header`` is ``std_msgs/Header``."""
    parts = re.split(r"::|/", name)
    return f"{parts[0]}/{parts[-1]}" if len(parts) > 1 else name


def parse(form: str, name: str, data: bytes) -> Definitions:
    """The definitions that a schema of `form` (``ros1msg``, ``ros2msg``, ``ros2idl``) holds for type `name`.

    Types that the text does not hold are missing. Raises `InputError` for text that is none.
    """
    if len(data) > MAX_DEFINITION:
        raise InputError(f"its definition has {len(data):,} bytes, more than {MAX_DEFINITION:,}")
    sections = _SECTION.split(data.decode("utf-8", "replace"))
    texts = [(name, sections[0]), *zip(sections[1::2], sections[2::2], strict=True)]
    if form == "ros2idl":
        from fusion.messages.idl import parse_idl

        return _TIMES | parse_idl([text for _, text in texts])
    times = dict(_TIMES)
    if form == "ros2msg":
        times["time"] = times["builtin_interfaces/Time"]
    # the first text is the type itself, whatever later ones say
    return times | {key_of(key): _fields(key_of(key), text) for key, text in reversed(texts)}


def _fields(owner: str, text: str) -> tuple[Field, ...]:
    found = []
    for number, line in enumerate(text.split("\n"), 1):
        line = line.strip()
        if not line or line.startswith(("#", "@")):
            continue
        match = _LINE.match(line)
        if match is None:
            raise InputError(f"line {number} of the definition of {owner} is no field: {line[:60]!r}")
        if match["rest"] != "=" or match["array"]:  # else a constant
            found.append(Field(match["name"], _resolved(match["type"], owner), _count(match)))
    return tuple(found)


def _count(match: re.Match[str]) -> int | None:
    if match["array"] is None:
        return None
    return SEQUENCE if match["bound"] or not match["size"] else int(match["size"])


def _resolved(name: str, owner: str) -> str:
    """A type's name as the definition of `owner` means it: without a package it is of the same one."""
    if name in NUMBERS or name in TEXTS or name in ("time", "duration"):
        return name
    if name == "Header":
        return "std_msgs/Header"
    return key_of(name) if "/" in name else key_of(f"{owner.split('/')[0]}/{name}")


@lru_cache(2)
def standard(ros: int) -> Definitions:
    """What ROS 1 or 2 itself defines, for recordings that do not say (older rosbag2). From rosbags' tables,
    but for the few types that are wanted often; Livox's come from livox_ros_driver.
    """
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import Stores, get_typestore

    def field(name: str, desc: tuple) -> Field:
        kind, what = desc
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            return replace(field(name, what[0]), count=what[1] if kind == Nodetype.ARRAY else SEQUENCE)
        return Field(name, what[0] if kind == Nodetype.BASE else key_of(what))

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.LATEST)
    found = {
        key_of(name): tuple(field(*each) for each in fields if each[0] != DUMMY)
        for name, (_, fields) in store.fielddefs.items()
    }
    return _TIMES | found | common(ros)


@lru_cache(2)
def common(ros: int) -> Definitions:
    """The definitions of the types that are read, without asking rosbags for them."""
    seq, cameras = ("uint32 seq\n", "DKRP") if ros == 1 else ("", "dkrp")
    stamp = "time stamp" if ros == 1 else "builtin_interfaces/Time stamp"
    text = _COMMON.replace("{seq}", seq).replace("{stamp}", stamp)
    for letter, upper in zip(cameras, "DKRP", strict=True):
        text = text.replace("{" + upper + "}", letter)
    livox = "=\nMSG: livox_ros_driver{n}/CustomMsg\n{msg}=\nMSG: livox_ros_driver{n}/CustomPoint\n{point}"
    for n in ("", "2", "_interfaces"):
        text += livox.replace("{n}", n).replace("{msg}", _LIVOX).replace("{point}", _LIVOX_POINT)
    return parse("ros1msg" if ros == 1 else "ros2msg", "", text.encode())


_COMMON = """
=
MSG: std_msgs/Header
{seq}{stamp}
string frame_id
=
MSG: sensor_msgs/Image
std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
=
MSG: sensor_msgs/CompressedImage
std_msgs/Header header
string format
uint8[] data
=
MSG: sensor_msgs/PointField
string name
uint32 offset
uint8 datatype
uint32 count
=
MSG: sensor_msgs/PointCloud2
std_msgs/Header header
uint32 height
uint32 width
PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
=
MSG: sensor_msgs/RegionOfInterest
uint32 x_offset
uint32 y_offset
uint32 height
uint32 width
bool do_rectify
=
MSG: sensor_msgs/CameraInfo
std_msgs/Header header
uint32 height
uint32 width
string distortion_model
float64[] {D}
float64[9] {K}
float64[9] {R}
float64[12] {P}
uint32 binning_x
uint32 binning_y
RegionOfInterest roi
=
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
=
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
=
MSG: geometry_msgs/Transform
Vector3 translation
Quaternion rotation
=
MSG: geometry_msgs/TransformStamped
std_msgs/Header header
string child_frame_id
Transform transform
=
MSG: tf2_msgs/TFMessage
geometry_msgs/TransformStamped[] transforms
"""
_LIVOX = """
std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
"""
_LIVOX_POINT = """
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
