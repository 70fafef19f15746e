"""What `fusion blend` does once its options are known (the heavy imports live here)."""

from __future__ import annotations

import csv
import io
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fusion.batch import opencv_on_one_thread, run
from fusion.cli.partners import Partners
from fusion.cli.running import progress_bar, quiet_libraries, refuse_overlap, threads_of, warn
from fusion.codecs import encode_png
from fusion.config import BlendConfig, load_config
from fusion.errors import FrameError, InputError, UsageError
from fusion.files import replace_file
from fusion.manifest import Manifest, load_manifest
from fusion.pairing import report_lines
from fusion.pipeline import Fuser, PairsWithDepth
from fusion.provenance import describe_run
from fusion.registration import homography_toml
from fusion.report.sheet import contact_sheet
from fusion.report.text import closing_lines, plan_lines, warnings_of
from fusion.rig import Rig
from fusion.rig_warp import Value
from fusion.settings import nested
from fusion.sinks.depth import PER_METRE
from fusion.sinks.folder import FolderSink
from fusion.sources import Source, open_source
from fusion.sync import PairedSources, Pairs, open_pairs

if TYPE_CHECKING:
    from fusion.cli.aligning import Aligned

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
    "align": ("warp", "align"),
    "rig": ("warp", "rig"),
    "warp": ("warp", "mode"),
    "distance": ("warp", "distance_m"),
    "depth": ("warp", "depth"),
    "undistort": ("warp", "undistort"),
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
        refuse_overlap(
            [*inputs, *([settings.warp.depth] if settings.warp.depth else [])], out, ("fused", "mask")
        )
    manifest, rig = manifest_of(dataset, settings, inputs), rig_of(settings)
    with quiet_libraries(), ExitStack() as open_things:
        pairs = open_inputs(settings, inputs, manifest, rig)
        open_things.callback(pairs.close)
        report_pairing(pairs, settings.strict, show=dry_run)
        depth = depth_of(settings, pairs, rig, open_things)
        if out is None or (dry_run and not preview):
            return
        settings = window_in_counts(settings, pairs)
        alignment = align_pairs(pairs, quiet=quiet) if settings.warp.align else None
        registration = None if alignment is None else alignment.registration
        fuser = Fuser(pairs if depth is None else PairsWithDepth(pairs, depth), settings, rig, registration)
        warn([*unlike_the_manifest(manifest, pairs), *fuser.notes, *(depth.notes if depth else [])])
        if dry_run:
            replace_file(out / PREVIEW, _preview_png(fuser))
            print(f"preview: {out / PREVIEW}")
            return
        if not quiet:
            print("\n".join(plan_lines(fuser)), flush=True)
        with _sink(fuser, out, overwrite) as sink:
            if preview:
                sink.write_file(PREVIEW, _preview_png(fuser))
            if alignment is not None:
                sink.write_file("alignment.toml", homography_toml(alignment.registration).encode())
                sink.write_file("alignment.jpg", alignment.picture_jpg)
            with progress_bar("fusing", quiet) as progress:
                report = run(fuser, sink, workers=threads, progress=progress)
            if pairs.pairing.unmatched:
                sink.write_file("unmatched.csv", unmatched_csv(pairs))
        if not quiet:
            print("\n".join(closing_lines(fuser, report, out)))
        warn(warnings_of(fuser, report))


def window_in_counts(settings: BlendConfig, pairs: Pairs) -> BlendConfig:
    """A window in degrees without a scale becomes one in counts by the constants in radiometric files.

    Raises `UsageError` where there are none, `InputError` where they differ from file to file.
    """
    thermal = settings.thermal
    if not thermal.by_camera:
        return settings
    from fusion.sources.radiometric import common_planck, is_radiometric

    files = getattr(pairs, "fir_files", [])
    if not files or not is_radiometric(files[0]):
        thermal.rule()  # says what is missing
    planck = common_planck(files)
    window = (float(planck.counts_at(thermal.window[0])), float(planck.counts_at(thermal.window[1])))
    counts = thermal.model_copy(update={"window": window, "window_unit": "counts"})
    counts.rule()
    return settings.model_copy(update={"thermal": counts})


def align_pairs(pairs: Pairs, *, quiet: bool) -> Aligned:
    """Where thermal lies on RGB, from the scene alone. Raises `InputError` where it cannot be told."""
    from fusion.cli.aligning import aligned

    return aligned(pairs, quiet=quiet)


def manifest_of(dataset: str | None, settings: BlendConfig, inputs: Sequence[str]) -> Manifest | None:
    """The manifest that `--dataset` names; an unregistered set is refused without a registration."""
    if dataset is None:
        return None
    if len(inputs) != 1:
        hint = "fusion blend --dataset NAME ROOT -o OUT"
        raise UsageError("a data set has one root", where="--dataset", hint=hint)
    manifest = load_manifest(dataset)
    warp = settings.warp
    manifest.refuse_unfit(registration=bool(warp.homography or warp.points or warp.align or warp.rig))
    return manifest


def open_inputs(
    settings: BlendConfig, inputs: Sequence[str], manifest: Manifest | None, rig: Rig | None = None
) -> Pairs:
    """The pairs of two inputs, of one 4-channel input, or of a data set's root; by the clocks of the rig."""
    offset_s = {} if rig is None else rig.time_offset_s
    offset_ns = round(1e9 * (offset_s.get("fir", 0.0) - offset_s.get("rgb", 0.0)))
    rule, fir_colour = replace(settings.pairing.rule(), fir_offset_ns=offset_ns), settings.thermal.fir_colour
    if manifest is None:
        return open_pairs(inputs[0], inputs[1] if len(inputs) == 2 else None, rule, fir_colour=fir_colour)
    layout = manifest.plan(inputs[0])
    if "rgbt" in layout.roles:
        return open_pairs(layout["rgbt"].glob)
    if "fir" not in layout.roles:
        raise manifest.no_images()
    own = None if settings.pairing.model_fields_set else layout["fir"].rule
    rule = rule if own is None else replace(own, fir_offset_ns=offset_ns)
    return PairedSources(layout.open("rgb"), layout.open("fir", fir_colour), rule)


def rig_of(settings: BlendConfig) -> Rig | None:
    """The rig that the settings name, which must have both cameras and say how they stand."""
    path = settings.warp.rig
    if path is None:
        return None
    from calib.formats import read_rig

    rig = read_rig(path)
    try:
        for name in ("rgb", "fir"):
            rig.camera(name)
        rig.pose("rgb", "fir")
    except UsageError as error:
        raise UsageError(error.what, where=path, hint=error.hint) from None
    return rig


def depth_of(
    settings: BlendConfig, pairs: Pairs, rig: Rig | None, open_things: ExitStack
) -> DepthFolder | None:
    """The depth maps that the settings name, paired with RGB."""
    if settings.warp.depth is None or rig is None:
        return None
    folder, value = depth_maps_in(settings.warp.depth, rig)
    source = open_source(folder, "fir", fir_colour="luma")  # 16-bit grey, as thermal is
    open_things.callback(source.close)
    return DepthFolder(source, [pairs.stems(index)[0] for index in range(len(pairs))], value)


def depth_maps_in(spec: str, rig: Rig) -> tuple[str, Value | None]:
    """Where the maps lie, and what they hold, if that is the output of `fusion depth` and says so.

    Raises `InputError` where it says that they are of another camera than the rig's.
    """
    folder = Path(spec)
    if (folder / "run.toml").is_file() and (folder / "depth").is_dir():
        folder = folder / "depth"
    try:
        run = tomllib.loads((folder.parent / "run.toml").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return str(folder), None
    if folder.name != "depth" or run.get("value") not in ("depth", "range"):
        return str(folder), None
    made_for, camera = run.get("camera"), rig.camera("rgb")
    ours: dict[str, Any] = {"kind": type(camera).__name__, **asdict(camera)}
    if not isinstance(made_for, dict) or not all(_alike(made_for.get(key), ours[key]) for key in ours):
        hint = "make them again: fusion depth CLOUDS -o OUT --rig with this rig"
        raise InputError(
            "the maps are of another camera than the rig's rgb", where=f"--depth {spec}", hint=hint
        )
    return str(folder), run["value"]


def _alike(theirs: object, ours: object) -> bool:
    if isinstance(ours, str):
        return theirs == ours
    try:
        one, other = np.asarray(theirs, np.float64), np.asarray(ours, np.float64)
    except (TypeError, ValueError):
        return False
    return one.shape == other.shape and bool(np.allclose(one, other, rtol=1e-9, atol=1e-12))


class DepthFolder:
    """The maps of a source for pairs whose RGB images are called `stems`: `fusion.pipeline.DepthMaps`."""

    def __init__(self, source: Source, stems: Sequence[str], value: Value | None) -> None:
        self.value: Value | None = value
        self._partners = Partners("--depth", source, stems)
        self.notes = self._partners.notes

    def name(self, index: int) -> str:
        return Path(self._partners.file(index)).stem

    def read_m(self, index: int) -> NDArray[np.float32]:
        image, where = self._partners.read(index), self._partners.file(index)
        if "fir-colour-to-luma" in image.flags or image.pixels.dtype != np.uint16:
            hint = "16-bit grey, metres x 256, 0 = none, as `fusion depth` writes them"
            raise FrameError("the picture is no depth map", where=where, hint=hint)
        return image.pixels.astype(np.float32) / np.float32(PER_METRE)

    def changed_ns(self, index: int) -> int:
        path = self._partners.file(index)
        return Path(path).stat().st_mtime_ns if path and Path(path).exists() else 0


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
