"""What a campaign reads: moments, chunk by chunk, whether they lie in a recording or in folders."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np

from fusion.chunks import Chunk
from fusion.clouds import read_cloud
from fusion.errors import FrameError, InputError
from fusion.frames import FrameSet, Image, PointCloud
from fusion.manifest import Layout, Manifest
from fusion.pairing import stamp_in_name, stamps_of
from fusion.provenance import digest
from fusion.sync import PairedSources, Pairs, open_pairs


class Dropped(NamedTuple):
    """A message that belongs to no frame."""

    role: str
    where: str
    reason: str


@dataclass(frozen=True, slots=True)
class Moment:
    """A frame's images and cloud, not decoded yet.

    `stem` names it; `position` is its place along the footage, as windows of colour count it. `images` and
    `cloud` (None: none belongs to it) raise `FrameError` where one cannot be used.
    """

    stem: str
    position: int
    images: Callable[[], FrameSet]
    cloud: Callable[[], PointCloud] | None = None


class Footage(Protocol):
    """Moments in order. Picklable: other machines open it again. Safe from several threads.

    `positions` is how many places a window may be sampled at, `rate_hz` the frames a second of the leader.
    """

    name: str
    has_lidar: bool
    rate_hz: float
    positions: int

    def describe(self) -> Mapping[str, Any]:
        """What it is, TOML-able: a run over other footage is another run."""
        ...

    def notes(self) -> Sequence[str]:
        """What the user should know of it before the run."""
        ...

    def chunks(self, chunk_s: float) -> list[Chunk]: ...

    def moments(self, chunk: Chunk) -> Iterator[Moment | Dropped]:
        """What chunk `chunk` owns, in order."""
        ...

    def fir_at(self, position: int) -> Image:
        """The thermal image at (or next after) a position. Raises `FrameError`."""
        ...

    def close(self) -> None: ...


class SetFootage:
    """The folders of a data set below `root`: pairs of images, and clouds as its manifest says.

    Thermal frames that repeat the one before are left out where the pairing is by time, unless `keep_frozen`.
    """

    def __init__(
        self,
        manifest: Manifest,
        root: Path,
        *,
        fir_colour: Any = "refuse",
        keep_frozen: bool = False,
        fir_offset_ns: int = 0,
    ) -> None:
        self._spec = manifest, root, fir_colour, keep_frozen, fir_offset_ns
        self._open()

    def _open(self) -> None:
        manifest, root, colour, self._keep_frozen, offset_ns = self._spec
        layout = manifest.plan(root)
        self._pairs, self._leads = _pairs_of(layout, colour, offset_ns)
        self.name, self.positions = manifest.name, len(self._pairs)
        self._stems = [self._pairs.stems(index)[0] for index in range(self.positions)]
        self._clouds: dict[str, Path] = {}
        self.has_lidar = "lidar" in layout.roles and bool(self._leads)
        if self.has_lidar:
            by_lead = layout.partners("lidar").by_lead()
            self._clouds = {str(lead): cloud for lead, cloud in by_lead.items()}
        self._form = layout["lidar"].form if self.has_lidar else None
        self.rate_hz = self._rate_hz()

    def __getstate__(self) -> tuple[Any, ...]:
        return self._spec

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self._spec = state
        self._open()

    @property
    def pairs(self) -> Pairs:
        return self._pairs

    def describe(self) -> Mapping[str, Any]:
        return {
            "kind": "data set",
            "name": self.name,
            "pairs": self.positions,
            "unmatched": len(self._pairs.pairing.unmatched),
            "clouds": len(self._clouds),
            "names_sha256": digest(self._stems),
            "keep_frozen": self._keep_frozen,
            "fir_offset_ns": self._spec[-1],
        }

    def notes(self) -> Sequence[str]:
        lost = sum(self._cloud(index) is None for index in range(self.positions))
        return [f"{lost} of {self.positions} pairs have no cloud"] if self.has_lidar and lost else []

    def chunks(self, chunk_s: float) -> list[Chunk]:
        step = max(1, round(chunk_s * self.rate_hz))
        begins = range(0, self.positions, step)
        return [
            Chunk(k, begin, min(begin + step, self.positions), min(step, self.positions - begin))
            for k, begin in enumerate(begins)
        ]

    def moments(self, chunk: Chunk) -> Iterator[Moment | Dropped]:
        if chunk.index == 0:
            for lost in self._pairs.pairing.unmatched:
                yield Dropped(lost.role, lost.where, _countable(lost.reason))
        before: Image | None = None
        for index in range(chunk.begin, chunk.end):
            if self._by_time and not self._keep_frozen:
                before = self._fir(index - 1) if before is None and index else before
                now = self._fir(index)
                if before is not None and now is not None and _same(before, now):
                    yield Dropped("fir", self._pairs.stems(index)[1], "frozen: repeats the frame before")
                    continue
                before = now
            yield Moment(
                self._stems[index],
                index,
                partial(self._pairs.read, index),
                None if (scan := self._cloud(index)) is None else partial(read_cloud, scan, form=self._form),
            )

    def fir_at(self, position: int) -> Image:
        return self._pairs.read_fir(position)

    def pictures(self, role: str, longest_s: float) -> Iterator[Image]:
        """The images of one folder as their stamps order them; those that cannot be read are left out."""
        manifest, root, colour, *_ = self._spec
        camera: Literal["rgb", "fir"] = "rgb" if role == "rgb" else "fir"
        source = manifest.plan(root).open(camera, colour)
        stamped = sorted((t, k) for k, t in enumerate(stamps_of(source.entries)) if t is not None)
        for stamp, index in stamped:
            if stamp - stamped[0][0] > 1e9 * longest_s:
                return
            with suppress(FrameError):
                yield replace(source.read(index), stamp_ns=stamp)

    def close(self) -> None:
        self._pairs.close()

    @property
    def _by_time(self) -> bool:
        return self._pairs.pairing.rule_by == "stamp"

    def _fir(self, index: int) -> Image | None:
        try:
            return self._pairs.read_fir(index)
        except FrameError:
            return None  # it is named when it is read as a frame

    def _cloud(self, index: int) -> Path | None:
        return self._clouds.get(self._leads[index]) if self.has_lidar else None

    def _rate_hz(self) -> float:
        stamps = [t for t in map(stamp_in_name, map(_last, self._stems)) if t is not None]
        steps = np.diff(np.sort(stamps)) if len(stamps) > 1 else np.array([0])
        middle = float(np.median(steps))
        return 1e9 / middle if middle > 0 else 10.0  # folders without a clock: as if ten a second


def _last(stem: str) -> str:
    return Path(stem).name


def _same(a: Image, b: Image) -> bool:
    return a.pixels.dtype == b.pixels.dtype and np.array_equal(a.pixels, b.pixels)


def _countable(reason: str) -> str:
    """Reasons name files and times; a report counts kinds."""
    tolerance = re.search(r"tolerance (\S+ ms)$", reason)
    if tolerance is not None:
        return f"no partner within {tolerance[1]}"
    for kind in ("no time stamp in its name", "same time stamp as another"):
        if reason.startswith(kind.removesuffix(" another")):
            return kind
    return "its nearest is nearer to another" if " is nearer to " in reason else reason[:80]


def _pairs_of(layout: Layout, colour: Any, offset_ns: int) -> tuple[Pairs, list[str]]:
    """The pairs, and the RGB file of each (none for files of four channels: nothing else goes with them)."""
    if "rgbt" in layout.roles:
        return open_pairs(layout["rgbt"].glob), []
    if not {"rgb", "fir"} <= layout.roles.keys():
        there = " and ".join(layout.roles) or "no images"
        hint = "fusion depth makes depth maps of clouds alone"
        raise InputError(f"has {there}: nothing to fuse", where=f"data set {layout.manifest.name}", hint=hint)
    rule = layout["fir"].rule
    if rule is None:
        raise InputError("its images are no pairs", where=f"data set {layout.manifest.name}")
    rgb = layout.open("rgb")
    pairs = PairedSources(rgb, layout.open("fir", colour), replace(rule, fir_offset_ns=offset_ns))
    return pairs, [rgb.entries[pair.rgb].where for pair in pairs.pairing.pairs]
