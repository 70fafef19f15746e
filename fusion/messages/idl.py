"""The part of OMG's IDL that ROS 2 writes into recordings: modules, structs, typedefs, enums."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace

from fusion.errors import InputError
from fusion.messages.definitions import SEQUENCE, Definitions, Field, key_of

# every alternative ends at the end of the text too, so that an open comment costs one pass
_TOKEN = re.compile(
    r'//[^\n]*|/\*(?:[^*]|\*(?!/))*(?:\*/|\Z)|^[ \t]*#[^\n]*|(?P<token>"(?:[^"\\]|\\.)*(?:"|\\?\Z)'
    r"|[A-Za-z_]\w*(?:::[A-Za-z_]\w*)*|\d[\w.]*|[^\s\w])",
    re.MULTILINE | re.DOTALL,
)
_NAMES = {
    "boolean": "bool",
    "octet": "uint8",
    "char": "uint8",
    "float": "float32",
    "double": "float64",
    "short": "int16",
    "long": "int32",
    "long long": "int64",
    "unsigned short": "uint16",
    "unsigned long": "uint32",
    "unsigned long long": "uint64",
    "wchar": "uint16",
}
_MOST_NUMBERS = 1 << 31


class _Reader:
    def __init__(self, text: str) -> None:
        self.tokens = [m["token"] for m in _TOKEN.finditer(text) if m["token"]]
        self.at = 0
        self.modules: list[str] = []
        self.structs: dict[str, tuple[Field, ...]] = {}
        self.aliases: dict[str, Field] = {}  # typedefs: their type and count

    def next(self, expected: str = "") -> str:
        token = self.tokens[self.at] if self.at < len(self.tokens) else "its end"
        self.at += 1
        if (expected and token != expected) or self.at > len(self.tokens):
            raise InputError(f"the IDL definition has {token[:40]!r} where {expected or 'more'!r} belongs")
        return token

    def peek(self) -> str:
        return self.tokens[self.at] if self.at < len(self.tokens) else ""

    def read(self) -> None:
        """All declarations; blocks are a list and no recursion, whatever the text nests."""
        while self.at < len(self.tokens):
            word = self.next()
            if word == "module":
                self.modules.append(self.next())
                self.next("{")
            elif word == "}":
                self.modules[-1:] = []
            elif word == "struct":
                self.struct()
            elif word == "typedef":
                field = self.field(*self.type())
                self.aliases[field.name] = field
            elif word == "enum":
                self.aliases[self.next()] = Field("", "uint32")
                self.skip(";")
            elif word in ("const", "union", "bitmask", "bitset"):
                self.skip(";")
            elif word == "@":
                self.annotation()

    def annotation(self) -> None:
        self.next()
        if self.peek() == "(":
            self.skip(")")

    def skip(self, end: str) -> None:
        """Beyond the next `end` outside of all brackets."""
        depth = 0
        while True:
            word = self.next()
            depth += (word in ("(", "{")) - (word in (")", "}"))
            if word == end and depth <= 0:
                return

    def struct(self) -> None:
        name = self.next()
        self.next("{")
        fields = []
        while self.peek() != "}":
            if self.peek() == "@":
                self.at += 1
                self.annotation()
                continue
            fields.append(self.field(*self.type()))
        self.next("}")
        self.structs[key_of("::".join([*self.modules, name]))] = tuple(fields)

    def type(self) -> tuple[str, int | None]:
        word = self.next()
        if word == "sequence":
            self.next("<")
            if self.peek() == "sequence":
                raise InputError("the IDL definition has a sequence of sequences, which is not read")
            kind, _ = self.type()
            if self.next() == ",":
                self.next()
                self.next(">")
            return kind, SEQUENCE
        if word in ("string", "wstring"):
            if self.peek() == "<":
                self.skip(">")
            return word, None
        while word in ("unsigned", "long", "unsigned long") and self.peek() in ("long", "short", "double"):
            word = f"{word} {self.next()}"
        return _NAMES.get(word, word), None

    def field(self, kind: str, count: int | None) -> Field:
        name = self.next()
        while (mark := self.next()) == "[":
            size = self.next()
            if count == SEQUENCE or not size.isdecimal() or len(size) > 10:
                raise InputError(f"the IDL definition has an array of {size[:20]!r} {kind}")
            count = min((1 if count is None else count) * int(size), _MOST_NUMBERS)
            self.next("]")
        if mark != ";":
            raise InputError(f"the IDL definition has {mark[:40]!r} where ';' belongs")
        return Field(name, kind, count)

    def resolved(self, owner: str, field: Field) -> Field:
        """`field` with typedefs followed, and its type under the key it has in `structs`."""
        for _ in range(8):
            alias = self.aliases.get(field.type.split("::")[-1])
            if alias is None:
                break
            counts = {alias.count, field.count} - {None}
            if len(counts) > 1 or (alias.count is not None and field.count is not None):
                raise InputError(f"the IDL definition has arrays of arrays in {owner}, which are not read")
            field = Field(field.name, alias.type, counts.pop() if counts else None)
        local = f"{owner.split('/')[0]}/{field.type}"
        return replace(field, type=local if local in self.structs else key_of(field.type))


def parse_idl(texts: Iterable[str]) -> Definitions:
    """The structs of concatenated IDL files. Raises `InputError` for text that is none."""
    reader = _Reader("\n".join(texts))
    reader.read()
    return {
        key: tuple(reader.resolved(key, field) for field in fields) for key, fields in reader.structs.items()
    }
