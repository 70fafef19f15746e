"""Protobuf messages by the descriptors in the recording: the wanted fields only, large ones as views.

The protobuf library reads the descriptors. The messages are walked here, since it would copy all pixels for a
header, and make a tree of a crafted message that is many times larger than its bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any, NamedTuple

from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorSet
from google.protobuf.message import DecodeError

from fusion.errors import FrameError, InputError
from fusion.messages import foxglove
from fusion.messages.base import Bytes, Header, Message, Transforms
from fusion.messages.definitions import MAX_DEFINITION
from fusion.recordings.base import Topic

_MAX_NUMBERS = 1 << 10
_MAX_WALKED = 1 << 18  # fields of a message
_F = FieldDescriptorProto
_BYTES, _STRING = int(_F.TYPE_BYTES), int(_F.TYPE_STRING)
_FIXED: dict[int, str] = {  # read by `struct`
    _F.TYPE_DOUBLE: "<d",
    _F.TYPE_FLOAT: "<f",
    _F.TYPE_FIXED64: "<Q",
    _F.TYPE_FIXED32: "<I",
    _F.TYPE_SFIXED64: "<q",
    _F.TYPE_SFIXED32: "<i",
}
_VARINT_BITS: dict[int, int] = {  # read as two's complement of so many bits; 0: unsigned
    _F.TYPE_INT64: 64,
    _F.TYPE_INT32: 32,
    _F.TYPE_ENUM: 32,
    _F.TYPE_UINT64: 0,
    _F.TYPE_UINT32: 0,
    _F.TYPE_BOOL: 0,
}
_LEAVES = {
    int: {*_VARINT_BITS, _F.TYPE_FIXED32, _F.TYPE_FIXED64, _F.TYPE_SFIXED32, _F.TYPE_SFIXED64},
    float: {_F.TYPE_DOUBLE, _F.TYPE_FLOAT},
    str: {_F.TYPE_STRING},
    bytes: {_F.TYPE_BYTES},
}
# google.protobuf.Timestamp's names for those of `foxglove.STAMP`
_RENAMED = {"seconds": "sec", "nanos": "nsec"}


class _Field(NamedTuple):
    name: str
    type: int
    repeated: bool
    part: _Layout | None


class _Layout(NamedTuple):
    """Wanted fields by their numbers, and what stands for those that a message leaves out."""

    fields: Mapping[int, _Field]
    default: Mapping[str, Any]


class ProtobufReader:
    """`MessageReader` of a topic in protobuf: foxglove's types, and the header of others that have one."""

    def __init__(self, topic: Topic) -> None:
        self._where = topic.name
        types = _types(topic)
        name = "." + topic.schema.name
        if name not in types:
            raise InputError(f"its definition does not define {topic.schema.name}")
        self._shape = foxglove.SHAPES.get(topic.schema.name.split(".")[-1])
        self._layout = self._head = None
        try:
            if self._shape is not None:
                self._layout = _layout(types, name, self._shape.tree)
        except KeyError as error:
            if topic.schema.name.startswith("foxglove."):
                what = f"the definition of {topic.schema.name} has no field {error.args[0]} of the usual type"
                raise InputError(what) from None
            self._shape = None
        self.kind: type[Message] | None = self._shape and self._shape.kind
        if self.kind is not Transforms:
            try:
                self._head = _layout(types, name, foxglove.HEADER)
            except KeyError:
                self._head = None

    def header(self, data: Bytes) -> Header:
        if self._head is not None:
            return self._run(self._head, foxglove.header, data)
        return self.message(data).header if self.kind is Transforms else Header()

    def message(self, data: Bytes) -> Message:
        if self._shape is None or self._layout is None:
            raise FrameError("messages of this type are not read", where=self._where)
        return self._run(self._layout, self._shape.make, data)

    def _run(self, layout: _Layout, make: Any, data: Bytes) -> Any:
        try:
            return make(_walk(memoryview(data), layout, [_MAX_WALKED]))
        except (IndexError, struct.error):
            raise FrameError(f"its {len(data):,} bytes end too early", where=self._where) from None
        except FrameError as error:
            raise FrameError(error.what, where=self._where) from None


def _types(topic: Topic) -> dict[str, DescriptorProto]:
    """All message types of the definition, by full name with a dot in front."""
    if topic.schema.form != "protobuf":
        raise InputError(f"its definition has the form {topic.schema.form!r}, not 'protobuf'")
    if len(topic.schema.data) > MAX_DEFINITION:
        raise InputError(f"its definition has {len(topic.schema.data):,} bytes, more than {MAX_DEFINITION:,}")
    try:
        files = FileDescriptorSet.FromString(topic.schema.data).file
    except DecodeError:
        raise InputError("its definition is no set of protobuf descriptors") from None
    found: dict[str, DescriptorProto] = {}
    for file in files:
        below = [(f".{file.package}" if file.package else "", each) for each in file.message_type]
        while below:
            prefix, each = below.pop()
            found[f"{prefix}.{each.name}"] = each
            below += [(f"{prefix}.{each.name}", inner) for inner in each.nested_type]
    return found


def _layout(types: Mapping[str, DescriptorProto], type_name: str, tree: foxglove.Tree) -> _Layout:
    """Where the fields of `tree` are. `KeyError` with the name of one that is missing or of another type."""
    described = types.get(type_name)
    known = {
        _RENAMED.get(f.name, f.name) if tree is foxglove.STAMP else f.name: f for f in _fields(described)
    }
    fields: dict[int, _Field] = {}
    default: dict[str, Any] = {}
    for name, leaf in tree.items():
        repeated = isinstance(leaf, list)
        leaf = leaf[0] if repeated else leaf
        field = known[name]
        part = None
        if (field.label == _F.LABEL_REPEATED) != repeated:
            raise KeyError(name)
        if not isinstance(leaf, type):
            part = _layout(types, field.type_name, leaf)
        elif field.type not in _LEAVES[leaf]:
            raise KeyError(name)
        fields[field.number] = _Field(name, field.type, repeated, part)
        default[name] = () if repeated else part.default if part else leaf()
    return _Layout(fields, default)


def _fields(described: DescriptorProto | None) -> Any:
    return described.field if described is not None else ()


# --- the wire (protobuf's encoding guide: keys are number << 3 | wire type)


def _walk(view: memoryview, layout: _Layout, left: list[int]) -> dict[str, Any]:
    """The wanted values. `left` is how many fields may still be walked, those of parts included."""
    values = dict(layout.default)
    at, end = 0, len(view)
    while at < end:
        left[0] -= 1
        if left[0] < 0:
            raise FrameError(f"it has more than {_MAX_WALKED:,} fields")
        key, at = (view[at], at + 1) if view[at] < 128 else _varint(view, at)
        field = layout.fields.get(key >> 3)
        wire = key & 7
        if wire == 2:
            size, at = (view[at], at + 1) if view[at] < 128 else _varint(view, at)
            stop = at + size
            if field is not None and stop <= end:
                _take(values, field, view[at:stop], left)
        elif wire == 0:
            number, stop = _varint(view, at)
            if field is not None:
                _keep(values, field, _integer(number, field.type))
        else:
            stop = at + _size(wire)
            if field is not None and stop <= end:
                _keep(values, field, _fixed(view[at:stop], field))
        if stop > end:
            raise FrameError(f"it claims {stop - at:,} bytes where {end - at:,} are left")
        at = stop
    return values


def _varint(view: memoryview, at: int) -> tuple[int, int]:
    byte = view[at]
    if byte < 128:
        return byte, at + 1
    value, shift = byte & 127, 7
    for last in range(at + 1, at + 10):
        byte = view[last]
        value |= (byte & 127) << shift
        if byte < 128:
            return value & 0xFFFFFFFFFFFFFFFF, last + 1
        shift += 7
    raise FrameError("a number of more than 64 bits")


def _size(wire: int) -> int:
    if wire not in (1, 5):
        raise FrameError(f"protobuf's wire type {wire}, which no field of today has")
    return 8 if wire == 1 else 4


def _integer(number: int, kind: int) -> int:
    if kind not in _VARINT_BITS:
        raise FrameError("a field of another type than its definition says")
    bits = _VARINT_BITS[kind]
    if not bits:
        return number
    number &= (1 << bits) - 1
    return number - (number >> (bits - 1) << bits)


def _fixed(view: memoryview, field: _Field) -> Any:
    if field.type not in _FIXED or struct.calcsize(_FIXED[field.type]) != len(view):
        raise FrameError(f"its field {field.name} is of another type than its definition says")
    return struct.unpack(_FIXED[field.type], view)[0]


def _keep(values: dict[str, Any], field: _Field, value: Any) -> None:
    if not field.repeated:
        values[field.name] = value
        return
    if not isinstance(values[field.name], list):
        values[field.name] = []
    if len(values[field.name]) >= foxglove.MAX_PARTS:
        raise FrameError(f"it claims more than {foxglove.MAX_PARTS:,} {field.name}")
    values[field.name].append(value)


def _take(values: dict[str, Any], field: _Field, view: memoryview, left: list[int]) -> None:
    """A field that begins with its length: a part, a text, bytes, or numbers packed together."""
    if field.part is not None:
        _keep(values, field, _walk(view, field.part, left))
    elif field.type == _BYTES:
        values[field.name] = view
    elif field.type == _STRING:
        if len(view) > 1 << 16:
            raise FrameError(f"it claims a name of {len(view):,} bytes")
        values[field.name] = str(view, "utf-8", "replace")
    elif field.repeated and field.type in _FIXED:
        size = struct.calcsize(_FIXED[field.type])
        if len(view) % size or len(view) > _MAX_NUMBERS * size:
            raise FrameError(f"it claims {len(view):,} bytes of {field.name}")
        values[field.name] = [
            *values[field.name],
            *(v for (v,) in struct.iter_unpack(_FIXED[field.type], view)),
        ]
    else:
        raise FrameError(f"its field {field.name} is of another type than its definition says")
