"""The compiled loops against plain numpy twins, exact integers and every value there is."""

from __future__ import annotations

import importlib
import math
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numba.core import config
from numpy.typing import NDArray

from fusion import kernels
from fusion.kernels import blend_indexed, index_counts, resample, scratch

EVERY = {
    np.uint8: np.arange(256, dtype=np.uint8).reshape(16, 16),
    np.uint16: np.arange(65536, dtype=np.uint16).reshape(256, 256),
}


def index_twin(counts: NDArray, lo: float, hi: float) -> tuple[NDArray, int, int]:
    stretched = np.clip((counts.astype(np.float64) - lo) / (hi - lo), 0, 1)
    index = np.floor(255 * stretched + 0.5).astype(np.uint8)
    return index, int((counts < lo).sum()), int((counts > hi).sum())


def resample_twin(image: NDArray, offset: NDArray, fraction: NDArray) -> NDArray:
    """In float64: every weight is a multiple of 1/65536, so nothing is rounded before the end."""
    y, x = np.divmod(offset.astype(np.int64), image.shape[1])
    below, right = np.minimum(y + 1, image.shape[0] - 1), np.minimum(x + 1, image.shape[1] - 1)
    fx, fy = (fraction & 255) / 256, (fraction >> 8) / 256
    upper = image[y, x] * (1 - fx) + image[y, right] * fx
    lower = image[below, x] * (1 - fx) + image[below, right] * fx
    return np.floor(upper * (1 - fy) + lower * fy + 0.5).astype(np.uint8)


def blend_twin(
    bgr: NDArray, index: NDArray, table: NDArray, thousandths: int, mask: NDArray | None
) -> NDArray:
    a, c = bgr.astype(np.int32), table.astype(np.int32)[index]
    blended = (thousandths * a + (1000 - thousandths) * c + 500) // 1000
    return (blended if mask is None else np.where(mask[..., None] > 0, blended, a)).astype(np.uint8)


def agrees(counts: NDArray, lo: float, hi: float) -> None:
    index, below, above = index_counts(counts, lo, hi)
    expected = index_twin(counts, lo, hi)
    np.testing.assert_array_equal(index, expected[0])
    assert (below, above) == expected[1:]
    assert index.dtype == np.uint8


@pytest.mark.parametrize("dtype", EVERY)
@pytest.mark.parametrize(
    ("lo", "hi"),
    [
        (0, 255),
        (0, 65535),
        (0.3 * 65535, 0.6 * 65535),
        (76.5, 153),
        (7100, 7610),
        (100, 101),
        (100.2, 100.8),
        (-50, 70000),
        (-3, -1),
        (65535, 65536),
        (70000, 80000),
        (0, 1e-300),
        (-1e300, 1e300),
        (41.5, 42.5),
    ],
)
def test_every_count_falls_on_its_index(dtype: type, lo: float, hi: float) -> None:
    agrees(EVERY[dtype], lo, hi)


@given(lo=st.floats(-1e5, 1e5), span=st.floats(1e-6, 1e5), whole=st.booleans())
@settings(max_examples=60, deadline=None)
def test_any_window_agrees_with_the_twin(lo: float, span: float, whole: bool) -> None:
    if whole:  # whole windows are the ones with ties
        lo, span = round(lo), 2 * math.ceil(span / 2)
    if lo < lo + span:
        for counts in EVERY.values():
            agrees(counts, lo, lo + span)


@pytest.mark.parametrize("value", [0, 65535])
@pytest.mark.parametrize("shape", [(1, 1), (1, 4032), (1, 4033), (300, 301)])
def test_tallies_hold_when_every_pixel_lies_outside(value: int, shape: tuple[int, int]) -> None:
    size = shape[0] * shape[1]
    _, below, above = index_counts(np.full(shape, value, np.uint16), 1.0, 65534.0)
    assert (below, above) == ((size, 0) if value == 0 else (0, size))


@pytest.mark.parametrize(
    ("counts", "lo", "hi"),
    [
        (EVERY[np.uint8], 5, 5),
        (EVERY[np.uint8], 6, 5),
        (EVERY[np.uint8], math.nan, 5),
        (EVERY[np.uint8], 0, math.inf),
        *((EVERY[np.uint16].astype(t), 0, 5) for t in (np.int16, np.float32, ">u2", bool)),
        (np.zeros(9, np.uint8), 0, 5),
        (np.zeros((0, 9), np.uint8), 0, 5),
        (np.zeros((3, 3, 3), np.uint8), 0, 5),
    ],
)
def test_index_refuses_what_it_cannot_stretch(counts: NDArray, lo: float, hi: float) -> None:
    with pytest.raises(ValueError, match="expected"):
        index_counts(counts, lo, hi)


def sampling(rng: np.random.Generator, image: NDArray, shape: tuple[int, int]) -> tuple[NDArray, NDArray]:
    offset = rng.integers(0, image.size, shape).astype(np.uint32)
    return offset, rng.integers(0, 65536, shape).astype(np.uint16)


@given(h=st.integers(1, 40), w=st.integers(1, 40), seed=st.integers(0, 99))
@example(h=1, w=1, seed=0)
@example(h=1, w=40, seed=0)
@example(h=40, w=1, seed=0)
@settings(max_examples=40, deadline=None)
def test_resample_agrees_with_float64_for_any_position(h: int, w: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (h, w)).astype(np.uint8)
    offset, fraction = sampling(rng, image, (37, 41))
    np.testing.assert_array_equal(resample(image, offset, fraction), resample_twin(image, offset, fraction))


def test_resample_agrees_for_every_fraction_and_every_pixel() -> None:
    image = np.random.default_rng(3).choice(np.array([0, 1, 128, 254, 255], np.uint8), (3, 4))
    fraction = np.tile(EVERY[np.uint16].reshape(1, -1), (image.size, 1))
    offset = np.repeat(np.arange(image.size, dtype=np.uint32)[:, None], fraction.shape[1], axis=1)
    for order in (
        slice(None),
        slice(None, None, -1),
    ):  # taps wanted from the top down, and from the bottom up
        positions = np.ascontiguousarray(offset[order]), fraction
        np.testing.assert_array_equal(resample(image, *positions), resample_twin(image, *positions))


def test_resample_at_whole_pixels_copies_and_fills_out() -> None:
    image = np.random.default_rng(4).integers(0, 256, (97, 131)).astype(np.uint8)
    offset = np.arange(image.size, dtype=np.uint32).reshape(image.shape)
    out = np.empty_like(image)
    assert resample(image, offset, np.zeros(image.shape, np.uint16), out) is out
    np.testing.assert_array_equal(out, image)


@pytest.mark.parametrize("bad", [6, 2**31, 2**31 + 1, 2**32 - 1])
@pytest.mark.parametrize("place", [0, 20000])
def test_resample_refuses_offsets_outside_the_image(bad: int, place: int) -> None:
    offset = np.zeros((1, 20001), np.uint32)
    offset[0, place] = bad
    with pytest.raises(ValueError, match=f"outside the image of 6 pixels: {bad}"):
        resample(np.zeros((2, 3), np.uint8), offset, np.zeros(offset.shape, np.uint16))


def test_resample_refuses_an_out_that_overlaps_or_does_not_fit() -> None:
    image, offset, fraction = (
        np.zeros((4, 4), np.uint8),
        np.zeros((4, 4), np.uint32),
        np.zeros((4, 4), np.uint16),
    )
    read_only = np.empty((4, 4), np.uint8)
    read_only.flags.writeable = False
    for array in (image, offset, fraction):
        with pytest.raises(ValueError, match="out: overlaps an input"):
            resample(image, offset, fraction, array.reshape(-1).view(np.uint8)[:16].reshape(4, 4))
    strided = np.empty((4, 8), np.uint8)[:, ::2]
    unfit: list[Any] = [np.empty((4, 5), np.uint8), np.empty((4, 4), np.int8), strided, read_only]
    for out in unfit:
        with pytest.raises(ValueError, match="out: expected"):
            resample(image, offset, fraction, out)


@pytest.mark.parametrize(
    ("position", "wrong"),
    [
        (0, np.zeros((4, 4), np.uint16)),
        (0, np.zeros((0, 4), np.uint8)),
        (1, np.zeros((4, 4), np.int64)),
        (1, np.zeros(16, np.uint32)),
        (2, np.zeros((4, 4), np.uint8)),
        (2, np.zeros((4, 5), np.uint16)),
    ],
)
def test_resample_refuses_other_types_and_shapes(position: int, wrong: NDArray) -> None:
    arguments: list[Any] = [np.zeros((4, 4), t) for t in (np.uint8, np.uint32, np.uint16)]
    arguments[position] = wrong
    with pytest.raises(ValueError, match=r"expected (n|4) x (n|4) uint"):
        resample(*arguments)


# Every pair of an RGB value and a colour value: rows are colours, columns (three to a pixel) RGB values.
PAIRS_BGR = (np.arange(258) % 256).astype(np.uint8).reshape(1, 86, 3).repeat(256, axis=0)
PAIRS_INDEX = np.arange(256, dtype=np.uint8)[:, None].repeat(86, axis=1)
GREYS = np.arange(256, dtype=np.uint8)[:, None].repeat(3, axis=1)


def test_blend_is_exact_for_all_pairs_and_every_alpha_of_three_decimals() -> None:
    a, c = np.divmod(np.arange(65536, dtype=np.int32).reshape(256, 256), 256)[::-1]  # a varies along a row
    for thousandths in range(1001):
        got = blend_indexed(PAIRS_BGR, PAIRS_INDEX, GREYS, thousandths / 1000).reshape(256, 258)[:, :256]
        expected = (thousandths * a + (1000 - thousandths) * c + 500) // 1000
        assert (got == expected).all(), f"alpha {thousandths / 1000}"


@given(st.floats(0, 1))
@example(math.nextafter(1, 0))
@example(math.nextafter(0, 1))
@example(1 / 3)
@settings(max_examples=50, deadline=None)
def test_blend_of_any_alpha_errs_only_just_below_a_half(alpha: float) -> None:
    got = blend_indexed(PAIRS_BGR, PAIRS_INDEX, GREYS, alpha).astype(int)
    true = alpha * PAIRS_BGR + (1 - alpha) * PAIRS_INDEX[..., None]
    error = got - np.floor(true + 0.5)
    below_half = 0.5 - (true - np.floor(true))
    assert set(np.unique(error)) <= {0, 1}
    assert ((error == 0) | ((below_half > 0) & (below_half < 4e-4)) | (abs(below_half) < 1e-9)).all()


def scene(seed: int, h: int, w: int) -> tuple[NDArray, NDArray, NDArray]:
    rng = np.random.default_rng(seed)
    return tuple(rng.integers(0, 256, s).astype(np.uint8) for s in ((h, w, 3), (h, w), (256, 3)))  # type: ignore[return-value]


@given(
    h=st.integers(1, 9),
    w=st.sampled_from([1, 2, 3, 5, 64, 1023, 1365, 4095, 4097]),
    thousandths=st.integers(0, 1000),
    share=st.sampled_from([None, 0.0, 0.001, 0.5, 0.999, 1.0]),
    seed=st.integers(0, 99),
)
@settings(max_examples=60, deadline=None)
def test_blend_agrees_with_exact_integers(
    h: int, w: int, thousandths: int, share: float | None, seed: int
) -> None:
    bgr, index, table = scene(seed, h, w)
    rng = np.random.default_rng(seed)
    mask = None
    if share is not None:
        mask = np.where(rng.random((h, w)) < share, rng.choice([1, 128, 255], (h, w)), 0).astype(np.uint8)
    got = blend_indexed(bgr, index, table, thousandths / 1000, mask)
    np.testing.assert_array_equal(got, blend_twin(bgr, index, table, thousandths, mask))


def test_blend_at_the_ends_gives_the_images_themselves() -> None:
    bgr, index, table = scene(5, 31, 57)
    all_rgb = blend_indexed(bgr, index, table, 1)
    np.testing.assert_array_equal(all_rgb, bgr)
    assert not np.may_share_memory(all_rgb, bgr)
    np.testing.assert_array_equal(blend_indexed(bgr, index, table, 0), table[index])


@pytest.mark.parametrize(
    ("position", "wrong"),
    [
        (0, np.zeros((4, 5), np.uint8)),
        (0, np.zeros((4, 5, 4), np.uint8)),
        (0, np.zeros((4, 5, 3), np.uint16)),
        (1, np.zeros((5, 4), np.uint8)),
        (1, np.zeros((4, 5), np.int32)),
        (2, np.zeros((255, 3), np.uint8)),
        (2, np.zeros((256, 3))),
        (3, 1.01),
        (3, -0.01),
        (3, math.nan),
        (4, np.ones((4, 4), np.uint8)),
        (4, np.ones((4, 5), bool)),
    ],
)
def test_blend_refuses_other_types_shapes_and_alphas(position: int, wrong: Any) -> None:
    arguments: list[Any] = [*(np.zeros(s, np.uint8) for s in ((4, 5, 3), (4, 5), (256, 3))), 0.5, None]
    arguments[position] = wrong
    with pytest.raises(ValueError, match=r"expected (alpha|n|4|256) "):
        blend_indexed(*arguments)


def test_strided_read_only_and_misaligned_inputs_give_the_same_and_stay_the_same() -> None:
    bgr, index, table = scene(6, 24, 40)
    counts = (index * np.uint16(200)).astype(np.uint16)
    offset, fraction = sampling(np.random.default_rng(6), index, index.shape)
    plain = [bgr, index, table, counts, offset, fraction]

    def misaligned(array: NDArray) -> NDArray:
        view = np.zeros(array.nbytes + 1, np.uint8)[1:].view(array.dtype).reshape(array.shape)
        view[...] = array
        view.flags.writeable = False
        return view

    shifted = [misaligned(array) for array in plain]
    strided = [array.repeat(2, axis=-1)[..., ::2] for array in plain]
    before = [array.tobytes() for array in [*plain, *shifted, *strided]]
    for b, i, t, c, o, f in (plain, shifted, strided):
        np.testing.assert_array_equal(
            blend_indexed(b, i, t, 0.85, i), blend_twin(bgr, index, table, 850, index)
        )
        np.testing.assert_array_equal(index_counts(c, 500, 20000.5)[0], index_twin(counts, 500, 20000.5)[0])
        np.testing.assert_array_equal(resample(i, o, f), resample_twin(index, offset, fraction))
    assert [array.tobytes() for array in [*plain, *shifted, *strided]] == before
    for loop in (kernels._look_up_counts, kernels._sample, kernels._blend):  # nothing was compiled twice
        most = 2 if loop is kernels._look_up_counts else 1  # uint8 and uint16 counts
        assert len(loop.signatures) <= most  # type: ignore[attr-defined]


def chain(seed: int) -> bytes:
    bgr, image, table = scene(seed, 60 + seed, 80)
    index, *_ = index_counts(image, 20, 200)
    offset, fraction = sampling(np.random.default_rng(seed), image, image.shape)
    return blend_indexed(bgr, resample(index, offset, fraction), table, 0.85, image).tobytes()


def test_threads_do_not_share_buffers() -> None:
    serial = [chain(seed) for seed in range(24)]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(4):
            assert list(pool.map(chain, range(24))) == serial


def test_scratch_is_reused_within_a_thread_and_owned_by_it() -> None:
    first = scratch("test", (6, 8), np.uint32)
    assert first.shape == (6, 8)
    assert first.dtype == np.uint32
    address = first.ctypes.data
    for shape, dtype in (((3, 4), np.uint32), ((6, 32), np.uint8), ((6, 8), np.uint32)):
        assert scratch("test", shape, dtype).ctypes.data == address
    assert not np.may_share_memory(first, scratch("other", (6, 8), np.uint32))
    assert scratch("test", (100, 100), np.uint16).shape == (100, 100)
    with ThreadPoolExecutor(1) as pool:
        theirs = pool.submit(scratch, "test", (6, 8), np.uint32).result()
    assert not np.may_share_memory(scratch("test", (6, 8), np.uint32), theirs)


def test_a_second_process_finds_the_machine_code() -> None:
    index_counts(EVERY[np.uint16], 1.0, 2.0)
    if kernels._look_up_counts.stats.cache_path is None:  # type: ignore[attr-defined]
        pytest.skip("no folder here in which machine code may be kept")
    program = (
        "import numpy as np; from fusion import kernels as k\n"
        "c = np.arange(65536, dtype=np.uint16).reshape(256, 256)\n"
        "i, *_ = k.index_counts(c, 100.0, 40000.5)\n"
        "s = k._look_up_counts.stats\n"
        "print(sum(s.cache_hits.values()), sum(s.cache_misses.values()), int((i * np.arange(256)).sum()))"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    expected = index_twin(EVERY[np.uint16], 100.0, 40000.5)[0] * np.arange(256)
    assert run.stdout.split() == ["1", "0", str(expected.sum())]


def test_without_a_place_for_machine_code_a_loop_still_compiles() -> None:
    namespace: dict[str, Any] = {}
    exec("def twice(n):\n    return n + n", namespace)  # from no file: there is nothing to cache beside
    assert kernels.compiled(namespace["twice"])(21) == 42


def test_damaged_or_unwritable_machine_code_is_compiled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "extra_loop.py").write_text("def twice(n):\n    return n + n\n")
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "code"))
    twice = importlib.import_module("extra_loop").twice

    def found(n: int) -> bool:
        """Whether a fresh process's first call would find machine code; the call itself must be right."""
        loop: Any = kernels.compiled(twice)
        assert loop(n) == 2 * n
        return bool(loop.stats.cache_hits)

    assert [found(1), found(2)] == [False, True]
    for pattern in ("*.nbc", "*.nbi"):
        for path in list((tmp_path / "code").rglob(pattern)):
            path.write_bytes(b"")
        assert [found(3), found(4)] == [False, True]  # and it was mended
    loop: Any = kernels.compiled(twice)
    shutil.rmtree(tmp_path / "code")
    (tmp_path / "code").write_text("a file where the folder was")
    assert loop(5) == 10
