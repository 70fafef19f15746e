"""A calibration session: what a detector finds in the pictures is where the truth says that corners are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from small_worlds import Room, small

from calib.boards import load_board
from fusion.clouds import read_cloud
from fusion.codecs import decode_image
from fusion.errors import OutputError
from fusion.geometry import invert, pose, transform
from fusion.simulate.mine import layout
from fusion.simulate.mine.board import Board, Session
from fusion.simulate.mine.scene_config import BoardConfig
from fusion.simulate.mine.session import make_session
from fusion.simulate.mine.truth import Truth

BOARD = BoardConfig(poses=2)
FACING = np.array(
    [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float
)  # the board's x is the world's -y, its z the world's x
CONFIG = small(
    board=BOARD.model_dump(),
    dust={"particles": 0},
    rgb={"camera": {"size_wh": (400, 300)}, "shadows": False, "file": "png"},
    thermal={"camera": {"size_wh": (400, 320)}},
    lidar={"rings": 32, "columns": 1024},
)


def held_at(turn: float, away_m: float) -> NDArray[np.float64]:
    """T_world_board of a board turned about its upright axis, its middle straight ahead of the sensors."""
    c, s = np.cos(turn), np.sin(turn)
    R = FACING @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return pose(R, np.array([away_m, -0.04, 0.02]) - R @ (0.32, 0.20, 0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("mine") / "session"
    room: Any = Room()
    held = [held_at(0.2, 1.4), held_at(-0.3, 1.6)]
    report = make_session(out, CONFIG, session=Session(room, Board.of(BOARD), np.eye(4), np.stack(held)))
    assert (report.rgb, report.fir, report.lidar) == (2, 2, 2)
    return out


def grey(path: Path) -> NDArray[np.uint8]:
    pixels: Any = decode_image(path.read_bytes(), str(path))
    if pixels.ndim == 3:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), np.uint8)
    lo, hi = np.percentile(pixels, [50, 99.9])
    return np.clip((pixels - lo) / (hi - lo) * 255, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("camera", ["rgb", "fir"])
def test_detected_corners_are_the_true_ones(folder: Path, camera: str) -> None:
    rows = layout.read_rows(folder / "truth" / f"corners_{camera}.csv")
    assert len(rows) == 2 * 54
    for stamp in Truth(folder).stamps(camera):
        true = np.array([(float(r["u_px"]), float(r["v_px"])) for r in rows if int(r["stamp_ns"]) == stamp])
        image = grey(folder / camera / f"{stamp}.png")
        found, corners = cv2.findChessboardCornersSB(image, (9, 6), flags=cv2.CALIB_CB_EXHAUSTIVE)
        assert found
        uv = np.asarray(corners).reshape(-1, 2)
        error = min(np.abs(uv - true).mean(), np.abs(uv[::-1] - true).mean())
        assert error < 0.15
        assert all(r["seen"] == "1" for r in rows)


def test_scan_hits_the_board(folder: Path) -> None:
    truth = Truth(folder)
    times, boards = layout.read_tum(folder / "truth" / "poses_board.tum")
    for stamp, t, T_world_board in zip(truth.stamps("lidar"), times, boards, strict=True):
        assert truth.true_s("lidar", stamp) == t
        cloud = read_cloud(folder / f"lidar/{stamp}.pcd")
        T_board_lidar = invert(T_world_board) @ truth.pose("lidar", stamp)
        xyz = transform(T_board_lidar, cloud.xyz_m)
        on = (xyz[:, :2] > 0).all(1) & (xyz[:, 0] < 0.64) & (xyz[:, 1] < 0.40) & (np.abs(xyz[:, 2]) < 0.2)
        assert on.sum() > 200
        sigma = CONFIG.lidar.range_noise_m
        assert abs(xyz[on, 2].mean()) < 4 * sigma / np.sqrt(on.sum())
        assert xyz[on, 2].std() < 1.2 * sigma


def test_used_folder_is_refused(folder: Path) -> None:
    with pytest.raises(OutputError, match="not empty"):
        make_session(folder, CONFIG)


@pytest.mark.parametrize("config", [BOARD, BoardConfig.circles()], ids=lambda config: config.kind)
def test_board_is_written_as_calibration_takes_it(config: BoardConfig, tmp_path: Path) -> None:
    held = Board.of(config)
    session = Session(Room(), held, np.eye(4), held_at(0.0, 1.4)[None])  # type: ignore[arg-type]
    make_session(tmp_path / "session", CONFIG, session=session)
    board = load_board(tmp_path / "session" / "truth" / "board.toml")
    np.testing.assert_allclose(board.points_m, held.corners_m, atol=1e-12)
    np.testing.assert_allclose(board.plate_m or (), held.box_m, atol=1e-9)
