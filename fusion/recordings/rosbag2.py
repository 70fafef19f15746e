"""rosbag2: a folder with or without its metadata.yaml, or one bare .db3; sqlite3 and MCAP; packed or not."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from fusion.errors import InputError
from fusion.recordings import metadata as meta
from fusion.recordings.base import Recording, RecordingKind, Schema, Topic
from fusion.recordings.files import (
    DamagedError,
    Faults,
    Workspace,
    first_bytes,
    inside,
    is_url,
    names_in,
    open_bytes,
    stem,
)
from fusion.recordings.joined import JoinedRecording, Part, PartFile
from fusion.recordings.mcap import McapRecording
from fusion.recordings.sqlite import MAGIC, Sqlite3Recording
from fusion.recordings.unpack import unpack_file

PACKED = {".zstd": "zstd", ".zst": "zstd", ".lz4": "lz4"}
STORAGES = {"sqlite3": ".db3", "mcap": ".mcap"}
FORMS = {".db3": "rosbag2 (sqlite3)", ".mcap": "rosbag2 (MCAP)"}


@dataclass(slots=True)
class _Found:
    """What there is to be opened: a local folder, the names in it, and what is said of them."""

    shown: str
    folder: str
    names: list[str]
    metadata: meta.Metadata = field(default_factory=meta.Metadata)
    faults: Faults = field(default_factory=Faults)
    workspace: Workspace = field(default_factory=Workspace)


def open_rosbag2(path: str) -> Recording:
    """A folder, or a .db3 (packed or not), as one recording. Raises `InputError`."""
    found = _Found(path.rstrip("/"), path.rstrip("/"), [])
    try:
        if _storage(path):
            _find_bare(found)
        else:
            _find_in_folder(found)
        return _joined(found)
    except BaseException:
        found.workspace.close()
        raise


def _find_bare(found: _Found) -> None:
    """One file; the metadata beside it, if they name it, say whether its messages are packed."""
    found.folder, _, name = found.shown.rpartition("/")
    found.folder = found.folder or "."
    found.names = [name]
    try:
        text = _metadata_text(found.folder)
        known = meta.parse(text) if text else meta.Metadata()
        if name in map(meta.last_part, known.files):
            found.metadata = replace(known, counts=known.counts if len(known.files) == 1 else {})
    except DamagedError:
        pass  # a file on its own is read for itself
    if is_url(found.folder):
        _fetch(found, [name, f"{name}-wal"])


def _find_in_folder(found: _Found) -> None:
    here = names_in(found.folder)
    storages = [name for name in here if _storage(name)]
    try:
        text = _metadata_text(found.folder)
        if not text:
            found.faults.add(f"{found.shown}: has no {meta.NAME}: all files that may be of it are read")
        found.metadata = meta.parse(text) if text else meta.Metadata()
    except DamagedError as damage:
        found.faults.add(f"{found.shown}/{meta.NAME}: {damage}: all files that may be of it are read")
    if found.metadata.version > meta.NEWEST:
        what = f"{meta.NAME} is of version {found.metadata.version}, newer than what is known ({meta.NEWEST})"
        found.faults.add(f"{found.shown}: {what}")
    found.names = _named(found, storages) if found.metadata.files else sorted(storages, key=_natural)
    if is_url(found.folder):
        _fetch(found, found.names)


def _named(found: _Found, here: Sequence[str]) -> list[str]:
    """The files that the metadata name and that are there; what is not is said."""
    names, missing = [], []
    for name in found.metadata.files:
        last = meta.last_part(inside(found.folder, name))
        options = [last, *(last + end for end in PACKED), *(last.removesuffix(end) for end in PACKED)]
        there = next((option for option in options if option in here), None)
        names += [there] if there and there not in names else []
        missing += [] if there else [last]
    if not names:
        listed = ", ".join(missing[:5]) + (f" and {len(missing) - 5} more" if len(missing) > 5 else "")
        raise InputError(f"none of its files is there: {listed}", where=found.shown)
    for name in missing:
        found.faults.add(f"{found.shown}: its file {name} is missing")
    for name in sorted(set(here) - set(names)):
        found.faults.add(f"{found.shown}: {name} is left out: {meta.NAME} does not name it")
    return names


def _metadata_text(folder: str) -> bytes:
    """Its beginning, at most a byte more than is allowed; empty where there is none."""
    if meta.NAME not in names_in(folder):
        return b""
    with open_bytes(f"{folder}/{meta.NAME}") as file:
        return file.read(meta.MAX_BYTES + 1)


def _fetch(found: _Found, names: Sequence[str]) -> None:
    """Local copies of files at a URL, all in one folder."""
    target = found.workspace.path("files")
    target.mkdir()
    for name in set(names) & set(names_in(found.folder)):
        copy = found.workspace.copy(f"{found.folder}/{name}")
        shutil.move(copy, target / name)
    found.folder = str(target)


def _joined(found: _Found) -> Recording:
    if not found.names:
        raise InputError("is an empty rosbag2 folder: neither .db3 nor .mcap", where=found.shown)
    kinds = {_storage(name) for name in found.names}
    if len(kinds) > 1:
        raise InputError("holds .db3 and .mcap side by side: give one of the files", where=found.shown)
    if found.metadata.packing not in {"", *PACKED.values()}:
        what = f"is packed by {found.metadata.packing!r}; known: {', '.join(sorted(set(PACKED.values())))}"
        raise InputError(what, where=found.shown)
    parts = [_part_file(found, name) for name in found.names]
    _open_first(found, parts)
    packing = _message_packing(found, parts)
    return JoinedRecording(
        stem(found.shown),
        FORMS[kinds.pop() or ".db3"],
        tuple(_shown(found, name) for name in found.names),
        parts,
        _topics(found, parts),
        found.faults,
        packing,
        found.workspace,
    )


def _shown(found: _Found, name: str) -> str:
    return found.shown if found.shown.endswith(name) else f"{found.shown}/{name}"


def _part_file(found: _Found, name: str) -> PartFile:
    path, shown = f"{found.folder}/{name}", _shown(found, name)
    spans = found.metadata.spans
    claimed = spans.get(name) or next((spans[s] for s in spans if name in (s + end for end in PACKED)), None)
    return PartFile(name, partial(_open_part, path, shown, found.workspace), claimed)


def _open_part(path: str, shown: str, workspace: Workspace) -> Part:
    packing = next((form for end, form in PACKED.items() if path.lower().endswith(end)), "")
    if packing:
        target = workspace.path(Path(path).stem)
        with workspace.writing(path, target) as (source, file):
            unpack_file(packing, source, file, shown)
        path = str(target)
    return McapRecording(path, shown) if _storage(path) == ".mcap" else Sqlite3Recording(path, shown)


def _open_first(found: _Found, parts: list[PartFile]) -> None:
    """Open what costs little. A packed file waits until it is needed, but for the first, for its schemas."""
    errors: list[InputError] = []
    opened = False
    for file in parts:
        packed = file.name.lower().endswith(tuple(PACKED))
        if packed and opened and file.claimed_ns is not None:
            continue
        try:
            file.part, opened = file.open(), True
        except InputError as error:
            errors.append(error)
            found.faults.add(f"{error}: left out")
    parts[:] = [file for file in parts if file.part is not None or file.claimed_ns is not None]
    parts[:] = [file for file in parts if file.part is not None or file.name.lower().endswith(tuple(PACKED))]
    if not opened:
        raise errors[0]


def _message_packing(found: _Found, parts: list[PartFile]) -> str:
    """How messages are packed: by the metadata, or by the copy of them that a .db3 holds."""
    known = found.metadata
    for file in parts:
        text = getattr(file.part, "metadata", "")
        if text and not known.files:
            try:
                known = meta.parse(text)
            except DamagedError as damage:
                found.faults.add(f"{_shown(found, file.name)}: its own metadata: {damage}")
    return known.packing if known.packed == "message" else ""


def _topics(found: _Found, parts: list[PartFile]) -> list[Topic]:
    """The topics of all parts and of the metadata, with the metadata's counts where there are any."""
    groups: dict[tuple[str, str, str], dict[Schema, list[int | None]]] = {}
    for file in parts:
        for topic in file.part.topics if file.part else ():
            group = groups.setdefault((topic.name, topic.schema.name, topic.encoding), {})
            group.setdefault(topic.schema, []).append(topic.count)
    for (name, kind), encoding in found.metadata.encodings.items():
        groups.setdefault((name, kind, encoding), {}).setdefault(Schema(kind), [])
    topics = []
    for (name, kind, encoding), group in sorted(groups.items()):
        told = {schema: counts for schema, counts in group.items() if schema.form}
        bare = [count for schema, counts in group.items() if not schema.form for count in counts]
        if len(told) == 1:  # files without the definition mean the same
            next(iter(told.values())).extend(bare)
        for schema, counts in (told or group).items():
            claimed = found.metadata.counts.get((name, kind)) if len(told) < 2 else None
            summed = None if None in counts else sum(count or 0 for count in counts)
            topics.append(Topic(name, schema, encoding, summed if claimed is None else claimed))
    return topics


def _storage(path: str) -> str | None:
    """``.db3`` or ``.mcap``, by the name, packed or not."""
    for end in PACKED:
        path = path[: -len(end)] if path.lower().endswith(end) else path
    return next((end for end in STORAGES.values() if path.lower().endswith(end)), None)


def _natural(name: str) -> list[tuple[int, str]]:
    """`bag_2` before `bag_10`."""
    return [(int(part), "") if part.isdecimal() else (0, part) for part in re.split(r"(\d+)", name)]


def _accepts(path: str) -> bool:
    if is_url(path) or Path(path).is_dir():
        names = names_in(path)
        if any(_storage(name) for name in names):
            return True
        if meta.NAME in names:
            return meta.ROOT.encode() in first_bytes(f"{path.rstrip('/')}/{meta.NAME}", 1 << 14)
    head = first_bytes(path)
    if head.startswith(MAGIC):
        return True
    packed = path.lower().endswith(tuple(PACKED))
    return _storage(path) is not None and (packed or _storage(path) == ".db3")


ROSBAG2 = RecordingKind("rosbag2 (a folder with metadata.yaml, or a .db3)", _accepts, open_rosbag2)
