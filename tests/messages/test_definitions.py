"""Definitions as text: against rosbags' parsers where they agree, and text that is hostile."""

from __future__ import annotations

import time
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import get_types_from_idl

from fusion.errors import InputError
from fusion.messages import reader_of
from fusion.messages.definitions import SEQUENCE, Field, common, key_of, parse, standard
from fusion.recordings.base import Schema, Topic
from tests.messages.samples import store


@pytest.mark.parametrize("ros", [1, 2])
def test_every_type_of_ros_reads_as_its_definition_says(ros: int) -> None:
    """The text that rosbags writes of its own tables, read by us, against those tables."""
    form, known = f"ros{ros}msg", standard(ros)
    for name in [name for name in store(ros).types if not name.startswith(("livox", "own_msgs"))]:
        text, _ = store(ros).generate_msgdef(name, ros_version=ros)
        found = parse(form, name, text.encode())
        for key in found.keys() - {"time", "duration"}:
            if key.startswith("builtin_interfaces"):
                continue
            assert [plain(f, ros) for f in found[key]] == [plain(f, ros) for f in known[key]], (name, key)


def plain(field: Field, ros: int) -> tuple[str, str, int | None]:
    times = {"time": "builtin_interfaces/Time", "duration": "builtin_interfaces/Duration"}
    return field.name, times.get(field.type, field.type), field.count


@pytest.mark.parametrize("ros", [1, 2])
def test_our_own_texts_are_what_ros_says(ros: int) -> None:
    ours, theirs = common(ros), {}
    for name in store(ros).types:
        text, _ = store(ros).generate_msgdef(name, ros_version=ros)
        theirs[key_of(name)] = parse(f"ros{ros}msg", name, text.encode())[key_of(name)]
    shared = ours.keys() & theirs.keys()
    assert {"sensor_msgs/Image", "sensor_msgs/PointCloud2", "sensor_msgs/CameraInfo"} <= shared
    assert {key: ours[key] for key in shared if "builtin" not in key} == {
        key: theirs[key] for key in shared if "builtin" not in key
    }


def test_the_lines_of_a_definition() -> None:
    text = """
  # a comment
string<=10 a   # bounded
int32[<=5] b
int32[3] c\t
uint8[] d
Other e
pkg/Other[] f
pkg2/msg/Other[2] g
int32 DEFAULT=5
string NAME= # not a comment
float64 h 5.0
string[] i ["x", "y"]
Header j
time k
"""
    found = parse("ros1msg", "pkg/msg/A", text.replace("\n", "\r\n").encode())["pkg/A"]
    kinds = [("a", "string", None), ("b", "int32", SEQUENCE), ("c", "int32", 3), ("d", "uint8", SEQUENCE)]
    kinds += [("e", "pkg/Other", None), ("f", "pkg/Other", SEQUENCE), ("g", "pkg2/Other", 2)]
    kinds += [
        ("h", "float64", None),
        ("i", "string", SEQUENCE),
        ("j", "std_msgs/Header", None),
        ("k", "time", None),
    ]
    assert [(f.name, f.type, f.count) for f in found] == kinds


IDL = """
module a_msgs { module msg {
  typedef double double__9[9];
  typedef octet grid__6[2][3];
  enum Kind { ONE, TWO };
  const short SIZE = 5;
  @final
  struct Inner { long long a; unsigned long long b; short c; };
  struct Outer {
    double__9 k; grid__6 g; Kind kind; Inner one; a_msgs::msg::Inner two[2];
    sequence<float, 5> floats; string<10> text; sequence<string> words; boolean yes; char letter;
    @default (value=5) unsigned short last;
  };
}; };
"""


def test_idl() -> None:
    found = parse("ros2idl", "a_msgs/msg/Outer", IDL.encode())
    kinds = [("k", "float64", 9), ("g", "uint8", 6), ("kind", "uint32", None), ("one", "a_msgs/Inner", None)]
    kinds += [("two", "a_msgs/Inner", 2), ("floats", "float32", SEQUENCE), ("text", "string", None)]
    kinds += [
        ("words", "string", SEQUENCE),
        ("yes", "bool", None),
        ("letter", "uint8", None),
        ("last", "uint16", None),
    ]
    assert [(f.name, f.type, f.count) for f in found["a_msgs/Outer"]] == kinds
    assert [f.type for f in found["a_msgs/Inner"]] == ["int64", "uint64", "int16"]
    simple = (
        'module b { module msg { struct C { @unit(value="m") double x; sequence<long> y; string z; }; }; };'
    )
    ((_, (_, fields)),) = get_types_from_idl(simple).items()
    assert [name for name, _ in fields] == [
        f.name for f in parse("ros2idl", "b/msg/C", simple.encode())["b/C"]
    ]


HOSTILE = {
    "open comments": ("ros2idl", b"/*" * 20_000),
    "stars": ("ros2idl", b"/*" + b"*" * 200_000),
    "open texts": ("ros2idl", b'"\\' * 20_000),
    "deep modules": ("ros2idl", b"module a {" * 20_000),
    "deep sequences": ("ros2idl", b"struct A { " + b"sequence<" * 20_000),
    "brackets": ("ros2idl", b"const " + b"(" * 200_000),
    "aliases": ("ros2idl", b"module t { module msg { typedef A A; struct T { A a; }; }; };"),
    "spaces": ("ros2msg", b"a" + b" " * 200_000 + b"\n"),
    "slashes": ("ros2msg", b"a/" * 20_000),
    "equals": ("ros2msg", b"=" * 200_000),
    "many sections": ("ros2msg", b"\n=\nMSG: a/B\n" * 15_000),
    "itself": ("ros2msg", b"t/T a"),
    "itself in an array": ("ros2msg", b"std_msgs/Header header\nt/T[] a\nuint8[] data\nstring format"),
    "doubling": (
        "ros2msg",
        b"t/A0 a\nt/A0 b\n"
        + b"".join(b"===\nMSG: t/A%d\nt/A%d a\nt/A%d b\n" % (k, k + 1, k + 1) for k in range(30))
        + b"===\nMSG: t/A30\nuint8 a\n",
    ),
    "large arrays": ("ros2msg", b"uint8[9999999999] a\nstd_msgs/Header header\nstring format\nuint8[] data"),
    "many fields": ("ros2msg", b"uint8 a\n" * 20_000),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_definitions_end_soon(name: str) -> None:
    form, data = HOSTILE[name]
    began = time.process_time()
    with suppress(InputError):
        reader = reader_of(Topic("/a", Schema("t/msg/T", form, data), "cdr"))
        assert reader.kind is None
    assert time.process_time() - began < 10  # no speed: a parser that goes wrong takes minutes


@settings(max_examples=150)
@given(
    st.sampled_from(["ros2msg", "ros2idl"]),
    st.lists(
        st.sampled_from(
            [
                "struct",
                "module",
                "typedef",
                "sequence<",
                ">",
                "{",
                "}",
                ";",
                "[",
                "]",
                "9",
                "A",
                "string",
                "long",
                "@",
                "(",
                ")",
                "T",
                "::",
                "\n",
                "uint8",
                "t/T",
                "=",
                "<=",
                "MSG: t/T",
                "Header",
                "\n===\n",
                '"',
                "/*",
                " ",
            ]
        ),
        max_size=40,
    ),
)
def test_any_text_is_a_definition_or_an_input_error(form: str, words: list[str]) -> None:
    for text in ("".join(words), " ".join(words)):
        with suppress(InputError):
            reader_of(Topic("/a", Schema("t/msg/T", form, text.encode()), "cdr"))


def test_the_first_text_is_the_type_itself() -> None:
    found = parse("ros2msg", "a/msg/A", b"uint8 x\ntime t\n===\nMSG: a/A\nuint16 y\n===\nMSG: a/B\nint8 z\n")
    assert [field.name for field in found["a/A"]] == ["x", "t"]
    assert [field.name for field in found["a/B"]] == ["z"]
    assert [field.type for field in found["time"]] == ["int32", "uint32"]  # ROS 2's seconds have a sign
    assert [field.type for field in parse("ros1msg", "a/A", b"")["time"]] == ["uint32", "uint32"]
