"""Levenberg-Marquardt with weights: first a Cauchy loss from afar, then plain least squares on what is left.

On the normal equations with the boards' poses eliminated, because the problem is an arrow: some 30 shared
parameters and a 6 x 6 block a board. `scipy.optimize.least_squares` comes to the same optimum (tested), but
knows nothing of the arrow, of weights that change on the way, or of noise to be estimated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from calib.solve.blocks import Block, Linear
from calib.solve.normal import Normal, Part, assemble, explained, inverse, part_of
from calib.solve.robust import FLOOR, Mask, cauchy, inliers, known, scale
from calib.solve.state import Layout, State
from fusion.errors import InputError
from fusion.geometry import Floats

Progress = Callable[[int, int], None]
T = TypeVar("T")
Weigh = Callable[[list[Floats]], list[Floats]]
_MAX_STEPS, _MAX_FAR_STEPS, _MAX_ROUNDS = 60, 30, 12
_CONVERGED, _NEAR = 1e-6, 0.05  # of a squared standard deviation that another step would gain
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-15, 1e12
_SAME_NOISE = 1e-3  # relative change


@dataclass(frozen=True, slots=True)
class Fit:
    """An optimum: residuals `r`, which points counted (`used`) and the noise `sigma` of each block; the
    `information` (inverse covariance) of the free shared parameters; whether it came to rest (`settled`)."""

    state: State
    r: list[Floats]
    used: list[Mask]
    sigma: list[float]
    information: Floats
    settled: bool


@dataclass(frozen=True, slots=True)
class _Place:
    """A state and the problem linearised there, block by block."""

    state: State
    linear: list[Linear]

    @property
    def r(self) -> list[Floats]:
        return [x.r for x in self.linear]


@dataclass(slots=True)
class Descent:
    """The problem, and how many steps have been taken so far."""

    blocks: Sequence[Block]
    layout: Layout
    progress: Progress | None = None
    steps: int = 0

    def fit(self, robust: bool) -> Fit:
        """From the layout's start to the optimum. Raises `InputError` where a board's pose is left open."""
        place = self._at(self.layout.first_state())
        if robust:
            place, _ = self._descend(place, lambda r: self._each(cauchy, r), _NEAR, _MAX_FAR_STEPS, _DAMPING)
        return self._refine(place, robust)

    def _refine(self, place: _Place, robust: bool) -> Fit:
        """Least squares on the inliers, until they and the noise stay the same."""
        sigma, used, damping = self._each(scale, place.r), self._used(place.r, robust), _DAMPING
        rounds = 0
        while True:
            weight = [u / s**2 for u, s in zip(used, sigma, strict=True)]
            place, settled = self._descend(place, lambda _, w=weight: w, _CONVERGED, _MAX_STEPS, damping)
            information, now = self._noise(place, weight, sigma)
            then, used = used, self._used(place.r, robust)
            same = all(np.array_equal(a, b) for a, b in zip(then, used, strict=True))
            rounds += 1
            calm = same and np.allclose(now, sigma, rtol=_SAME_NOISE, atol=0)
            if calm or not settled or rounds == _MAX_ROUNDS:
                return Fit(place.state, place.r, then, sigma, information, settled)
            sigma, damping = now, _LEAST_DAMPING

    def _at(self, state: State) -> _Place:
        return _Place(state, [block.linearise(state) for block in self.blocks])

    def _each(self, f: Callable[[Block, Floats], T], r: list[Floats]) -> list[T]:
        return [f(block, x) for block, x in zip(self.blocks, r, strict=True)]

    def _used(self, r: list[Floats], robust: bool) -> list[Mask]:
        return self._each(inliers, r) if robust else [known(x) for x in r]

    def _noise(self, place: _Place, weight: list[Floats], sigma: list[float]) -> tuple[Floats, list[float]]:
        """The information by these weights, and each block's noise: squares over degrees of freedom."""
        parts = self._parts(place, weight)
        normal = assemble(parts, self.layout, place.state)
        S, lift = _schur(normal)
        covariance = inverse(S)
        noise = []
        for block, part, x, w, s in zip(self.blocks, parts, place.r, weight, sigma, strict=True):
            n = x.shape[1] * int((w > 0).sum())
            freedom = n - explained(part, normal, covariance, lift)
            squares = float((x[w > 0] ** 2).sum())
            enough = freedom > max(1.0, 0.01 * n)
            noise.append(max(float(np.sqrt(squares / freedom)), FLOOR[block.kind]) if enough else s)
        return S, noise

    def _parts(self, place: _Place, weight: list[Floats]) -> list[Part]:
        items = zip(self.blocks, place.linear, weight, strict=True)
        return [part_of(block, linear, w, self.layout) for block, linear, w in items]

    def _descend(
        self, place: _Place, weigh: Weigh, gain: float, steps: int, damping: float
    ) -> tuple[_Place, bool]:
        """To where a step gains less than `gain`, and whether at last it was next to nothing; in the flat
        valleys of the rational model the last of it takes long. Weights are new each time."""
        fall = np.inf
        for _ in range(steps):
            weight = weigh(place.r)
            normal = assemble(self._parts(place, weight), self.layout, place.state)
            trial, fall, damping = self._step(place, normal, weight, damping, gain)
            place = trial or place
            self._report()
            if trial is None or fall < gain:
                break
        return place, fall < _NEAR

    def _step(
        self, place: _Place, normal: Normal, weight: list[Floats], damping: float, gain: float
    ) -> tuple[_Place | None, float, float]:
        """The next place, None where there is no better one; what was to be gained; the next damping."""
        cost, fall = self._cost(place, weight), np.inf
        while damping < _MOST_DAMPING:
            with suppress(np.linalg.LinAlgError):
                shared, boards, fall = normal.step(damping)
                trial = self._at(self.layout.moved(place.state, shared, boards))
                if self._cost(trial, weight) <= cost:
                    return trial, fall, max(damping / 30, _LEAST_DAMPING)
                if fall < gain:  # what is left is rounding
                    return None, fall, damping
            damping *= 10
        return None, fall, damping

    def _cost(self, place: _Place, weight: list[Floats]) -> float:
        """The weighted sum of squares, inf where it cannot be computed."""
        if any(values[0] <= 0 or values[1] <= 0 for values in place.state.camera.values()):
            return np.inf
        total = sum(float(w[w > 0] @ (x[w > 0] ** 2).sum(1)) for x, w in zip(place.r, weight, strict=True))
        total += float(self.layout.prior @ self.layout.distortion_step(place.state) ** 2)
        return total if np.isfinite(total) else np.inf

    def _report(self) -> None:
        self.steps += 1
        if self.progress is not None:
            self.progress(self.steps, max(self.steps, _MAX_STEPS))


def _schur(normal: Normal) -> tuple[Floats, Floats]:
    try:
        return normal.schur()
    except np.linalg.LinAlgError:
        hint = "its views have too few points, or all on one line"
        raise InputError("the pose of a board cannot be determined", hint=hint) from None
