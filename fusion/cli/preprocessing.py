"""What `fusion preprocess` does once its options are known (the heavy imports live here)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from fusion.cli.blending import PLACES, rig_of
from fusion.cli.running import quiet_libraries, refuse_overlap, threads_of, warn
from fusion.errors import FrameError, FusionError, InputError, UsageError
from fusion.frames import FrameSet
from fusion.manifest import Layout, Manifest, load_manifest
from fusion.preprocess.campaign import Pace, Route
from fusion.preprocess.config import PreprocessConfig, StreamsConfig, load_preprocess_config
from fusion.preprocess.footage import Footage, Moment, SetFootage
from fusion.preprocess.local import Progress, no_progress
from fusion.preprocess.recorded import RecordedFootage
from fusion.preprocess.run import preprocess
from fusion.preprocess.streams import resolve_streams
from fusion.preprocess.work import PreprocessWork, make_plan, settled
from fusion.recordings import is_recording, open_recording
from fusion.report.campaign_text import campaign_end, campaign_plan, campaign_warnings
from fusion.rig import Rig
from fusion.settings import nested

# option of the command -> its place in the configuration
OWN_PLACES = {
    "rgb": ("streams", "rgb"),
    "fir": ("streams", "fir"),
    "lidar": ("streams", "lidar"),
    "lead": ("streams", "lead"),
    "stamp": ("streams", "stamp"),
    "tolerance_ms": ("streams", "tolerance_ms"),
    "lidar_tolerance_ms": ("streams", "lidar_tolerance_ms"),
    "fir_offset_ms": ("streams", "fir_offset_ms"),
    "fir_drift_ppm": ("streams", "fir_drift_ppm"),
    "estimate_clock": ("streams", "estimate_clock"),
    "keep_frozen": ("streams", "keep_frozen"),
    "begin": ("streams", "begin_s"),
    "end": ("streams", "end_s"),
    "densify": ("depth", "dense", "method"),
    "to": ("outputs", "kinds"),
    "chunk_s": ("chunk_s",),
}
NOT_HERE = {"pair", "rgb_key", "fir_key", "pair_map", "tolerance_ms", "depth"}


def settings_of(config: Path | None, given: Mapping[str, Any]) -> PreprocessConfig:
    """The configuration file with the options that were given laid over it."""
    fuse = {name: ("fuse", *place) for name, place in PLACES.items() if name not in NOT_HERE}
    return load_preprocess_config(config, nested({**fuse, **OWN_PLACES}, given))


def route_of(workers: int | None, cluster: str | None, scheduler: str | None, wait_s: float | None) -> Route:
    route = Route(threads_of(workers), cluster == "local", scheduler or "")
    return route if wait_s is None else replace(route, wait_s=wait_s)


def run_preprocess(
    config: PreprocessConfig,
    source: str,
    root: Path | None,
    out: str | None,
    *,
    route: Route,
    overwrite: bool,
    dry_run: bool,
    quiet: bool,
) -> None:
    if out is None and not dry_run:
        raise UsageError("no output", where="--out", hint="give -o OUT, or only --dry-run")
    if out is not None and "://" not in out:
        inputs = [str(root or source)] if "://" not in source else []
        refuse_overlap(inputs, Path(out), ("fused", "mask", "depth", "fir", "chunks"))
    parts = _parts(config, source, root)
    problems: list[Exception] = []
    with quiet_libraries():
        for name, opened in parts:
            target = None if out is None else f"{out}/{name}" if name else out
            if name and not quiet:
                print(f"{name}:", flush=True)
            try:
                with ExitStack() as open_things:
                    part = opened(open_things)
                    problem = _campaign(*part, target, route, overwrite, dry_run, quiet)
            except FusionError as error:
                if len(parts) == 1:
                    raise
                problem = error
            if problem is not None and len(parts) > 1:
                warn([f"{name}: {problem}"])
            problems += [] if problem is None else [problem]
    if problems and len(parts) > 1:
        what = f"{len(problems)} of {len(parts)} recordings have failed or are not whole"
        raise FusionError(what, hint="the same command tries them again, and only them")
    if problems:
        raise problems[0]


def _campaign(
    config: PreprocessConfig,
    footage: Footage,
    rig: Rig | None,
    guessed: list[str],
    out: str | None,
    route: Route,
    overwrite: bool,
    dry_run: bool,
    quiet: bool,
) -> Exception | None:
    config = settled(config, footage.has_lidar)
    registration = None
    if config.fuse.warp.align:
        from fusion.cli.aligning import FRAMES, aligned  # here: it is slow to import

        registration = aligned(_Here(footage, config.chunk_s, FRAMES), quiet=quiet).registration
    work = PreprocessWork(footage, config, make_plan(footage, config, registration), rig)
    if not quiet or dry_run:
        print("\n".join(campaign_plan(work, guessed)), flush=True)
    warn(footage.notes())
    if dry_run or out is None:
        return None
    with _progress(quiet) as progress:
        result = preprocess(
            work, out, route=route, overwrite=overwrite, progress=progress, say=lambda words: warn([words])
        )
    if not quiet:
        print("\n".join(campaign_end(result)))
    warn(campaign_warnings(result))
    problem = result.report.problem()
    if problem is None and not result.made:
        stem, reason = result.skipped[0]
        problem = InputError(f"no frame could be made; the first, {stem!r}: {reason}")
    return problem


class _Here:
    """A frame from each of a few places in the footage: what an alignment looks at."""

    def __init__(self, footage: Footage, chunk_s: float, count: int) -> None:
        chunks = footage.chunks(chunk_s)
        if len(chunks) < count:
            chunks = footage.chunks(max(0.1, chunk_s * len(chunks) / count))
        self._footage, self._chunks = footage, chunks

    def __len__(self) -> int:
        return len(self._chunks)

    def read(self, index: int) -> FrameSet:
        for moment in self._footage.moments(self._chunks[index]):
            if isinstance(moment, Moment):
                return moment.images()
        raise FrameError("no frame there", where=f"{self._footage.name}, chunk {self._chunks[index].name}")


Part = tuple[PreprocessConfig, Footage, "Rig | None", list[str]]
FOR_RECORDINGS = (
    *("rgb", "fir", "lidar", "lead", "stamp", "tolerance_ms", "lidar_tolerance_ms"),
    *("fir_drift_ppm", "begin_s", "end_s"),
)


def _parts(
    config: PreprocessConfig, source: str, root: Path | None
) -> list[tuple[str, Callable[[ExitStack], Part]]]:
    """The campaigns that the command stands for: what each is called below OUT ("" if it is the only one),
    and how to open what it reads.
    """
    if root is None and is_recording(source):
        return [("", partial(_recorded, config, source, rig_of(config.fuse)))]
    if root is None:
        known = Path(source).exists()
        hint = "a data set: fusion preprocess NAME ROOT -o OUT; fusion inspect says what a path is"
        raise InputError("is no recording" if known else "no such recording", where=source, hint=hint)
    manifest = load_manifest(source)
    layout = manifest.plan(root)
    asked, config = config.streams, _as_the_set_says(config, layout)
    warp = config.fuse.warp
    manifest.refuse_unfit(registration=bool(warp.rig or warp.homography or warp.points or warp.align))
    rig = rig_of(config.fuse)
    if layout.recording is None:
        _refuse_for_folders(asked)
        return [("", partial(_folders, config, manifest, root, rig))]
    files = layout.recording.files
    if len(files) == 1:
        return [("", partial(_recorded, config, str(files[0]), rig))]
    bare = Counter(path.relative_to(root).with_suffix("") for path in files)
    return [
        ((short if bare[short] == 1 else own).as_posix(), partial(_recorded, config, str(path), rig))
        for path in files
        for own in [path.relative_to(root)]
        for short in [own.with_suffix("")]
    ]


def _refuse_for_folders(asked: StreamsConfig) -> None:
    """What means nothing for folders is not passed over in silence."""
    vain = [name for name in FOR_RECORDINGS if name in asked.model_fields_set]
    if vain:
        hint = (
            "files are chosen and paired by the manifest: copy it and change it (fusion datasets show NAME)"
        )
        raise UsageError(f"streams.{vain[0]} is for recordings; this data set is folders", hint=hint)


def _folders(
    config: PreprocessConfig, manifest: Manifest, root: Path, rig: Rig | None, open_things: ExitStack
) -> Part:
    def footage_at(offset_ns: int) -> SetFootage:
        colour, keep = config.fuse.thermal.fir_colour, config.streams.keep_frozen
        footage = SetFootage(manifest, root, fir_colour=colour, keep_frozen=keep, fir_offset_ns=offset_ns)
        open_things.callback(footage.close)
        return footage

    footage = footage_at(_fir_offset_ns(config, rig))
    if not config.streams.estimate_clock:
        return config, footage, rig, []
    from fusion.preprocess.clocks import clock_of, in_words  # here: SciPy is slow to import

    found = clock_of(footage)
    return config, footage_at(found.offset_ns), rig, [in_words(found)]


def _recorded(config: PreprocessConfig, path: str, rig: Rig | None, open_things: ExitStack) -> Part:
    recording = open_recording(path)
    open_things.callback(recording.close)
    streams, guessed = resolve_streams(recording, config.streams, rig, config.fuse.thermal.fir_colour)
    footage = RecordedFootage(path, streams, recording)
    if config.streams.estimate_clock:
        from fusion.preprocess.clocks import clock_of, in_words  # here: SciPy is slow to import

        own = replace(streams, offset_ns={}, drift={})
        with closing(RecordedFootage(path, own)) as unshifted:
            found = clock_of(unshifted)
        guessed.append(in_words(found))
        shifted = replace(
            streams, offset_ns={"fir": found.offset_at(footage.begin_ns)}, drift={"fir": found.drift}
        )
        footage = RecordedFootage(path, shifted)
        open_things.callback(footage.close)
    return config, footage, rig, guessed


def _as_the_set_says(config: PreprocessConfig, layout: Layout) -> PreprocessConfig:
    """What was not asked for is as the manifest has it: topics, clock, tolerances, and the rig of the set."""
    streams, recording = config.streams, layout.recording
    if recording is not None:
        known: dict[str, Any] = {role: recording.topics.get(role) for role in ("rgb", "fir", "lidar")}
        known |= {"stamp": recording.stamp}
        known |= {
            name: recording.tolerance_ns[role] / 1e6
            for name, role in (("tolerance_ms", "fir"), ("lidar_tolerance_ms", "lidar"))
            if role in recording.tolerance_ns
        }
        given = streams.model_fields_set
        streams = streams.model_copy(
            update={k: v for k, v in known.items() if k not in given and v is not None}
        )
    warp = config.fuse.warp
    registered = warp.rig or warp.homography or warp.points or warp.align
    files = layout.calibration.readable() if layout.calibration is not None else ()
    settings = config.model_dump(exclude_unset=True, exclude_none=True)
    settings["streams"] = streams.model_dump(exclude_none=True)
    if not registered and len(files) == 1 and not layout.manifest.registered:
        settings.setdefault("fuse", {}).setdefault("warp", {})["rig"] = str(files[0])
    return PreprocessConfig.of(settings)


def _fir_offset_ns(config: PreprocessConfig, rig: Rig | None) -> int:
    if config.streams.fir_offset_ms is not None:
        return round(1e6 * config.streams.fir_offset_ms)
    offsets = {} if rig is None else rig.time_offset_s
    return round(1e9 * (offsets.get("fir", 0.0) - offsets.get("rgb", 0.0)))


@contextmanager
def _progress(quiet: bool) -> Iterator[Progress]:
    """A bar over all chunks with rate and time left on the terminal; nothing where there is none."""
    import sys

    if quiet or not sys.stderr.isatty():
        yield no_progress
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bar

    words = "{task.fields[chunks]} chunks, {task.fields[rate]:.0f} frames/s, {task.fields[left]}"
    with Bar(
        "preprocessing", BarColumn(), TextColumn(words), console=Console(stderr=True), transient=True
    ) as bar:
        task, pace = bar.add_task("", total=None, chunks="", rate=0.0, left=""), Pace()

        def advance(frames_done: int, frames: int, chunks_done: int, chunks: int) -> None:
            rate, left_s = pace(frames_done, frames)
            left = "" if left_s is None else f"{_clock(left_s)} left"
            bar.update(
                task,
                completed=frames_done,
                total=frames,
                chunks=f"{chunks_done}/{chunks}",
                rate=rate,
                left=left,
            )

        yield advance


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"
