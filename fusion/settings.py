"""What all settings have in common: TOML files read safely, layers merged, problems named by their key."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from fusion.errors import UsageError

MAX_CONFIG_BYTES = 1 << 20


class Group(BaseModel):
    """A table of settings: unknown keys are refused, values are fixed and finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def read_settings(path: Path, form: str, paths: Iterable[tuple[str, str]] = ()) -> dict[str, Any]:
    """The settings in a TOML file whose `format` is `form`.

    `paths` lists the keys (table, key) that name files: they count from the file's own folder. Raises
    `UsageError` where the file cannot be read, is too large or is of another format.
    """
    try:
        if path.stat().st_size > MAX_CONFIG_BYTES:
            raise UsageError("too large for a configuration", where=path)
        settings = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:  # no TOML, or one made to break its reader
        raise UsageError(f"cannot be read as TOML: {error}", where=path) from None
    if settings.get("format") != form:
        raise UsageError(
            "no configuration of ours", where=path, hint=f'its first line must be format = "{form}"'
        )
    for group, key in paths:
        table = settings.get(group)
        if isinstance(table, dict) and isinstance(table.get(key), str):
            table[key] = str(path.parent / table[key])
    return settings


def merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`over` laid over `base`, table by table."""
    result = dict(base)
    for key, value in over.items():
        known = result.get(key)
        if isinstance(known, Mapping) and isinstance(value, Mapping):
            value = merged(known, value)
        result[key] = value
    return result


def nested(places: Mapping[str, tuple[str, ...]], options: Mapping[str, Any]) -> dict[str, Any]:
    """The options that were given (not None), each at its place in the settings."""
    settings: dict[str, Any] = {}
    for option, (*groups, key) in places.items():
        if options[option] is not None:
            table = settings
            for group in groups:
                table = table.setdefault(group, {})
            table[key] = options[option]
    return settings


def first_problem(error: ValidationError) -> str:
    """The first key that is wrong, and what is wrong with it."""
    problem = error.errors(include_url=False)[0]
    key = ".".join(str(part) for part in problem["loc"])
    more = error.error_count() - 1
    return f"{key}: {problem['msg'].lower()}" + (f" (and {more} more)" if more else "")
