"""One way to look a method up by name: our explicit table first, then what others have installed."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import Any, TypeVar

from fusion.errors import UsageError

T = TypeVar("T")


def lookup(table: Mapping[str, T], group: str, name: str, what: str) -> T:
    """The value called `name`: from `table`, else from the entry points of `group`.

    `what` names the kind of thing in messages ("blender"). A row of `table` is never replaced by an
    installed package, and no foreign code is imported unless it is asked for by name. Raises
    `UsageError` where the name is unknown (the known ones are listed), where two packages offer
    it, or where the package that offers it fails to load.
    """
    if name in table:
        return table[name]
    offered = entry_points(group=group)
    found = {point.value: point for point in offered if point.name == name}
    if not found:
        names = ", ".join([*table, *sorted({point.name for point in offered} - set(table))])
        raise UsageError(f"unknown {what} {name!r}", hint=f"one of: {names}")
    if len(found) > 1:
        raise UsageError(
            f"{what} {name!r} is offered twice: {', '.join(sorted(found))}",
            hint="uninstall one of the packages that offer it",
        )
    return _loaded(next(iter(found.values())), what)


def _loaded(point: Any, what: str) -> Any:
    """Import what an entry point names; foreign code may raise anything."""
    try:
        return point.load()
    except Exception as error:
        raise UsageError(
            f"{what} {point.name!r} cannot be loaded from {point.value}: {type(error).__name__}: {error}",
            hint="repair or uninstall the package that offers it",
        ) from error
