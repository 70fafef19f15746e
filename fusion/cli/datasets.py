"""`fusion datasets`: what sets are known, and what is known of one."""

from __future__ import annotations


def list_datasets() -> None:
    """List the known data sets: name, registered or not, title.

    Manifests come from $FUSION_DATASETS (or ~/.config/fusion/datasets) and from fusion itself.
    """
    from fusion.manifest import list_manifests

    found = list_manifests()
    width = max((len(item.name) for item in found), default=0)
    for item in found:
        manifest = item.manifest
        state = "broken" if manifest is None else "registered" if manifest.registered else "unregistered"
        print(f"{item.name:<{width}}  {state:<12}  {item.problem if manifest is None else manifest.title}")
    if not found:
        print("no data sets found")


def show_dataset(name: str) -> None:
    """Show one data set: its layout, pairing, registration, licence, citation and where to get it.

    NAME is a name from `fusion datasets list` or the path of a .toml file.
    """
    from fusion.manifest import load_manifest

    manifest = load_manifest(name)
    pairing = {} if manifest.pairing is None else manifest.pairing.model_dump(exclude_none=True)
    rows = [("name", manifest.name), ("title", manifest.title)]
    rows += [(role, f"ROOT/{pattern}") for role, pattern in manifest.layout()]
    rows.append(
        ("pairing", ", ".join(f"{key} {value}" for key, value in pairing.items()) or _default(manifest.rgbt))
    )
    rows.append(("registered", f"{'yes' if manifest.registered else 'no'}: {manifest.registration_note}"))
    rows += [(key, str(value)) for key, value in manifest.checks.model_dump(exclude_none=True).items()]
    rows += [("licence", manifest.licence), ("citation", manifest.citation), ("url", manifest.url)]
    rows += [("notes", manifest.notes)] if manifest.notes else []
    width = max(len(label) for label, _ in rows)
    for label, text in rows:
        print(f"{label:<{width}}  {text.replace(chr(10), chr(10) + ' ' * (width + 2))}")
    registration = "" if manifest.registered else " --homography FILE"
    print(f"\nfusion blend --dataset {manifest.name} ROOT{registration} -o OUT")


def _default(rgbt: object) -> str:
    return "by stem" if rgbt is None else "none: each file holds both"
