"""Cameras that turn together, drawn: known motion, known clocks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.timing.motion import Floats, Motion

Path = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Clock:
    """own = true * (1 + drift) + offset, as in the mine's truth/clocks.toml."""

    offset_s: float = 0.0
    drift: float = 0.0

    def stamps(self, true_s: Floats) -> NDArray[np.int64]:
        return 1_700_000_000 * 10**9 + np.rint((true_s * (1 + self.drift) + self.offset_s) * 1e9).astype(
            np.int64
        )

    def to_true_ns(self, stamp_ns: int) -> int:
        """What has to be added to a stamp to give true time, on the stamps' epoch."""
        own_s = (stamp_ns - 1_700_000_000 * 10**9) * 1e-9
        return round(((own_s - self.offset_s) / (1 + self.drift) - own_s) * 1e9)


def wobble(seed: int, size_px: float = 6.0) -> Path:
    """A way in x and y that never repeats: true seconds (N,) to pixels (N, 2)."""
    rng = np.random.default_rng(seed)
    hz, phase = rng.uniform(0.15, 2.2, (12, 2)), rng.uniform(0, 2 * np.pi, (12, 2))
    size = size_px * rng.uniform(0.5, 1.0, (12, 2)) / (1 + 2 * hz)
    return lambda t: (size * np.sin(2 * np.pi * hz * t[:, None, None] + phase)).sum(1)


def times(rate_hz: float, length_s: float, first_s: float = 0.1) -> Floats:
    return first_s + np.arange(int((length_s - first_s) * rate_hz), dtype=np.float64) / rate_hz


def motion(path: Path, true_s: Floats, clock: Clock, noise_px: float = 0.1, seed: int = 0) -> Motion:
    rng = np.random.default_rng(seed)
    shift = np.diff(path(true_s), axis=0)
    return Motion(clock.stamps(true_s), shift + rng.normal(0, noise_px, shift.shape))


def pictures(
    path: Path, true_s: Floats, seed: int, *, thermal: bool, size_wh: tuple[int, int] = (128, 96)
) -> Iterator[NDArray[np.uint8] | NDArray[np.uint16]]:
    """What a camera sees that looks at a wall: BGR with changing exposure, or counts with noise and a
    pattern.
    """
    rng = np.random.default_rng(seed)
    wall = cv2.GaussianBlur(rng.standard_normal((400, 400)).astype(np.float32), (0, 0), 2.5)
    wall /= wall.std()
    w, h = size_wh
    pattern = rng.normal(0, 0.7, (h, w)).astype(np.float32)
    for k, (x, y) in enumerate(path(true_s)):
        M = np.array([[1, 0, 120 + x], [0, 1, 120 + y]], np.float64)
        view = cv2.warpAffine(wall, M, size_wh, flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)
        noise = rng.standard_normal((h, w)).astype(np.float32)
        if thermal:
            yield np.rint(7200 + 40 * view + 1.2 * noise + pattern).astype(np.uint16)
        else:
            exposure = 1 + 0.5 * np.sin(k / 17)
            grey = np.clip(exposure * (80 + 25 * view) + 2 * noise, 0, 255).astype(np.uint8)
            yield np.repeat(grey[..., None], 3, 2)
