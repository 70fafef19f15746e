"""A folder that one run fills: atomic, resumable, the same bytes every time. What it holds is its subclass's.

    OUT/frames.csv   one row per frame
    OUT/run.toml     effective configuration, versions, hashes: what makes this run what it is

While a run is under way `OUT/.partial` holds temporary files and a journal of finished rows; it is
gone when the run is complete. A finished frame is one whose row is in the journal or the index, whose
files are there with the sizes in the row and are no older than their inputs.
"""

from __future__ import annotations

import os
import shutil
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import IO, Any, Generic, Self, TypeVar

import tomlkit
from tomlkit.exceptions import TOMLKitError

from fusion.errors import OutputError
from fusion.files import output_error, replace_file
from fusion.sinks.index import IndexRow, read_rows, to_csv

try:
    import fcntl
except ImportError:  # not on Windows: there, two runs into one folder are not kept apart
    fcntl = None

RUN_FORMAT = "fusion-run/1"
RowT = TypeVar("RowT", bound=IndexRow)


class RunFolder(ABC, Generic[RowT]):
    """The folder `out` of a run whose index has rows of the kind `row_kind`.

    `run` is what makes this run what it is (nested, TOML-able); a folder that holds another run's
    frames is refused with the first difference named, unless `overwrite`, which deletes the frames that the
    index there lists and nothing else.
    """

    row_kind: type[RowT]
    main_folder: str  # where every frame has a file

    def __init__(
        self, out: str | Path, run: Mapping[str, Any] | None = None, *, overwrite: bool = False
    ) -> None:
        self.out = Path(out)
        self._run = {"format": RUN_FORMAT, **(run or {})}
        self._overwrite = overwrite
        self._partial = self.out / ".partial"
        self._journal: IO[str] | None = None
        self._done: dict[str, RowT] = {}
        self._rows: list[RowT] = []
        self._lock_fd: int | None = None
        self._was_there = True

    @abstractmethod
    def files(self, row: RowT) -> Mapping[Path, int]:
        """The files that a finished row stands for, and their sizes in bytes."""

    @abstractmethod
    def paths(self, stem: str) -> Iterable[Path]:
        """All files that a frame of this name may have left, whatever its run's options were."""

    def __enter__(self) -> Self:
        try:
            self._open()
        except OSError as error:
            self._close()
            raise output_error(error, self.out) from None
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                self._complete()
            else:
                with suppress(OSError):  # the error that brought us here is the one to tell
                    self._withdraw()
        except OSError as error:
            raise output_error(error, self.out) from None
        finally:
            self._close()

    def expect(self, stems: Iterable[str]) -> None:
        """Refuse, before a frame is written, names that would fall onto one file on this disk."""
        main = self.out / self.main_folder
        main.mkdir(exist_ok=True)
        blind_to_case = main.with_name(main.name.upper()).exists()
        seen: dict[str, str] = {}
        for stem in stems:
            file = stem.casefold() if blind_to_case else stem
            if file in seen:
                raise OutputError(
                    f"{seen[file]!r} and {stem!r} would be one file: one would overwrite the other",
                    where=self.out,
                    hint="rename one of the images",
                )
            seen[file] = stem

    def finished(self, stem: str, changed_ns: int) -> RowT | None:
        row = self._done.get(stem)
        if row is None:
            return None
        with suppress(OSError, ValueError):
            for path, size in self.files(row).items():
                there = path.stat()
                if there.st_size != size or there.st_mtime_ns < changed_ns:
                    return None
            return row
        return None

    def record(self, row: RowT) -> None:
        if self._journal is None:
            raise OutputError("the sink is not open", where=self.out, hint="use it in a with block")
        self._rows.append(row)
        if not row.done and row.stem in self._done:
            self._unlink(row.stem)  # its inputs were good once: what is left of it is stale
        if row.done and self._done.get(row.stem) != row:
            try:
                self._journal.write(to_csv([row], self.row_kind, header=False))
                self._journal.flush()
            except OSError as error:
                raise output_error(error, self._partial) from None

    def write_file(self, name: str, data: bytes) -> Path:
        """Put one more file (a picture, a table) beside the index, by rename."""
        self._replace(self.out / name, data)
        return self.out / name

    # --- opening and closing

    def _open(self) -> None:
        if self.out.exists() and not self.out.is_dir():
            raise OutputError("is a file, not a folder", where=self.out, hint="choose another -o")
        self._was_there = self.out.exists()
        self.out.mkdir(parents=True, exist_ok=True)
        self._lock()
        journal, index = self._partial / "journal.csv", self.out / "frames.csv"
        rows = [*read_rows(index, self.row_kind), *read_rows(journal, self.row_kind, header=False)]
        if self._overwrite:
            self._delete(rows)
        else:
            self._refuse_another_run(rows)
            self._done = {row.stem: row for row in rows if row.done}
        self._partial.mkdir(exist_ok=True)
        for leftover in self._partial.glob("*.tmp"):
            leftover.unlink()
        self._replace(self.out / "run.toml", tomlkit.dumps(self._run).encode())
        kept = to_csv(self._done.values(), self.row_kind, header=False)
        self._replace(journal, kept.encode("utf-8", "surrogateescape"))
        self._journal = journal.open("a", encoding="utf-8", errors="surrogateescape", newline="")

    def _lock(self) -> None:
        if fcntl is None:
            return
        self._lock_fd = os.open(self.out, os.O_RDONLY)
        try:
            fcntl.flock(self._lock_fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError("another run is writing here", where=self.out, hint="wait for it") from None

    def _refuse_another_run(self, rows: list[RowT]) -> None:
        path, frames = self.out / "run.toml", any((self.out / self.main_folder).glob("*"))
        hint = "choose another -o, or pass --overwrite to replace that run's frames"
        if not path.exists():
            if frames or (self.out / "frames.csv").exists():
                raise OutputError(
                    "holds frames, but no run.toml that says whose they are", where=self.out, hint=hint
                )
            return
        try:
            before = tomlkit.parse(path.read_text(encoding="utf-8")).unwrap()
        except (ValueError, TOMLKitError) as error:
            raise OutputError(f"its run.toml cannot be read: {error}", where=self.out, hint=hint) from None
        if before.get("format") == RUN_FORMAT and not (frames or any(row.done for row in rows)):
            return  # it came to nothing: there is nothing to protect
        difference = first_difference(before, self._run)
        if difference:
            raise OutputError(f"holds another run ({difference})", where=self.out, hint=hint)

    def _delete(self, rows: list[RowT]) -> None:
        for row in rows:
            self._unlink(row.stem)
        for name in ("frames.csv", "run.toml", "unmatched.csv", "preview.png"):
            (self.out / name).unlink(missing_ok=True)
        shutil.rmtree(self._partial, ignore_errors=True)

    def _complete(self) -> None:
        index = to_csv(self._rows, self.row_kind)
        self._replace(self.out / "frames.csv", index.encode("utf-8", "surrogateescape"))
        if self._journal is not None:
            self._journal.close()
        shutil.rmtree(self._partial)

    def _withdraw(self) -> None:
        """After an error, if not one frame was made: leave nothing that would stand in the next run's way."""
        main = self.out / self.main_folder
        left = {path.name for path in self.out.iterdir()} - {"run.toml", ".partial", self.main_folder}
        if left or (main.exists() and any(main.iterdir())):
            return
        shutil.rmtree(self._partial, ignore_errors=True)
        (self.out / "run.toml").unlink(missing_ok=True)
        if main.exists():
            main.rmdir()
        if not self._was_there:
            self.out.rmdir()

    def _close(self) -> None:
        if self._journal is not None:
            with suppress(OSError):  # a full disk has been reported by the write that met it
                self._journal.close()
            self._journal = None
        if self._lock_fd is not None:
            os.close(self._lock_fd)
            self._lock_fd = None

    # --- files

    def _unlink(self, stem: str) -> None:
        for path in self.paths(stem):
            path.unlink(missing_ok=True)

    def _replace(self, path: Path, data: bytes) -> None:
        replace_file(path, data, self._partial / f"{threading.get_ident()}.tmp")


def first_difference(before: Any, now: Any, key: str = "") -> str | None:
    """The first key, in words, in which two nested settings differ; None where they agree."""
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for name in sorted({*before, *now}):
            inner = first_difference(before.get(name), now.get(name), f"{key}.{name}" if key else name)
            if inner:
                return inner
        return None
    if isinstance(before, list | tuple) and isinstance(now, list | tuple) and len(before) == len(now):
        for a, b in zip(before, now, strict=True):
            inner = first_difference(a, b, key)
            if inner:
                return inner
        return None
    return None if before == now else f"{key} was {_short(before)}, is {_short(now)}"


def _short(value: Any) -> str:
    text = "not there" if value is None else repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


def inside(stem: str) -> str:
    path = PurePosixPath(stem)
    if path.is_absolute() or ".." in path.parts or not path.parts:
        raise OutputError(f"the name {stem!r} leads out of the output folder")
    return stem
