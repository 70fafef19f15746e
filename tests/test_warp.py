"""The warp against brute force, SciPy and OpenCV."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from fusion import registration as reg
from fusion.warp import Warp, coverage, fault_of, largest_rectangle, valid_spans

MARGIN = 0.5 + 1 / 512  # an image reaches half a pixel beyond its outermost centres; and half a step


def positions(H: NDArray, rgb_size_wh: tuple[int, int]) -> tuple[NDArray, NDArray, NDArray]:
    """x, y on the thermal grid and the denominator, for every RGB pixel, in plain float64."""
    v, u = np.mgrid[0 : rgb_size_wh[1], 0 : rgb_size_wh[0]]
    x, y, z = np.einsum("ij,jhw->ihw", np.linalg.inv(H), np.stack([u, v, np.ones_like(u)]).astype(float))
    with np.errstate(all="ignore"):  # a pixel on the horizon has no position
        return x / z, y / z, z


def inside(
    H: NDArray, fir_size_wh: tuple[int, int], rgb_size_wh: tuple[int, int], slack_px: float
) -> NDArray[np.bool_]:
    x, y, z = positions(H, rgb_size_wh)
    (w, h), s = fir_size_wh, slack_px
    return (z > 0) & (x >= -s) & (x <= w - 1 + s) & (y >= -s) & (y <= h - 1 + s)


def twin(image: NDArray, offset: NDArray, fraction: NDArray) -> NDArray:
    """The resampling in plain integers: floor(sum of taps times weights / 65536 + 1/2), taps clamped."""
    h, w = image.shape
    y0, x0 = np.divmod(offset.astype(np.int64), w)
    fy, fx = fraction.astype(np.int64) >> 8, fraction.astype(np.int64) & 255
    x1, y1, taps = np.minimum(x0 + 1, w - 1), np.minimum(y0 + 1, h - 1), image.astype(np.int64)
    upper = taps[y0, x0] * (256 - fx) + taps[y0, x1] * fx
    lower = taps[y1, x0] * (256 - fx) + taps[y1, x1] * fx
    return ((upper * (256 - fy) + lower * fy + 32768) >> 16).astype(np.uint8)


def homography(angle: float, scale: float, shift: tuple[float, float], tilt: tuple[float, float]) -> NDArray:
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    return np.array([[c, -s, shift[0]], [s, c, shift[1]], [*tilt, 1.0]])


TILTED = homography(0.2, 1.7, (9.3, -6.4), (1.5e-3, -8e-4))
FIR, RGB = (61, 47), (97, 83)


def brute_force_area(mask: NDArray[np.bool_]) -> int:
    """The largest all-valid rectangle by trying every one (sums over an integral image)."""
    h, w = mask.shape
    total = np.pad(mask.astype(int).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    best = 0
    for t in range(h):
        for b in range(t + 1, h + 1):
            for x in range(w):
                for r in range(x + 1, w + 1):
                    area = (b - t) * (r - x)
                    if area > best and total[b, r] - total[t, r] - total[b, x] + total[t, x] == area:
                        best = area
    return best


homographies = st.builds(
    homography,
    st.floats(-3.2, 3.2),
    st.floats(0.3, 3),
    st.tuples(st.floats(-6, 12), st.floats(-6, 12)),
    st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05)),
)
sizes = st.tuples(st.integers(1, 11), st.integers(1, 11))


@settings(max_examples=150, deadline=None)
@given(homographies, sizes, sizes)
def test_mask_coverage_and_crop_are_those_of_brute_force(
    H: NDArray, fir: tuple[int, int], rgb: tuple[int, int]
) -> None:
    if fault_of(H, fir, rgb):
        with pytest.raises(ValueError, match=r"homography|scale"):
            Warp(H, fir, rgb)
        return
    surely, maybe = (inside(H, fir, rgb, MARGIN + e) for e in (-1e-9, 1e-9))
    if not maybe.any():
        assert coverage(H, fir, rgb) == 0
        with pytest.raises(ValueError, match="no RGB pixel"):
            Warp(H, fir, rgb)
    if not surely.any():
        return
    warp = Warp(H, fir, rgb)
    valid = warp.mask == 255
    assert not (surely & ~valid).any()
    assert not (valid & ~maybe).any()
    assert set(np.unique(warp.mask)) <= {0, 255}
    assert warp.coverage == coverage(H, fir, rgb) == pytest.approx(valid.mean())
    assert warp.full == valid.all()
    x, y, w, h = warp.crop_xywh
    assert valid[y : y + h, x : x + w].all()
    assert w * h == brute_force_area(valid)
    assert warp.border_ltrb == (x, y, rgb[0] - x - w, rgb[1] - y - h)
    sampled = warp.apply(np.full(fir[::-1], 77, np.uint8))
    assert (sampled == 77).all()  # also outside the mask and behind the horizon


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.floats(0, 12), st.floats(0, 12)), min_size=3, max_size=7))
def test_largest_rectangle_of_any_convex_polygon(corners: list[tuple[float, float]]) -> None:
    hull = cv2.convexHull(np.array(corners, np.float32))[:, 0].astype(float)
    edges = np.roll(hull, -1, 0) - hull
    if abs(hull[:, 0] @ np.roll(hull[:, 1], -1) - hull[:, 1] @ np.roll(hull[:, 0], -1)) < 1e-3:
        return
    grid = np.stack(np.meshgrid(np.arange(13), np.arange(13)), -1).astype(float)
    side = np.stack(
        [
            e[0] * (grid[..., 1] - p[1]) - e[1] * (grid[..., 0] - p[0])
            for p, e in zip(hull, edges, strict=True)
        ]
    )
    mask = np.asarray((side >= 0).all(axis=0) | (side <= 0).all(axis=0))
    some = mask.any(axis=-1)
    first = np.where(some, mask.argmax(1), 13)
    stop = np.where(some, 13 - mask[:, ::-1].argmax(1), 0)
    x, y, w, h = largest_rectangle((first, stop))
    assert mask[y : y + h, x : x + w].all()
    assert w * h == brute_force_area(mask)


def test_the_horizon_of_the_inverse_may_cross_the_rgb_image() -> None:
    H = homography(0.0, 1.0, (30.0, 20.0), (1 / 64, 0.0))  # lands on columns 30 to 52
    _, _, z = positions(H, (400, 300))
    assert (z[:, 64] == 0).all()  # the horizon is this very column: no position at all
    assert z.min() < 0 < z.max()
    warp = Warp(H, (129, 40), (400, 300))
    assert np.array_equal(warp.mask == 255, inside(H, (129, 40), (400, 300), MARGIN))
    assert 0 < warp.coverage < 0.02
    assert (warp.apply(np.full((40, 129), 9, np.uint8)) == 9).all()


def test_values_are_within_one_grey_level_of_exact_interpolation() -> None:
    # A position is rounded to 1/256 px, so it errs by at most 1/512 px an axis; a bilinear surface of
    # bytes climbs at most 255 a pixel and axis: 2 * 255 / 512 < 1 grey level before rounding, so the
    # rounded values differ by at most one. Noise makes every slope occur.
    image = np.random.default_rng(1).integers(0, 256, FIR[::-1], dtype=np.uint8)
    warp = Warp(TILTED, FIR, RGB)
    x, y, _ = positions(TILTED, RGB)
    exact = map_coordinates(image.astype(float), [y, x], order=1, mode="nearest")
    seen = warp.mask == 255
    got = warp.apply(image)
    assert 0.2 < seen.mean() < 0.95
    assert np.abs(got - exact)[seen].max() < 2 * 255 / 512 + 0.5
    assert np.abs(got - np.rint(exact))[seen].max() <= 1
    assert np.abs(got - exact)[seen].mean() < 0.4  # rounding alone gives 0.25


def test_kernel_and_maps_agree_with_plain_integers() -> None:
    image = np.random.default_rng(2).integers(0, 256, FIR[::-1], dtype=np.uint8)
    warp = Warp(TILTED, FIR, RGB)
    x, y, z = positions(TILTED, RGB)
    assert z.min() > 0
    q = [np.floor(np.clip(p, 0, n - 1) * 256 + 0.5).astype(np.int64) for p, n in ((x, FIR[0]), (y, FIR[1]))]
    offset, fraction = (q[1] >> 8) * FIR[0] + (q[0] >> 8), (q[1] & 255) << 8 | (q[0] & 255)
    assert np.array_equal(warp.apply(image), twin(image, offset, fraction))


def test_smooth_content_agrees_with_opencv() -> None:
    # Each side rounds positions to at worst 1/64 px (OpenCV's classic tables) and the value to one level.
    y, x = np.mgrid[0:47, 0:61]
    image = np.rint(127 + 60 * np.sin(x / 7) + 60 * np.cos(y / 6)).astype(np.uint8)
    slope = max(np.abs(np.diff(image.astype(int), axis=a)).max() for a in (0, 1))
    warp = Warp(TILTED, FIR, RGB)
    theirs = cv2.warpPerspective(image, TILTED, RGB, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    difference = np.abs(warp.apply(image).astype(int) - theirs)[warp.mask == 255]
    assert difference.max() <= 1 + 2 * slope / 64


def test_half_pixel_rule_keeps_a_ramp_exact() -> None:
    ramp = np.tile(4 * np.arange(60, dtype=np.uint8), (20, 1))
    warp = Warp(reg.scale_to_fit((60, 20), (120, 40)).H_rgb_fir, (60, 20), (120, 40))
    assert warp.full  # the outermost pixels lie a quarter pixel beyond the centres, on the image still
    # u lies at (u + 0.5) / 2 - 0.5 on the thermal grid: four times that is 2 u - 1.
    assert np.array_equal(warp.apply(ramp)[1:-1, 1:-1], np.tile(2 * np.arange(1, 119) - 1, (38, 1)))


def test_whole_pixel_shift_moves_pixels_and_counts_the_border() -> None:
    image = np.random.default_rng(3).integers(0, 256, (30, 40), dtype=np.uint8)
    warp = Warp(np.array([[1, 0, 5], [0, 1, -3], [0, 0, 1.0]]), (40, 30), (40, 30))
    assert warp.border_ltrb == (5, 0, 0, 3)
    assert warp.crop_xywh == (5, 0, 35, 27)
    assert warp.coverage == 35 * 27 / 1200
    assert not warp.full
    assert np.array_equal(warp.apply(image)[:27, 5:], image[3:, :35])


def test_identity_hands_the_frame_back() -> None:
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    warp = Warp(np.eye(3), (4, 3), (4, 3))
    assert warp.is_identity
    assert warp.full
    assert warp.crop_xywh == (0, 0, 4, 3)
    assert warp.apply(image, np.zeros((3, 4), np.uint8)) is image
    assert not Warp(np.eye(3), (4, 3), (4, 2)).is_identity


def test_result_goes_to_out_and_nothing_is_changed() -> None:
    H = TILTED.copy()
    warp = Warp(H, FIR, RGB)
    image = np.random.default_rng(4).integers(0, 256, FIR[::-1], dtype=np.uint8)
    kept, out = image.copy(), np.empty(RGB[::-1], np.uint8)
    assert warp.apply(image, out) is out
    assert np.array_equal(image, kept)
    assert np.array_equal(warp.apply(np.asfortranarray(image)), out)
    H[:] = 0
    assert np.array_equal(warp.H_rgb_fir, TILTED)
    for array in (warp.mask, warp.H_rgb_fir):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1
    with pytest.raises(AttributeError):
        warp.coverage = 1.0  # type: ignore[misc]


@pytest.mark.parametrize("image", [np.zeros((61, 47), np.uint8), np.zeros((47, 61), np.uint16)])
def test_frames_of_another_size_or_type_are_refused(image: NDArray) -> None:
    with pytest.raises(ValueError, match="thermal grid"):
        Warp(TILTED, FIR, RGB).apply(image)


def test_a_matrix_and_its_negative_are_one_homography() -> None:
    a, b = Warp(TILTED, FIR, RGB), Warp(-3 * TILTED, FIR, RGB)
    assert a.crop_xywh == b.crop_xywh
    assert np.array_equal(a.mask, b.mask)


def test_a_12_megapixel_grid() -> None:
    H = homography(0.12, 6.0, (200, -20), (1e-5, 2e-5))
    fir, rgb = (640, 480), (4096, 3072)
    first, stop = valid_spans(H, fir, rgb)
    x, y, w, h = largest_rectangle((first, stop))
    assert (first[y : y + h] <= x).all()
    assert (stop[y : y + h] >= x + w).all()


def grey(path: Path) -> NDArray[np.uint8]:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)


@pytest.mark.parametrize(("group", "name"), [("MSRS", "00055D"), ("MSRS", "00004N"), ("RoadScene", "14")])
def test_points_register_a_deformed_real_pair(shared_data: Path, group: str, name: str) -> None:
    """30-odd correspondences of a perspective plus elastic deformation with a known dense flow.

    The elastic part is not a homography's to undo; the bound is what it leaves (1.4 to 1.6 px of
    14 to 26), with a margin: the mean error falls to a fifth and below 2.5 px.
    """
    from scipy.io import loadmat

    root = shared_data / "rgbt_warped" / group
    flow = loadmat(root / "flow" / f"{name}.png.mat")["flow"][0].astype(float)
    warped, original = (grey(root / kind / f"{name}.png") for kind in ("ir_warp", "ir"))
    h, w = flow.shape[:2]
    target = (flow + 1) * [(w - 1) / 2, (h - 1) / 2]  # ir_warp(x) = ir(target(x))
    known = ((target >= 0) & (target <= [w - 1, h - 1])).all(-1)
    v, u = (a.ravel().round().astype(int) for a in np.mgrid[20 : h - 20 : 5j, 20 : w - 20 : 7j])
    v, u = v[known[v, u]], u[known[v, u]]
    found = reg.fit_points(np.stack([u, v], 1).astype(float), target[v, u])
    grid = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).astype(float)
    moved = cv2.perspectiveTransform(grid, found.H_rgb_fir)
    before, after = (np.linalg.norm(g - target, axis=-1)[known].mean() for g in (grid, moved))
    assert before > 10
    assert after < min(before / 5, 2.5)
    assert found.fit is not None
    assert found.fit.leave_one_out_px == pytest.approx(after, rel=0.5)  # the figure that the user is given
    assert reg.check(found, (w, h), (w, h)) == []
    warp = Warp(found.H_rgb_fir, (w, h), (w, h))
    seen = warp.mask == 255
    error = [np.abs(image.astype(float) - original)[seen].mean() for image in (warped, warp.apply(warped))]
    assert error[1] < error[0] / 2.5
