"""What `fusion calibrate intrinsics | stereo` do once their options are known: the heavy imports are here."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from calib.boards import load_board
from calib.detect.cache import DetectionCache
from calib.detect.folder import Found, ImageRef, find_in_images
from calib.evidence.linear import with_held
from calib.evidence.verdict import Evidence, gather
from calib.intrinsics import calibrate_camera
from calib.moments import Pairing, Shot, pair
from calib.observations import Detection, View
from calib.report.page import page
from calib.report.pictures import (
    board_overlay,
    coverage_picture,
    residual_picture,
    uncertainty_picture,
)
from calib.report.record import known_covariance, rig_of, views_behind
from calib.report.text import closing_lines
from calib.rigging import calibrate_rig
from calib.solve.estimate import Solution
from calib.still import pair_still
from fusion.batch import opencv_on_one_thread
from fusion.cli.running import progress_bar, quiet_libraries, refuse_existing, threads_of, warn
from fusion.codecs import encode_jpeg
from fusion.errors import FrameError, InputError, UsageError
from fusion.files import replace_file
from fusion.pairing import stamps_of
from fusion.rig import Rig, load_rig, save_rig
from fusion.sources import open_source
from fusion.sources.base import Role, Source

OVERLAYS = 4
CACHE = ".detections"  # beside the rig, so that the commands of one calibration share what was found
_NAMED = 5  # images without a board that are named on the terminal; the report names all


@dataclass(frozen=True, slots=True)
class Asked:
    """What all these commands are asked: see the options of the same names."""

    board: Path | None
    out: Path
    rig: Path | None
    overwrite: bool
    report: bool
    debug: bool
    workers: int | None
    quiet: bool

    @property
    def folder(self) -> Path:
        """Where evidence goes: beside the rig."""
        return self.out.with_name(f"{self.out.stem}_evidence")

    def known(self) -> Rig:
        return Rig() if self.rig is None else load_rig(self.rig)


@dataclass(frozen=True, slots=True)
class Together:
    """What belongs together: by what, within which time, and what clocks are like."""

    by: str
    tolerance_ms: float | None
    timing: Literal["synchronised", "offset", "static"]

    def options(self) -> dict[str, Any]:
        by = "name" if self.by == "stem" else self.by
        if self.tolerance_ms is not None and not 0 < self.tolerance_ms < math.inf:
            raise UsageError(f"{self.tolerance_ms:g} ms", where="--tolerance-ms", hint="above 0")
        return {"by": by, **({} if self.tolerance_ms is None else {"tolerance_s": self.tolerance_ms / 1000})}


class Desk:
    """The sources that are open, the board, and what was found of it: closes all when left."""

    def __init__(self, asked: Asked) -> None:
        if asked.board is None:
            raise UsageError("no board is given", where="--board", hint="fusion calibrate board makes one")
        refuse_existing(asked.out, asked.overwrite)
        self.asked, self.board = asked, load_board(asked.board)
        asked.known()  # a rig that cannot be read is said before the search, not after it
        self.sources: dict[str, Source] = {}
        self.shots: dict[str, list[Shot]] = {}
        self._open = ExitStack()

    def __enter__(self) -> Desk:
        self._open.enter_context(quiet_libraries())
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def look(self, camera: str, spec: str) -> list[Shot]:
        """Search all images of a camera. Raises `InputError` where none shows the board."""
        role: Role = "fir" if camera == "fir" else "rgb"
        source = open_source(spec, role, fir_colour="luma")
        self._open.callback(source.close)
        self.sources[camera] = source
        with (
            DetectionCache(self.asked.out.parent / CACHE / f"{camera}.jsonl", self.board) as cache,
            opencv_on_one_thread(),
            progress_bar(f"{camera}: looking for the board", self.asked.quiet) as progress,
        ):
            found = find_in_images(
                _refs(source),
                self.board,
                cache=cache,
                workers=threads_of(self.asked.workers),
                progress=progress,
                debug=self._debug(camera) if self.asked.debug else None,
            )
        self._say(camera, found, cache)
        self.shots[camera] = [
            Shot(f.name, f.image.file, f.stamp_ns, f.size_wh, f.result)
            for f in found
            if f.size_wh is not None
        ]
        self._refuse_nothing(camera, spec, found)
        return self.shots[camera]

    def picture(self, camera: str, name: str) -> NDArray[Any] | None:
        """The pixels of the image of that name, None where it cannot be read again."""
        source = self.sources[camera]
        for index, entry in enumerate(source.entries):
            if name in (entry.stem, entry.file or entry.where):
                return source.read(index).pixels
        return None

    def files(self) -> list[str]:
        """All image files, in order."""
        return list(
            dict.fromkeys(
                entry.file or entry.where for source in self.sources.values() for entry in source.entries
            )
        )

    def _debug(self, camera: str) -> Callable[[ImageRef, NDArray[np.uint8]], None]:
        def keep(image: ImageRef, picture: NDArray[np.uint8]) -> None:
            name = image.name.replace("/", "_")
            replace_file(self.asked.folder / "debug" / camera / f"{name}.jpg", encode_jpeg(picture, 85))

        return keep

    def _say(self, camera: str, found: Sequence[Found], cache: DetectionCache) -> None:
        if self.asked.quiet:
            return
        seen = sum(isinstance(f.result, Detection) for f in found)
        kept = f", {cache.hits} as found before" if cache.hits else ""
        print(f"{camera}: the board in {seen} of {len(found)} images{kept}", flush=True)
        without = [f for f in found if not isinstance(f.result, Detection)]
        for f in without[:_NAMED]:
            print(f"  no board in {f.name}: {f.result.reason}")  # type: ignore[union-attr]
        if len(without) > _NAMED:
            named = ", the report names all" if seen and self.asked.report else ""
            print(f"  and {len(without) - _NAMED} more: {self._drawn(camera)}{named}")

    def _drawn(self, camera: str) -> str:
        folder = self.asked.folder / "debug" / camera
        return f"{folder} shows what was tried" if self.asked.debug else "--debug draws what was tried"

    def _refuse_nothing(self, camera: str, spec: str, found: Sequence[Found]) -> None:
        reasons = [f.result.reason for f in found if not isinstance(f.result, Detection)]
        common = max(reasons, key=reasons.count, default="")
        if len(reasons) < len(found):
            if 2 * len(reasons) > len(found):
                warn([f"{camera}: no board in {len(reasons)} of {len(found)} images; most often: {common}"])
            return
        hint = f"most often: {common}; is the board {self.board}? {self._drawn(camera)}"
        raise InputError(f"no board in any of {len(found)} images of {camera}", where=spec, hint=hint)


def _refs(source: Source) -> list[ImageRef]:
    stamps = stamps_of(source.entries, None)
    return [
        ImageRef(
            entry.stem,
            lambda index=index: source.read(index).pixels,
            file=entry.file or entry.where,
            part=entry.where if entry.file else "",
            stamp_ns=stamp,
        )
        for index, (entry, stamp) in enumerate(zip(source.entries, stamps, strict=True))
    ]


def run_intrinsics(asked: Asked, images: str, camera: str, model: str) -> None:
    with Desk(asked) as desk:
        desk.look(camera, images)
        views = [v for v in pair(desk.shots, by="order").views if v.camera == camera]
        with progress_bar("solving", asked.quiet) as progress:
            solution = calibrate_camera(desk.board, views, model, progress=progress)
        finish(desk, solution)


def run_stereo(
    asked: Asked,
    images: Mapping[str, str],
    models: Mapping[str, str],
    together: Together,
    refine: bool | None,
) -> None:
    together.options()  # what cannot be is said before the search
    with Desk(asked) as desk:
        refuse_swapped(images)
        for camera, spec in images.items():
            desk.look(camera, spec)
        pairing = _paired(desk, together)
        if not asked.quiet:
            print(pairing.table())
        warn(pairing.notes)
        known = {name: lens for name, lens in asked.known().cameras.items() if name in images}
        held = hold(asked.known(), pairing.views, list(images), refine)
        say_held(asked, known, held)
        with progress_bar("solving", asked.quiet) as progress:
            solution = calibrate_rig(
                desk.board,
                pairing.views,
                models=models,
                known=known,
                refine_known=not held,
                timing=together.timing,
                moment_ns=pairing.moment_ns,
                progress=progress,
            )
        finish(desk, solution, fixed=tuple(known) if held else ())


def refuse_swapped(images: Mapping[str, str]) -> None:
    """Raises `InputError` where the RGB images are 16-bit grey and the thermal ones 8-bit colour."""
    first = {}
    for camera, spec in images.items():
        roles: tuple[Role, ...] = ("rgb", "fir")
        for role in roles:
            with closing(open_source(spec, role, fir_colour="luma")) as source:
                try:
                    first[camera, role] = source.read(0).pixels
                except FrameError:  # told when its turn comes
                    return
    deep = {camera: first[camera, "fir"].dtype == np.uint16 for camera in images}
    coloured = {camera: bool(np.ptp(first[camera, "rgb"], axis=2).any()) for camera in images}
    if deep["rgb"] and not coloured["rgb"] and coloured["fir"] and not deep["fir"]:
        what = "RGB images are 16-bit grey, thermal ones 8-bit and coloured: are the folders swapped?"
        raise InputError(what, where=images["rgb"], hint="RGB comes first, then thermal")


def _paired(desk: Desk, together: Together) -> Pairing:
    """Views of both cameras by moment; where clocks are apart, of a board that stood still."""
    options = together.options()
    if together.timing != "static":
        return pair(desk.shots, **options)
    by = "order" if together.by == "order" else "stamp"
    margin = {"margin_s": options["tolerance_s"]} if "tolerance_s" in options else {}
    return pair_still(desk.board, desk.shots, by=by, **margin)


def hold(known: Rig, views: Sequence[View], cameras: Sequence[str], refine: bool | None) -> bool:
    """Whether the cameras that `known` has are held as they are.

    Unless the user says: where one of them was calibrated from more views than there are now, or nobody
    knows.
    """
    if refine is not None:
        return not refine
    now = {name: sum(view.camera == name for view in views) for name in cameras if name in known.cameras}
    return any(not 0 < views_behind(known, name) <= count for name, count in now.items())


def say_held(asked: Asked, known: Mapping[str, object], held: bool) -> None:
    if known and not asked.quiet:
        how = (
            "held as they are (--refine refines them)"
            if held
            else "refined with the rest (--hold holds them)"
        )
        print(f"{' and '.join(known)} of {asked.rig}: {how}")


def finish(
    desk: Desk,
    solution: Solution,
    *,
    fixed: tuple[str, ...] = (),
    closure: tuple[float, float] | None = None,
    inputs: Sequence[str] = (),
    pictures: Sequence[tuple[str, bytes]] = (),
) -> None:
    """Judge a solution, write the rig and its report, say what came out."""
    asked = desk.asked
    warn(solution.notes)
    with progress_bar("judging", asked.quiet) as progress:
        judged = with_held(solution, *known_covariance(asked.known()))
        evidence = gather(desk.board, judged, fixed=fixed, closure=closure, progress=progress)
    rig = rig_of(solution, evidence, desk.board, [*desk.files(), *inputs], known=asked.known())
    if asked.report:
        left_out = [
            (f"{camera} {shot.name}", shot.found.reason)
            for camera, shots in desk.shots.items()
            for shot in shots
            if not isinstance(shot.found, Detection)
        ]
        shown = [*_pictures(desk, solution, evidence), *pictures]
        replace_file(asked.folder / "report.html", page(asked.out.name, solution, evidence, shown, left_out))
    save_rig(asked.out, rig)
    if not asked.quiet:
        print("\n".join(closing_lines(solution, evidence)))
        report = f"; see {asked.folder / 'report.html'}" if asked.report else ""
        print(f"{asked.out} written{report}")


def _pictures(desk: Desk, solution: Solution, evidence: Evidence) -> list[tuple[str, bytes]]:
    found: list[tuple[str, bytes]] = []
    for camera, covered in evidence.coverage.items():
        found.append((f"{camera}: where and how the board was shown", coverage_picture(solution, covered)))
        found.append((f"{camera}: what the model does not explain", residual_picture(solution, camera)))
        words = f"{camera}: how far a point may appear off; crosses: no point was seen there"
        found.append((words, uncertainty_picture(evidence.projection[camera], solution, camera)))
    for (dst, src), maps in evidence.transfer.items():
        seen_in = src if src in solution.estimate.cameras else dst
        for distance in (min(maps), max(maps)):
            words = f"how far {src} may land off on {dst}, {distance:g} m away"
            found.append((words, uncertainty_picture(maps[distance], solution, seen_in)))
    return [*found, *_overlays(desk, solution)]


def _overlays(desk: Desk, solution: Solution) -> list[tuple[str, bytes]]:
    """Thermal edges on RGB at a few moments that both saw."""
    by_moment: dict[str, dict[str, View]] = {}
    for view in solution.views:
        by_moment.setdefault(view.moment, {})[view.camera] = view
    shared = [views for views in by_moment.values() if {"rgb", "fir"} <= set(views)]
    found = []
    for views in shared[:: max(1, len(shared) // OVERLAYS)][:OVERLAYS]:
        images = {name: desk.picture(name, views[name].file) for name in ("rgb", "fir")}
        if images["rgb"] is not None and images["fir"] is not None:
            drawn = board_overlay(
                solution, views["rgb"].moment, ("rgb", images["rgb"]), ("fir", images["fir"])
            )
            words = f"{views['rgb'].moment}: thermal edges on RGB, right in the board's plane"
            found.append((words, encode_jpeg(drawn, 88)))
    return found
