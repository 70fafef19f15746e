"""From candidates to matched spots: blocks over a pyramid, all frames of a rig together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from calib.align.blocks import Field, Grid, agree, correlation, field_of, grid_for, on_grid, peaks
from calib.align.channels import Doubles, Grey, inverse
from calib.align.models import Matches, Model, corners_of, project

# Longer side of the working grid, largest displacement looked for, the map, and how far from it, pass after
# pass, a block's peak still counts; in the grid's pixels.
Level = tuple[int, int, Model, tuple[float, ...]]
FIRST: Level = (128, 8, "similarity", (10.0, 6.0, 4.0))
LEVELS: tuple[Level, ...] = ((256, 8, "similarity", (8.0, 5.0)), (256, 8, "affine", (9.0, 6.0, 4.0, 3.0)))
LAST: Level = (320, 6, "affine", (5.0, 4.0, 3.0))
JUDGED = 256  # longer side of the grid on which scores are measured


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One pair made ready, and its name for messages."""

    rgb: Grey
    fir: Grey
    name: str

    @property
    def swapped(self) -> Frame:
        return Frame(self.fir, self.rgb, self.name)


def scores(frames: Sequence[Frame], H: Doubles, width: int = JUDGED) -> list[float]:
    """The masked feature correlation of every frame."""
    grid = grid_for(H, frames[0].rgb.shape, frames[0].fir.shape, width)
    return [correlation(*on_grid(frame.rgb, frame.fir, H, grid)) for frame in frames]


def chosen(frames: Sequence[Frame], starts: Sequence[Doubles]) -> Doubles:
    """Of the candidates the one that, after a first step, is least likely by chance, all frames together."""
    better = [_step(frames, H, FIRST) for H in starts]
    return better[int(np.argmax([_worth(frames, H) for H in better]))]


def _worth(frames: Sequence[Frame], H: Doubles) -> float:
    """The correlation times the root of the share of the smaller image that both see: a narrow strip that
    agrees by chance is worth little."""
    grid = grid_for(H, frames[0].rgb.shape, frames[0].fir.shape, FIRST[0])
    planes = [on_grid(frame.rgb, frame.fir, H, grid) for frame in frames]
    both = np.mean([np.count_nonzero(q.any(axis=0)) for _, q in planes])
    image = float(np.prod(frames[0].rgb.shape))
    thermal = cv2.contourArea(project(H, corners_of(frames[0].fir.shape)).astype(np.float32))
    smaller = min(image, thermal) * abs(np.linalg.det(grid.matrix))
    return float(np.mean([correlation(p, q) for p, q in planes]) * np.sqrt(both / max(smaller, 1.0)))


def matched(frames: Sequence[Frame], start: Doubles, top: Model = "affine") -> list[Matches]:
    """The spots that correspond, frame by frame, found about the map that all frames agree on.

    `top` is the most that the map may be: a similarity stays one on every level.
    """
    H = start
    for width, reach, model, within in LEVELS:
        H = _step(frames, H, (width, reach, _at_most(model, top), within))
    width, reach, model, within = LAST
    grid, fields = _fields(frames, H, width, reach)
    moved = agree(fields, _at_most(model, top), within)
    return [_matches(field, moved, grid, H, within[-1]) for field in fields]


def _at_most(model: Model, top: Model) -> Model:
    return "similarity" if top == "similarity" else model


def _step(frames: Sequence[Frame], H: Doubles, level: Level) -> Doubles:
    """`H` after one level, all frames together."""
    width, reach, model, within = level
    grid, fields = _fields(frames, H, width, reach)
    better = inverse(grid.matrix) @ agree(fields, model, within) @ grid.matrix @ H
    return better / better[2, 2]


def _fields(frames: Sequence[Frame], H: Doubles, width: int, reach: int) -> tuple[Grid, list[Field]]:
    grid = grid_for(H, frames[0].rgb.shape, frames[0].fir.shape, width)
    return grid, [field_of(*on_grid(frame.rgb, frame.fir, H, grid), reach) for frame in frames]


def _matches(field: Field, moved: Doubles, grid: Grid, H: Doubles, within: float) -> Matches:
    move, weight = peaks(field, project(moved, field.at) - field.at, within)
    to_rgb = inverse(grid.matrix)
    to_fir = inverse(grid.matrix @ H)
    return Matches(project(to_rgb, field.at + move), project(to_fir, field.at), weight)
