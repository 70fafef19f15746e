"""Agreement with mrcal (https://mrcal.secretsauce.net) on the same corners, where a Python that has it is
named."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.boards import Board
from calib.evidence.uncertainty import sensitivity
from calib.intrinsics import calibrate_camera
from calib.observations import View
from fusion.geometry import Floats, PinholeCamera, pose, transform

TRUTH = PinholeCamera((640, 480), 520, 522, 322, 238, (-0.2, 0.05, 0.0004, -0.0003, 0.0))
PLACES_PX = np.array([[320, 240], [160, 120], [60, 60], [580, 420.0]])
AWAY_M, NOISE_PX, VIEWS = 0.65, 0.1, 40


def scene() -> tuple[Board, list[View], list[Floats]]:
    """Views of a board that fills the image, with noise, and where the board truly was."""
    board, rng = Board.of("chessboard", 9, 6, 0.04), np.random.default_rng(3)
    views: list[View] = []
    poses: list[Floats] = []
    while len(views) < VIEWS:
        R = Rotation.from_euler("xyz", rng.uniform(-35, 35, 3), degrees=True).as_matrix()
        ray = TRUTH.unproject(rng.uniform((100, 80), (540, 400))[None])[0]
        T = pose(R, ray / ray[2] * rng.uniform(0.4, 0.9) - R @ board.points_m.mean(0))
        uv, seen = TRUTH.project(transform(T, board.points_m))
        if seen.all() and (uv > 0).all() and (uv < (639, 479)).all():
            noisy = uv + rng.normal(0, NOISE_PX, uv.shape)
            views.append(View("rgb", str(len(views)), np.arange(54), noisy, (640, 480)))
            poses.append(T)
    return board, views, poses


def ask_mrcal(tmp_path: Path, board: Board, views: list[View], poses: list[Floats], at_m: Floats) -> dict:
    """mrcal's answer. Skips where no Python with it is named."""
    python = os.environ.get("FUSION_MRCAL_PYTHON", "")
    if not python:
        pytest.skip("FUSION_MRCAL_PYTHON names no Python that has mrcal (3.12 or newer)")
    uv = np.stack([view.uv.reshape(board.rows, board.cols, 2) for view in views])
    start = np.stack([np.r_[Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]] for T in poses])
    np.savez(
        tmp_path / "views.npz",
        uv=uv,
        spacing_m=board.spacing_m,
        size_wh=np.array((640, 480)),
        start=np.array([500, 500, 319.5, 239.5]),
        pose=start,
        at=at_m,
    )
    oracle = Path(__file__).with_name("mrcal_oracle.py")
    command = [python, str(oracle), str(tmp_path / "views.npz"), str(tmp_path / "answer.json")]
    subprocess.run(command, check=True, timeout=300, capture_output=True)
    return json.loads((tmp_path / "answer.json").read_text())


def test_agreement_with_mrcal(tmp_path: Path) -> None:
    """Focal lengths within 0.1 %, coefficients within their noise, projection uncertainty within a tenth."""
    board, views, poses = scene()
    at_m = TRUTH.unproject(PLACES_PX) * AWAY_M
    theirs = ask_mrcal(tmp_path, board, views, poses, at_m)
    solution = calibrate_camera(board, views)
    ours = solution.estimate.cameras["rgb"]
    assert np.allclose([ours.fx, ours.fy], theirs["intrinsics"][:2], rtol=1e-3)
    assert np.allclose([ours.cx, ours.cy], theirs["intrinsics"][2:4], atol=0.2)
    found = sensitivity(board, solution, "rgb", at_m).covariance_px2(solution.covariance)
    ours_px, theirs_px = (
        np.sqrt(np.linalg.eigvalsh(c)[:, -1]) for c in (found, np.array(theirs["covariance"]))
    )
    assert ours_px == pytest.approx(theirs_px, rel=0.1)
