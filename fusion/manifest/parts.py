"""The tables of a manifest: each checked when it is read, unknown keys refused."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from fusion.errors import FusionError
from fusion.pairing import PairingRule


def _plain(text: str) -> str:
    """Text that a terminal shows as it stands."""
    if not text.strip() or any(not c.isprintable() and c != "\n" for c in text):
        raise ValueError("expected printable text that is not empty")
    return text.strip()


def _inside(path: str) -> str:
    """A relative posix path that cannot leave its root."""
    parts = path.split("/")
    if path.startswith(("/", "~")) or "\\" in path or re.match(r"[A-Za-z]:", path):
        raise ValueError("expected a path relative to the root, with forward slashes and no drive")
    if any(part in ("", ".", "..") for part in parts) or not path.isprintable():
        raise ValueError("expected a path without empty parts, '.', '..' or control characters")
    return path


def _pattern(path: str) -> str:
    if "**" in path or any(c in path for c in "{}"):
        raise ValueError("expected a pattern of *, ? and [ ] only: ** and { } are not expanded")
    return _inside(path)


def _no_pattern(path: str) -> str:
    if any(c in path for c in "*?[]{}"):
        raise ValueError("expected one file, not a pattern")
    return _inside(path)


def _ns(milliseconds: float | None) -> int | None:
    return None if milliseconds is None else round(milliseconds * 1e6)


def _sound(make: Callable[[], object]) -> None:
    """What a rule refuses is the manifest's fault."""
    try:
        make()
    except FusionError as error:
        raise ValueError(str(error)) from None


Text = Annotated[str, Field(max_length=4000), AfterValidator(_plain)]
Pattern = Annotated[str, Field(max_length=1000), AfterValidator(_pattern)]
Positive = Annotated[int, Field(ge=1, le=1_000_000_000)]
SizeWH = Annotated[tuple[Positive, Positive], Field(strict=False)]
Key = Annotated[str, Field(min_length=1, max_length=500)]
Milliseconds = Annotated[float, Field(gt=0, le=1e9)]
TopicName = Annotated[str, Field(max_length=1000, pattern=r"^[!-~]+$")]
Bayer = Literal["rggb", "bggr", "gbrg", "grbg"]
Form = Literal["rig", "kalibr", "ros", "opencv", "kitti", "kitti-raw", "koide", "plain"]


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Files(Strict):
    """Where the files of one role lie, and where their time stamps come from.

    `files` is a glob pattern relative to the root. `stamps`: ``name`` (10, 13, 16 or 19 digits, or
    seconds.fraction), or ``none``; None: not said. `stamp_files` is a pattern of text files instead, one time
    a line: KITTI's timestamps.txt (see `fusion.manifest.stamps`).
    """

    files: Pattern
    stamps: Literal["name", "none"] | None = None
    stamp_files: Pattern | None = None

    @model_validator(mode="after")
    def _one_clock(self) -> Files:
        if self.stamps is not None and self.stamp_files is not None:
            raise ValueError("stamps come from the name or from stamp_files: give one")
        return self


class RgbFiles(Files):
    """[rgb]: images. `bayer` where they are raw mosaics, the colours of the top-left 2 x 2 pixels by row."""

    bayer: Bayer | None = None


class RolePairing(Strict):
    """How the files of a further role (clouds, depth) go with the leading one's.

    The rules are `fusion.pairing`'s but for ``map``. `lead_key` finds the key in the leading role's names,
    `key` in this one's.
    """

    by: Literal["stem", "index", "stamp", "order"] = "stem"
    lead_key: Key | None = None
    key: Key | None = None
    tolerance_ms: Milliseconds | None = None

    def rule(self) -> PairingRule:
        """The rule with the leading role in RGB's place and this one in thermal's."""
        return PairingRule(self.by, self.lead_key, self.key, _ns(self.tolerance_ms))

    @model_validator(mode="after")
    def _possible(self) -> RolePairing:
        _sound(self.rule)
        return self


class CloudFiles(Files):
    """[lidar]: clouds, metres. `form` is a row of `fusion.clouds.READERS`, None where the suffix decides."""

    form: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]*$")] | None = None
    pairing: RolePairing = RolePairing()


class DepthFiles(Files):
    """[depth] and [sparse]: 16-bit maps of `per_metre` counts a metre (KITTI 256; millimetres 1000), 0 =
    none.
    """

    per_metre: Annotated[float, Field(gt=0)]
    value: Literal["depth", "range"] = "depth"
    pairing: RolePairing = RolePairing()


class PairingPart(Strict):
    """The parts of a `fusion.pairing.PairingRule` that a data set can fix, for RGB and thermal."""

    by: Literal["stem", "index", "stamp", "map", "order"] = "stem"
    rgb_key: Key | None = None
    fir_key: Key | None = None
    map_file: Annotated[str, AfterValidator(_no_pattern)] | None = None
    tolerance_ms: Milliseconds | None = None

    def rule(self, root: Path) -> PairingRule:
        map_file = None if self.map_file is None else str(root / self.map_file)
        return PairingRule(self.by, self.rgb_key, self.fir_key, _ns(self.tolerance_ms), map_file)

    @model_validator(mode="after")
    def _possible(self) -> PairingPart:
        _sound(lambda: self.rule(Path()))
        return self


class Topics(Strict):
    """[recording.topics]: the topic that plays each role; `*_info` are the cameras' CameraInfo."""

    rgb: TopicName | None = None
    fir: TopicName | None = None
    lidar: TopicName | None = None
    depth: TopicName | None = None
    rgb_info: TopicName | None = None
    fir_info: TopicName | None = None

    def known(self) -> dict[str, str]:
        return self.model_dump(exclude_none=True)


class Recording(Strict):
    """[recording]: recordings in place of folders.

    `files` is a pattern of recordings: files, or folders such as a rosbag2 is. `stamp` is the clock:
    ``header`` (when the sensor measured) or ``log`` (when it was recorded). `tolerance_ms` by role is how far
    from the leading role's stamp a message may be; without it, half the median interval of the faster of the
    two.
    """

    files: Pattern
    stamp: Literal["header", "log"] = "header"
    topics: Topics
    tolerance_ms: dict[Literal["fir", "lidar", "depth"], Milliseconds] = {}

    @model_validator(mode="after")
    def _something(self) -> Recording:
        roles = {"rgb", "fir", "lidar", "depth"} & self.topics.known().keys()
        if not roles:
            raise ValueError("topics: name one at least of rgb, fir, lidar, depth")
        if self.tolerance_ms.keys() - roles:
            raise ValueError("tolerance_ms: it names a role that has no topic")
        return self


class Calibration(Strict):
    """[calibration]: where it lies, and whether it can be read.

    `files` is one file or a pattern: of one a sequence (`per`), covering the files below the folders that the
    pattern's wildcards stand for, or of one a frame, with that frame's stem. `form` names the form
    (`fusion calibrate convert` knows them); None: it is in a form that is not read, and `note` says which.
    """

    files: Pattern
    form: Form | None = None
    per: Literal["set", "sequence", "frame"] = "set"
    note: Text | None = None

    @model_validator(mode="after")
    def _reasoned(self) -> Calibration:
        if self.form is None and self.note is None:
            raise ValueError("without a form, note must say why it is not read")
        return self


class Thermal(Strict):
    """[thermal]: celsius = celsius_at_zero + celsius_per_count * counts, where the set documents it."""

    celsius_per_count: Annotated[float, Field(gt=0)] | None = None
    celsius_at_zero: float | None = None
    note: Text | None = None

    @model_validator(mode="after")
    def _both(self) -> Thermal:
        if (self.celsius_per_count is None) != (self.celsius_at_zero is None):
            raise ValueError("celsius_per_count and celsius_at_zero go together")
        return self


class Counts(Strict):
    """[checks.counts]: how many files each role has, and how many pairs, where that is published."""

    pairs: Positive | None = None
    rgb: Positive | None = None
    fir: Positive | None = None
    rgbt: Positive | None = None
    lidar: Positive | None = None
    depth: Positive | None = None
    sparse: Positive | None = None


class Checks(Strict):
    """What the files are known to be; None where it varies or is not known. Sizes are (width, height)."""

    rgb_size_wh: SizeWH | None = None
    fir_size_wh: SizeWH | None = None
    fir_bits: Literal[8, 16] | None = None
    min_pairs: Positive | None = None
    counts: Counts = Counts()
