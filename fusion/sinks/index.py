"""`frames.csv`: one row per frame, what became of it and how."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import dataclass, fields
from operator import attrgetter
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar

from fusion.errors import FrameError, InputError
from fusion.frames import FusedFrame


class IndexRow(Protocol):
    """A frozen dataclass of strings: a row of an index, its fields the columns."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def stem(self) -> str: ...

    @property
    def done(self) -> bool:
        """Whether there is a frame: else its reason says why not."""
        ...


RowT = TypeVar("RowT", bound=IndexRow)


@dataclass(frozen=True, slots=True)
class Row:
    """One pair. `status` is ``fused`` or ``skipped`` (then `reason` says why and the rest is empty).

    Stamps and `dt_ns` are integer nanoseconds, windows are thermal counts, clipped and coverage are
    shares [0, 1], `size` and `mask_size` are the lengths of the files in bytes.
    """

    stem: str
    fir_stem: str
    status: str
    rgb_stamp_ns: str = ""
    fir_stamp_ns: str = ""
    dt_ns: str = ""
    window_lo: str = ""
    window_hi: str = ""
    clipped_below: str = ""
    clipped_above: str = ""
    coverage: str = ""
    size: str = ""
    mask_size: str = ""
    flags: str = ""
    reason: str = ""

    @property
    def done(self) -> bool:
        return self.status == "fused"

    @classmethod
    def fused(cls, frame: FusedFrame, fir_stem: str, size: int = 0, mask_size: int | None = None) -> Row:
        rgb_ns, fir_ns = frame.rgb_stamp_ns, frame.fir_stamp_ns
        return cls(
            frame.stem,
            fir_stem,
            "fused",
            "" if rgb_ns is None else str(rgb_ns),
            "" if fir_ns is None else str(fir_ns),
            "" if rgb_ns is None or fir_ns is None else str(fir_ns - rgb_ns),
            f"{frame.window.lo:.9g}",
            f"{frame.window.hi:.9g}",
            f"{frame.clipped_below:.6f}",
            f"{frame.clipped_above:.6f}",
            f"{frame.coverage:.6f}",
            str(size),
            "" if mask_size is None else str(mask_size),
            ";".join(frame.flags),
        )

    @classmethod
    def skipped(cls, stem: str, fir_stem: str, error: FrameError) -> Row:
        return cls(stem, fir_stem, "skipped", reason=error.what)


def columns_of(kind: type[IndexRow]) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind))


def to_csv(rows: Iterable[RowT], kind: type[RowT], header: bool = True) -> str:
    columns = columns_of(kind)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    if header:
        writer.writerow(columns)
    writer.writerows(map(attrgetter(*columns), rows))  # `astuple` would copy every value deeply
    return text.getvalue()


def read_rows(path: Path, kind: type[RowT], *, header: bool = True) -> list[RowT]:
    """The whole rows of a CSV. A last line that a killed run left half written does not count.

    Raises `InputError` where it is no CSV.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="surrogateescape")
    except FileNotFoundError:
        return []
    whole = text[: text.rfind("\n") + 1]
    try:
        cells = list(csv.reader(io.StringIO(whole, newline="")))
    except csv.Error as error:
        hint = "it is damaged: delete it, or choose another place for the output"
        raise InputError(f"is no index: {error}", where=path, hint=hint) from None
    width = len(columns_of(kind))
    return [kind(*row) for row in cells[1 if header else 0 :] if len(row) == width]
