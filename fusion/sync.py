"""Sources become `FrameSet`s: what belongs together is read together."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Literal, Protocol

from fusion.frames import FrameSet, Image
from fusion.pairing import Pair, Pairing, PairingRule, Unmatched, pair, stamps_of
from fusion.sources import open_source
from fusion.sources.base import Entry, Source
from fusion.sources.channels import RgbtFiles, open_rgbt
from fusion.sources.radiometric import RadiometricFiles, is_radiometric, open_radiometric_files

UNREGISTERED = "the visible images lie in the thermal files, and are not registered to the counts"


class Pairs(Protocol):
    """A finite, ordered set of `FrameSet`s with random access; `read` is safe from several threads."""

    name: str
    pairing: Pairing
    ignored: int  # how many other files the sources left alone

    def __len__(self) -> int: ...

    def stems(self, index: int) -> tuple[str, str]:
        """The stems of the RGB and of the thermal image."""
        ...

    def read(self, index: int) -> FrameSet:
        """Decode both images of a pair. Raises `FrameError` where one cannot be used."""
        ...

    def read_fir(self, index: int) -> Image:
        """Decode the thermal image alone."""
        ...

    def changed_ns(self, index: int) -> int:
        """When the files that a pair lies in last changed (0 where there are none)."""
        ...

    def close(self) -> None: ...


class PairedSources:
    """Pairs from an RGB source and a thermal source."""

    def __init__(self, rgb: Source, fir: Source, rule: PairingRule) -> None:
        self.name = f"{rgb.name} + {fir.name}"
        self.pairing = pair(rgb.entries, fir.entries, rule)
        self.ignored = rgb.ignored + fir.ignored
        self._rgb, self._fir = rgb, fir
        by_time = self.pairing.rule_by == "stamp"  # the stamps may stand in the names alone
        self._rgb_stamps = stamps_of(rgb.entries, rule.rgb_key) if by_time else None
        self._fir_stamps = stamps_of(fir.entries, rule.fir_key) if by_time else None

    def __len__(self) -> int:
        return len(self.pairing.pairs)

    @property
    def fir_files(self) -> list[str]:
        """The thermal images' files, pair by pair (of a video, what its frames are called)."""
        return [self._fir.entries[pair.fir].where for pair in self.pairing.pairs]

    def _entries(self, index: int) -> tuple[Entry, Entry]:
        rgb, fir, _ = self.pairing.pairs[index]
        return self._rgb.entries[rgb], self._fir.entries[fir]

    def stems(self, index: int) -> tuple[str, str]:
        rgb, fir = self._entries(index)
        return rgb.stem, fir.stem

    def read(self, index: int) -> FrameSet:
        rgb = _read(self._rgb, self.pairing.pairs[index].rgb, self._rgb_stamps)
        return FrameSet(rgb, self.read_fir(index))

    def read_fir(self, index: int) -> Image:
        return _read(self._fir, self.pairing.pairs[index].fir, self._fir_stamps)

    def changed_ns(self, index: int) -> int:
        return _changed_ns(self._entries(index))

    def close(self) -> None:
        self._rgb.close()
        self._fir.close()


class PairedRadiometric:
    """Pairs from radiometric JPEGs: the counts of each, and the visible image in it. Not registered.

    Files without one of the two are `pairing.unmatched`, each with its reason.
    """

    def __init__(self, files: RadiometricFiles) -> None:
        self.name = files.name
        self.ignored = files.ignored
        self._files = files
        count, lost = len(files.entries), [Unmatched(f.role, f.where, f.reason) for f in files.left_out]
        n_rgb, n_fir = (count + sum(one.role == role for one in lost) for role in ("rgb", "fir"))
        pairs = tuple(Pair(k, k, 0) for k in range(count))
        self.pairing = Pairing("channels", pairs, tuple(lost), None, (UNREGISTERED,), n_rgb, n_fir)

    def __len__(self) -> int:
        return len(self._files.entries)

    @property
    def fir_files(self) -> list[str]:
        """The thermal images' files, pair by pair."""
        return [entry.where for entry in self._files.entries]

    def stems(self, index: int) -> tuple[str, str]:
        stem = self._files.entries[index].stem
        return stem, stem

    def read(self, index: int) -> FrameSet:
        return self._files.read(index)

    def read_fir(self, index: int) -> Image:
        return self._files.read_fir(index)

    def changed_ns(self, index: int) -> int:
        return _changed_ns([self._files.entries[index]])

    def close(self) -> None:
        self._files.close()


class PairedChannels:
    """Pairs from files that hold RGB and thermal together, in four channels."""

    def __init__(self, files: RgbtFiles) -> None:
        self.name = files.name
        self.pairing = Pairing.of_channels(len(files.entries))
        self.ignored = files.ignored
        self._files = files

    def __len__(self) -> int:
        return len(self._files.entries)

    def stems(self, index: int) -> tuple[str, str]:
        stem = self._files.entries[index].stem
        return stem, stem

    def read(self, index: int) -> FrameSet:
        return self._files.read(index)

    def read_fir(self, index: int) -> Image:
        return self.read(index).fir

    def changed_ns(self, index: int) -> int:
        return _changed_ns([self._files.entries[index]])

    def close(self) -> None:
        self._files.close()


def open_pairs(
    rgb: str | Path,
    fir: str | Path | None = None,
    rule: PairingRule | None = None,
    *,
    fir_colour: Literal["refuse", "luma"] = "refuse",
) -> Pairs:
    """Open folders, glob patterns, videos or single files and pair them; nothing is decoded yet.

    `fir` None: `rgb` names 4-channel RGB+T files, or radiometric JPEGs. `fir_colour` says what to do with
    thermal images that are in colour. Raises `InputError` where nothing is found or nothing pairs.
    """
    if fir is None:
        return open_radiometric(rgb) if is_radiometric(rgb) else PairedChannels(open_rgbt(rgb))
    rgb_source = open_source(rgb, "rgb")
    fir_source = open_source(fir, "fir", fir_colour=fir_colour)
    return PairedSources(rgb_source, fir_source, rule or PairingRule())


def open_radiometric(spec: str | Path) -> PairedRadiometric:
    """Open a folder, a glob pattern or one file of radiometric JPEGs with visible images in them.

    Raises `InputError` where nothing is there or no file holds both.
    """
    return PairedRadiometric(open_radiometric_files(spec))


def _read(source: Source, index: int, stamps: Sequence[int | None] | None) -> Image:
    image = source.read(index)
    return image if stamps is None else replace(image, stamp_ns=stamps[index])


def _changed_ns(entries: Sequence[Entry]) -> int:
    changed = 0
    for entry in entries:
        with suppress(OSError):  # a source that is no file has no such time
            changed = max(changed, Path(entry.file or entry.where).stat().st_mtime_ns)
    return changed
