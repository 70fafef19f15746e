"""The two cameras of a rig as a warp needs them, and the tables that warps are made of."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fusion.errors import UsageError
from fusion.geometry import Floats, PinholeCamera, invert
from fusion.rig import Rig, RigCamera
from fusion.warp import STEPS, Size

Value = Literal["depth", "range"]
Sampling = tuple[NDArray[np.uint32], NDArray[np.uint16]]

MARGIN_PX = 0.5 + 0.5 / STEPS  # as in `fusion.warp`
_BLOCK_PIXELS = 1 << 15
_LARGEST_FOCAL_GROWTH = 16.0


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """The two cameras of a rig as a warp needs them.

    `rgb` and `fir` are the cameras, `T_fir_rgb` takes points of the RGB camera's frame to the thermal one's.
    `output` is the camera of the frames that come out: `rgb` itself, or, with `undistort`, a pinhole without
    distortion, its focal lengths those of `rgb`, longer if some pixel would otherwise see past its picture.
    """

    rgb: RigCamera
    fir: RigCamera
    T_fir_rgb: Floats
    output: RigCamera

    @classmethod
    def of(cls, rig: Rig, fir_size_wh: Size, rgb_size_wh: Size, undistort: bool = False) -> Views:
        """Raises `UsageError` where the rig lacks a camera or a transformation, or is for other sizes."""
        rgb, fir = rig.camera("rgb"), rig.camera("fir")
        for role, camera, size in (("RGB", rgb, rgb_size_wh), ("thermal", fir, fir_size_wh)):
            if tuple(camera.size_wh) != tuple(size):
                hint = "a rig holds for the image size that it was calibrated at"
                what = f"the rig's {role} camera has {wh(camera.size_wh)} pixels, the images {wh(size)}"
                raise UsageError(what, hint=hint)
        return cls(rgb, fir, invert(rig.pose("rgb", "fir")), _rectified(rgb) if undistort else rgb)

    def rays(self, uv: Floats) -> Floats:
        """Unit directions N x 3, RGB camera's frame, of pixels of the output; NaN where none falls there."""
        return self.output.unproject(uv)

    def per_value(self, rays: Floats, value: Value) -> Floats:
        """Rays scaled to one unit of `value`: along the axis or from the centre; NaN behind the axis."""
        if value == "range":
            return rays
        return rays / np.where(rays[:, 2:] > 0, rays[:, 2:], np.nan)

    @property
    def value(self) -> Value:
        """What distances count along: the RGB camera's axis, or the ray, where it looks all round."""
        return "depth" if self.rgb.has_axis else "range"

    def thermal_px(self, rays: Floats, metres: float) -> tuple[Floats, NDArray[np.bool_]]:
        """Where in the thermal image (N x 2) things lie `metres` off, and whether it can be seen there."""
        R, t = self.T_fir_rgb[:3, :3], self.T_fir_rgb[:3, 3]
        points = rays @ R.T if math.isinf(metres) else self.per_value(rays, self.value) @ R.T * metres + t
        with np.errstate(invalid="ignore", over="ignore"):
            return self.fir.project(points)


def _rectified(camera: RigCamera) -> PinholeCamera:
    """The pinhole without distortion that sees only what is in the picture of `camera`."""
    if not any(camera.distortion) and isinstance(camera, PinholeCamera):
        return camera
    w, h = camera.size_wh
    edge = np.concatenate(
        [
            np.stack(np.meshgrid(np.arange(w), (0, h - 1)), -1).reshape(-1, 2),
            np.stack(np.meshgrid((0, w - 1), np.arange(h)), -1).reshape(-1, 2),
        ]
    ).astype(np.float64)

    def pinhole(growth: float) -> PinholeCamera:
        return PinholeCamera((w, h), growth * camera.fx, growth * camera.fy, camera.cx, camera.cy)

    def fits(growth: float) -> bool:
        with np.errstate(invalid="ignore"):
            xy, seen = camera.project(pinhole(growth).unproject(edge))
        return bool((seen & inside(xy, (w, h), 0.5 + 1e-6)).all())

    if fits(1.0):
        return pinhole(1.0)
    low, high = 1.0, _LARGEST_FOCAL_GROWTH
    if not fits(high):
        raise UsageError("the RGB camera's distortion leaves no picture to undistort", hint="check the rig")
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (low, middle) if fits(middle) else (middle, high)
    return pinhole(high)


def blocks(size_wh: Size) -> Iterator[tuple[slice, Floats]]:
    """The rows of a picture, a few at a time, and their pixels N x 2."""
    w, h = size_wh
    step = max(1, _BLOCK_PIXELS // w)
    for top in range(0, h, step):
        rows = slice(top, min(top + step, h))
        v, u = np.mgrid[rows, :w]
        yield rows, np.stack([u.ravel(), v.ravel()], -1).astype(np.float64)


def inside(xy: Floats, size_wh: Size, margin_px: float = MARGIN_PX) -> NDArray[np.bool_]:
    w, h = size_wh
    with np.errstate(invalid="ignore"):
        return np.all((xy >= -margin_px) & (xy <= (w - 1 + margin_px, h - 1 + margin_px)), axis=-1)


def sampling_of(xy: Floats, seen: NDArray[np.bool_], size_wh: Size) -> tuple[Any, Any]:
    """y0 w + x0 and fy << 8 | fx of positions, as `fusion.kernels.resample` reads them; 0 where not seen."""
    w, h = size_wh
    held = np.where(seen[:, None], np.clip(xy, 0, (w - 1, h - 1)), 0)
    qx, qy = np.rint(held * STEPS).astype(np.int64).T
    return ((qy >> 8) * w + (qx >> 8)).astype(np.uint32), ((qy & 255) << 8 | (qx & 255)).astype(np.uint16)


def positions(
    offset: NDArray[np.uint32], fraction: NDArray[np.uint16], mask: NDArray[np.uint8], size_wh: Size
) -> Floats:
    row, column = np.divmod(offset.astype(np.int64), size_wh[0])
    x, y = column + (fraction & 255) / STEPS, row + (fraction >> 8) / STEPS
    return np.where(mask[..., None] > 0, np.stack([x, y], -1), np.nan)


def checked_index(index: NDArray[np.uint8], views: Views) -> NDArray[np.uint8]:
    shape = views.fir.size_wh[::-1]
    if index.shape != shape or index.dtype != np.uint8:
        raise ValueError(f"expected {shape} uint8 on the thermal grid, got {index.shape} {index.dtype}")
    return np.ascontiguousarray(index)


def locked(array: Any) -> Any:
    array.setflags(write=False)
    return array


def wh(size_wh: Sequence[int]) -> str:
    return f"{size_wh[0]}x{size_wh[1]}"
