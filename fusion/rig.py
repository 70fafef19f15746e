"""The rig: how its cameras see, and how its sensors stand to each other. `rig.toml` in and out.

format = "fusion-rig/1"

[cameras.rgb]
model = "pinhole"                # or fisheye
size_wh = [640, 480]
focal_px = [520.0, 520.0]
centre_px = [319.5, 239.5]       # (0, 0) is the centre of the top-left pixel
distortion = [-0.1, 0.02, 0.0, 0.0, 0.0]   # pinhole: none, 4, 5 or 8; fisheye: none or 4

[transforms]
T_rgb_lidar = [[0, -1, 0, 0.05], [0, 0, -1, 0.1], [1, 0, 0, 0], [0, 0, 0, 1]]

[time_offset_s]                  # optional: added to a sensor's stamps to give the reference's clock
fir = 0.012

[evidence]                       # optional, free: what a calibration says of itself
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tomlkit
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, PositiveInt, ValidationError

from fusion.errors import UsageError
from fusion.files import replace_file
from fusion.geometry import FisheyeCamera, Floats, PinholeCamera, checked_pose, invert

FORMAT = "fusion-rig/1"
RigCamera = PinholeCamera | FisheyeCamera
_LARGEST_FILE_BYTES = 1 << 24
_TRANSFORM = re.compile(r"T_([a-z0-9]+)_([a-z0-9]+)")
_MODELS: dict[str, type[PinholeCamera] | type[FisheyeCamera]] = {
    "pinhole": PinholeCamera,
    "fisheye": FisheyeCamera,
}


@dataclass(frozen=True, slots=True)
class Rig:
    """Cameras by name (``rgb``, ``fir``), and rigid 4 x 4 transformations by ``T_dst_src``.

    `time_offset_s` by sensor is added to its stamps to give the reference's clock. `evidence` is what the
    calibration says of itself: tables, lists, numbers and texts as TOML has them, kept as they are.
    """

    cameras: Mapping[str, RigCamera] = field(default_factory=dict)
    transforms: Mapping[str, Floats] = field(default_factory=dict)
    time_offset_s: Mapping[str, float] = field(default_factory=dict)
    evidence: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Own copies, their rotations orthonormal. `UsageError` for one that is not rigid, or misnamed."""
        rigid = {}
        for name, T in self.transforms.items():
            _sensors(name)
            try:
                rigid[name] = checked_pose(T)
            except UsageError as error:
                raise UsageError(f"{name}: {error.what}", hint=error.hint) from None
        object.__setattr__(self, "transforms", rigid)

    def camera(self, name: str) -> RigCamera:
        """The camera `name`. Raises `UsageError` that lists those there are."""
        if name not in self.cameras:
            hint = f"the rig has {', '.join(sorted(self.cameras)) or 'none'}"
            raise UsageError(f"no camera {name!r} in the rig", hint=hint)
        return self.cameras[name]

    def pose(self, dst: str, src: str) -> Floats:
        """T_dst_src, 4 x 4, along the shortest chain of known transformations, inverted where need be.

        Raises `UsageError` where nothing links the two.
        """
        chains: dict[str, Floats] = {src: checked_pose([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]])}
        reached = [src]
        for sensor in reached:
            for a, b, T_a_b in self._links():
                if b == sensor and a not in chains:
                    chains[a] = T_a_b @ chains[sensor]
                    reached.append(a)
        if dst not in chains:
            hint = f"it has {', '.join(sorted(self.transforms)) or 'no transformation'}"
            raise UsageError(f"the rig does not say how {dst} stands to {src}", hint=hint)
        return chains[dst]

    def _links(self) -> list[tuple[str, str, Floats]]:
        links = []
        for name, T in self.transforms.items():
            dst, src = _sensors(name)
            links += [(dst, src, T), (src, dst, invert(T))]
        return links


def load_rig(path: str | Path) -> Rig:
    """Read a rig.toml. Raises `UsageError` naming the file and the key."""
    try:
        content = _RigFile.model_validate(tomllib.loads(_text(path)))
        cameras = {name: _camera(name, entry) for name, entry in content.cameras.items()}
        transforms = {name: np.array(rows, np.float64) for name, rows in content.transforms.items()}
        return Rig(cameras, transforms, content.time_offset_s, content.evidence)
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in problem["loc"])
        raise UsageError(
            f"{key}: {problem['msg'].lower()}", where=path, hint="see docs/conventions.md"
        ) from None
    except (ValueError, RecursionError) as error:  # no TOML, or one made to break its reader
        raise UsageError(f"the rig cannot be read: {error}", where=path) from None
    except UsageError as error:
        raise UsageError(error.what, where=path, hint=error.hint) from None


def save_rig(path: str | Path, rig: Rig) -> None:
    """Write a rig.toml; reading it gives the same numbers. Raises `OutputError`."""
    content: dict[str, object] = {
        "format": FORMAT,
        "cameras": {name: _entry(camera) for name, camera in rig.cameras.items()},
        "transforms": {name: [[float(x) for x in row] for row in T] for name, T in rig.transforms.items()},
    }
    if rig.time_offset_s:
        content["time_offset_s"] = {name: float(s) for name, s in rig.time_offset_s.items()}
    if rig.evidence:
        content["evidence"] = dict(rig.evidence)
    replace_file(Path(path), tomlkit.dumps(content).encode())


def _text(path: str | Path) -> str:
    try:
        with Path(path).open("rb") as file:
            data = file.read(_LARGEST_FILE_BYTES + 1)
    except OSError as error:
        raise UsageError(f"the rig cannot be read: {error.strerror or error}") from None
    if len(data) > _LARGEST_FILE_BYTES:
        raise UsageError("too large for a rig")
    return data.decode("utf-8")


class _CameraEntry(BaseModel):
    model_config = ConfigDict(extra="forbid")

    model: Literal["pinhole", "fisheye"]
    size_wh: tuple[PositiveInt, PositiveInt]
    focal_px: tuple[FiniteFloat, FiniteFloat]
    centre_px: tuple[FiniteFloat, FiniteFloat]
    distortion: tuple[FiniteFloat, ...] = ()


_Row = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]


class _RigFile(BaseModel):
    model_config = ConfigDict(extra="forbid")

    format: Literal["fusion-rig/1"]
    cameras: dict[str, _CameraEntry] = {}
    transforms: dict[str, Annotated[list[_Row], Field(min_length=3, max_length=4)]] = {}
    time_offset_s: dict[str, FiniteFloat] = {}
    evidence: dict[str, Any] = {}


def _camera(name: str, entry: _CameraEntry) -> RigCamera:
    try:
        return _MODELS[entry.model](entry.size_wh, *entry.focal_px, *entry.centre_px, entry.distortion)
    except UsageError as error:
        raise UsageError(f"cameras.{name}: {error.what}", hint=error.hint) from None


def _entry(camera: RigCamera) -> dict[str, object]:
    model = next(name for name, kind in _MODELS.items() if isinstance(camera, kind))
    return {
        "model": model,
        "size_wh": [int(n) for n in camera.size_wh],
        "focal_px": [float(camera.fx), float(camera.fy)],
        "centre_px": [float(camera.cx), float(camera.cy)],
        "distortion": [float(k) for k in camera.distortion],
    }


def _sensors(name: str) -> tuple[str, str]:
    found = _TRANSFORM.fullmatch(name)
    if found is None:
        raise UsageError(f"{name!r} is no transformation's name", hint="T_dst_src, such as T_rgb_lidar")
    return found[1], found[2]
