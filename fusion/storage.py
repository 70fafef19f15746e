"""Where a run's files go: a folder, memory, or an object store, all by names below one root."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol


class Storage(Protocol):
    """Names are relative posix paths that cannot leave the root. Picklable as its URL; safe from several threads.

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
        """The names of all whole files below `folder`, at any depth, sorted."""
        ...

    def remove(self, name: str) -> None: ...


def open_storage(url: str) -> Storage:
    """The storage at a path or an fsspec URL (``s3://bucket/run``, ``memory://run``)."""
    raise NotImplementedError
