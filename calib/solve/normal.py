"""Normal equations whose boards are eliminated (Schur complement).

The matrix of all unknowns is an arrow: shared parameters (some 30) x themselves, and 6 x 6 blocks of the
boards on the diagonal. Eliminating these leaves a small dense system (Brown 1958; Triggs et al. 2000, section
6.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.solve.blocks import Block, Ids, Linear
from calib.solve.state import Layout, State
from fusion.geometry import Floats


@dataclass(frozen=True, slots=True)
class Part:
    """What a block adds: of each of its V views `H` (V, p + 6, p + 6) and gradient `g` (V, p + 6). The
    sensor's free parameters come first, which stand at `at` (p,) among the free ones; then the board of
    `moments` (V,)."""

    at: Ids
    moments: Ids
    H: Floats
    g: Floats


@dataclass(frozen=True, slots=True)
class Normal:
    """Half the Hessian and half the gradient of the weighted squares: P shared parameters, M boards."""

    ss: Floats  # (P, P)
    sb: Floats  # (M, P, 6)
    bb: Floats  # (M, 6, 6)
    gs: Floats  # (P,)
    gb: Floats  # (M, 6)

    def schur(self) -> tuple[Floats, Floats]:
        """The information of the shared parameters alone (P, P), boards unknown; and bb^-1 bs (M, 6, P).

        Raises `numpy.linalg.LinAlgError` where a board's own matrix is singular.
        """
        lift = np.asarray(np.linalg.solve(self.bb, np.swapaxes(self.sb, 1, 2)), np.float64)
        return self.ss - np.tensordot(self.sb, lift, ((0, 2), (0, 1))), lift

    def step(self, damping: float) -> tuple[Floats, Floats, float]:
        """Levenberg-Marquardt's step (P,), (M, 6), and by how much the sum of squares should fall.

        Raises `numpy.linalg.LinAlgError` where it cannot be computed.
        """
        ss, bb = self.ss.copy(), self.bb.copy()
        diagonal = np.diag(ss)
        ss[np.diag_indices(len(ss))] += np.where(diagonal > 0, damping * diagonal, 1.0)
        bb[:, np.arange(6), np.arange(6)] *= 1 + damping
        S, lift = Normal(ss, self.sb, bb, self.gs, self.gb).schur()
        own = np.linalg.solve(bb, self.gb[..., None])[..., 0]
        scale = 1 / np.sqrt(np.maximum(np.diag(ss), 1e-300))  # a metre is no pixel
        right = -self.gs + np.tensordot(self.sb, own, ((0, 2), (0, 1)))
        shared = scale * np.linalg.solve(S * np.outer(scale, scale), scale * right)
        boards = -own - lift @ shared
        if not (np.isfinite(shared).all() and np.isfinite(boards).all()):
            raise np.linalg.LinAlgError("the step is not finite")
        fall = -float(self.gs @ shared + (self.gb * boards).sum())
        return shared, boards, fall


def part_of(block: Block, linear: Linear, weight: Floats, layout: Layout) -> Part:
    """The normal equations of a block, by view. `weight` (N,) is 1 / variance, 0 for what does not count."""
    columns = layout.columns(block.sensor)
    keep = layout.free[columns]
    at = layout.position[columns[keep]]
    root = np.sqrt(weight)[:, None]
    counts = root > 0  # what does not count may not be finite
    J = np.concatenate([linear.by_shared[..., keep], linear.by_board, linear.r[..., None]], -1)
    J = np.where(counts[..., None], J * root[..., None], 0)
    rows = _stacked(J, block.parts)
    H = np.swapaxes(rows, 1, 2) @ rows  # the residuals are its last column
    return Part(at, block.moments, H[:, :-1, :-1], H[:, :-1, -1])


def _stacked(J: Floats, parts: Sequence[slice]) -> Floats:
    """Rows (N, K, Q) by view, (V, most rows of a view, Q), zeros below: one product for all of them."""
    stacked = np.zeros((len(parts), max(p.stop - p.start for p in parts), *J.shape[1:]))
    for i, part in enumerate(parts):
        stacked[i, : part.stop - part.start] = J[part]
    return stacked.reshape(len(parts), -1, J.shape[-1])


def assemble(parts: Sequence[Part], layout: Layout, state: State) -> Normal:
    """All blocks' normal equations, and the prior's."""
    P, M = len(layout.free_names), len(layout.moments)
    N = Normal(np.zeros((P, P)), np.zeros((M, P, 6)), np.zeros((M, 6, 6)), np.zeros(P), np.zeros((M, 6)))
    for part in parts:
        n = len(part.at)
        N.ss[np.ix_(part.at, part.at)] += part.H[:, :n, :n].sum(0)
        N.gs[part.at] += part.g[:, :n].sum(0)
        np.add.at(N.sb, (part.moments[:, None], part.at), part.H[:, :n, n:])
        np.add.at(N.bb, part.moments, part.H[:, n:, n:])
        np.add.at(N.gb, part.moments, part.g[:, n:])
    N.ss[np.diag_indices(P)] += layout.prior
    N.gs[:] += layout.prior * layout.distortion_step(state)
    return N


def inverse(S: Floats) -> Floats:
    """The inverse of a symmetric information matrix; what has no information gets a huge variance."""
    scale = 1 / np.sqrt(np.maximum(np.diag(S), 1e-200))
    values, vectors = np.linalg.eigh((S + S.T) / 2 * np.outer(scale, scale))
    floor = 1e-15 * max(float(values.max(initial=0.0)), 1e-300)
    return np.outer(scale, scale) * ((vectors / np.maximum(values, floor)) @ vectors.T)


def explained(part: Part, normal: Normal, covariance: Floats, lift: Floats) -> float:
    """Of how many parameters' worth a block is: trace of (its information x the covariance of all unknowns).

    Its residuals, n numbers, have n minus this many degrees of freedom (Förstner 1979).
    """
    n = len(part.at)
    up = lift[part.moments]
    mixed = -up @ covariance  # (V, 6, P): covariance of each view's board with the shared parameters
    own = np.linalg.inv(normal.bb)[part.moments] - mixed @ np.swapaxes(up, 1, 2)
    total = (part.H[:, :n, :n].sum(0) * covariance[np.ix_(part.at, part.at)]).sum()
    total += 2 * (part.H[:, n:, :n] * mixed[:, :, part.at]).sum() + (part.H[:, n:, n:] * own).sum()
    return float(total)
