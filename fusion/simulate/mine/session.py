"""A calibration session as a recording: a heated board held still before all three sensors, pose after pose.

rgb/, fir/ and lidar/ hold one file a pose, truth/ what `recording` writes of a standing drone, and
`board.toml` (what was held), `poses_board.tum` (T_world_board), `corners_rgb.csv`, `corners_fir.csv`: where
the board's corners truly are.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tomlkit
from numpy.typing import ArrayLike, NDArray

from fusion.clouds import write_pcd
from fusion.codecs import encode_jpeg, encode_png
from fusion.files import replace_file
from fusion.geometry import Floats, PinholeCamera, invert, transform
from fusion.rig import Rig, save_rig
from fusion.simulate.mine import layout
from fusion.simulate.mine.board import Board, Session, build_session
from fusion.simulate.mine.config import MineConfig
from fusion.simulate.mine.lidar import LidarSensor
from fusion.simulate.mine.motion import Clock, mounted
from fusion.simulate.mine.recording import Progress, Report
from fusion.simulate.mine.rgb import RgbSensor
from fusion.simulate.mine.textures import cloud_volume
from fusion.simulate.mine.thermal import ThermalSensor

FIRST_S, EVERY_S = 1.0, 2.0
_CORNERS = ("stamp_ns", "corner", "u_px", "v_px", "seen")
_STILL = (np.zeros(3), np.zeros(3))


@dataclass(frozen=True, slots=True)
class _Standing:
    T_world_body: Floats

    def pose_at(self, t_s: ArrayLike) -> Floats:
        return np.broadcast_to(self.T_world_body, (*np.shape(t_s), 4, 4))


def make_session(
    out: Path, config: MineConfig, *, progress: Progress | None = None, session: Session | None = None
) -> Report:
    """Write the session that `config.board` describes into the new or empty folder `out`.

    The same configuration gives the same bytes. All sensors look at the true times 1, 3, 5 ... s. `session`
    replaces the one of the configuration. Raises `OutputError`, `UsageError`.
    """
    layout.claim(out)
    return _Sitting(out, config, session or build_session(config.board, config.seed)).run(progress)


class _Sitting:
    def __init__(self, out: Path, config: MineConfig, session: Session) -> None:
        self._out, self._config, self._session = out, config, session
        volume = cloud_volume(np.random.default_rng(np.random.SeedSequence(config.seed, spawn_key=(0,))))
        first = session.scene(0)
        self._rgb, self._fir = RgbSensor(config, first, volume), ThermalSensor(config, first, volume)
        self._lidar = LidarSensor(config, first, volume)
        self._times = [FIRST_S + EVERY_S * k for k in range(len(session))]
        groups = {"rgb": config.rgb, "fir": config.thermal, "lidar": config.lidar}
        self._clocks = {name: Clock.of(group.clock) for name, group in groups.items()}
        self._mounts = {name: mounted(group.mount, name != "lidar") for name, group in groups.items()}

    def run(self, progress: Progress | None) -> Report:
        self._write_small()
        points = 0
        for k in range(len(self._session)):
            points += self._pose(k)
            if progress is not None:
                progress(k + 1, len(self._session))
        return Report(len(self._session), len(self._session), len(self._session), points, 0)

    def _pose(self, k: int) -> int:
        scene, body, t = self._session.scene(k), self._session.T_world_body, self._times[k]
        rgb, fir, lidar = (clock.stamp_ns(t) for clock in self._clocks.values())
        at = body @ self._mounts["rgb"]
        view = self._rgb.viewer.at(at, scene)
        bgr, c = self._rgb.picture(view, k, t, body, at, _STILL, metered=True), self._config.rgb
        data = encode_jpeg(bgr, c.quality) if c.file == "jpg" else encode_png(bgr)
        replace_file(self._out / "rgb" / f"{rgb}.{c.file}", data)
        seen = self._fir.viewer.at(body @ self._mounts["fir"], scene)
        counts, kelvin = self._fir.picture(seen, k, t, _STILL)
        replace_file(self._out / "fir" / f"{fir}.png", encode_png(counts))
        cloud = self._lidar.scan(_Standing(body), t, k, scene)
        write_pcd(self._out / "lidar" / f"{lidar}.pcd", cloud)
        if self._config.truth:
            dense = (
                ("depth_rgb", rgb, view.depth),
                ("depth_fir", fir, seen.depth),
                ("temperature_fir", fir, kelvin),
            )
            for kind, stamp, image in dense:
                replace_file(self._out / "truth" / kind / f"{stamp}.png", encode_png(image))
        return len(cloud)

    def _write_small(self) -> None:
        truth, body = self._out / "truth", self._session.T_world_body
        replace_file(truth / "mine.toml", self._config.toml().encode())
        replace_file(truth / "board.toml", _board_toml(self._session.board).encode())
        T_rgb_body, cameras = (
            invert(self._mounts["rgb"]),
            {"rgb": self._rgb.viewer.camera, "fir": self._fir.viewer.camera},
        )
        transforms = {f"T_rgb_{name}": T_rgb_body @ self._mounts[name] for name in ("fir", "lidar")}
        save_rig(truth / "rig.toml", Rig(cameras, transforms))
        layout.write_clocks(truth / "clocks.toml", self._clocks)
        layout.write_rows(truth / "freezes.csv", ("stamp_ns", "shown_stamp_ns"), [])
        for name, mount in self._mounts.items():
            layout.write_tum(truth / f"poses_{name}.tum", self._times, [body @ mount] * len(self._times))
        layout.write_tum(truth / "poses_board.tum", self._times, list(self._session.T_world_board))
        for name, camera in cameras.items():
            layout.write_rows(truth / f"corners_{name}.csv", _CORNERS, self._corners(name, camera))

    def _corners(self, name: str, camera: PinholeCamera) -> list[tuple[object, ...]]:
        """Pixels of every corner in every pose; seen: inside the picture, on the front of the board."""
        T_cam_world, (w, h) = invert(self._session.T_world_body @ self._mounts[name]), camera.size_wh
        rows: list[tuple[object, ...]] = []
        for t, T_world_board in zip(self._times, self._session.T_world_board, strict=True):
            T = T_cam_world @ T_world_board
            uv, ahead = camera.project(transform(T, self._session.board.corners_m))
            seen: NDArray[np.bool_] = (
                ahead & ((uv > -0.5) & (uv < (w - 0.5, h - 0.5))).all(1) & (T[:3, 2] @ T[:3, 3] > 0)
            )
            stamp = self._clocks[name].stamp_ns(t)
            rows += [
                (stamp, j, f"{u:.4f}", f"{v:.4f}", int(s))
                for j, ((u, v), s) in enumerate(zip(uv, seen, strict=True))
            ]
        return rows


def _board_toml(board: Board) -> str:
    """The board as calibration takes it; what its spacing is, for circles, is the distance of rows."""
    config = board.config
    table: dict[str, object] = {
        "format": "fusion-board/1",
        "kind": "asymmetric-circles" if config.kind == "circles" else config.kind,
        "cols": config.cols,
        "rows": config.rows,
        "spacing_m": config.square_m,
        "plate_m": [round(float(edge), 9) for edge in board.box_m],
    }
    return tomlkit.dumps(table)
