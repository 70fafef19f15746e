"""Where manifests are found: the user's folder, the installed package, the checkout."""

from __future__ import annotations

import difflib
import os
import tomllib
from contextlib import suppress
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from pydantic import ValidationError

from fusion.errors import FusionError, UsageError
from fusion.manifest.model import Manifest

MAX_MANIFEST_BYTES = 1 << 20
TEMPLATES = frozenset({"template", "template_recording"})
_IN_CHECKOUT = Path(__file__).resolve().parents[2]


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
    known = sorted(set(found) - TEMPLATES)
    near = difflib.get_close_matches(text.lower(), known, n=3, cutoff=0.5)
    meant = f"did you mean {' or '.join(near)}? " if near else ""
    raise UsageError(f"no data set is called '{text}'", hint=f"{meant}known: {', '.join(known) or 'none'}")


def list_manifests() -> list[Listed]:
    """Every manifest that can be found, by name, but the templates; broken ones with what is wrong."""
    return [_listed(name, path) for name, path in sorted(_found().items()) if name not in TEMPLATES]


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
