"""Where the bytes of a recording come from: local files as they are, URLs through fsspec, copies where a
format needs a file; and what a reader notes down when bytes are damaged."""

from __future__ import annotations

import io
import os
import shutil
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, overload

from fusion.errors import InputError

MAX_FAULTS = 200  # lines; more are counted in the last one


class DamagedError(Exception):
    """A piece of a recording that cannot be read; its text says why. Becomes a line of `faults`."""


class Faults(Sequence[str]):
    """The lines of `Recording.faults`: each once, in the order found, from any thread."""

    def __init__(self) -> None:
        self._lines: dict[str, None] = {}
        self._more: set[int] = set()
        self._lock = threading.Lock()

    def add(self, line: str) -> None:
        text = " ".join(line.split())
        with self._lock:
            if text not in self._lines:
                if len(self._lines) < MAX_FAULTS:
                    self._lines[text] = None
                elif len(self._more) < 10**6:
                    self._more.add(hash(text))

    def lines(self) -> list[str]:
        with self._lock:
            more = [f"and {len(self._more)} more faults like these"] if self._more else []
            return [*self._lines, *more]

    def __len__(self) -> int:
        return len(self.lines())

    @overload
    def __getitem__(self, index: int) -> str: ...
    @overload
    def __getitem__(self, index: slice) -> list[str]: ...
    def __getitem__(self, index: int | slice) -> str | list[str]:
        return self.lines()[index]

    def __iter__(self) -> Iterator[str]:
        return iter(self.lines())


def is_url(path: str) -> bool:
    """Whether fsspec is asked for it."""
    return "://" in path


def open_bytes(path: str) -> BinaryIO:
    """A seekable file of its own for every call, so that threads never share a position.

    Raises `InputError` where it cannot be opened: not there, no permission, no package for the protocol.
    """
    try:
        if not is_url(path):
            return open(path, "rb")  # noqa: PTH123 - the caller closes it
        file = filesystem(path)[0].open(path, "rb")
    except Exception as error:  # fsspec's packages raise what they like
        raise unreadable(path, error) from error
    if isinstance(file, io.BytesIO):  # fsspec's memory hands out one shared file: take its bytes, uncopied
        return io.BytesIO(file.getvalue())
    return file  # type: ignore[return-value]


def filesystem(url: str) -> tuple[Any, str]:
    """fsspec's file system of a URL, and the path inside it."""
    from fsspec.core import url_to_fs

    return url_to_fs(url)


def unreadable(path: str, error: Exception) -> InputError:
    """What an error of opening or reading means to the user."""
    if isinstance(error, FileNotFoundError):
        return InputError("no such file or folder", where=path)
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return InputError(f"cannot be read: {reason}", where=path)


def byte_size(file: BinaryIO) -> int:
    return file.seek(0, os.SEEK_END)


def read_at(file: BinaryIO, offset: int, count: int) -> bytes:
    """Exactly `count` bytes; the caller has checked them against the size of the file.

    Raises `DamagedError` where the file ends before; `InputError` where reading fails, as networks and disks
    do: what could be there must not be taken for lost.
    """
    try:
        file.seek(offset)
        data = file.read(count)
        while len(data) < count and (more := file.read(count - len(data))):
            data += more
    except Exception as error:  # fsspec's packages raise what they like
        where = getattr(file, "name", "") or getattr(file, "path", "")
        raise InputError(f"byte {offset} cannot be read: {error}", where=where) from error
    if len(data) < count:
        raise DamagedError(f"ends at byte {offset + len(data)}, {count - len(data)} bytes too early")
    return data


def first_bytes(path: str, count: int = 16) -> bytes:
    """The beginning of a file; empty for folders and for what cannot be read."""
    try:
        if not is_url(path) and not Path(path).is_file():
            return b""
        with open_bytes(path) as file:
            return file.read(count)
    except (InputError, OSError, ValueError):
        return b""


def exists(path: str) -> bool:
    if not is_url(path):
        return Path(path).exists()
    try:
        fs, inside = filesystem(path)
        return bool(fs.exists(inside))
    except Exception as error:  # fsspec's packages raise what they like
        raise unreadable(path, error) from error


def names_in(folder: str) -> list[str]:
    """The names of the files in a folder, sorted; empty where it is none."""
    try:
        if not is_url(folder):
            return sorted(entry.name for entry in os.scandir(folder) if entry.is_file())
        fs, inside = filesystem(folder)
        rows = fs.ls(inside, detail=True) if fs.isdir(inside) else []
        return sorted(row["name"].rstrip("/").rpartition("/")[2] for row in rows if row["type"] == "file")
    except Exception:  # fsspec's packages raise what they like; opening says more
        return []


def inside(folder: str, name: str) -> str:
    """`name` in `folder`, whatever path a file claims for it: only its last part counts."""
    last = name.replace("\\", "/").rstrip("/").rpartition("/")[2]
    if last in {"", ".", ".."} or "\0" in last:
        raise InputError(f"names a file {name!r}, which cannot be one", where=folder)
    return f"{folder.rstrip('/')}/{last}"


class Workspace:
    """A temporary folder that is made when first needed and removed by `close`."""

    def __init__(self) -> None:
        self._folder: TemporaryDirectory[str] | None = None
        self._lock = threading.Lock()
        self._made = 0

    def path(self, name: str) -> Path:
        """A path for a new file of that name, in a folder of its own."""
        with self._lock:
            if self._folder is None:
                self._folder = TemporaryDirectory(prefix="fusion-")
            self._made += 1
            folder = Path(self._folder.name, str(self._made))
        folder.mkdir()
        return folder / name

    def copy(self, path: str) -> Path:
        """A local copy of a file or URL."""
        target = self.path(path.rpartition("/")[2])
        with self.writing(path, target) as (source, file):
            shutil.copyfileobj(source, file, 1 << 20)
        return target

    @contextmanager
    def writing(self, path: str, target: Path) -> Iterator[tuple[BinaryIO, BinaryIO]]:
        """Both files open; what goes wrong is an `InputError` that says where the copy was to go."""
        with open_bytes(path) as source:
            try:
                with target.open("wb") as file:
                    yield source, file
            except OSError as error:
                hint = "the environment variable TMPDIR says where copies go"
                raise InputError(
                    f"cannot be copied to {target.parent}: {error}", where=path, hint=hint
                ) from error

    def close(self) -> None:
        with self._lock:
            folder, self._folder = self._folder, None
        if folder is not None:
            folder.cleanup()


def stem(path: str) -> str:
    """The last part of a path without the suffixes of recordings."""
    name = path.rstrip("/").rpartition("/")[2]
    for suffix in (".active", ".zstd", ".zst", ".lz4", ".bag", ".db3", ".mcap"):
        name = name[: -len(suffix)] if name.lower().endswith(suffix) and len(name) > len(suffix) else name
    return name
