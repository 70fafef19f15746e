"""What every sink of fused frames offers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from fusion.frames import FusedFrame
from fusion.sinks.index import Row


class Sink(Protocol):
    """Takes fused frames. `write` may be called from several threads; `record` in order, from one.

    A sink is a context manager: leaving it after an error keeps what was recorded, so that the same
    run can go on; leaving it normally completes the output.
    """

    def expect(self, stems: Iterable[str]) -> None:
        """Refuse names that this sink cannot keep apart. Raises `OutputError`."""
        ...

    def finished(self, stem: str, changed_ns: int) -> Row | None:
        """The row of a frame that is there already and no older than `changed_ns`, else None."""
        ...

    def write(self, frame: FusedFrame, fir_stem: str) -> Row:
        """Store one frame and return its row of the index. Raises `OutputError`."""
        ...

    def record(self, row: Row) -> None:
        """Enter a row, of a frame stored or skipped, into the index."""
        ...
