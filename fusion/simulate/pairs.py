"""A small synthetic sequence of unregistered RGB and 16-bit thermal pairs, with the truth beside it.

The world is one picture plane, painted as the view down a mine drift: a **planar 2-D world**. Every
camera sees that plane through a 3x3 homography, so the homography between the two cameras is the exact
truth at every pixel; there is no parallax anywhere. Nothing here says anything about depth.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tomlkit
from numpy.typing import NDArray

from fusion.errors import OutputError, UsageError
from fusion.simulate.drift import (
    AMBIENT_DEGC,
    MARGIN,
    PERSON_DEGC,
    PERSON_EMISSIVITY,
    ZERO_DEGC_KELVIN,
    Floats,
    Patch,
    Size,
    fractal,
    lay_over,
    paint_drift,
    paint_person,
    texture_px,
)

Matrix = NDArray[np.float64]

FORMAT = "fusion-pairs-truth/1"
KELVIN_PER_COUNT = 0.04
MAX_COUNT = 2**14 - 1
NETD_KELVIN = 0.05
DRIFT_KELVIN = 1.5
FRAME_PERIOD_NS = 100_000_000
POINT_NOISE_PX = 0.4
SIZE_LIMITS = (96, 2048)
MAX_FRAMES = 1_000_000

_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
        cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP)  # fmt: skip


@dataclass(frozen=True, slots=True)
class PairsTruth:
    """What is exactly true of a simulated sequence.

    `H_rgb_fir` is 3x3 float64 and takes thermal pixel coordinates to RGB pixel coordinates, the same for
    all frames. `stamps_ns` are int nanoseconds, one a frame, common to both cameras. `outliers` are the
    0-based rows of points.csv that are gross errors. degC = count * `kelvin_per_count` - 273.15, after
    the level error of the frame, `level_kelvin`, is taken off.
    """

    H_rgb_fir: Matrix
    rgb_size_wh: Size
    fir_size_wh: Size
    seed: int
    stamps_ns: tuple[int, ...]
    outliers: tuple[int, ...]
    level_kelvin: tuple[float, ...]
    kelvin_per_count: float = KELVIN_PER_COUNT

    def toml(self) -> str:
        """The text of truth.toml."""
        table = tomlkit.document()
        table["format"] = FORMAT
        table["H_rgb_fir"] = self.H_rgb_fir.tolist()
        table["rgb_size_wh"], table["fir_size_wh"] = list(self.rgb_size_wh), list(self.fir_size_wh)
        table["seed"] = self.seed
        table["kelvin_per_count"], table["zero_count_degC"] = self.kelvin_per_count, -ZERO_DEGC_KELVIN
        table["person_degC"], table["person_emissivity"] = PERSON_DEGC, PERSON_EMISSIVITY
        table["ambient_degC"] = AMBIENT_DEGC
        table["outliers"] = list(self.outliers)
        table["stamps_ns"] = list(self.stamps_ns)
        table["level_kelvin"] = [round(v, 6) for v in self.level_kelvin]
        return tomlkit.dumps(table)


def make_pairs(
    out: Path,
    *,
    frames: int = 12,
    rgb_size_wh: Size = (640, 480),
    fir_size_wh: Size = (640, 512),
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> PairsTruth:
    """Write `frames` pairs, hand-picked-like correspondences and the truth into the folder `out`.

    rgb/rgb_000000.png is 8-bit BGR, fir/fir_000000.png uint16 counts of 0.04 K from 0 K. points.csv has
    rgb_x, rgb_y, fir_x, fir_y in pixels; truth.toml is written last. The same arguments give the same
    bytes. `progress(done, frames)` is called after each pair. Raises `UsageError` for sizes and counts
    that cannot be, `OutputError` where `out` holds such files already or cannot be written.
    """
    scene = Scene(frames=frames, rgb_size_wh=rgb_size_wh, fir_size_wh=fir_size_wh, seed=seed)
    _claim(out)
    points, outliers = scene.picked_points()
    for index in range(frames):
        _write(out / "rgb" / f"rgb_{index:06d}.png", _png(scene.bgr(index)))
        _write(out / "fir" / f"fir_{index:06d}.png", _png(scene.counts(index)))
        if progress is not None:
            progress(index + 1, frames)
    rows = "".join(",".join(f"{v:.2f}" for v in row) + "\n" for row in points)
    _write(out / "points.csv", ("rgb_x,rgb_y,fir_x,fir_y\n" + rows).encode())
    stamps = tuple(index * FRAME_PERIOD_NS for index in range(frames))
    levels = tuple(scene.level_kelvin(index) for index in range(frames))
    truth = PairsTruth(scene.H_rgb_fir, rgb_size_wh, fir_size_wh, seed, stamps, outliers, levels)
    _write(out / "truth.toml", truth.toml().encode())
    return truth


class Scene:
    """The painted drift and the two cameras. Frames are computed on demand; nothing of them is kept.

    Every frame draws from its own random stream, so frames may be asked for in any order.
    """

    def __init__(self, *, frames: int, rgb_size_wh: Size, fir_size_wh: Size, seed: int) -> None:
        _check(frames, rgb_size_wh, fir_size_wh, seed)
        self.frames, self.seed = frames, seed
        self.rgb_size_wh, self.fir_size_wh = rgb_size_wh, fir_size_wh
        self.H_rgb_fir = _between_cameras(rgb_size_wh, fir_size_wh, self._rng(0))
        self._bgr, self._degC = paint_drift(rgb_size_wh, self._rng(1))
        self._dust = 0.5 + 0.25 * fractal(self._rng(2), texture_px(rgb_size_wh), 1.5)
        self._fixed_pattern = _fixed_pattern(fir_size_wh, self._rng(3))
        self._sway = self._rng(4).uniform(0, 2 * np.pi, 6)
        self._dead = self._rng(5).integers(0, fir_size_wh[::-1], (4, 2))

    def _rng(self, *key: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))

    def homography_rgb_world(self, index: int) -> Matrix:
        """3x3 float64, painted plane to RGB pixels in frame `index`: slow sway plus hand shake."""
        w, h = self.rgb_size_wh
        t = index * FRAME_PERIOD_NS * 1e-9
        slow = np.sin(2 * np.pi * t / np.array([4.1, 3.3, 6.7, 5.3, 7.1, 5.9]) + self._sway)
        shake = np.clip(self._rng(6, index).normal(size=6), -2.5, 2.5)
        move = slow * (0.022, 0.016, 0.6, 0.02, 0.008, 0.008)
        move += shake * (0.002, 0.002, 0.08, 0.001, 0.001, 0.001)
        rest = np.array([[1, 0, -MARGIN * w], [0, 1, -MARGIN * h], [0, 0, 1]])
        return _about_centre((w, h), move[0] * w, move[1] * h, move[2], 1.02 + move[3], move[4:]) @ rest

    def bgr(self, index: int) -> NDArray[np.uint8]:
        """The RGB camera's frame, H x W x 3 uint8 BGR: lamp, dust, shot and read noise, gamma."""
        person = self._person(index)
        world = lay_over(self._bgr, person, person.bgr)
        view = cv2.warpPerspective(world, self.homography_rgb_world(index), self.rgb_size_wh)
        light = self._lamp(index)
        dust = self._dust_seen(index) * (0.15 + 0.85 * light)
        airlight = dust[..., None] * np.array([0.022, 0.026, 0.028], np.float32)
        electrons = np.maximum((view * light[..., None] + airlight) * 4000, 0)
        noise = self._rng(7, index).standard_normal(electrons.shape, dtype=np.float32)
        electrons = np.maximum(electrons + noise * np.sqrt(electrons + 6.0**2), 0)
        return np.rint(255 * np.minimum(electrons / 4000, 1) ** np.float32(1 / 2.2)).astype(np.uint8)

    def counts(self, index: int) -> NDArray[np.uint16]:
        """The thermal camera's frame, H x W uint16 counts: apparent temperature plus its errors."""
        noise = self._rng(8, index).standard_normal(self.fir_size_wh[::-1], dtype=np.float32) * NETD_KELVIN
        degC = self.thermal_view(index) + self.level_kelvin(index) + self._fixed_pattern + noise
        counts = np.rint((degC + ZERO_DEGC_KELVIN) / KELVIN_PER_COUNT).clip(0, MAX_COUNT).astype(np.uint16)
        counts[tuple(self._dead.T)] = [6000, 6000, 9500, 9500]
        return counts

    def thermal_view(self, index: int) -> Floats:
        """What a thermal camera without errors sees: H x W float32 degrees Celsius, thermal grid."""
        person = self._person(index)
        world = lay_over(self._degC, person, person.apparent_degC)
        H_fir_world = np.linalg.inv(self.H_rgb_fir) @ self.homography_rgb_world(index)
        seen = cv2.warpPerspective(world, H_fir_world, self.fir_size_wh)
        return np.asarray(cv2.GaussianBlur(seen, (0, 0), 0.7), np.float32)

    def level_kelvin(self, index: int) -> float:
        """The thermal camera's slow error of level: 0 at the first frame, 1.5 K at the last."""
        done = index / max(self.frames - 1, 1)
        return float(DRIFT_KELVIN * done + 0.2 * np.sin(3 * np.pi * done))

    def person_mask(self, index: int) -> NDArray[np.bool_]:
        """Where the person stands in the RGB frame: H x W bool, noise-free."""
        person = self._person(index)
        world = lay_over(np.zeros_like(self._degC), person, np.ones_like(person.alpha))
        seen = cv2.warpPerspective(world, self.homography_rgb_world(index), self.rgb_size_wh)
        return np.asarray(seen) > 0.5

    def picked_points(self) -> tuple[Matrix, tuple[int, ...]]:
        """24 x 4 float64 pixels (rgb_x, rgb_y, fir_x, fir_y) and the two rows that are gross errors."""
        rng = self._rng(9)
        cells = np.stack(np.meshgrid(np.arange(6), np.arange(4)), -1).reshape(-1, 2)
        share = 0.04 + 0.92 * (cells + rng.uniform(0.2, 0.8, cells.shape)) / (6, 4)
        fir = share * np.array(self.fir_size_wh)
        rgb = cv2.perspectiveTransform(fir[None], self.H_rgb_fir)[0]
        outliers = np.sort(rng.choice(len(fir), 2, replace=False))
        inwards = np.sign(np.array(self.rgb_size_wh) / 2 - rgb[outliers])
        wrong = inwards * rng.uniform(0.03, 0.06, (2, 1)) * self.rgb_size_wh[0]
        # Both picks err; 2.2 sigma is the limit of a careful hand, and keeps good points well under 2 px.
        noise = (rng.normal(size=(2, *fir.shape)) * POINT_NOISE_PX / np.sqrt(2)).clip(-0.62, 0.62)
        coarser = max(1.0, *np.divide(self.rgb_size_wh, self.fir_size_wh))
        rgb, fir = rgb + noise[0], fir + noise[1] / coarser
        rgb[outliers] += wrong
        return np.hstack([rgb, fir]).round(2), tuple(outliers.tolist())

    def _person(self, index: int) -> Patch:
        """Walks to and fro between the left wall and the machine at 1.25 m/s."""
        path_m = index * FRAME_PERIOD_NS * 1e-9 * 1.25
        lap = path_m / 1.5 % 2.0
        x_m = -1.35 + 1.5 * min(lap, 2.0 - lap)
        return paint_person(self.rgb_size_wh, x_m, np.sin(2 * np.pi * path_m / 1.5))

    def _lamp(self, index: int) -> Floats:
        """The head lamp's spot on the RGB grid: a soft core and a wide skirt, carried by the head."""
        w, h = self.rgb_size_wh
        t = index * FRAME_PERIOD_NS * 1e-9
        x = np.arange(w, dtype=np.float32) / w - 0.45 - 0.03 * np.sin(2 * np.pi * t / 3.1 + self._sway[0])
        y = np.arange(h, dtype=np.float32) / w - 0.42 - 0.02 * np.sin(2 * np.pi * t / 2.3 + self._sway[1])
        r2 = (x * x + (y * y)[:, None]) / 0.30**2
        return (0.8 * np.exp(-r2) + 0.22 / (1 + r2)).astype(np.float32)

    def _dust_seen(self, index: int) -> Floats:
        """Dust that drifts through the beam, on the RGB grid, about 0 to 1."""
        w, h = self.rgb_size_wh
        n = len(self._dust)
        rows, columns = np.arange(h) + int(index * w * 0.002), np.arange(w) + int(index * w * 0.006)
        return np.maximum(self._dust[np.ix_(rows % n, columns % n)], 0)


def _about_centre(size_wh: Size, dx: float, dy: float, turn_deg: float, zoom: float, tilt: Matrix) -> Matrix:
    """Move, turn, zoom and tilt about the image's centre; `tilt` is the change of scale over the width."""
    w, h = size_wh
    cos, sin = zoom * np.cos(np.radians(turn_deg)), zoom * np.sin(np.radians(turn_deg))
    to_centre = np.array([[1, 0, -(w - 1) / 2], [0, 1, -(h - 1) / 2], [0, 0, 1]])
    change = np.array([[cos, -sin, dx], [sin, cos, dy], [tilt[0] / w, tilt[1] / w, 1]])
    return np.linalg.inv(to_centre) @ change @ to_centre


def _between_cameras(rgb_size_wh: Size, fir_size_wh: Size, rng: np.random.Generator) -> Matrix:
    """H_rgb_fir: the thermal view fills some 80 % of the RGB image's tighter side and lies inside it."""
    (w, h), (fir_w, fir_h) = rgb_size_wh, fir_size_wh
    zoom = rng.uniform(0.78, 0.82) * min(w / fir_w, h / fir_h)
    dx, dy = rng.uniform(0.01, 0.03, 2) * (w, -h) + ((w - fir_w) / 2, (h - fir_h) / 2)
    tilt = rng.uniform(0.01, 0.03, 2) * (1, -1)
    H = _about_centre(fir_size_wh, dx, dy, rng.uniform(0.8, 1.8), zoom, tilt)
    return H / H[2, 2]


def _fixed_pattern(size_wh: Size, rng: np.random.Generator) -> Floats:
    """Kelvin that stay put in every frame: columns, single pixels, and a lens that is warmer at its rim."""
    w, h = size_wh
    x, y = np.linspace(-1, 1, w)[None, :], np.linspace(-1, 1, h)[:, None]
    pattern = 0.05 * rng.normal(size=(1, w)) + 0.04 * rng.normal(size=(h, w)) + 0.15 * (x * x + y * y - 0.67)
    return pattern.astype(np.float32)


def _check(frames: int, rgb_size_wh: Size, fir_size_wh: Size, seed: int) -> None:
    if not 1 <= frames <= MAX_FRAMES:
        raise UsageError(f"{frames} frames", where="frames", hint=f"ask for 1 to {MAX_FRAMES}")
    if seed < 0:
        raise UsageError(f"seed {seed} is negative", where="seed", hint="take 0 or more")
    lo, hi = SIZE_LIMITS
    for where, size in (("rgb_size_wh", rgb_size_wh), ("fir_size_wh", fir_size_wh)):
        fits = len(size) == 2 and all(lo <= side <= hi and side % 2 == 0 for side in size)
        if not fits or max(size) > 2 * min(size):
            hint = f"take an even width and height of {lo} to {hi} pixels, one at most twice the other"
            raise UsageError(f"cannot simulate a camera of size {size}", where=where, hint=hint)


def _claim(out: Path) -> None:
    """Make the folders, or refuse where a file would be written over."""
    for name in ("rgb", "fir", "points.csv", "truth.toml"):
        if os.path.lexists(out / name):
            hint = "give a new folder, or remove this one first"
            raise OutputError(f"{name} is there already", where=out, hint=hint)
    try:
        for name in ("rgb", "fir"):
            (out / name).mkdir(parents=True)
    except OSError as error:
        what = f"cannot make the folder: {error.strerror}"
        raise OutputError(what, where=out, hint="give another") from error


def _png(pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    return cv2.imencode(".png", pixels, _PNG)[1].tobytes()


def _write(path: Path, data: bytes) -> None:
    """Under a temporary name first, so that what bears the final name is whole."""
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_bytes(data)
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise OutputError(f"cannot write: {error.strerror}", where=path, hint="is the disk full?") from error
