"""Which files a folder, a pattern or a name stands for."""

from __future__ import annotations

import glob
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import overload

from fusion.clouds.base import SUFFIXES
from fusion.errors import InputError

_LOOKED_FOR = f"looked for {' '.join(sorted(SUFFIXES))}, in any case of letters"


@dataclass(frozen=True, slots=True)
class CloudFiles(Sequence[Path]):
    """Cloud files in natural order; `stems` are their names below the folder, with `/`, without suffix.

    `ignored` counts the files beside them that are no clouds, `kinds` the clouds by suffix.
    """

    paths: tuple[Path, ...]
    stems: tuple[str, ...]
    ignored: int = 0
    kinds: Mapping[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.paths)

    def __iter__(self) -> Iterator[Path]:
        return iter(self.paths)

    @overload
    def __getitem__(self, index: int) -> Path: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Path, ...]: ...
    def __getitem__(self, index: int | slice) -> Path | tuple[Path, ...]:
        return self.paths[index]


def suffix_of(name: str) -> str | None:
    """The suffix by which a file is known to be a cloud, in small letters."""
    return next((suffix for suffix in SUFFIXES if name.lower().endswith(suffix)), None)


def stem_of(name: str) -> str:
    """The name without its suffix, of which `.pcd.bin` is one."""
    suffix = suffix_of(name)
    return name[: -len(suffix)] if suffix else os.path.splitext(name)[0]  # noqa: PTH122 - may hold folders


def clouds_in(spec: str | Path) -> CloudFiles:
    """The clouds that a file, a folder (not those below it) or a glob pattern stands for.

    A single file is taken whatever its suffix (`read_cloud` decides with its `form`). Hidden files are not
    looked at. Raises `InputError` where nothing is there, nothing is a cloud, or two clouds bear one stem.
    """
    text = str(spec)
    if not text.strip():
        raise InputError("no clouds given", hint="give a file, a folder or a glob pattern")
    path = Path(text)
    try:
        if path.is_dir():
            return _listed(path, (item.name for item in path.iterdir() if not item.is_dir()), text)
        if path.exists() or not glob.has_magic(text):
            return _alone(path)
        return _matched(text)
    except (OSError, ValueError, NotImplementedError) as error:  # no permission, a zero byte, "**x"
        raise InputError(f"cannot be looked up: {error}", where=text) from error


def _alone(path: Path) -> CloudFiles:
    if not path.exists():
        raise InputError("no such file or folder", where=path, hint=f"{_LOOKED_FOR} or a glob pattern")
    kind = suffix_of(path.name) or path.suffix.lower()
    return CloudFiles((path,), (stem_of(path.name),), 0, {kind: 1})


def _matched(pattern: str) -> CloudFiles:
    from fusion.sources.folders import split_pattern

    prefix, rest = split_pattern(pattern)
    if rest.split("/")[-1] == "**":
        rest += "/*"  # what a trailing ** finds differs between versions of Python
    found = {found.relative_to(prefix).as_posix() for found in prefix.glob(rest) if not found.is_dir()}
    return _listed(prefix, found, pattern)


def _listed(folder: Path, names: Iterable[str], where: str) -> CloudFiles:
    from fusion.sources.folders import natural_key

    seen = [name for name in names if not any(part.startswith(".") for part in name.split("/"))]
    clouds = sorted((name for name in seen if suffix_of(name)), key=natural_key)
    ignored = len(seen) - len(clouds)
    if not clouds:
        others = f"; {ignored} other files are there" if ignored else ""
        raise InputError("no point clouds here", where=where, hint=_LOOKED_FOR + others)
    stems: dict[str, str] = {}
    for name in clouds:
        twin = stems.setdefault(stem_of(name), name)
        if twin is not name:
            hint = "name one kind by a pattern, such as 'folder/*.pcd'"
            raise InputError(f"two clouds bear one name: {twin} and {name}", where=where, hint=hint)
    kinds = Counter(suffix_of(name) or "" for name in clouds)
    return CloudFiles(tuple(folder / name for name in clouds), tuple(stems), ignored, dict(kinds))
