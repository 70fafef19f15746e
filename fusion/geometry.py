"""Poses (`T_dst_src`, 4 x 4) and camera models (project, unproject): pure arrays, float64.

Cameras: x right, y down, z forward; pixel (0, 0) is the centre of the top-left one. LiDAR: x forward,
y left, z up. A model's `project` takes N x 3 points in metres of the camera's frame to N x 2 pixels (u, v)
and says which of them the model can see; `unproject` takes N x 2 pixels to N x 3 unit vectors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion.errors import UsageError

Floats = NDArray[np.float64]

# A camera at the LiDAR's origin that looks along +x, upright.
T_CAM_LIDAR = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], np.float64)
_LARGEST_COEFFICIENT = 1e9
_TABLE = 1024  # places a table of distorted radii has
_SETTLED = 1e-11  # a step of Newton's method after which the next changes nothing that a double holds
RIGID_TOLERANCE = 1e-4  # calibration files are written with few decimals


# --- poses


def pose(
    rotation: ArrayLike = ((1, 0, 0), (0, 1, 0), (0, 0, 1)), translation_m: ArrayLike = (0, 0, 0)
) -> Floats:
    """The 4 x 4 matrix of a 3 x 3 rotation and a translation in metres."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation_m
    return T


def invert(T_dst_src: Floats) -> Floats:
    """T_src_dst of a rigid T_dst_src."""
    R = T_dst_src[:3, :3]
    return pose(R.T, -R.T @ T_dst_src[:3, 3])


def transform(T_dst_src: Floats, xyz_m: NDArray[np.floating[Any]]) -> Floats:
    """N x 3 points of frame `src` in frame `dst`, float64."""
    return np.asarray(xyz_m, np.float64) @ T_dst_src[:3, :3].T + T_dst_src[:3, 3]


def checked_pose(T: ArrayLike, where: object = "") -> Floats:
    """`T` as a 4 x 4 (or 3 x 4) rigid transformation, its rotation made orthonormal.

    Raises `UsageError` where it is not finite, not rigid to 1e-4, a reflection, or of another shape.
    """
    M = np.array(T, np.float64)
    if M.shape == (3, 4):
        M = np.vstack([M, (0, 0, 0, 1)])
    if M.shape != (4, 4):
        raise UsageError(f"a transformation has 4x4 or 3x4 numbers, not {M.shape}", where=where)
    if not np.isfinite(M).all():
        raise UsageError("the transformation holds a number that is not finite", where=where)
    R = M[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # huge numbers: NaN, which is not close
        rigid = bool(np.abs(R @ R.T - np.eye(3)).max() <= RIGID_TOLERANCE)
    if not rigid or (M[3] != (0, 0, 0, 1)).any():
        what = "the transformation is not rigid (singular, scaled or sheared)"
        hint = "the upper left 3x3 must be a rotation, the last row 0 0 0 1, lengths in metres"
        raise UsageError(what, where=where, hint=hint)
    if np.linalg.det(R) < 0:
        raise UsageError("the transformation mirrors (determinant -1)", where=where, hint="check the axes")
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-12:
        left, _, right = np.linalg.svd(R)
        R = left @ right
    return pose(R, M[:3, 3])


def rotation_of_quat(quat_wxyz: ArrayLike) -> Floats:
    """3 x 3 rotation(s) of quaternion(s) (w, x, y, z), made unit: ... x 4 gives ... x 3 x 3.

    Raises `ValueError` for one that is zero or not finite.
    """
    q = np.asarray(quat_wxyz, np.float64)
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    if not ((length > 0) & np.isfinite(length)).all():
        raise ValueError("expected quaternions of finite length above 0")
    w, x, y, z = np.moveaxis(q / length, -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, -1) for row in rows], -2)


def quat_of_rotation(R: ArrayLike) -> Floats:
    """The unit quaternion (w, x, y, z), w >= 0, of a 3 x 3 rotation."""
    R = np.asarray(R, np.float64)
    # The eigenvector of the largest eigenvalue (Bar-Itzhack 2000): no case is special.
    xx, xy, xz, yx, yy, yz, zx, zy, zz = R.ravel()
    K = np.array(
        [
            [xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, yy - xx - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, zz - xx - yy],
        ]
    )
    q = np.linalg.eigh(K)[1][:, -1]
    return q if q[0] >= 0 else -q


# --- camera models


class Camera(Protocol):
    """How directions become pixels."""

    @property
    def size_wh(self) -> tuple[int, int]: ...

    @property
    def has_axis(self) -> bool:
        """Whether depth along z is positive for all that it sees: else only range makes sense."""
        ...

    def project(self, xyz_m: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Pixels N x 2, and which of the points the model can see at all: in frame or not."""
        ...

    def unproject(self, uv: Floats) -> Floats:
        """Unit vectors N x 3 of pixels N x 2; NaN where no direction falls there."""
        ...


def checked_size(size_wh: tuple[int, int]) -> None:
    if not all(isinstance(n, int | np.integer) and 1 <= n <= 1 << 15 for n in size_wh):
        raise UsageError(f"an image of {size_wh[0]}x{size_wh[1]} pixels", hint="1 to 32768 each way")


def checked_fov(fov_deg: float, limit_deg: float, what: str, *, inclusive: bool = False) -> float:
    """The angle in radians; `UsageError` unless 0 < fov < `limit_deg` (or equal to it if `inclusive`)."""
    if not (0 < fov_deg < limit_deg or (inclusive and fov_deg == limit_deg)):
        hint = f"more than 0, {'at most' if inclusive else 'less than'} {limit_deg:g}"
        raise UsageError(f"a {what} camera cannot have a field of view of {fov_deg:g} degrees", hint=hint)
    return math.radians(fov_deg)


@dataclass(frozen=True, slots=True)
class _Lens:
    size_wh: tuple[int, int]
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    _counts: ClassVar[tuple[int, ...]] = (0, 4)

    def __post_init__(self) -> None:
        checked_size(self.size_wh)
        if not (0 < self.fx < math.inf and 0 < self.fy < math.inf):
            raise UsageError(f"focal lengths must be positive numbers, not {self.fx:g}, {self.fy:g}")
        if not (math.isfinite(self.cx) and math.isfinite(self.cy)):
            raise UsageError(f"the centre must be finite numbers, not {self.cx:g}, {self.cy:g}")
        if len(self.distortion) not in self._counts:
            raise UsageError(f"{len(self.distortion)} distortion coefficients", hint=f"one of {self._counts}")
        if not all(abs(k) <= _LARGEST_COEFFICIENT for k in self.distortion):  # NaN is not, either
            raise UsageError(f"distortion out of all bounds: {list(self.distortion)}")


def _least_root(*polynomials: Floats) -> float:
    """The least positive root of polynomials 1 + c1 s + c2 s^2 + ..., inf where there is none."""
    # Read backwards they are polynomials in 1/s with leading coefficient 1: nothing to divide by.
    inverse = np.concatenate([np.roots(p) for p in polynomials])
    real = inverse.real[(inverse.imag == 0) & (inverse.real > 0)]
    return float(1 / real.max()) if real.size else math.inf


def _inverse(radius: Callable[[Floats], Floats], values: Floats, top: float, steps: int) -> Floats:
    """Where in [0, top], all of which it grows, `radius` has these values: by bisection."""
    low, high = np.zeros_like(values), np.full_like(values, top)
    for _ in range(steps):
        middle = (low + high) / 2
        below = radius(middle) < values
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return (low + high) / 2


@dataclass(frozen=True, slots=True)
class PinholeCamera(_Lens):
    """Pinhole with the distortion of OpenCV: (), (k1 k2 p1 p2), (… k3) or (… k4 k5 k6), in this order.

    Where the distorted radius stops growing, points would fold back into the picture (with tangential
    distortion: where the map turns over); `project` says that it cannot see them, nor what lies beyond.
    """

    _counts: ClassVar[tuple[int, ...]] = (0, 4, 5, 8)

    @classmethod
    def of_fov(cls, size_wh: tuple[int, int], fov_deg: float) -> PinholeCamera:
        """Square pixels, centred, `fov_deg` from the left edge of the picture to the right one."""
        checked_size(size_wh)
        f = size_wh[0] / 2 / math.tan(checked_fov(fov_deg, 180, "pinhole") / 2)
        return cls(size_wh, f, f, (size_wh[0] - 1) / 2, (size_wh[1] - 1) / 2)

    @property
    def has_axis(self) -> bool:
        return True

    def matrix(self) -> Floats:
        """The 3 x 3 camera matrix."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    def project(self, xyz_m: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        x, y, z = np.asarray(xyz_m, np.float64).T
        seen = z > 0
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            a, b = x / z, y / z
            if any(self.distortion):
                seen = seen & (a * a + b * b < self.valid_radius() ** 2) & (self._growth(a, b)[3] > 0)
                a, b = self._distort(a, b)
        return np.stack([self.fx * a + self.cx, self.fy * b + self.cy], -1), seen

    def unproject(self, uv: Floats) -> Floats:
        u, v = np.asarray(uv, np.float64).T
        a0, b0 = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        a, b = self._undistort(a0, b0) if any(self.distortion) else (a0, b0)
        return _unit(np.stack([a, b, np.ones_like(a)], -1))

    def valid_radius(self) -> float:
        """The tan(angle to the axis) up to which the distorted radius grows (tangential part left out)."""
        k1, k2, _, _, k3, k4, k5, k6 = self._coefficients()
        # In s = r^2 the radius is r N / D; its derivative has the sign of N D + 2 s (N' D - N D').
        N, D = np.array([1.0, k1, k2, k3]), np.array([1.0, k4, k5, k6])
        power = np.arange(4.0)
        growth = np.convolve(N, D) + 2 * (np.convolve(power * N, D) - np.convolve(N, power * D))
        return math.sqrt(_least_root(np.asarray(growth, np.float64), D))

    def _coefficients(self) -> tuple[float, ...]:
        return (*self.distortion, *([0.0] * (8 - len(self.distortion))))

    def _radial(self, r2: Floats) -> tuple[Floats, Floats]:
        """The radial factor at a squared radius, and its derivative."""
        k1, k2, _, _, k3, k4, k5, k6 = self._coefficients()
        below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        k = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
        return k, (k1 + r2 * (2 * k2 + r2 * 3 * k3) - k * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / below

    def _growth(self, a: Floats, b: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """The derivatives of `_distort`, da'/da, da'/db = db'/da, db'/db, and their determinant."""
        _, _, p1, p2, *_ = self._coefficients()
        k, slope = self._radial(a * a + b * b)
        aa = k + 2 * a * a * slope + 2 * p1 * b + 6 * p2 * a
        ab = 2 * a * b * slope + 2 * p1 * a + 2 * p2 * b
        bb = k + 2 * b * b * slope + 6 * p1 * b + 2 * p2 * a
        return aa, ab, bb, aa * bb - ab * ab

    def _distort(self, a: Floats, b: Floats) -> tuple[Floats, Floats]:
        _, _, p1, p2, *_ = self._coefficients()
        r2 = a * a + b * b
        k, _ = self._radial(r2)
        across = a * k + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
        return across, b * k + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b

    def _undistort(self, a0: Floats, b0: Floats) -> tuple[Floats, Floats]:
        """Bisection without the tangential part, then Newton's method; NaN where no direction falls there.

        Of many pixels a table of bisections is where most can start from; the rest is done again.
        """
        r0 = np.hypot(a0, b0)
        if r0.size <= _TABLE:
            return self._newton(a0, b0, r0, self._straight(r0))
        few = np.linspace(0, r0.max(), _TABLE)
        a, b = self._newton(a0, b0, r0, np.interp(r0, few, self._straight(few)))
        left = np.isnan(a)
        if left.any():
            a0, b0, r0 = a0[left], b0[left], r0[left]
            a[left], b[left] = self._newton(a0, b0, r0, self._straight(r0))
        return a, b

    def _straight(self, r0: Floats) -> Floats:
        """Which radii come out as `r0`, without the tangential part."""
        limit = min(self.valid_radius(), 1e3)
        return _inverse(lambda at: at * self._radial(at * at)[0], r0, limit, 30)

    def _newton(self, a0: Floats, b0: Floats, r0: Floats, start: Floats) -> tuple[Floats, Floats]:
        """Which (a, b) are distorted to (a0, b0), from the radii `start` on; NaN where none is found."""
        limit = min(self.valid_radius(), 1e3)
        scale = np.divide(start, r0, out=np.ones_like(start), where=r0 > 0)
        a, b = scale * a0, scale * b0
        with np.errstate(all="ignore"):
            for _ in range(10):
                fa, fb = self._distort(a, b)
                ra, rb, (aa, ab, bb, det) = fa - a0, fb - b0, self._growth(a, b)
                da, db = (bb * ra - ab * rb) / det, (aa * rb - ab * ra) / det
                a, b = a - da, b - db
                shrink = np.minimum(1, limit / np.maximum(np.hypot(a, b), 1e-12))
                a, b = a * shrink, b * shrink
                if max(np.abs(da).max(), np.abs(db).max()) < _SETTLED:
                    break
            fa, fb = self._distort(a, b)
            arrived = np.hypot(fa - a0, fb - b0) < 1e-9 * np.maximum(1, r0)
            arrived &= self._growth(a, b)[3] > 0
        return np.where(arrived, a, np.nan), np.where(arrived, b, np.nan)


@dataclass(frozen=True, slots=True)
class FisheyeCamera(_Lens):
    """Kannala-Brandt: radius = f (t + k1 t^3 + k2 t^5 + k3 t^7 + k4 t^9), t the angle to the axis.

    Without coefficients it is the equidistant fisheye.
    """

    @classmethod
    def of_fov(cls, size_wh: tuple[int, int], fov_deg: float) -> FisheyeCamera:
        """Equidistant, centred, `fov_deg` from the left edge to the right one."""
        f = size_wh[0] / checked_fov(fov_deg, 360, "fisheye")
        checked_size(size_wh)
        return cls(size_wh, f, f, (size_wh[0] - 1) / 2, (size_wh[1] - 1) / 2)

    @property
    def has_axis(self) -> bool:
        """Whether all that it sees is less than 90 degrees off the axis, in the picture's corners too."""
        if self.valid_angle() <= np.pi / 2:
            return True
        w, h = self.size_wh
        corner = np.hypot(
            max(self.cx + 0.5, w - 0.5 - self.cx) / self.fx, max(self.cy + 0.5, h - 0.5 - self.cy) / self.fy
        )
        return bool(corner < self._radius(np.array(np.pi / 2)))

    def valid_angle(self) -> float:
        """The largest angle to the axis, at most pi, up to which the radius grows."""
        k1, k2, k3, k4 = self.distortion or (0.0, 0.0, 0.0, 0.0)
        return min(math.pi, math.sqrt(_least_root(np.array([1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4]))))

    def project(self, xyz_m: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        x, y, z = np.asarray(xyz_m, np.float64).T
        across = np.hypot(x, y)
        t = np.arctan2(across, z)
        scale = np.divide(self._radius(t), across, out=np.zeros_like(t), where=across > 0)
        seen = (t < self.valid_angle()) & ((across > 0) | (z > 0))
        return np.stack([self.fx * scale * x + self.cx, self.fy * scale * y + self.cy], -1), seen

    def unproject(self, uv: Floats) -> Floats:
        u, v = np.asarray(uv, np.float64).T
        a, b = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        r, top = np.hypot(a, b), self.valid_angle()
        t = np.where(r <= self._radius(np.array(top)), _inverse(self._radius, r, top, 60), np.nan)
        scale = np.divide(np.sin(t), r, out=np.ones_like(r), where=r != 0)
        return np.stack([scale * a, scale * b, np.cos(t)], -1)

    def _radius(self, t: Floats) -> Floats:
        k1, k2, k3, k4 = self.distortion or (0.0, 0.0, 0.0, 0.0)
        t2 = t * t
        return t * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))


@dataclass(frozen=True, slots=True)
class _AllRound:
    size_wh: tuple[int, int]
    fov_deg: float

    @property
    def has_axis(self) -> bool:
        return False

    def __post_init__(self) -> None:
        checked_size(self.size_wh)
        what = type(self).__name__.removesuffix("Camera").lower()
        checked_fov(self.fov_deg, 360, what, inclusive=True)

    @property
    def f(self) -> float:
        """Pixels a radian of azimuth; down, pixels a unit of what the model's rows are even steps of."""
        return self.size_wh[0] / math.radians(self.fov_deg)

    def _pixels(self, azimuth: Floats, down: Floats) -> Floats:
        w, h = self.size_wh
        u, v = self.f * azimuth + (w - 1) / 2, self.f * down + (h - 1) / 2
        if self.fov_deg >= 360:  # +180 degrees is the left edge, as -180 is, whatever rounding does
            u = np.maximum(np.where(u >= w - 0.5, u - w, u), -0.5)
        return np.stack([u, v], -1)

    def _off_centre(self, uv: Floats) -> tuple[Floats, Floats]:
        u, v = np.asarray(uv, np.float64).T
        return (u - (self.size_wh[0] - 1) / 2) / self.f, (v - (self.size_wh[1] - 1) / 2) / self.f


@dataclass(frozen=True, slots=True)
class CylindricalCamera(_AllRound):
    """Columns are even steps of azimuth, rows even steps of height on a cylinder of radius 1 around y."""

    def project(self, xyz_m: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        x, y, z = np.asarray(xyz_m, np.float64).T
        away = np.hypot(x, z)
        with np.errstate(over="ignore"):
            height = np.divide(y, away, out=np.full_like(y, np.nan), where=away > 0)
        return self._pixels(np.arctan2(x, z), height), away > 0

    def unproject(self, uv: Floats) -> Floats:
        azimuth, height = self._off_centre(uv)
        return _unit(np.stack([np.sin(azimuth), height, np.cos(azimuth)], -1))


@dataclass(frozen=True, slots=True)
class SphericalCamera(_AllRound):
    """Columns are even steps of azimuth, rows even steps of elevation (equirectangular)."""

    def project(self, xyz_m: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        x, y, z = np.asarray(xyz_m, np.float64).T
        away = np.hypot(x, z)
        return self._pixels(np.arctan2(x, z), np.arctan2(y, away)), np.hypot(away, y) > 0

    def unproject(self, uv: Floats) -> Floats:
        azimuth, down = self._off_centre(uv)
        directions = [np.cos(down) * np.sin(azimuth), np.sin(down), np.cos(down) * np.cos(azimuth)]
        return np.where(np.abs(down)[:, None] <= np.pi / 2, np.stack(directions, -1), np.nan)


def _unit(xyz: Floats) -> Floats:
    return xyz / np.linalg.norm(xyz, axis=-1, keepdims=True)
