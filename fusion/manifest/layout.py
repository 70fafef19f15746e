"""What a manifest finds below a root: the files, recordings and calibrations of one data set, and how they go
together.

`Manifest.plan(root)` makes a `Layout`. Everything it names was found there and lies inside the root.

    layout = load_manifest("kitti_raw").plan(root)
    pairs = open_pairs(layout["rgb"].glob, layout["fir"].glob, layout["fir"].rule)  # of an ordinary set
    clouds = layout.partners("lidar")                      # which cloud goes with which RGB image
    rig_file = layout.calibration_of(clouds.lead[0])       # of that frame's sequence
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from fusion.errors import InputError
from fusion.manifest.stamps import StampFiles
from fusion.pairing import Pairing, PairingRule, pair

if TYPE_CHECKING:
    from fusion.manifest.model import Manifest
    from fusion.sources.base import Entry, Source

WORDS = {"rgb": "RGB", "fir": "thermal", "lidar": "LiDAR", "depth": "depth", "sparse": "sparse depth"}


@dataclass(frozen=True, slots=True)
class RoleFiles:
    """The files of one role, in natural order; `glob` finds the same files. Stems count from `home`, the
    pattern's fixed part.

    `rule` says how they go with the leading role's, that in RGB's place and this in thermal's; None for the
    leading role, and for thermal images that are not pairs. `form` is the clouds' reader, `per_metre` and
    `value` are the maps', `bayer` is the colour filter of images that are raw mosaics.
    """

    role: str
    glob: str
    home: Path
    files: tuple[Path, ...]
    rule: PairingRule | None = None
    stamps: Literal["name", "none"] | None = None
    stamp_files: tuple[Path, ...] = ()
    form: str | None = None
    per_metre: float | None = None
    value: Literal["depth", "range"] | None = None
    bayer: str | None = None

    def entries(self) -> list[Entry]:
        """The files as entries of a source: stems below the pattern's fixed part, stamps where a file says
        them.

        Stamps in names are left to whom they concern (`fusion.pairing.stamps_of`). Raises `InputError` for
        stamp files that cannot be read.
        """
        from fusion.clouds import stem_of
        from fusion.sources.base import Entry

        times = StampFiles(self.stamp_files).of(self.files) if self.stamp_files else [None] * len(self.files)
        stems = [stem_of(path.relative_to(self.home).as_posix()) for path in self.files]
        return [
            Entry(stem, str(path), time) for stem, path, time in zip(stems, self.files, times, strict=True)
        ]


@dataclass(frozen=True, slots=True)
class RecordingFiles:
    """The recordings (files or folders) in natural order; `topics` and tolerances by role; the clock."""

    files: tuple[Path, ...]
    topics: Mapping[str, str]
    stamp: Literal["header", "log"]
    tolerance_ns: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class CalibrationFiles:
    """The calibrations found. `form` None: known to be there, and not read, for the reason in `note`.

    `pattern` is absolute. `calib.formats.read_rig` takes a file, or the folder of one in form ``kitti-raw``
    and of several in form ``ros``: `readable` gives what to hand it.
    """

    files: tuple[Path, ...]
    pattern: str
    form: str | None
    per: Literal["set", "sequence", "frame"]
    note: str | None = None

    def readable(self) -> tuple[Path, ...]:
        """What a reader is given, once each; empty where the form is not read."""
        if self.form is None:
            return ()
        return tuple(dict.fromkeys(map(self.given, self.files)))

    def given(self, file: Path) -> Path:
        """What a reader is given for `file`: its folder where the form needs several files."""
        several = self.form == "ros" and sum(other.parent == file.parent for other in self.files) > 1
        return file.parent if self.form == "kitti-raw" or several else file


@dataclass(frozen=True, slots=True)
class Partners:
    """Which file of `role` goes with which of the leading role: `pairing` holds indices into `lead` and
    `files`.
    """

    role: str
    lead: tuple[Path, ...]
    files: tuple[Path, ...]
    pairing: Pairing

    def by_lead(self) -> dict[Path, Path]:
        return {self.lead[i]: self.files[j] for i, j, _ in self.pairing.pairs}


@dataclass(frozen=True, slots=True)
class Layout:
    """A data set as it lies below `root`: either `roles` (files by role) or `recording`.

    `lead` is the role that the others go with: ``rgb``, ``rgbt``, or the first there is. `missing` are roles
    that the manifest has and the root has not, but without which it can be used (clouds, depth).
    """

    manifest: Manifest
    root: Path
    lead: str
    roles: Mapping[str, RoleFiles]
    recording: RecordingFiles | None
    calibration: CalibrationFiles | None
    missing: tuple[str, ...] = ()
    _magic: Mapping[str, tuple[int, ...]] = field(default_factory=dict, repr=False)

    def __getitem__(self, role: str) -> RoleFiles:
        return self.roles[role]

    def open(self, role: Literal["rgb", "fir"], fir_colour: Literal["refuse", "luma"] = "refuse") -> Source:
        """The role's images as a source, with the stamps that its stamp files say; mosaics become colour.

        What `fusion.sources.open_source(self[role].glob, role)` opens, and more: this is the way to prefer.
        """
        from fusion.manifest.mosaics import MosaicFiles
        from fusion.sources.folders import FileSource

        files = self.roles[role]
        if role == "rgb" and files.bayer is not None:
            return MosaicFiles(files.glob, files.entries(), files.bayer)
        return FileSource(files.glob, files.entries(), role, fir_colour=fir_colour, max_pixels=2**27)

    def partners(self, role: str) -> Partners:
        """The files of `role` that go with the leading role's, by that role's rule; all others with the
        reason.

        Raises `InputError` where none do.
        """
        lead, files = self.roles[self.lead], self.roles[role]
        ours, theirs = lead.entries(), files.entries()
        try:
            pairing = pair(ours, theirs, files.rule)
        except InputError as error:
            raise InputError(_said(error.what, role), where=self.root, hint=_said(error.hint, role)) from None
        left = tuple(u._replace(reason=_said(u.reason, role)) for u in pairing.unmatched)
        return Partners(role, lead.files, files.files, replace(pairing, unmatched=left))

    def sequence_of(self, path: str | Path) -> str:
        """The folders of a leading file that its pattern leaves open, joined by `/`: ``set00/V000``; "" for
        none.
        """
        parts = Path(path).relative_to(self.root).parts
        return "/".join(parts[k] for k in self._magic.get(self.lead, ()) if k < len(parts) - 1)

    def calibration_of(self, path: str | Path) -> Path | None:
        """What `calib.formats.read_rig` is to read for that leading file (or recording); None where nothing
        covers it, or it is in a form that is not read.
        """
        found = self.calibration
        if found is None or found.form is None:
            return None
        given = [found.given(file) for file in found.files]
        if found.per == "set":
            return given[0] if given else None
        if found.per == "frame":
            return next(
                (g for f, g in zip(found.files, given, strict=True) if f.stem == Path(path).stem), None
            )
        homes = [self._open_folder(f) for f in found.files]
        covers = [
            (len(h.parts), g) for h, g in zip(homes, given, strict=True) if Path(path).is_relative_to(h)
        ]
        return max(covers, key=lambda c: c[0])[1] if covers else None

    def _open_folder(self, file: Path) -> Path:
        """The folder down to the last one that the calibration's pattern leaves open: what it covers."""
        parts = file.relative_to(self.root).parts
        last = max((k for k in self._magic.get("calibration", ()) if k < len(parts) - 1), default=-1)
        return self.root.joinpath(*parts[: last + 1])


def plan(manifest: Manifest, root: str | Path) -> Layout:
    """See `Manifest.plan`."""
    root = Path(root)
    check_root(manifest, root)
    if manifest.recording is not None:
        found = {"recording": tuple(files_inside(root, manifest.recording.files, folders=True))}
    else:
        found = {r: _of_kind(r, files_inside(root, p), manifest) for r, p in manifest.layout()}
    missing = tuple(role for role, files in found.items() if not files)
    for role in missing:
        if role in manifest.needed():
            raise _lacks(manifest, root, role)
    roles = {r: _role(manifest, root, r, f) for r, f in found.items() if f and r != "recording"}
    patterns = dict(manifest.layout())
    if manifest.calibration is not None:
        patterns["calibration"] = manifest.calibration.files
    magic = {role: _open_parts(pattern) for role, pattern in patterns.items()}
    return Layout(
        manifest,
        root,
        manifest.lead(),
        roles,
        _recording(manifest, found.get("recording", ())),
        _calibration(manifest, root),
        missing,
        magic,
    )


def check_root(manifest: Manifest, root: Path) -> None:
    if not root.is_dir():
        raise InputError(f"no such folder: the root of {manifest.name}", where=root, hint=expected(manifest))


def _lacks(manifest: Manifest, root: Path, role: str) -> InputError:
    pattern = dict(manifest.layout())[role]
    kind = {"lidar": "cloud", "depth": "depth map", "sparse": "depth map", "recording": "recording"}
    noun = kind.get(role, f"{role} image")
    what = f"does not hold {manifest.name}: no {noun} matches '{pattern}'"
    return InputError(what, where=root, hint=_root_hint(manifest, root) + expected(manifest))


def expected(manifest: Manifest) -> str:
    layout = " and ".join(
        f"ROOT/{pattern}" for role, pattern in manifest.layout() if role in manifest.needed()
    )
    where = f"; get the set from {manifest.url}" if manifest.url else ""
    return f"expected {layout}{where}"


def _root_hint(manifest: Manifest, root: Path) -> str:
    """The folder directly above or below `root` that would have been the right one."""
    patterns = [pattern for role, pattern in manifest.layout() if role in manifest.needed()]
    try:
        near = [root.resolve().parent, *sorted(p for p in root.iterdir() if p.is_dir())[:100]]
        for folder in near:
            if all(next(folder.glob(pattern), None) for pattern in patterns):
                return f"{folder} has the layout: give that as the root; "
    except OSError:
        pass
    return ""


def files_inside(root: Path, pattern: str, *, folders: bool = False) -> list[Path]:
    """Files (with `folders` also folders) below `root` that match, without hidden ones, in natural order.

    Raises `InputError` for one that leads out of the root.
    """
    from fusion.sources.folders import natural_key

    return sorted(_walk(root, pattern, folders), key=lambda path: natural_key(path.as_posix()))


def _walk(root: Path, pattern: str, folders: bool) -> Iterator[Path]:
    home = root.resolve()
    inside: dict[Path, bool] = {}
    for path in root.glob(pattern):
        hidden = any(part.startswith(".") for part in path.relative_to(root).parts)
        if hidden or not (path.is_file() or (folders and path.is_dir())):
            continue
        if path.parent not in inside:
            inside[path.parent] = path.parent.resolve().is_relative_to(home)
        if not inside[path.parent] or (path.is_symlink() and not path.resolve().is_relative_to(home)):
            raise InputError(
                "leads out of the data set's root", where=path, hint="replace the link by the files"
            )
        yield path


def _role(manifest: Manifest, root: Path, role: str, files: Sequence[Path]) -> RoleFiles:
    part = manifest.files_of(role)
    stamps = tuple(files_inside(root, part.stamp_files)) if part.stamp_files else ()
    if part.stamp_files and not stamps:
        what = f"does not hold {manifest.name}: no file of time stamps matches '{part.stamp_files}'"
        raise InputError(what, where=root)
    rule = None
    if role == "fir":
        rule = manifest.pairing_rule(root) if manifest.paired else None
    elif role != manifest.lead():
        pairing = getattr(part, "pairing", None)
        rule = None if pairing is None else pairing.rule()
    own = {key: getattr(part, key) for key in ("form", "per_metre", "value", "bayer") if hasattr(part, key)}
    glob = f"{escape(str(root))}/{part.files}"
    return RoleFiles(role, glob, _home(root, part.files), tuple(files), rule, part.stamps, stamps, **own)


def _home(root: Path, pattern: str) -> Path:
    """The folder that the pattern names before its first wildcard, and never the file."""
    parts = pattern.split("/")[:-1]
    return root.joinpath(*parts[: next((k for k in _open_parts(pattern) if k < len(parts)), len(parts))])


def _of_kind(role: str, files: Sequence[Path], manifest: Manifest) -> tuple[Path, ...]:
    """Those of `files` that can be what the role holds: images, or clouds."""
    from fusion.clouds.find import suffix_of
    from fusion.sources.folders import IMAGE_SUFFIXES

    if role == "lidar":
        forced = manifest.lidar is not None and manifest.lidar.form is not None
        return tuple(file for file in files if forced or suffix_of(file.name))
    return tuple(file for file in files if file.suffix.lower() in IMAGE_SUFFIXES)


def _recording(manifest: Manifest, files: Sequence[Path]) -> RecordingFiles | None:
    part = manifest.recording
    if part is None:
        return None
    tolerance = {role: round(ms * 1e6) for role, ms in part.tolerance_ms.items()}
    return RecordingFiles(tuple(files), part.topics.known(), part.stamp, tolerance)


def _calibration(manifest: Manifest, root: Path) -> CalibrationFiles | None:
    part = manifest.calibration
    if part is None:
        return None
    files = tuple(files_inside(root, part.files))
    return CalibrationFiles(files, f"{escape(str(root))}/{part.files}", part.form, part.per, part.note)


def _open_parts(pattern: str) -> tuple[int, ...]:
    return tuple(k for k, part in enumerate(pattern.split("/")) if any(c in part for c in "*?["))


def _said(text: str, role: str) -> str:
    """The pairing's words with the role's own in thermal's place."""
    if role == "fir":
        return text
    noun = "cloud" if role == "lidar" else f"{WORDS[role]} map"
    text = re.sub(r"\bthermal image(s?)", rf"{noun}\1", text)
    return re.sub(r"\bthermal\b", noun, text)
