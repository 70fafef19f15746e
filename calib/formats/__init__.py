"""Calibrations of other tools, read as a `fusion.rig.Rig` and written from one; forms are told by content."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from calib.formats import kalibr, kitti, koide, opencv, plain, ros
from calib.formats.common import Asked, Notes, Read, SizeWH, Written
from calib.formats.document import Node, parse_json, parse_yaml
from calib.formats.plain import FORMS
from fusion.errors import UsageError
from fusion.files import replace_file
from fusion.geometry import PinholeCamera
from fusion.rig import Rig, load_rig, save_rig
from fusion.tables import lookup

Sizes = SizeWH | Mapping[str, SizeWH] | None
_TOML = re.compile(r"[ \t]*(\[|[\w.\"'-]+[ \t]*=)")
_YAML = re.compile(r"^(%YAML|---|[ \t]*- |[ \t]+[\w.]+[ \t]*:|[\w.]+[ \t]*:[ \t]*[\[{!])", re.MULTILINE)
_MOST_FILES = 16


@dataclass(frozen=True, slots=True)
class Form:
    """A form that can be written: how, what it says of a rig, and the names of files it goes by."""

    write: Callable[[Rig, Path], Written] | None
    says: str
    goes_by: str  # a pattern of the file's name


FORMATS: dict[str, Form] = {
    "rig": Form(None, "everything", r".*\.toml"),
    "kalibr": Form(
        kalibr.write,
        "cameras with radtan (4) or equidistant distortion, their chain, the IMU, time offsets; no LiDAR",
        r".*camchain.*\.ya?ml|.*kalibr.*\.ya?ml",
    ),
    "ros": Form(
        ros.write,
        "intrinsics of one camera a file, every lens; no transformation",
        r".*(camera_info|ros|head_camera).*\.ya?ml",
    ),
    "opencv": Form(
        opencv.write,
        "everything; of it R, T of two cameras, and lenses, under OpenCV's own names",
        r".*\.yml|.*(opencv|stereo|intrinsics|extrinsics).*\.ya?ml",
    ),
    "kitti": Form(
        kitti.write_object,
        "one camera of undistorted images, and the LiDAR; no size of pictures",
        r"calib.*\.txt|\d{6,10}\.txt",
    ),
    "kitti-raw": Form(
        kitti.write_raw,
        "one camera of undistorted images, and the LiDAR, as two files in a folder",
        r"calib_(cam_to_cam|velo_to_cam)\.txt",
    ),
    "koide": Form(
        koide.write, "one camera with plumb_bob or fisheye, and the LiDAR; no size of pictures", r".*\.json"
    ),
    "plain": Form(
        plain.write, "one pinhole camera, and the LiDAR; no size of pictures", r".*(kdt|plain).*\.txt"
    ),
}


def read_rig(path: str | Path, size_wh: Sizes = None, names: Sequence[str] | None = None) -> Rig:
    """The rig that a calibration file, or the folder of a KITTI raw recording or of ROS files, describes.

    `size_wh` is the size of the pictures of the first camera (``rgb``), or by camera: required where the form
    does not say it (KITTI object, koide3, K D T text). `names` are the cameras' in the file's order; else
    they are told from topics and names (``thermal``, ``lwir`` ...), or rgb then fir. Rotations are made
    orthonormal (files round them). Raises `UsageError` that names file and key for whatever is wrong, another
    size than the form's included. What of the file has no place in a rig, `read_with_notes` tells.
    """
    return read_with_notes(path, size_wh, names)[0]


def read_with_notes(
    path: str | Path,
    size_wh: Sizes = None,
    names: Sequence[str] | None = None,
    *,
    any_size: bool = False,
) -> Read:
    """`read_rig`, and in one line each what was guessed, and what of the file is not kept.

    With `any_size`, sizes other than those asked for are let through.
    """
    path = Path(path)
    names = tuple(names) if names is not None else None
    sizes = dict(size_wh) if isinstance(size_wh, Mapping) else {}
    if size_wh is not None and not isinstance(size_wh, Mapping):
        sizes[names[0] if names else "rgb"] = size_wh
    rig, notes = _read(path, Asked(sizes, names))
    for name, size in sizes.items():
        camera = rig.cameras.get(name)
        if camera is not None and tuple(size) != tuple(camera.size_wh) and not any_size:
            theirs, ours = ("{}x{}".format(*s) for s in (camera.size_wh, size))
            of = "" if name == "rgb" else f" of {name}"
            raise UsageError(
                f"the calibration is for pictures{of} of {theirs} pixels, not {ours}", where=path
            )
    return rig, notes


def write_rig(path: str | Path, rig: Rig, form: str, *, force: bool = False) -> Notes:
    """Write `rig` in one of `FORMATS`; what it cannot say, in one line each.

    `path` is a file; a folder for ``kitti-raw``, and for ``ros`` with several cameras. Every number is
    written to its last digit. Raises `UsageError` where leaving something out would make the file wrong (a
    fisheye in KITTI's form; more coefficients than the form has); `force` leaves the distortion of rgb out in
    KITTI's forms, which describe undistorted images. `OutputError` if it cannot be written.
    """
    path = Path(path)
    writer = lookup(FORMATS, "fusion.calibrations", form, "form of calibration").write
    if writer is None:
        save_rig(path, rig)
        return ()
    notes: Notes = ()
    if force and form.startswith("kitti"):
        rig, notes = _undistorted(rig)
    written = writer(rig, path)
    for file, text in written.files.items():
        replace_file(file, text.encode())
    return notes + written.notes


def _undistorted(rig: Rig) -> tuple[Rig, Notes]:
    camera = rig.cameras.get("rgb")
    if not isinstance(camera, PinholeCamera) or not any(camera.distortion):
        return rig, ()
    cameras = {**rig.cameras, "rgb": replace(camera, distortion=())}
    note = "the distortion of rgb is left out: undistort the images with the same camera matrix"
    return replace(rig, cameras=cameras), (note,)


def convert(
    src: str | Path,
    dst: str | Path,
    form: str | None = None,
    *,
    size_wh: Sizes = None,
    names: Sequence[str] | None = None,
    force: bool = False,
) -> Notes:
    """Read `src`, write `dst` in `form` (None: as its name says); what was guessed and lost, a line each."""
    form = form or form_of_name(dst)
    rig, notes = read_with_notes(src, size_wh, names)
    return notes + write_rig(dst, rig, form, force=force)


def form_of_name(path: str | Path) -> str:
    """The form that a file's name stands for. `UsageError` lists the forms where it stands for none."""
    path = Path(path)
    for form in ("kitti-raw", "plain", *FORMATS):
        if re.fullmatch(FORMATS[form].goes_by, path.name.lower()):
            if form == "kitti-raw":
                hint = f"give the folder, and the form kitti-raw: {path.parent}"
                raise UsageError("KITTI's raw form is two files", where=path, hint=hint)
            return form
    hint = f"say which: {', '.join(FORMATS)}"
    raise UsageError("the name does not tell the form of the calibration", where=path, hint=hint)


# --- telling forms by content


def _read(path: Path, asked: Asked) -> Read:
    if path.is_dir():
        return _folder(path, asked)
    if path.suffix == ".toml" and path.is_file() and path.stat().st_size > plain.LARGEST_BYTES:
        return load_rig(path), ()  # a rig's evidence may be large
    text = plain.read_text(path)
    if text.lstrip().startswith("<"):
        raise UsageError("XML is not read", where=path, hint="let OpenCV write a file named .yml instead")
    if text.lstrip().startswith("{"):
        return _tree(parse_json(text, path), asked)
    if _is_toml(text):
        return load_rig(path), ()
    if _YAML.search(text):
        return _tree(parse_yaml(text, path), asked)
    lines = plain.entries(text, path)
    if "P_rect_02" in lines or {"R", "T", "delta_f"} <= lines.keys():
        return kitti.read_raw(path.parent, asked)
    if lines.keys() & {"P2", "R0_rect", "Tr_velo_to_cam"}:
        return kitti.read_object(lines, path, asked)
    if lines.keys() & {"K", "D"}:
        return plain.read_plain(lines, path, asked)
    raise _unknown(path)


def _is_toml(text: str) -> bool:
    """Whether the first line that says something is one of TOML's."""
    lines = (line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#"))
    return _TOML.match(next(lines, "")) is not None


def _tree(tree: Node, asked: Asked) -> Read:
    if kalibr.matches(tree):
        return kalibr.read(tree, asked)
    if ros.matches(tree):
        return ros.read(tree, asked)
    if koide.matches(tree):
        return koide.read(tree, asked)
    if opencv.matches(tree):
        return opencv.read(tree, asked)
    raise _unknown(tree.path)


def _unknown(path: Path) -> UsageError:
    return UsageError("no calibration of a known form", where=path, hint=f"expected {FORMS}")


def _folder(folder: Path, asked: Asked) -> Read:
    if any((folder / name).exists() for name in (kitti.CAMERAS_FILE, kitti.LIDAR_FILE)):
        return kitti.read_raw(folder, asked)
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in (".yaml", ".yml") and p.is_file())
    trees = [(p, parse_yaml(plain.read_text(p), p)) for p in files[: _MOST_FILES + 1]]
    found = [(p, tree) for p, tree in trees if ros.matches(tree)]
    if not found or len(files) > _MOST_FILES:
        raise UsageError("no calibration in this folder", where=folder, hint=f"expected {FORMS}")
    return ros.read_several([tree for _, tree in found], asked, folder)
