"""Where a run's files go: a folder, memory, or an object store, all by names below one root.

Folders are ours: a rename is what makes a file whole or not there. Everything else is fsspec's, whose object
stores put an object whole or not at all; credentials and endpoints are its own configuration (``AWS_…``,
``FSSPEC_S3_…``).
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, Protocol

from fusion.errors import FusionError, InputError, OutputError, UsageError
from fusion.files import output_error, replace_file

try:
    import fcntl
except ImportError:  # not on Windows: there, two runs into one folder are not kept apart
    fcntl = None

# No two processes may share a temporary name, not even on two machines whose process ids are the same.
_TEMPORARY = re.compile(r"\.[0-9a-f]{32}\.tmp")
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")
_DRIVE = re.compile(r"[A-Za-z]:")


class Storage(Protocol):
    """Names are relative posix paths that cannot leave the root. Picklable as its URL; any thread may use it.

    A file is whole or not there: written under a temporary name and renamed, or put as one object.
    Raises `OutputError` where something cannot be written, `InputError` where it cannot be read.
    """

    url: str

    def write(self, name: str, data: bytes) -> None: ...

    def read(self, name: str) -> bytes: ...

    def size(self, name: str) -> int | None:
        """Bytes, None where there is no such file."""
        ...

    def names(self, folder: str) -> Iterable[str]:
        """The names of all whole files below `folder` ("" is the root), at any depth, sorted."""
        ...

    def remove(self, name: str) -> None:
        """What is not there is removed already."""
        ...


class RunStorage(Storage, Protocol):
    """What the process that leads a run needs besides."""

    shared: bool  # other processes see it under its URL (memory is each process's own)

    def sizes(self, folder: str) -> dict[str, int]:
        """Name -> bytes of all whole files below `folder`, by one listing, sorted by name."""
        ...

    def clean(self) -> int:
        """Remove what killed runs left half written; how many files. Only while no other run is under way."""
        ...

    def lock(self) -> AbstractContextManager[None]:
        """Keep other runs out meanwhile; raises `OutputError` when one is here.

        Object stores have no lock that goes away with a killed holder: there, two runs of one command do the
        same work twice and put the same bytes under the same names.
        """
        ...


def open_storage(url: str | Path) -> RunStorage:
    """The storage at a path or an fsspec URL (``s3://bucket/run``, ``memory://run``, ``file:///data/run``).

    Makes nothing yet. Raises `UsageError` for a URL that cannot be one, or whose package is not installed.
    """
    text = str(url)
    scheme, mark, rest = text.partition("://")
    if not mark:
        return LocalFolder(text)
    if scheme in ("file", "local"):
        return LocalFolder(rest)
    return FsspecStorage(text)


def checked_name(name: str) -> str:
    """`name`, if it stays below the root on every kind of storage. Raises `OutputError`."""
    parts = name.split("/")
    found = (
        ("leads out of the output", ".." in parts or name.startswith("/") or bool(_DRIVE.match(name))),
        ("has an empty part", "" in parts or "." in parts),
        ("has a control character or a backslash", bool(_CONTROL.search(name)) or "\\" in name),
        ("is a temporary file's", bool(_TEMPORARY.fullmatch(parts[-1]))),
        ("is no text", not _encodable(name)),
    )
    for what, true in found:
        if true:
            raise OutputError(f"the name {name!r} {what}", hint="rename the input it comes from")
    return name


def _encodable(name: str) -> bool:
    try:
        os.fsencode(name)
    except UnicodeEncodeError:
        return False
    return True


class LocalFolder:
    """A folder, on this machine or on a disk that machines share. `url` is its absolute path."""

    shared = True

    def __init__(self, path: str) -> None:
        if not path or "\x00" in path:
            raise UsageError("names no folder", where=repr(path))
        self.url = str(Path(path).absolute())
        self._root = Path(self.url)

    def __reduce__(self) -> tuple[Any, ...]:
        return LocalFolder, (self.url,)

    def _path(self, name: str) -> Path:
        return self._root / checked_name(name)

    def write(self, name: str, data: bytes) -> None:
        path = self._path(name)
        replace_file(path, data, path.with_name(f".{os.urandom(16).hex()}.tmp"))

    def read(self, name: str) -> bytes:
        path = self._path(name)
        try:
            return path.read_bytes()
        except OSError as error:
            raise _cannot_read(error, path) from None

    def size(self, name: str) -> int | None:
        path = self._path(name)
        try:
            there = path.stat()
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise _cannot_read(error, path) from None
        return there.st_size if stat.S_ISREG(there.st_mode) else None

    def names(self, folder: str) -> Iterable[str]:
        return list(self.sizes(folder))

    def sizes(self, folder: str) -> dict[str, int]:
        found = {
            self._name(entry): entry.stat().st_size
            for entry in self._files(folder)
            if not _TEMPORARY.fullmatch(entry.name)
        }
        return dict(sorted(found.items()))

    def remove(self, name: str) -> None:
        path = self._path(name)
        try:
            path.unlink(missing_ok=True)
        except NotADirectoryError:
            return
        except OSError as error:
            raise output_error(error, path) from None

    def clean(self) -> int:
        left = [Path(entry.path) for entry in self._files("") if _TEMPORARY.fullmatch(entry.name)]
        try:
            for path in left:
                path.unlink(missing_ok=True)
        except OSError as error:
            raise output_error(error, self._root) from None
        return len(left)

    @contextmanager
    def lock(self) -> Iterator[None]:
        try:
            self._root.mkdir(parents=True, exist_ok=True)
            held = os.open(self._root, os.O_RDONLY)
        except FileExistsError:
            raise OutputError("is a file, not a folder", where=self.url, hint="choose another -o") from None
        except OSError as error:
            raise output_error(error, self._root) from None
        try:
            _hold(held, self.url)
            yield
        finally:
            os.close(held)

    def _name(self, entry: os.DirEntry[str]) -> str:
        return Path(entry.path).relative_to(self._root).as_posix()

    def _files(self, folder: str) -> Iterator[os.DirEntry[str]]:
        """All regular files below `folder`; links to folders are followed, each folder once."""
        waiting = [self._path(folder) if folder else self._root]
        seen: set[tuple[int, int]] = set()
        while waiting:
            path = waiting.pop()
            try:
                here = path.stat()
                entries = list(os.scandir(path)) if (here.st_dev, here.st_ino) not in seen else []
            except (FileNotFoundError, NotADirectoryError):
                continue
            except OSError as error:
                raise _cannot_read(error, path) from None
            seen.add((here.st_dev, here.st_ino))
            waiting += [Path(entry.path) for entry in entries if entry.is_dir()]
            yield from (entry for entry in entries if entry.is_file())


def _hold(descriptor: int, url: str) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise OutputError("another run is writing here", where=url, hint="wait for it") from None
    except OSError:  # some network disks have no locks: there it is as with an object store
        return


def _cannot_read(error: OSError, path: Path) -> InputError:
    return InputError(f"cannot be read: {error.strerror or error}", where=path)


class FsspecStorage:
    """A store that fsspec speaks to. Listings are never cached: another machine may have written since."""

    def __init__(self, url: str) -> None:
        if "::" in url:
            raise UsageError("is a chain of stores; name one", where=url)
        self.url = url.rstrip("/")
        self.shared = not url.startswith("memory:")
        self._fs, root = _open_fsspec(url)
        self._root = root.rstrip("/")
        if not self._root:
            raise UsageError("names no place in the store", where=url, hint="such as s3://bucket/run")

    def __reduce__(self) -> tuple[Any, ...]:
        return FsspecStorage, (self.url,)

    def write(self, name: str, data: bytes) -> None:
        with self._told(OutputError, name, "cannot be written"):
            self._fs.pipe_file(self._path(name), data)

    def read(self, name: str) -> bytes:
        with self._told(InputError, name, "cannot be read"):
            return self._fs.cat_file(self._path(name))

    def size(self, name: str) -> int | None:
        with self._told(InputError, name, "cannot be read"):
            try:
                there = self._fs.info(self._path(name))
            except FileNotFoundError:
                return None
            return int(there["size"]) if there["type"] == "file" else None

    def names(self, folder: str) -> Iterable[str]:
        return list(self.sizes(folder))

    def sizes(self, folder: str) -> dict[str, int]:
        with self._told(InputError, folder, "cannot be listed"):
            place = self._path(folder) if folder else self._root
            try:
                found = self._fs.find(place, detail=True)
            except FileNotFoundError:
                return {}
            start = len(self._root) + 1
            return {
                path[start:]: int(info["size"])
                for path, info in sorted(found.items())
                if path.startswith(f"{place}/") and info["type"] == "file"
            }

    def remove(self, name: str) -> None:
        with self._told(OutputError, name, "cannot be removed"), suppress(FileNotFoundError):
            self._fs.rm_file(self._path(name))

    def clean(self) -> int:
        return 0  # an object is not there until it is whole

    def lock(self) -> AbstractContextManager[None]:
        return nullcontext()

    def _path(self, name: str) -> str:
        checked_name(name).encode()
        return f"{self._root}/{name}"

    @contextmanager
    def _told(self, kind: type[FusionError], name: str, what: str) -> Iterator[None]:
        """Stores fail in their own ways, most of them no `OSError`: all become one of ours."""
        try:
            yield
        except FusionError:
            raise
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            raise kind(f"{what}: {reason}", where=f"{self.url}/{name}") from error


def _open_fsspec(url: str) -> tuple[Any, str]:
    from fsspec.core import url_to_fs  # here: a folder needs none of it

    try:
        return url_to_fs(url, use_listings_cache=False)
    except ImportError as error:
        raise UsageError(str(error), where=url) from None
    except Exception as error:
        raise UsageError(f"is no place to store: {error}", where=url) from None
