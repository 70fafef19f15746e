"""What `fusion depth` does once its options are known (the heavy imports live here)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.batch import in_order, opencv_on_one_thread, rows_of
from fusion.cli.partners import Partners
from fusion.cli.running import progress_bar, quiet_libraries, refuse_overlap, threads_of, warn
from fusion.clouds import READERS, CloudFiles, clouds_in, read_cloud
from fusion.codecs import decode_image
from fusion.colormaps import colormap_bgr
from fusion.errors import FrameError, InputError, UsageError
from fusion.frames import Image
from fusion.lidar.config import DepthConfig, load_depth_config
from fusion.lidar.densify import DENSIFIERS
from fusion.lidar.lane import DepthFrame, DepthLane
from fusion.lidar.score import Score, score
from fusion.provenance import describe_depth
from fusion.report.depth_picture import depth_picture, overlay
from fusion.report.depth_text import DepthReport, closing_lines, plan_lines, score_lines, warnings_of
from fusion.rig import Rig
from fusion.settings import nested
from fusion.sinks.depth import KINDS, PER_METRE, DepthRow, DepthSink, quantised
from fusion.sources import Role, Source, open_source
from fusion.tables import lookup

# option of the command -> its place in the configuration
PLACES = {
    "preset": ("preset",),
    "strict": ("strict",),
    "form": ("cloud", "form"),
    "range": ("cloud", "range_m"),
    "box": ("cloud", "box_m"),
    "voxel": ("cloud", "voxel_m"),
    "outliers": ("cloud", "outliers"),
    "camera": ("camera", "model"),
    "fov": ("camera", "fov_deg"),
    "size": ("camera", "size_wh"),
    "position": ("camera", "position_m"),
    "look": ("camera", "look_deg"),
    "rig": ("camera", "rig"),
    "sensor": ("camera", "sensor"),
    "value": ("samples", "value"),
    "limits": ("samples", "limits_m"),
    "visibility": ("samples", "visibility"),
    "method": ("dense", "method"),
    "extrapolate": ("dense", "extrapolate"),
    "max_gap": ("dense", "max_gap_px"),
    "colormap": ("picture", "colormap"),
    "show": ("picture", "show_m"),
}


@dataclass(frozen=True, slots=True)
class Given:
    """The files that a run was given, as they were named."""

    clouds: Sequence[str]
    sparse: str | None = None
    guide: str | None = None
    overlay: str | None = None
    score: str | None = None

    def all(self) -> list[str]:
        return [*self.clouds, *(spec for spec in (self.sparse, self.guide, self.overlay, self.score) if spec)]


def settings_of(config: Path | None, options: Mapping[str, Any]) -> DepthConfig:
    """The configuration file with the options that were given laid over it."""
    return load_depth_config(config, nested(PLACES, options))


def run_depth(
    settings: DepthConfig,
    given: Given,
    out: Path | None,
    *,
    workers: int | None,
    overwrite: bool,
    quiet: bool,
) -> None:
    _check(settings, given, out)
    threads = threads_of(workers)
    if out is not None:
        refuse_overlap(given.all(), out, tuple(KINDS))
    with quiet_libraries(), ExitStack() as open_things:
        job = DepthJob(settings, given, threads, open_things)
        if not quiet:
            plan = plan_lines(job.lane, len(job), job.ignored, pictures=given.sparse is not None)
            print("\n".join(plan), flush=True)
        report = DepthReport()
        if out is None:
            _score_only(job, report, quiet)
        else:
            job.sink = open_things.enter_context(DepthSink(out, job.description(given), overwrite=overwrite))
            with progress_bar("densifying", quiet) as progress:
                for index, (row, kept) in enumerate(rows_of(job, job.sink, job.workers)):
                    report.add(row, kept)
                    if kept:
                        job.score_kept(index, out / "depth" / f"{row.stem}.png")
                    progress(report.total, len(job))
        if report.made + report.kept == 0:
            stem, reason = report.skipped[0]
            raise InputError(f"no depth map could be made; the first, {stem!r}: {reason}")
        if not quiet and out is not None:
            print("\n".join(closing_lines(report, out)))
        if job.scores:
            print("\n".join(score_lines(job.scores)))
        warn([*job.notes, *warnings_of(report, job.unscored)])
    if given.score is not None and not job.scores:  # out here: the maps, if kept, are whole
        raise InputError("no map could be scored", where=f"--score {given.score}")


def _check(settings: DepthConfig, given: Given, out: Path | None) -> None:
    """Refuse what cannot be meant, before anything is read or written."""
    if out is None and given.score is None:
        raise UsageError("no output folder", where="--out", hint="give -o OUT, or only --score TRUTH")
    if bool(given.clouds) == bool(given.sparse):
        hint = "fusion depth CLOUD… -o OUT, or fusion depth --sparse PNG|FOLDER -o OUT"
        raise UsageError("give either clouds or sparse pictures", hint=hint)
    if given.sparse is not None:
        _check_for_pictures(settings)
    method = settings.dense.method
    if method == "guided" and given.guide is None:
        raise UsageError("--method guided looks at a picture", hint="give --guide RGB, or another --method")
    if given.guide is not None and method in DENSIFIERS and method != "guided":
        hint = "give --method guided, or no --guide"
        raise UsageError(f"--method {method} looks at no guide", where="--guide", hint=hint)
    colormap_bgr(settings.picture.colormap)
    if settings.cloud.form is not None:
        lookup(READERS, "fusion.clouds", settings.cloud.form, "form of point cloud")


def _check_for_pictures(settings: DepthConfig) -> None:
    for name, group in (("cloud", settings.cloud), ("camera", settings.camera)):
        for key in sorted(group.model_fields_set):
            hint = "leave it out: a sparse picture has its points and its camera"
            raise UsageError(f"{name}.{key} means nothing here", where="--sparse", hint=hint)
    if settings.samples.visibility == "map":
        raise UsageError("a sparse picture is no map", where="--visibility", hint="scan or none")


class DepthJob:
    """Clouds, or sparse pictures, into a folder of depth maps; see `fusion.batch.Job`."""

    def __init__(self, settings: DepthConfig, given: Given, threads: int, open_things: ExitStack) -> None:
        self.strict = settings.strict
        self.lane = DepthLane(settings, _rig(settings, given))
        self.sink: DepthSink | None = None
        self._scores: dict[int, Score | str] = {}  # or why there is none
        self._clouds = _clouds(given.clouds)
        self._pictures = None if given.sparse is None else _opened(given.sparse, "fir", open_things)
        self._stems, self._files = self._names()
        self.workers = min(threads, len(self))  # one cloud: its rows are shared out among the threads
        self._inner_threads = max(1, threads // self.workers)
        partners = {"guide": given.guide, "overlay": given.overlay, "score": given.score}
        self._partners = {
            name: Partners(f"--{name}", _opened(spec, _role(name), open_things), self._stems)
            for name, spec in partners.items()
            if spec is not None
        }
        self.notes = [note for partner in self._partners.values() for note in partner.notes]
        if given.overlay is not None and settings.camera.rig is None and self._pictures is None:
            self.notes.append(
                "--overlay without --rig: the points are those of a virtual camera; expect no fit"
            )
        if given.score is not None and self.lane.value != "depth":
            raise UsageError("true depth is along the axis", where="--score", hint="give --value depth")

    def __len__(self) -> int:
        return len(self._stems)

    @property
    def scores(self) -> dict[str, Score]:
        return {self._stems[i]: s for i, s in sorted(self._scores.items()) if isinstance(s, Score)}

    @property
    def unscored(self) -> dict[str, str]:
        """Why maps that have a truth have no score."""
        return {self._stems[i]: s for i, s in sorted(self._scores.items()) if isinstance(s, str)}

    @property
    def ignored(self) -> int:
        """How many other files lie in the inputs."""
        pictures = 0 if self._pictures is None else self._pictures.ignored
        return pictures + sum(files.ignored for files in self._clouds)

    def description(self, given: Given) -> dict[str, Any]:
        """What makes this run what it is."""
        extra = {name: getattr(given, name) is not None for name in ("sparse", "guide", "overlay")}
        return describe_depth(self.lane, self._stems, extra)

    def stem(self, index: int) -> str:
        return self._stems[index]

    def changed_ns(self, index: int) -> int:
        files = [self._files[index], *(partner.file(index) for partner in self._partners.values())]
        return max(
            (Path(file).stat().st_mtime_ns for file in files if file and Path(file).exists()), default=0
        )

    def make(self, index: int) -> DepthRow:
        if self.sink is None:
            raise ValueError("expected an open sink")
        frame = self.frame(index)
        shown = self.lane.config.picture
        picture = depth_picture(frame.dense.value_m, shown.colormap, shown.show_m)
        image = self._partner("overlay", index)
        over = None if image is None else _overlay(image, frame, shown.colormap, shown.show_m)
        return self.sink.write(frame, picture, over)

    def skip(self, index: int, error: FrameError) -> DepthRow:
        return DepthRow.skipped(self._stems[index], error)

    def frame(self, index: int) -> DepthFrame:
        """Read and densify one cloud, and score it where its truth is known."""
        stem, guide = self._stems[index], self._partner("guide", index)
        options = {
            "guide_bgr": None if guide is None else guide.pixels,
            "threads": self._inner_threads,
        }
        if self._pictures is not None:
            metres = _metres(self._pictures.read(index), self._files[index])
            frame = self.lane.of_image(metres, stem, **options)
        else:
            cloud = read_cloud(self._files[index], self.lane.config.cloud.form, stem)
            frame = self.lane.of_cloud(cloud, **options)
        self._score(index, quantised(frame.dense.value_m))
        return frame

    def score_kept(self, index: int, path: Path) -> None:
        """Score a map that was there already."""
        self._score(index, decode_image(path.read_bytes(), str(path)))

    def _score(self, index: int, map_counts: NDArray[Any]) -> None:
        """As the benchmark does: the map as its file holds it against the truth's file.

        A truth that cannot be used costs the score, not the map, unless the run is strict.
        """
        try:
            truth = self._partner("score", index)
            if truth is not None:
                where = self._partners["score"].file(index)
                self._scores[index] = _scored(map_counts, _metres(truth, where), where)
        except FrameError as error:
            if self.strict:
                raise
            self._scores[index] = error.what

    def _names(self) -> tuple[list[str], list[str]]:
        if self._pictures is not None:
            entries = self._pictures.entries
            return [entry.stem for entry in entries], [entry.file or entry.where for entry in entries]
        stems = [stem for files in self._clouds for stem in files.stems]
        paths = [str(path) for files in self._clouds for path in files]
        first: dict[str, str] = {}
        for stem, path in zip(stems, paths, strict=True):
            if stem in first:
                hint = (
                    "maps bear the names of their clouds: give each once, or a folder above both as 'top/*/*'"
                )
                raise InputError(f"one name for two inputs: {first[stem]} and {path}", hint=hint)
            first[stem] = path
        return stems, paths

    def _partner(self, name: str, index: int) -> Image | None:
        """The image that goes with a frame; None where there is none, and the frame can do without."""
        partner = self._partners.get(name)
        if partner is None or (name != "guide" and not partner.has(index)):
            return None
        return partner.read(index)


def _score_only(job: DepthJob, report: DepthReport, quiet: bool) -> None:
    """Make every frame for its score's sake and keep none."""

    def work(index: int) -> DepthRow:
        try:
            return DepthRow.made(job.frame(index), {})
        except FrameError as error:
            if job.strict:
                raise
            return job.skip(index, error)

    with opencv_on_one_thread(), progress_bar("scoring", quiet) as progress:
        for row in in_order(work, len(job), job.workers):
            report.add(row, kept=False)
            progress(report.total, len(job))


def _role(name: str) -> Role:
    return "fir" if name == "score" else "rgb"  # depth is 16-bit grey, as thermal is


def _clouds(specs: Sequence[str]) -> list[CloudFiles]:
    return [clouds_in(spec) for spec in specs]


def _opened(spec: str, role: Role, open_things: ExitStack) -> Source:
    source = open_source(spec, role, fir_colour="luma")  # which flags what was coloured: no depth
    open_things.callback(source.close)
    return source


def _rig(settings: DepthConfig, given: Given) -> Rig | None:
    if settings.camera.rig is None:
        return None
    from calib.formats import read_rig

    return read_rig(settings.camera.rig, _size_of(given.overlay or given.guide))


def _size_of(spec: str | None) -> tuple[int, int] | None:
    """The size of the first image of a source: for calibrations that do not say it."""
    if spec is None:
        return None
    with ExitStack() as open_things:
        return _opened(spec, "rgb", open_things).read(0).size_wh


def _metres(image: Image, where: str) -> NDArray[np.float32]:
    """Depth PNG to metres. Raises `FrameError` for pictures that are none."""
    coloured = "fir-colour-to-luma" in image.flags
    if coloured or image.pixels.dtype != np.uint16:
        what = f"{'a coloured' if coloured else 'an 8-bit'} picture is no depth map"
        raise FrameError(what, where=where, hint="16-bit grey, metres x 256, 0 = none, as KITTI has them")
    return image.pixels.astype(np.float32) / np.float32(PER_METRE)


def _scored(map_counts: NDArray[np.uint16], truth_m: NDArray[np.float32], where: str) -> Score:
    if truth_m.shape != map_counts.shape:
        size, true = (f"{w}x{h}" for h, w in (map_counts.shape, truth_m.shape))
        raise FrameError(f"the truth is {true}, the map {size}", where=where)
    found = score(map_counts.astype(np.float32) / np.float32(PER_METRE), truth_m)
    if not found.count:
        raise FrameError("no pixel has both a truth and a value", where=where)
    return found


def _overlay(
    image: Image, frame: DepthFrame, colormap: str, show_m: tuple[float, float]
) -> NDArray[np.uint8]:
    bgr: NDArray[Any] = image.pixels
    if bgr.shape[1::-1] != frame.sparse.size_wh:
        size, ours = (f"{w}x{h}" for w, h in (frame.sparse.size_wh, bgr.shape[1::-1]))
        raise FrameError(f"the image for the overlay is {ours}, the camera {size}", where=frame.stem)
    return overlay(bgr, frame.sparse, colormap, show_m)
