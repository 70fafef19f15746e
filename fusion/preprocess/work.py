"""What is decided once for a whole campaign, and how one of its chunks is done."""

from __future__ import annotations

import hashlib
import pkgutil
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass
from typing import Any

import tomlkit

from fusion.chunks import Chunk, Done
from fusion.errors import FrameError, InputError
from fusion.fusing import FrameFuser, Sizes
from fusion.lidar.lane import DepthLane
from fusion.lidar.sparse import Value
from fusion.preprocess.config import PreprocessConfig
from fusion.preprocess.footage import Dropped, Footage, Moment
from fusion.preprocess.frame import FrameMaker
from fusion.preprocess.rows import FrameRow
from fusion.provenance import describe_registration, plain, versions
from fusion.registration import Registration
from fusion.rig import Rig
from fusion.sinks.base import OUTPUTS, ChunkOutput, Output, Setup
from fusion.sinks.run_folder import RUN_FORMAT
from fusion.storage import Storage
from fusion.thermal import WindowPlan, plan_windows

FAULT = "recording: "  # what is lost to damage, among what is lost for other reasons


@dataclass(frozen=True, slots=True)
class Plan:
    """What all frames share: image sizes (thermal, RGB), windows, and the registration unless by a rig."""

    sizes: Sizes
    windows: WindowPlan
    registration: Registration | None = None


def make_plan(footage: Footage, config: PreprocessConfig, registration: Registration | None = None) -> Plan:
    """Look at the footage, here and there. Raises `InputError` where no frame can be read."""
    sizes = _first_sizes(footage, config)
    windows = plan_windows(
        config.fuse.thermal.rule(), footage.positions, lambda position: footage.fir_at(position).pixels
    )
    return Plan(sizes, windows, registration)


def _first_sizes(footage: Footage, config: PreprocessConfig) -> Sizes:
    first_error, lost = None, Counter[str]()
    for chunk in footage.chunks(config.chunk_s):
        for moment in footage.moments(chunk):
            if isinstance(moment, Dropped):
                lost[f"{moment.role}: {moment.reason}"] += 1
                continue
            try:
                frames = moment.images()
            except FrameError as error:
                if config.fuse.strict:
                    raise
                first_error = first_error or error
            else:
                return frames.fir.size_wh, frames.rgb.size_wh
    if first_error is not None:
        raise InputError(f"no frame can be used; the first: {first_error}", where=footage.name)
    reasons = "; ".join(f"{count} x {reason}" for reason, count in lost.most_common(3))
    hint = "fusion inspect shows the streams' times; --tolerance-ms, --stamp, --fir-offset-ms"
    raise InputError(f"nothing belongs together ({reasons or 'no messages'})", where=footage.name, hint=hint)


class PreprocessWork:
    """A campaign over one footage: `fusion.chunks.Work`."""

    def __init__(self, footage: Footage, config: PreprocessConfig, plan: Plan, rig: Rig | None) -> None:
        self.footage, self.config, self.plan, self.rig = footage, config, plan, rig
        self.chunks: Sequence[Chunk] = footage.chunks(config.chunk_s)
        self._open()
        self.description = self._describe()
        self.run_id = hashlib.sha256(tomlkit.dumps(self.description).encode()).hexdigest()

    def _open(self) -> None:
        self._lock = threading.Lock()
        self._fuser: FrameFuser | None = None
        self._ready: tuple[FrameMaker, list[Output]] | None = None

    def __getstate__(self) -> dict[str, Any]:
        opened = ("_lock", "_fuser", "_ready")
        return {name: value for name, value in self.__dict__.items() if name not in opened}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._open()

    @property
    def frames(self) -> int:
        """About how many there are."""
        return sum(chunk.frames for chunk in self.chunks)

    def fuser(self) -> FrameFuser:
        """What fuses its frames; built once a process."""
        with self._lock:
            if self._fuser is None:
                plan, value = self.plan, self._depth_value()
                self._fuser = FrameFuser(self.config.fuse, plan.sizes, self.rig, plan.registration, value)
            return self._fuser

    def _depth_value(self) -> Value | None:
        lane = self.lane() if self.onto_rgb else None
        return None if lane is None else lane.value

    @property
    def onto_rgb(self) -> bool:
        """Whether depth is made for the RGB camera of the rig; else for a virtual camera."""
        return self.rig is not None

    def lane(self) -> DepthLane | None:
        if not self.footage.has_lidar:
            return None
        depth = self.config.depth
        if self.rig is not None:
            camera = depth.camera.model_copy(update={"rig": "rig", "sensor": "rgb"})
            depth = depth.model_copy(update={"camera": camera})
        return DepthLane(depth, self.rig)

    def parts(self) -> tuple[FrameMaker, list[Output]]:
        """What makes and what keeps frames; built once a process."""
        fuser = self.fuser()
        with self._lock:
            if self._ready is None:
                lane = self.lane()
                maker = FrameMaker(self.config, fuser, self.plan.windows, lane, self.onto_rgb)
                output = self.config.fuse.output
                camera = None if lane is None else lane.camera
                setup = Setup(self.rig, camera, self.footage.rate_hz, output.format, output.quality)
                outputs = [pkgutil.resolve_name(OUTPUTS[kind])(setup) for kind in self.config.outputs.kinds]
                self._ready = maker, outputs
            return self._ready

    def do(self, chunk: Chunk, out: Storage, tick: Callable[[], None]) -> Done:
        """Make all frames of a chunk; see `fusion.chunks.Work`."""
        began = time.monotonic()
        maker, outputs = self.parts()
        writing = [output.open(chunk, out) for output in outputs]
        rows: list[FrameRow] = []
        lost: Counter[str] = Counter()
        known = {*self.footage.notes()}
        try:
            for moment in self.footage.moments(chunk):
                if isinstance(moment, Dropped):
                    lost[f"{moment.role}: {moment.reason}"] += 1
                    continue
                rows.append(self._row(moment, maker, writing))
                tick()
            files = {name: size for each in writing for name, size in each.close().items()}
        except BaseException:
            for each in writing:
                each.discard()
            raise
        # Damage that was met on the way; chunks under way beside this one may tell it too.
        lost.update(f"{FAULT}{fault}" for fault in self.footage.notes() if fault not in known)
        kept = [astuple(row) for row in rows]
        return Done(chunk, kept, files, dict(lost), time.monotonic() - began)

    def _row(self, moment: Moment, maker: FrameMaker, writing: Sequence[ChunkOutput]) -> FrameRow:
        try:
            troubled = maker.make(moment)
        except FrameError as error:
            if self.config.fuse.strict:
                raise
            return FrameRow.skipped(moment.stem, error)
        for each in writing:
            each.add(troubled.made)
        return FrameRow.made(troubled.made, troubled.trouble)

    def _describe(self) -> Mapping[str, Any]:
        """What makes this run what it is, TOML-able."""
        config = self.config.model_dump(exclude_none=True)
        del config["fuse"]["strict"], config["fuse"]["pairing"]
        for key in ("rig", "homography", "points"):  # known by their numbers
            config["fuse"]["warp"].pop(key, None)
        fuser = self.fuser()
        return {
            "format": RUN_FORMAT,
            "versions": versions(),
            "footage": plain(dict(self.footage.describe())),
            "config": plain(config),
            "registration": describe_registration(fuser),
            "window": self.plan.windows.record(),
        }


def settled(config: PreprocessConfig, has_lidar: bool) -> PreprocessConfig:
    """The configuration with its warp decided: by the LiDAR's own depth; without LiDAR at a distance."""
    warp = config.fuse.warp
    if warp.mode != "depth" or has_lidar:
        return config
    mode = "infinity" if warp.distance_m is None else "distance"
    warp = warp.model_copy(update={"mode": mode, "depth": None})
    return config.model_copy(update={"fuse": config.fuse.model_copy(update={"warp": warp})})
