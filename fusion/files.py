"""Writing a file so that it is whole or not there at all."""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path

from fusion.errors import OutputError

NO_SPACE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


def replace_file(path: Path, data: bytes, temporary: Path | None = None) -> None:
    """Write `data` under a temporary name, then rename it to `path`; missing folders are made.

    `temporary` must lie on the same file system; by default it lies beside `path`. Raises
    `OutputError` and leaves whatever was at `path` as it was.
    """
    temporary = temporary or path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        try:
            _write(temporary, data)
            os.replace(temporary, path)  # noqa: PTH105 - Path.replace costs half as much again
        except FileNotFoundError:
            path.parent.mkdir(parents=True, exist_ok=True)
            _write(temporary, data)
            os.replace(temporary, path)  # noqa: PTH105
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise output_error(error, path) from None


def _write(path: Path, data: bytes) -> None:
    with open(path, "wb", buffering=0) as file:  # noqa: PTH123
        if file.write(data) != len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def output_error(error: OSError, path: Path) -> OutputError:
    """What an `OSError` of a write means to the user."""
    hint = "free some space and run the same command again: finished frames are kept"
    where = error.filename2 or error.filename or path
    full = error.errno in NO_SPACE
    return OutputError(
        f"cannot be written: {error.strerror or error}", where=where, hint=hint if full else ""
    )
