"""Folder to folder in one process: what the run costs beyond its codecs, what a second worker brings."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from content import CASES, Case, pairs_of
from numpy.typing import NDArray
from table import Row, Section, at_least, at_most, milliseconds
from timing import Job, clocked, interleaved
from workspace import Workspace

from fusion import BlendConfig, FolderSink, Fuser, open_pairs, run
from fusion.batch import opencv_on_one_thread
from fusion.codecs import decode_image, encode_jpeg, encode_png

TEXT = """\
`fusion.run` from a folder of pairs to a folder of frames, registered pairs, fixed window, {frames} frames a
round at 640x480 and a quarter of that at 1280x1024. *Codecs alone* reads the same files
(`Path.read_bytes`), decodes them (`decode_image`), encodes the fused pixels, which it holds already
(`encode_png`, `encode_jpeg`), and writes them (`Path.write_bytes`): no pairing, no kernel, no index, no
rename. What two threads can bring at all on this machine is shown by `zlib.decompress`, which needs nothing
of ours."""


def measure(space: Workspace, distinct: int, frames: int, rounds: int) -> Section:
    text = TEXT.format(frames=frames)
    section = Section("Folder to folder in one process", text, ("ours, a frame", "other, a frame"))
    kinds = [(case, ".png") for case in CASES] + [(case, ".jpg") for case in CASES if case.bits == 8]
    for case, suffix in kinds:
        count = frames if case.size_wh[0] == 640 else max(frames // 4, distinct)
        section.rows += _rows(Folders(space, case, suffix, distinct, count), rounds)
    section.rows.append(_ceiling(rounds))
    return section


def _ceiling(rounds: int) -> Row:
    """What two threads of plain C bring: two cores may be the two halves of one."""
    data = zlib.compress(pairs_of(CASES[0], 1)[0][0].tobytes(), 1)

    def inflate(threads: int) -> float:
        with ThreadPoolExecutor(threads) as pool:
            return clocked(lambda: list(pool.map(zlib.decompress, [data] * 40)))

    taken = interleaved({"one": lambda: inflate(1), "two": lambda: inflate(2)}, rounds)
    one, two = (taken[name].per(40) for name in ("one", "two"))
    return Row("this machine: one thread of zlib / two", milliseconds(two), milliseconds(one), one.over(two))


class Folders:
    """One folder of pairs with everything opened and planned, so that only the run itself is timed."""

    def __init__(self, space: Workspace, case: Case, suffix: str, distinct: int, count: int) -> None:
        self.case, self.suffix, self.count, self.space = case, suffix, count, space
        self.pairs = space.pairs(case, distinct, count, suffix)
        settings = {
            "thermal": {"window": case.window, "window_unit": "counts"},
            "output": {"format": suffix.removeprefix(".")},
        }
        self.fuser = Fuser(open_pairs(self.pairs / "rgb", self.pairs / "fir"), BlendConfig.of(settings))
        self.fused: list[NDArray] = [self.fuser.fuse(index).bgr for index in range(distinct)]

    def run(self, workers: int) -> float:
        output = self.fuser.config.output
        with FolderSink(self.space.fresh_out(), image_format=output.format, quality=output.quality) as sink:
            return clocked(lambda: run(self.fuser, sink, workers=workers))

    def codecs_alone(self) -> float:
        out = self.space.fresh_out()
        out.mkdir()
        with opencv_on_one_thread():
            return clocked(lambda: [self._recode(index, out) for index in range(self.count)])

    def _recode(self, index: int, out: Path) -> None:
        name = f"{index:06d}{self.suffix}"
        for role in ("rgb", "fir"):
            path = self.pairs / role / name
            decode_image(path.read_bytes(), name)
        bgr = self.fused[index % len(self.fused)]
        data = (
            encode_png(bgr) if self.suffix == ".png" else encode_jpeg(bgr, self.fuser.config.output.quality)
        )
        (out / name).write_bytes(data)


@contextmanager
def opened(folders: Folders) -> Iterator[dict[str, Job]]:
    try:
        yield {
            "alone": folders.codecs_alone,
            "one": lambda: folders.run(workers=1),
            "two": lambda: folders.run(workers=2),
        }
    finally:
        folders.fuser.pairs.close()


def _rows(folders: Folders, rounds: int) -> list[Row]:
    with opened(folders) as jobs:
        taken = {name: sample.per(folders.count) for name, sample in interleaved(jobs, rounds).items()}
    alone, one, two = taken["alone"], taken["one"], taken["two"]
    kind = "PNG" if folders.suffix == ".png" else "JPEG"
    wanted = (at_most(1.1), at_least(1.65)) if kind == "PNG" else (None, None)
    name = f"{kind}, {folders.case.name}"
    return [
        Row(
            f"{name}: one worker / codecs alone",
            milliseconds(one),
            milliseconds(alone),
            one.over(alone),
            wanted[0],
        ),
        Row(f"{name}: one worker / two", milliseconds(two), milliseconds(one), one.over(two), wanted[1]),
    ]
