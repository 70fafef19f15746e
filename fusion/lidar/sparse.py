"""What passes between the stages of the LiDAR lane: a list of samples, and a dense map made of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Value = Literal["depth", "range"]


@dataclass(frozen=True, slots=True)
class SparseDepth:
    """The thesis's list (r_i, c_i, d_i) (6.1): where points fall in an image, and how far they are.

    `u` and `v` (N float64) are column and row, not rounded, inside [-0.5, size - 0.5); `value_m` (N float32,
    positive) is the distance to the camera's centre (`value` "range", the thesis's d) or along its axis
    ("depth"). `index` (N int64) says which point of the cloud a sample is, `ring` (N int32, or None where
    unknown) which laser measured it; 0 is the lowest. `counts` tells, step by step, how many points were
    left: ``read``, ``finite``, ``in_front``, ``in_frame``, ``in_range``, ``visible``.
    """

    size_wh: tuple[int, int]
    u: NDArray[np.float64]
    v: NDArray[np.float64]
    value_m: NDArray[np.float32]
    value: Value
    index: NDArray[np.int64]
    ring: NDArray[np.int32] | None = None
    counts: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shapes = {a.shape for a in (self.u, self.v, self.value_m, self.index)}
        if len(shapes) != 1 or len(next(iter(shapes))) != 1:
            raise ValueError(f"expected four lists of one length, got {sorted(shapes)}")
        if self.ring is not None and self.ring.shape != self.u.shape:
            raise ValueError(f"expected {self.u.shape} rings, got {self.ring.shape}")

    def __len__(self) -> int:
        return len(self.u)

    def take(self, keep: NDArray[np.bool_] | NDArray[np.int64], **counts: int) -> SparseDepth:
        """The samples that `keep` selects, in its order; `counts` are added to those that stand."""
        return SparseDepth(
            self.size_wh,
            self.u[keep],
            self.v[keep],
            self.value_m[keep],
            self.value,
            self.index[keep],
            None if self.ring is None else self.ring[keep],
            {**self.counts, **counts},
        )


@dataclass(frozen=True, slots=True)
class DenseDepth:
    """A value for (nearly) every pixel: `value_m` H x W float32, 0 where there is none.

    `support` is H x W bool: True where samples stand behind the value, so that it is interpolated, no farther
    than the largest gap from a sample; False where there is no value, or where it is extrapolated.
    """

    value_m: NDArray[np.float32]
    support: NDArray[np.bool_]
    value: Value

    def __post_init__(self) -> None:
        if self.value_m.ndim != 2 or self.value_m.dtype != np.float32:
            raise ValueError(f"expected HxW float32, got {self.value_m.shape} {self.value_m.dtype}")
        if self.support.shape != self.value_m.shape or self.support.dtype != np.bool_:
            raise ValueError(f"expected {self.value_m.shape} bool, got {self.support.shape}")
