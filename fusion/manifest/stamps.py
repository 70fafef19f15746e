"""Times of files from a text file with one time a line, as KITTI's `timestamps.txt`: exact nanoseconds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path

from fusion.errors import InputError
from fusion.pairing import stamp_in_name

MAX_BYTES = 1 << 26
_DATE = re.compile(r"(\d{4}-\d\d-\d\d)[ T](\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?Z?")
_SECONDS = re.compile(r"[0-9]{1,10}(\.[0-9]{1,20})?([eE][+-]?[0-9]{1,2})?")
_NUMBER = re.compile(r"([0-9]+)[^0-9]*$")
_NS = 10**9


def read_stamps(path: str | Path) -> list[int]:
    """The time of every line in ns: a date with a fraction (UTC where no zone stands), a stamp of 13, 16 or
    19 digits, or seconds. Raises `InputError` that names the line that is none of them.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError("a file of time stamps over 64 MB is none", where=path)
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        raise InputError(f"the time stamps cannot be read: {error}", where=path) from None
    while lines and not lines[-1].strip():
        lines.pop()
    stamps = []
    for number, line in enumerate(lines, 1):
        stamp = _stamp(line.strip())
        if stamp is None:
            hint = "expected a date and time, 13, 16 or 19 digits, or seconds"
            raise InputError(f"'{line.strip()[:60]}' is no time", where=f"{path} line {number}", hint=hint)
        stamps.append(stamp)
    if not stamps:
        raise InputError("the file of time stamps is empty", where=path)
    return stamps


def _stamp(text: str) -> int | None:
    date = _DATE.fullmatch(text)
    if date is not None:
        try:
            moment = datetime.fromisoformat(f"{date[1]}T{date[2]}").replace(tzinfo=UTC)
        except ValueError:  # the 31st of February
            return None
        return int(moment.timestamp()) * _NS + int((date[3] or "").ljust(9, "0"))
    if re.fullmatch("[0-9]{13}|[0-9]{16}|[0-9]{19}", text):
        return stamp_in_name(text)
    if _SECONDS.fullmatch(text) is None:
        return None
    seconds = Decimal(text) * _NS
    return int(seconds.to_integral_value()) if seconds < 2**63 else None


class StampFiles:
    """Files of time stamps, each for the images below the folder that it lies in; the deepest folder wins.

    Line k belongs to the file whose last number is k, counted from 0, so that frames a set leaves out shift
    nothing; where names have numbers beyond the lines but the counts agree, the lines are in the files'
    order.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self._lines = {path.parent: read_stamps(path) for path in files}

    def of(self, files: Sequence[Path]) -> list[int | None]:
        """The time of each of `files` (in natural order), None where no line belongs to it."""
        groups: dict[Path | None, list[int]] = {}
        for number, file in enumerate(files):
            home = next((parent for parent in file.parents if parent in self._lines), None)
            groups.setdefault(home, []).append(number)
        stamps: list[int | None] = [None] * len(files)
        for home, numbers in groups.items():
            if home is not None:
                for number, stamp in zip(
                    numbers, self._group(home, [files[n] for n in numbers]), strict=True
                ):
                    stamps[number] = stamp
        return stamps

    def _group(self, home: Path, files: Sequence[Path]) -> list[int | None]:
        lines = self._lines[home]
        found = [_NUMBER.search(file.stem) for file in files]
        numbers = [int(match[1]) if match else -1 for match in found]
        if len(set(numbers)) == len(files) and all(0 <= k < len(lines) for k in numbers):
            return [lines[k] for k in numbers]
        if len(files) == len(lines):
            return list(lines)
        return [lines[k] if 0 <= k < len(lines) and numbers.count(k) == 1 else None for k in numbers]
