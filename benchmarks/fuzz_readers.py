"""The readers that are fuzzed: how each is called, what it is fed with, its share of inputs, its bound."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import fuzz_made as made
from fuzz_seeds import Seed

from fusion.errors import FusionError

MOST_PACKETS, MOST_PACKET_BYTES = 5000, 1 << 28
SIZE = (48, 36)
ROLES = ("rgb", "fir", "depth")


@dataclass(frozen=True, slots=True)
class Reader:
    """`read(path, seed)` raises a `FusionError`, or returns why the input was refused, "" where it was read.

    `seeds` names the group that is mutated; `make` draws inputs instead (from a sound one), for a share
    `made` of them. `bound_mib` is how far memory may grow above the idle worker's.
    """

    name: str
    says: str
    read: Callable[[Path, Seed], str]
    seeds: str = ""
    make: Callable[[Random, Seed], Seed] | None = None
    made: float = 0.0
    share: float = 1.0
    bound_mib: int = 512


def recording(path: Path, seed: Seed) -> str:
    """Open, list, read all (to a bound), then a range of times of the first topic."""
    del seed
    from fusion.recordings import open_recording

    found = open_recording(path)
    try:
        assert all(isinstance(file, str) for file in found.files)
        size = 0
        for k, (_, log_ns, data) in enumerate(found.packets()):
            size += len(data) + 0 * log_ns
            if k > MOST_PACKETS or size > MOST_PACKET_BYTES:
                break
        if found.span_ns is not None:
            start, end = found.span_ns
            third = (end - start) // 3
            for k, _ in enumerate(found.packets(found.topics[:1], start + third, end - third)):
                if k > MOST_PACKETS:
                    break
        list(found.faults)
    finally:
        found.close()
    return ""


def message(path: Path, seed: Seed) -> str:
    """A reader from the definition, then header, message and what is made of it."""
    from dataclasses import replace

    from fusion.messages import reader_of

    definition = (path / "definition.msg").read_bytes()
    topic = replace(seed.about, schema=replace(seed.about.schema, data=definition))
    reader = reader_of(topic)
    data = (path / "message").read_bytes()
    _any_of([lambda: reader.header(data), lambda: use(reader.message(data))])
    return ""


def definition(path: Path, seed: Seed) -> str:
    """A definition alone, for a type that we read and for one that we do not."""
    return message(path, seed)


def use(meant: Any) -> None:
    """All that a message may be used as; refused where it can be used as nothing."""
    from fusion.messages.base import CameraInfo, CompressedImage, Points, RawImage
    from fusion.messages.cameras import camera_of
    from fusion.messages.clouds import cloud_of_points
    from fusion.messages.images import depth_of, image_of

    if isinstance(meant, RawImage | CompressedImage):
        calls: list[Callable[[], Any]] = [lambda: depth_of(meant, where="it")]
        calls += [partial(image_of, meant, role, fir_colour="luma", stem="a", where="it") for role in ROLES]
        _any_of(calls)
    elif isinstance(meant, Points):
        cloud_of_points(meant, stem="a", where="it")
    elif isinstance(meant, CameraInfo):
        camera_of(meant)


def drawn_message(path: Path, seed: Seed) -> str:
    del path
    use(seed.about)
    return ""


def _any_of(calls: list[Callable[[], Any]]) -> None:
    """All are made; the last refusal counts where none went through."""
    refusals = []
    for call in calls:
        try:
            call()
        except FusionError as error:
            refusals.append(error)
    if len(refusals) == len(calls):
        raise refusals[-1]


def image(path: Path, seed: Seed) -> str:
    del seed
    from fusion.codecs import decode_image

    decode_image(path.read_bytes(), str(path))
    return ""


def flir(path: Path, seed: Seed) -> str:
    del seed
    from fusion.radiometric.flir import HEAD_BYTES, glance, read_flir

    data = path.read_bytes()
    glance(data[:HEAD_BYTES])
    read_flir(data, str(path)).celsius()
    return ""


def cloud(path: Path, seed: Seed) -> str:
    del seed
    from fusion.clouds import read_cloud

    read_cloud(path)
    return ""


def manifest(path: Path, seed: Seed) -> str:
    """Read, and laid over a small tree: whatever it finds must lie in that tree."""
    del seed
    from fusion.manifest import load_manifest

    tree = path.parent / "tree"
    for name in ("rgb/1.jpg", "fir/1.png", "rgb/2.jpg", "truth/rig.toml"):
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        (tree / name).touch()
    found = load_manifest(path)
    with suppress(FusionError):  # most sets look for more than is in this tree
        _inside(found.plan(tree), tree.resolve())
    return ""


def _inside(value: Any, root: Path) -> None:
    """All paths anywhere in a plan."""
    if isinstance(value, Path):
        assert value.resolve().is_relative_to(root), f"{value} leads out of {root}"
    elif isinstance(value, dict):
        _inside([*value.values()], root)
    elif isinstance(value, list | tuple):
        for item in value:
            _inside(item, root)
    elif hasattr(value, "__dataclass_fields__"):
        _inside([getattr(value, name) for name in value.__dataclass_fields__], root)


def rig(path: Path, seed: Seed) -> str:
    del seed
    from fusion.rig import load_rig

    load_rig(path)
    return ""


def calibration(path: Path, seed: Seed) -> str:
    del seed
    from calib.formats import read_with_notes

    read_with_notes(path, SIZE, any_size=True)
    return ""


def settings(path: Path, seed: Seed) -> str:
    del seed
    from fusion.preprocess.config import load_preprocess_config

    load_preprocess_config(path, {})
    return ""


def record(path: Path, seed: Seed) -> str:
    del seed
    from fusion.chunks import Chunk
    from fusion.preprocess.records import read_record

    found = read_record(path.read_bytes(), "ab12", Chunk(3, 10, 20, 4))
    return found if isinstance(found, str) else ""


def storage_name(path: Path, seed: Seed) -> str:
    """A name that is let through stays below the root, by the system's own rules."""
    from fusion.storage import checked_name

    name = checked_name(seed.about)
    root = str(path.parent)
    whole = os.path.normpath(os.path.join(root, name))  # noqa: PTH118, the oracle is not pathlib
    assert whole.startswith(root + os.sep), f"{name!r} leads out"
    assert not name.startswith("/"), f"{name!r} is absolute"
    return ""


def rows(path: Path, seed: Seed) -> str:
    del seed
    from fusion.preprocess.rows import FrameRow
    from fusion.sinks.depth import DepthRow
    from fusion.sinks.index import Row, read_rows

    for kind in (FrameRow, Row, DepthRow):
        read_rows(path, kind)
    return ""


def inspected(path: Path, seed: Seed) -> str:
    """The whole call as the command line makes it, and all that it prints."""
    from fusion.cli.inspect import _calibration_kind
    from fusion.inspect import inspect
    from fusion.inspect.page import page_of
    from fusion.inspect.record import json_of
    from fusion.inspect.text import text_of

    pictures = sum(map(len, seed.files.values())) % 3 == 0
    finding = inspect(path, full=not pictures, pictures=pictures, also=(_calibration_kind(),))
    assert json_of(finding)
    assert list(text_of(finding))
    if pictures:
        assert page_of(finding)
    return ""


# Shares are by what an input of each costs. Bounds above 512 MiB are those that a format's own stated limit
# asks for: a chunk, or a packed message, may unpack to 1 GiB.
READERS: dict[str, Reader] = {
    reader.name: reader
    for reader in (
        Reader("rosbag1", "ROS 1 bags: plain, lz4, bz2", recording, "rosbag1", share=2, bound_mib=1536),
        Reader(
            "sqlite",
            "rosbag2 as SQLite with metadata.yaml: plain, packed messages and files, split",
            recording,
            "sqlite",
            share=2,
            bound_mib=1536,
        ),
        Reader(
            "rosbag2-mcap",
            "rosbag2 as MCAP with metadata.yaml",
            recording,
            "rosbag2-mcap",
            share=1.5,
            bound_mib=1536,
        ),
        Reader(
            "mcap",
            "MCAP, four wires: plain, lz4, zstd, with and without CRCs",
            recording,
            "mcap",
            share=3,
            bound_mib=1536,
        ),
        Reader(
            "messages",
            "messages and their definitions over every wire, and what is made of them",
            message,
            "messages",
            share=5,
        ),
        Reader(
            "definitions",
            ".msg, IDL and JSON messages, drawn by their grammar",
            definition,
            make=made.definition,
            made=1.0,
            share=1.5,
        ),
        Reader(
            "pixels",
            "raw and compressed images of any encoding, size and step, drawn; compressedDepth",
            drawn_message,
            make=made.picture,
            made=1.0,
            share=2,
        ),
        Reader(
            "points",
            "clouds of any fields, offsets and steps, and camera infos, drawn",
            drawn_message,
            make=made.points,
            made=1.0,
            share=2,
        ),
        Reader("images", "image files: PNG, JPEG, TIFF, BMP, WebP, PNM", image, "images", share=3),
        Reader("flir", "radiometric JPEGs", flir, "flir", share=2),
        Reader("clouds", "PCD, PLY, .bin, LAS, LAZ, NPY, NPZ", cloud, "clouds", share=3),
        Reader(
            "manifests", "data sets' TOML, and what they find in a tree", manifest, "toml", made.toml, 0.2, 2
        ),
        Reader("rig", "rig.toml", rig, "rig", made.toml, 0.2, 1),
        Reader("calibrations", "other tools' calibrations: YAML, JSON, text", calibration, "rigs", share=2),
        Reader("settings", "the configuration of preprocess", settings, "settings", made.toml, 0.2, 1),
        Reader("records", "records of chunks", record, "records", share=0.7),
        Reader("names", "names in a storage", storage_name, make=made.storage_name, made=1.0, share=0.7),
        Reader("rows", "frames.csv", rows, "rows", share=0.5),
        Reader("inspect", "fusion inspect of any of the files", inspected, "any", share=0.8, bound_mib=1536),
    )
}
