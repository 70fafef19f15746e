"""Periodic noise that surfaces and air look up by position: made once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.int8]
STEPS = 40  # steps of one standard deviation
TILE = 512
VOLUME = 64


@dataclass(frozen=True, slots=True)
class Tile:
    """Blasted rock: `samples` (N x 4 float32) are slope along u, slope along v, albedo and stain of all
    levels.

    `levels` (L x 2 int64) says where each level (half the side of the one before) begins, and its side.
    """

    samples: NDArray[np.float32]
    levels: NDArray[np.int64]


def rock_tile(rng: np.random.Generator, side: int = TILE) -> Tile:
    """A tile of unit deviation in each channel; `side` is a power of two."""
    height = fractal(rng, (side, side), 1.75) - 0.8 * np.abs(fractal(rng, (side, side), 1.5))
    grain = fractal(rng, (side, side), 0.9)
    relief = height + 0.012 * grain
    slope_u = np.roll(relief, -1, 0) - np.roll(relief, 1, 0)
    slope_v = np.roll(relief, -1, 1) - np.roll(relief, 1, 1)
    hollow = relief - sum(np.roll(relief, step, axis) for axis in (0, 1) for step in (-3, 3)) / 4
    albedo = fractal(rng, (side, side), 1.1) + 0.8 * _standard(hollow)
    stain = fractal(rng, (side, side), 1.8)
    top = np.stack([_standard(a) for a in (slope_u, slope_v, albedo, stain)], -1)
    parts, levels, first = [], [], 0
    while len(top) >= 2:
        parts.append(top.astype(np.float32).reshape(-1, 4))
        levels.append((first, len(top)))
        first += len(top) ** 2
        top = top.reshape(len(top) // 2, 2, len(top) // 2, 2, 4).mean((1, 3))
    return Tile(np.concatenate(parts), np.array(levels, np.int64))


def cloud_volume(rng: np.random.Generator, side: int = VOLUME) -> Bytes:
    """A cube of smooth noise of unit deviation, some eight cells from crest to crest and finer."""
    return _bytes(fractal(rng, (side,) * 3, 2.6, longest=8))


def fractal(
    rng: np.random.Generator, shape: tuple[int, ...], falloff: float, longest: float = 2.0
) -> NDArray[np.float64]:
    """Periodic noise whose amplitudes fall as frequency^-falloff, unit deviation; nothing below
    side/`longest`.
    """
    spectrum = np.fft.rfftn(rng.standard_normal(shape))
    axes = [np.fft.fftfreq(n) * n for n in shape[:-1]] + [np.fft.rfftfreq(shape[-1]) * shape[-1]]
    frequency = np.sqrt(sum(axis**2 for axis in np.meshgrid(*axes, indexing="ij")))
    shaped = spectrum * np.maximum(frequency, longest) ** -falloff * (frequency >= longest / 2)
    return _standard(np.fft.irfftn(shaped, shape, axes=range(len(shape))))


def _standard(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return (values - values.mean()) / values.std()


def _bytes(values: NDArray[np.float64]) -> Bytes:
    return np.clip(np.rint(values * STEPS), -127, 127).astype(np.int8)
