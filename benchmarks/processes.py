"""Folder to folder as whole processes: ours, ffmpeg's, ImageMagick's."""

from __future__ import annotations

import shutil
from dataclasses import dataclass

import rivals
from content import CASES, Case
from table import Row, Section, Target, at_least, grid, per_second
from timing import Job, Sample, interleaved
from workspace import Workspace, blend_command, run_clocked

TUNE_FRAMES = 40
MAGICK_SHARE = 10  # ImageMagick gets a tenth of the frames: its rate is the same from the first
SIZE_BAND = 1.15  # a JPEG rival's files may be as large as ours, within this

TEXT = """\
Whole processes, two workers (`fusion blend RGB FIR -o OUT --window LO HI --window-unit counts --workers 2 --quiet`), from registered pairs (the others'
best case) to PNG or JPEG: {frames} frames at 640x480, a third of that at 1280x1024. *Steady* takes each program's start-up off on both
sides, measured in the same round as the same command on one pair; *whole* does not. Start-up of ours: {startup}.
ffmpeg and ImageMagick do the same job with two threads or processes, tuned on the first case of each kind ({tune} frames, the faster of two runs, the best graph
first, then the encoder's options, then threads); their pixels were compared with ours. PNG with compression level 0 (nothing compressed, files {stored}) is shown for
information: it is another job. ffmpeg's JPEG quality is the one whose files come nearest to ours in size."""


@dataclass(slots=True)
class Kind:
    """PNG or JPEG: how we and the tuned rivals do it."""

    suffix: str
    ffmpeg: list[tuple[rivals.Ffmpeg, float]]
    magick: list[tuple[rivals.Magick, float]]
    note: str = ""

    @property
    def name(self) -> str:
        return "PNG" if self.suffix == ".png" else "JPEG"


class Processes:
    """Measures one workspace; `frames` at VGA, a third at SXGA."""

    def __init__(self, space: Workspace, distinct: int, frames: int, rounds: int) -> None:
        self.space, self.distinct, self.frames, self.rounds = space, distinct, frames, rounds
        self.startup: Sample | None = None
        self.stored = ""

    def measure(self) -> tuple[Section, str]:
        """The section, and what tuning found as text for the end of the page."""
        kinds = [self._tuned(".png"), self._tuned(".jpg")]
        rows = [row for case in CASES for row in self._rows(case, kinds[0])]
        rows += [row for case in CASES if case.bits == 8 for row in self._rows(case, kinds[1])]
        text = TEXT.format(
            frames=self.frames,
            startup=_seconds(self.startup),
            tune=min(TUNE_FRAMES, self.frames),
            stored=self.stored or "of raw size",
        )
        section = Section("Folder to folder as whole processes", text, ("ours", "other"), rows)
        return section, "\n\n".join(_tuning_table(kind) for kind in kinds)

    def _tuned(self, suffix: str) -> Kind:
        case, count = CASES[0], min(TUNE_FRAMES, self.frames)
        pairs = self.space.pairs(case, self.distinct, self.frames, suffix)
        ours = self.space.root / f"ours{suffix}"
        run_clocked(blend_command(case, pairs, ours, workers=2, suffix=suffix))
        kind, out = Kind(suffix, [], []), self.space.fresh_out()
        if rivals.FFMPEG:
            outputs = rivals.PNG_OUTPUTS if suffix == ".png" else [self._jpeg_output(kind)]
            kind.ffmpeg = rivals.tune(pairs, out, case, count, suffix, outputs)
            rivals.run_ffmpeg(kind.ffmpeg[0][0], pairs, out, case, count, suffix)
            kind.note += f" ffmpeg's pixels differ from ours by {rivals.mean_difference(ours / 'fused', out):.2f} grey levels on average."
        if rivals.MAGICK and suffix == ".png":
            kind.magick = rivals.tune_magick(pairs, out, case, max(count // 5, 4))
            rivals.run_magick(kind.magick[0][0], pairs, out, case, max(count // 5, 4))
            kind.note += f" ImageMagick's by {rivals.mean_difference(ours / 'fused', out, 3):.2f}."
        shutil.rmtree(ours)
        return kind

    def _jpeg_output(self, kind: Kind) -> tuple[str, ...]:
        """The `-q:v` whose files come nearest to ours in size."""
        case = CASES[0]
        pairs = self.space.pairs(case, self.distinct, self.frames, ".jpg")
        ours = _bytes(self.space.root / "ours.jpg" / "fused", self.distinct)
        sizes: dict[str, float] = {}
        for quality in map(str, range(1, 10)):
            output = ("-c:v", "mjpeg", "-pix_fmt", "yuvj420p", "-q:v", quality)
            how = rivals.Ffmpeg("lutrgb x2 + blend=addition, planar", output)
            rivals.run_ffmpeg(how, pairs, self.space.out, case, self.distinct, ".jpg")
            sizes[quality] = _bytes(self.space.out, self.distinct) / ours
        best = min(sizes, key=lambda quality: abs(sizes[quality] - 1))
        kind.note = f" With `-q:v {best}` ffmpeg's JPEG files are {sizes[best]:.2f} times as large as ours."
        return ("-c:v", "mjpeg", "-pix_fmt", "yuvj420p", "-q:v", best)
