"""What `fusion datasets check` finds out: a data set's files held against its manifest. Prints nothing."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fusion.codecs import decode_image
from fusion.errors import FrameError, FusionError
from fusion.manifest import Layout, Manifest, Partners, RoleFiles
from fusion.manifest.layout import WORDS
from fusion.pairing import stamps_of
from fusion.sources.folders import read_bytes

if TYPE_CHECKING:
    from fusion.frames import FrameSet
    from fusion.pairing import Pair

FORMAT = "fusion-dataset-check/1"
_ENDS, _AT_RANDOM = 2, 4  # files looked at: at either end, and between (drawn with a fixed seed)
_FEW = 0.5  # of the smaller side that must pair by name, or the manifest does not fit
_THINNED = 2  # of the pairs looked at every second is asked about its alignment


@dataclass(frozen=True, slots=True)
class Finding:
    """`wrong`: the set is not as its manifest says. Else something that is worth knowing."""

    kind: str
    wrong: bool
    text: str


@dataclass(frozen=True, slots=True)
class RoleSeen:
    """The files (messages, for a recording) of one role; `pixels` and `sizes_wh` count those looked at."""

    role: str
    where: str
    files: int | None
    looked_at: int = 0
    sizes_wh: dict[str, int] = field(default_factory=dict)
    pixels: dict[str, int] = field(default_factory=dict)
    points: list[int] = field(default_factory=list)
    first_ns: int | None = None
    last_ns: int | None = None


@dataclass(frozen=True, slots=True)
class PairsSeen:
    """How many of `role` go with the leading role's, by which rule, and all that do not, each with its
    reason.
    """

    role: str
    lead: str
    by: str
    pairs: int
    dt_median_ms: float | None
    dt_max_ms: float | None
    tolerance_ms: float | None
    unmatched: list[dict[str, str]]


@dataclass(slots=True)
class Report:
    """All of it. `ok`: nothing is wrong."""

    name: str
    root: str
    state: str
    format: str = FORMAT
    ok: bool = True
    roles: list[RoleSeen] = field(default_factory=list)
    pairs: list[PairsSeen] = field(default_factory=list)
    calibration: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    def wrong(self, kind: str, text: str) -> None:
        self.ok = False
        self.findings.append(Finding(kind, True, text))

    def note(self, kind: str, text: str) -> None:
        self.findings.append(Finding(kind, False, text))


def check(manifest: Manifest, root: Path, *, alignment: bool = False) -> Report:
    """Walk `root` and hold it against `manifest`; nothing is raised for what is wrong with the files.

    A few files of each role are decoded: the first and the last two, and four between. `alignment` also lets
    the scene say whether thermal lies on RGB (some seconds).
    """
    report = Report(manifest.name, str(root), manifest.state)
    try:
        layout = manifest.plan(root)
    except FusionError as error:
        report.wrong("layout", str(error))
        return report
    for role in layout.missing:
        report.note("missing", f"no {role} files: the set can be used without")
    if layout.recording is not None:
        from fusion.cli.dataset_recordings import check_recordings

        check_recordings(layout, report)
        return report
    sizes = _Files(layout, report).run(alignment=alignment)
    from fusion.cli.dataset_calibration import check_calibration

    check_calibration(layout, sizes, report)
    return report


class _Files:
    """One run over the files of a layout."""

    def __init__(self, layout: Layout, report: Report) -> None:
        self.layout, self.report = layout, report
        self.checks = layout.manifest.checks

    def run(self, *, alignment: bool) -> dict[str, tuple[int, int]]:
        """Sizes of the images by role, of the first one that can be read."""
        sizes: dict[str, tuple[int, int]] = {}
        for role, files in self.layout.roles.items():
            self._count(role, len(files.files))
            sizes |= self._look(role, files)
        for role in self.layout.roles:
            if role != self.layout.lead and (role != "fir" or self.layout.manifest.paired):
                self._pairs(role, alignment)
        if "rgbt" in self.layout.roles:
            self._count("pairs", len(self.layout["rgbt"].files))
        elif not self.layout.manifest.paired:
            self.report.note(
                "unpaired", f"RGB and thermal are not pairs: {self.layout.manifest.unpaired_note}"
            )
        return sizes

    def _count(self, what: str, found: int) -> None:
        wanted = getattr(self.checks.counts, what)
        if wanted is not None and wanted != found:
            noun = "pairs" if what == "pairs" else f"{what} files"
            self.report.wrong("count", f"{noun}: {self.layout.manifest.name} has {wanted:,}, found {found:,}")
        least = self.checks.min_pairs
        if what == "pairs" and least is not None and found < least:
            text = f"pairs: {self.layout.manifest.name} has at least {least:,}, found {found:,}"
            self.report.wrong("count", text)

    def _look(self, role: str, files: RoleFiles) -> dict[str, tuple[int, int]]:
        """Decode a few, note their sizes and types; the stamps of all."""
        sizes: Counter[str] = Counter()
        pixels: Counter[str] = Counter()
        points, first = [], {}
        picked = sample(len(files.files))
        for index in picked:
            try:
                for name, (width, height), kind in self._decoded(role, files, index):
                    first.setdefault(name, (width, height))
                    sizes[f"{width}x{height}"] += 1
                    pixels[kind] += 1
                    self._fits(name, (width, height), kind, files.files[index])
                if role == "lidar":
                    points.append(self._cloud(files, index))
            except FusionError as error:
                self.report.wrong("unreadable", str(error))
        stamps = self._stamps(role, files)
        known = [stamp for stamp in stamps if stamp is not None]
        self.report.roles.append(
            RoleSeen(
                role,
                self.layout.manifest.files_of(role).files,
                len(files.files),
                len(picked),
                dict(sizes),
                dict(pixels),
                points,
                min(known, default=None),
                max(known, default=None),
            )
        )
        return first

    def _decoded(self, role: str, files: RoleFiles, index: int) -> Iterator[tuple[str, tuple[int, int], str]]:
        """(role, size, type of pixel) of an image; both parts of one that holds RGB and thermal."""
        if role == "lidar":
            return
        if role == "rgbt":
            frames = self._both(index)
            yield "rgb", frames.rgb.size_wh, "uint8"
            yield "fir", frames.fir.size_wh, str(frames.fir.pixels.dtype)
            return
        if role in ("rgb", "fir"):
            image = self.layout.open("rgb" if role == "rgb" else "fir").read(index)
            yield role, image.size_wh, str(image.pixels.dtype)
            return
        pixels = decode_image(read_bytes(str(files.files[index])), str(files.files[index]))
        if pixels.ndim != 2 or pixels.dtype != np.uint16:
            what = f"expected a depth map of 16-bit grey, found {pixels.dtype} of shape {pixels.shape}"
            raise FrameError(what, where=files.files[index])
        yield role, (pixels.shape[1], pixels.shape[0]), "uint16"

    def _both(self, index: int) -> FrameSet:
        from fusion.sync import open_pairs

        return open_pairs(self.layout["rgbt"].files[index]).read(0)

    def _cloud(self, files: RoleFiles, index: int) -> int:
        from fusion.clouds import read_cloud

        cloud = read_cloud(files.files[index], files.form)
        if not len(cloud):
            raise FrameError("the cloud has no point that can be used", where=files.files[index])
        return len(cloud)

    def _fits(self, role: str, size: tuple[int, int], kind: str, where: Path) -> None:
        wanted = getattr(self.checks, f"{role}_size_wh", None)
        name = self.layout.manifest.name
        if wanted is not None and tuple(wanted) != size:
            want, got = ("{}x{}".format(*s) for s in (wanted, size))
            self.report.wrong("size", f"{where}: {role} images of {name} are {want}, this one is {got}")
        bits = self.checks.fir_bits
        if role == "fir" and bits is not None and kind != f"uint{bits}":
            text = f"{where}: thermal images of {name} have {bits} bits, this one is {kind}"
            self.report.wrong("bits", text)

    def _stamps(self, role: str, files: RoleFiles) -> list[int | None]:
        """The stamps of all files, where they have them; they must rise from file to file of a folder."""
        by_stamp, key = self._clock(role, files)
        if files.stamps != "name" and not files.stamp_files and not by_stamp:
            return []
        try:
            entries = files.entries()
        except FusionError as error:
            self.report.wrong("stamps", str(error))
            return []
        stamps = stamps_of(entries, key)
        without = [file for file, stamp in zip(files.files, stamps, strict=True) if stamp is None]
        if without:
            text = (
                f"{role}: {len(without):,} of {len(stamps):,} files have no time stamp, such as {without[0]}"
            )
            self.report.wrong("stamps", text)
        back = list(_falling(files.files, stamps))
        if back:
            text = f"{role}: time does not rise at {len(back):,} files, the first {back[0]}"
            self.report.wrong("stamps", text)
        return stamps

    def _clock(self, role: str, files: RoleFiles) -> tuple[bool, str | None]:
        """Whether the role is paired by time, and the pattern that finds the stamp in its names."""
        if files.rule is not None:
            timed = files.rule.by == "stamp"
            return timed, files.rule.fir_key if timed else None
        fir = self.layout.roles.get("fir")
        timed = role == "rgb" and fir is not None and fir.rule is not None and fir.rule.by == "stamp"
        return timed, fir.rule.rgb_key if timed and fir is not None and fir.rule is not None else None

    def _pairs(self, role: str, alignment: bool) -> None:
        try:
            partners = self.layout.partners(role)
        except FusionError as error:
            self.report.wrong("pairs", str(error))
            return
        pairing, summary = partners.pairing, partners.pairing.summary()
        lost = [
            {"role": self._name(u.role, role), "where": u.where, "reason": u.reason}
            for u in pairing.unmatched
        ]
        self.report.pairs.append(
            PairsSeen(
                role,
                self.layout.lead,
                pairing.rule_by,
                len(pairing.pairs),
                summary.dt_median_ms,
                summary.dt_max_ms,
                summary.tolerance_ms,
                lost,
            )
        )
        for note in pairing.notes:
            self.report.note("pairs", note)
        if role == "fir":
            self._count("pairs", len(pairing.pairs))
        few = len(pairing.pairs) < _FEW * min(pairing.n_rgb, pairing.n_fir)
        if few and pairing.rule_by != "stamp":
            word = WORDS.get(role, role)
            text = f"only {len(pairing.pairs):,} of {pairing.n_fir:,} {word} files pair by {pairing.rule_by}"
            self.report.wrong("pairs", text)
        self._one_grid(role, partners)
        if role == "fir" and alignment:
            self._alignment([pairing.pairs[k] for k in sample(len(pairing.pairs))][::_THINNED])

    def _name(self, side: str, role: str) -> str:
        return {"rgb": self.layout.lead, "fir": role}.get(side, side)

    def _one_grid(self, role: str, partners: Partners) -> None:
        """What lies on RGB pixel by pixel must have RGB's size: thermal of a registered set, and depth."""
        registered = role == "fir" and self.layout.manifest.registered
        on_rgb = role in ("depth", "sparse") and self.layout.lead == "rgb"
        if not registered and not on_rgb:
            return
        for k in sample(len(partners.pairing.pairs)):
            i, j, _ = partners.pairing.pairs[k]
            try:
                (_, rgb, _), *_ = self._decoded("rgb", self.layout["rgb"], i)
                (_, other, _), *_ = self._decoded(role, self.layout[role], j)
            except FusionError:
                continue  # an unreadable one has been said, or is not this check's
            if rgb != other:
                ours, theirs = ("{}x{}".format(*size) for size in (rgb, other))
                text = f"{partners.files[j]} is {theirs}, its RGB image {ours}: it cannot lie on it"
                self.report.wrong("size", text)
                return

    def _alignment(self, pairs: Sequence[Pair]) -> None:
        from fusion.cli.dataset_alignment import judge_alignment

        judge_alignment(self.layout, pairs, self.report)


def sample(count: int) -> list[int]:
    """The first and last few of `count` and some between, the same ones every time."""
    ends = [*range(min(_ENDS, count)), *range(max(count - _ENDS, 0), count)]
    between = range(_ENDS, max(count - _ENDS, _ENDS))
    return sorted({*ends, *random.Random(0).sample(between, min(_AT_RANDOM, len(between)))})  # noqa: S311


def _falling(files: Sequence[Path], stamps: Sequence[int | None]) -> Iterator[Path]:
    """Files that are not later than the one before them in their folder."""
    known = [(file, stamp) for file, stamp in zip(files, stamps, strict=True) if stamp is not None]
    for (a, before), (b, after) in pairwise(known):
        if a.parent == b.parent and after <= before:
            yield b
