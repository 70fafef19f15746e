"""Maps fitted to matched spots, and which of them the spots justify."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from calib.align.channels import Doubles, inverse

Model = Literal["similarity", "affine", "homography"]
MODELS: tuple[Model, ...] = ("similarity", "affine", "homography")
_LEAST = {"similarity": 2, "affine": 3, "homography": 4}
# By how much the held-out misfit must fall before the next larger map is taken.
_GAIN = {"affine": 0.03, "homography": 0.3}
_FOLDS, _PATCHES = 4, 6
_LEAST_FOR_CHOICE = 60
_ROUNDS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """`rgb_xy` and `fir_xy` (N, 2) float64, pixels of the same spots, and `weight` (N,), 0 for none."""

    rgb_xy: Doubles
    fir_xy: Doubles
    weight: Doubles

    def __post_init__(self) -> None:
        n = len(self.weight)
        if self.rgb_xy.shape != (n, 2) or self.fir_xy.shape != (n, 2) or self.weight.shape != (n,):
            shapes = self.rgb_xy.shape, self.fir_xy.shape, self.weight.shape
            raise ValueError(f"expected (N, 2), (N, 2) and (N,), got {shapes}")


def joined(matches: Sequence[Matches]) -> Matches:
    return Matches(
        np.concatenate([m.rgb_xy for m in matches]),
        np.concatenate([m.fir_xy for m in matches]),
        np.concatenate([m.weight for m in matches]),
    )


def project(matrix: Doubles, xy: Doubles) -> Doubles:
    """(N, 2) points through a homography (3, 3); float64."""
    mapped = xy @ matrix[:, :2].T + matrix[:, 2]
    return mapped[:, :2] / mapped[:, 2:]


def corners_of(shape: tuple[int, ...]) -> Doubles:
    """(4, 2): the middles of an image's corner pixels, around."""
    h, w = shape[:2]
    return np.array([[0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1]], np.float64)


def corner_gap(H: Doubles, other: Doubles, shape: tuple[int, ...]) -> float:
    """Mean distance between where two maps take the corners of an image of `shape`."""
    xy = corners_of(shape)
    return float(np.linalg.norm(project(H, xy) - project(other, xy), axis=1).mean())


def fit(src: Doubles, dst: Doubles, weight: Doubles, model: Model) -> Doubles:
    """The map (3, 3) of kind `model` from `src` to `dst`, both (N, 2), with the least weighted squares.

    Of a homography the algebraic distance, which for the mild ones of a rig is the distance to 1 %.
    Raises `ValueError` where too few points count.
    """
    if np.count_nonzero(weight) < _LEAST[model]:
        raise ValueError(f"{np.count_nonzero(weight)} points determine no {model}")
    to_p, to_q = _normaliser(src), _normaliser(dst)
    system = _system(project(to_p, src), project(to_q, dst), model)
    q = project(to_q, dst).ravel()
    weighted = system * np.repeat(weight, 2)[:, None]
    try:
        k = np.linalg.solve(weighted.T @ system, weighted.T @ q)
    except np.linalg.LinAlgError:
        raise ValueError(f"the points determine no {model}") from None
    if model == "similarity":
        k = np.array([k[0], -k[1], k[2], k[1], k[0], k[3]])
    matrix = inverse(to_q) @ np.append(k, [0, 0, 1][len(k) - 6 :]).reshape(3, 3) @ to_p
    return matrix / matrix[2, 2]


def _normaliser(xy: Doubles) -> Doubles:
    """The similarity that puts the middle of `xy` at 0 and its spread at 1."""
    (x, y), spread = xy.mean(axis=0), max(float((xy - xy.mean(axis=0)).std()), 1e-9)
    return np.array([[1, 0, -x], [0, 1, -y], [0, 0, spread]]) / spread


def _system(p: Doubles, q: Doubles, model: Model) -> Doubles:
    """(2N, 4 | 6 | 8): x and y rows by turns."""
    x, y = p.T
    zero, one = np.zeros(len(p)), np.ones(len(p))
    if model == "similarity":
        rows = [[x, -y, one, zero], [y, x, zero, one]]
    else:
        rows = [[x, y, one, zero, zero, zero], [zero, zero, zero, x, y, one]]
    system = np.stack([np.stack(row, axis=-1) for row in rows], axis=1)
    if model == "homography":
        system = np.concatenate([system, -q[:, :, None] * p[:, None, :]], axis=-1)
    return system.reshape(2 * len(p), -1)


def robust_fit(matches: Matches, model: Model, tolerance_px: float) -> Doubles:
    """The map on which most of the matches' weight agrees; distances far beyond `tolerance_px` count little.

    Starts from a consensus (seeded) of the same kind. Raises `ValueError` where there is none.
    """
    matrix = _consensus(matches, model, 3 * tolerance_px)
    for _ in range(_ROUNDS):
        miss = np.linalg.norm(project(matrix, matches.fir_xy) - matches.rgb_xy, axis=1)
        weight = matches.weight / (1 + (miss / tolerance_px) ** 2) ** 2
        matrix = fit(matches.fir_xy, matches.rgb_xy, weight, model)
    return matrix


def _consensus(matches: Matches, model: Model, threshold: float) -> Doubles:
    use = matches.weight > 0
    src, dst = matches.fir_xy[use], matches.rgb_xy[use]
    if len(src) < max(_LEAST[model], 4):
        raise ValueError(f"{len(src)} matches determine no {model}")
    affine, _ = cv2.estimateAffine2D(src, dst, method=cv2.RANSAC, ransacReprojThreshold=threshold)
    if affine is None or not np.isfinite(affine).all():
        raise ValueError("the matches agree on no map")
    return np.vstack([affine, [0, 0, 1]])


def justified(matches: Matches, tolerance_px: float) -> Model:
    """The smallest map that predicts matches it was not fitted to about as well as the next larger one."""
    if np.count_nonzero(matches.weight) < _LEAST_FOR_CHOICE:
        return "similarity"
    misfit = {model: _held_out(matches, model, tolerance_px) for model in MODELS}
    best: Model = "similarity"
    for larger in ("affine", "homography"):
        if misfit[larger] < (1 - _GAIN[larger]) * misfit[best]:
            best = larger
    return best


def _held_out(matches: Matches, model: Model, tolerance_px: float) -> float:
    """Mean bounded misfit of matches in patches of the image whose matches took no part in the fit."""
    fold = _folds(matches.fir_xy)
    total = 0.0
    for k in range(_FOLDS):
        kept = Matches(matches.rgb_xy, matches.fir_xy, np.where(fold == k, 0, matches.weight))
        try:
            matrix = robust_fit(kept, model, tolerance_px)
        except ValueError:
            return np.inf
        square = ((project(matrix, matches.fir_xy) - matches.rgb_xy) ** 2).sum(axis=1)[fold == k]
        total += float((matches.weight[fold == k] * square / (square + tolerance_px**2)).sum())
    return total / float(matches.weight.sum())


def _folds(xy: Doubles) -> Doubles:
    """The fold of every point: patches of about a sixth of the extent, neighbours in different folds."""
    low, extent = xy.min(axis=0), np.maximum(np.ptp(xy, axis=0), 1e-9)
    column, row = np.minimum((_PATCHES * (xy - low) / extent).astype(int), _PATCHES - 1).T
    return column % 2 + 2 * (row % 2)
