"""From one moment's images and cloud to all that is kept of it."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.codecs import encode_jpeg, encode_png
from fusion.errors import FrameError
from fusion.frames import PointCloud
from fusion.fusing import FrameFuser, Stages
from fusion.lidar.lane import DepthFrame, DepthLane
from fusion.preprocess.config import PreprocessConfig
from fusion.preprocess.footage import Moment
from fusion.sinks.base import Made
from fusion.sinks.depth import quantised
from fusion.thermal import WindowPlan


@dataclass(frozen=True, slots=True)
class Troubled:
    """A frame that was made, and what went wrong with a part of it that can be done without."""

    made: Made
    trouble: str = ""


class FrameMaker:
    """Makes frames by one configuration; any frame on its own, by several threads.

    `lane` is None where there is no LiDAR; `onto_rgb` says that its camera is the RGB camera of the rig.
    """

    def __init__(
        self,
        config: PreprocessConfig,
        fuser: FrameFuser,
        windows: WindowPlan,
        lane: DepthLane | None,
        onto_rgb: bool,
    ) -> None:
        self._config, self._fuser, self._windows = config, fuser, windows
        self._lane, self._onto_rgb = lane, onto_rgb
        self._mask: tuple[NDArray[np.uint8], bytes] | None = None
        self._lock = threading.Lock()

    def make(self, moment: Moment) -> Troubled:
        """All of one frame. Raises `FrameError` where it cannot be fused."""
        frames = moment.images()
        window = self._windows.window(moment.position, frames.counts)
        cloud, depth, trouble = self._depth_of(moment)
        depth_m = depth.dense.value_m if depth is not None and self._onto_rgb else None
        stages = self._fuser.stages(frames, window, depth_m, with_counts=self._config.outputs.counts)
        fused = replace(stages.fused, stem=moment.stem)
        if trouble:
            fused = replace(fused, flags=(*fused.flags, "depth-failed"))
        kept = depth if self._config.outputs.depth else None
        frames = replace(frames, cloud=cloud)
        made = Made(moment.stem, frames, fused, stages.fir_counts, kept, self._encoded(stages, kept))
        return Troubled(made, trouble)

    def _depth_of(self, moment: Moment) -> tuple[PointCloud | None, DepthFrame | None, str]:
        """Cloud and depth, as far as they can be had, and why not: a frame can do without."""
        if self._lane is None or moment.cloud is None:
            return None, None, ""
        cloud = None
        try:
            cloud = moment.cloud()
            return cloud, self._lane.of_cloud(cloud), ""
        except FrameError as error:
            return cloud, None, error.what

    def _encoded(self, stages: Stages, depth: DepthFrame | None) -> Mapping[str, bytes]:
        output, fused = self._config.fuse.output, stages.fused
        lossless = output.format == "png"
        encoded = {"fused": encode_png(fused.bgr) if lossless else encode_jpeg(fused.bgr, output.quality)}
        if fused.mask is not None:
            encoded["mask"] = self._mask_png(fused.mask)
        if stages.fir_counts is not None:
            encoded["fir"] = encode_png(stages.fir_counts)
        if depth is not None:
            encoded["depth"] = encode_png(quantised(depth.dense.value_m))
            encoded["support"] = encode_png(np.where(depth.dense.support, np.uint8(255), np.uint8(0)))
        return encoded

    def _mask_png(self, mask: NDArray[np.uint8]) -> bytes:
        with self._lock:
            known = self._mask
        if known is None or known[0] is not mask:  # a fixed warp hands out one and the same array
            known = (mask, encode_png(mask))
            with self._lock:
                self._mask = known
        return known[1]
