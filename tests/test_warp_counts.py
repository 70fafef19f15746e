"""Counts on the RGB grid: 16 bits through every warp, sampled and rounded as the 8-bit way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from fusion.errors import FrameError
from fusion.geometry import FisheyeCamera, PinholeCamera, pose
from fusion.kernels import resample
from fusion.kernels16 import resample_counts
from fusion.rig import Rig
from fusion.rig_warp import DepthWarp, RigWarp
from fusion.warp import Warp

FIR, RGB = (61, 47), (97, 83)
TILTED = np.array([[1.666, -0.338, 9.3], [0.338, 1.666, -6.4], [1.5e-3, -8e-4, 1.0]])
RNG = np.random.default_rng(5)
COUNTS = RNG.integers(0, 65536, FIR[::-1], dtype=np.uint16)
RIG = Rig(
    {
        "rgb": PinholeCamera(RGB, 70, 71, 48.3, 41.1, (-0.12, 0.02, 4e-4, -3e-4, 0.002)),
        "fir": FisheyeCamera(FIR, 62, 61, 30.2, 23.4, (-0.02, 0.004, -0.001, 0.0)),
    },
    {"T_rgb_fir": pose(np.eye(3), (0.08, -0.02, 0.01))},
)


def depth_map() -> NDArray[np.float32]:
    """A wall with a near post that hides part of it from the thermal camera, and pixels without depth."""
    depth = np.full(RGB[::-1], 4, np.float32)
    depth[:, 40:50] = 1.0
    depth[10:20, 5:30] = 0
    return depth


def twin(image: NDArray, offset: NDArray, fraction: NDArray) -> NDArray:
    """floor(sum of taps times weights / 65536 + 1/2) in integers of 64 bits, taps clamped."""
    h, w = image.shape
    y0, x0 = np.divmod(offset.astype(np.int64), w)
    fy, fx = fraction.astype(np.int64) >> 8, fraction.astype(np.int64) & 255
    x1, y1, taps = np.minimum(x0 + 1, w - 1), np.minimum(y0 + 1, h - 1), image.astype(np.int64)
    upper = taps[y0, x0] * (256 - fx) + taps[y0, x1] * fx
    lower = taps[y1, x0] * (256 - fx) + taps[y1, x1] * fx
    return (upper * (256 - fy) + lower * fy + 32768) >> 16


@settings(max_examples=60)
@given(st.data())
def test_the_loop_is_its_plain_twin(data: st.DataObject) -> None:
    w, h = data.draw(st.tuples(st.integers(1, 9), st.integers(1, 9)))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    extremes = data.draw(st.booleans())
    image = rng.choice([0, 65535], (h, w)) if extremes else rng.integers(0, 65536, (h, w))
    image = image.astype(np.uint16)
    shape = data.draw(st.tuples(st.integers(1, 40), st.integers(1, 40)))
    offset = rng.integers(0, w * h, shape, dtype=np.uint32)
    fraction = rng.integers(0, 65536, shape, dtype=np.uint16)
    mask = rng.choice([0, 255, 1], shape).astype(np.uint8)
    got = resample_counts(image, offset, fraction, mask)
    assert got.dtype == np.uint16
    assert np.array_equal(got, np.where(mask > 0, twin(image, offset, fraction), 0))


@pytest.mark.parametrize("size", [100, 8192, 8193, 3 * 8192])
def test_the_loop_in_several_blocks_agrees_with_the_8_bit_one(size: int) -> None:
    rng = np.random.default_rng(size)
    image = rng.integers(0, 256, (200, 130), dtype=np.uint8)
    offset = rng.integers(0, image.size, (1, size), dtype=np.uint32)
    offset[0, -1] = image.size - 1
    fraction = rng.integers(0, 65536, (1, size), dtype=np.uint16)
    everywhere = np.full((1, size), 255, np.uint8)
    assert np.array_equal(
        resample_counts(image, offset, fraction, everywhere), resample(image, offset, fraction)
    )


def test_wrong_input_of_the_loop_is_refused() -> None:
    offset, fraction, mask = (
        np.zeros((2, 3), np.uint32),
        np.zeros((2, 3), np.uint16),
        np.ones((2, 3), np.uint8),
    )
    with pytest.raises(ValueError, match="outside the image"):
        resample_counts(np.zeros((4, 5), np.uint16), offset + np.uint32(20), fraction, mask)
    with pytest.raises(ValueError, match="uint8 or uint16"):
        resample_counts(np.zeros((4, 5), np.int32), offset, fraction, mask)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="mask"):
        resample_counts(np.zeros((4, 5), np.uint16), offset, fraction, mask[:1])


def fixed_warps() -> list[Warp | RigWarp]:
    return [
        Warp(TILTED, FIR, RGB),
        Warp(np.eye(3), FIR, FIR),
        RigWarp.fixed(RIG, FIR, RGB),
        RigWarp.fixed(RIG, FIR, RGB, "distance", 2.0, undistort=True),
    ]


@pytest.mark.parametrize("warp", fixed_warps(), ids=["tilted", "identity", "infinity", "undistorted"])
def test_8_bit_content_is_the_same_either_way(warp: Warp | RigWarp) -> None:
    content = (COUNTS >> 8).astype(np.uint8)
    expected = np.where(warp.mask > 0, warp.apply(content), 0)
    assert (expected > 0).mean() > 0.1
    for counts in (content, content.astype(np.uint16), np.asfortranarray(content)):
        got = warp.counts(counts)
        assert got.dtype == np.uint16
        assert np.array_equal(got, expected)


def test_counts_are_exact_interpolation_to_a_step_of_position() -> None:
    # Smooth: half a position step of 1/256 px an axis, and half a count of rounding.
    y, x = np.mgrid[: FIR[1], : FIR[0]]
    smooth = np.rint(30000 + 20000 * np.sin(x / 9) + 9000 * np.cos(y / 7)).astype(np.uint16)
    slope = sum(np.abs(np.diff(smooth.astype(int), axis=axis)).max() for axis in (0, 1))
    warp = Warp(TILTED, FIR, RGB)
    v, u = np.mgrid[: RGB[1], : RGB[0]]
    fx, fy, fz = np.einsum(
        "ij,jhw->ihw", np.linalg.inv(TILTED), np.stack([u, v, np.ones_like(u)]).astype(float)
    )
    exact = map_coordinates(smooth.astype(float), [fy / fz, fx / fz], order=1, mode="nearest")
    seen = warp.mask > 0
    error = np.abs(warp.counts(smooth) - exact)[seen]
    assert error.max() <= slope / 512 + 0.5
    assert (warp.counts(smooth)[~seen] == 0).all()
    assert 0.2 < seen.mean() < 0.95


def test_the_identity_keeps_every_count_in_an_array_of_its_own() -> None:
    got = Warp(np.eye(3), FIR, FIR).counts(COUNTS)
    assert np.array_equal(got, COUNTS)
    assert not np.shares_memory(got, COUNTS)


@pytest.mark.parametrize("undistort", [False, True])
def test_by_depth_counts_are_seen_where_the_index_is(undistort: bool) -> None:
    warp, depth = DepthWarp(RIG, FIR, RGB, undistort=undistort), depth_map()
    content = (COUNTS >> 8).astype(np.uint8)
    warped = warp.apply(content, depth, fir=COUNTS)
    plain = warp.apply(content, depth)
    assert plain.counts is None
    assert warped.counts is not None
    assert warped.hidden > 50
    assert np.array_equal(plain.index, warped.index)
    assert np.array_equal(plain.mask, warped.mask)
    assert (warped.counts[warped.mask == 0] == 0).all()
    assert np.array_equal(warp.counts(COUNTS, depth), warped.counts)
    either = warp.counts(content, depth)
    assert np.array_equal(either, np.where(warped.mask > 0, warped.index, 0))
    assert 0.3 < (warped.mask > 0).mean() < 0.95


def test_by_depth_counts_lie_where_positions_say() -> None:
    warp, depth = DepthWarp(RIG, FIR, RGB), depth_map()
    xy = warp.positions(depth)
    seen = np.isfinite(xy[..., 0])
    x, y = (np.where(seen, xy[..., axis], 0) for axis in (0, 1))
    exact = map_coordinates(COUNTS.astype(float), [y, x], order=1, mode="nearest")
    got = warp.counts(COUNTS, depth)
    assert np.abs(got - exact)[seen].max() <= 0.5 + 1e-6  # positions are exact here: rounding alone is left
    assert (got[~seen] == 0).all()


@pytest.mark.parametrize("fir", [np.zeros(FIR, np.uint16), np.zeros(FIR[::-1], np.float32)])
def test_counts_of_another_size_or_type_are_refused(fir: NDArray) -> None:
    by_depth = DepthWarp(RIG, FIR, RGB)
    for warp in fixed_warps():
        with pytest.raises(ValueError, match="thermal grid"):
            warp.counts(fir)
    with pytest.raises(ValueError, match="thermal grid"):
        by_depth.counts(fir, None)
    with pytest.raises(ValueError, match="thermal grid"):
        by_depth.apply(np.zeros(FIR[::-1], np.uint8), None, fir=fir)
    with pytest.raises(FrameError, match="depth map"):
        by_depth.counts(COUNTS, np.ones((3, 3), np.float32))
