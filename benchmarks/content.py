"""Test images with texture and noise, the same on every machine, and folders full of them.

A frame is a smooth random field (three octaves: structure at every scale) with Gaussian noise as a sensor
adds it. Without the noise every PNG encoder looks better than it is.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

RGB_NOISE, FIR_NOISE_8, FIR_NOISE_16 = 3.5, 1.5, 4.0  # standard deviations, in counts
OCTAVES = ((96, 0.6), (24, 0.3), (6, 0.1))  # (pixels a cell, weight)
WINDOW = {8: (60, 190), 16: (7050, 7350)}  # counts; cuts a few percent off either end
SEED = 20200601


@dataclass(frozen=True, slots=True)
class Case:
    """One kind of pair: image size (both cameras), bits of a thermal count."""

    size_wh: tuple[int, int]
    bits: int

    @property
    def name(self) -> str:
        return f"{self.size_wh[0]}x{self.size_wh[1]}, {self.bits}-bit thermal"

    @property
    def window(self) -> tuple[int, int]:
        return WINDOW[self.bits]


VGA, SXGA = (640, 480), (1280, 1024)
CASES = tuple(Case(size, bits) for size in (VGA, SXGA) for bits in (8, 16))


def smooth_field(rng: np.random.Generator, size_wh: tuple[int, int]) -> NDArray[np.float32]:
    """H x W float32 in about [0, 1]: random grids of three cell sizes, interpolated and added."""
    width, height = size_wh
    field = np.zeros((height, width), np.float32)
    for cell, weight in OCTAVES:
        grid = rng.random((height // cell + 2, width // cell + 2), dtype=np.float32)
        field += weight * cv2.resize(grid, size_wh, interpolation=cv2.INTER_CUBIC)
    return field


def rgb_frame(rng: np.random.Generator, size_wh: tuple[int, int]) -> NDArray[np.uint8]:
    """H x W x 3 BGR uint8: one brightness field, a little colour, noise in every channel."""
    light = smooth_field(rng, size_wh)
    colour = [0.75 * light + 0.25 * smooth_field(rng, size_wh) for _ in range(3)]
    noisy = 20 + 210 * np.dstack(colour) + _noise(rng, (*size_wh[::-1], 3), RGB_NOISE)
    return np.rint(np.clip(noisy, 0, 255)).astype(np.uint8)


def fir_frame(rng: np.random.Generator, case: Case) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """H x W counts: 8 bit over most of the range, or 16 bit in the few hundred counts a room spans."""
    heat = smooth_field(rng, case.size_wh)
    if case.bits == 8:
        noisy = 30 + 190 * heat + _noise(rng, heat.shape, FIR_NOISE_8)
        return np.rint(np.clip(noisy, 0, 255)).astype(np.uint8)
    noisy = 7000 + 400 * heat + _noise(rng, heat.shape, FIR_NOISE_16)
    return np.rint(np.clip(noisy, 0, 65535)).astype(np.uint16)


def pairs_of(
    case: Case, count: int
) -> list[tuple[NDArray[np.uint8], NDArray[np.uint8] | NDArray[np.uint16]]]:
    """`count` different pairs (BGR, counts), always the same ones."""
    rng = np.random.default_rng([SEED, *case.size_wh, case.bits])
    return [(rgb_frame(rng, case.size_wh), fir_frame(rng, case)) for _ in range(count)]


def write_folder(folder: Path, case: Case, distinct: int, count: int, suffix: str = ".png") -> None:
    """`count` pairs, folder/rgb/000000.png and folder/fir/000000.png: `distinct` ones, repeated as links.

    PNG as `cv2.imwrite` writes it by default; JPEG with quality 92 (grey for thermal).
    """
    for name in ("rgb", "fir"):
        (folder / name).mkdir(parents=True)
    for index, pair in enumerate(pairs_of(case, distinct)):
        for name, pixels in zip(("rgb", "fir"), pair, strict=True):
            path = folder / name / f"{index:06d}{suffix}"
            options = [cv2.IMWRITE_JPEG_QUALITY, 92] if suffix == ".jpg" else []
            if not cv2.imwrite(str(path), pixels, options):
                raise OSError(f"{path} cannot be written")
    for index in range(distinct, count):
        for name in ("rgb", "fir"):
            first = folder / name / f"{index % distinct:06d}{suffix}"
            os.link(first, folder / name / f"{index:06d}{suffix}")


def _noise(rng: np.random.Generator, shape: tuple[int, ...], sigma: float) -> NDArray[np.float32]:
    return sigma * rng.standard_normal(shape, dtype=np.float32)
