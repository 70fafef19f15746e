"""The board is where its pose says, shows its pattern exactly, and hides and is hidden."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.errors import UsageError
from fusion.geometry import invert, pose, transform
from fusion.simulate.mine.board import RADIUS, Board, BoardScene, Session, build_session
from fusion.simulate.mine.scene import build_scene
from fusion.simulate.mine.scene_config import BoardConfig, SceneConfig

BARE = {"side_drift": False, "machine": False, "person": False, "roughness": 0.0}
ROOM = SceneConfig(length_m=60.0, cell_m=0.3).model_copy(update=BARE)
KINDS = {"chessboard": BoardConfig(), "circles": BoardConfig.circles()}
F, SIZE_WH = 420.0, (640, 480)
# A board square to the body's x axis: its own x is the body's -y, its z the body's x.
FACING = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], np.float64)


@pytest.fixture(scope="module")
def session() -> Session:
    return build_session(KINDS["chessboard"], 3, build_scene(ROOM, 3))


def with_board(session: Session, config: BoardConfig, T_world_board: NDArray[np.float64]) -> BoardScene:
    other = Session(session.room, Board.of(config), session.T_world_body, T_world_board[None])
    return other.scene(0)


def camera_rays(T_world_body: NDArray[np.float64]) -> NDArray[np.float32]:
    w, h = SIZE_WH
    u, v = np.meshgrid(np.arange(w) - (w - 1) / 2, np.arange(h) - (h - 1) / 2)
    d = np.stack([np.full_like(u, F), -u, -v], -1).reshape(-1, 3) @ T_world_body[:3, :3].T
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return np.hstack([np.broadcast_to(T_world_body[:3, 3], d.shape), d]).astype(np.float32)


def pixels(
    session: Session, T_world_board: NDArray[np.float64], xyz: NDArray[np.float64]
) -> NDArray[np.float64]:
    x, y, z = transform(invert(session.T_world_body) @ T_world_board, xyz).T
    return np.stack([-y / x * F + (SIZE_WH[0] - 1) / 2, -z / x * F + (SIZE_WH[1] - 1) / 2], -1)


def is_dark(config: BoardConfig, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.bool_]:
    """The pattern as it is drawn: hard edges, every circle asked."""
    u, v = x / config.square_m, y / config.square_m
    if config.kind == "chessboard":
        inside = (u >= -1) & (u < config.cols) & (v >= -1) & (v < config.rows)
        return np.asarray(inside & ((np.floor(u) + np.floor(v)) % 2 == 0))
    centres = Board.of(config).corners_m[:, :2] / config.square_m
    away = np.hypot(u[..., None] - centres[:, 0], v[..., None] - centres[:, 1])
    return np.asarray((away < RADIUS).any(-1))


@pytest.mark.parametrize("kind", KINDS)
def test_detected_corners_lie_where_the_truth_says(session: Session, kind: str) -> None:
    config = KINDS[kind]
    T = session.T_world_body @ pose(FACING, (0, 0, 0))
    middle = Board.of(config).outline_m()[4]
    T = T @ pose(cv2.Rodrigues(np.array([0.25, -0.3, 0.1]))[0], (0, 0, 1.6)) @ pose(np.eye(3), -middle)
    hits = with_board(session, config, T).cast(camera_rays(session.T_world_body))
    shade = np.where(np.isnan(hits.printed), 0.3, hits.printed).reshape(SIZE_WH[::-1])
    image, grid = (255 * shade).astype(np.uint8), (config.cols, config.rows)
    if kind == "chessboard":
        found, corners = cv2.findChessboardCornersSB(image, grid)
    else:
        found, corners = cv2.findCirclesGrid(image, grid, flags=cv2.CALIB_CB_ASYMMETRIC_GRID)
    assert found
    truth = pixels(session, T, Board.of(config).corners_m)
    seen = np.asarray(corners).reshape(-1, 2)
    error = min(np.abs(seen - truth).max(), np.abs(seen[::-1] - truth).max())
    assert error < 0.25


@pytest.mark.parametrize("kind", KINDS)
def test_pattern_is_the_mean_over_a_footprint(session: Session, kind: str) -> None:
    config, distance, footprint = KINDS[kind], 2.0, 0.006
    T = session.T_world_body @ pose(FACING, (distance, 0, 0))
    board, rng = Board.of(config), np.random.default_rng(0)
    x0, y0, x1, y1 = board.box_m
    x, y = rng.uniform(x0 + 0.02, x1 - 0.02, 400), rng.uniform(y0 + 0.02, y1 - 0.02, 400)
    way = transform(T, np.stack([x, y, 0 * x], -1)) - (T[:3, 3] - distance * T[:3, 2])
    start, r = T[:3, 3] - distance * T[:3, 2], np.linalg.norm(way, axis=1)
    rays = np.hstack([np.broadcast_to(start, way.shape), way / r[:, None]]).astype(np.float32)
    hits = with_board(session, config, T).cast(rays, footprint_rad=footprint)
    np.testing.assert_allclose(hits.range_m, r, rtol=1e-5)
    around = np.linspace(-0.5, 0.5, 41)
    wx, wy = (r * footprint * np.hypot(1, a / distance) for a in (x, y))
    gx, gy = (a[:, None] + b[:, None] * around for a, b in ((x, wx), (y, wy)))
    dark = is_dark(config, gx[:, :, None] + 0 * gy[:, None], gy[:, None] + 0 * gx[:, :, None]).mean((1, 2))
    expected = config.bright + dark * (config.dark - config.bright)
    tolerance = (
        0.04 if kind == "chessboard" else 0.16
    )  # a circle's rim is taken for straight, its spot for round
    np.testing.assert_allclose(hits.printed, expected, atol=tolerance)
    assert abs((hits.printed - expected).mean()) < 0.01


def test_the_nearer_wins(session: Session) -> None:
    rays = camera_rays(session.T_world_body)
    bare = session.room.cast(rays)
    ahead = session.T_world_body @ pose(FACING, (1.5, 0, 0))
    behind_rock = session.T_world_body @ pose(FACING, (80.0, 0, 0))
    seen = with_board(session, KINDS["chessboard"], ahead).cast(rays)
    on = ~np.isnan(seen.printed)
    assert 0.02 < on.mean() < 0.6
    np.testing.assert_array_equal(seen.range_m[~on], bare.range_m[~on])
    assert (seen.range_m[on] <= bare.range_m[on]).all()
    hidden = with_board(session, KINDS["chessboard"], behind_rock).cast(rays)
    assert np.isnan(hidden.printed).all()
    np.testing.assert_array_equal(hidden.range_m, bare.range_m)


def test_front_and_back_are_told_apart(session: Session) -> None:
    scene = with_board(session, KINDS["chessboard"], session.T_world_body @ pose(FACING, (1.5, 0.3, 0.2)))
    eye = session.T_world_body[:3, 3]
    rays = np.array([[*eye, 1, 0, 0], [eye[0] + 3, *eye[1:], -1, 0, 0]], np.float32)
    hits = scene.cast(rays)
    assert [scene.materials[k].name for k in hits.material] == ["board", "board back"]
    np.testing.assert_allclose(hits.range_m, 1.5, rtol=1e-6)
    np.testing.assert_allclose(hits.normal, [(-1, 0, 0), (1, 0, 0)], atol=1e-6)
    np.testing.assert_array_equal(np.isnan(hits.printed), [False, True])


def test_a_session_covers_places_distances_and_tilts(session: Session) -> None:
    T = invert(session.T_world_body) @ session.T_world_board
    middle = np.stack([transform(pose_k, session.board.outline_m()[4:])[0] for pose_k in T])
    away = np.linalg.norm(middle, axis=1)
    assert len(session) == 30
    assert away.min() < 1.4 < 3.0 < away.max() <= 4.0 + 1e-9
    tilt = np.rad2deg(np.arccos(T[:, 0, 2]))
    assert 20 < tilt.max() <= 38 + 1e-6
    azimuth = np.rad2deg(np.arctan2(middle[:, 1], middle[:, 0]))
    assert azimuth.min() < -10 < 10 < azimuth.max()
    rays = camera_rays(session.T_world_body)[::7]
    assert all((~np.isnan(session.scene(k).cast(rays).printed)).any() for k in range(0, 30, 6))


def test_corners_come_in_opencvs_order() -> None:
    chess, circles = (Board.of(config).corners_m for config in KINDS.values())
    np.testing.assert_allclose(chess[:10], [(0.08 * k, 0, 0) for k in range(9)] + [(0, 0.08, 0)])
    np.testing.assert_allclose(circles[:5] / 0.07, [(0, 0, 0), (2, 0, 0), (4, 0, 0), (6, 0, 0), (1, 1, 0)])


def test_a_seed_gives_the_same_session(session: Session) -> None:
    again = build_session(KINDS["chessboard"], 3, session.room)
    other = build_session(KINDS["chessboard"], 4, session.room)
    assert again.T_world_board.tobytes() == session.T_world_board.tobytes()
    assert np.abs(other.T_world_board - session.T_world_board).max() > 0.05


def test_a_board_that_does_not_fit_is_refused(session: Session) -> None:
    with pytest.raises(UsageError, match="does not fit"):
        build_session(BoardConfig(square_m=0.3, cols=20, rows=20), 3, session.room)
