"""The thermal image on the RGB grid: where it is valid, what a crop would keep, and the resampling.

Pixel (0, 0) is the centre of the top-left pixel; `H_rgb_fir` takes thermal pixel coordinates to RGB ones.
An RGB pixel is valid where its position lies on the thermal image, [-1/2, w - 1/2] x [-1/2, h - 1/2]: in
the last half pixel beyond the outermost centres their value is drawn out. Positions are sampled in steps of
1/256 px, so half a step is let pass.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Size = tuple[int, int]
Counts = NDArray[np.uint8] | NDArray[np.uint16]
Spans = tuple[NDArray[np.int64], NDArray[np.int64]]
_A = TypeVar("_A", bound=np.ndarray)

STEPS = 256  # sampling positions per pixel: what `fusion.kernels.resample` reads
_LEAST_DENOMINATOR = 1e-2  # of the largest: beyond it the scale of areas varies a million-fold
_LARGEST_AREA_RATIO = 1e4
_MARGIN_PX = 0.5 + 0.5 / STEPS  # a pixel reaches half a pixel beyond its centre; and positions are rounded
_BLOCK_PIXELS = 1 << 15  # a block's float64 temporaries stay in the processor's cache


def fault_of(H_rgb_fir: NDArray[np.float64], fir_size_wh: Size, rgb_size_wh: Size) -> str:
    """Why `H_rgb_fir` cannot carry images of these sizes, whatever it overlaps; empty where it can.

    Not finite, singular, folding (its denominator comes near zero or changes sign on the thermal image),
    or an area more than 10,000 times larger or smaller than scale-to-fit. The inverse needs no test of
    its own: where the thermal image lands its denominator is 1 / w, w that of `H_rgb_fir`.
    """
    H, (w, h), (W, rows) = H_rgb_fir, fir_size_wh, rgb_size_wh
    if not np.isfinite(H).all():
        return "the homography holds NaN or infinity"
    # Both images as unit squares, so that their sizes do not count.
    unit = np.diag([1 / W, 1 / rows, 1]) @ (H / max(np.abs(H).max(), 1e-300)) @ np.diag([w, h, 1])
    if not np.linalg.cond(unit) <= 1e12:
        return "the homography is singular: it squeezes the image to a line or a point"
    corners = np.array([[-0.5, -0.5, 1], [w - 0.5, -0.5, 1], [w - 0.5, h - 0.5, 1], [-0.5, h - 0.5, 1]])
    mapped = corners @ H.T
    denominators = mapped[:, 2] * np.sign(mapped[0, 2])
    if denominators.min() <= _LEAST_DENOMINATOR * denominators.max():
        return "the homography folds the thermal image: part of it would lie at or behind the horizon"
    with np.errstate(all="ignore"):
        x, y = (mapped[:, :2] / mapped[:, 2:]).T
        area = abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2 / (W * rows)
    if not 1 / _LARGEST_AREA_RATIO <= area <= _LARGEST_AREA_RATIO:
        return f"absurd scale: the thermal image would fill {area:.2g} times the area of the RGB image"
    return ""


def valid_spans(H_rgb_fir: NDArray[np.float64], fir_size_wh: Size, rgb_size_wh: Size) -> Spans:
    """The valid columns of each RGB row, as half-open [first, stop): two int64 arrays, one value a row.

    A row that has none gets (W, 0). `H_rgb_fir` must have no `fault_of`; then the valid region is convex
    and one interval a row says it all.
    """
    (w, h), (W, H) = fir_size_wh, rgb_size_wh
    x, y, z = _inverse(H_rgb_fir, fir_size_wh)
    # -1/2 <= x/z <= w - 1/2 as half-planes of the RGB plane. Together they imply z > 0: nothing from behind.
    edges = (
        x + _MARGIN_PX * z,
        (w - 1 + _MARGIN_PX) * z - x,
        y + _MARGIN_PX * z,
        (h - 1 + _MARGIN_PX) * z - y,
    )
    lower, upper = np.zeros(H), np.full(H, W - 1.0)
    for a, b, c in edges:  # a u + b v + c >= 0
        rest = -(b * np.arange(H) + c)
        if a == 0:
            upper[rest > 0] = -1
            continue
        with np.errstate(over="ignore"):
            bound = rest / a
        if a > 0:
            lower = np.maximum(lower, bound)
        else:
            upper = np.minimum(upper, bound)
    empty = np.ceil(lower) > np.floor(upper)
    first = np.where(empty, W, np.ceil(np.minimum(lower, W))).astype(np.int64)
    stop = np.where(empty, 0, np.floor(np.maximum(upper, -1)) + 1).astype(np.int64)
    return first, stop


def coverage(H_rgb_fir: NDArray[np.float64], fir_size_wh: Size, rgb_size_wh: Size) -> float:
    """The share [0, 1] of the RGB grid that the thermal image covers; conditions as in `valid_spans`."""
    first, stop = valid_spans(H_rgb_fir, fir_size_wh, rgb_size_wh)
    return float(np.maximum(stop - first, 0).sum()) / (rgb_size_wh[0] * rgb_size_wh[1])


def largest_rectangle(spans: Spans) -> tuple[int, int, int, int]:
    """The largest rectangle (x, y, w, h) of valid pixels of a convex region; (0, 0, 0, 0) if it is empty.

    In a convex region a rectangle is valid when its top and bottom rows are, so it is enough to try
    every pair of rows. Of equals the one with the topmost, then shortest extent is taken.
    """
    first, stop = spans
    best, best_area = (0, 0, 0, 0), 0
    rows = len(first)
    heights = np.arange(1, rows + 1)
    for top in range(rows):
        if int(stop[top] - first[top]) * (rows - top) <= best_area:
            continue
        left = np.maximum(first[top:], first[top])
        widths = np.minimum(stop[top:], stop[top]) - left
        areas = widths * heights[: rows - top]
        k = int(areas.argmax())
        if areas[k] > best_area:
            best, best_area = (int(left[k]), top, int(widths[k]), k + 1), int(areas[k])
    return best


@dataclass(frozen=True, slots=True, eq=False)
class Warp:
    """Carries a thermal image onto the RGB grid by a homography; built once, then only read.

    Parameters: `H_rgb_fir` (3, 3) float64 (`fusion.registration.check` says what is wrong with one);
    sizes in pixels. Raises `ValueError` when the matrix cannot carry an image (`fault_of`) or no RGB
    pixel is valid.

    `mask` is H x W uint8 on the RGB grid, 255 where valid, read-only; `coverage` its share [0, 1];
    `full` whether that is all of it. `crop_xywh` is the largest rectangle of valid pixels, and
    `border_ltrb` the columns and rows that this crop cuts off at the left, top, right and bottom.
    `is_identity` says that the grids are the same and nothing moves. Safe to share between threads.
    """

    H_rgb_fir: NDArray[np.float64]
    fir_size_wh: Size
    rgb_size_wh: Size
    mask: NDArray[np.uint8] = field(init=False, repr=False)
    coverage: float = field(init=False)
    full: bool = field(init=False)
    crop_xywh: tuple[int, int, int, int] = field(init=False)
    border_ltrb: tuple[int, int, int, int] = field(init=False)
    is_identity: bool = field(init=False)
    _sampling: tuple[NDArray[np.uint32], NDArray[np.uint16]] | None = field(init=False, repr=False)

    def __post_init__(self) -> None:
        matrix = np.array(self.H_rgb_fir, dtype=np.float64)
        fir, rgb = self.fir_size_wh, self.rgb_size_wh
        if matrix.shape != (3, 3) or min(*fir, *rgb) < 1:
            raise ValueError(f"expected a 3x3 matrix and sizes >= 1, got {matrix.shape}, {fir} and {rgb}")
        if fault := fault_of(matrix, fir, rgb):
            raise ValueError(fault)
        spans = valid_spans(matrix, fir, rgb)
        x, y, w, h = crop = largest_rectangle(spans)
        if not w:
            raise ValueError("the thermal image covers no RGB pixel")
        identity = fir == rgb and np.array_equal(matrix, np.eye(3))
        mask = _mask(spans, rgb[0])
        values = {
            "H_rgb_fir": _locked(matrix),
            "mask": _locked(mask),
            "coverage": float(np.maximum(spans[1] - spans[0], 0).sum()) / mask.size,
            "full": crop == (0, 0, *rgb),
            "crop_xywh": crop,
            "border_ltrb": (x, y, rgb[0] - x - w, rgb[1] - y - h),
            "is_identity": identity,
            "_sampling": None if identity else _sampling_maps(matrix, fir, rgb),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def apply(self, index: NDArray[np.uint8], out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """`index` (h x w uint8, thermal grid) sampled bilinearly on the RGB grid: H x W uint8.

        The result is written to `out` where given and returned; when `is_identity` it is `index` itself
        and `out` stays as it is. A grey level differs from exact interpolation by less than one before
        rounding. Outside `mask` values are finite and mean nothing (edge pixels drawn out).
        """
        shape = self.fir_size_wh[::-1]
        if index.shape != shape or index.dtype != np.uint8:
            raise ValueError(f"expected {shape} uint8 on the thermal grid, got {index.shape} {index.dtype}")
        if self._sampling is None:
            return index
        from fusion.kernels import resample  # compiled code: loaded when the first frame needs it

        return resample(np.ascontiguousarray(index), *self._sampling, out)

    def counts(self, fir: Counts) -> NDArray[np.uint16]:
        """The counts (h x w uint8 or uint16, thermal grid) on the RGB grid: H x W uint16, 0 outside `mask`.

        Sampled bilinearly where `apply` samples, with its rounding. Always a new array. Raises `ValueError`
        for another size or type.
        """
        fir = checked_counts(fir, self.fir_size_wh)
        if self._sampling is None:
            return np.array(fir, np.uint16)
        from fusion.kernels16 import resample_counts

        return resample_counts(fir, *self._sampling, self.mask)

    def rgb(self, bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The RGB image on the grid of the result: itself. (Warps from a rig may undistort it.)"""
        return bgr


def checked_counts(fir: Counts, fir_size_wh: Size) -> Counts:
    """`fir`, if it is h x w uint8 or uint16 of the thermal grid. Raises `ValueError`."""
    shape = tuple(fir_size_wh[::-1])
    if fir.shape != shape or fir.dtype not in (np.uint8, np.uint16):
        what = f"expected {shape} uint8 or uint16 on the thermal grid, got {fir.shape} {fir.dtype}"
        raise ValueError(what)
    return fir


def _inverse(H_rgb_fir: NDArray[np.float64], fir_size_wh: Size) -> NDArray[np.float64]:
    """H_fir_rgb, scaled so that its denominator is positive where the thermal image lands."""
    matrix = np.asarray(H_rgb_fir, dtype=np.float64)
    centre = matrix[2] @ [(fir_size_wh[0] - 1) / 2, (fir_size_wh[1] - 1) / 2, 1.0]
    return np.linalg.inv(matrix / centre)


def _mask(spans: Spans, width: int) -> NDArray[np.uint8]:
    first, stop = spans
    mask = np.zeros((len(first), width), np.uint8)
    for row, a, b in zip(mask, first, stop, strict=True):
        row[a:b] = 255
    return mask


def _sampling_maps(
    H_rgb_fir: NDArray[np.float64], fir_size_wh: Size, rgb_size_wh: Size
) -> tuple[NDArray[np.uint32], NDArray[np.uint16]]:
    """For each RGB pixel y0 * w + x0 (uint32) and fy << 8 | fx in 1/256 px (uint16), both H x W."""
    (w, h), (W, H) = fir_size_wh, rgb_size_wh
    G = _inverse(H_rgb_fir, fir_size_wh)
    offset, fraction = np.empty((H, W), np.uint32), np.empty((H, W), np.uint16)
    u, step = np.arange(W, dtype=np.float64), max(1, _BLOCK_PIXELS // W)
    for top in range(0, H, step):
        rows = slice(top, min(top + step, H))
        v = np.arange(rows.start, rows.stop, dtype=np.float64)[:, None]
        # At and behind the horizon there is no position; such pixels are outside the mask, any value will do.
        z = np.maximum(G[2, 0] * u + (G[2, 1] * v + G[2, 2]), 1e-9)
        qx = _quantised((G[0, 0] * u + (G[0, 1] * v + G[0, 2])) / z, w)
        qy = _quantised((G[1, 0] * u + (G[1, 1] * v + G[1, 2])) / z, h)
        offset[rows] = (qy >> 8).astype(np.uint32) * np.uint32(w) + (qx >> 8).astype(np.uint32)
        fraction[rows] = (qy & 255) << 8 | (qx & 255)
    return _locked(offset), _locked(fraction)


def _quantised(position: NDArray[np.float64], count: int) -> NDArray[np.int32]:
    """Positions kept on [0, count - 1], rounded to whole 1/256 px."""
    np.clip(position, 0, count - 1, out=position)
    position *= STEPS
    return np.rint(position, out=position).astype(np.int32)


def _locked(array: _A) -> _A:
    array.setflags(write=False)
    return array
