"""Round spots in an image, darker or brighter than what is round them, and their centres to sub-pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from calib.detect.known import Known, mapped
from calib.detect.saddles import Image, look_up
from fusion.geometry import Floats

_FINEST_PX = 1.0  # sigma; a spot's radius is about sigma * sqrt(2)
_STEP = 2**0.5
_OCTAVES = 6
_ROUND = 0.08  # least ratio of the two curvatures
_STEPS = 9


@dataclass(frozen=True, slots=True, eq=False)
class Blobs:
    """N spots of one polarity: `xy` (N, 2) px, `radius` (N,) px, `strength` (N,), the contrast in counts."""

    xy: Floats
    radius: Floats
    strength: Floats

    def __len__(self) -> int:
        return len(self.xy)

    def __getitem__(self, rows: NDArray[Any]) -> Blobs:
        return Blobs(self.xy[rows], self.radius[rows], self.strength[rows])


def find_blobs(image: Image, most: int = 1000) -> tuple[Blobs, Blobs]:
    """The strongest spots: dark ones, bright ones.

    Maxima of the scale-normalised Laplacian over place and scale (Lindeberg 1998). A glow of constant slope
    has no Laplacian and does not matter.
    """
    rows: list[Floats] = []
    small, factor = image, 1
    for _ in range(_OCTAVES):
        if min(small.shape) < 12:
            break
        found = _octave(small)
        found[:, :2] = (found[:, :2] + 0.5) * factor - 0.5
        found[:, 2] *= factor
        rows.append(found)
        half = (small.shape[1] // 2, small.shape[0] // 2)
        small = np.asarray(cv2.resize(small, half, interpolation=cv2.INTER_AREA), np.float32)
        factor *= 2
    table = np.concatenate(rows) if rows else np.zeros((0, 4))
    return _strongest(table[table[:, 3] > 0], most), _strongest(table[table[:, 3] < 0], most)


def _octave(image: Image) -> Floats:
    """(N, 4): x, y, radius, Laplacian (positive: dark) of the maxima at the octave's two scales."""
    sigmas = _FINEST_PX * _STEP ** np.arange(-1, 3)
    stack = np.stack([s * s * cv2.Laplacian(_blurred(image, s), cv2.CV_32F, ksize=1) for s in sigmas])
    peak = np.abs(stack)
    near = np.stack([cv2.dilate(layer, np.ones((3, 3), np.uint8)) for layer in peak])
    found = []
    for k in (1, 2):
        top = near[k - 1 : k + 2].max(0)
        y, x = np.nonzero((peak[k] >= top) & (peak[k] > 1e-6))
        inner = (x > 1) & (y > 1) & (x < image.shape[1] - 2) & (y < image.shape[0] - 2)
        y, x = y[inner], x[inner]
        good = _is_round(_blurred(image, sigmas[k]), y, x)
        y, x = y[good], x[good]
        radius = np.full(len(x), sigmas[k] * np.sqrt(2))
        found.append(np.stack([x, y, radius, stack[k, y, x]], 1))
    return np.concatenate(found).astype(np.float64)


def _blurred(image: Image, sigma: float) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), float(sigma)), np.float32)


def _is_round(f: Image, y: NDArray[np.intp], x: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Whether both curvatures have one sign and are not too unlike, as they are along an edge."""
    xx = f[y, x + 1] + f[y, x - 1] - 2 * f[y, x]
    yy = f[y + 1, x] + f[y - 1, x] - 2 * f[y, x]
    xy = (f[y + 1, x + 1] + f[y - 1, x - 1] - f[y + 1, x - 1] - f[y - 1, x + 1]) / 4
    half, root = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    return (np.abs(half) - root) > _ROUND * (np.abs(half) + root)


def _strongest(table: Floats, most: int) -> Blobs:
    order = np.argsort(-np.abs(table[:, 3]), kind="stable")[:most]
    x, y, radius, strength = table[order].T
    return Blobs(np.stack([x, y], 1), radius, np.abs(strength))


@dataclass(frozen=True, slots=True, eq=False)
class Discs:
    """Circles of the board as fitted: centres `uv` (N, 2) px, `radius` (N,) in the board's unit, `contrast`
    (N,) counts (positive: brighter than around), `explained` (N,) 0..1, the share of the window's variance
    that the disc accounts for beyond a slope."""

    uv: Floats
    radius: Floats
    contrast: Floats
    explained: Floats

    @classmethod
    def none(cls) -> Discs:
        return cls(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0))

    def __getitem__(self, rows: NDArray[Any]) -> Discs:
        return Discs(*(part[rows] for part in self._parts()))

    def and_(self, more: Discs) -> Discs:
        """These, then those."""
        pairs = zip(self._parts(), more._parts(), strict=True)
        return Discs(*(np.concatenate(pair) for pair in pairs))

    def _parts(self) -> tuple[Floats, Floats, Floats, Floats]:
        return self.uv, self.radius, self.contrast, self.explained


def fit_discs(
    image: Image, known: Known, xy: Floats, radius: float, window: float, samples: int = 11
) -> Discs:
    """Fit circles about places `xy` (N, 2) of the board, of about `radius`, in windows of radius `window`,
    with `samples` from a window's middle to its rim (fewer where that is more than pixels).

    The model is the perspective picture of a disc with a blurred rim on a sloping background,
    c0 + c . p + A erfc(d / s), by least squares; d is a pixel's distance from the rim, found through the
    homography. So `uv` is where the circle's centre is, not the ellipse's, which lies nearer to the camera.
    """
    if not len(xy):
        return Discs.none()
    start, _ = known.predict(xy)
    shift = start - mapped(known.H, xy)
    back = np.asarray(np.linalg.inv(known.H), np.float64)
    place, value, weight, middle = _samples(image, known, back, xy, start, window, samples)
    state = np.zeros((len(xy), 4))  # offset in px, log of the radius, log of the blur
    state[:, 2], state[:, 3] = np.log(radius), np.log(1.0)
    free = np.array([1.0, 1.0, 0.3, 0.3])

    def model(state: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        return _disc(
            place - (shift + state[:, :2])[:, None], back, xy, state, place - middle[:, None], value, weight
        )

    error, slopes, rest, part = model(state)
    damping = np.full(len(xy), 1e-2)
    low, high = np.log((0.4 * radius, 0.2)), np.log((2.0 * radius, 20.0))
    for _ in range(_STEPS):
        square = slopes @ slopes.transpose(0, 2, 1)
        scale = np.einsum("nii->ni", square)
        square += (damping[:, None] * scale + 1e-9 * scale.max(1, keepdims=True) + 1e-12)[:, None] * np.eye(8)
        step = np.clip(np.linalg.solve(square, slopes @ rest[..., None])[:, :4, 0], -free, free)
        trial = state + step
        trial[:, 2:] = np.clip(trial[:, 2:], low, high)
        new = model(trial)
        better = new[0] <= error
        damping = np.clip(np.where(better, damping / 5, damping * 5), 1e-6, 1e3)
        state[better] = trial[better]
        for old, one in zip((error, slopes, rest, part), new, strict=True):
            old[better] = one[better]
        if (np.abs(step[:, :2]) < 1e-3).all():
            break
    flat = _without_slope(place - middle[:, None], value, weight)
    explained = 1 - error / np.maximum(flat, 1e-12)
    return Discs(start + state[:, :2], np.exp(state[:, 2]), part[:, 3], explained)


def _samples(
    image: Image, known: Known, back: Floats, xy: Floats, start: Floats, window: float, side: int
) -> tuple[Floats, Floats, Floats, Floats]:
    """Places (N, P, 2) px about each start, whole pixels if few; values, weights (N, P); the middles."""
    ring = np.array([(1, 0), (0, 1), (-1, 0), (0, -1), (0.7, 0.7), (-0.7, 0.7), (0.7, -0.7), (-0.7, -0.7)])
    rim = mapped(known.H, (xy[:, None] + window * ring).reshape(-1, 2)).reshape(len(xy), len(ring), 2)
    reach = np.linalg.norm(rim - mapped(known.H, xy)[:, None], axis=2).max(1)
    step = np.maximum(np.minimum(reach, 400) / side, 1.0)
    side = int(np.ceil(min(side, reach.max())))
    y, x = np.mgrid[-side : side + 1, -side : side + 1]
    middle = np.round(start)
    place = middle[:, None] + step[:, None, None] * np.stack([x.ravel(), y.ravel()], 1)
    on_board = mapped(back, (place - (start - mapped(known.H, xy))[:, None]).reshape(-1, 2)).reshape(
        place.shape
    )
    away = np.linalg.norm(on_board - xy[:, None], axis=2)
    h, w = image.shape
    inside = ((place >= 0) & (place <= (w - 1, h - 1))).all(2)
    weight = np.clip(3 * (1 - away / window), 0, 1) * inside
    return place, look_up(image, place), weight, middle


def _disc(
    place: Floats, back: Floats, xy: Floats, state: Floats, offset: Floats, value: Floats, weight: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Squared error (N,), weighted slopes (N, 8, P), what is left (N, P), linear part (N, 4)."""
    n, count, _ = place.shape
    p = place @ back[:, :2].T + back[:, 2]
    q = p[..., :2] / p[..., 2:]
    away = q - xy[:, None]
    rho = np.maximum(np.linalg.norm(away, axis=2), 1e-12)
    # d rho / d pixel: J = (back[:2, :2] - q back[2, :2]) / w
    unit = away / rho[..., None]
    slope = (unit @ back[:2, :2] - (unit * q).sum(2, keepdims=True) * back[2, :2]) / p[..., 2:]
    steep = np.maximum(np.linalg.norm(slope, axis=2), 1e-12)
    radius, blur = np.exp(state[:, 2:3]), np.exp(state[:, 3:4])
    t = (rho - radius) / (steep * blur)
    profile = 0.5 * (1 - erf(t / np.sqrt(2)))
    bell = np.exp(-0.5 * t * t) / np.sqrt(2 * np.pi)
    scale = np.sqrt((weight**2).sum(1))[:, None, None]
    linear = np.stack([np.ones((n, count)), offset[..., 0], offset[..., 1], profile], 1) * weight[:, None]
    wanted = value * weight
    square = linear @ linear.transpose(0, 2, 1) + (1e-9 * scale**2 + 1e-12) * np.eye(4)
    part = np.linalg.solve(square, linear @ wanted[..., None])[..., 0]
    rest = wanted - np.einsum("ni,nip->np", part, linear)
    move = (bell / blur)[..., None] * slope / steep[..., None]
    by_state = np.stack([move[..., 0], move[..., 1], bell * radius / (steep * blur), bell * t], 1)
    slopes = np.concatenate([by_state * (weight * part[:, 3:])[:, None], linear], 1)
    return (rest**2).sum(1), slopes, rest, part


def _without_slope(offset: Floats, value: Floats, weight: Floats) -> Floats:
    """What is left of the windows' squares without a plane."""
    plane = np.stack([np.ones(value.shape), offset[..., 0], offset[..., 1]], 1) * weight[:, None]
    wanted = value * weight
    square = plane @ plane.transpose(0, 2, 1) + 1e-6 * np.eye(3)
    part = np.linalg.solve(square, plane @ wanted[..., None])[..., 0]
    return ((wanted - np.einsum("ni,nip->np", part, plane)) ** 2).sum(1)
