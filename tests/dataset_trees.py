"""Data sets in miniature, built from a manifest's own patterns: two sequences of two frames each."""

from __future__ import annotations

import json
import pickle
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from calib.formats import write_rig
from fusion.clouds import write_pcd
from fusion.frames import PointCloud
from fusion.geometry import PinholeCamera
from fusion.manifest import Manifest
from fusion.rig import Rig, save_rig

COUNT = 4
START_S = 1_600_000_000
SMALL_WH = (64, 48)
PICKLED = "was_unpickled"


@dataclass(frozen=True)
class Tree:
    """What was built: per frame the files by role, relative to the root."""

    root: Path
    frames: list[dict[str, str]]

    def pairs(self, lead: str, role: str) -> list[tuple[str, str]]:
        return [(frame[lead], frame[role]) for frame in self.frames]


def from_pattern(pattern: str, k: int, *, numbered: bool = False) -> str:
    """The file of frame `k` that a pattern stands for.

    In a folder `*` becomes the sequence's number; in a name a time stamp in seconds, a minute apart, or (with
    `numbered`) the frame's number in its sequence.
    """
    assert not re.search(r"\[[!^]", pattern), "name a set without negation"
    pattern = re.sub(r"\[(.)[^]]*\]", r"\1", pattern)
    *folders, name = pattern.split("/")
    number = f"{k % 2:010d}" if numbered else str(START_S + 60 * k)
    parts = [folder.replace("*", str(k // 2)).replace("?", str(k // 2)) for folder in folders]
    name = name.replace("*", number).replace("?", str(k))
    return "/".join([*parts, name if "." in name else f"{name}.png"])


def frame_files(manifest: Manifest, k: int) -> dict[str, str]:
    """The files of frame `k` by role."""
    return {
        role: from_pattern(pattern, k, numbered=manifest.files_of(role).stamp_files is not None)
        for role, pattern in manifest.layout()
    }


def build(manifest: Manifest, root: Path) -> Tree:
    """Four frames, their clouds, depth, stamps, mapping file and calibrations."""
    frames = [frame_files(manifest, k) for k in range(COUNT)]
    for k, frame in enumerate(frames):
        for role, name in frame.items():
            write_role(root / name, manifest, role, k)
    _stamp_files(manifest, root)
    if manifest.pairing is not None and manifest.pairing.map_file is not None:
        _mapping(root / manifest.pairing.map_file, frames)
    if manifest.calibration is not None:
        _calibrations(manifest, root)
    return Tree(root, frames)


def size_of(manifest: Manifest, role: str) -> tuple[int, int]:
    return getattr(manifest.checks, f"{role}_size_wh", None) or SMALL_WH


def write_role(path: Path, manifest: Manifest, role: str, k: int = 0) -> None:
    """One file of a role: of the size and bits that the manifest states, nearly empty."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if role == "lidar":
        _cloud(path)
        return
    width, height = size_of(manifest, "rgb" if role in ("rgbt", "depth", "sparse") else role)
    mosaic = role == "rgb" and manifest.rgb is not None and manifest.rgb.bayer is not None
    channels = {"rgb": 1 if mosaic else 3, "rgbt": 4}.get(role, 1)
    deep = role in ("depth", "sparse") or (role == "fir" and manifest.checks.fir_bits == 16)
    pixels = np.zeros((height, width, channels), np.uint16 if deep else np.uint8)
    pixels[: height // 2] = 60 + 20 * k
    assert cv2.imwrite(str(path), pixels)


def _cloud(path: Path) -> None:
    points = np.random.default_rng(0).normal(0, 5, (20, 3)).astype(np.float32)
    if path.suffix == ".pcd":
        write_pcd(path, PointCloud(points))
        return
    path.write_bytes(np.column_stack([points, np.ones(20, np.float32)]).astype("<f4").tobytes())


def _stamp_files(manifest: Manifest, root: Path) -> None:
    """As KITTI writes them: a date, and nine digits of a second."""
    patterns = [manifest.files_of(role).stamp_files for role, _ in manifest.layout()]
    for pattern in filter(None, patterns):
        for sequence in range(2):
            path = root / from_pattern(pattern, 2 * sequence)
            lines = [f"2011-09-26 13:0{sequence}:0{k}.964389445" for k in range(2)]
            path.write_text("\n".join(lines) + "\n")


def _mapping(path: Path, frames: list[dict[str, str]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [(Path(frame["rgb"]).name, Path(frame["fir"]).name) for frame in frames]
    csv = "\n".join(["rgb,fir", *(",".join(row) for row in rows)])
    path.write_text(json.dumps(dict(rows)) if path.suffix == ".json" else csv)


class Harmful:
    """Unpickled, it leaves a file behind."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return (Path.touch, (self.path,))


def rig_for(manifest: Manifest) -> Rig:
    """Cameras of the sizes that the images have, and a LiDAR, in no special place."""
    cameras = {
        name: PinholeCamera(size, 300.0, 300.0, (size[0] - 1) / 2, (size[1] - 1) / 2)
        for name in ("rgb", "fir")
        for size in [size_of(manifest, name)]
        if name == "rgb" or manifest.has_thermal()
    }
    T = np.eye(4)
    T[:3, 3] = 0.1, 0.0, 0.0
    transforms = {"T_rgb_lidar": T, **({"T_rgb_fir": T} if "fir" in cameras else {})}
    return Rig(cameras, transforms)


def _calibrations(manifest: Manifest, root: Path) -> None:
    part = manifest.calibration
    assert part is not None
    for k in {"set": [0], "sequence": [0, 2], "frame": range(COUNT)}[part.per]:
        path = root / from_pattern(part.files, k)
        path.parent.mkdir(parents=True, exist_ok=True)
        rig = rig_for(manifest)
        if part.form is None:
            path.write_bytes(pickle.dumps(Harmful(root / PICKLED)))
        elif part.form == "rig":
            save_rig(path, rig)
        else:
            write_rig(path.parent if part.form == "kitti-raw" else path, rig, part.form)
