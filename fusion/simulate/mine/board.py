"""A calibration session: a heated board moved about in front of the sensors, in a quiet stretch of drift.

The board's frame is OpenCV's: origin at the first corner (or circle), x along its rows, y down, z into the
board, away from who sees its front. The front is printed, the back is bare metal; it has no thickness.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.errors import UsageError
from fusion.geometry import T_CAM_LIDAR, invert, pose, transform
from fusion.simulate.mine.board_kernels import CHESSBOARD, CIRCLES, lay_board
from fusion.simulate.mine.hits import Floats, Hits, Material
from fusion.simulate.mine.scene import MineScene, build_scene
from fusion.simulate.mine.scene_config import BoardConfig, SceneConfig

Matrix = NDArray[np.float64]

RADIUS = 0.38  # of a circle, in distances between rows
_ROOM = SceneConfig(length_m=60.0, side_drift=False, machine=False, person=False)
_STAND_M = 15.0  # where in the drift the sensors stand
_CLEAR_M = 0.08  # between board and rock
_TRIES = 200
_KIND = {"chessboard": CHESSBOARD, "circles": CIRCLES}


@dataclass(frozen=True, slots=True)
class Board:
    """The board's geometry: `corners_m` N x 3 float64 in its frame, `box_m` its extent x0, y0, x1, y1.

    Corners are a chessboard's inner ones, or the centres of an asymmetric grid's circles, row by row as
    OpenCV orders them.
    """

    config: BoardConfig
    corners_m: Matrix
    box_m: Matrix

    @classmethod
    def of(cls, config: BoardConfig) -> Board:
        """A board with a bright margin: half a field around a chessboard, a row's distance around circles."""
        j, i = (a.ravel() for a in np.meshgrid(np.arange(config.cols), np.arange(config.rows)))
        chess = config.kind == "chessboard"
        grid = np.stack([j if chess else 2 * j + i % 2, i, np.zeros_like(i)], -1).astype(np.float64)
        margin = 1.5 if chess else 1.0 + RADIUS
        corners = config.square_m * grid
        box = np.r_[
            corners[:, :2].min(0) - margin * config.square_m, corners[:, :2].max(0) + margin * config.square_m
        ]
        return cls(config, corners, box)

    def outline_m(self) -> Matrix:
        """Its four corners and its middle, 5 x 3, in its frame."""
        x0, y0, x1, y1 = self.box_m
        return np.array(
            [(x0, y0, 0), (x1, y0, 0), (x1, y1, 0), (x0, y1, 0), ((x0 + x1) / 2, (y0 + y1) / 2, 0)]
        )


@dataclass(frozen=True, slots=True)
class BoardScene:
    """A room with a board in it, as a scene: the room by ray casting, the board exactly; the nearer wins."""

    room: MineScene
    board: Board
    T_world_board: Matrix
    materials: tuple[Material, ...]

    @property
    def lamps(self) -> Matrix:
        return self.room.lamps

    @property
    def lamp_bgr(self) -> Matrix:
        return self.room.lamp_bgr

    def cast(self, rays: Floats, **options: Any) -> Hits:
        """As `MineScene.cast`; `footprint_rad` overrides the angle over which the pattern is averaged."""
        config = self.board.config
        footprint = float(options.pop("footprint_rad", config.footprint_rad))
        rays = np.ascontiguousarray(rays, np.float32)
        hits = self.room.cast(rays, **options)
        range_m, T_board_world = hits.range_m.copy(), invert(self.T_world_board)
        pattern = np.array([_KIND[config.kind], config.cols, config.rows, config.square_m, RADIUS])
        print_of, last = np.array([config.dark, config.bright]), len(self.materials) - 1
        sides, box = np.array([last - 1, last], np.uint8), self.board.box_m
        found = range_m, hits.normal, hits.material, hits.printed
        lay_board(rays, T_board_world, box, pattern, print_of, footprint, sides, *found)
        return Hits(*found)


@dataclass(frozen=True, slots=True)
class Session:
    """A room, and where a board was held (`T_world_board`, K x 4 x 4) before a body at `T_world_body`."""

    room: MineScene
    board: Board
    T_world_body: Matrix
    T_world_board: Matrix

    def __len__(self) -> int:
        return len(self.T_world_board)

    def scene(self, k: int) -> BoardScene:
        """The scene while the board is held in pose k."""
        return self.scene_at(self.T_world_board[k])

    def scene_at(self, T_world_board: Matrix) -> BoardScene:
        """The scene with the board anywhere."""
        return BoardScene(
            self.room, self.board, T_world_board, (*self.room.materials, *_sides(self.board.config))
        )


def _sides(config: BoardConfig) -> tuple[Material, Material]:
    grey = (config.bright, config.bright, config.bright)
    front = Material(
        "board", grey, 0.0, 0.0, 0.5, config.heated_degC, 0.3, 0.95, lidar_reflectance=config.bright
    )
    metal = Material(
        "board back", (0.3, 0.3, 0.3), 0.1, 0.0, 0.5, config.heated_degC, 0.3, 0.3, lidar_reflectance=0.4
    )
    return front, metal


def build_room(seed: int) -> MineScene:
    """The quiet stretch of drift in which boards are shown."""
    return build_scene(_ROOM, seed)


def build_session(config: BoardConfig, seed: int, room: MineScene | None = None) -> Session:
    """The session of a configuration and a seed; the same two give the same session.

    Poses go round all directions within the two angles and all distances, tilted about any axis and turned
    in their plane by up to 20 degrees. `room` is `build_room(seed)` or another mine, whose first straight is
    used. Raises `UsageError` if the board does not fit into it.
    """
    room, board = room or build_room(seed), Board.of(config)
    k = int(np.argmin(np.abs(room.centre_line[:, 0] - _STAND_M)))
    T_world_body = pose(np.eye(3), room.centre_line[k])
    rng = np.random.default_rng([seed, 5])
    T_body_board = [_free_pose(room, board, T_world_body, index, rng) for index in range(config.poses)]
    return Session(room, board, T_world_body, T_world_body @ np.stack(T_body_board))


def _free_pose(
    room: MineScene, board: Board, T_world_body: Matrix, index: int, rng: np.random.Generator
) -> Matrix:
    for _ in range(_TRIES):
        T_body_board = _drawn_pose(board, index, rng)
        ends = transform(T_world_body @ T_body_board, board.outline_m())
        start = T_world_body[:3, 3]
        away = np.linalg.norm(ends - start, axis=1)
        free = room.caster.reach(np.tile(start, (5, 1)), (ends - start) / away[:, None])
        if np.all(free > away + _CLEAR_M):
            return T_body_board
    hint = "make the board smaller, or hold it nearer (distance_m, elevation_deg)"
    raise UsageError("the board does not fit into the drift", where="board", hint=hint)


def _drawn_pose(board: Board, index: int, rng: np.random.Generator) -> Matrix:
    """One of 3 x 3 directions and five distances in turn, each anywhere within its part."""
    c = board.config
    column, row, depth = np.array([index % 3, index // 3 % 3, index * 2 % 5]) + rng.uniform(0, 1, 3)
    azimuth = np.deg2rad(c.azimuth_deg) * (1 - 2 * column / 3)
    elevation = np.deg2rad(c.elevation_deg) * (1 - 2 * row / 3)
    near, far = c.distance_m
    distance = near * (far / near) ** (depth / 5)
    middle = distance * np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    axis, tilt = rng.uniform(0, 2 * np.pi), np.deg2rad(c.tilt_deg) * np.sqrt(rng.uniform())
    tilted = _rotation(np.array([np.cos(axis), np.sin(axis), 0]), tilt)
    R = T_CAM_LIDAR[:3, :3].T @ tilted @ _rotation(np.array([0, 0, 1.0]), np.deg2rad(rng.uniform(-20, 20)))
    return pose(R, middle - R @ board.outline_m()[4])


def _rotation(axis: Matrix, angle: float) -> Matrix:
    x, y, z = axis
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
