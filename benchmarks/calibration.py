"""Calibration: a board found, everything solved, thermal laid on RGB from the scene; OpenCV beside it."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from table import Row, Section, at_most, milliseconds
from timing import Job, interleaved, repeated

from calib.align import align
from calib.boards import Board
from calib.detect.chessboard import find_chessboard
from calib.observations import Detection
from calib.scenes import Scene, perturbed, scene
from calib.solve import solve
from fusion.codecs import decode_image
from fusion.geometry import PinholeCamera, invert, pose, transform
from fusion.simulate.pairs import make_pairs

BOARD = Board.of("chessboard", 9, 6, 0.05)
CAMERA = PinholeCamera((640, 480), 520, 520, 319.5, 239.5)
T_CAM_BOARD = pose([[0.96, -0.05, 0.27], [0.09, 0.98, -0.15], [-0.26, 0.17, 0.95]], [-0.2, -0.13, 0.8])

TEXT = """\
The board is drawn at a slant in 640x480 with noise, and again in 16 bit with 12 counts of contrast on a glow
of thousands. OpenCV's is `findChessboardCornersSB`, exhaustive and accurate, on the 8-bit picture, where it
finds it; the 16-bit one is stretched to 8 bit for it. The solve has 30 poses, two cameras of 5 coefficients
and the LiDAR, from a start some per cent and degrees off; OpenCV's `stereoCalibrate`, both cameras free, has
no LiDAR, no outliers, no covariance. The pair is one of `fusion simulate pairs`."""


def measure(rounds: int) -> Section:
    sharp, faint = drawn()
    made = scene(0, 30)
    start = perturbed(made.truth, 0)
    rgb, fir = pair()
    jobs: dict[str, Job] = {
        "find": repeated(lambda: find_chessboard(sharp, BOARD), 5),
        "find faint": repeated(lambda: find_chessboard(faint, BOARD), 5),
        "opencv find": repeated(lambda: cv2.findChessboardCornersSB(sharp, (9, 6), flags=_FLAGS), 5),
        "solve": repeated(lambda: solve(made.board, made.views, made.clouds, start=start), 1),
        "opencv solve": repeated(_opencv(made), 1),
        "align": repeated(lambda: align([(rgb, fir)]), 1),
    }
    taken = interleaved(jobs, rounds)
    for image, name in ((sharp, "8 bit"), (faint, "16 bit")):
        if not isinstance(find_chessboard(image, BOARD), Detection):
            raise SystemExit(f"benchmark: no board found in the {name} picture")

    def against(what: str, name: str, other: str) -> Row:
        ratio = taken[other].over(taken[name])
        return Row(what, milliseconds(taken[name]), milliseconds(taken[other]), ratio)

    rows = [
        against("a chessboard found, 8 bit", "find", "opencv find"),
        Row(
            "the same, 16 bit, weak on a glow",
            milliseconds(taken["find faint"]),
            _theirs(faint),
            note="for information",
        ),
        against("30 poses solved", "solve", "opencv solve"),
        Row(
            "thermal laid on RGB, a pair", milliseconds(taken["align"]), "", taken["align"], at_most(5, " s")
        ),
        Row("the same, the goal", milliseconds(taken["align"]), "", taken["align"], at_most(2, " s")),
    ]
    return Section("Calibration", TEXT, ("ours", "OpenCV"), rows)


def _theirs(faint: NDArray[np.uint16]) -> str:
    """Whether OpenCV finds the board in the faint picture, stretched to 8 bit."""
    low, high = np.percentile(faint, (0.5, 99.5))
    stretched = np.clip((faint - low) / (high - low) * 255, 0, 255).astype(np.uint8)
    return "finds it" if cv2.findChessboardCornersSB(stretched, (9, 6), flags=_FLAGS)[0] else "finds none"


_FLAGS = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY


def drawn() -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """The board's squares averaged over 4 x 4 rays a pixel; 8 bit, and 16 bit faint on a glow."""
    w, h = CAMERA.size_wh
    u, v = np.meshgrid((np.arange(4 * w) + 0.5) / 4 - 0.5, (np.arange(4 * h) + 0.5) / 4 - 0.5)
    rays = CAMERA.unproject(np.stack([u.ravel(), v.ravel()], -1))
    normal, origin = T_CAM_BOARD[:3, 2], T_CAM_BOARD[:3, 3]
    away = (normal @ origin) / (rays @ normal)
    x, y, _ = transform(invert(T_CAM_BOARD), rays * away[:, None]).T / BOARD.spacing_m
    on = (x > -1) & (x < 9) & (y > -1) & (y < 6)
    dark = (np.floor(x) + np.floor(y)) % 2 == 0
    fine = np.where(on & dark, 0.0, 1.0).reshape(h, 4, w, 4).mean((1, 3)).reshape(h, w)
    fine = cv2.GaussianBlur(fine, (0, 0), 0.8)
    rng = np.random.default_rng(0)
    glow = 4000 * np.exp(-((np.arange(w) - 400.0) ** 2) / 9e4)[None] * np.ones((h, 1))
    faint = 7000 + glow + 12 * fine + rng.normal(0, 1.5, (h, w))
    sharp = 40 + 160 * fine + rng.normal(0, 3, (h, w))
    return np.clip(np.rint(sharp), 0, 255).astype(np.uint8), np.rint(faint).astype(np.uint16)


def pair() -> tuple[NDArray[Any], NDArray[Any]]:
    """A pair of `fusion simulate pairs`."""
    with tempfile.TemporaryDirectory() as name:
        make_pairs(Path(name), frames=1, seed=0)
        files = [next((Path(name) / role).iterdir()) for role in ("rgb", "fir")]
        rgb, fir = (decode_image(file.read_bytes(), str(file)) for file in files)
    return rgb, fir


def _opencv(made: Scene) -> Callable[[], object]:
    points: list[Any] = []
    uv: dict[str, list[Any]] = {"rgb": [], "fir": []}
    moments = {name: {v.moment: v for v in made.views if v.camera == name} for name in uv}
    for moment in sorted(set(moments["rgb"]) & set(moments["fir"])):
        views = {name: moments[name][moment] for name in uv}
        ids = np.intersect1d(views["rgb"].ids, views["fir"].ids)
        points.append(made.board.points_m[ids].astype(np.float32))
        for name, view in views.items():
            uv[name].append(view.uv[np.searchsorted(view.ids, ids)].astype(np.float32))
    K = {name: np.diag([500.0, 500.0, 1.0]) for name in uv}
    for name in uv:
        K[name][:2, 2] = np.array(made.truth.cameras[name].size_wh) / 2

    def solved() -> object:
        flags = cv2.CALIB_USE_INTRINSIC_GUESS
        guesses = [a for name in uv for a in (K[name].copy(), np.zeros(5))]
        return cv2.stereoCalibrate(points, uv["rgb"], uv["fir"], *guesses, (640, 480), flags=flags)  # type: ignore[call-overload]

    return solved
