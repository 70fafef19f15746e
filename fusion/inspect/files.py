"""The images, or the clouds, of one folder, looked at as one stream."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.clouds import CloudFiles, read_cloud
from fusion.codecs import decode_image
from fusion.errors import FrameError, FusionError
from fusion.inspect.base import QUICK_BYTES, QUICK_ITEMS, Asked, Looked, Picture, Stream, Times
from fusion.inspect.image import what_of
from fusion.inspect.measure import PixelTally, freezes_said, points_of, spread, times_of
from fusion.inspect.pictures import histogram, thumbnail, top_view
from fusion.messages.base import CompressedImage, Points
from fusion.messages.peek import word_of
from fusion.messages.roles import Seen
from fusion.pairing.times import stamps_of
from fusion.radiometric import read_flir
from fusion.radiometric.flir import HEAD_BYTES, glance, why_no_counts
from fusion.recordings.base import Schema, Topic
from fusion.sources.base import Entry
from fusion.sources.folders import read_bytes
from fusion.timing.freeze import FreezeFinder, Step

FAULTS_NAMED = 10
_FIRST_NS = 10**17  # 1973: a stamp before it is a number


@dataclass(frozen=True, slots=True)
class Sampled:
    """A stream with what its roles are guessed from, what of it cannot be read, and its pictures."""

    stream: Stream
    seen: Seen
    faults: tuple[str, ...] = ()
    pictures: tuple[Picture, ...] = ()


def image_stream(name: str, entries: Sequence[Entry], ignored: int, asked: Asked) -> Sampled:
    """The images `entries`: all of them with `asked.full`, else a few from first to last."""
    chosen = range(len(entries)) if asked.full else spread(len(entries), QUICK_ITEMS)
    look = _Images()
    for done, index in enumerate(chosen):
        asked.progress(done, len(chosen))
        look.add(entries[index].where)
    looked = Looked(len(chosen), len(entries), "images")
    times, stamps = _times(entries)
    notes = list(look.notes)
    if ignored:
        notes.append(f"other files in it, left alone: {ignored:,}")
    if asked.full and look.grey and look.failed:
        notes.append("frozen frames were not looked for: some images cannot be read")
    frozen = freezes_said(look.steps) if asked.full and look.grey and not look.failed else {}
    forms = Counter(entry.where.rpartition(".")[2].lower() for entry in entries)
    stream = Stream(
        name,
        "images",
        "image",
        len(entries),
        "",
        looked,
        {"files": dict(forms)} | look.facts() | frozen,
        times,
        tuple(notes),
        stamps if asked.pictures else None,
    )
    topic = Topic(name, Schema("image files"), "files", len(entries))
    encoding, size = look.kinds.most_common(1)[0][0] if look.kinds else ("", None)
    seen = Seen(topic, CompressedImage if look.kinds else None, encoding, size, camera=name, zeros=look.zeros)
    return Sampled(stream, seen, _faults(name, look.faults), look.pictures(name) if asked.pictures else ())


class _Images:
    """Takes files one by one."""

    def __init__(self) -> None:
        self.tallies: dict[int, PixelTally] = {}  # by bits
        self.steps, self.faults, self.notes = list[Step](), list[str](), dict[str, None]()
        self.sizes, self.contents = Counter[tuple[int, int]](), Counter[str]()
        self.kinds = Counter[tuple[str, tuple[int, int]]]()
        self.radiometric, self.visible, self.seen, self.grey = 0, 0, 0, True
        self.celsius: list[float] = []
        self.zeros = 0.0
        self._freeze, self._first = FreezeFinder(), None

    @property
    def failed(self) -> bool:
        return bool(self.faults)

    def add(self, where: str) -> None:
        try:
            data = read_bytes(where)
            pixels = self._pixels(data, where)
        except FrameError as error:
            self.faults.append(str(error))
            return
        self.seen += 1
        bits = pixels.dtype.itemsize * 8
        self.tallies.setdefault(bits, PixelTally()).add(pixels)
        size = (pixels.shape[1], pixels.shape[0])
        self.sizes[size] += 1
        self.contents[f"{what_of(pixels)}, {bits} bit"] += 1
        channels = 1 if pixels.ndim == 2 else pixels.shape[2]
        grey = channels == 1 or what_of(pixels) == "grey stored as colour"
        self.grey &= grey
        self.kinds[word_of(1 if grey else channels, bits), size] += 1
        if self._first is None:
            self._first, self.zeros = pixels, float(np.mean(pixels == 0))
        if self.grey:
            self.steps.append(self._freeze.add(pixels))

    def _pixels(self, data: bytes, where: str) -> NDArray[Any]:
        """The counts of a radiometric file, else the picture as it is."""
        holds, refused = glance(data[:HEAD_BYTES]), why_no_counts(data[:HEAD_BYTES])
        if holds is None or not holds.counts:
            if refused is not None:
                self.notes[f"{refused.what}: {refused.hint}"] = None
            return decode_image(data, where)
        flir = read_flir(data, where, visible=False)
        known = flir.celsius()[np.isfinite(flir.celsius())]
        self.celsius += [float(known.min()), float(known.max())] if known.size else []
        self.radiometric += 1
        self.visible += holds.visible
        return flir.counts

    def facts(self) -> dict[str, Any]:
        if not self.seen:
            return {}
        one = [[*size] for size, _ in self.sizes.most_common(10)]
        facts: dict[str, Any] = {"size_wh": one[0] if len(one) == 1 else one}
        facts["content"] = next(iter(self.contents)) if len(self.contents) == 1 else dict(self.contents)
        values = {f"{bits}_bit": tally.facts() for bits, tally in sorted(self.tallies.items())}
        facts["values"] = values if len(values) > 1 else next(iter(values.values()))
        if self.celsius:
            facts["radiometric"], facts["with_visible_image"] = self.radiometric, self.visible
            facts["temperature_celsius"] = [round(min(self.celsius), 2), round(max(self.celsius), 2)]
        both = self.visible == self.radiometric == self.seen or all("fourth" in c for c in self.contents)
        return facts | ({"both_cameras": True} if both else {})

    def pictures(self, name: str) -> tuple[Picture, ...]:
        made = [thumbnail(name, self._first)] if self._first is not None else []
        made += [histogram(f"{name}: counts", tally) for tally in self.tallies.values() if self.grey]
        return tuple(picture for picture in made if picture)


def cloud_stream(name: str, files: CloudFiles, asked: Asked) -> Sampled:
    """The clouds `files`, sampled as images are."""
    quick = min(QUICK_ITEMS, QUICK_BYTES // max(files[0].stat().st_size, 1))
    chosen = range(len(files)) if asked.full else spread(len(files), max(quick, 2))
    points, valid, fields, faults, first = [], [], {}, [], None
    for done, index in enumerate(chosen):
        asked.progress(done, len(chosen))
        try:
            cloud = read_cloud(files[index])
        except FusionError as error:
            faults.append(str(error))
            continue
        said = points_of(cloud)
        points.append(said["points"])
        valid.append(said["valid_points"])
        fields |= said["fields"]
        first = first or (cloud, said)
    facts: dict[str, Any] = {"files": dict(files.kinds)}
    if first is not None:
        facts |= {
            "points": [min(points), max(points)],
            "valid_points": [min(valid), max(valid)],
            "fields": fields,
        }
        facts["first_cloud"] = {
            k: v for k, v in first[1].items() if k in ("range_m", "rings", "scan_s", "extent_m")
        }
    entries = [Entry(stem, str(path)) for stem, path in zip(files.stems, files.paths, strict=True)]
    times, stamps = _times(entries)
    looked = Looked(len(chosen), len(files), "clouds")
    stream = Stream(
        name, "clouds", "cloud", len(files), "", looked, facts, times, (), stamps if asked.pictures else None
    )
    topic = Topic(name, Schema("cloud files"), "files", len(files))
    picture = top_view(name, first[0]) if first and asked.pictures else None
    seen = Seen(topic, Points if first else None, fields=tuple(fields), camera=name)
    return Sampled(stream, seen, _faults(name, faults), (picture,) if picture else ())


def _times(entries: Sequence[Entry]) -> tuple[Times | None, Any]:
    stamps = stamps_of(entries)
    if all(stamp is None or stamp < _FIRST_NS for stamp in stamps):  # numbered with ten digits: no times
        return None, None
    known = [stamp for stamp in stamps if stamp is not None]
    looked = Looked(len(entries), len(entries), "names")
    return times_of(stamps, "name", looked), np.array(known, np.int64) if known else None


def _faults(name: str, faults: Sequence[str]) -> tuple[str, ...]:
    more = len(faults) - FAULTS_NAMED
    rest = (f"{name}: … and {more} more that cannot be read",) if more > 0 else ()
    return (*faults[:FAULTS_NAMED], *rest)
