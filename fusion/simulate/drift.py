"""The synthetic mine, so far as a flat picture of a drift goes; `pairs` films it with two cameras.

The drift is painted on one plane, in perspective, as an RGB camera at rest sees it by the light of a lamp
beside it. Lengths are metres (x right, y down, z ahead), radiance is linear, 1 saturates the camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Values = NDArray[np.floating[Any]]
Size = tuple[int, int]
Colour = tuple[float, float, float]
Corners = list[tuple[float, float, float]]

ZERO_DEGC_KELVIN = 273.15
AMBIENT_DEGC = 11.0  # what every surface reflects
PERSON_DEGC, PERSON_EMISSIVITY = 32.0, 0.97
MARGIN = 0.12  # of the RGB size, painted beyond the resting view on every side: what shake uncovers

_FLOOR_M, _WALL_M, _ROOF_M = 1.5, 2.4, 2.1  # half axes of the drift around the camera's axis
_PERSON_Z_M, _MACHINE_Z_M = 5.0, 7.0
_LAMP = 62.0


@dataclass(frozen=True, slots=True)
class Patch:
    """Something painted: `corner` (x, y) is where its first pixel lies on the plane.

    `bgr` is H x W x 3 linear radiance, `apparent_degC` H x W, `alpha` H x W in [0, 1], all float32.
    """

    corner: tuple[int, int]
    bgr: Floats
    apparent_degC: Floats  # noqa: N815 - units as the conventions write them
    alpha: Floats


def lay_over(plane: Floats, patch: Patch, values: Floats) -> Floats:
    """A copy of `plane` (H x W or H x W x 3) with `values` of the patch's size blended in at its corner."""
    (x, y), (h, w) = patch.corner, patch.alpha.shape
    alpha = patch.alpha if plane.ndim == 2 else patch.alpha[..., None]
    laid = plane.copy()
    laid[y : y + h, x : x + w] += alpha * (values - laid[y : y + h, x : x + w])
    return laid


def apparent_temperature(degC: Values | float, emissivity: float) -> Floats:
    """What a thermal camera reads off a grey body: emitted plus reflected T^4, all wavelengths alike."""
    emitted = emissivity * np.square(np.square(np.asarray(degC, np.float64) + ZERO_DEGC_KELVIN))
    reflected = (1 - emissivity) * (AMBIENT_DEGC + ZERO_DEGC_KELVIN) ** 4
    return np.asarray(np.sqrt(np.sqrt(emitted + reflected)) - ZERO_DEGC_KELVIN, np.float32)


def fractal(rng: np.random.Generator, side_px: int, falloff: float) -> Floats:
    """Periodic noise of all octaves, side x side float32, mean 0, deviation 1; power falls as f^-2falloff."""
    f = np.hypot(np.fft.fftfreq(side_px)[:, None], np.fft.rfftfreq(side_px)[None, :])
    f[0, 0] = np.inf
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((side_px, side_px))) * f**-falloff)
    return (noise / noise.std()).astype(np.float32)


def texture_px(rgb_size_wh: Size) -> int:
    """The side of a noise tile fine enough for this image: a power of two."""
    return 1 << int(np.ceil(np.log2(0.8 * rgb_size_wh[0])))


class _Canvas:
    """The painted plane: what every pixel is made of (albedo, light, temperature) and where it lies.

    Each pixel is a ray down the drift: `rho`, `phi` its direction around the axis, `z` its depth in
    metres, `s` its place across the drift in metres. All float32, H x W.
    """

    def __init__(self, rgb_size_wh: Size) -> None:
        self.f, self.vx, self.vy = _pinhole(rgb_size_wh)
        wide, high = (round(side * (1 + 2 * MARGIN)) for side in rgb_size_wh)
        x = (np.arange(wide, dtype=np.float32) - np.float32(self.vx)) / np.float32(self.f)
        y = ((np.arange(high, dtype=np.float32) - np.float32(self.vy)) / np.float32(self.f))[:, None]
        self.rho, self.phi = np.hypot(x, y) + np.float32(0.5 / self.f), np.arctan2(y, x)
        self.albedo = np.zeros((high, wide, 3), np.float32)
        self.z, self.s, self.light, self.apparent_degC = (
            np.zeros((high, wide), np.float32) for _ in range(4)
        )

    def pixels(self, xyz_m: Corners) -> NDArray[np.float64]:
        """Metres (x right, y down, z ahead) to pixels of the plane, N x 2."""
        p = np.array(xyz_m, np.float64)
        return p[:, :2] / p[:, 2:] * self.f + (self.vx, self.vy)

    def cover(
        self, alpha: Values, bgr: Values, light: Values | float, degC: Values | float, emissivity: float
    ) -> None:
        """Lay one material over the plane; `degC` is its surface temperature, kept as apparent."""
        # Only the box that holds all of the mask: most things are small.
        rows, columns = (np.flatnonzero(alpha.any(axis)) for axis in (1, 0))
        if not rows.size:
            return
        box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        share = alpha[box]
        seen_degC = apparent_temperature(_part(degC, box), emissivity)
        self.albedo[box] += share[..., None] * (_part(bgr, box) - self.albedo[box])
        self.light[box] += share * (_part(light, box) - self.light[box])
        self.apparent_degC[box] += share * (seen_degC - self.apparent_degC[box])


def _part(values: Values | float, box: tuple[slice, slice]) -> Values:
    """A map's values in the box; one value or one colour holds everywhere."""
    values = np.asarray(values, np.float32)
    return values[box] if values.ndim > 1 else values


def paint_drift(rgb_size_wh: Size, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """The view down the drift lit from the camera: radiance H x W x 3 BGR, apparent degC H x W."""
    c = _Canvas(rgb_size_wh)
    _paint_rock(c, rng, texture_px(rgb_size_wh))
    for tube in _TUBES:
        _paint_tube(c, tube)
    _paint_machine(c)
    dusty = c.light * np.exp(-c.z / 11)
    return c.albedo * dusty[..., None], c.apparent_degC


def _paint_rock(c: _Canvas, rng: np.random.Generator, tile_px: int) -> None:
    """Walls, roof and wet floor: a rough outline around the axis gives depth, a rock tile the texture."""
    big = fractal(rng, 256, 2.2)
    outline = ((np.abs(np.cos(c.phi)) / _WALL_M) ** 4 + (np.abs(np.sin(c.phi)) / _ROOF_M) ** 4) ** -0.25
    outline *= 1 + 0.05 * _sample(big, c.phi * (256 / np.pi), np.minimum(outline / c.rho, 60) * 20)
    floor_m = _FLOOR_M / np.maximum(np.sin(c.phi), 1e-3)
    floor = (floor_m < outline).astype(np.float32)
    away = np.minimum(outline, floor_m)
    c.z[:] = np.minimum(away / c.rho, 80.0)
    c.s[:] = np.where(floor > 0, away * np.cos(c.phi), c.phi * 2.2)
    rock_at = _sample_rock(c, _rock_tile(rng, tile_px), np.sqrt(1 + c.z / away))
    slope_z, slope_s, stain, warm = (rock_at[..., k] for k in range(4))
    dist = np.hypot(away, c.z)
    rough = 1 - 0.6 * floor
    facing = (away + rough * (slope_z * c.z + slope_s * away)) / dist
    facing = np.maximum(facing, 0.06) / np.sqrt(1 + rough * (slope_z**2 + slope_s**2))
    light = _LAMP * facing / (dist**2 + 8)
    grey = np.clip(0.20 + 0.06 * stain, 0.04, 0.5)[..., None]
    rock_degC = AMBIENT_DEGC + 2.5 + 0.9 * warm + 0.05 * np.minimum(c.z, 30)
    c.cover(np.ones_like(c.z), grey * _bgr(0.82, 0.92, 1.0), light, rock_degC, 0.95)
    wet = np.clip(2.0 * _sample(big, c.s * 14 + 90, np.minimum(c.z, 40) * 7) + 0.4, 0, 1)
    tracks = np.exp(-(((np.abs(c.s) - 0.85) / 0.25) ** 2))
    mud = np.maximum(0.75 * grey - (0.04 * tracks + 0.07 * wet)[..., None], 0.02)
    c.cover(floor, mud * _bgr(0.66, 0.87, 1.1), light, AMBIENT_DEGC - 0.5 - 2.5 * wet + 0.25 * warm, 0.96)


@dataclass(frozen=True, slots=True)
class _Tube:
    """A pipe, duct or cable along the drift: where in its section, albedo, temperature, spacing of joints."""

    centre_m: tuple[float, float]
    radius_m: float
    bgr: Colour
    surface_degC: float  # noqa: N815
    emissivity: float
    joint_m: float


_TUBES = (
    _Tube((-2.15, -0.95), 0.11, (0.20, 0.28, 0.42), 44.0, 0.90, 3.0),  # warm water pipe
    _Tube((0.95, -1.45), 0.40, (0.10, 0.42, 0.55), 8.0, 0.93, 0.6),  # air duct
    *(_Tube((2.15, y), 0.03, (0.05, 0.05, 0.06), 17.0, 0.95, 4.0) for y in (-0.55, -0.45, -0.37)),  # cables
)


def _paint_tube(c: _Canvas, tube: _Tube) -> None:
    """Seen down the drift it is a band of constant angle around the axis; it warms the air about it."""
    away, angle = float(np.hypot(*tube.centre_m)), float(np.arctan2(tube.centre_m[1], tube.centre_m[0]))
    z = np.minimum(away / c.rho, 80.0)
    joint = np.exp(-((((z + 0.5 * tube.joint_m) % tube.joint_m - 0.5 * tube.joint_m) / 0.07) ** 2))
    off = (c.phi - angle) * away / (tube.radius_m * (1 + 0.25 * joint))
    edge = tube.radius_m / away * c.rho * c.f  # the half width in pixels: one pixel of soft edge
    alpha = np.clip((1 - np.abs(off)) * edge + 0.5, 0, 1) * np.clip(edge * 2, 0, 1)
    round_ = np.sqrt(np.clip(1 - off * off, 0, 1))
    light = _LAMP * (0.15 + 0.85 * round_) * 0.8 * (away + 0.3 * z) / np.hypot(away, z) / (away**2 + z**2 + 8)
    glow = 0.10 * np.exp(-np.maximum(np.abs(off) - 1, 0) / 1.5)
    c.apparent_degC += glow * (tube.surface_degC - c.apparent_degC)
    c.z += alpha * (z - c.z)
    bgr = _bgr(*tube.bgr) * (1 - 0.4 * joint[..., None])
    degC = tube.surface_degC - 4 * joint * np.sign(tube.surface_degC - AMBIENT_DEGC)
    c.cover(alpha, bgr, light, degC, tube.emissivity)


# Corners in metres at the machine's rear (x0, y0, x1, y1), BGR albedo, degC. y is down, the floor is at 1.5.
_MACHINE = (
    ((0.75, 0.15, 2.05, 1.15), (0.06, 0.36, 0.50), 19.0),  # body
    ((0.85, -0.35, 1.40, 0.15), (0.05, 0.28, 0.38), 17.0),  # cab
    ((0.92, -0.27, 1.33, 0.08), (0.03, 0.03, 0.03), 15.0),  # window
    ((0.72, 0.85, 1.10, 1.50), (0.03, 0.03, 0.03), 27.0),  # tyres
    ((1.72, 0.85, 2.10, 1.50), (0.03, 0.03, 0.03), 27.0),
    ((1.18, 0.35, 1.85, 0.95), (0.05, 0.06, 0.07), 52.0),  # radiator
    ((1.62, -0.20, 1.76, 0.15), (0.08, 0.09, 0.10), 88.0),  # exhaust
    ((0.80, 0.30, 1.10, 0.40), (0.55, 0.55, 0.60), 19.0),  # reflecting tape
    ((0.82, 0.52, 0.98, 0.64), (0.08, 0.06, 0.70), 21.0),  # tail lamp
)


def _paint_machine(c: _Canvas) -> None:
    """A loader parked ahead on the right, its rear to the camera, its near side running away."""
    z, far = _MACHINE_Z_M, _MACHINE_Z_M + 2.6
    side = [(0.75, 0.15, z), (0.75, 0.15, far), (0.75, 1.35, far), (0.75, 1.35, z)]
    _paint_panel(c, side, z + 1.2, (0.05, 0.28, 0.40), 0.35, 24.0)
    for (x0, y0, x1, y1), bgr, degC in _MACHINE:
        _paint_panel(c, [(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)], z, bgr, 1.0, degC)


def _paint_panel(c: _Canvas, corners_m: Corners, z: float, bgr: Colour, facing: float, degC: float) -> None:
    """A flat plate through `corners_m` (x, y, z), shaded as if all of it were `z` away."""
    mask = np.zeros(c.z.shape, np.uint8)
    cv2.fillPoly(mask, [np.rint(c.pixels(corners_m) * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
    alpha = mask.astype(np.float32) / 255
    c.z += alpha * (z - c.z)
    c.cover(alpha, _bgr(*bgr), _LAMP * facing / (z * z + 10), degC, 0.92)


def _walker(swing: float) -> list[tuple[list[tuple[float, float]], float, float, float]]:
    """Legs, far arm, trunk, reflecting band, near arm, head, helmet; later ones cover earlier ones.

    Each is points (metres right of the feet's middle, metres above the floor), radius in metres, albedo,
    and kelvin above the body's mean.
    """
    step, arm = 0.24 * swing, 0.17 * swing
    return [
        ([(0.0, 0.86), (-0.6 * step, 0.48), (-step, 0.06), (0.08 - step, 0.04)], 0.095, 0.007, -0.3),
        ([(0.0, 0.86), (0.7 * step, 0.46), (step, 0.06), (0.08 + step, 0.04)], 0.095, 0.009, -0.3),
        ([(0.0, 1.38), (-arm, 1.10), (0.08 - 1.5 * arm, 0.88)], 0.06, 0.008, -0.2),
        ([(0.0, 0.88), (0.01, 1.34)], 0.17, 0.010, 0.3),
        ([(-0.09, 1.12), (0.10, 1.12)], 0.025, 0.050, 0.3),
        ([(0.0, 1.38), (arm, 1.10), (0.08 + 1.5 * arm, 0.88)], 0.06, 0.012, 0.0),
        ([(0.01, 1.63), (0.03, 1.60)], 0.105, 0.030, 1.3),
        ([(-0.01, 1.71), (0.03, 1.71)], 0.09, 0.035, -1.0),
    ]


def paint_person(rgb_size_wh: Size, x_m: float, swing: float) -> Patch:
    """A walker in dark clothes 5 m ahead, `x_m` right of the axis; `swing` in [-1, 1] is the stride."""
    f, vx, vy = _pinhole(rgb_size_wh)
    scale, fine = f / _PERSON_Z_M, 4
    corner = int(vx + (x_m - 0.55) * scale), int(vy + (_FLOOR_M - 1.9) * scale)
    w, h = int(1.1 * scale) + 2, int(2.0 * scale) + 2
    labels = np.zeros((h * fine, w * fine), np.uint8)
    origin = np.array([vx + x_m * scale - corner[0], vy + _FLOOR_M * scale - corner[1]]) + 0.5
    parts = _walker(swing)
    for label, (points, radius, *_) in enumerate(parts, start=1):
        at = np.rint((origin + np.array(points) * (scale, -scale)) * fine * 16 - 8).astype(np.int32)
        cv2.polylines(labels, [at], False, label, max(1, round(2 * radius * scale * fine)), cv2.LINE_8, 4)
    alpha = _smaller(labels > 0, (w, h))
    whole = np.maximum(alpha, 1e-3)
    albedo = _smaller(np.array([0.0] + [p[2] for p in parts], np.float32)[labels], (w, h)) / whole
    warmer = _smaller(np.array([0.0] + [p[3] for p in parts], np.float32)[labels], (w, h)) / whole
    light = _LAMP / (_PERSON_Z_M**2 + 10) * np.exp(-_PERSON_Z_M / 11)
    bgr = albedo[..., None] * (_bgr(0.95, 0.92, 1.0) * light)
    degC = apparent_temperature(PERSON_DEGC + warmer, PERSON_EMISSIVITY)
    return Patch(corner, bgr.astype(np.float32), degC, alpha)


def _smaller(values: NDArray[np.generic], size_wh: Size) -> Floats:
    values = values.astype(np.float32)
    return np.asarray(cv2.resize(values, size_wh, interpolation=cv2.INTER_AREA), np.float32)


def _bgr(blue: float, green: float, red: float) -> Floats:
    return np.array([blue, green, red], np.float32)


def _pinhole(rgb_size_wh: Size) -> tuple[float, float, float]:
    """Focal length and vanishing point (x, y) on the painted plane, in its pixels."""
    w, h = rgb_size_wh
    return 0.82 * w, (0.52 + MARGIN) * w, (0.42 + MARGIN) * h


def _sample(tile: Floats, x: Values, y: Values) -> Floats:
    """Bilinear look-up in a periodic tile, any number of channels."""
    side = len(tile)
    wrapped = cv2.copyMakeBorder(tile, 0, 1, 0, 1, cv2.BORDER_WRAP)
    at = [np.asarray(v % side, np.float32) for v in np.broadcast_arrays(x, y)]
    sampled = cv2.remap(wrapped, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(sampled, np.float32)


def _rock_tile(rng: np.random.Generator, side: int) -> Floats:
    """Blasted rock, side x side x 4: slopes along and across the drift, stain, warmth; mean 0, periodic."""
    bent = [fractal(rng, side, 1.7) * side / 160 for _ in range(2)]
    rows, columns = np.mgrid[:side, :side].astype(np.float32)
    slopes = np.zeros((side, side, 2), np.float32)
    for cell, steep in ((12, 0.38), (28, 0.38), (60, 0.25)):
        slopes += _sample(_facets(rng, side, cell, steep), columns + bent[0], rows + bent[1])
    grain = fractal(rng, side, 1.1)
    slopes[..., 0] += 1.6 * (np.roll(grain, -1, 0) - grain)
    slopes[..., 1] += 1.6 * (np.roll(grain, -1, 1) - grain)
    return np.dstack([slopes, fractal(rng, side, 1.2), fractal(rng, side, 1.5)])


def _facets(rng: np.random.Generator, side: int, cells: int, steep: float) -> Floats:
    """Broken faces: the nearest of some cells^2 random seeds decides the slope (side x side x 2)."""
    rows, columns = rng.integers(0, side, (2, cells * cells))
    free = np.full((side, side), 255, np.uint8)
    free[rows, columns] = 0
    rim = side // 4  # wrapped around, so that the pattern repeats without a seam
    wrapped = cv2.copyMakeBorder(free, rim, rim, rim, rim, cv2.BORDER_WRAP)
    _, nearest = cv2.distanceTransformWithLabels(wrapped, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    labels = np.asarray(nearest, np.int32)
    slope_at = np.zeros((side, side, 2), np.float32)
    slope_at[rows, columns] = rng.normal(0, steep, (cells * cells, 2))
    slope_at = np.asarray(cv2.copyMakeBorder(slope_at, rim, rim, rim, rim, cv2.BORDER_WRAP), np.float32)
    seeds = wrapped == 0
    of_label = np.zeros((labels.max() + 1, 2), np.float32)
    of_label[labels[seeds]] = slope_at[seeds]
    return of_label[labels[rim:-rim, rim:-rim]]


def _sample_rock(c: _Canvas, tile: Floats, stretch: Values) -> Floats:
    """The tile on the walls, H x W x 4, blurred where one pixel covers several of its texels."""
    texels_per_m = len(tile) / (2 * np.pi * 2.2 / 2)  # repeats twice around the drift, without a seam
    x, y = c.s * texels_per_m, c.z * texels_per_m
    level = np.log2(np.maximum(c.z / c.f * stretch * texels_per_m, 1)).clip(0, 5)
    seen = np.zeros((*c.z.shape, 4), np.float32)
    for k in range(6):
        blurred = tile if k == 0 else np.asarray(cv2.GaussianBlur(tile, (0, 0), 0.5 * 2**k), np.float32)
        seen += np.maximum(1 - np.abs(level - k), 0)[..., None] * _sample(blurred, x, y)
    return seen
