"""One point cloud in a file."""

from __future__ import annotations

from pathlib import Path

from fusion.clouds import read_cloud
from fusion.clouds.find import suffix_of
from fusion.errors import FusionError, InputError
from fusion.inspect.base import Asked, Finding, InspectKind, steps_of
from fusion.inspect.measure import points_of
from fusion.inspect.pictures import top_view


def look_at_cloud(path: Path, asked: Asked) -> Finding:
    """A cloud: its points, fields and extent, and what `fusion depth` would make of it."""
    try:
        cloud = read_cloud(path)
    except FusionError as error:
        raise InputError(error.what, where=path, hint=error.hint) from None
    facts = {"file_bytes": path.stat().st_size, **points_of(cloud)}
    if cloud.stamp_ns is not None:
        facts["stamp_ns"] = cloud.stamp_ns
    picture = top_view(path.name, cloud) if asked.pictures else None
    notes = ("no valid point is left in it",) if not len(cloud) else ()
    return Finding(
        str(path),
        "cloud",
        "a point cloud",
        facts,
        notes=notes,
        steps=steps_of((["fusion", "depth", path, "-o", "OUT"], "dense depth from it")) if len(cloud) else (),
        pictures=(picture,) if picture else (),
    )


CLOUD = InspectKind(
    "a point cloud", lambda path: path.is_file() and suffix_of(path.name) is not None, look_at_cloud
)
