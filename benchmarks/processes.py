"""Folder to folder as whole processes: ours, ffmpeg's, ImageMagick's."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import rivals
from content import CASES, VGA, Case
from table import Row, Section, Target, at_least, grid, per_second
from timing import Job, Sample, interleaved
from workspace import Workspace, blend_command, run_clocked

TUNE_FRAMES = 40
MAGICK_SHARE = 10  # ImageMagick gets a tenth of the frames: its start-up is nothing beside its work
JPEG_MORE = 4  # JPEG is quicker: more frames, so that start-up does not decide

TEXT = """\
Whole processes, two workers (`fusion blend RGB FIR -o OUT --window LO HI --window-unit counts --workers 2
--quiet`), registered pairs (the others' best case), {frames} PNG frames at 640x480 and a third of that at
1280x1024, JPEG {more} times as many. *Whole* is frames / time of the process. *Steady* is (frames - 1) /
(time - time of the same command on one pair, in the same round), for both sides: start-up and the first
frame are taken off. `fusion blend` on one pair takes {startup}. ffmpeg and ImageMagick do the same job with
two threads or two processes, tuned here (see the end); ImageMagick is given a tenth of the frames. Ours
writes JPEG at quality 90, 4:2:0. ffmpeg with compression level 0, which stores pixels uncompressed, is
shown for information{stored}."""


@dataclass(slots=True)
class Kind:
    """PNG or JPEG, and how the others do it best: (way, seconds) with the fastest first."""

    suffix: str
    ffmpeg: list[tuple[rivals.Ffmpeg, float]] = field(default_factory=list)
    magick: list[tuple[rivals.Magick, float]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        return "PNG" if self.suffix == ".png" else "JPEG"


class Processes:
    """Whole processes on the pairs of one workspace."""

    def __init__(self, space: Workspace, distinct: int, frames: int, rounds: int) -> None:
        self.space, self.distinct, self.frames, self.rounds = space, distinct, frames, rounds
        self.startups: list[float] = []
        self.stored = ""

    def measure(self) -> tuple[Section, str]:
        """The section, and what tuning found as text for the end of the page."""
        kinds = [self._tuned(Kind(".png")), self._tuned(Kind(".jpg"))]
        rows = [row for case in CASES for row in self._png_rows(case, kinds[0])]
        rows += [row for case in CASES if case.bits == 8 for row in self._jpeg_rows(case, kinds[1])]
        start = Sample(tuple(self.startups))
        text = TEXT.format(
            frames=self.frames,
            more=JPEG_MORE,
            startup=f"{start.median:.2f} s ({start.quartiles[0]:.2f}–{start.quartiles[1]:.2f})",
            stored=self.stored,
        )
        section = Section("Folder to folder as whole processes", text, ("ours", "other"), rows)
        return section, "\n\n".join(_tuning_text(kind) for kind in kinds)

    # --- the others, tuned

    def _tuned(self, kind: Kind) -> Kind:
        case, count = CASES[0], min(TUNE_FRAMES, self.frames)
        pairs = self._pairs(case, kind.suffix)[0]
        ours = self.space.root / f"ours-{kind.name}"
        run_clocked(blend_command(case, pairs, ours, workers=2, suffix=kind.suffix))
        if rivals.FFMPEG:
            png = kind.suffix == ".png"
            outputs = rivals.PNG_OUTPUTS if png else self._jpeg_outputs(pairs, ours / "fused")
            kind.ffmpeg = rivals.tune(pairs, self.space.out, case, count, kind.suffix, outputs)
            rivals.run_ffmpeg(kind.ffmpeg[0][0], pairs, self.space.out, case, count, kind.suffix)
            self._compare(kind, "ffmpeg", ours / "fused")
        if rivals.MAGICK and kind.suffix == ".png":
            few = max(count // 5, 4)
            kind.magick = rivals.tune_magick(pairs, self.space.out, case, few)
            rivals.run_magick(kind.magick[0][0], pairs, self.space.out, case, few)
            self._compare(kind, "ImageMagick", ours / "fused")
        return kind

    def _compare(self, kind: Kind, who: str, ours: Path) -> None:
        apart = rivals.mean_difference(ours, self.space.out, 3)
        if apart > 3:
            raise AssertionError(
                f"{who} does another job: its pixels differ by {apart:.1f} grey levels on average"
            )
        size = _bytes(self.space.out, 3) / _bytes(ours, 3)
        kind.notes.append(
            f"{who}'s {kind.name} pixels differ from ours by {apart:.2f} grey levels on average,"
            f" its files are {size:.2f} times as large."
        )

    def _jpeg_outputs(self, pairs: Path, ours: Path) -> list[tuple[str, ...]]:
        """With the `-q:v` whose files come nearest to ours in size."""
        wanted, sizes = _bytes(ours, 3), {}
        for quality in range(1, 10):
            how = rivals.Ffmpeg("YUV: lut2", rivals.jpeg_outputs(quality)[0])
            rivals.run_ffmpeg(how, pairs, self.space.out, CASES[0], 3, ".jpg")
            sizes[quality] = _bytes(self.space.out, 3) / wanted
        return rivals.jpeg_outputs(min(sizes, key=lambda quality: abs(math.log(sizes[quality]))))

    # --- measured

    def _pairs(self, case: Case, suffix: str) -> tuple[Path, int]:
        count = self.frames if case.size_wh == VGA else max(self.frames // 3, self.distinct)
        count *= JPEG_MORE if suffix == ".jpg" else 1
        return self.space.pairs(case, self.distinct, count, suffix), count

    def _ours(self, case: Case, suffix: str, workers: int, one_pair: bool = False) -> Job:
        pairs, _ = self._pairs(case, suffix)
        command = blend_command(
            case, pairs, self.space.out, workers=workers, suffix=suffix, one_pair=one_pair
        )

        def job() -> float:
            self.space.fresh_out()
            return run_clocked(command)

        return job

    def _ffmpeg(self, how: rivals.Ffmpeg, case: Case, suffix: str, one_pair: bool = False) -> Job:
        pairs, count = self._pairs(case, suffix)
        return lambda: rivals.run_ffmpeg(how, pairs, self.space.out, case, 1 if one_pair else count, suffix)

    def _jobs(self, case: Case, kind: Kind) -> dict[str, Job]:
        jobs = {
            "ours": self._ours(case, kind.suffix, 2),
            "ours, one pair": self._ours(case, kind.suffix, 2, one_pair=True),
        }
        if kind.ffmpeg:
            best = kind.ffmpeg[0][0]
            jobs["ffmpeg"] = self._ffmpeg(best, case, kind.suffix)
            jobs["ffmpeg, one pair"] = self._ffmpeg(best, case, kind.suffix, one_pair=True)
        return jobs

    def _png_rows(self, case: Case, kind: Kind) -> list[Row]:
        pairs, count = self._pairs(case, kind.suffix)
        jobs = {**self._jobs(case, kind), "one worker": self._ours(case, kind.suffix, 1)}
        few = max(count // MAGICK_SHARE, 4)
        if kind.ffmpeg:
            stored = replace(kind.ffmpeg[0][0], output=rivals.PNG_STORED)
            jobs["stored"] = self._ffmpeg(stored, case, kind.suffix)
        if kind.magick:
            jobs["magick"] = lambda: rivals.run_magick(kind.magick[0][0], pairs, self.space.out, case, few)
        rates = self._rates(jobs, count, {"magick": few})
        name = f"PNG, {case.name}"
        return [
            *_versus(f"{name}: ours / ffmpeg", rates, "ffmpeg", at_least(2.7)),
            _row(
                f"{name}: ours / ffmpeg without compression, whole", rates, "ours", "stored", None, "ffmpeg"
            ),
            _row(f"{name}: ours / ImageMagick, whole", rates, "ours", "magick", at_least(12), "ImageMagick"),
            _row(
                f"{name}: two workers / one, steady",
                rates,
                "ours, steady",
                "one worker, steady",
                at_least(1.65),
            ),
            _row(f"{name}: two workers / one, whole", rates, "ours", "one worker", None),
        ]

    def _jpeg_rows(self, case: Case, kind: Kind) -> list[Row]:
        _, count = self._pairs(case, kind.suffix)
        rates = self._rates(self._jobs(case, kind), count, {})
        return _versus(f"JPEG, {case.name}: ours / ffmpeg", rates, "ffmpeg", at_least(4))

    def _rates(self, jobs: dict[str, Job], count: int, fewer: dict[str, int]) -> dict[str, Sample]:
        """Frames/s of each job; as "NAME, steady" without start-up where that was measured too."""
        taken = interleaved(jobs, self.rounds, warm=0)
        self.startups += taken["ours, one pair"].values
        rates = {name: taken[name].rate(fewer.get(name, count)) for name in jobs if "one pair" not in name}
        starts = {"ours": "ours, one pair", "one worker": "ours, one pair", "ffmpeg": "ffmpeg, one pair"}
        for name, start in starts.items():
            if name in taken:
                rates[f"{name}, steady"] = taken[name].minus(taken[start]).rate(count - 1)
        if "stored" in jobs:
            self.stored = "; its files are as large as the pixels"
        return rates


def _versus(what: str, rates: dict[str, Sample], other: str, target: Target) -> list[Row]:
    steady = _row(f"{what}, steady", rates, "ours, steady", f"{other}, steady", target, other)
    return [steady, _row(f"{what}, whole", rates, "ours", other, target, other)]


def _row(
    what: str, rates: dict[str, Sample], ours: str, other: str, target: Target | None, program: str = ""
) -> Row:
    if other not in rates:
        return Row(what, per_second(rates[ours]), target=target, note=f"{program} is not installed")
    return Row(
        what, per_second(rates[ours]), per_second(rates[other]), rates[ours].over(rates[other]), target
    )


def _bytes(folder: Path, frames: int) -> int:
    return sum(path.stat().st_size for path in sorted(folder.iterdir())[:frames])


def _tuning_text(kind: Kind) -> str:
    """What was tried, with the mean time of a frame at 640x480, start-up included."""
    parts = [" ".join(kind.notes)] if kind.notes else []
    for who, tried in (("ffmpeg", kind.ffmpeg), ("ImageMagick", kind.magick)):
        if tried:
            parts.append(
                _tried_table(f"{who} to {kind.name}", [(how.words, seconds) for how, seconds in tried])
            )
    return "\n\n".join(parts) or f"{kind.name}: nothing to tune, ffmpeg and ImageMagick are not installed."


def _tried_table(head: str, tried: Iterable[tuple[str, float]]) -> str:
    times = list(tried)
    fastest = times[0][1]
    return grid(
        (head, "time / fastest"), [(f"`{words}`", f"{seconds / fastest:.2f}") for words, seconds in times]
    )
