"""A folder: the images, clouds and recordings in it and below it, a stream for each folder that has some."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from fusion.clouds import clouds_in
from fusion.clouds.find import suffix_of
from fusion.errors import FusionError, InputError
from fusion.inspect.base import FALLBACK, Asked, Finding, InspectKind, Step, Stream, steps_of
from fusion.inspect.files import Sampled, cloud_stream, image_stream
from fusion.inspect.rigs import format_of
from fusion.messages.roles import Roles, roles_of
from fusion.rig import FORMAT as RIG_FORMAT
from fusion.sources.folders import IMAGE_SUFFIXES, list_folder

MOST_FOLDERS, DEPTH = 400, 4
_RECORDINGS = (".bag", ".mcap", ".db3")


def look_at_folder(path: Path, asked: Asked) -> Finding:
    """What lies in a folder and up to `DEPTH` below it; `InputError` where nothing of it can be used."""
    folders, cut = folders_in(path)
    parts = streams_of(path, folders, asked)
    recordings = [Stream(_name(path, item), "recording", "recording") for item in _recordings(folders)]
    if not parts and not recordings:
        hint = f"looked for images, clouds and recordings in it and {DEPTH} folders below"
        raise InputError("nothing here that can be used", where=path, hint=hint)
    sets = _sets(parts)
    roles = roles_of([part.seen for part in parts]) if parts and not sets else None
    streams = tuple(part.stream for part in parts)
    notes = [f"only the first {MOST_FOLDERS} folders were looked at"] if cut else []
    return Finding(
        str(path),
        "folder",
        _title(streams, len(recordings)),
        {"folders": len(folders), "images": _sum(streams, "image"), "clouds": _sum(streams, "cloud")},
        (*streams, *recordings),
        roles,
        tuple(notes + _ambiguity(roles) + _named(sets)),
        tuple(fault for part in parts for fault in part.faults),
        _steps(path, parts, sets, roles, folders, recordings),
        tuple(picture for part in parts for picture in part.pictures)[:24],
    )


def _sets(parts: Sequence[Sampled]) -> dict[str, tuple[list[Sampled], Roles]]:
    """Where several folders each hold RGB and thermal: those, with their roles; else nothing."""
    groups: dict[str, list[Sampled]] = {}
    for part in parts:
        groups.setdefault(part.stream.name.rpartition("/")[0], []).append(part)
    judged = {name: (group, roles_of([part.seen for part in group])) for name, group in groups.items()}
    sets = {name: pair for name, pair in judged.items() if {"rgb", "fir"} <= pair[1].chosen.keys()}
    return sets if len(sets) > 1 else {}


def _named(sets: Mapping[str, tuple[list[Sampled], Roles]]) -> list[str]:
    return (
        [f"{len(sets)} sets of RGB and thermal, each for itself: {', '.join(list(sets)[:20])}"]
        if sets
        else []
    )


def _steps(
    root: Path,
    parts: Sequence[Sampled],
    sets: Mapping[str, tuple[list[Sampled], Roles]],
    roles: Roles | None,
    folders: Sequence[Path],
    recordings: Sequence[Stream],
) -> tuple[Step, ...]:
    rigs = rigs_in(folders)
    if not sets:
        return steps_for(root, parts, roles, rigs, [item.name for item in recordings])
    steps = [steps_for(root, group, found, rigs) for group, found in list(sets.values())[:3]]
    return tuple(step for group in steps for step in group)


def streams_of(root: Path, folders: Sequence[Path], asked: Asked) -> list[Sampled]:
    """A stream for the images and one for the clouds of each folder that has some, named by its path below
    `root`.
    """
    found = []
    for folder in folders:
        names = _names(folder)
        if any(os.path.splitext(name)[1].lower() in IMAGE_SUFFIXES for name in names):  # noqa: PTH122
            found.append(image_stream(_name(root, folder), *list_folder(str(folder)), asked))
        if any(suffix_of(name) and not name.startswith(".") for name in names):
            try:
                found.append(cloud_stream(_name(root, folder), clouds_in(folder), asked))
            except FusionError:  # two kinds of clouds under one name: `fusion depth` says so
                continue
    return found


def folders_in(root: Path) -> tuple[list[Path], bool]:
    """`root` and the folders below it, by depth then name, without hidden ones; whether some were left out.

    A folder is left alone from where a rosbag2 begins; links to folders are not followed.
    """
    found, level = [root], [root]
    for _ in range(DEPTH):
        below = []
        for folder in level:
            if (folder / "metadata.yaml").is_file() and folder != root:
                continue
            below += [folder / name for name in _names(folder) if _is_folder(folder / name)]
        level = below
        found += below
        if len(found) > MOST_FOLDERS:
            return found[:MOST_FOLDERS], True
    return found, False


def rigs_in(folders: Sequence[Path]) -> list[Path]:
    """The rig.toml files in these folders."""
    files = [folder / name for folder in folders for name in _names(folder) if name.endswith(".toml")]
    return [file for file in files[:50] if format_of(file) == RIG_FORMAT]


def steps_for(
    root: Path,
    parts: Sequence[Sampled],
    roles: Roles | None,
    rigs: Sequence[Path],
    recordings: Sequence[str] = (),
) -> tuple[Step, ...]:
    """Commands for what the folders hold, by the roles that they could play."""
    chosen = {} if roles is None else {role: root / topic.name for role, (topic, _) in roles.chosen.items()}
    rig = ["--rig", rigs[0]] if rigs else []
    steps: list[tuple[list[object], str]] = []
    if "rgb" in chosen and "fir" in chosen:
        words = ["fusion", "blend", chosen["rgb"], chosen["fir"], *rig, "-o", "OUT", "--preview"]
        why = "fuse them" if rigs else "fuse them; --align, --points or --rig where they are not registered"
        steps.append((words, why))
    elif "rgb" in chosen or "fir" in chosen:
        steps += _one_camera(root, parts, chosen)
    if "depth" in chosen:
        words = ["fusion", "depth", "--sparse", chosen["depth"], "-o", "OUT"]
        steps.append((words, "if these are sparse depth maps, metres x 256: fill them"))
    if "lidar" in chosen:
        steps.append((["fusion", "depth", chosen["lidar"], *rig, "-o", "OUT"], "dense depth from the clouds"))
    for name in recordings[:3]:
        steps.append((["fusion", "inspect", root / name], "look into that recording"))
    return steps_of(*steps)


def _one_camera(root: Path, parts: Sequence[Sampled], chosen: dict) -> list[tuple[list[object], str]]:
    folder = chosen["rgb" if "rgb" in chosen else "fir"]
    part = next(part for part in parts if root / part.stream.name == folder)
    if part.stream.facts.get("both_cameras"):
        return [(["fusion", "blend", folder, "-o", "OUT"], "each file holds both cameras' images")]
    if "rgb" in chosen:
        return [(["fusion", "blend", folder, "FIR", "-o", "OUT"], "with the thermal images as FIR")]
    return [(["fusion", "blend", "RGB", folder, "-o", "OUT"], "with the visible images as RGB")]


def _title(streams: Sequence[Stream], recordings: int) -> str:
    if len(streams) == 1 and not recordings and streams[0].name == ".":
        return f"a folder of {streams[0].type}"
    kinds = sorted({stream.type for stream in streams}) + (["recordings"] if recordings else [])
    return f"folders of {' and '.join(kinds)}" if kinds else "a folder"


def _ambiguity(roles: Roles | None) -> list[str]:
    if roles is None:
        return []
    return [
        f"which is {role} is not clear: {', '.join(guess.topic.name for guess in tied)}"
        for role, tied in roles.ambiguous.items()
    ]


def _recordings(folders: Sequence[Path]) -> list[Path]:
    bags = [folder for folder in folders[1:] if (folder / "metadata.yaml").is_file()]
    files = [
        folder / name
        for folder in folders
        if folder not in bags
        for name in _names(folder)
        if name.lower().endswith(_RECORDINGS) and (folder / name).is_file()
    ]
    return sorted([*bags, *files])


def _sum(streams: Sequence[Stream], used: str) -> int:
    return sum(stream.count or 0 for stream in streams if stream.used == used)


def _name(root: Path, item: Path) -> str:
    return item.relative_to(root).as_posix()


def _names(folder: Path) -> list[str]:
    try:
        return sorted(name for name in os.listdir(folder) if not name.startswith("."))  # noqa: PTH208
    except OSError:
        return []


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


FOLDER = InspectKind(FALLBACK, lambda path: path.is_dir(), look_at_folder)
