"""Data sets as TOML: where their images lie, how they pair, whether they are registered, whose they are.

A manifest is data, never code: it names files below a root that the user gives, and what it names must
lie inside that root. It is found by name in the user's folder ($FUSION_DATASETS, else
~/.config/fusion/datasets), in the installed package, or in the checkout's `datasets/`, in this order.
"""

from __future__ import annotations

import difflib
import os
import re
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from glob import escape
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from fusion.errors import FusionError, InputError, UsageError
from fusion.pairing import PairingRule

if TYPE_CHECKING:
    from fusion.frames import Image

FORMAT = "fusion-dataset/1"
MAX_MANIFEST_BYTES = 1 << 20
TEMPLATE = "template"
_IN_CHECKOUT = Path(__file__).resolve().parents[1]


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


Text = Annotated[str, Field(max_length=4000), AfterValidator(_plain)]
Pattern = Annotated[str, Field(max_length=1000), AfterValidator(_pattern)]
Positive = Annotated[int, Field(ge=1, le=1_000_000)]
SizeWH = Annotated[tuple[Positive, Positive], Field(strict=False)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Files(_Strict):
    """Where the images of one role lie: a glob pattern relative to the root."""

    files: Pattern


class PairingPart(_Strict):
    """The parts of a `fusion.pairing.PairingRule` that a data set can fix."""

    by: Literal["stem", "index", "stamp", "map", "order"] = "stem"
    rgb_key: Annotated[str, Field(min_length=1, max_length=500)] | None = None
    fir_key: Annotated[str, Field(min_length=1, max_length=500)] | None = None
    map_file: Annotated[str, AfterValidator(_no_pattern)] | None = None
    tolerance_ms: Annotated[float, Field(gt=0)] | None = None

    def rule(self, root: Path) -> PairingRule:
        tolerance_ns = None if self.tolerance_ms is None else round(self.tolerance_ms * 1e6)
        map_file = None if self.map_file is None else str(root / self.map_file)
        return PairingRule(self.by, self.rgb_key, self.fir_key, tolerance_ns, map_file)

    @model_validator(mode="after")
    def _possible(self) -> PairingPart:
        try:
            self.rule(Path())
        except FusionError as error:
            raise ValueError(str(error)) from None
        return self


class Checks(_Strict):
    """What the images are known to be; None where it varies or is not known. Sizes are (width, height)."""

    rgb_size_wh: SizeWH | None = None
    fir_size_wh: SizeWH | None = None
    fir_bits: Literal[8, 16] | None = None
    min_pairs: Positive | None = None


class Manifest(_Strict):
    """One data set of paired images. Unknown keys are refused at every level."""

    format: Literal["fusion-dataset/1"]
    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]
    title: Text
    licence: Text
    citation: Text
    url: Annotated[str, Field(pattern=r"^https?://[!-~]+$", max_length=1000)]
    notes: Text | None = None
    registered: bool
    registration_note: Text
    rgb: Files | None = None
    fir: Files | None = None
    rgbt: Files | None = None
    pairing: PairingPart | None = None
    checks: Checks = Checks()

    @model_validator(mode="after")
    def _roles(self) -> Manifest:
        two = self.rgb is not None and self.fir is not None and self.rgbt is None
        one = self.rgbt is not None and self.rgb is None and self.fir is None
        if not two and not one:
            raise ValueError("expected [rgb] and [fir], or [rgbt] alone for 4-channel files")
        if one and self.pairing is not None:
            raise ValueError("[rgbt] files hold both channels: there is nothing to pair")
        return self

    def layout(self) -> list[tuple[str, str]]:
        """(role, pattern) of what lies below the root."""
        parts = (("rgb", self.rgb), ("fir", self.fir), ("rgbt", self.rgbt))
        return [(role, part.files) for role, part in parts if part is not None]

    def globs(self, root: str | Path) -> tuple[str, str | None]:
        """Glob patterns of the RGB and thermal images below `root`; (pattern, None) for 4-channel files.

        Characters of `root` itself that patterns give a meaning are escaped. Raises `InputError` where
        `root` has not this layout, saying what was expected and where to get the set, or where a match
        leaves `root` through a link.
        """
        root = Path(root)
        if not root.is_dir():
            raise InputError(f"no such folder: the root of {self.name}", where=root, hint=self._expected())
        for role, pattern in self.layout():
            found = sum(1 for _ in _files_inside(root, pattern))
            if not found:
                what = f"does not hold {self.name}: no {role} image matches '{pattern}'"
                raise InputError(what, where=root, hint=self._root_hint(root) + self._expected())
        first, *second = (f"{escape(str(root))}/{pattern}" for _, pattern in self.layout())
        return first, second[0] if second else None

    def pairing_rule(self, root: str | Path) -> PairingRule:
        """The set's pairing rule; a mapping file is looked for inside `root`. Raises `InputError`."""
        part = self.pairing or PairingPart()
        if part.map_file is not None and not any(_files_inside(Path(root), part.map_file)):
            what = f"does not hold {self.name}: no mapping file '{part.map_file}'"
            raise InputError(what, where=root, hint=self._expected())
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
        if pairs is not None and pairs < (self.checks.min_pairs or 0):
            said.append(f"pairs: {self.name} has at least {self.checks.min_pairs}, found {pairs}")
        return said

    def _expected(self) -> str:
        layout = " and ".join(f"ROOT/{pattern}" for _, pattern in self.layout())
        return f"expected {layout}; get the set from {self.url}"

    def _root_hint(self, root: Path) -> str:
        """The folder directly above or below `root` that would have been the right one."""
        with suppress(OSError):
            near = [root.resolve().parent, *sorted(p for p in root.iterdir() if p.is_dir())[:100]]
            for folder in near:
                if all(next(folder.glob(pattern), None) for _, pattern in self.layout()):
                    return f"{folder} has the layout: give that as the root; "
        return ""


def _files_inside(root: Path, pattern: str) -> Iterator[Path]:
    """Files below `root` that match, without hidden ones. Raises `InputError` for one that leads out."""
    home = root.resolve()
    inside: dict[Path, bool] = {}
    for path in root.glob(pattern):
        if any(part.startswith(".") for part in path.relative_to(root).parts) or not path.is_file():
            continue
        if path.parent not in inside:
            inside[path.parent] = path.parent.resolve().is_relative_to(home)
        if not inside[path.parent] or (path.is_symlink() and not path.resolve().is_relative_to(home)):
            raise InputError(
                "leads out of the data set's root", where=path, hint="replace the link by the files"
            )
        yield path


@dataclass(frozen=True, slots=True)
class Listed:
    """A manifest that was found: its name, its file, and either its content or what is wrong with it."""

    name: str
    path: Path
    manifest: Manifest | None
    problem: str = ""


def load_manifest(name_or_path: str | Path) -> Manifest:
    """The manifest of that name, or in that .toml file. Raises `UsageError`."""
    text = str(name_or_path)
    if text.endswith(".toml") or "/" in text or os.sep in text:
        return _read(Path(text))
    found = _found()
    if text in found:
        return _read(found[text])
    known = sorted(set(found) - {TEMPLATE})
    near = difflib.get_close_matches(text.lower(), known, n=3, cutoff=0.5)
    meant = f"did you mean {' or '.join(near)}? " if near else ""
    raise UsageError(f"no data set is called '{text}'", hint=f"{meant}known: {', '.join(known) or 'none'}")


def list_manifests() -> list[Listed]:
    """Every manifest that can be found, by name, but the template; broken ones with what is wrong."""
    return [_listed(name, path) for name, path in sorted(_found().items()) if name != TEMPLATE]


def _listed(name: str, path: Path) -> Listed:
    try:
        return Listed(name, path, _read(path))
    except FusionError as error:
        return Listed(name, path, None, str(error))


def _found() -> dict[str, Path]:
    """Path of every manifest by name; what is found earlier hides what is found later."""
    found: dict[str, Path] = {}
    for folder in _folders():
        for path in sorted(folder.glob("*.toml")):
            found.setdefault(path.stem, path)
    return found


def _folders() -> list[Path]:
    own = os.environ.get("FUSION_DATASETS")
    if own and not Path(own).is_dir():
        raise UsageError("no such folder", where=f"FUSION_DATASETS={own}", hint="correct it, or unset it")
    folders = [Path(own)] if own else []
    if not own:
        with suppress(RuntimeError):  # an account without a home
            folders.append(Path.home() / ".config" / "fusion" / "datasets")
    folders.append(Path(str(files("fusion"))) / "manifests")
    if (
        _IN_CHECKOUT / "pyproject.toml"
    ).is_file():  # beside an installed package it would be someone else's folder
        folders.append(_IN_CHECKOUT / "datasets")
    return [folder for folder in folders if folder.is_dir()]


def _read(path: Path) -> Manifest:
    try:
        if not path.is_file():
            raise UsageError(
                "no such manifest", where=path, hint="fusion datasets list shows those that are known"
            )
        if path.stat().st_size > MAX_MANIFEST_BYTES:
            raise UsageError("a manifest over 1 MB is none", where=path)
        table = tomllib.loads(path.read_bytes().decode("utf-8-sig"))
        manifest = Manifest.model_validate(table)
    except ValidationError as error:
        raise UsageError(_first_fault(error), where=path, hint="template.toml explains every line") from None
    except OSError as error:
        raise UsageError(f"cannot be read: {error.strerror or error}", where=path) from None
    except (ValueError, RecursionError) as error:  # TOML syntax, encoding
        raise UsageError(f"is no TOML: {error}", where=path) from None
    if manifest.name != path.stem:
        raise UsageError(f"calls itself '{manifest.name}'", where=path, hint="file name and name must agree")
    return manifest


def _first_fault(error: ValidationError) -> str:
    first, *more = error.errors(include_url=False, include_context=False)
    place = ".".join(map(str, first["loc"])) or "the manifest"
    rest = f" (and {len(more)} more)" if more else ""
    return f"{place}: {first['msg'].removeprefix('Value error, ')}{rest}"
