"""Damage, made from a seed: to bytes, to their lengths and counts, and to text word by word."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Sequence
from random import Random

MOST_BYTES = 1 << 23  # of a mutated file
EXTREMES = (
    *(0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x10000, 1 << 20, 1 << 27, 1 << 30),
    *((1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 32, 1 << 40, (1 << 63) - 1, 1 << 63, (1 << 64) - 1),
)
HOSTILE_WORDS = (
    *("0", "-1", "1", "0.5", "-0.0", "1e308", "1e400", "-1e-400", "nan", ".nan", "inf", "-.inf", "NaN"),
    *("2147483648", "9223372036854775807", "18446744073709551616", "9" * 5000, "0x7f", "1_000", "007"),
    *("true", "null", "~", "''", '""', "[]", "{}", "[[]]", "[1, 2]", "{a: 1}", "{a = 1}", '{"a": 1}'),
    *("../../etc/passwd", "/etc/passwd", "a/../../b", "C:\\x", "..", "a\x00b", "CON", "s3://x/y", "~/x"),
    *("!!python/object/apply:os.system ['id']", "!!binary aaa", "&a [*a]", "*a", "<<: *a", "%YAML 9.9"),
    *("é", "\ufeff", "\u202e", "\U0001f525", "\x1b[2J", "\x85", "\u2028", "x" * 70_000, "%s%n", "$(id)"),
    *("1979-05-27T07:32:00Z", "{}{0.__class__}", "---", "...", "#", '"', "'", "=", ":", "[", "]", "{", "}"),
)
NESTED = ("[", "{", '{"a":', "[[", "- ", "a: {b: [", "x = [", "(")
_TOKEN = re.compile(r"[\w.+-]+|\s+|[^\w\s]")
_PNG = b"\x89PNG\r\n\x1a\n"


def mutated(data: bytes, rng: Random, others: Sequence[bytes], text: bool) -> bytes:
    """`data` with one to four kinds of damage; text is damaged as text three times of four."""
    for _ in range(rng.choice((1, 1, 1, 1, 1, 2, 3, 4))):
        if text and rng.random() < 0.75:
            data = rng.choice(_OF_TEXT)(data.decode("utf-8", "replace"), rng).encode("utf-8", "replace")
        else:
            data = bytes(rng.choice(_OF_BYTES)(bytearray(data), rng, others))
        data = data[:MOST_BYTES]
    return data


def png_repaired(data: bytes) -> bytes:
    """The CRCs of all PNGs' chunks made right, so that damage gets past them."""
    out, at = bytearray(data), data.find(_PNG) + len(_PNG)
    while len(_PNG) <= at and at + 12 <= len(out):
        size = int.from_bytes(out[at : at + 4], "big")
        end = at + 8 + size
        if end + 4 > len(out):
            break
        struct.pack_into(">I", out, end, zlib.crc32(out[at + 4 : end]))
        at = end + 4
    return bytes(out)


def mcap_without_crcs(data: bytes) -> bytes:
    """The CRCs of an MCAP's chunks, data and summary set to 0: not given."""
    out, at = bytearray(data), 8
    places = {0x06: 24, 0x0F: 0, 0x02: 16}  # of the CRC in a record's body, by opcode
    while at + 9 <= len(out) - 8:
        opcode, size = struct.unpack_from("<BQ", out, at)
        if opcode in places:
            struct.pack_into("<I", out, at + 9 + places[opcode], 0)
        at += 9 + size
    return bytes(out)


def _place(size: int, rng: Random) -> int:
    """Anywhere, but more often where headers and indexes are: at both ends."""
    near = min(size, 4096)
    where = rng.random()
    if where < 0.3:
        return rng.randrange(near + 1)
    return size - rng.randrange(near + 1) if where < 0.45 else rng.randrange(size + 1)


def _length(size: int, rng: Random) -> int:
    return min(size, 1 << rng.randrange(1, 18), rng.randrange(1, 1 << 18))


def _flip(data: bytearray, rng: Random, others: Sequence[bytes]) -> bytearray:
    del others
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        at = _place(len(data), rng)
        if at < len(data):
            data[at] ^= 1 << rng.randrange(8)
    return data


def _overwrite(data: bytearray, rng: Random, others: Sequence[bytes]) -> bytearray:
    del others
    at = _place(len(data), rng)
    run = min(_length(len(data), rng), len(data) - at)
    data[at : at + run] = (
        rng.randbytes(run) if rng.random() < 0.5 else bytes([rng.choice((0, 255, 32))]) * run
    )
    return data


def _truncate(data: bytearray, rng: Random, others: Sequence[bytes]) -> bytearray:
    del others
    return data[: _place(len(data), rng)]


def _duplicate(data: bytearray, rng: Random, others: Sequence[bytes]) -> bytearray:
    del others
    at, to = _place(len(data), rng), _place(len(data), rng)
    block = data[at : at + _length(len(data), rng)]
    return data[:to] + block * rng.choice((1, 1, 2, 16)) + data[to:]


def _delete(data: bytearray, rng: Random, others: Sequence[bytes]) -> bytearray:
    del others
    at = _place(len(data), rng)
    del data[at : at + _length(len(data), rng)]
    return data


def _swap(data: bytearray, rng: Random, others: Sequence[bytes]) -> bytearray:
    del others
    a, b = sorted((_place(len(data), rng), _place(len(data), rng)))
    run = min(_length(len(data), rng), b - a)
    data[a : a + run], data[b : b + run] = data[b : b + run], data[a : a + run]
    return data


def _splice(data: bytearray, rng: Random, others: Sequence[bytes]) -> bytearray:
    other = rng.choice(others) if others else b""
    at, start = _place(len(data), rng), _place(len(other), rng)
    if rng.random() < 0.5:
        return data[:at] + other[start:]
    return data[:at] + other[start : start + _length(len(other), rng)] + data[at:]


def _extreme(data: bytearray, rng: Random, others: Sequence[bytes]) -> bytearray:
    """A field of 1 to 8 bytes, of either order, becomes an extreme value, or a little more or less."""
    del others
    for _ in range(rng.choice((1, 1, 2, 4))):
        width = rng.choice((1, 2, 4, 4, 4, 8, 8))
        at = _place(len(data), rng)
        if at + width > len(data):
            continue
        order = rng.choice(("little", "little", "big"))
        old = int.from_bytes(data[at : at + width], order)
        value = rng.choice((*EXTREMES, old + 1, old - 1, old * 2, old + rng.randrange(64), len(data) - at))
        data[at : at + width] = (value % (1 << 8 * width)).to_bytes(width, order)
    return data


def _word(text: str, rng: Random) -> str:
    """One token replaced by a hostile one, or by another of the text."""
    tokens = _TOKEN.findall(text) or [""]
    words = [k for k, token in enumerate(tokens) if not token.isspace()] or [0]
    new = rng.choice(HOSTILE_WORDS) if rng.random() < 0.7 else rng.choice(tokens)
    tokens[rng.choice(words)] = new
    return "".join(tokens)


def _number(text: str, rng: Random) -> str:
    """One number replaced by an extreme one."""
    found = list(re.finditer(r"-?\d+(\.\d+)?", text))
    if not found:
        return _word(text, rng)
    match = rng.choice(found)
    value = rng.choice((*EXTREMES, -1, -(1 << 31), -(1 << 63), 1e308, 1e-320, 0.1, 10**30))
    return f"{text[: match.start()]}{value}{text[match.end() :]}"


def _lines(text: str, rng: Random) -> str:
    """A line left out, said again, or moved."""
    lines = text.splitlines(keepends=True) or [""]
    taken = lines[(k := rng.randrange(len(lines)))]
    if rng.random() < 0.6:
        del lines[k]
    if rng.random() < 0.6:
        at = rng.randrange(len(lines) + 1)
        lines[at:at] = [taken] * rng.choice((1, 1, 2, 50))
    return "".join(lines)


def _nest(text: str, rng: Random) -> str:
    """A bracket repeated until a recursive reader has no stack left."""
    at = rng.randrange(len(text) + 1)
    return text[:at] + rng.choice(NESTED) * rng.choice((40, 1500, 30_000)) + text[at:]


def _bomb(text: str, rng: Random) -> str:
    """YAML's references to references: a few lines that mean a billion words."""
    lines = ["a0: &a0 [x,x,x,x,x,x,x,x,x]"]
    lines += [f"a{k}: &a{k} [{','.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 10)]
    at = rng.choice((0, len(text)))
    return f"{text[:at]}\n" + "\n".join(lines) + f"\n{text[at:]}"


_OF_BYTES: tuple[Callable[[bytearray, Random, Sequence[bytes]], bytearray], ...] = (
    *(_flip, _flip, _overwrite, _truncate, _duplicate, _delete, _swap, _splice),
    *(_extreme, _extreme, _extreme, _extreme),
)
_OF_TEXT: tuple[Callable[[str, Random], str], ...] = (
    _word,
    _word,
    _word,
    _number,
    _number,
    _lines,
    _nest,
    _bomb,
)
