"""What a detector tried, kept for a picture: nothing is kept unless somebody asked."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(slots=True)
class Trace:
    """Steps of a search: a title, a picture (H x W uint8 or H x W x 3 BGR) and points (N x 2 px) on it."""

    wanted: bool = False
    steps: list[tuple[str, NDArray[np.uint8], NDArray[np.float64] | None]] = field(default_factory=list)

    def add(self, title: str, picture: NDArray[Any], points: NDArray[Any] | None = None) -> None:
        """Keep a step; a no-op where no picture is wanted. Floats are stretched to 0..255."""
        if not self.wanted:
            return
        shown = np.asarray(picture)
        if shown.dtype != np.uint8:
            low, high = np.percentile(shown, (0.5, 99.5))
            shown = np.clip((shown - low) / max(high - low, 1e-9) * 255, 0, 255)
        at = None if points is None else np.array(points, np.float64).reshape(-1, 2)
        self.steps.append((title, np.array(shown, np.uint8), at))


SILENT = Trace()
