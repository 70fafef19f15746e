"""Warps from a rig: OpenCV and plain geometry as oracles, scenes whose hidden pixels are known one by one."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from fusion import rig_warp_kernels as loops
from fusion.errors import FrameError, UsageError
from fusion.geometry import FisheyeCamera, Floats, PinholeCamera, invert, pose, transform
from fusion.rig import Rig, RigCamera
from fusion.rig_warp import DepthWarp, RigWarp, Views, parallax_px
from fusion.warp import Warp

RGB_WH, FIR_WH = (96, 72), (80, 64)
STEP = 1 / 512 + 1e-4  # positions are rounded to 1/256 px; OpenCV undistorts to 1e-5 px or so

PINHOLE = PinholeCamera(RGB_WH, 60, 61, 48.3, 35.1)
RADIAL = PinholeCamera(RGB_WH, 60, 61, 48.3, 35.1, (-0.19, 0.035, 4e-4, -3e-4, 0.002))
CUSHION = PinholeCamera(RGB_WH, 60, 61, 48.3, 35.1, (0.12, 0.01, 0, 0))
RATIONAL = PinholeCamera(FIR_WH, 72, 71, 41.2, 30.4, (0.3, -0.02, -5e-4, 6e-4, 0.001, 0.5, 0.03, 0.002))
FISHEYE = FisheyeCamera(FIR_WH, 68, 69, 40.5, 32.2, (-0.02, 0.004, -0.001, 0.0))
FISHEYE_RGB = FisheyeCamera(RGB_WH, 52, 51, 47.1, 36.4, (0.01, -0.003, 0.001, 0.0))
PLAIN_FIR = PinholeCamera(FIR_WH, 72, 71, 41.2, 30.4)


def turned(x: float = 0.02, y: float = -0.03, z: float = 0.015) -> Floats:
    return np.asarray(cv2.Rodrigues(np.array([x, y, z]))[0], np.float64)


def rig_of(rgb: RigCamera, fir: RigCamera, R: Floats | None = None, t: tuple = (0.08, -0.02, 0.01)) -> Rig:
    return Rig({"rgb": rgb, "fir": fir}, {"T_rgb_fir": pose(turned() if R is None else R, t)})


def K(camera: RigCamera) -> Floats:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])


def pixels(size_wh: tuple[int, int]) -> Floats:
    v, u = np.mgrid[: size_wh[1], : size_wh[0]]
    return np.stack([u.ravel(), v.ravel()], -1).astype(np.float64)


def by_opencv(rig: Rig, z_m: float | Floats) -> Floats:
    """Where each RGB pixel's point at depth `z_m` lies in the thermal image, by OpenCV alone: H x W x 2."""
    rgb, fir, T = rig.camera("rgb"), rig.camera("fir"), rig.pose("fir", "rgb")
    uv, D = pixels(rgb.size_wh)[:, None], np.array(rgb.distortion or (0.0,) * 4)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    if isinstance(rgb, FisheyeCamera):
        flat = cv2.fisheye.undistortPoints(uv, K(rgb), D, criteria=stop)
    else:
        flat = cv2.undistortPoints(uv, K(rgb), D, None, None, None, stop)
    points = np.concatenate([np.reshape(flat, (-1, 2)), np.ones((len(uv), 1))], 1) * np.reshape(z_m, (-1, 1))
    r, t, D = cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], np.array(fir.distortion or (0.0,) * 4)
    if isinstance(fir, FisheyeCamera):
        xy = cv2.fisheye.projectPoints(points[:, None], r, t, K(fir), D)[0]
    else:
        xy = cv2.projectPoints(points, r, t, K(fir), D)[0]
    return np.asarray(xy, np.float64).reshape(rgb.size_wh[1], rgb.size_wh[0], 2)


def inside(xy: Floats, size_wh: tuple[int, int], slack: float) -> NDArray[np.bool_]:
    w, h = size_wh
    return np.asarray(((xy >= -0.5 - slack) & (xy <= (w - 0.5 + slack, h - 0.5 + slack))).all(-1))


def held(xy: Floats, size_wh: tuple[int, int]) -> Floats:
    """Half a pixel beyond the outermost centres their value is drawn out."""
    return np.clip(xy, 0, (size_wh[0] - 1, size_wh[1] - 1))


def apart(a: Floats, b: Floats) -> float:
    return float(np.nanmax(np.abs(a - b)))


RIGS = {
    "pinhole-pinhole": rig_of(PINHOLE, PLAIN_FIR),
    "radial-rational": rig_of(RADIAL, RATIONAL),
    "cushion-fisheye": rig_of(CUSHION, FISHEYE),
    "fisheye-radial": rig_of(
        FISHEYE_RGB, PinholeCamera(FIR_WH, 72, 71, 41.2, 30.4, (-0.24, 0.07, -5e-4, 6e-4, 0))
    ),
    "quarter-turn": rig_of(RADIAL, RATIONAL, turned(0, 0, math.pi / 2)),
}
each_rig = pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS)


# --- fixed maps


@each_rig
@pytest.mark.parametrize("metres", [0.7, 3.0, math.inf])
def test_fixed_maps_are_opencvs(rig: Rig, metres: float) -> None:
    """Positions to the step they are rounded to; the mask but for what lies on its very edge; the values."""
    exact = by_opencv(rig, 1e9 if math.isinf(metres) else metres)
    mode, distance = ("infinity", None) if math.isinf(metres) else ("distance", metres)
    warp = RigWarp.fixed(rig, FIR_WH, RGB_WH, mode, distance)
    seen = warp.mask == 255
    assert not (seen & ~inside(exact, FIR_WH, 0.01)).any()
    assert not (inside(exact, FIR_WH, -0.01) & ~seen).any()
    assert 0.2 < seen.mean() < 1
    assert apart(warp.positions()[seen], held(exact, FIR_WH)[seen]) < STEP
    assert np.isnan(warp.positions()[~seen]).all()
    image = np.random.default_rng(1).integers(0, 256, FIR_WH[::-1], dtype=np.uint8)
    x, y = np.moveaxis(exact, -1, 0)
    values = map_coordinates(image.astype(float), [y, x], order=1, mode="nearest")
    assert np.abs(warp.apply(image) - values)[seen].max() < 2 * 255 * STEP + 0.5


def test_infinity_without_distortion_is_the_infinite_homography() -> None:
    rig = RIGS["pinhole-pinhole"]
    H = K(PINHOLE) @ rig.pose("rgb", "fir")[:3, :3] @ np.linalg.inv(K(PLAIN_FIR))
    ours, theirs = RigWarp.fixed(rig, FIR_WH, RGB_WH), Warp(H, FIR_WH, RGB_WH)
    assert np.array_equal(ours.mask, theirs.mask)
    assert ours.crop_xywh == theirs.crop_xywh
    assert ours.border_ltrb == theirs.border_ltrb
    assert ours.coverage == theirs.coverage
    image = np.random.default_rng(2).integers(0, 256, FIR_WH[::-1], dtype=np.uint8)
    off = np.abs(ours.apply(image).astype(int) - theirs.apply(image))[ours.mask > 0]
    assert np.count_nonzero(off) < 0.001 * off.size  # a position may round to the neighbouring step


def test_smooth_content_agrees_with_opencvs_remap() -> None:
    rig = RIGS["radial-rational"]
    y, x = np.mgrid[: FIR_WH[1], : FIR_WH[0]]
    image = np.rint(127 + 60 * np.sin(x / 7) + 60 * np.cos(y / 6)).astype(np.uint8)
    warp = RigWarp.fixed(rig, FIR_WH, RGB_WH, "distance", 2.0)
    at = by_opencv(rig, 2.0).astype(np.float32)
    theirs = cv2.remap(image, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
    slope = max(np.abs(np.diff(image.astype(int), axis=axis)).max() for axis in (0, 1))
    assert np.abs(warp.apply(image).astype(int) - theirs)[warp.mask > 0].max() <= 1 + 2 * slope / 64


def test_what_a_lens_would_fold_back_is_masked() -> None:
    """The polynomial turns back at 45 degrees: what lies farther out would land in the picture again."""
    folding = PinholeCamera(FIR_WH, 60, 60, 39.5, 31.5, (-1 / 3, 0, 0, 0))
    rig = rig_of(PinholeCamera(RGB_WH, 18, 18, 47.5, 35.5), folding, np.eye(3), (0, 0, 0))
    ray = (pixels(RGB_WH) - (47.5, 35.5)) / 18
    beyond = (np.linalg.norm(ray, axis=1) > 1.001).reshape(RGB_WH[::-1])
    assert inside(by_opencv(rig, 1e9), FIR_WH, 0)[beyond].any()
    assert not RigWarp.fixed(rig, FIR_WH, RGB_WH).mask[beyond].any()
    far = np.full(RGB_WH[::-1], 50, np.float32)
    by_depth = DepthWarp(rig, FIR_WH, RGB_WH).apply(np.zeros(FIR_WH[::-1], np.uint8), far)
    assert np.array_equal(by_depth.mask, RigWarp.fixed(rig, FIR_WH, RGB_WH, "distance", 50).mask)


def test_all_round_cameras_count_distance_along_the_ray() -> None:
    wide = FisheyeCamera(RGB_WH, 26, 26, 47.5, 35.5)  # 106 degrees to the left and right: z is negative there
    assert not wide.has_axis
    rig = rig_of(wide, PLAIN_FIR, turned(0, 0.0, 0))
    warp = RigWarp.fixed(rig, FIR_WH, RGB_WH, "distance", 2.0)
    points = 2.0 * wide.unproject(pixels(RGB_WH))
    xy, _ = PLAIN_FIR.project(transform(rig.pose("fir", "rgb"), points))
    seen = warp.mask > 0
    assert seen.any()
    assert apart(warp.positions()[seen], held(xy.reshape(*RGB_WH[::-1], 2), FIR_WH)[seen]) < STEP
    ranges = np.full(RGB_WH[::-1], 2, np.float32)
    by_depth = DepthWarp(rig, FIR_WH, RGB_WH)
    assert by_depth.value == "range"
    assert np.array_equal(by_depth.apply(np.zeros(FIR_WH[::-1], np.uint8), ranges).mask, warp.mask)


# --- undistortion


@pytest.mark.parametrize("camera", [RADIAL, CUSHION, FISHEYE_RGB], ids=["barrel", "cushion", "fisheye"])
def test_undistorted_frames_are_those_of_a_pinhole(camera: RigCamera) -> None:
    rig = rig_of(camera, RATIONAL)
    warp = RigWarp.fixed(rig, FIR_WH, RGB_WH, "distance", 2.0, undistort=True)
    ideal = warp.views.output
    assert isinstance(ideal, PinholeCamera)
    assert not ideal.distortion
    growth = ideal.fx / camera.fx
    assert growth == pytest.approx(ideal.fy / camera.fy)
    assert (growth == 1) == (camera is not CUSHION)
    # thermal: as for a rig whose RGB camera is that pinhole
    twin = RigWarp.fixed(rig_of(ideal, RATIONAL), FIR_WH, RGB_WH, "distance", 2.0)
    assert np.array_equal(warp.mask, twin.mask)
    assert apart(warp.positions(), twin.positions()) == 0
    # RGB: sampled once, where OpenCV says
    rays = np.concatenate(
        [(pixels(RGB_WH) - (ideal.cx, ideal.cy)) / (ideal.fx, ideal.fy), np.ones((96 * 72, 1))], 1
    )
    D = np.array(camera.distortion)
    project = cv2.fisheye.projectPoints if isinstance(camera, FisheyeCamera) else cv2.projectPoints
    xy = np.asarray(project(rays[:, None], np.zeros(3), np.zeros(3), K(camera), D)[0], np.float64).reshape(
        72, 96, 2
    )
    assert inside(xy, RGB_WH, 1e-4).all()  # no pixel without a source
    if growth > 1:  # and none to spare
        assert not inside(xy, RGB_WH, -0.01).all()
    bgr = np.random.default_rng(3).integers(0, 256, (72, 96, 3), dtype=np.uint8)
    x, y = np.moveaxis(xy, -1, 0)
    exact = [map_coordinates(bgr[..., k].astype(float), [y, x], order=1, mode="nearest") for k in range(3)]
    assert np.abs(warp.rgb(bgr) - np.stack(exact, -1)).max() < 2 * 255 * STEP + 0.5


def test_without_undistortion_rgb_is_handed_back() -> None:
    bgr = np.zeros((72, 96, 3), np.uint8)
    assert RigWarp.fixed(RIGS["radial-rational"], FIR_WH, RGB_WH).rgb(bgr) is bgr
    assert RigWarp.fixed(RIGS["pinhole-pinhole"], FIR_WH, RGB_WH, undistort=True).rgb(bgr) is bgr


# --- by depth


@each_rig
@pytest.mark.parametrize("undistort", [False, True])
def test_a_wall_by_depth_is_the_fixed_distance(rig: Rig, undistort: bool) -> None:
    fixed = RigWarp.fixed(rig, FIR_WH, RGB_WH, "distance", 1.5, undistort)
    warp = DepthWarp(rig, FIR_WH, RGB_WH, undistort=undistort)
    wall = np.full(RGB_WH[::-1], 1.5, np.float32)
    image = np.random.default_rng(4).integers(0, 256, FIR_WH[::-1], dtype=np.uint8)
    got = warp.apply(image, wall)
    differ = got.mask != fixed.mask
    assert np.count_nonzero(differ) <= 2  # on the very edge, in float32
    both = (got.mask > 0) & (fixed.mask > 0)
    assert apart(warp.positions(wall)[both], fixed.positions()[both]) <= 1 / 256
    assert np.abs(got.index.astype(int) - fixed.apply(image))[both].max() <= 2
    assert (got.hidden, got.unknown, got.assumed) == (0, 0, 0)


def test_a_slanted_plane_by_depth_is_its_homography() -> None:
    """H = K_fir (R + t n' / d) K_rgb^-1 of the plane n' x = d (Hartley & Zisserman, 13.1)."""
    rig, n, d = RIGS["pinhole-pinhole"], np.array([0.3, -0.25, 1.0]), 2.0
    T = rig.pose("fir", "rgb")
    H = K(PLAIN_FIR) @ (T[:3, :3] + np.outer(T[:3, 3], n) / d) @ np.linalg.inv(K(PINHOLE))
    rays = np.concatenate([pixels(RGB_WH), np.ones((96 * 72, 1))], 1) @ np.linalg.inv(K(PINHOLE)).T
    depth = (d / (rays @ n)).reshape(72, 96)
    theirs = Warp(np.asarray(np.linalg.inv(H), np.float64), FIR_WH, RGB_WH)
    warp = DepthWarp(rig, FIR_WH, RGB_WH)
    image = np.random.default_rng(5).integers(0, 256, FIR_WH[::-1], dtype=np.uint8)
    got = warp.apply(image, depth.astype(np.float32))
    assert np.count_nonzero(got.mask != theirs.mask) <= 2
    both = (got.mask > 0) & (theirs.mask > 0)
    assert both.mean() > 0.5
    assert np.abs(got.index.astype(int) - theirs.apply(image))[both].max() <= 2


@each_rig
def test_any_depth_lands_where_opencv_says(rig: Rig) -> None:
    """Smooth relief, so that nothing is hidden; range maps mean the same."""
    v, u = np.mgrid[:72, :96]
    depth = (2 + 0.3 * np.sin(u / 30) + 0.3 * np.cos(v / 25)).astype(np.float32)
    exact = by_opencv(rig, depth.ravel())
    warp = DepthWarp(rig, FIR_WH, RGB_WH)
    got = warp.positions(depth)
    seen = np.isfinite(got[..., 0])
    assert not (inside(exact, FIR_WH, -0.01) & ~seen).any()
    assert apart(got[seen], held(exact, FIR_WH)[seen]) < STEP + 2e-3
    z = rig.camera("rgb").unproject(pixels(RGB_WH))[:, 2].reshape(72, 96)
    ranges = (depth / z).astype(np.float32)
    by_range = DepthWarp(rig, FIR_WH, RGB_WH, value="range").positions(ranges)
    assert apart(by_range, got) <= 1 / 256


def scene_of_two_planes() -> tuple[Rig, NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:
    """A panel at 1 m (columns 40 to 59, rows 20 to 49) before a wall at 2 m, seen by two alike cameras.

    The thermal one is 0.1 m to the right: 100 px of focal length make whole pixels of it, 10 and 5. The
    wall's pixel u lies at u - 5, behind the panel's u' - 10 for u' = u + 5: the five columns left of the
    panel are hidden.
    """
    camera = PinholeCamera((96, 72), 100, 100, 47.5, 35.5)
    rig = Rig({"rgb": camera, "fir": camera}, {"T_rgb_fir": pose(np.eye(3), (0.1, 0, 0))})
    depth = np.full((72, 96), 2, np.float32)
    depth[20:50, 40:60] = 1
    hidden, outside = np.zeros((72, 96), bool), np.zeros((72, 96), bool)
    hidden[20:50, 35:40] = True
    outside[:, :5] = True
    return rig, depth, hidden, outside


@pytest.mark.parametrize("turn", [0, 1, 2, 3])
def test_what_the_panel_hides_is_masked_to_the_pixel(turn: int) -> None:
    """And so with both cameras turned by quarters about their axes: to all four sides."""
    rig, depth, hidden, outside = scene_of_two_planes()
    camera = PinholeCamera((72, 96), 100, 100, 35.5, 47.5) if turn % 2 else rig.camera("rgb")
    # np.rot90 turns the picture counter-clockwise: its columns (x) become rows counted from below (-y).
    T_turned = pose(np.linalg.matrix_power(np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]), turn))
    T = T_turned @ rig.pose("rgb", "fir") @ invert(T_turned)
    rig = Rig({"rgb": camera, "fir": camera}, {"T_rgb_fir": T})
    depth = np.ascontiguousarray(np.rot90(depth, turn))
    hidden, outside = np.rot90(hidden, turn), np.rot90(outside, turn)
    h, w = depth.shape
    image = np.random.default_rng(6).integers(0, 256, (h, w), dtype=np.uint8)
    warp = DepthWarp(rig, (w, h), (w, h))
    got = warp.apply(image, depth)
    assert np.array_equal(got.mask == 0, hidden | outside)
    assert got.hidden == hidden.sum() == 150
    assert (got.unknown, got.assumed) == (0, 0)
    # What is seen has its own pixel's value, not the panel's.
    seen = got.mask > 0
    whole = np.rint(warp.positions(depth)[seen]).astype(int)
    assert np.array_equal(got.index[seen], image[whole[:, 1], whole[:, 0]])


@pytest.mark.parametrize("undistort", [False, True])
@pytest.mark.parametrize("fir", [RATIONAL, FISHEYE], ids=["pinhole", "fisheye"])
def test_hidden_pixels_are_those_of_rays(fir: RigCamera, undistort: bool) -> None:
    """A tilted panel before a tilted wall through lenses: beside it, strips many pixels wide are masked.

    A ray from the thermal camera's centre to each point decides. The panel's outline is known to half a
    pixel, so its strip's pixels may be wrong along that edge; none may within it, as holes would be.
    """
    rig = rig_of(RADIAL, fir, t=(0.3, 0.04, 0.0))
    views = Views.of(rig, FIR_WH, RGB_WH, undistort)
    rays = views.rays(pixels(RGB_WH))
    panel, wall = (np.array([0.9, 0.5, 1.0]), 1.0), (np.array([-0.1, 0.2, 1.0]), 3.0)

    def on_panel(points: Floats) -> NDArray[np.bool_]:
        across, down = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
        return np.asarray((np.abs(across + 0.05) < 0.25) & (np.abs(down) < 0.3))

    def met(eye: Floats, ways: Floats, plane: tuple[Floats, float]) -> Floats:
        return np.asarray((plane[1] - plane[0] @ eye) / (ways @ plane[0]), np.float64)

    near = met(np.zeros(3), rays, panel)
    points = np.where(np.reshape(on_panel(rays * near[:, None]), (-1, 1)), rays * near[:, None], 0)
    points = np.where(
        np.reshape(points.any(1), (-1, 1)), points, rays * met(np.zeros(3), rays, wall)[:, None]
    )
    eye = invert(views.T_fir_rgb)[:3, 3]
    ways = points - eye
    at = met(eye, ways, panel)
    hidden = np.asarray((at > 0) & (at < 0.98)) & on_panel(eye + ways * at[:, None])
    xy, ahead = fir.project(transform(views.T_fir_rgb, points))
    judged = (ahead & inside(xy, FIR_WH, -0.1)).reshape(72, 96)
    hidden = hidden.reshape(72, 96)
    # depth maps are of the RGB camera's own grid, distorted or not
    source = views if not undistort else Views.of(rig, FIR_WH, RGB_WH)
    own = source.rays(pixels(RGB_WH))
    n = met(np.zeros(3), own, panel)
    z = np.where(on_panel(own * n[:, None]), n, met(np.zeros(3), own, wall)) * own[:, 2]
    warp = DepthWarp(rig, FIR_WH, RGB_WH, undistort=undistort)
    mask = warp.apply(np.zeros(FIR_WH[::-1], np.uint8), z.reshape(72, 96).astype(np.float32)).mask == 0
    truly, ours = hidden & judged, mask & judged
    assert truly.sum() > 200
    overlap = np.count_nonzero(truly & ours) / np.count_nonzero(truly | ours)
    assert overlap > (0.8 if undistort else 0.9)  # undistorted, the panel's own outline is off as well
    ball = np.ones((3, 3), np.uint8)
    surely = cv2.erode(truly.astype(np.uint8), ball) > 0
    maybe = cv2.dilate(truly.astype(np.uint8), ball) > 0
    assert not (surely & ~ours).any()
    assert undistort or not (ours & ~maybe).any()


def test_a_surface_that_thermal_sees_stretched_hides_without_holes() -> None:
    """Slanted so that its pixels lie 1.8 px apart on the thermal grid: nothing shows through between them."""
    rig, depth, _, _ = scene_of_two_planes()
    depth[:] = 20
    depth[20:50, 40:60] = 10 / (2 + 0.8 * (60 - np.arange(40, 60)))  # lies at u - 10 / z, from 22 to 56
    mask = DepthWarp(rig, (96, 72), (96, 72)).apply(np.zeros((72, 96), np.uint8), depth).mask
    assert not mask[20:50, 24:40].any()
    assert mask[20:50, 5:20].all()
    assert mask[20:50, 40:].all()


def test_pixels_without_depth_are_masked_and_hide_nothing() -> None:
    rig, depth, hidden, outside = scene_of_two_planes()
    depth[20:30, 40:60] = 0  # the upper part of the panel is not known: it hides nothing there
    depth[60, 50:54] = (np.nan, np.inf, -1, 0)
    got = DepthWarp(rig, (96, 72), (96, 72)).apply(np.zeros((72, 96), np.uint8), depth)
    unknown = ~((depth > 0) & np.isfinite(depth))
    hidden[20:30] = False
    assert np.array_equal(got.mask == 0, hidden | outside | unknown)
    assert (got.hidden, got.unknown, got.assumed) == (100, 204, 0)


def test_pixels_without_depth_may_be_taken_to_be_at_a_distance() -> None:
    rig, depth, hidden, outside = scene_of_two_planes()
    full = depth.copy()
    depth[:20] = 0
    depth[25, 35:40] = 0  # at 2 m, where they are taken to be, the panel hides them
    depth[30:35, 40:60] = 0  # the panel's own: taken to be at 2 m, they hide nothing
    warp = DepthWarp(rig, (96, 72), (96, 72), distance_m=2.0)
    got = warp.apply(np.zeros((72, 96), np.uint8), depth)
    hidden[30:35] = False
    assert np.array_equal(got.mask == 0, hidden | outside)
    assert got.assumed == 20 * 91 + 5 * 20
    assert got.unknown == 0
    for nowhere in (None, np.zeros_like(full)):
        empty = warp.apply(np.zeros((72, 96), np.uint8), nowhere)
        assert np.array_equal(empty.mask, warp.fixed.mask)
        assert empty.assumed == np.count_nonzero(warp.mask)


def test_what_is_only_assumed_to_be_near_hides_nothing() -> None:
    rig, depth, _, _ = scene_of_two_planes()
    depth[depth == 1] = 0  # the panel is not known, but all that is not is taken to be at 1 m
    depth[depth > 0] = 2
    got = DepthWarp(rig, (96, 72), (96, 72), distance_m=1.0).apply(np.zeros((72, 96), np.uint8), depth)
    assert (got.hidden, got.assumed) == (0, 20 * 30)
    assert got.mask[:, 5:].all()


def test_undistorted_pixels_take_the_depth_of_the_nearest_pixel() -> None:
    warp = DepthWarp(RIGS["radial-rational"], FIR_WH, RGB_WH, undistort=True)
    xy, _ = RADIAL.project(warp.views.rays(pixels(RGB_WH)))
    column, row = np.clip(np.rint(xy), 0, (95, 71)).astype(int).T
    assert warp._source is not None
    assert np.array_equal(warp._source, row * 96 + column)


def test_without_any_depth_nothing_is_seen() -> None:
    rig, _, _, _ = scene_of_two_planes()
    got = DepthWarp(rig, (96, 72), (96, 72)).apply(np.zeros((72, 96), np.uint8), None)
    assert not got.mask.any()
    assert got.unknown == 72 * 96


@pytest.mark.parametrize("value", ["depth", "range"])
def test_the_assumed_distance_is_along_the_axis_whatever_maps_hold(value: str) -> None:
    rig = RIGS["radial-rational"]
    warp = DepthWarp(rig, FIR_WH, RGB_WH, value=value, distance_m=1.5)  # type: ignore[arg-type]
    assert (
        apart(warp.positions(None), RigWarp.fixed(rig, FIR_WH, RGB_WH, "distance", 1.5).positions())
        <= 1 / 256
    )


def test_cameras_in_one_place_hide_nothing_from_each_other() -> None:
    rig = rig_of(PINHOLE, PLAIN_FIR, t=(0, 0, 0))
    depth = np.random.default_rng(7).uniform(0.5, 50, (72, 96)).astype(np.float32)
    got = DepthWarp(rig, FIR_WH, RGB_WH).apply(np.zeros(FIR_WH[::-1], np.uint8), depth)
    assert np.array_equal(got.mask, RigWarp.fixed(rig, FIR_WH, RGB_WH).mask)


def test_threads_share_a_warp_and_change_nothing() -> None:
    rig = RIGS["radial-rational"]
    warp, rng = DepthWarp(rig, FIR_WH, RGB_WH), np.random.default_rng(8)
    frames = [
        (rng.integers(0, 256, FIR_WH[::-1], dtype=np.uint8), rng.uniform(0.5, 9, (72, 96)).astype(np.float32))
        for _ in range(8)
    ]
    copies = [(image.copy(), depth.copy()) for image, depth in frames]
    alone = [warp.apply(*frame) for frame in frames]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda frame: warp.apply(*frame), frames * 4))
    for k, got in enumerate(together):
        seen = got.mask > 0
        assert np.array_equal(got.mask, alone[k % 8].mask)
        assert np.array_equal(got.index[seen], alone[k % 8].index[seen])
    for (image, depth), (image_before, depth_before) in zip(frames, copies, strict=True):
        assert np.array_equal(image, image_before)
        assert np.array_equal(depth, depth_before)
    with pytest.raises(ValueError, match="read-only"):
        warp.mask[0, 0] = 1
    out = np.empty(RGB_WH[::-1], np.uint8)
    assert warp.apply(*frames[0], out).index is out


# --- predicted parallax


def test_parallax_of_parallel_cameras_is_the_formula() -> None:
    """f b |1/z - 1/z0|: at 1 m, taken to be at 5 m, 100 px x 0.1 m x 0.8."""
    rig, _, _, _ = scene_of_two_planes()
    distances = (0.5, 1.0, 2.0, 5.0, 10.0, math.inf)
    for at in (0.8, 5.0, math.inf):
        expected = [10 * abs(1 / z - 1 / at) for z in distances]
        assert parallax_px(rig, at, distances) == pytest.approx(expected, abs=1e-9)


@each_rig
def test_parallax_is_how_far_the_fixed_map_draws_off(rig: Rig) -> None:
    """The thermal position of a wall's pixel, looked up in the map that assumes 5 m, is where it is drawn."""
    warp = RigWarp.fixed(rig, FIR_WH, RGB_WH, "distance", 5.0)
    used, true = warp.positions(), by_opencv(rig, 1.0)
    off = np.linalg.norm(used - true, axis=-1)
    per_px = np.linalg.norm(np.diff(used, axis=1), axis=-1)
    assert parallax_px(rig, 5.0, [5.0])[0] == pytest.approx(0, abs=1e-4)
    assert parallax_px(rig, 5.0, [1.0])[0] == pytest.approx(np.nanmedian(off[:, 1:] / per_px), rel=0.08)


def test_parallax_of_what_nobody_sees_is_unknown() -> None:
    camera = PinholeCamera((96, 72), 100, 100, 47.5, 35.5)
    rig = Rig({"rgb": camera, "fir": camera}, {"T_rgb_fir": pose(np.eye(3), (2.0, 0, 0))})
    near, far = parallax_px(rig, 50.0, (0.5, 50.0))
    assert math.isnan(near)
    assert far == pytest.approx(0, abs=1e-9)


# --- the rectangle, refusals


@settings(max_examples=200)
@given(arrays(np.bool_, st.tuples(st.integers(1, 7), st.integers(1, 8))))
def test_largest_rectangle_of_any_mask(mask: NDArray[np.bool_]) -> None:
    h, w = mask.shape
    fits = [
        (-(b - t) * (r - x), t, b - t)
        for t in range(h)
        for b in range(t + 1, h + 1)
        for x in range(w)
        for r in range(x + 1, w + 1)
        if mask[t:b, x:r].all()
    ]
    scratch = np.zeros(w, np.int64), np.zeros(w + 1, np.int64), np.zeros(w + 1, np.int64)
    x, y, rw, rh = loops.largest_rectangle(mask.astype(np.uint8) * 255, *scratch)
    if not fits:
        assert (x, y, rw, rh) == (0, 0, 0, 0)
        return
    assert mask[y : y + rh, x : x + rw].all()
    assert (-rw * rh, y, rh) == min(fits)


@pytest.mark.parametrize(
    ("fir", "rgb", "words"),
    [
        (FIR_WH, (192, 144), "RGB camera has 96x72 pixels, the images 192x144"),
        ((64, 80), RGB_WH, "thermal camera"),
    ],
)
def test_images_of_another_size_than_the_rigs_are_refused(
    fir: tuple[int, int], rgb: tuple[int, int], words: str
) -> None:
    for make in (RigWarp.fixed, DepthWarp):
        with pytest.raises(UsageError, match=words):
            make(RIGS["radial-rational"], fir, rgb)


def test_what_a_rig_must_have() -> None:
    with pytest.raises(UsageError, match="no camera 'fir'"):
        RigWarp.fixed(Rig({"rgb": PINHOLE}), FIR_WH, RGB_WH)
    with pytest.raises(UsageError, match="how rgb stands to fir"):
        RigWarp.fixed(Rig({"rgb": PINHOLE, "fir": PLAIN_FIR}), FIR_WH, RGB_WH)
    backwards = rig_of(PINHOLE, PLAIN_FIR, turned(0, math.pi, 0))
    with pytest.raises(UsageError, match="share no view") as refused:
        RigWarp.fixed(backwards, FIR_WH, RGB_WH)
    assert "T_rgb_fir" in refused.value.hint


@pytest.mark.parametrize(
    ("mode", "metres"), [("distance", None), ("infinity", 2.0), ("distance", -1.0), ("depth", 1.0)]
)
def test_modes_and_distances_that_make_no_sense(mode: str, metres: float | None) -> None:
    with pytest.raises(ValueError, match="expected"):
        RigWarp.fixed(RIGS["radial-rational"], FIR_WH, RGB_WH, mode, metres)  # type: ignore[arg-type]


def test_frames_of_another_size_or_type_are_refused() -> None:
    warp, image = DepthWarp(RIGS["radial-rational"], FIR_WH, RGB_WH), np.zeros(FIR_WH[::-1], np.uint8)
    with pytest.raises(FrameError, match="the depth map is 48x36, the RGB camera 96x72"):
        warp.apply(image, np.zeros((36, 48), np.float32))
    for depth in (np.zeros((72, 96)), np.zeros((72, 96, 1), np.float32)):
        with pytest.raises(ValueError, match="float32 metres"):
            warp.apply(image, depth)  # type: ignore[arg-type]
    for bad in (np.zeros((3, 3), np.uint8), image.astype(np.uint16)):
        with pytest.raises(ValueError, match="thermal grid"):
            warp.apply(bad, None)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="thermal grid"):
            warp.fixed.apply(bad)  # type: ignore[arg-type]
