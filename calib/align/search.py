"""Where one image may lie on another, with no guess at hand: correlation over scale, turn and shift.

Scale shrinks the one image and turn turns the other, so that each is transformed once per scale or turn, not
once per pair of them; all shifts come from one product of spectra. Exchanging the images changes nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from calib.align.channels import Doubles, Floats, Grey, channels, inverse, resized, warped
from calib.align.models import corner_gap

SCALES = (0.4, 2.5)  # relative to both images stretched to the same longer side
TURN_DEG = 16.0
WIDTH = 144  # pixels of the longer side
_SCALE_STEP, _TURN_STEP_DEG = 1.06, 4.0
_LEAST_OVERLAP = 0.45  # of the smaller image
_LEAST_ENERGY = 0.1  # per pixel; flat overlaps never count as agreement
_ROOM = 1.45  # transforms are so much larger than the images: what wraps around overlaps too little to count
_APART = 0.06  # of the width: candidates closer than this are one


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """`H_rgb_fir` (3, 3), a similarity, and its correlation times the root of the overlap in pixels."""

    H_rgb_fir: Doubles
    score: float


@dataclass(frozen=True, slots=True, eq=False)
class _Side:
    """Spectra of channels, energy and what is seen; the matrix from the pixels given; the area seen."""

    planes: NDArray[np.complex64]
    energy: NDArray[np.complex64]
    seen: NDArray[np.complex64]
    matrix: Doubles
    area: float


def candidates(
    rgb: Sequence[Grey], fir: Sequence[Grey], count: int = 5, width: int = WIDTH
) -> list[Candidate]:
    """The `count` best similarities that take thermal to RGB, best first, all different.

    `rgb` and `fir` are the frames of one rig, each of one size: their correlations are summed. Scales and
    turns are those of `SCALES` and `TURN_DEG`; overlaps of less than 0.45 of the smaller image are not tried.
    Both are searched with their longer side at `width` pixels.
    """
    small_rgb, to_rgb = _small(rgb, width)
    small_fir, to_fir = _small(fir, width)
    larger = np.maximum(small_rgb[0].shape, small_fir[0].shape)
    size = _fast(larger[0]), _fast(larger[1])
    back = inverse(to_rgb)
    found = []
    for a, b in _sides(small_rgb, small_fir, size):
        score, (x, y) = _best_shift(a, b, size)
        shift = np.array([[1, 0, x], [0, 1, y], [0, 0, 1]])
        found.append(Candidate(back @ inverse(a.matrix) @ shift @ b.matrix @ to_fir, score))
    return _different(found, rgb[0].shape, fir[0].shape, count)


def _fast(extent: int) -> int:
    return int(fft.next_fast_len(int(_ROOM * extent), real=True) or 0)


def _small(images: Sequence[Grey], width: int) -> tuple[list[Grey], Doubles]:
    both = [resized(image, width / max(image.shape)) for image in images]
    return [image for image, _ in both], both[0][1]


def _sides(rgb: Sequence[Grey], fir: Sequence[Grey], size: tuple[int, int]) -> Iterable[tuple[_Side, _Side]]:
    """Every pair of an RGB and a thermal image, the larger one of them shrunk, the other one turned."""
    steps = np.arange(1, 1 + int(np.ceil(np.log(SCALES[1]) / np.log(_SCALE_STEP))))
    turns = np.arange(-TURN_DEG, TURN_DEG + 0.1, _TURN_STEP_DEG)
    turned_rgb = [_side([_turned(image, -t) for image in rgb], size) for t in turns]
    for scale in (1.0, *_SCALE_STEP**-steps):
        shrunk = _side([resized(image, scale) for image in fir], size)
        yield from ((turned, shrunk) for turned in turned_rgb)
    del turned_rgb
    turned_fir = [_side([_turned(image, t) for image in fir], size) for t in turns]
    for scale in _SCALE_STEP**-steps:
        shrunk = _side([resized(image, scale) for image in rgb], size)
        yield from ((shrunk, turned) for turned in turned_fir)


def _turned(image: Grey, turn_deg: float) -> tuple[Grey, Doubles]:
    """`image` turned clockwise about its middle, whole, and the matrix that does it."""
    (h, w), turn = image.shape, np.deg2rad(turn_deg)
    c, s = np.cos(turn), np.sin(turn)
    size = int(np.ceil(w * abs(c) + h * abs(s))), int(np.ceil(h * abs(c) + w * abs(s)))
    matrix = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    middle = np.array([(w - 1) / 2, (h - 1) / 2])
    matrix[:2, 2] = (np.array(size) - 1) / 2 - matrix[:2, :2] @ middle
    return warped(image, matrix, size), matrix


def _side(images: Sequence[tuple[Grey, Doubles]], size: tuple[int, int]) -> _Side:
    """The frames of one camera, their channels one after the other: one correlation sums over all."""
    seen = [(image.seen > 0).astype(np.float32) for image, _ in images]
    planes = np.concatenate([channels(i) * s for (i, _), s in zip(images, seen, strict=True)])
    energy = np.einsum("chw,chw->hw", planes, planes)
    area = np.mean(seen, axis=0)
    spectra = [np.asarray(fft.rfft2(plane, size)) for plane in (planes, energy, area)]
    return _Side(spectra[0], spectra[1], spectra[2], images[0][1], float(area.sum()))


def _best_shift(a: _Side, b: _Side, size: tuple[int, int]) -> tuple[float, tuple[int, int]]:
    """Of all shifts (x, y) of b over a with enough overlap the one that is least likely by chance.

    That is the masked correlation times the root of the overlap's area: its worth in standard deviations.
    """
    products = (
        np.einsum("cij,cij->ij", a.planes, b.planes.conj()),
        a.energy * b.seen.conj(),
        a.seen * b.energy.conj(),
        a.seen * b.seen.conj(),
    )
    dot, energy_a, energy_b, overlap = (_real(product, size) for product in products)
    overlap = np.maximum(overlap, 0)
    least = _LEAST_ENERGY * overlap + 1
    score = dot * np.sqrt(overlap / (np.maximum(energy_a, least) * np.maximum(energy_b, least)))
    score[overlap < _LEAST_OVERLAP * min(a.area, b.area)] = -1
    y, x = (int(n) for n in np.unravel_index(int(score.argmax()), score.shape))
    return float(score[y, x]), (_signed(x, size[1]), _signed(y, size[0]))


def _real(spectrum: NDArray[np.complex64], size: tuple[int, int]) -> Floats:
    return np.asarray(fft.irfft2(spectrum, size))


def _signed(shift: int, size: int) -> int:
    return shift - size if shift > size // 2 else shift


def _different(
    found: list[Candidate], rgb_shape: tuple[int, int], fir_shape: tuple[int, int], count: int
) -> list[Candidate]:
    kept: list[Candidate] = []
    for one in sorted(found, key=lambda one: -one.score):
        gaps = (corner_gap(one.H_rgb_fir, other.H_rgb_fir, fir_shape) for other in kept)
        if all(gap > _APART * max(rgb_shape) for gap in gaps):
            kept.append(one)
        if len(kept) == count:
            break
    return kept
