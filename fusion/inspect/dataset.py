"""A manifest, and a folder that is the root of a known data set."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from fusion.errors import FusionError, InputError, UsageError
from fusion.inspect.base import Asked, Finding, InspectKind, Step, Stream, steps_of
from fusion.inspect.folder import look_at_folder
from fusion.inspect.rigs import format_of
from fusion.manifest import FORMAT, Layout, Manifest, list_manifests, load_manifest


def look_at_manifest(path: Path, _: Asked) -> Finding:
    """What a manifest says; nothing of the set itself is looked at."""
    try:
        manifest = load_manifest(str(path.absolute()))
    except FusionError as error:
        raise InputError(error.what, where=path, hint=error.hint) from None
    streams = tuple(Stream(role, f"ROOT/{pattern}", role) for role, pattern in manifest.layout())
    steps = [
        Step(("fusion", "datasets", "check", str(path), "ROOT"), "is the set at ROOT whole?"),
        *_use(manifest, str(path), "ROOT"),
    ]
    return Finding(
        str(path), "manifest", f"a manifest: {manifest.title}", _said(manifest), streams, steps=tuple(steps)
    )


def look_at_root(path: Path, asked: Asked) -> Finding:
    """The folder as a folder is looked at, and which known sets have this layout."""
    base, found = look_at_folder(path, asked), _plans(path)
    if not found:
        return base
    facts: dict[str, Any] = dict(base.facts)
    notes, steps = list(base.notes), []
    for manifest, layout in found:
        counts = {role: len(files.files) for role, files in layout.roles.items()}
        if layout.recording is not None:
            counts["recordings"] = len(layout.recording.files)
        facts[f"layout_of_{manifest.name}"] = counts
        notes += [f"{manifest.name}: {manifest.registration_note}"] if manifest.has_thermal() else []
        steps += _use(manifest, manifest.name, str(path))
    title = f"the layout of {' or '.join(manifest.name for manifest, _ in found)}"
    return Finding(
        base.path,
        "dataset",
        title,
        facts,
        base.streams,
        base.roles,
        tuple(notes),
        base.faults,
        (*steps, *base.steps),
        base.pictures,
    )


def _said(manifest: Manifest) -> dict[str, Any]:
    facts: dict[str, Any] = {"name": manifest.name, "state": manifest.state}
    facts |= {"registration": manifest.registration_note, "licence": manifest.licence}
    facts |= {"citation": manifest.citation} | ({"url": manifest.url} if manifest.url else {})
    return facts | ({"notes": " ".join(manifest.notes.split())} if manifest.notes else {})


def _use(manifest: Manifest, name: str, root: str) -> tuple[Step, ...]:
    """The command that uses the set, as far as it can be used."""
    if manifest.state == "unpaired":
        return ()
    if manifest.state == "lidar only":
        return steps_of((["fusion", "preprocess", name, root, "-o", "OUT"], "depth from its clouds"))
    if manifest.state == "registered":
        return steps_of((["fusion", "preprocess", name, root, "-o", "OUT"], "fuse it: it is registered"))
    words = ["fusion", "preprocess", name, root, "--rig", "RIG", "-o", "OUT"]
    return steps_of((words, "fuse it; RIG is your calibration: the set is not registered"))


def _plans(path: Path) -> list[tuple[Manifest, Layout]]:
    """The known sets of which `path` could be the root, with what of them lies there."""
    found = []
    for manifest in _known():
        if _fits(manifest, path):
            with suppress(FusionError):  # a link that leads out, a stamp file that is missing
                found.append((manifest, manifest.plan(path)))
    return found


def _known() -> list[Manifest]:
    try:
        known = [item.manifest for item in list_manifests() if item.manifest is not None]
        # folders rgb/ and fir/ are anybody's: a simulated mine is known by its truth
        return [manifest for manifest in known if manifest.name != "mine"]
    except UsageError:  # $FUSION_DATASETS leads nowhere: that is for `fusion datasets` to say
        return []


def _fits(manifest: Manifest, root: Path) -> bool:
    """Whether every role that the set needs has a file; the first one found is enough."""
    patterns = dict(manifest.layout())
    try:
        return all(next(root.glob(patterns[role]), None) is not None for role in manifest.needed())
    except (OSError, ValueError):
        return False


MANIFEST = InspectKind("a manifest (.toml)", lambda path: format_of(path) == FORMAT, look_at_manifest)
ROOT = InspectKind(
    "the root of a known data set",
    lambda path: path.is_dir() and any(_fits(manifest, path) for manifest in _known()),
    look_at_root,
)
