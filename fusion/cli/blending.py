"""What `fusion blend` does once its options are known (the heavy imports live here)."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from fusion.batch import opencv_on_one_thread, run
from fusion.cli.running import progress_bar, quiet_libraries, refuse_overlap, threads_of, warn
from fusion.codecs import encode_png
from fusion.config import BlendConfig, load_config
from fusion.errors import FrameError, InputError, UsageError
from fusion.files import replace_file
from fusion.manifest import Manifest, load_manifest
from fusion.pairing import report_lines
from fusion.pipeline import Fuser
from fusion.provenance import describe_run
from fusion.report.sheet import contact_sheet
from fusion.report.text import closing_lines, plan_lines, warnings_of
from fusion.settings import nested
from fusion.sinks.folder import FolderSink
from fusion.sync import Pairs, open_pairs

PREVIEW = "preview.png"

# option of the command -> its place in the configuration
PLACES = {
    "preset": ("preset",),
    "strict": ("strict",),
    "pair": ("pairing", "by"),
    "rgb_key": ("pairing", "rgb_key"),
    "fir_key": ("pairing", "fir_key"),
    "pair_map": ("pairing", "map"),
    "tolerance_ms": ("pairing", "tolerance_ms"),
    "window": ("thermal", "window"),
    "window_unit": ("thermal", "window_unit"),
    "window_over": ("thermal", "window_over"),
    "celsius_per_count": ("thermal", "celsius_per_count"),
    "celsius_at_zero": ("thermal", "celsius_at_zero"),
    "clahe": ("thermal", "clahe"),
    "colormap": ("thermal", "colormap"),
    "fir_colour": ("thermal", "fir_colour"),
    "homography": ("warp", "homography"),
    "points": ("warp", "points"),
    "outside": ("warp", "outside"),
    "fill_bgr": ("warp", "fill_bgr"),
    "method": ("blend", "method"),
    "alpha": ("blend", "alpha"),
    "format": ("output", "format"),
    "quality": ("output", "quality"),
}


def settings_of(config: Path | None, options: Mapping[str, Any]) -> BlendConfig:
    """The configuration file with the options that were given laid over it."""
    return load_config(config, nested(PLACES, options))


def run_blend(
    settings: BlendConfig,
    inputs: Sequence[str],
    out: Path | None,
    *,
    dataset: str | None,
    workers: int | None,
    overwrite: bool,
    dry_run: bool,
    preview: bool,
    quiet: bool,
) -> None:
    if out is None and (preview or not dry_run):
        raise UsageError("no output folder", where="--out", hint="give -o OUT, or only --dry-run")
    threads = threads_of(workers)
    if out is not None:
        refuse_overlap(inputs, out, ("fused", "mask"))
    manifest = manifest_of(dataset, settings, inputs)
    with quiet_libraries(), closing(open_inputs(settings, inputs, manifest)) as pairs:
        report_pairing(pairs, settings.strict, show=dry_run)
        if out is None or (dry_run and not preview):
            return
        fuser = Fuser(pairs, settings)
        warn([*unlike_the_manifest(manifest, pairs), *fuser.registration.notes])
        if dry_run:
            replace_file(out / PREVIEW, _preview_png(fuser))
            print(f"preview: {out / PREVIEW}")
            return
        if not quiet:
            print("\n".join(plan_lines(fuser)), flush=True)
        with _sink(fuser, out, overwrite) as sink:
            if preview:
                sink.write_file(PREVIEW, _preview_png(fuser))
            with progress_bar("fusing", quiet) as progress:
                report = run(fuser, sink, workers=threads, progress=progress)
            if pairs.pairing.unmatched:
                sink.write_file("unmatched.csv", unmatched_csv(pairs))
        if not quiet:
            print("\n".join(closing_lines(fuser, report, out)))
        warn(warnings_of(fuser, report))


def manifest_of(dataset: str | None, settings: BlendConfig, inputs: Sequence[str]) -> Manifest | None:
    """The manifest that `--dataset` names; an unregistered set is refused without a registration."""
    if dataset is None:
        return None
    if len(inputs) != 1:
        hint = "fusion blend --dataset NAME ROOT -o OUT"
        raise UsageError("a data set has one root", where="--dataset", hint=hint)
    manifest = load_manifest(dataset)
    if not manifest.registered and not (settings.warp.homography or settings.warp.points):
        raise InputError(
            "its thermal images are not registered to its RGB images: as they are, they do not fit",
            where=f"data set {manifest.name}",
            hint="give --homography FILE or --points CSV",
        )
    return manifest


def open_inputs(settings: BlendConfig, inputs: Sequence[str], manifest: Manifest | None) -> Pairs:
    """The pairs of two inputs, of one 4-channel input, or of a data set's root."""
    rule, fir_colour = settings.pairing.rule(), settings.thermal.fir_colour
    if manifest is None:
        return open_pairs(inputs[0], inputs[1] if len(inputs) == 2 else None, rule, fir_colour=fir_colour)
    rgb, fir = manifest.globs(inputs[0])
    if not settings.pairing.model_fields_set:
        rule = manifest.pairing_rule(inputs[0])
    return open_pairs(rgb, fir, rule, fir_colour=fir_colour)


def unlike_the_manifest(manifest: Manifest | None, pairs: Pairs) -> list[str]:
    """In what the first pair and their number differ from what the data set is known to be."""
    with suppress(FrameError):  # a first pair that cannot be read is reported as any other
        if manifest is not None:
            frames = pairs.read(0)
            return manifest.differences(pairs=len(pairs), rgb=frames.rgb, fir=frames.fir)
    return []


def report_pairing(pairs: Pairs, strict: bool, *, show: bool) -> None:
    pairing = pairs.pairing
    if show:
        print("\n".join(report_lines(pairing)))
    if strict and pairing.unmatched:
        first = pairing.unmatched[0]
        raise InputError(
            f"{len(pairing.unmatched)} images have no partner; the first: {first.where}: {first.reason}",
            hint="--dry-run lists them; without --strict they are left out",
        )


def unmatched_csv(pairs: Pairs) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("role", "name", "reason"))
    writer.writerows((lost.role, lost.where, lost.reason) for lost in pairs.pairing.unmatched)
    return text.getvalue().encode("utf-8", "surrogateescape")


def _sink(fuser: Fuser, out: Path, overwrite: bool) -> FolderSink:
    output = fuser.config.output
    return FolderSink(
        out, describe_run(fuser), image_format=output.format, quality=output.quality, overwrite=overwrite
    )


def _preview_png(fuser: Fuser) -> bytes:
    with opencv_on_one_thread():  # the same bytes on any machine
        return encode_png(contact_sheet(fuser))
