"""Depth of the simulated mine against its truth: by distance, at edges, in the open, 16 to 128 rings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from table import grid

from fusion.frames import PointCloud
from fusion.geometry import Floats, invert
from fusion.lidar.config import DepthConfig
from fusion.lidar.lane import DepthLane
from fusion.rig import Rig
from fusion.simulate.mine.config import MineConfig
from fusion.simulate.mine.lidar import LidarSensor
from fusion.simulate.mine.motion import mounted
from fusion.simulate.mine.recording import World, world_of
from fusion.simulate.mine.rgb import camera_of
from fusion.simulate.mine.textures import cloud_volume

RINGS = (16, 32, 64, 128)
METHODS = ("plane", "plane-fast", "natural-discrete", "scan", "natural", "linear", "nearest")
BANDS_M = ((0, 3), (3, 6), (6, 12), (12, 30))
EDGE_SHARE, EDGE_PX = 0.1, 4  # a step of depth, as a share of it, and how far around it counts as edge

TEXT = """\
{frames} frames of the default mine (seed {seed}), the drone standing still at moments of its flight: RGB
camera of 640x480 beside a LiDAR of 1024 columns with 1.5 cm noise, visibility `auto`. Every pixel of the
camera has a true depth; errors are in millimetres, RMSE / MAE, over the pixels that a method supports (their
share of the pixels between the highest and the lowest sample in the last column). An edge pixel lies within
{edge_px} pixels of a step of more than {edge:.0%} of the depth."""


@dataclass(frozen=True, slots=True)
class Standing:
    """A flight that hovers."""

    T_world_body: Floats

    def pose_at(self, t_s: ArrayLike) -> Floats:
        return np.broadcast_to(self.T_world_body, (*np.shape(t_s), 4, 4))


@dataclass(frozen=True, slots=True)
class Frame:
    """A scan, the true depth of the camera, and which of its pixels are at edges."""

    cloud: PointCloud
    truth_m: NDArray[np.float32]
    edge: NDArray[np.bool_]


def markdown(frames: int = 6, seed: int = 0) -> str:
    """The section of the page."""
    config = MineConfig.of(seed=seed)
    world = world_of(config)
    rig = _rig(config)
    heads = ["rings", "method", *(f"{lo}–{hi} m" for lo, hi in BANDS_M), "edges", "open", "all", "supported"]
    lines = []
    for rings in RINGS:
        seen = list(
            _frames(
                config.model_copy(update={"lidar": config.lidar.model_copy(update={"rings": rings})}),
                world,
                frames,
            )
        )
        lines += [[str(rings), f"`{method}`", *_errors(method, rig, seen)] for method in METHODS]
    text = TEXT.format(frames=frames, seed=seed, edge_px=EDGE_PX, edge=EDGE_SHARE)
    return f"### The simulated mine\n\n{text}\n\n{grid(heads, lines)}"


def _frames(config: MineConfig, world: World, count: int) -> Iterator[Frame]:
    volume = cloud_volume(np.random.default_rng(config.seed))
    sensor = LidarSensor(config, world.scene, volume)
    for k, t in enumerate(np.linspace(2.0, 0.9 * world.path.duration_s, count)):  # type: ignore[attr-defined]
        standing = Standing(np.asarray(world.path.pose_at(float(t))))
        truth = _true_depth(config, world, standing)
        yield Frame(sensor.scan(standing, float(t), k), truth, _edges(truth))


def _true_depth(config: MineConfig, world: World, standing: Standing) -> NDArray[np.float32]:
    """Depth along the RGB camera's axis of every pixel, H x W, by rays into the scene."""
    camera = _rig(config).camera("rgb")
    w, h = camera.size_wh
    v, u = np.mgrid[:h, :w]
    rays_cam = camera.unproject(np.stack([u.ravel(), v.ravel()], -1).astype(np.float64))
    T = standing.T_world_body @ mounted(config.rgb.mount, camera=True)
    directions = rays_cam @ T[:3, :3].T
    rays = np.concatenate([np.broadcast_to(T[:3, 3], directions.shape), directions], 1).astype(np.float32)
    return (world.scene.cast(rays).range_m * rays_cam[:, 2]).astype(np.float32).reshape(h, w)


def _edges(truth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels near a step: within a 3 x 3 window depth differs by more than the share that makes an edge."""
    window = np.ones((3, 3), np.uint8)
    near, far = cv2.erode(truth_m, window), cv2.dilate(truth_m, window)
    step = (far - near > EDGE_SHARE * near).astype(np.uint8)
    return cv2.dilate(step, np.ones((2 * EDGE_PX + 1,) * 2, np.uint8)) > 0


def _errors(method: str, rig: Rig, frames: Sequence[Frame]) -> list[str]:
    lane = DepthLane(DepthConfig.of(dense={"method": method}), rig)
    error, truth, edge, wanted = [], [], [], 0
    for frame in frames:
        made = lane.of_cloud(frame.cloud, threads=2)
        good = made.dense.support & np.isfinite(frame.truth_m)
        error.append(1000 * (made.dense.value_m - frame.truth_m)[good])
        truth.append(frame.truth_m[good])
        edge.append(frame.edge[good])
        rows = np.flatnonzero(np.bincount(np.clip(made.sparse.v, 0, None).astype(int)))
        wanted += (rows[-1] - rows[0] + 1) * lane.camera.size_wh[0]
    e, z, at_edge = (np.concatenate(parts) for parts in (error, truth, edge))
    parts = [(z >= lo) & (z < hi) for lo, hi in BANDS_M]
    cells = [_cell(e[part]) for part in (*parts, at_edge, ~at_edge, np.ones(len(e), bool))]
    return [*cells, f"{len(e) / wanted:.1%}"]


def _cell(error_mm: NDArray[np.float32]) -> str:
    if not error_mm.size:
        return "–"
    return f"{np.sqrt(np.mean(np.square(error_mm, dtype=np.float64))):.0f} / {np.mean(np.abs(error_mm)):.0f}"


def _rig(config: MineConfig) -> Rig:
    T_body_rgb = mounted(config.rgb.mount, camera=True)
    T_body_lidar = mounted(config.lidar.mount, camera=False)
    return Rig({"rgb": camera_of(config.rgb.camera)}, {"T_rgb_lidar": invert(T_body_rgb) @ T_body_lidar})
