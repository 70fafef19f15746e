"""One data set: what a manifest file says, whole and sound, and what it refuses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, model_validator

from fusion.errors import InputError
from fusion.manifest import layout as found
from fusion.manifest.parts import (
    Calibration,
    Checks,
    CloudFiles,
    DepthFiles,
    Files,
    PairingPart,
    Recording,
    RgbFiles,
    Strict,
    Text,
    Thermal,
)
from fusion.pairing import PairingRule

if TYPE_CHECKING:
    from fusion.frames import Image

State = Literal["registered", "unregistered", "unpaired", "lidar only"]
ROLES = ("rgb", "fir", "rgbt", "lidar", "depth", "sparse")


class Manifest(Strict):
    """One data set. Unknown keys are refused at every level.

    Files by role: [rgb] and [fir], or [rgbt] alone for 4-channel files; [lidar] clouds, [depth] dense and
    [sparse] projected depth maps go with either, or stand alone. Or [recording] in place of them all.
    """

    format: Literal["fusion-dataset/1"]
    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]
    title: Text
    licence: Text
    citation: Text
    url: Annotated[str, Field(pattern=r"^https?://[!-~]+$", max_length=1000)] | None = None
    notes: Text | None = None
    registered: bool
    registration_note: Text
    paired: bool = True
    unpaired_note: Text | None = None
    rgb: RgbFiles | None = None
    fir: Files | None = None
    rgbt: Files | None = None
    lidar: CloudFiles | None = None
    depth: DepthFiles | None = None
    sparse: DepthFiles | None = None
    recording: Recording | None = None
    pairing: PairingPart | None = None
    calibration: Calibration | None = None
    thermal: Thermal = Thermal()
    checks: Checks = Checks()

    @model_validator(mode="after")
    def _roles(self) -> Manifest:
        files = [role for role in ROLES if getattr(self, role) is not None]
        if self.recording is not None:
            if files or self.pairing is not None:
                raise ValueError("[recording] has its own topics and tolerances: no files by role beside it")
            return self
        if not files:
            raise ValueError("expected files: [rgb] and [fir], [rgbt], [lidar], [depth], or [recording]")
        if self.rgbt is not None and (self.rgb is not None or self.fir is not None):
            raise ValueError("expected [rgb] and [fir], or [rgbt] alone for 4-channel files")
        if self.fir is not None and self.rgb is None:
            raise ValueError("expected [rgb] and [fir], or [rgbt] alone for 4-channel files")
        if self.rgb is not None and files == ["rgb"]:
            raise ValueError(
                "expected [rgb] and [fir], or [lidar] or depth with [rgb]: RGB alone fuses nothing"
            )
        if self.pairing is not None and self.fir is None:
            raise ValueError("[pairing] is of RGB and thermal: there is nothing to pair")
        return self

    @model_validator(mode="after")
    def _reasons(self) -> Manifest:
        if self.paired != (self.unpaired_note is None):
            raise ValueError("paired = false and unpaired_note, which says why and what to use, go together")
        if not self.paired and (self.pairing is not None or self.registered):
            raise ValueError("a set that is not paired has no [pairing] and is not registered")
        return self

    @property
    def state(self) -> State:
        """In one word what it is good for."""
        if not self.has_thermal():
            return "lidar only"
        return "unpaired" if not self.paired else "registered" if self.registered else "unregistered"

    def has_thermal(self) -> bool:
        topics = {} if self.recording is None else self.recording.topics.known()
        return self.fir is not None or self.rgbt is not None or "fir" in topics

    def lead(self) -> str:
        """The role that the others go with."""
        if self.recording is not None:
            return next(r for r in ("rgb", "fir", "lidar", "depth") if r in self.recording.topics.known())
        return next(
            role for role in ("rgb", "rgbt", "depth", "lidar", "sparse") if getattr(self, role) is not None
        )

    def needed(self) -> tuple[str, ...]:
        """Roles without which a root is not this set: RGB and thermal, else the leading one."""
        if self.recording is not None:
            return ("recording",)
        return ("rgb", "fir") if self.fir is not None else (self.lead(),)

    def files_of(self, role: str) -> Files:
        """Raises `KeyError` where the set has no such role."""
        part = getattr(self, role) if role in ROLES else None
        if part is None:
            raise KeyError(role)
        return part

    def layout(self) -> list[tuple[str, str]]:
        """(role, pattern) of what lies below the root; the role ``recording`` for recordings."""
        parts = [(role, getattr(self, role)) for role in (*ROLES, "recording")]
        return [(role, part.files) for role, part in parts if part is not None]

    def plan(self, root: str | Path) -> found.Layout:
        """The set as it lies below `root`: files by role, or recordings and topics; rules; calibration.

        Nothing is decoded. Raises `InputError` where `root` has not this layout, saying what was expected and
        where to get the set, or where a match leaves `root` through a link.
        """
        return found.plan(self, root)

    def refuse_unfit(self, *, registration: bool) -> None:
        """Raises `InputError`, with the way out, where RGB and thermal of this set cannot be laid on each
        other.

        `registration`: the user gave one (a rig, a homography, points, an alignment).
        """
        where = f"data set {self.name}"
        if not self.has_thermal():
            hint = "fusion depth makes depth of its clouds; for blending, take a set of RGB and thermal"
            raise InputError("it has no thermal images: there is nothing to blend", where=where, hint=hint)
        if not self.paired:
            raise InputError(
                "its RGB and thermal images are not pairs", where=where, hint=self.unpaired_note or ""
            )
        if not self.registered and not registration:
            raise InputError(
                "its thermal images are not registered to its RGB images: as they are, they do not fit",
                where=where,
                hint="give --rig FILE, --homography FILE, --points CSV, or --align",
            )

    def globs(self, root: str | Path) -> tuple[str, str | None]:
        """Glob patterns of the RGB and thermal images below `root`; (pattern, None) for 4-channel files.

        Characters of `root` itself that patterns give a meaning are escaped. Raises `InputError` as `plan`
        does, and for a set that has no such images.
        """
        roles = self.plan(root).roles
        if "rgbt" in roles:
            return roles["rgbt"].glob, None
        if "rgb" not in roles or "fir" not in roles:
            raise self.no_images()
        return roles["rgb"].glob, roles["fir"].glob

    def no_images(self) -> InputError:
        """Why this set gives no RGB and thermal images as files, and what to do."""
        where = f"data set {self.name}"
        if self.recording is not None:
            hint = f"fusion preprocess {self.name} ROOT -o OUT reads them"
            return InputError("its images lie in recordings, not in files", where=where, hint=hint)
        return InputError("it has no RGB and thermal images", where=where, hint=f"it is {self.state}")

    def pairing_rule(self, root: str | Path) -> PairingRule:
        """The rule for RGB and thermal; a mapping file is looked for inside `root`. Raises `InputError`."""
        part = self.pairing or PairingPart()
        if part.map_file is not None and not found.files_inside(Path(root), part.map_file):
            what = f"does not hold {self.name}: no mapping file '{part.map_file}'"
            raise InputError(what, where=root, hint=found.expected(self))
        return part.rule(Path(root))

    def differences(
        self, *, pairs: int | None = None, rgb: Image | None = None, fir: Image | None = None
    ) -> list[str]:
        """What of the given facts contradicts `checks`, in words; empty where nothing does."""
        seen: list[tuple[str, object, object]] = []
        if rgb is not None:
            seen.append(("RGB size", self.checks.rgb_size_wh, rgb.size_wh))
        if fir is not None:
            seen.append(("thermal size", self.checks.fir_size_wh, fir.size_wh))
            seen.append(("thermal bit depth", self.checks.fir_bits, fir.pixels.dtype.itemsize * 8))
        said = [
            f"{name}: {self.name} has {want}, found {got}"
            for name, want, got in seen
            if want not in (None, got)
        ]
        exact = self.checks.counts.pairs
        if pairs is not None and pairs < (self.checks.min_pairs or 0):
            said.append(f"pairs: {self.name} has at least {self.checks.min_pairs}, found {pairs}")
        elif pairs is not None and exact is not None and pairs != exact:
            said.append(f"pairs: {self.name} has {exact}, found {pairs}")
        return said
