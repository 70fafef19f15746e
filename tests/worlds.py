"""Small pairs of images on disk for the tests of whole runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def textured(rng: np.random.Generator, width: int, height: int) -> NDArray[np.float64]:
    """A smooth random field in [0, 1], H x W."""
    coarse = rng.random((height // 8 + 2, width // 8 + 2))
    field = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(np.asarray(field, np.float64), 0, 1)


def write_pairs(
    folder: Path,
    count: int = 6,
    *,
    rgb_size_wh: tuple[int, int] = (64, 48),
    fir_size_wh: tuple[int, int] = (64, 48),
    bits: int = 8,
    suffix: str = ".png",
    seed: int = 0,
) -> tuple[Path, Path]:
    """Write `count` pairs into folder/rgb and folder/fir (same stems) and return both folders."""
    rng = np.random.default_rng(seed)
    rgb, fir = folder / "rgb", folder / "fir"
    rgb.mkdir(parents=True)
    fir.mkdir()
    for index in range(count):
        bgr = np.dstack([textured(rng, *rgb_size_wh) for _ in range(3)])
        heat = textured(rng, *fir_size_wh)
        counts = (heat * 255).astype(np.uint8) if bits == 8 else (7000 + heat * 400).astype(np.uint16)
        write(rgb / f"f{index:03d}{suffix}", (bgr * 255).astype(np.uint8))
        write(fir / f"f{index:03d}.png", counts)
    return rgb, fir


def write(path: Path, pixels: NDArray[Any]) -> Path:
    assert cv2.imwrite(str(path), np.asarray(pixels)), path
    return path


def read(path: Path) -> NDArray[Any]:
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None, path
    return np.asarray(pixels)


def tree(folder: Path) -> dict[str, bytes]:
    """Every file below a folder by its relative name: what two runs are compared by."""
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()
    }
