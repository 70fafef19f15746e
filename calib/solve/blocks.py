"""Residuals and their derivatives: a block for each camera, and for each LiDAR's plane and edge points.

A camera sees X of the board at p = T_ref_sensor^-1 T_ref_board exp(s twist) X, s = lag + time offset; a
LiDAR's point p is at X = exp(-s twist) T_ref_board^-1 T_ref_sensor p of the board. Steps as in
`motion.moved`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from calib.boards import Board
from calib.observations import CloudView, View
from calib.solve.cameras import Pixels, project
from calib.solve.motion import cross, exp_motion
from calib.solve.state import Layout, State
from fusion.geometry import Floats
from fusion.rig import RigCamera

Ids = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Linear:
    """N points' residuals `r` (N, K), and derivatives by a sensor's own parameters, in the order of
    `Layout.columns`, `by_shared` (N, K, P), and by the pose of the point's board `by_board` (N, K, 6)."""

    r: Floats
    by_shared: Floats
    by_board: Floats


class Block(Protocol):
    """Residuals of one kind and one noise. `parts` are the slices of its points by view (or cloud), `moments`
    the boards' numbers of those; `kind` is ``px``, ``plane`` or ``edge``."""

    sensor: str
    kind: str
    parts: list[slice]
    moments: Ids

    def linearise(self, state: State) -> Linear:
        """Residuals (px or m; NaN where a point cannot be seen) and derivatives."""
        ...


def blocks_of(
    board: Board, views: Sequence[View], clouds: Sequence[CloudView], layout: Layout
) -> list[Block]:
    """The blocks of views and clouds, sensor by sensor; within one in the order of `views`, `clouds`."""
    sensors = list(dict.fromkeys([*(v.camera for v in views), *(c.sensor for c in clouds)]))
    blocks: list[Block] = []
    for sensor in sensors:
        seen = [v for v in views if v.camera == sensor]
        scans = [c for c in clouds if c.sensor == sensor]
        if seen:
            blocks.append(CameraBlock(board, sensor, seen, layout))
        if scans:
            blocks.append(CloudBlock(sensor, scans, layout))
        if any(len(c.edge_m) for c in scans):
            blocks.append(CloudBlock(sensor, scans, layout, board.plate_m))
    return blocks


class _Parts:
    """Points that stand behind each other by view, and how the boards move in each view."""

    def __init__(self, sensor: str, counts: list[int], moments: list[str], layout: Layout) -> None:
        ends = np.cumsum([0, *counts])
        number = {moment: i for i, moment in enumerate(layout.moments)}
        twist = layout.start.twist
        self.sensor = sensor
        self.parts = [slice(a, b) for a, b in pairwise(ends.tolist())]
        self.moments = np.array([number[m] for m in moments], np.intp)
        self.of = np.repeat(np.arange(len(counts)), counts)
        self.twist = np.array([twist.get(m, np.zeros(6)) for m in moments], np.float64)
        self.moving = bool(self.twist.any())
        self.posed, self.timed = sensor in layout.posed, sensor in layout.timed

    def motion(self, lag_s: Floats, state: State) -> Floats:
        """(V, 4, 4) how the board moved since its moment, by view."""
        if not self.moving:
            return np.broadcast_to(np.eye(4), (len(self.moments), 4, 4))
        s = lag_s + state.offset_s.get(self.sensor, 0.0)
        return exp_motion(s[:, None] * self.twist)

    def velocity(self, xyz: Floats) -> Floats:
        """(N, 3) m/s of points in the frame of the moving board."""
        twist = self.twist[self.of]
        return cross(twist[:, :3], xyz) + twist[:, 3:]

    def columns(self, own: list[Floats], pose: Floats, offset: Floats) -> Floats:
        """The sensor's derivatives side by side, without those that it has not."""
        return np.concatenate([*own, *([pose] if self.posed else []), *([offset] if self.timed else [])], -1)


def _apply(T: Floats, of: Ids, xyz: Floats) -> Floats:
    """(N, 3) points by the transformation of the view that each is of."""
    return np.einsum("nij,nj->ni", T[of, :3, :3], xyz) + T[of, :3, 3]


class CameraBlock(_Parts):
    """Projected minus seen pixels of one camera."""

    kind = "px"

    def __init__(self, board: Board, camera: str, views: Sequence[View], layout: Layout) -> None:
        super().__init__(camera, [len(v.ids) for v in views], [v.moment for v in views], layout)
        self.model: RigCamera = layout.cameras[camera]
        self.points = np.concatenate([board.points_m[v.ids] for v in views]).astype(np.float64)
        self.uv = np.concatenate([v.uv for v in views]).astype(np.float64)
        self.lag_s = np.array([v.lag_s for v in views], np.float64)

    def _project(self, state: State) -> tuple[Floats, Floats, Pixels]:
        """Points in the moved board's frame and in the reference, and their pixels."""
        on_board = _apply(self.motion(self.lag_s, state), self.of, self.points)
        in_ref = _apply(state.boards[self.moments], self.of, on_board)
        T = state.T[self.sensor]
        in_camera = (in_ref - T[:3, 3]) @ T[:3, :3]
        return on_board, in_ref, project(self.model, state.camera[self.sensor], in_camera)

    def linearise(self, state: State) -> Linear:
        on_board, in_ref, pixels = self._project(state)
        T, boards = state.T[self.sensor], state.boards[self.moments]
        g = pixels.by_point @ T[:3, :3].T  # by the point in the reference's frame
        from_board = (in_ref - boards[self.of, :3, 3])[:, None]
        by_board = np.concatenate([cross(from_board, g), g], -1)
        pose = np.concatenate([cross(g, (in_ref - T[:3, 3])[:, None]), -g], -1) if self.posed else g
        offset = g[..., :1]
        if self.timed:
            speed = np.einsum("nij,nj->ni", boards[self.of, :3, :3], self.velocity(on_board))
            offset = np.einsum("nki,ni->nk", g, speed)[..., None]
        r = np.where(pixels.seen[:, None], pixels.uv - self.uv, np.nan)
        return Linear(r, self.columns([pixels.by_parameter], pose, offset), by_board)


class CloudBlock(_Parts):
    """Distances of a LiDAR's points, in metres: from the board's plane, or outwards from its sides."""

    def __init__(
        self,
        sensor: str,
        clouds: Sequence[CloudView],
        layout: Layout,
        plate_m: tuple[float, float, float, float] | None = None,
    ) -> None:
        self.kind = "plane" if plate_m is None else "edge"
        points = [c.plane_m if plate_m is None else c.edge_m for c in clouds]
        super().__init__(sensor, [len(p) for p in points], [c.moment for c in clouds], layout)
        self.points = np.concatenate(points).astype(np.float64)
        self.lag_s = np.zeros(len(clouds))
        self.normal = np.tile([0.0, 0.0, 1.0], (len(self.points), 1))
        self.level = np.zeros(len(self.points))
        if plate_m is not None:
            left, top, right, bottom = plate_m
            side = np.concatenate([c.edge_of for c in clouds])
            self.normal = np.array([[0.0, -1, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0]])[side]
            self.level = np.array([-top, right, bottom, -left])[side]

    def _place(self, state: State) -> tuple[Floats, Floats, Floats, Floats]:
        """Points turned like the reference, in it, on the board; and the boards' motion (V, 4, 4)."""
        T, boards = state.T[self.sensor], state.boards[self.moments]
        turned = self.points @ T[:3, :3].T
        in_ref = turned + T[:3, 3]
        motion = self.motion(self.lag_s, state)
        there = boards @ motion
        on_board = np.einsum("nji,nj->ni", there[self.of, :3, :3], in_ref - there[self.of, :3, 3])
        return turned, in_ref, on_board, there

    def linearise(self, state: State) -> Linear:
        turned, in_ref, on_board, there = self._place(state)
        boards = state.boards[self.moments]
        g = np.einsum("nij,nj->ni", there[self.of, :3, :3], self.normal)  # by the point in the reference
        by_board = np.concatenate([cross(g, in_ref - boards[self.of, :3, 3]), -g], -1)
        pose = np.concatenate([cross(turned, g), g], -1)
        offset = -(self.normal * self.velocity(on_board)).sum(1)[:, None]
        r = (self.normal * on_board).sum(1) - self.level
        return Linear(r[:, None], self.columns([], pose, offset)[:, None], by_board[:, None])


def by_part(block: Block, values: NDArray[Any]) -> list[NDArray[Any]]:
    """A block's values view by view."""
    return [values[part] for part in block.parts]
