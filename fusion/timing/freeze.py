"""Thermal frames that repeat their predecessor: the shutter is closed, and the camera shows its last picture.

A sensor's noise makes no two of its pictures equal, also of a scene that stands still, so equal counts are
certain. A stream that was compressed with losses, or that has a clock drawn into it, repeats a picture almost
only: there hardly a pixel changes, far fewer than in the frames around. Telemetry, which counts on in the
first or last rows of some cameras, is left out of both.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from hashlib import blake2b
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import percentile_filter

Pixels = NDArray[np.uint8] | NDArray[np.uint16]
Flags = NDArray[np.bool_]

AROUND = 128  # frames on each side that tell the level of the noise
_EDGE = 0.05  # of the height at the top and at the bottom: telemetry
_SAMPLES = 160  # columns and rows that are compared pixel by pixel, at most
_BLOCK = 8
_DRAWN = 75  # per cent of the blocks: what is drawn into the others may change
_LEVEL = 30  # per cent of the frames around, the calmest
_ALIKE, _FEWER = 0.25, 0.5  # of the pixels, and of what changes in those frames


class Step(NamedTuple):
    """A frame against its predecessor: whether it is the `same` picture, and the share of pixels that
    `changed`, 0 to 1, which noise makes a large one also where nothing moves; NaN where it cannot be told
    (the first frame, another size, a flat picture).
    """

    same: bool
    changed: float


class Run(NamedTuple):
    """Frames [`first`, `end`) show one picture: `first` took it, the others repeat it."""

    first: int
    end: int


class FreezeFinder:
    """Fed with frames in order, says of each how it differs from the one before. Keeps a thinned frame."""

    def __init__(self) -> None:
        self._digest = b""
        self._thin: Pixels | None = None

    def add(self, pixels: Pixels) -> Step:
        """`pixels` is H x W (or H x W x C) counts; it is not kept. Raises `ValueError` for fewer
        dimensions.
        """
        digest, thin = picture_digest(pixels), _thinned(pixels)
        before, self._thin = self._thin, thin
        same, self._digest = digest == self._digest, digest
        if before is None or before.shape != thin.shape:
            return Step(same, np.nan)
        return Step(same, 0.0 if same else _changed(before, thin))


def picture_digest(pixels: Pixels) -> bytes:
    """16 bytes that are equal where pictures are, their first and last twentieth of rows left out.

    Of frames in different processes digests may be compared instead of pixels. Flat pictures (black,
    saturated) are equal as others are: nothing in them is new.
    """
    if pixels.ndim < 2:
        raise ValueError(f"expected H x W counts, got {pixels.shape}")
    inner = np.ascontiguousarray(_inner(pixels))
    head = f"{pixels.shape}{pixels.dtype.str}".encode()
    return blake2b(inner.data, digest_size=16, key=blake2b(head, digest_size=16).digest()).digest()


def repeats(digests: Iterable[bytes]) -> Flags:
    """Of each frame whether its digest is its predecessor's; False for the first."""
    listed = list(digests)
    return np.array([k > 0 and d == listed[k - 1] for k, d in enumerate(listed)], bool)


def frozen(steps: Sequence[Step]) -> Flags:
    """Of each frame whether it repeats its predecessor: the same picture, or, in a run of three or more,
    almost.

    Exact repeats hang on the predecessor alone; almost equal ones on `AROUND` frames on each side, so that
    parts of a recording with that much overlap agree. A scene that stands still is not frozen: its noise is
    there. A video whose encoder left every block as it was cannot be told from one that is frozen, and
    counts as that.
    """
    same = np.array([step.same for step in steps], bool)
    alike = same | _alike(np.array([step.changed for step in steps], np.float64), same)
    return same | (alike & _in_threes(alike))


def frozen_runs(flags: Flags, shortest: int = 2) -> list[Run]:
    """Runs of `shortest` or more frames that show one picture, of flags as `frozen` and `repeats` give
    them.
    """
    edges = np.diff(np.concatenate([[0], np.asarray(flags, np.int8), [0]]))
    starts, ends = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    runs = [Run(max(int(a) - 1, 0), int(b)) for a, b in zip(starts, ends, strict=True)]
    return [run for run in runs if run.end - run.first >= shortest]


def _inner(pixels: Pixels) -> Pixels:
    edge = int(np.ceil(_EDGE * len(pixels)))
    return pixels[edge : len(pixels) - edge] if len(pixels) > 2 * edge else pixels


def _thinned(pixels: Pixels) -> Pixels:
    """Every so many rows and columns: means would hide the noise."""
    inner = _inner(pixels)
    if inner.ndim == 3:
        inner = inner[..., 1 % inner.shape[2]]
    steps = [max(1, size // _SAMPLES) for size in inner.shape]
    return inner[:: steps[0], :: steps[1]].copy()


def _changed(before: Pixels, after: Pixels) -> float:
    """The share of pixels that changed, of the blocks that are not flat, in all but those that changed
    most.
    """
    shares = _blocks(before != after).mean(1)
    textured = (np.ptp(_blocks(before), axis=1) > 0) | (np.ptp(_blocks(after), axis=1) > 0)
    return float(np.percentile(shares[textured], _DRAWN)) if textured.any() else np.nan


def _blocks(image: NDArray[Any]) -> NDArray[Any]:
    """N x pixels; what is left over at the right and at the bottom is left out."""
    b = min(_BLOCK, *image.shape)
    rows, cols = image.shape[0] // b, image.shape[1] // b
    return image[: rows * b, : cols * b].reshape(rows, b, cols, b).swapaxes(1, 2).reshape(rows * cols, b * b)


def _alike(changed: NDArray[np.float64], same: Flags) -> Flags:
    """Hardly a change, and far less than around; where that is not known, nothing is alike."""
    live = np.flatnonzero(~same & np.isfinite(changed))
    alike = np.zeros(len(changed), bool)
    if len(live) < 3:
        return alike
    filled = np.interp(np.arange(len(changed)), live, changed[live])
    level = percentile_filter(filled, _LEVEL, 2 * AROUND + 1, mode="mirror")
    alike[live] = (changed[live] < _ALIKE) & (changed[live] < _FEWER * level[live])
    return alike


def _in_threes(flags: Flags) -> Flags:
    """Which have a neighbour that is set as well: three pictures alike are two that repeat."""
    padded = np.concatenate([[False], flags, [False]])
    return padded[:-2] | padded[2:]
