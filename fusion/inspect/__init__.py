"""What a file or folder holds, said without being asked twice: counts, times, ranges, roles, the next
command.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from fusion.errors import InputError
from fusion.inspect.base import FALLBACK, FORMAT, KINDS, Asked, Finding, InspectKind, Step, no_progress
from fusion.recordings.files import is_url

__all__ = ["FORMAT", "KINDS", "Finding", "InspectKind", "inspect"]


def inspect(
    path: str | Path,
    *,
    full: bool = False,
    pictures: bool = False,
    progress: Callable[[int, int], None] | None = None,
    also: Sequence[InspectKind] = (),
) -> Finding:
    """Look at whatever is at `path` and say what is in it.

    Without `full` large things are sampled; the finding says what was looked at. `pictures` makes those of
    the page. `also` are kinds that are tried after ours. Raises `InputError` where nothing is there, where it
    cannot be read, and where it is of no kind that is known (the kinds are listed).
    """
    asked = Asked(full, pictures, progress or no_progress)
    if is_url(str(path)):
        from fusion.inspect.recording import look_at_recording

        return _with_more(look_at_recording(str(path), asked), full)
    place = Path(path)
    kinds = [*(pkgutil.resolve_name(target) for target in KINDS.values()), *also]
    expected = "give " + "; ".join(kind.expects for kind in kinds)
    _check_there(place, expected)
    fitting = [kind for kind in kinds if kind.accepts(place)]
    for last, kind in enumerate(fitting, 1 - len(fitting)):
        try:
            return _with_more(kind.look(place, asked), full)
        except InputError:
            if kind.expects != FALLBACK or last == 0:
                raise
    raise InputError("not of a kind that can be inspected", where=path, hint=expected)


def _with_more(finding: Finding, full: bool) -> Finding:
    """Where something was only sampled, the last step is to look at all of it."""
    used = [stream for stream in finding.streams if stream.used in ("image", "cloud")]
    looks = [stream.looked for stream in used if stream.looked is not None]
    if full or all(look.seen == look.of for look in looks):
        return finding
    step = Step(("fusion", "inspect", finding.path, "--full"), "read everything: exact ranges, frozen frames")
    return replace(finding, steps=(*finding.steps, step))


def _check_there(place: Path, expected: str) -> None:
    """Raises `InputError` where nothing is there, it is empty, or it cannot be read."""
    try:
        if place.is_dir():
            empty = "an empty folder" if next(place.iterdir(), None) is None else ""
        elif place.is_file():
            with place.open("rb") as file:
                empty = "" if file.read(1) else "an empty file (0 bytes)"
        else:
            raise InputError("no such file or folder", where=place, hint=_nearest(place))
    except (OSError, ValueError) as error:  # no permission, a name too long, a zero byte
        what = getattr(error, "strerror", None) or error
        raise InputError(f"cannot be read: {what}", where=place) from error
    if empty:
        raise InputError(empty, where=place, hint=expected)


def _nearest(place: Path) -> str:
    """Up to where a path that is not there does exist."""
    folder = next((parent for parent in place.absolute().parents if parent.is_dir()), Path("/"))
    try:
        names = sorted(item.name for item in folder.iterdir() if not item.name.startswith("."))[:5]
    except OSError:
        return f"{folder} cannot be listed"
    return f"{folder} holds {', '.join(names)}" if names else f"{folder} is empty"
