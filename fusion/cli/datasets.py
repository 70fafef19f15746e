"""`fusion datasets`: what sets are known, what is known of one, and whether its files are as they should."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

if TYPE_CHECKING:
    from fusion.cli.dataset_checks import PairsSeen, Report, RoleSeen
    from fusion.manifest import Manifest

_LOUD = 5  # unmatched files named on the terminal; --json names all


def list_datasets() -> None:
    """List the known data sets: name, state, title.

    States: registered (thermal lies on RGB), unregistered (it needs a registration), unpaired (RGB and
    thermal are not of the same moments), lidar only (no thermal images). Manifests come from $FUSION_DATASETS
    (or ~/.config/fusion/datasets) and from fusion itself.
    """
    from fusion.manifest import list_manifests

    found = list_manifests()
    width = max((len(item.name) for item in found), default=0)
    for item in found:
        state = "broken" if item.manifest is None else item.manifest.state
        title = item.problem if item.manifest is None else item.manifest.title
        print(f"{item.name:<{width}}  {state:<12}  {title}")
    if not found:
        print("no data sets found")


def show_dataset(name: str) -> None:
    """Show one data set: layout, pairing, registration, calibration, licence, citation, where to get it.

    NAME is a name from `fusion datasets list` or the path of a .toml file.
    """
    from fusion.manifest import load_manifest
    from fusion.report.table import table

    manifest = load_manifest(name)
    rows = [*_about(manifest), *_laid_out(manifest), *_known(manifest), *_whose(manifest)]
    indent = " " * (max(len(label) for label, _ in rows) + 2)
    print("\n".join(table([(label, text.replace("\n", f"\n{indent}")) for label, text in rows])))
    print(f"\n{_next_command(manifest)}")


def check_dataset(
    name: str,
    root: Path,
    *,
    json: bool = False,
    alignment: Annotated[bool, Parameter(negative=())] = False,
) -> None:
    """Hold the files below ROOT against the data set NAME: counts, sizes, bits, pairs, stamps, calibration.

    A few files of each role are decoded. Exit code 1 when something is not as the manifest says.

    Parameters
    ----------
    name
        A name from `fusion datasets list`, or the path of a .toml file.
    root
        The folder that holds the set.
    json
        For machines: everything that was found, every unmatched file with its reason.
    alignment
        Also let the scene say whether thermal lies on RGB, as the manifest claims (some seconds).
    """
    import sys
    from dataclasses import asdict
    from json import dumps

    from fusion.cli.dataset_checks import check
    from fusion.cli.running import quiet_libraries
    from fusion.manifest import load_manifest

    manifest = load_manifest(name)
    with quiet_libraries():
        report = check(manifest, root, alignment=alignment)
    print(dumps(asdict(report), indent=2) if json else "\n".join(_report_lines(report)))
    if not report.ok:
        sys.exit(1)


# --- show


def _about(manifest: Manifest) -> list[tuple[str, str]]:
    return [("name", manifest.name), ("title", manifest.title), ("state", manifest.state)]


def _laid_out(manifest: Manifest) -> list[tuple[str, str]]:
    """Where everything lies below the root, how it goes together, where its times come from."""
    rows = [(role, f"ROOT/{pattern}") for role, pattern in manifest.layout()]
    if manifest.recording is not None:
        rows += [(f"topic {role}", topic) for role, topic in manifest.recording.topics.known().items()]
        rows.append(("stamps", f"of the {manifest.recording.stamp}"))
        tolerance = manifest.recording.tolerance_ms.items()
        rows += [("tolerance", ", ".join(f"{role} {ms:g} ms" for role, ms in tolerance))] if tolerance else []
        return rows
    for role, _ in manifest.layout():
        part = manifest.files_of(role)
        stamps = f"ROOT/{part.stamp_files}" if part.stamp_files else part.stamps
        rows += [(f"{role} stamps", stamps)] if stamps else []
        per_metre = getattr(part, "per_metre", None)
        rows += [(f"{role} unit", f"{per_metre:g} counts a metre, 0 = none")] if per_metre else []
        bayer = getattr(part, "bayer", None)
        rows += [(f"{role} pixels", f"raw mosaic, {bayer}")] if bayer else []
        pairing = getattr(part, "pairing", None)
        if pairing is not None and role != manifest.lead():
            rows.append((f"{role} pairing", _rule(pairing.model_dump(exclude_none=True))))
    return rows


def _known(manifest: Manifest) -> list[tuple[str, str]]:
    """What is known of its images: pairs, registration, calibration, units, sizes, counts."""
    rows = []
    if manifest.fir is not None:
        pairing = {} if manifest.pairing is None else manifest.pairing.model_dump(exclude_none=True)
        rows.append(("pairing", _rule(pairing) if manifest.paired else f"none: {manifest.unpaired_note}"))
    elif manifest.rgbt is not None:
        rows.append(("pairing", "none: each file holds both"))
    rows.append(("registered", f"{'yes' if manifest.registered else 'no'}: {manifest.registration_note}"))
    calibration = manifest.calibration
    if calibration is not None:
        form = calibration.form or f"not read: {calibration.note}"
        rows.append(("calibration", f"ROOT/{calibration.files} ({form}; one a {calibration.per})"))
    if manifest.thermal.celsius_per_count is not None:
        scale, zero = manifest.thermal.celsius_per_count, manifest.thermal.celsius_at_zero
        rows.append(("degrees", f"celsius = {zero:g} + {scale:g} * counts"))
    checks = manifest.checks.model_dump(exclude_none=True)
    counts = checks.pop("counts", {})
    rows += [(key, _plain(value)) for key, value in checks.items()]
    return rows + [(f"{key} in all", f"{value:,}") for key, value in counts.items()]


def _whose(manifest: Manifest) -> list[tuple[str, str]]:
    rows = [("licence", manifest.licence), ("citation", manifest.citation)]
    rows += [("url", manifest.url)] if manifest.url else []
    return rows + ([("notes", manifest.notes)] if manifest.notes else [])


def _next_command(manifest: Manifest) -> str:
    if not manifest.has_thermal():
        return f"fusion datasets check {manifest.name} ROOT"
    if manifest.recording is not None:
        return f"fusion preprocess {manifest.name} ROOT -o OUT"
    if not manifest.paired:
        return f"it cannot be blended: {manifest.unpaired_note}"
    registration = "" if manifest.registered else " --homography FILE"
    if not manifest.registered and manifest.calibration is not None and manifest.calibration.form is not None:
        registration = f" --rig ROOT/{manifest.calibration.files}"
    return f"fusion blend --dataset {manifest.name} ROOT{registration} -o OUT"


def _rule(parts: dict[str, object]) -> str:
    return ", ".join(f"{key} {value}" for key, value in parts.items()) or "by stem"


def _plain(value: object) -> str:
    return "{}x{}".format(*value) if isinstance(value, tuple) else str(value)


# --- check


def _report_lines(report: Report) -> list[str]:
    lines = [f"{report.name} in {report.root}: {report.state}"]
    lines += [_role_line(seen) for seen in report.roles]
    for pairs in report.pairs:
        lines += _pair_lines(pairs)
    lines += [f"calibration: {line}" for line in report.calibration]
    lines += [f"note: {finding.text}" for finding in report.findings if not finding.wrong]
    lines += [f"wrong: {finding.text}" for finding in report.findings if finding.wrong]
    wrong = sum(finding.wrong for finding in report.findings)
    things = "1 thing is" if wrong == 1 else f"{wrong} things are"
    lines.append(f"{things} not as the manifest says" if wrong else "as the manifest says")
    return lines


def _role_line(seen: RoleSeen) -> str:
    facts = [f"{seen.role}: {'?' if seen.files is None else f'{seen.files:,}'} at {seen.where}"]
    if seen.sizes_wh:
        facts.append(f"of {seen.looked_at} looked at: {', '.join([*seen.sizes_wh, *seen.pixels])}")
    if seen.points:
        facts.append(f"{min(seen.points):,} to {max(seen.points):,} points")
    if seen.first_ns is not None and seen.last_ns is not None:
        facts.append(f"{(seen.last_ns - seen.first_ns) / 1e9:.3f} s from the first to the last")
    return "; ".join(facts)


def _pair_lines(pairs: PairsSeen) -> list[str]:
    apart = "" if pairs.dt_max_ms is None else f", at most {pairs.dt_max_ms:.1f} ms apart"
    limit = "" if pairs.tolerance_ms is None else f" (tolerance {pairs.tolerance_ms:.1f} ms)"
    lines = [f"{pairs.role} with {pairs.lead}: {pairs.pairs:,} by {pairs.by}{apart}{limit}"]
    if pairs.unmatched:
        lines.append(f"  {len(pairs.unmatched):,} without a partner:")
        lines += [f"  {one['role']} {one['where']}: {one['reason']}" for one in pairs.unmatched[:_LOUD]]
    if len(pairs.unmatched) > _LOUD:
        lines.append(f"  and {len(pairs.unmatched) - _LOUD:,} more: --json names them all")
    return lines
