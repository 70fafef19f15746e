"""`fusion calibrate align` as a user meets it: a known map found, strangers refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fusion.registration import read_homography
from tests.cli.conftest import Answer
from tests.cli.test_blend_command import one_line
from tests.worlds import read, tree, write

Fusion = Callable[..., Answer]


def painted(seed: int) -> tuple[Any, Any]:
    """A flat world of polygons, its light and its heat; W 260, H 200."""
    rng = np.random.default_rng(seed)
    light, heat = np.full((200, 260), 90, np.uint8), np.full((200, 260), 120, np.uint8)
    for _ in range(45):
        middle, radius = rng.uniform([0, 0], [260, 200]), rng.uniform(8, 30)
        turns = np.sort(rng.uniform(0, 2 * np.pi, 4))
        ring = (middle + radius * np.stack([np.cos(turns), np.sin(turns)], 1)).round().astype(np.int32)
        for image in (light, heat):
            cv2.fillPoly(image, [ring], int(rng.integers(0, 256)))
    return light, heat


H_RGB_FIR = np.array([[1.08, -0.03, 9.0], [0.02, 1.1, 6.0], [0, 0, 1]])


def write_unaligned(folder: Path, light_seed: int, heat_seed: int) -> tuple[Path, Path]:
    light, heat = painted(light_seed)[0], painted(heat_seed)[1]
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    seen = np.asarray(cv2.warpPerspective(heat, H_RGB_FIR, (220, 170), flags=flags), float)
    noise = np.random.default_rng(light_seed).normal(0, 9, seen.shape)
    rgb = write(folder / "rgb.png", np.repeat(light[..., None], 3, 2))
    return rgb, write(folder / "fir.png", (8000 + 3 * (255 - seen) + noise).astype(np.uint16))


def test_align_finds_a_known_map(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_unaligned(tmp_path, 0, 0)
    out = tmp_path / "H.toml"
    answer = fusion("calibrate", "align", rgb, fir, "-o", out)
    assert answer.code == 0, answer.err
    assert "H.jpg written: look at the picture" in answer.out
    corners = np.array([[0, 0, 1], [219, 0, 1], [0, 169, 1], [219, 169, 1]], float)
    there, truth = (
        (p := corners @ H.T)[:, :2] / p[:, 2:] for H in (read_homography(out).H_rgb_fir, H_RGB_FIR)
    )
    assert np.abs(there - truth).max() < 1.5
    assert read(tmp_path / "H.jpg").ndim == 3
    before = tree(tmp_path)
    one_line(fusion("calibrate", "align", rgb, fir, "-o", out), "is there already", code=1)
    assert tree(tmp_path) == before
    fused = fusion("blend", rgb, fir, "-o", tmp_path / "out", "--homography", out, "--quiet")
    assert fused.code == 0, fused.err


def test_align_refuses_strangers(fusion: Fusion, tmp_path: Path) -> None:
    """Exit code, reason, picture; no homography."""
    rgb, fir = write_unaligned(tmp_path, 1, 2)
    answer = fusion("calibrate", "align", rgb, fir, "-o", tmp_path / "H.toml", "--quiet")
    one_line(answer, "cannot be laid onto RGB", "H.jpg", code=1)
    assert sorted(tree(tmp_path)) == ["H.jpg", "fir.png", "rgb.png"]


def test_align_options_that_cannot_be(fusion: Fusion, tmp_path: Path) -> None:
    rgb, fir = write_unaligned(tmp_path, 1, 1)
    before = tree(tmp_path)
    for options, word in (
        (["--frames", 0], "--frames"), (["--model", "spline"], "affine"), (["--matcher", "wurst"], "wurst"),
    ):  # fmt: skip
        one_line(fusion("calibrate", "align", rgb, fir, "-o", tmp_path / "H.toml", *options), word, code=2)
    one_line(fusion("calibrate", "align", rgb, fir, "-o", tmp_path), "is a folder")
    one_line(fusion("calibrate", "align", rgb, tmp_path / "no", "-o", tmp_path / "H.toml"), "no such file")
    assert tree(tmp_path) == before
