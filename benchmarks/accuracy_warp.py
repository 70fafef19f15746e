"""Where thermal lands on RGB in the simulated mine, by every way of warping, against the truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from accuracy_mine import Standing
from numpy.typing import NDArray
from table import grid

from fusion.frames import PointCloud
from fusion.geometry import Floats, invert, transform
from fusion.lidar.config import DepthConfig
from fusion.lidar.lane import DepthLane
from fusion.rig import Rig
from fusion.rig_warp import DepthWarp, RigWarp
from fusion.simulate.mine.board import Session, build_session
from fusion.simulate.mine.config import MineConfig
from fusion.simulate.mine.hits import Scene
from fusion.simulate.mine.lidar import LidarSensor
from fusion.simulate.mine.motion import mounted
from fusion.simulate.mine.plane_at import homography_at
from fusion.simulate.mine.recording import World, world_of
from fusion.simulate.mine.rgb import camera_of
from fusion.simulate.mine.textures import cloud_volume
from fusion.warp import Warp

BANDS_M = ((0.0, 1.5), (1.5, 3.0), (3.0, 6.0), (6.0, 12.0), (12.0, 60.0))
AT_M = 5.0
NEARER = 0.01  # a ray that ends nearer than the point by this share, and as many metres, is stopped
HELD_M, SQUARE_M = (0.8, 2.4), 0.05  # how far off the board is held; the side of its fields
CLEARLY_PX = 1.0  # parallax between what hides and what is hidden from which on a mask is asked for
WANTED_PX = 0.5

TEXT = """\
{flown} moments of a flight in the default mine (seed {seed}), the drone standing still, and {posed} poses
of a board held {near:.1f} to {far:.1f} m before it: RGB of 640x480 (84 degrees) and thermal of 640x512
(68 degrees), their centres {baseline:.0f} mm apart. Errors are how far, in RGB pixels, thermal is sampled
from where it truly belongs, median / 95th percentile over the pixels whose point both cameras see, by true
depth; beside it the share of those that are off by more than {wanted:g} px, and of those that get no value.
The homography is the one that fits best at {at:g} m. *LiDAR depth* is `fusion depth`'s default on a scan of
64 rings, which reaches 22.5 degrees up and down: pixels beyond have no value. *Masked* is the overlap
(intersection over union) of what is masked as hidden with what rays from the thermal camera show to be
hidden, in the flight and behind the board, where pixels have depth. What lies less than {clearly:g} px of
parallax behind something does not count as hidden. The edge of a strip is known to half a pixel at best, and
most strips in the flight are one or two pixels wide. The other ways mask nothing."""


@dataclass(frozen=True, slots=True)
class Frame:
    """Of every RGB pixel: true depth, and where its point lies in the thermal image (NaN: outside).

    `hidden_px` is the parallax between the point and what hides it from the thermal camera, 0: nothing.
    """

    truth_m: NDArray[np.float32]
    fir_xy: Floats
    hidden_px: Floats
    cloud: PointCloud


def markdown(flown: int = 6, posed: int = 6, seed: int = 0) -> str:
    """The section of the page."""
    config = MineConfig.of(seed=seed)
    board = config.board.model_copy(update={"poses": posed, "distance_m": HELD_M, "square_m": SQUARE_M})
    rig, session = rig_of(config), build_session(board, seed)
    frames = [*frames_of(config, world_of(config), flown), *poses_of(config, session)]
    found, T = errors(rig, frames, flown), rig.pose("rgb", "fir")
    near, far = board_distances(config, session)
    text = TEXT.format(
        flown=flown,
        posed=posed,
        seed=seed,
        near=near,
        far=far,
        baseline=1000 * float(np.linalg.norm(T[:3, 3])),
        wanted=WANTED_PX,
        at=AT_M,
        clearly=CLEARLY_PX,
    )
    bands = [f"{lo:g}–{hi:g} m" for lo, hi in BANDS_M]
    heads = [
        "way",
        *bands,
        "all",
        f"over {WANTED_PX:g} px",
        "without a value",
        "masked, flight",
        "masked, board",
    ]
    return f"### Thermal on RGB\n\n{text}\n\n{grid(heads, ([way, *cells] for way, cells in found.items()))}"


def errors(rig: Rig, frames: list[Frame], flown: int) -> dict[str, list[str]]:
    """The cells of every way's row; the first `flown` of the frames are of the flight."""
    fir_wh, rgb_wh = rig.camera("fir").size_wh, rig.camera("rgb").size_wh
    lane, by_depth = DepthLane(DepthConfig.of(), rig), DepthWarp(rig, fir_wh, rgb_wh)
    infinity = RigWarp.fixed(rig, fir_wh, rgb_wh)
    fixed: Mapping[str, Floats] = {
        f"homography of {AT_M:g} m": homography_positions(rig),
        "rig, infinity": infinity.positions(),
        f"rig, distance {AT_M:g} m": RigWarp.fixed(rig, fir_wh, rgb_wh, "distance", AT_M).positions(),
        "rig, distance 2 m": RigWarp.fixed(rig, fir_wh, rgb_wh, "distance", 2.0).positions(),
    }
    thermal_per_rgb_px = thermal_scale(infinity.positions())
    used = {way: [positions] * len(frames) for way, positions in fixed.items()}
    used["rig, true depth"] = [by_depth.positions(frame.truth_m) for frame in frames]
    lidar_m = [lane.of_cloud(frame.cloud, threads=2).dense.value_m for frame in frames]
    used["rig, LiDAR depth"] = [by_depth.positions(depth_m) for depth_m in lidar_m]
    known = {"rig, true depth": [frame.truth_m for frame in frames], "rig, LiDAR depth": lidar_m}
    rows = {}
    for way, places in used.items():
        parts = [np.s_[:flown], np.s_[flown:]]
        overlaps = [_overlap(frames[k], places[k], known[way][k]) if way in known else "–" for k in parts]
        rows[way] = [*_error_cells(frames, places, thermal_per_rgb_px), *overlaps]
    return rows


def _error_cells(frames: list[Frame], used: list[Floats], scale: float) -> list[str]:
    off, depth, wanted = [], [], 0
    for frame, positions in zip(frames, used, strict=True):
        both = (frame.hidden_px == 0) & np.isfinite(frame.fir_xy[..., 0])
        wanted += np.count_nonzero(both)
        both &= np.isfinite(positions[..., 0])
        off.append(np.linalg.norm(positions - frame.fir_xy, axis=-1)[both] / scale)
        depth.append(frame.truth_m[both])
    e, z = np.concatenate(off), np.concatenate(depth)
    parts = [(z >= lo) & (z < hi) for lo, hi in BANDS_M]
    cells = [_cell(e[part]) for part in (*parts, np.ones(len(e), bool))]
    return [*cells, f"{np.mean(e > WANTED_PX):.1%}", f"{1 - len(e) / wanted:.1%}"]


def _cell(off_px: NDArray[np.float64]) -> str:
    return f"{np.median(off_px):.2f} / {np.percentile(off_px, 95):.2f}" if off_px.size else "–"


def _overlap(frames: list[Frame], used: list[Floats], known: list[NDArray[np.float32]]) -> str:
    both = either = 0
    for frame, positions, depth_m in zip(frames, used, known, strict=True):
        judged = np.isfinite(frame.fir_xy[..., 0]) & (depth_m > 0)
        judged &= (frame.hidden_px == 0) | (frame.hidden_px >= CLEARLY_PX)
        masked, hidden = judged & ~np.isfinite(positions[..., 0]), judged & (frame.hidden_px > 0)
        both += np.count_nonzero(masked & hidden)
        either += np.count_nonzero(masked | hidden)
    return f"{both / either:.2f}"


def frames_of(config: MineConfig, world: World, count: int) -> Iterator[Frame]:
    """Frames spread over the flight, with their truth by rays into the scene."""
    volume = cloud_volume(np.random.default_rng(config.seed))
    sensor, rig = LidarSensor(config, world.scene, volume), rig_of(config)
    for k, t in enumerate(np.linspace(2.0, 0.9 * world.path.duration_s, count)):  # type: ignore[attr-defined]
        standing = Standing(np.asarray(world.path.pose_at(float(t))))
        T_world_rgb = standing.T_world_body @ mounted(config.rgb.mount, camera=True)
        yield Frame(*seen_truly(rig, world.scene, T_world_rgb), sensor.scan(standing, float(t), k))


def poses_of(config: MineConfig, session: Session) -> Iterator[Frame]:
    """All poses of a session."""
    volume = cloud_volume(np.random.default_rng(config.seed))
    sensor, rig = LidarSensor(config, session.scene(0), volume), rig_of(config)
    T_world_rgb = session.T_world_body @ mounted(config.rgb.mount, camera=True)
    for k in range(len(session)):
        scene = session.scene(k)
        scan = sensor.scan(Standing(session.T_world_body), float(k), k, scene)
        yield Frame(*seen_truly(rig, scene, T_world_rgb), scan)


def board_distances(config: MineConfig, session: Session) -> tuple[float, float]:
    """Least and largest depth of the corners of the board."""
    T_rgb_world = invert(session.T_world_body @ mounted(config.rgb.mount, camera=True))
    depths = np.concatenate(
        [transform(T_rgb_world @ T, session.board.corners_m)[:, 2] for T in session.T_world_board]
    )
    return float(depths.min()), float(depths.max())


def seen_truly(rig: Rig, scene: Scene, T_world_rgb: Floats) -> tuple[NDArray[np.float32], Floats, Floats]:
    """Of every RGB pixel depth, place in the thermal image, and the parallax to what hides it there."""
    rgb, fir, T_rgb_fir = rig.camera("rgb"), rig.camera("fir"), rig.pose("rgb", "fir")
    w, h = rgb.size_wh
    v, u = np.mgrid[:h, :w]
    rays = rgb.unproject(np.stack([u.ravel(), v.ravel()], -1).astype(np.float64))
    away = _reach(scene, T_world_rgb[:3, 3], rays @ T_world_rgb[:3, :3].T)
    points = rays * away[:, None]
    xy, ahead = fir.project(transform(invert(T_rgb_fir), points))
    fw, fh = fir.size_wh
    inside = ahead & (xy >= -0.5).all(1) & (xy[:, 0] <= fw - 0.5) & (xy[:, 1] <= fh - 0.5)
    eye = T_world_rgb @ T_rgb_fir
    towards = transform(T_world_rgb, points) - eye[:3, 3]
    far = np.linalg.norm(towards, axis=1)
    stop = _reach(scene, eye[:3, 3], towards / far[:, None])
    hidden = inside & (stop < (1 - NEARER) * far - NEARER)
    apart_px = rgb.fx * np.linalg.norm(T_rgb_fir[:3, 3]) * (1 / stop - 1 / far)
    truth_m = (points[:, 2]).astype(np.float32).reshape(h, w)
    fir_xy = np.where(inside[:, None], xy, np.nan).reshape(h, w, 2)
    return truth_m, fir_xy, np.where(hidden, apart_px, 0.0).reshape(h, w)


def _reach(scene: Scene, eye: Floats, directions: Floats) -> Floats:
    rays = np.concatenate([np.broadcast_to(eye, directions.shape), directions], 1).astype(np.float32)
    return scene.cast(rays).range_m.astype(np.float64)


def homography_positions(rig: Rig) -> Floats:
    """Where each RGB pixel samples the thermal image by the homography that fits best at `AT_M`."""
    found, (w, h) = homography_at(rig, AT_M), rig.camera("rgb").size_wh
    v, u = np.mgrid[:h, :w]
    mapped = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(found.H_rgb_fir).T
    mask = Warp(found.H_rgb_fir, rig.camera("fir").size_wh, (w, h)).mask
    return np.where(mask[..., None] > 0, mapped[..., :2] / mapped[..., 2:], np.nan)


def thermal_scale(positions: Floats) -> float:
    """How many thermal pixels an RGB pixel is, by the median."""
    return float(np.nanmedian(np.linalg.norm(np.diff(positions, axis=1), axis=-1)))


def rig_of(config: MineConfig) -> Rig:
    T_body = {
        name: mounted(group.mount, camera=name != "lidar")
        for name, group in (("rgb", config.rgb), ("fir", config.thermal), ("lidar", config.lidar))
    }
    cameras = {"rgb": camera_of(config.rgb.camera), "fir": camera_of(config.thermal.camera)}
    transforms = {f"T_rgb_{name}": invert(T_body["rgb"]) @ T_body[name] for name in ("fir", "lidar")}
    return Rig(cameras, transforms)


if __name__ == "__main__":
    print(markdown())
