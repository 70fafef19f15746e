"""What becomes of channels: plain numpy is the oracle."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.errors import FrameError
from fusion.sources.roles import to_role

GENERATOR = np.random.default_rng(1)
COLOUR = GENERATOR.integers(0, 256, (5, 7, 3), np.uint8)
ALL_16 = np.arange(65536, dtype=np.uint16).reshape(256, 256)


def with_alpha(pixels: np.ndarray, alpha: int) -> np.ndarray:
    full = np.full((*pixels.shape[:2], 1), alpha, pixels.dtype)
    return np.dstack([pixels, full])


def test_rgb_as_is() -> None:
    pixels, flags = to_role(COLOUR, "rgb", "x", "refuse")
    assert (pixels == COLOUR).all()
    assert flags == ()


def test_rgb_of_every_16_bit_value_rounds_exactly() -> None:
    pixels, flags = to_role(ALL_16, "rgb", "x", "refuse")
    values = ALL_16.astype(np.int64)
    expected = (2 * values + 257) // 514  # round(v / 257) in integers
    assert flags == ("rgb-16bit-to-8", "rgb-grey")
    assert (pixels == expected[:, :, None]).all()
    assert pixels.dtype == np.uint8


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_rgb_alpha(dtype) -> None:
    top = int(np.iinfo(dtype).max)
    pixels = (COLOUR.astype(dtype) * (top // 255)).astype(dtype)
    lowered = () if dtype is np.uint8 else ("rgb-16bit-to-8",)
    opaque, flags = to_role(with_alpha(pixels, top), "rgb", "x", "refuse")
    assert flags == lowered
    assert (opaque == COLOUR).all()
    seen, flags = to_role(with_alpha(pixels, top - 1), "rgb", "x", "refuse")
    assert flags == ("rgb-alpha-dropped", *lowered)
    assert (seen == COLOUR).all()  # not multiplied by it


def test_fir_as_is() -> None:
    for pixels in (COLOUR[:, :, 0].copy(), ALL_16):
        counts, flags = to_role(pixels, "fir", "x", "refuse")
        assert counts.dtype == pixels.dtype
        assert (counts == pixels).all()
        assert flags == ()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("alpha", [False, True])
def test_fir_grey_stored_as_colour(dtype, alpha) -> None:
    grey = GENERATOR.integers(0, np.iinfo(dtype).max, (5, 7), dtype)
    pixels = np.dstack([grey] * 3)
    pixels = with_alpha(pixels, int(np.iinfo(dtype).max)) if alpha else pixels
    counts, flags = to_role(pixels, "fir", "x", "refuse")
    assert (counts == grey).all()
    assert flags == ("fir-grey-stored-as-colour",)
    assert counts.flags.c_contiguous


@pytest.mark.parametrize(("channel", "step"), [(0, 2), (1, -2), (2, 2)])
def test_fir_tolerance_of_8_bit(channel, step) -> None:
    pixels = np.full((4, 4, 3), 100, np.uint8)
    pixels[2, 3, channel] = 100 + step
    assert to_role(pixels, "fir", "x", "refuse")[1] == ("fir-grey-stored-as-colour",)
    pixels[2, 3, channel] = 100 + step * 3 // 2
    with pytest.raises(FrameError, match="--fir-colour luma"):
        to_role(pixels, "fir", "x", "refuse")


def test_fir_tolerance_is_between_any_two_channels() -> None:
    pixels = np.full((1, 1, 3), 100, np.uint8)
    pixels[0, 0] = (98, 100, 101)
    with pytest.raises(FrameError, match="coloured"):
        to_role(pixels, "fir", "x", "refuse")


def test_fir_16_bit_has_no_tolerance() -> None:
    pixels = np.full((4, 4, 3), 30000, np.uint16)
    pixels[0, 0, 2] += 1
    with pytest.raises(FrameError, match="coloured"):
        to_role(pixels, "fir", "x", "refuse")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_fir_luma_is_bt601(dtype) -> None:
    pixels = GENERATOR.integers(0, np.iinfo(dtype).max, (50, 70, 3), dtype)
    before = pixels.copy()
    counts, flags = to_role(pixels, "fir", "x", "luma")
    expected = pixels.astype(float) @ [0.114, 0.587, 0.299]
    # OpenCV's weights are multiples of 2**-14: off by half of one each, over the range of the type
    tolerance = 0.5 + 1.5 * float(np.iinfo(dtype).max) / 2**14 * 0.5 + 1e-9
    assert counts.dtype == dtype
    assert np.abs(counts - expected).max() <= tolerance
    assert flags == ("fir-colour-to-luma",)
    assert (pixels == before).all()


def test_fir_alpha_with_data_is_refused_even_for_luma() -> None:
    with pytest.raises(FrameError, match="alpha channel that holds data"):
        to_role(with_alpha(COLOUR, 7), "fir", "x", "luma")
