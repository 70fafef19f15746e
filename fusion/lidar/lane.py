"""The LiDAR lane: clean the cloud, project it, drop what the camera cannot see, fill the gaps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.clouds.filters import crop_box, crop_range, statistical_outliers, voxel
from fusion.errors import FrameError, UsageError
from fusion.frames import PointCloud
from fusion.geometry import Camera, Floats, transform
from fusion.lidar.config import CloudConfig, DepthConfig
from fusion.lidar.densify import Demand, check_beyond, densifier, densify
from fusion.lidar.project import check_value, from_image, project
from fusion.lidar.rings import rings_of
from fusion.lidar.sparse import DenseDepth, SparseDepth, Value
from fusion.rig import Rig

MOST_IN_MAP = 5_000_000  # a normal a point takes a search among all
FEW = 0.02  # a smaller share than this left at one step is what went wrong


@dataclass(frozen=True, slots=True)
class DepthFrame:
    """What became of one cloud or sparse picture; `sparse` holds the samples that were used."""

    stem: str
    sparse: SparseDepth
    dense: DenseDepth
    stamp_ns: int | None = None
    dropped: Mapping[str, int] | None = None
    flags: tuple[str, ...] = ()

    @property
    def counts(self) -> dict[str, int]:
        """Points or pixels left after each step, from ``read`` to ``covered`` and ``supported`` (pixels)."""
        covered = int(np.count_nonzero(self.dense.value_m))
        return {
            **self.sparse.counts,
            "covered": covered,
            "supported": int(np.count_nonzero(self.dense.support)),
        }


class DepthLane:
    """Turns clouds, or sparse pictures, into dense depth by one configuration.

    `camera` and `T_cam_lidar` are the configuration's, or those of the `rig` that it names. Each frame
    is made on its own, so that frames may be made in any order, by several threads, with the same result.
    Raises `UsageError` when made, if the configuration cannot hold.
    """

    def __init__(self, config: DepthConfig | None = None, rig: Rig | None = None) -> None:
        self.config = config or DepthConfig.of()
        self.camera, self.T_cam_lidar = _camera(self.config, rig)
        chosen = self.config.samples.value
        self.value: Value = chosen if chosen != "auto" else "depth" if self.camera.has_axis else "range"
        check_value(self.camera, self.value)
        densifier(self.config.dense.method)
        check_beyond(self.config.dense.method, self.config.dense.extrapolate)

    def of_cloud(
        self, cloud: PointCloud, *, guide_bgr: NDArray[np.uint8] | None = None, threads: int = 1
    ) -> DepthFrame:
        """Dense depth of a cloud. Raises `FrameError`, with the likely cause, when no sample is left."""
        whole = cloud if cloud.read is not None else replace(cloud, read=len(cloud))  # before the crops
        cloud = cleaned(whole, self.config.cloud)
        ring = rings_of(cloud) if len(cloud) else None
        if ring is not None:
            cloud = replace(cloud, fields={**cloud.fields, "ring": ring})
        samples = self.config.samples
        sparse = project(cloud, self.camera, self.T_cam_lidar, value=self.value, limits_m=samples.limits_m)
        sparse = self._visible(sparse, cloud, is_scan=ring is not None)
        return self._filled(cloud.stem, sparse, guide_bgr, threads, cloud.stamp_ns, cloud.dropped)

    def of_image(
        self,
        depth_m: NDArray[np.floating[Any]],
        stem: str = "",
        *,
        guide_bgr: NDArray[np.uint8] | None = None,
        threads: int = 1,
    ) -> DepthFrame:
        """Dense depth of a sparse picture of a scan, H x W metres, 0 where there is none."""
        sparse = from_image(depth_m, self.value)
        lo, hi = self.config.samples.limits_m
        near = (sparse.value_m >= lo) & (sparse.value_m <= hi)
        sparse = sparse.take(near, in_range=int(near.sum()))
        sparse = self._visible(sparse, None, is_scan=guide_bgr is None)
        return self._filled(stem, sparse, guide_bgr, threads, None, None)

    def _visible(self, sparse: SparseDepth, cloud: PointCloud | None, *, is_scan: bool) -> SparseDepth:
        """The samples that nothing nearer hides from the camera, as the configuration tells visibility."""
        way = self.config.samples.visibility
        if way == "auto":
            way = "scan" if is_scan else "none" if cloud is None else "map"
        if way == "none" or not len(sparse):
            return sparse.take(np.ones(len(sparse), np.bool_), visible=len(sparse))
        if way == "scan":
            from fusion.lidar.occlusion import occluded

            seen = ~occluded(sparse)
        else:
            if cloud is None:
                raise FrameError("a sparse picture is no map", hint="--visibility scan or none")
            seen = self._seen_in_map(cloud)[sparse.index]
        return sparse.take(seen, visible=int(np.count_nonzero(seen)))

    def _seen_in_map(self, cloud: PointCloud) -> NDArray[np.bool_]:
        from fusion.lidar.surfels import surfels_of, visible_in_map

        if len(cloud) > MOST_IN_MAP:
            hint = f"at most {MOST_IN_MAP:,}: --voxel METRES, or --visibility none"
            raise FrameError(f"{len(cloud):,} points are too many to find the hidden ones", hint=hint)
        discs = surfels_of(cloud)
        normal = discs.normal @ self.T_cam_lidar[:3, :3].T.astype(np.float32)
        return visible_in_map(transform(self.T_cam_lidar, cloud.xyz_m), self.camera, normal, discs.radius_m)

    def _filled(
        self,
        stem: str,
        sparse: SparseDepth,
        guide_bgr: NDArray[np.uint8] | None,
        threads: int,
        stamp_ns: int | None,
        dropped: Mapping[str, int] | None,
    ) -> DepthFrame:
        if not len(sparse):
            raise FrameError(f"nothing to fill in from: {likely_cause(sparse.counts)}", where=stem)
        if guide_bgr is not None and guide_bgr.shape[1::-1] != sparse.size_wh:
            size, guide = (f"{w}x{h}" for w, h in (sparse.size_wh, guide_bgr.shape[1::-1]))
            raise FrameError(f"the guide is {guide}, the depth {size}", where=stem)
        dense = self.config.dense
        demand = Demand(dense.extrapolate, dense.max_gap_px, self.config.samples.limits_m, guide_bgr, threads)
        filled = densify(sparse, dense.method, demand)
        if not filled.value_m.any():
            hint = "more points, a larger --max-gap, or --extrapolate nearest"
            raise FrameError(f"{len(sparse)} samples, and no pixel between them", where=stem, hint=hint)
        cause = likely_cause(sparse.counts)
        return DepthFrame(stem, sparse, filled, stamp_ns, dropped, ("few-points",) if cause else ())


def cleaned(cloud: PointCloud, config: CloudConfig) -> PointCloud:
    """The cloud after the crops, the down-sampling and the outlier test that are asked for, all counted."""
    if config.range_m is not None:
        cloud = crop_range(cloud, *config.range_m)
    if config.box_m is not None:
        cloud = crop_box(cloud, config.box_m[:3], config.box_m[3:])
    if config.voxel_m is not None and len(cloud):
        try:
            cloud = voxel(cloud, config.voxel_m)
        except UsageError as error:  # the size is right; this cloud is too wide for it
            raise FrameError(error.what, where=cloud.stem, hint=error.hint) from None
    if config.outliers is not None and len(cloud):
        cloud = statistical_outliers(cloud, *config.outliers)
    return cloud


CAUSES = (
    ("finite", "read", "nearly all points are invalid or cut away", "look at the crops, and at the file"),
    (
        "in_front",
        "finite",
        "nearly all points lie behind the camera",
        "turn it: --look YAW PITCH ROLL, --rig",
    ),
    ("in_frame", "in_front", "nearly all points lie outside the picture", "--fov, --look, or another --rig"),
    ("in_range", "in_frame", "nearly all points lie outside the limits", "--limits LEAST MOST"),
    ("visible", "in_range", "nearly all points are hidden behind others", "--visibility none shows them"),
)


def likely_cause(counts: Mapping[str, int]) -> str:
    """The first step that took nearly all, in words and with a way out; "" where none did."""
    if counts.get("read", 0) == 0:
        return "it has no points"
    for left, before, words, way_out in CAUSES:
        if left in counts and counts[left] <= FEW * counts[before]:
            return f"{words} ({counts[left]} of {counts[before]} left; {way_out})"
    return ""


def _camera(config: DepthConfig, rig: Rig | None) -> tuple[Camera, Floats]:
    if rig is None:
        return config.camera.virtual(), config.camera.pose()
    sensor = config.camera.sensor
    return rig.camera(sensor), rig.pose(sensor, "lidar")
