"""What `fusion blend` does once its options are known (the heavy imports live here)."""

from __future__ import annotations

import csv
import io
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from glob import has_magic
from pathlib import Path
from typing import Any

from fusion.batch import no_progress, opencv_on_one_thread, run
from fusion.codecs import encode_png
from fusion.config import BlendConfig, load_config
from fusion.errors import FrameError, InputError, OutputError, UsageError
from fusion.files import replace_file
from fusion.manifest import Manifest, load_manifest
from fusion.pairing import report_lines
from fusion.pipeline import Fuser
from fusion.provenance import describe_run
from fusion.report.sheet import contact_sheet
from fusion.report.text import closing_lines, plan_lines, warnings_of
from fusion.settings import nested
from fusion.sinks.folder import FolderSink
from fusion.sources.folders import split_pattern
from fusion.sync import Pairs, open_pairs

PREVIEW = "preview.png"
MAX_WORKERS = 256

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
    if workers is not None and not 1 <= workers <= MAX_WORKERS:
        raise UsageError(f"{workers} is no number of threads", where="--workers", hint=f"1 to {MAX_WORKERS}")
    if out is not None:
        refuse_overlap(inputs, out)
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
            with progress_bar(quiet) as progress:
                report = run(fuser, sink, workers=workers or default_workers(), progress=progress)
            if pairs.pairing.unmatched:
                sink.write_file("unmatched.csv", unmatched_csv(pairs))
        if not quiet:
            print("\n".join(closing_lines(fuser, report, out)))
        warn(warnings_of(fuser, report))


def warn(warnings: Iterable[str]) -> None:
    for warning in warnings:
        print(f"fusion: warning: {warning}", file=sys.stderr)


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


def refuse_overlap(inputs: Sequence[str], out: Path) -> None:
    """An output inside an input folder would be read as input the next time; the reverse would overwrite."""
    target = out.resolve()
    for spec in inputs:
        folder = fixed_folder(spec)
        if folder is None:
            continue
        if target == folder or folder in target.parents:
            raise OutputError("lies inside the input folder", where=out, hint="choose another -o")
        for ours in (target / "fused", target / "mask"):
            if folder == ours or ours in folder.parents:
                raise OutputError(f"would overwrite the input {spec}", where=out, hint="choose another -o")


def fixed_folder(spec: str) -> Path | None:
    """The folder that a folder or glob specification reads from; None for single files."""
    path = Path(spec)
    if path.is_dir():
        return path.resolve()
    return None if path.exists() or not has_magic(spec) else split_pattern(spec)[0].resolve()


@contextmanager
def progress_bar(quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """A bar with rate and time left on the terminal; nothing where there is none."""
    if quiet or not sys.stderr.isatty():
        yield no_progress
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]:.0f} frames/s"),
        TimeRemainingColumn(),
    )
    with Progress("fusing", *columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("fusing", total=None, rate=0.0)
        began = time.monotonic()

        def advance(done: int, total: int) -> None:
            rate = done / max(time.monotonic() - began, 1e-6)
            bar.update(task, completed=done, total=total, rate=rate)

        yield advance


@contextmanager
def quiet_libraries() -> Iterator[None]:
    """Sends what C libraries write to standard error nowhere; Python's own words still arrive.

    libpng and libtiff announce every damaged file by themselves; the frame is named in our report already.
    """
    sys.stderr.flush()
    before, terminal = sys.stderr, os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        if before is sys.__stderr__:
            sys.stderr = os.fdopen(os.dup(terminal), "w", buffering=1, errors="backslashreplace")
        yield
    finally:
        if sys.stderr is not before:
            sys.stderr.close()
            sys.stderr = before
        os.dup2(terminal, 2)
        os.close(terminal)
        os.close(nowhere)


def default_workers() -> int:
    """One thread for every core that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
