"""The unit of work: a chunk of a recording, done whole or not at all, the same on any machine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from fusion.storage import Storage

FOLDER = "chunks"  # of the records, in the output


@dataclass(frozen=True, slots=True)
class Chunk:
    """Part `index` of a recording: [`begin`, `end`) in log nanoseconds, or in numbers of a folder's pairs.

    `frames` is about how many frames it holds, for progress.
    """

    index: int
    begin: int
    end: int
    frames: int

    @property
    def name(self) -> str:
        return f"{self.index:06d}"


@dataclass(frozen=True, slots=True)
class Done:
    """What became of a chunk, as its record in the output says it: committed after everything it names.

    `rows` are the rows of the index; `files` the names and sizes of all files that the chunk wrote; `lost`
    counts by role and reason what belongs to no frame; `seconds` the time it took.
    """

    chunk: Chunk
    rows: Sequence[Sequence[str]]
    files: dict[str, int]
    lost: dict[str, int]
    seconds: float


def record_name(chunk: Chunk) -> str:
    """What a chunk's record is called: written after everything that it names."""
    return f"{FOLDER}/{chunk.name}.json"


class Work(Protocol):
    """A campaign: its chunks, and how to do one. Picklable, so that another machine may do it.

    `run_id` is what makes the run what it is (a hash of configuration, plan and inputs): records of another
    run do not count as done.
    """

    run_id: str
    chunks: Sequence[Chunk]

    def do(self, chunk: Chunk, out: Storage, tick: Callable[[], None]) -> Done:
        """Make the chunk's files in `out`; idempotent: the same bytes under the same names. `tick` is
        called once a frame. Raises `FusionError`. Does not commit: the executor writes the record when this
        has returned.
        """
        ...
