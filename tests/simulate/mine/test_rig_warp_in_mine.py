"""Warping by depth in a simulated session: thermal lands on RGB, and what the board hides is masked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from small_worlds import Room, small

from fusion.codecs import decode_image
from fusion.geometry import Floats, invert, pose, transform
from fusion.kernels import index_counts
from fusion.rig_warp import DepthWarp, RigWarp
from fusion.simulate.mine import layout
from fusion.simulate.mine.board import Board, Session
from fusion.simulate.mine.scene_config import BoardConfig
from fusion.simulate.mine.session import make_session
from fusion.simulate.mine.truth import Truth

BOARD = BoardConfig(poses=2, square_m=0.07)
FACING = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float)
CONFIG = small(
    board=BOARD.model_dump(),
    dust={"particles": 0},
    rgb={"camera": {"size_wh": (400, 300)}, "shadows": False, "file": "png"},
    thermal={"camera": {"size_wh": (400, 320)}},
)
LARGEST_PX = 0.5


def held_at(turn: float, away_m: float) -> Floats:
    """T_world_board of a board turned about its upright axis, its middle straight ahead."""
    c, s = np.cos(turn), np.sin(turn)
    R = FACING @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return pose(R, np.array([away_m, -0.04, 0.02]) - R @ (0.28, 0.18, 0))


@pytest.fixture(scope="module")
def session() -> Session:
    room: Any = Room()
    return Session(room, Board.of(BOARD), np.eye(4), np.stack([held_at(0.2, 0.9), held_at(-0.3, 1.4)]))


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory, session: Session) -> Truth:
    out = tmp_path_factory.mktemp("mine") / "session"
    make_session(out, CONFIG, session=session)
    return Truth(out)


@pytest.fixture(scope="module")
def warp(truth: Truth) -> DepthWarp:
    return DepthWarp(truth.rig, (400, 320), (400, 300))


def corners(folder: Path, camera: str, stamp: int) -> Floats:
    rows = layout.read_rows(folder / "truth" / f"corners_{camera}.csv")
    return np.array([(float(r["u_px"]), float(r["v_px"])) for r in rows if int(r["stamp_ns"]) == stamp])


def at(field: Floats, uv: Floats) -> Floats:
    """A field H x W x 2 between its pixels."""
    u, v = uv.T
    return np.stack([map_coordinates(field[..., k], [v, u], order=1) for k in (0, 1)], -1)


@pytest.mark.parametrize("k", [0, 1])
def test_every_corner_is_sampled_where_the_thermal_camera_saw_it(
    truth: Truth, warp: DepthWarp, k: int
) -> None:
    stamp, seen_at = truth.stamps("rgb")[k], truth.stamps("fir")[k]
    uv, xy = corners(truth.folder, "rgb", stamp), corners(truth.folder, "fir", seen_at)
    off = np.linalg.norm(at(warp.positions(truth.depth_m("rgb", stamp)), uv) - xy, axis=1)
    assert off.max() < LARGEST_PX / 2  # depth comes in steps of 1/256 m
    wrong = RigWarp.fixed(truth.rig, (400, 320), (400, 300)).positions()
    assert np.linalg.norm(at(wrong, uv) - xy, axis=1).min() > 10  # what parallax would do


@pytest.mark.parametrize("k", [0, 1])
def test_the_warped_picture_shows_the_board_where_rgb_does(truth: Truth, warp: DepthWarp, k: int) -> None:
    """From the rendered thermal picture: its corners, found after the warp, against RGB's true ones."""
    stamp, seen_at = truth.stamps("rgb")[k], truth.stamps("fir")[k]
    path = truth.folder / "fir" / f"{seen_at}.png"
    counts = np.asarray(decode_image(path.read_bytes(), str(path)), np.uint16)
    index, _, _ = index_counts(counts, *np.percentile(counts, [50, 99.9]).tolist())
    warped = warp.apply(index, truth.depth_m("rgb", stamp))
    picture = np.where(warped.mask > 0, warped.index, np.uint8(0))
    found, where = cv2.findChessboardCornersSB(picture, (9, 6), flags=cv2.CALIB_CB_EXHAUSTIVE)
    assert found
    true = corners(truth.folder, "rgb", stamp)
    near = np.linalg.norm(np.reshape(where, (-1, 1, 2)) - true, axis=-1).min(axis=1)
    assert near.max() < LARGEST_PX
    assert np.median(near) < 0.2


@pytest.mark.parametrize("k", [0, 1])
def test_what_the_board_hides_is_masked(truth: Truth, warp: DepthWarp, session: Session, k: int) -> None:
    """Rays from the thermal camera to every RGB pixel's point decide: IoU 0.9, as the issue asks."""
    stamp, fir = truth.stamps("rgb")[k], truth.rig.camera("fir")
    depth, T_world_rgb = truth.depth_m("rgb", stamp), truth.pose("rgb", stamp)
    v, u = np.mgrid[:300, :400]
    rays = truth.rig.camera("rgb").unproject(np.stack([u.ravel(), v.ravel()], -1).astype(float))
    points = rays / rays[:, 2:] * depth.reshape(-1, 1)
    xy, ahead = fir.project(transform(truth.rig.pose("fir", "rgb"), points))
    inside = ahead & (xy >= 0).all(1) & (xy[:, 0] <= 399) & (xy[:, 1] <= 319)
    eye = (T_world_rgb @ truth.rig.pose("rgb", "fir"))[:3, 3]
    ways = transform(T_world_rgb, points) - eye
    far = np.linalg.norm(ways, axis=1)
    cast = np.concatenate([np.broadcast_to(eye, ways.shape), ways / far[:, None]], 1).astype(np.float32)
    hidden = (inside & (session.scene(k).cast(cast).range_m < 0.97 * far - 0.01)).reshape(300, 400)
    masked: NDArray[np.bool_] = inside.reshape(300, 400) & (
        warp.apply(np.zeros((320, 400), np.uint8), depth).mask == 0
    )
    assert hidden.sum() > 1000
    assert np.count_nonzero(masked & hidden) / np.count_nonzero(masked | hidden) >= 0.9


def test_the_pose_of_the_cameras_is_the_rigs(truth: Truth) -> None:
    """The oracle's own ground: T_world_rgb T_rgb_fir = T_world_fir."""
    for rgb, fir in zip(truth.stamps("rgb"), truth.stamps("fir"), strict=True):
        assert truth.pose("rgb", rgb) @ truth.rig.pose("rgb", "fir") == pytest.approx(truth.pose("fir", fir))
        assert invert(truth.pose("fir", fir)) @ truth.pose("rgb", rgb) == pytest.approx(
            truth.rig.pose("fir", "rgb")
        )
