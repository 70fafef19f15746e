"""Inputs that damage would hardly ever reach, drawn: definitions, JSON, TOML, names, images, clouds."""

from __future__ import annotations

import base64
import copy
import functools
import json
import struct
from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np
from fuzz_mutate import EXTREMES, HOSTILE_WORDS
from fuzz_seeds import Seed
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

_TRIES = 20
_ALL: Any = tuple(HealthCheck)


def drawn(strategy: st.SearchStrategy[Any], rng: Random) -> Any:
    """One example of a strategy, decided by `rng` alone."""
    found: list[Any] = []
    one = _one_input(strategy)
    for _ in range(_TRIES):
        one(rng.randbytes(8192), found)
        if found:
            return found[-1]
    return None


@functools.cache
def _one_input(strategy: st.SearchStrategy[Any]) -> Callable[[bytes, list[Any]], None]:
    kept: list[Any] = []

    @settings(database=None, deadline=None, suppress_health_check=_ALL)
    @given(strategy)
    def keep(value: Any) -> None:
        kept.append(value)

    def one(buffer: bytes, found: list[Any]) -> None:
        kept.clear()
        keep.hypothesis.fuzz_one_input(buffer)  # pyright: ignore[reportFunctionMemberAccess]
        found.extend(kept)

    return one


# -- definitions and JSON messages

_NAMES = st.sampled_from(
    ["header", "stamp", "data", "width", "height", "a", "encoding", "points", "frame_id"]
)
_TYPE_WORDS = """
bool byte int8 uint8 int64 float32 float64 string wstring time duration Header std_msgs/Header a/B a/msg/C B
Image builtin_interfaces/Time sensor_msgs/PointField string<=8 uint8<=3 unknown/Type boolean
sequence<octet> octet
"""
_ARRAY_WORDS = "[] [3] [0] [<=4] [1048576] [4294967295] [9999999999] [-1]"
_TYPES = st.sampled_from(_TYPE_WORDS.split())
_ARRAYS = st.sampled_from(("", "", "", *_ARRAY_WORDS.split()))
_RESTS = st.sampled_from(("", "", " # x", "=3", " 'x'", " [1, 2]", "=", ' "a#b"'))
_FIELDS = st.lists(st.builds("{0}{1} {2}{3}".format, _TYPES, _ARRAYS, _NAMES, _RESTS), max_size=12).map(
    "\n".join
)
_PARTS = st.lists(
    st.builds(
        "{0}\n{1}: {2}\n{3}".format,
        st.sampled_from(["=" * 80, "=", "==="]),
        st.sampled_from(["MSG", "IDL"]),
        st.sampled_from(
            ["std_msgs/Header", "a/B", "a/msg/C", "sensor_msgs/Image", "sensor_msgs/msg/PointField"]
        ),
        _FIELDS,
    ),
    max_size=6,
)
_MSG = st.builds(lambda first, parts: "\n".join([first, *parts]), _FIELDS, _PARTS)
_IDL_WORDS = """
module struct enum union typedef const sequence string octet boolean x a { } }; < > [ ] ; ; :: , = 3
4294967296 long unsigned sensor_msgs msg Image @key @default (value=0) // /* */ #include double
"""
_IDL = st.lists(st.sampled_from(_IDL_WORDS.split()), max_size=80).map(" ".join)
_NUMBER = st.one_of(st.integers(), st.floats(), st.sampled_from([*EXTREMES]))
_LEAF = st.one_of(
    st.none(), st.booleans(), _NUMBER, st.text(max_size=8), st.binary(max_size=40).map(base64.b64encode)
)
_JSON_NAMES = [
    "timestamp",
    "sec",
    "nsec",
    "frame_id",
    "width",
    "height",
    "step",
    "encoding",
    "data",
    "format",
]
_JSON_NAMES += [
    "point_stride",
    "fields",
    "name",
    "offset",
    "type",
    "pose",
    "position",
    "orientation",
    "x",
    "y",
    "z",
]
_JSON_NAMES += ["w", "D", "K", "R", "P", "distortion_model", "transforms", "translation", "rotation"]
_JSON = st.recursive(
    _LEAF,
    lambda inner: (
        st.lists(inner, max_size=12) | st.dictionaries(st.sampled_from(_JSON_NAMES), inner, max_size=10)
    ),
    max_leaves=40,
)
_ROS_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage", "a/msg/B")
_JSON_TYPES = (
    "foxglove.RawImage",
    "foxglove.PointCloud",
    "foxglove.CameraCalibration",
    "foxglove.FrameTransforms",
)


def definition(rng: Random, seed: Seed) -> Seed:
    del seed
    from fusion.recordings.base import Schema, Topic

    kind = rng.choice(("msg", "msg", "idl", "json"))
    if kind == "json":
        topic = Topic("/t", Schema(rng.choice(_JSON_TYPES), "jsonschema", b"{}"), "json")
        data = json.dumps(
            _shaped(drawn(_JSON, rng), topic.schema.name, rng), default=lambda b: b.decode()
        ).encode()
        return Seed(kind, {"message": data, "definition.msg": b"{}"}, about=topic)
    text = drawn(_MSG if kind == "msg" else _IDL, rng) or ""
    name = rng.choice(_ROS_TYPES)
    if kind == "idl":
        text = f"{'=' * 80}\nIDL: {name}\n{text}"
    ros1 = kind == "msg" and rng.random() < 0.5
    form = "ros1msg" if ros1 else {"msg": "ros2msg", "idl": "ros2idl"}[kind]
    topic = Topic("/t", Schema(name, form), "ros1" if ros1 else "cdr")
    data = (b"" if ros1 else b"\0\1\0\0") + _counts(rng)
    return Seed(kind, {"message": data, "definition.msg": text.encode("utf-8", "replace")}, about=topic)


def _counts(rng: Random) -> bytes:
    """Bytes in which lengths are often small, sometimes extreme."""
    words = (
        rng.choice((0, 1, 2, 3, 8, 1 << 16, (1 << 32) - 1, rng.getrandbits(32)))
        for _ in range(rng.randrange(80))
    )
    return struct.pack("<" + "I" * len(found := list(words)), *found)


def _shaped(value: Any, name: str, rng: Random) -> Any:
    """A sound message, in which half of the time one or two values are of the drawn kind."""
    stamp, data = {"sec": 1, "nsec": 2}, base64.b64encode(bytes(96)).decode()
    head = {"timestamp": stamp, "frame_id": "a"}
    zero = {"x": 0, "y": 0, "z": 0}
    sound: dict[str, Any] = {
        "foxglove.RawImage": {**head, "width": 4, "height": 3, "encoding": "rgb8", "step": 12, "data": data},
        "foxglove.PointCloud": {
            **head,
            "pose": {"position": zero, "orientation": {**zero, "w": 1}},
            "point_stride": 12,
            "fields": [{"name": axis, "offset": 4 * k, "type": 7} for k, axis in enumerate("xyz")],
            "data": data,
        },
        "foxglove.CameraCalibration": {
            **head, "width": 4, "height": 3, "distortion_model": "plumb_bob", "D": [0.0] * 5,
            "K": [4, 0, 2, 0, 4, 1, 0, 0, 1], "R": [1, 0, 0, 0, 1, 0, 0, 0, 1], "P": [0] * 12,
        },
        "foxglove.FrameTransforms": {
            "transforms": [
                {
                    "timestamp": stamp,
                    "parent_frame_id": "a",
                    "child_frame_id": "b",
                    "translation": zero,
                    "rotation": {**zero, "w": 1},
                }
            ]
        },
    }[name]  # fmt: skip
    if rng.random() < 0.2:
        return value
    for _ in range(rng.choice((1, 1, 2))):
        _put(sound, value, rng)
    return sound


def _put(tree: Any, value: Any, rng: Random) -> None:
    """`value` in place of something in the tree."""
    while isinstance(tree, dict | list) and tree:
        key = rng.choice([*tree]) if isinstance(tree, dict) else rng.randrange(len(tree))
        if not isinstance(tree[key], dict | list) or not tree[key] or rng.random() < 0.2:
            tree[key] = copy.deepcopy(value)  # never into itself
            return
        tree = tree[key]


# -- TOML


_TOML_VALUES = st.recursive(
    st.one_of(st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(), st.text(max_size=12))
    | st.sampled_from([word for word in HOSTILE_WORDS if len(word) < 100]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=8,
)


def toml(rng: Random, seed: Seed) -> Seed:
    """A sound file with one to three values of another kind."""
    import tomllib

    import tomlkit

    tree = tomllib.loads(seed.files[seed.main].decode())
    for _ in range(rng.choice((1, 1, 2, 3))):
        _put(tree, drawn(_TOML_VALUES, rng), rng)
    data = tomlkit.dumps(tree).encode("utf-8", "replace")
    return Seed(f"drawn {seed.name}", {**seed.files, seed.main: data}, seed.main)


# -- names


_PIECES = (
    "..",
    ".",
    "",
    "a",
    "b.png",
    "/",
    "\\",
    "C:",
    "~",
    "\x00",
    "é",
    "\udcff",
    "\ud800",
    " ",
    "...",
    "a" * 300,
)
_PIECES += (f".{'0' * 32}.tmp", "%2e%2e", "con", "\n", "\u2215", "\uff0e\uff0e", "-", "*")


def storage_name(rng: Random, seed: Seed) -> Seed:
    del seed
    pieces = [rng.choice(_PIECES) for _ in range(rng.randrange(1, 7))]
    name = rng.choice(("/", "/", "")).join(pieces)
    if rng.random() < 0.3:
        name = drawn(st.text(max_size=20), rng) or name
    return Seed("name", {}, about=name)


# -- images and clouds


def _size(rng: Random) -> int:
    """A sound one two times of three."""
    if rng.random() < 0.67:
        return 2 * rng.randrange(1, 40)
    return rng.choice((0, 1, 2, 3, 4, 5, 16, 31, 64, -1, rng.choice(EXTREMES), rng.randrange(200)))


def picture(rng: Random, seed: Seed) -> Seed:
    """A raw image of any encoding, or a compressedDepth."""
    del seed
    from fusion.messages.base import CompressedImage, Header, RawImage
    from fusion.messages.pixels import ENCODINGS, YUV

    if rng.random() < 0.25:
        word = rng.choice(
            ("16UC1; compressedDepth png", "32FC1; compressedDepth rvl", "16UC1; compressedDepth", "jpeg")
        )
        data = _compressed_depth(rng)
        return Seed(word, {}, about=CompressedImage(Header(), word, data))
    encoding = rng.choice([*ENCODINGS, *YUV, "MONO8", "8UC5", "", "rgb8\x00", "yuv"])
    width, height = _size(rng), _size(rng)
    known = ENCODINGS.get(encoding)
    bytes_each = np.dtype(known.dtype).itemsize * known.channels if known else rng.choice((1, 2, 2, 3))
    natural = max(0, width) * bytes_each
    step = rng.choice((*[natural] * 6, natural + rng.randrange(16), natural - 1, _size(rng)))
    size = min(
        1 << 20, max(0, step * height * rng.choice((1, 1, 2)) + rng.choice((0, 0, 0, 0, 1, -1, -step)))
    )
    pixels = rng.randbytes(size) if rng.random() < 0.7 else bytes(size)
    return Seed(
        encoding, {}, about=RawImage(Header(), width, height, encoding, rng.random() < 0.3, step, pixels)
    )


def _compressed_depth(rng: Random) -> bytes:
    import cv2

    head = struct.pack(
        "<iff", rng.choice((0, 1, -1)), *(rng.choice((0.0, 100.0, -1.0, 1e38, float("nan"))) for _ in "ab")
    )
    if rng.random() < 0.5:
        pixels = np.frombuffer(rng.randbytes(96), "<u2").reshape(6, 8)
        payload = bytearray(cv2.imencode(".png", pixels)[1].tobytes())
        payload[rng.randrange(len(payload))] ^= rng.choice((0, 0, 1, 128))
    else:
        sizes = [rng.choice((1, 4, 8, 16, 4096, -1, 0, (1 << 31) - 1)) for _ in "wh"]
        payload = bytearray(struct.pack("<ii", *sizes) + rng.randbytes(rng.randrange(400)))
    return head + bytes(payload[: rng.choice((len(payload), len(payload), rng.randrange(len(payload) + 1)))])


def points(rng: Random, seed: Seed) -> Seed:
    del seed
    from fusion.messages.base import CameraInfo, Header, PointField, Points

    if rng.random() < 0.25:
        numbers = [500.0, 0.0, 20.0, 0.0, 500.0, 10.0, 0.0, 0.0, 1.0, 1, 0, 0, 0, 1, 0, 0, 0, 1, *[0.0] * 12]
        for k in rng.sample(range(30), rng.choice((0, 1, 1, 2))):
            numbers[k] = rng.choice((0.0, 1.0, 500.0, -1.0, 1e308, 1e-308, float("nan"), float("inf")))
        model = rng.choice(("plumb_bob", "rational_polynomial", "equidistant", "fisheye", "", "none", "x"))
        K, R, P = (
            np.array(numbers[:9]).reshape(3, 3),
            np.array(numbers[9:18]).reshape(3, 3),
            np.array(numbers[18:]),
        )
        D = tuple(numbers[18:][: rng.choice((0, 4, 5, 8, 12))])
        return Seed(
            model, {}, about=CameraInfo(Header(), _size(rng), _size(rng), model, D, K, R, P.reshape(3, 4))
        )
    fields = []
    at = 0
    for name in (
        "x",
        "y",
        "z",
        *rng.sample(("intensity", "ring", "t", "time", "timestamp", "x", "", "rgb"), 3),
    ):
        dtype = np.dtype(rng.choice(("<f4", "<f4", "<f4", ">f4", "<f8", "u1", "<u2", "<u4", "i1", "<i4")))
        count = 1 if rng.random() < 0.95 else rng.choice((2, 3, 0, 5000))
        fields.append(PointField(name, at if rng.random() < 0.97 else _size(rng), dtype, count))
        at += dtype.itemsize * max(1, min(count, 4))
    width, height = _size(rng), rng.choice((1, 1, 1, _size(rng)))
    step = rng.choice((*[at] * 6, at + 4, _size(rng)))
    row = width * step + rng.choice((0, 0, 0, 0, 8, -1, _size(rng)))
    size = min(1 << 20, max(0, row * height + rng.choice((0, 0, 0, 0, -1, 1))))
    shift = rng.choice((None, None, np.eye(4)))
    return Seed(
        "points",
        {},
        about=Points(Header(), width, height, tuple(fields), step, row, rng.randbytes(size), shift),
    )
