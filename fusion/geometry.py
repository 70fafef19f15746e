"""Poses (`T_dst_src`, 4 x 4) and camera models (project, unproject): pure arrays, float64.

Cameras: x right, y down, z forward; pixel (0, 0) is the centre of the top-left one. LiDAR: x forward,
y left, z up. A model's `project` takes N x 3 points in metres of the camera's frame to N x 2 pixels (u, v)
and says which of them the model can see; `unproject` takes N x 2 pixels to N x 3 unit vectors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion.errors import UsageError

Floats = NDArray[np.float64]

# A camera at the LiDAR's origin that looks along +x, upright.
T_CAM_LIDAR = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], np.float64)
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
    if M.shape != (4, 4) or not np.isfinite(M).all():
        raise UsageError(f"a transformation has 4x4 finite numbers, not {M.shape}", where=where)
    R = M[:3, :3]
    if np.abs(M[3] - (0, 0, 0, 1)).max() > 0 or np.abs(R @ R.T - np.eye(3)).max() > RIGID_TOLERANCE:
        hint = "the upper left 3x3 must be a rotation, the last row 0 0 0 1, lengths in metres"
        raise UsageError(
            "the transformation is not rigid (singular, scaled or sheared)", where=where, hint=hint
        )
    if np.linalg.det(R) < 0:
        raise UsageError(
            "the transformation mirrors: its determinant is -1", where=where, hint="check the axes"
        )
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-12:
        left, _, right = np.linalg.svd(R)
        R = left @ right
    return pose(R, M[:3, 3])


def rotation_of_quat(quat_wxyz: ArrayLike) -> Floats:
    """3 x 3 rotation(s) of unit quaternion(s) (w, x, y, z): ... x 4 gives ... x 3 x 3."""
    q = np.asarray(quat_wxyz, np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
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


def checked_fov(fov_deg: float, below_deg: float, what: str) -> float:
    """The angle in radians; `UsageError` unless 0 < fov < `below_deg`."""
    if not (math.isfinite(fov_deg) and 0 < fov_deg < below_deg):
        hint = f"more than 0 and less than {below_deg:g} degrees"
        raise UsageError(f"a {what} camera cannot have a field of view of {fov_deg:g} degrees", hint=hint)
    return math.radians(fov_deg)


@dataclass(frozen=True, slots=True)
class PinholeCamera:
    """Pinhole with the distortion of OpenCV: (), (k1 k2 p1 p2), (… k3) or (… k4 k5 k6), in this order.

    Beyond the radius where the distorted radius stops growing, points would fold back into the picture;
    `project` says that it cannot see them.
    """

    size_wh: tuple[int, int]
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    has_axis: ClassVar[bool] = True

    def __post_init__(self) -> None:
        checked_size(self.size_wh)
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not all(map(math.isfinite, numbers)) or self.fx <= 0 or self.fy <= 0:
            raise UsageError(
                f"a camera's focal lengths must be positive numbers, not {self.fx:g}, {self.fy:g}"
            )
        if len(self.distortion) not in (0, 4, 5, 8):
            raise UsageError(f"{len(self.distortion)} distortion coefficients", hint="none, 4, 5 or 8")

    @classmethod
    def of_fov(cls, size_wh: tuple[int, int], fov_deg: float) -> PinholeCamera:
        """Square pixels, centred, `fov_deg` from the left edge of the picture to the right one."""
        half = checked_fov(fov_deg, 180, "pinhole") / 2
        checked_size(size_wh)
        f = size_wh[0] / 2 / math.tan(half)
        return cls(size_wh, f, f, (size_wh[0] - 1) / 2, (size_wh[1] - 1) / 2)

    def matrix(self) -> Floats:
        """The 3 x 3 camera matrix."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    def project(self, xyz_m: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        x, y, z = np.asarray(xyz_m, np.float64).T
        seen = z > 0
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = x / z, y / z
            if any(self.distortion):
                seen = seen & (a * a + b * b < self.valid_radius() ** 2)
                a, b = self._distort(a, b)
        return np.stack([self.fx * a + self.cx, self.fy * b + self.cy], -1), seen

    def unproject(self, uv: Floats) -> Floats:
        u, v = np.asarray(uv, np.float64).T
        a0, b0 = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        a, b = self._undistort(a0, b0) if any(self.distortion) else (a0, b0)
        return _unit(np.stack([a, b, np.ones_like(a)], -1))

    def valid_radius(self) -> float:
        """The largest tan(angle to the axis) up to which the distorted radius grows."""
        if not any(self.distortion):
            return math.inf
        r = np.linspace(0, 10, 20_001)[1:]
        falling = np.flatnonzero(np.diff(r * self._radial(r * r), prepend=0.0) <= 0)
        return (
            float(r[falling[0] - 1])
            if falling.size and falling[0]
            else (math.inf if not falling.size else 0.0)
        )

    def _coefficients(self) -> tuple[float, ...]:
        return (*self.distortion, *([0.0] * (8 - len(self.distortion))))

    def _radial(self, r2: Floats) -> Floats:
        k1, k2, _, _, k3, k4, k5, k6 = self._coefficients()
        return (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))

    def _distort(self, a: Floats, b: Floats) -> tuple[Floats, Floats]:
        _, _, p1, p2, *_ = self._coefficients()
        r2 = a * a + b * b
        k = self._radial(r2)
        return (
            a * k + 2 * p1 * a * b + p2 * (r2 + 2 * a * a),
            b * k + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b,
        )

    def _undistort(self, a0: Floats, b0: Floats) -> tuple[Floats, Floats]:
        """Newton's method, the Jacobian from differences; NaN where it does not arrive."""
        a, b, h = a0.copy(), b0.copy(), 1e-6
        limit = min(self.valid_radius(), 1e3)
        with np.errstate(all="ignore"):
            for _ in range(30):
                fa, fb = self._distort(a, b)
                ra, rb = fa - a0, fb - b0
                (pa, pb), (ma, mb) = self._distort(a + h, b), self._distort(a - h, b)
                (qa, qb), (na, nb) = self._distort(a, b + h), self._distort(a, b - h)
                aa, ba, ab, bb = (pa - ma) / 2 / h, (pb - mb) / 2 / h, (qa - na) / 2 / h, (qb - nb) / 2 / h
                det = aa * bb - ab * ba
                a, b = a - (bb * ra - ab * rb) / det, b - (aa * rb - ba * ra) / det
                shrink = np.minimum(1, limit / np.maximum(np.hypot(a, b), 1e-12))
                a, b = a * shrink, b * shrink
            fa, fb = self._distort(a, b)
            arrived = np.hypot(fa - a0, fb - b0) < 1e-9
        return np.where(arrived, a, np.nan), np.where(arrived, b, np.nan)


@dataclass(frozen=True, slots=True)
class FisheyeCamera:
    """Kannala-Brandt: radius = f (t + k1 t^3 + k2 t^5 + k3 t^7 + k4 t^9), t the angle to the axis.

    Without coefficients it is the equidistant fisheye.
    """

    size_wh: tuple[int, int]
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        checked_size(self.size_wh)
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not all(map(math.isfinite, numbers)) or self.fx <= 0 or self.fy <= 0:
            raise UsageError(
                f"a camera's focal lengths must be positive numbers, not {self.fx:g}, {self.fy:g}"
            )
        if len(self.distortion) not in (0, 4):
            raise UsageError(f"{len(self.distortion)} fisheye coefficients", hint="none or 4")

    @classmethod
    def of_fov(cls, size_wh: tuple[int, int], fov_deg: float) -> FisheyeCamera:
        """Equidistant, centred, `fov_deg` from the left edge to the right one."""
        f = size_wh[0] / checked_fov(fov_deg, 360, "fisheye")
        checked_size(size_wh)
        return cls(size_wh, f, f, (size_wh[0] - 1) / 2, (size_wh[1] - 1) / 2)

    @property
    def has_axis(self) -> bool:
        """Whether all of the picture looks forward (less than 90 degrees off the axis in its corners)."""
        w, h = self.size_wh
        corner = np.hypot(
            max(self.cx + 0.5, w - 0.5 - self.cx) / self.fx, max(self.cy + 0.5, h - 0.5 - self.cy) / self.fy
        )
        return bool(corner < self._radius(np.array(np.pi / 2)))

    def valid_angle(self) -> float:
        """The largest angle to the axis, at most pi, up to which the radius grows."""
        t = np.linspace(0, np.pi, 20_001)[1:]
        falling = np.flatnonzero(np.diff(self._radius(t), prepend=0.0) <= 0)
        return float(t[falling[0] - 1]) if falling.size else math.pi

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
        low, high = np.zeros_like(r), np.full_like(r, top)
        for _ in range(60):  # bisection: the radius grows all the way to `top`
            middle = (low + high) / 2
            below = self._radius(middle) < r
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        t = np.where(r <= self._radius(np.array(top)), (low + high) / 2, np.nan)
        scale = np.divide(np.sin(t), r, out=np.ones_like(r), where=r > 0)
        return np.stack([scale * a, scale * b, np.cos(t)], -1)

    def _radius(self, t: Floats) -> Floats:
        k1, k2, k3, k4 = self.distortion or (0.0, 0.0, 0.0, 0.0)
        t2 = t * t
        return t * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))


@dataclass(frozen=True, slots=True)
class CylindricalCamera:
    """Columns are even steps of azimuth, rows even steps of height on a cylinder of radius 1 around y."""

    size_wh: tuple[int, int]
    fov_deg: float
    has_axis: ClassVar[bool] = False

    def __post_init__(self) -> None:
        checked_size(self.size_wh)
        checked_fov(self.fov_deg, 360.0001, "cylindrical")

    @property
    def f(self) -> float:
        """Pixels a radian, and pixels a unit of height."""
        return self.size_wh[0] / math.radians(self.fov_deg)

    def project(self, xyz_m: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        x, y, z = np.asarray(xyz_m, np.float64).T
        away = np.hypot(x, z)
        height = np.divide(y, away, out=np.full_like(y, np.nan), where=away > 0)
        return _around(self, np.arctan2(x, z), height), away > 0

    def unproject(self, uv: Floats) -> Floats:
        azimuth, height = _off_centre(self, uv)
        return _unit(np.stack([np.sin(azimuth), height, np.cos(azimuth)], -1))


@dataclass(frozen=True, slots=True)
class SphericalCamera:
    """Columns are even steps of azimuth, rows even steps of elevation (equirectangular)."""

    size_wh: tuple[int, int]
    fov_deg: float
    has_axis: ClassVar[bool] = False

    def __post_init__(self) -> None:
        checked_size(self.size_wh)
        checked_fov(self.fov_deg, 360.0001, "spherical")

    @property
    def f(self) -> float:
        """Pixels a radian, both ways."""
        return self.size_wh[0] / math.radians(self.fov_deg)

    def project(self, xyz_m: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        x, y, z = np.asarray(xyz_m, np.float64).T
        away = np.hypot(x, z)
        return _around(self, np.arctan2(x, z), np.arctan2(y, away)), (away > 0) | (y != 0)

    def unproject(self, uv: Floats) -> Floats:
        azimuth, down = _off_centre(self, uv)
        directions = [np.cos(down) * np.sin(azimuth), np.sin(down), np.cos(down) * np.cos(azimuth)]
        return np.where(np.abs(down)[:, None] <= np.pi / 2, np.stack(directions, -1), np.nan)


def _around(camera: CylindricalCamera | SphericalCamera, azimuth: Floats, down: Floats) -> Floats:
    w, h = camera.size_wh
    u, v = camera.f * azimuth + (w - 1) / 2, camera.f * down + (h - 1) / 2
    if camera.fov_deg >= 360:  # +180 degrees is the left edge, as -180 is
        u = np.where(u >= w - 0.5, u - w, u)
    return np.stack([u, v], -1)


def _off_centre(camera: CylindricalCamera | SphericalCamera, uv: Floats) -> tuple[Floats, Floats]:
    u, v = np.asarray(uv, np.float64).T
    return (u - (camera.size_wh[0] - 1) / 2) / camera.f, (v - (camera.size_wh[1] - 1) / 2) / camera.f


def _unit(xyz: Floats) -> Floats:
    return xyz / np.linalg.norm(xyz, axis=-1, keepdims=True)
