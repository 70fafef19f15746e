"""What all readers and writers of calibrations share: the request, names, lenses, and words for losses."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from fusion.errors import UsageError
from fusion.geometry import FisheyeCamera, Floats, PinholeCamera, checked_pose
from fusion.rig import Rig, RigCamera

SizeWH = tuple[int, int]
Notes = tuple[str, ...]
Read = tuple[Rig, Notes]
_NAME = re.compile(r"[a-z0-9]+")
_THERMAL = {"fir", "ir", "lwir", "mwir", "tir", "infra", "infrared", "boson", "lepton"}
_VISIBLE = {"rgb", "color", "colour", "visible", "vis", "bgr"}


@dataclass(frozen=True, slots=True)
class Asked:
    """What the caller says beside the file: sizes of pictures by camera, names of its cameras in order."""

    size_wh: Mapping[str, SizeWH] = field(default_factory=dict)
    names: tuple[str, ...] | None = None

    def size(self, name: str, path: Path) -> SizeWH:
        """The size of `name`'s pictures, for files that do not say it. `UsageError` if nobody does."""
        if name in self.size_wh:
            return self.size_wh[name]
        what = "the calibration does not say how large the pictures are"
        hint = f"give width and height of {name}'s images (size_wh; converting: --size, checking: --{name})"
        raise UsageError(what, where=path, hint=hint)


@dataclass(frozen=True, slots=True)
class Written:
    """The files that a rig becomes, and what they do not say."""

    files: Mapping[Path, str]
    notes: Notes = ()


# --- names


def named(hints: Sequence[str], asked: Asked, path: Path) -> tuple[tuple[str, ...], Notes]:
    """Names of the cameras that a file lists, and how they were come by.

    `hints` are what the file says of each (topic, name), in its order. Names asked for win, in that order.
    Else a hint with a word such as ``thermal``, ``lwir``, ``ir`` means ``fir``, ``rgb`` or ``color`` means
    ``rgb``, and what is left is rgb, fir, cam2 ... in order. Raises `UsageError` for too few names, or
    unusable ones.
    """
    if asked.names is not None:
        return _as_asked(asked.names, len(hints), path), ()
    told = [_told(hint) for hint in hints]
    if len(set(filter(None, told))) < len(list(filter(None, told))):
        told = [None] * len(hints)  # two thermal cameras: their order has to do
    free = (name for name in ("rgb", "fir") if name not in told)
    names = tuple(t or next(free, f"cam{i}") for i, t in enumerate(told))
    guessed = [f"{hint or f'camera {i}'} as {names[i]}" for i, hint in enumerate(hints) if told[i] is None]
    if not guessed:
        return names, ()
    return names, (f"taken by their order, no name says it: {', '.join(guessed)}",)


def _as_asked(names: tuple[str, ...], count: int, path: Path) -> tuple[str, ...]:
    if len(names) < count:
        raise UsageError(f"{count} cameras, but {len(names)} names", where=path, hint=", ".join(names))
    bad = [name for name in names if _NAME.fullmatch(name) is None]
    if bad or len(set(names)) < len(names):
        hint = "different ones, of small letters and digits, such as rgb, fir"
        raise UsageError(f"unusable names of cameras: {', '.join(bad or names)}", where=path, hint=hint)
    return names[:count]


def _told(hint: str) -> str | None:
    words = set(re.findall(r"[a-z]+", hint.lower()))
    if words & _THERMAL or any(word.startswith("therm") for word in words):
        return "fir"
    return "rgb" if words & _VISIBLE else None


# --- lenses and transformations


def rigid(matrix: ArrayLike, key: str, path: Path) -> Floats:
    """A 4 x 4 rigid transformation out of a key's numbers, its rotation made orthonormal."""
    try:
        return checked_pose(matrix)
    except UsageError as error:
        raise UsageError(f"{key}: {error.what}", where=path, hint=error.hint) from None


def focal(K: Floats, key: str, path: Path) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a 3 x 3 camera matrix. `UsageError` for skew, scale, and zeros (no calibration)."""
    if K[0, 0] == 0 and K[1, 1] == 0:
        what = f"{key}: the camera is uncalibrated (its focal length is 0)"
        raise UsageError(what, where=path, hint="ROS drivers write zeros where they have no calibration")
    if K[0, 1] != 0 or K[1, 0] != 0 or tuple(K[2]) != (0, 0, 1):
        hint = "fx 0 cx, 0 fy cy, 0 0 1"
        raise UsageError(f"{key} is no camera matrix without skew", where=path, hint=hint)
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def lens(
    size_wh: SizeWH,
    focal: Sequence[float],
    D: Sequence[float],
    key: str,
    path: Path,
    *,
    fisheye: bool = False,
) -> RigCamera:
    """The camera of focal lengths, centre and distortion (OpenCV's order). `UsageError` that names `key`.

    12 or 14 coefficients are accepted if those of thin prisms and tilt are 0: no model here has them.
    """
    D = tuple(float(k) for k in D)
    if not fisheye and len(D) in (12, 14) and not any(D[8:]):
        D = D[:8]
    try:
        return (FisheyeCamera if fisheye else PinholeCamera)(
            size_wh, focal[0], focal[1], focal[2], focal[3], D
        )
    except UsageError as error:
        raise UsageError(f"{key}: {error.what}", where=path, hint=error.hint) from None


def padded(camera: RigCamera, count: int, form: str, name: str) -> tuple[float, ...]:
    """Exactly `count` coefficients: zeros added. `UsageError` if the camera has more that are not 0."""
    D = tuple(float(k) for k in camera.distortion)
    if any(D[count:]):
        what = f"{form} takes {count} distortion coefficients; camera {name} has {len(D)}"
        raise UsageError(what, hint="calibrate it with --model radtan, or write another form")
    return (D + (0.0,) * count)[:count]


# --- what is lost


def order(rig: Rig) -> list[str]:
    """The rig's cameras: rgb, fir, then the others as they stand."""
    return sorted(rig.cameras, key=lambda name: {"rgb": 0, "fir": 1}.get(name, 2))


def losses(
    rig: Rig, form: str, cameras: Iterable[str], sensors: Iterable[str], *, time: bool = False
) -> Notes:
    """What `form` leaves out if it says only these cameras, what is between these sensors (and time)."""
    sensors, kept = set(sensors), set(cameras)
    lost = [f"camera {name}" for name in order(rig) if name not in kept]
    lost += [name for name in rig.transforms if not set(name.split("_")[1:]) <= sensors]
    offsets = rig.time_offset_s
    if not time and offsets:
        lost.append(f"time offsets of {', '.join(offsets)}")
    known = {"cameras", "transforms", "time_offset_s"}
    lost += [f.name.replace("_", " ") for f in fields(rig) if f.name not in known and getattr(rig, f.name)]
    return (f"{form} cannot say, so not written: {'; '.join(lost)}",) if lost else ()


def camera_matrix(camera: RigCamera) -> Floats:
    """The 3 x 3 matrix, of a fisheye too."""
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], np.float64)


def known_pose(rig: Rig, dst: str, src: str) -> Floats | None:
    """`Rig.pose`, None where nothing links the two."""
    try:
        return rig.pose(dst, src)
    except UsageError:
        return None


def without_size(form: str, camera: RigCamera) -> Notes:
    """That the reader of the file has to say how large the pictures are."""
    w, h = camera.size_wh
    return (f"{form} does not say the size of pictures: give {w}x{h} when reading it",)


def needed(rig: Rig, name: str, form: str) -> RigCamera:
    """The camera that `form` cannot do without."""
    if name not in rig.cameras:
        hint = f"the rig has {', '.join(rig.cameras) or 'none'}"
        raise UsageError(f"{form} needs camera {name}", hint=hint)
    return rig.cameras[name]
