"""The blenders: one contract for all, and the pyramid against Burt's filter written out in float64."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

from fusion.blend import BLENDERS, blend_laplacian, blender
from fusion.errors import UsageError
from fusion.kernels import blend_indexed

BURT = np.array([1, 4, 6, 4, 1]) / 16
SHAPES = [(1, 1), (1, 50), (50, 1), (7, 5), (16, 16), (17, 16), (31, 33), (64, 95), (121, 90), (270, 310)]


def scene(seed: int, h: int, w: int) -> tuple[NDArray, NDArray, NDArray]:
    rng = np.random.default_rng(seed)
    shapes = ((h, w, 3), (h, w), (256, 3))
    bgr, index, table = (rng.integers(0, 256, shape).astype(np.uint8) for shape in shapes)
    return bgr, index, table


def reduced(image: NDArray) -> NDArray:
    for axis in (0, 1):
        image = convolve1d(image, BURT, axis=axis, mode="mirror")
    return image[::2, ::2]


def expanded(image: NDArray, shape: tuple[int, ...]) -> NDArray:
    spread = np.zeros((2 * image.shape[0], 2 * image.shape[1], 3))
    spread[::2, ::2] = image
    for axis in (0, 1):
        spread = convolve1d(spread, 2 * BURT, axis=axis, mode="mirror")
    return spread[: shape[0], : shape[1]]


def laplacian_twin(a: NDArray, b: NDArray, alpha: float, levels: int = 5) -> NDArray:
    """Recursive, in float64: the coarser half of both images is blended the same way."""
    if levels == 0 or min(a.shape[:2]) < 16:
        return alpha * a + (1 - alpha) * b
    coarse_a, coarse_b = reduced(a), reduced(b)
    detail_a = (a - expanded(coarse_a, a.shape)) * min(1, 2 * alpha)
    detail_b = (b - expanded(coarse_b, b.shape)) * min(1, 2 * (1 - alpha))
    longer = np.linalg.norm(detail_b, axis=2) > np.linalg.norm(detail_a, axis=2)
    detail = np.where(longer[..., None], detail_b, detail_a)
    return expanded(laplacian_twin(coarse_a, coarse_b, alpha, levels - 1), a.shape) + detail


def difference(first: NDArray, second: NDArray) -> NDArray:
    return abs(first.astype(int) - second.astype(int))


@pytest.fixture(params=sorted(BLENDERS))
def blend(request: pytest.FixtureRequest) -> Any:
    return BLENDERS[request.param]


@pytest.mark.parametrize("shape", SHAPES)
def test_every_blender_keeps_its_contract(blend: Any, shape: tuple[int, int]) -> None:
    bgr, index, table = scene(1, *shape)
    mask = np.where(np.random.default_rng(2).random(shape) < 0.7, 255, 0).astype(np.uint8)
    arguments = bgr, index, table, mask
    for array in arguments:
        array.flags.writeable = False
    before = [array.tobytes() for array in arguments]
    plain, masked = blend(bgr, index, table, 0.85, None), blend(bgr, index, table, 0.85, mask)
    for fused in (plain, masked):
        assert fused.shape == bgr.shape
        assert fused.dtype == np.uint8
        assert fused.flags.writeable
        assert not any(np.may_share_memory(fused, array) for array in arguments)
    np.testing.assert_array_equal(masked[mask == 0], bgr[mask == 0])
    np.testing.assert_array_equal(blend(bgr, index, table, 0.85, np.full(shape, 1, np.uint8)), plain)
    np.testing.assert_array_equal(blend(bgr, index, table, 0.85, np.zeros(shape, np.uint8)), bgr)
    assert [array.tobytes() for array in arguments] == before


@pytest.mark.parametrize("shape", SHAPES)
def test_every_blender_leaves_one_image_alone_at_either_end(blend: Any, shape: tuple[int, int]) -> None:
    bgr, index, table = scene(3, *shape)
    assert difference(blend(bgr, index, table, 1.0, None), bgr).max() <= 1
    assert difference(blend(bgr, index, table, 0.0, None), table[index]).max() <= 1


@pytest.mark.parametrize("alpha", [0.0, 0.3, 0.5, 0.85, 1.0])
@pytest.mark.parametrize("shape", SHAPES)
def test_every_blender_gives_back_rgb_where_thermal_is_the_same(
    blend: Any, shape: tuple[int, int], alpha: float
) -> None:
    _, index, table = scene(4, *shape)
    assert difference(blend(table[index], index, table, alpha, None), table[index]).max() <= 1


@pytest.mark.parametrize(
    ("position", "wrong"),
    [
        (0, np.zeros((4, 5), np.uint8)),
        (0, np.zeros((4, 5, 3), np.float32)),
        (1, np.zeros((5, 4), np.uint8)),
        (2, np.zeros((3, 256), np.uint8)),
        (3, 1.5),
        (3, math.nan),
        (4, np.ones((5, 4), np.uint8)),
        (4, np.ones((4, 5), bool)),
    ],
)
def test_every_blender_refuses_what_does_not_fit(blend: Any, position: int, wrong: Any) -> None:
    arguments: list[Any] = [*(np.zeros(s, np.uint8) for s in ((4, 5, 3), (4, 5), (256, 3))), 0.5, None]
    arguments[position] = wrong
    with pytest.raises(ValueError, match="expected"):
        blend(*arguments)


@pytest.mark.parametrize("alpha", [0.15, 0.5, 0.85])
@pytest.mark.parametrize("shape", SHAPES)
def test_laplacian_agrees_with_burts_filter_in_float64(shape: tuple[int, int], alpha: float) -> None:
    bgr, index, table = scene(5, *shape)
    mask = np.zeros(shape, np.uint8)
    mask[shape[0] // 5 :, : 1 + shape[1] * 4 // 5] = 255
    thermal = np.where(mask[..., None] > 0, table[index], bgr).astype(np.float64)
    expected = np.where(mask[..., None] > 0, laplacian_twin(bgr.astype(np.float64), thermal, alpha), bgr)
    got = blend_laplacian(bgr, index, table, alpha, mask)
    # where two coefficients are equally strong but for float32, either may win
    assert (abs(got - np.clip(expected, 0, 255)) < 0.501).mean() > 0.999


def test_laplacian_keeps_the_contrast_that_alpha_halves() -> None:
    """RGB alone has a pattern on the left, thermal alone on the right: each is kept in full at 1/2."""
    stripes = np.where(np.arange(64) // 2 % 2, 160, 96).astype(np.uint8)
    flat = np.full((64, 128), 128, np.uint8)
    rgb, index = flat.copy(), flat.copy()
    rgb[:, :64], index[:, 64:] = stripes, stripes
    bgr = np.repeat(rgb[..., None], 3, axis=2)
    greys = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
    inner = [np.s_[16:48, 16:48], np.s_[16:48, 80:112]]
    spread = {
        name: [np.ptp(blender(name)(bgr, index, greys, 0.5, None)[s]) for s in inner] for name in BLENDERS
    }
    assert spread["alpha"] == [32, 32]
    assert min(spread["laplacian"]) >= 60


def test_laplacian_does_not_depend_on_threads() -> None:
    bgr, index, table = scene(6, 200, 301)
    threads, results = cv2.getNumThreads(), set()
    try:
        for n in (1, 2, 4, 1):
            cv2.setNumThreads(n)
            results.add(blend_laplacian(bgr, index, table, 0.7).tobytes())
    finally:
        cv2.setNumThreads(threads)
    assert len(results) == 1


def test_real_pairs_gain_contrast_and_keep_their_brightness(shared_data: Path) -> None:
    folder = shared_data / "rgbt_pairs" / "MSRS"
    greys = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
    for path in sorted((folder / "vi").glob("*.png"))[:2]:
        bgr: Any = cv2.imread(str(path))
        index: Any = cv2.imread(str(folder / "ir" / path.name), cv2.IMREAD_GRAYSCALE)
        alpha, laplacian = (blender(name)(bgr, index, greys, 0.5, None).astype(float) for name in BLENDERS)
        assert laplacian.std() > alpha.std()
        assert np.diff(laplacian, axis=1).std() > 1.2 * np.diff(alpha, axis=1).std()
        assert abs(laplacian.mean() - alpha.mean()) < 3


def test_blenders_are_found_by_name() -> None:
    assert blender("alpha") is blend_indexed
    assert blender("laplacian") is blend_laplacian
    with pytest.raises(UsageError, match=r"unknown blender 'alhpa' \(one of: alpha, laplacian"):
        blender("alhpa")
