"""What says that a chunk is done: a record in the output, written after every file that it names.

    OUT/chunks/campaign.json   whose chunks these are: workers refuse an output that is not the command's
    OUT/chunks/000000.json     one a finished chunk: its index rows, its files with their sizes, what was lost

A record counts when it is of this run and the files are there with their sizes, by one listing of the output.
Rows stay in the records until the index is put together, so that they do not fill the memory of a campaign.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from fusion.chunks import FOLDER, Chunk, Done, Work, record_name
from fusion.errors import InputError, OutputError
from fusion.storage import RunStorage, Storage, checked_name

RECORD_FORMAT = "fusion-chunk/1"
CAMPAIGN_FORMAT = "fusion-campaign/1"
CAMPAIGN = f"{FOLDER}/campaign.json"
MAX_RECORD_BYTES = 1 << 28
READERS = 16  # records read at once: an object store answers each only after some time


@dataclass(frozen=True, slots=True)
class Committed:
    """A chunk whose record is written, without what only the record needs to hold.

    `rows` counts the rows of the index, `size_bytes` is of all its files together; `lost` counts by role and
    reason; `seconds` is the time it took.
    """

    chunk: Chunk
    rows: int
    size_bytes: int
    lost: Mapping[str, int]
    seconds: float


@dataclass(frozen=True, slots=True)
class Finished:
    """The chunks that need not be done, by index, and how many records there did not count, by reason."""

    done: dict[int, Committed]
    again: Mapping[str, int] = field(default_factory=dict)


def do_chunk(work: Work, chunk: Chunk, out: Storage, tick: Callable[[], None]) -> Committed:
    """Do a chunk and commit it. Raises what `Work.do` raises, and `OutputError`."""
    done = work.do(chunk, out, tick)
    if done.chunk != chunk:
        raise ValueError(f"asked for chunk {chunk.name}, the work did {done.chunk.name}")
    write_record(out, work.run_id, done)
    return _committed(done)


def write_record(out: Storage, run_id: str, done: Done) -> None:
    """Commit a chunk: everything that it names must have been written. Raises `OutputError`."""
    chunk = done.chunk
    record = {
        "format": RECORD_FORMAT,
        "run_id": run_id,
        "chunk": [chunk.index, chunk.begin, chunk.end, chunk.frames],
        "seconds": round(done.seconds, 3),
        "lost": dict(done.lost),
        "files": dict(done.files),
        "rows": [list(row) for row in done.rows],
    }
    if _done(record, chunk) is None:  # it would not be believed when it is read
        raise ValueError(f"chunk {chunk.name}: rows must be of str, counts and sizes ints from 0")
    data = _to_json(record)
    if len(data) > MAX_RECORD_BYTES:
        raise OutputError(
            f"chunk {chunk.name} has {len(done.rows)} rows, more than a record holds",
            hint="make chunks shorter",
        )
    out.write(record_name(chunk), data)


def read_record(data: bytes, run_id: str, chunk: Chunk) -> Done | str:
    """The record of `chunk`, or why it does not count: ``another run`` or ``damaged record``."""
    try:
        record = json.loads(data)
        if record["format"] != RECORD_FORMAT or not isinstance(record["run_id"], str):
            return "damaged record"
        if record["run_id"] != run_id:
            return "another run"
        return _done(record, chunk) or "damaged record"
    except (ValueError, KeyError, TypeError, RecursionError):
        return "damaged record"


def finished(out: RunStorage, work: Work) -> Finished:
    """What need not be done again: records of this run whose files are all there with their sizes."""
    there = out.sizes("")
    chunks = [chunk for chunk in work.chunks if record_name(chunk) in there]
    found: dict[int, Committed] = {}
    again: Counter[str] = Counter()
    for chunk, data in _read_all(out, chunks, there):
        done = read_record(data, work.run_id, chunk)
        reason = done if isinstance(done, str) else _what_is_missing(done, there)
        if isinstance(done, str) or reason:
            again[reason] += 1
        else:
            found[chunk.index] = _committed(done)
    return Finished(found, again)


def rows_of(out: Storage, work: Work, done: Iterable[int]) -> Iterator[Sequence[str]]:
    """The rows of the chunks `done` (indices), in the order of the chunks, read from their records.

    Raises `InputError` when a record that counted is gone meanwhile.
    """
    wanted = set(done)
    chunks = [chunk for chunk in work.chunks if chunk.index in wanted]
    for chunk, data in _read_all(out, chunks):
        record = read_record(data, work.run_id, chunk)
        if isinstance(record, str):
            hint = "the same command does that chunk again"
            raise InputError(
                f"{record}, though it was whole a moment ago", where=record_name(chunk), hint=hint
            )
        yield from record.rows


# --- whose output it is


def claim(out: RunStorage, run_id: str) -> None:
    """Say in the output whose campaign it is. Raises `OutputError` when it holds files of another one."""
    owner = owner_of(out)
    if owner == run_id:
        return
    if owner is not None and any("/" in name and name != CAMPAIGN for name in out.sizes("")):
        raise OutputError(
            "holds another run's chunks",
            where=out.url,
            hint="choose another -o, or pass --overwrite to replace them",
        )
    out.write(CAMPAIGN, _to_json({"format": CAMPAIGN_FORMAT, "run_id": run_id}))


def owner_of(out: Storage) -> str | None:
    """The run whose chunks are in `out`; "" when that cannot be read, None when there are none."""
    if out.size(CAMPAIGN) is None:
        return None
    try:
        owner = json.loads(out.read(CAMPAIGN))
        return owner["run_id"] if owner["format"] == CAMPAIGN_FORMAT else ""
    except (ValueError, KeyError, TypeError, RecursionError):
        return ""


def discard(out: RunStorage) -> int:
    """Remove all chunks there, of whatever run: the files that records name, the records; how many files."""
    there = out.sizes(FOLDER)
    names = [name for name in there if name != CAMPAIGN]
    removed = 0
    for name, data in _bytes_of(out, names, there):
        for file in [*_files_in(data), name]:
            out.remove(file)
            removed += 1
    out.remove(CAMPAIGN)  # last: a discard that was killed is taken up again
    return removed


# --- inside


def _read_all(
    out: Storage, chunks: Sequence[Chunk], there: Mapping[str, int] | None = None
) -> Iterator[tuple[Chunk, bytes]]:
    data = _bytes_of(out, [record_name(chunk) for chunk in chunks], there or {})
    yield from ((chunk, found) for chunk, (_, found) in zip(chunks, data, strict=True))


def _bytes_of(out: Storage, names: Sequence[str], there: Mapping[str, int]) -> Iterator[tuple[str, bytes]]:
    """The records under `names`, in order, a few read ahead; too large to be one: no bytes."""

    def read(name: str) -> bytes:
        return out.read(name) if there.get(name, 0) <= MAX_RECORD_BYTES else b""

    with ThreadPoolExecutor(READERS) as pool:
        for begin in range(0, len(names), READERS):
            some = names[begin : begin + READERS]
            yield from zip(some, pool.map(read, some), strict=True)


def _committed(done: Done) -> Committed:
    return Committed(done.chunk, len(done.rows), sum(done.files.values()), dict(done.lost), done.seconds)


def _what_is_missing(done: Done, there: Mapping[str, int]) -> str:
    for name, size in done.files.items():
        if there.get(name) != size:
            return "file of another size" if name in there else "file is gone"
    return ""


def _done(record: Mapping[str, Any], chunk: Chunk) -> Done | None:
    """None where a value is not what a record holds."""
    rows, files, lost, seconds = (record[key] for key in ("rows", "files", "lost", "seconds"))
    sound = (
        record["chunk"] == [chunk.index, chunk.begin, chunk.end, chunk.frames]
        and _counts(files)
        and _counts(lost)
        and isinstance(seconds, int | float)
        and math.isfinite(seconds)
        and isinstance(rows, list)
        and all(isinstance(row, list) and all(isinstance(cell, str) for cell in row) for row in rows)
    )
    return Done(chunk, rows, files, lost, float(seconds)) if sound else None


def _counts(value: object) -> bool:
    return isinstance(value, dict) and all(type(count) is int and count >= 0 for count in value.values())


def _files_in(data: bytes) -> list[str]:
    """The files that a record of any run names; none where it is damaged, or a name leads elsewhere."""
    try:
        files = json.loads(data)["files"]
        return [checked_name(name) for name in files] if _counts(files) else []
    except (ValueError, KeyError, TypeError, RecursionError, OutputError):
        return []


def _to_json(value: Mapping[str, Any]) -> bytes:
    return (json.dumps(value, separators=(",", ":")) + "\n").encode()
