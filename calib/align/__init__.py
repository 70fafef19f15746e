"""Registration without a board: where thermal lies on RGB, from the scene alone.

Orientation channels (CFOG) searched over scale, turn and shift, then matched block by block; the map is the
smallest that the matched spots justify. One plane, or a scene that is far away, is what such a map can hold.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calib.align import judge
from calib.align.channels import Doubles, inverse
from calib.align.judge import FrameResult
from calib.align.models import Matches, Model, corner_gap, joined, justified, robust_fit
from calib.align.pool import (
    FLIPS,
    MATCHERS,
    Method,
    Progress,
    Size,
    flipped,
    method,
    prepared,
    search,
    searched,
    to_kept,
)
from calib.align.refine import Frame, scores
from fusion.errors import InputError
from fusion.registration import Registration

__all__ = ["MATCHERS", "Alignment", "FrameResult", "align"]
_GLANCE = 96  # pixels of the longer side: enough to tell a mirrored stream
_TOLERANCE = 1 / 350  # of the RGB image's longer side


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """How thermal lies on RGB, whether that may be used, and why not.

    `H_rgb_fir` (3, 3) float64 takes full thermal pixels to full RGB pixels. `score` is the median over
    the frames of the masked feature correlation, `gap_px` the mean distance at the thermal corners, in
    thermal pixels, between a corner and itself after thermal to RGB and, found on its own, back;
    `gap_share` the same as a share of the width. Neither predicts the error. `flip` says how the
    thermal stream is mirrored, where only that explains the images (then never accepted).
    """

    H_rgb_fir: Doubles
    model: Model
    score: float
    gap_px: float
    gap_share: float
    frames: tuple[FrameResult, ...]
    accepted: bool
    reason: str
    flip: str
    seconds: float
    rgb_size_wh: Size
    fir_size_wh: Size
    matcher: str

    @property
    def notes(self) -> tuple[str, ...]:
        """What to tell the user: how it was found, and every frame that does not fit."""
        found = (
            f"found without a board by {self.matcher} on {len(self.frames)} frame(s): {self.model},"
            f" correlation {self.score:.2f}, forward-backward gap {self.gap_share:.2%} of the width;"
            " these say that it holds, not how exactly"
        )
        odd = (f"{f.name} does not fit the others: {f.outlier}" for f in self.frames if f.outlier)
        return (found, *odd)

    def registration(self) -> Registration:
        """What `write_homography` writes. Raises `InputError` where the registration was refused."""
        if not self.accepted:
            raise InputError(
                f"thermal and RGB could not be aligned: {self.reason}",
                hint="look at the picture; give more frames with structure that both cameras see, or points",
            )
        return Registration(
            self.H_rgb_fir, "homography", self.fir_size_wh, self.rgb_size_wh, notes=self.notes
        )


def align(
    pairs: Iterable[tuple[NDArray, NDArray]],
    *,
    model: Model | Literal["auto"] = "auto",
    matcher: str = "channels",
    progress: Progress | None = None,
) -> Alignment:
    """Register thermal on RGB from `pairs` of one rig, all used together.

    A pair is (rgb, fir): H x W x 3 BGR uint8 or H x W grey, and H x W uint8 or uint16, of any sizes but
    the same ones in all pairs; only small copies are kept. Found are scales of 0.4 to 2.5 (relative to
    the images stretched to the same longer side), turns of 16 degrees either way, either contrast.
    `model` "auto" takes the smallest map that held-out matches justify. `progress` is told each stage.
    What cannot be trusted comes back with `accepted` False and a `reason`. Raises `InputError` for
    frames that cannot be used at all, `UsageError` for an unknown matcher.
    """
    began = time.perf_counter()
    say = progress or (lambda _: None)
    way = method(matcher)
    frames, sizes = prepared(pairs, progress)
    say("searching")
    found = _registered(frames, way, model)
    if not found.accepted:
        say("refused; looking whether the thermal stream is mirrored")
        found = _mirrored(frames, way, model, found)
    rgb_size, fir_size = sizes[0]
    H = inverse(to_kept(rgb_size, frames[0].rgb)) @ found.H_rgb_fir @ to_kept(fir_size, frames[0].fir)
    larger = rgb_size[0] / frames[0].rgb.shape[1]
    return replace(
        found,
        H_rgb_fir=H / H[2, 2],
        gap_px=found.gap_share * fir_size[0],
        frames=tuple(replace(frame, gap_px=frame.gap_px * larger) for frame in found.frames),
        rgb_size_wh=rgb_size,
        fir_size_wh=fir_size,
        matcher=matcher,
        seconds=time.perf_counter() - began,
    )


def _registered(frames: Sequence[Frame], way: Method, model: Model | Literal["auto"]) -> Alignment:
    """The registration in the pixels that were kept of the frames."""
    top: Model = "affine" if model == "auto" else model
    forward, backward = way(frames, top)
    fir_shape, rgb_shape = frames[0].fir.shape, frames[0].rgb.shape
    try:
        H, kind = _map(forward, model, rgb_shape)
        back, _ = _map(backward, kind, fir_shape)
    except ValueError as error:
        return _nothing(frames, str(error))
    share = corner_gap(back @ H, np.eye(3), fir_shape) / fir_shape[1]
    values = scores(frames, H)
    names = [frame.name for frame in frames]
    results = judge.judged_frames(
        names, values, forward, H, fir_shape, _TOLERANCE * max(rgb_shape), rgb_shape[1]
    )
    value = float(np.median(values))
    reason = judge.verdict(value, share)
    zero = (0, 0)
    return Alignment(H, kind, value, 0.0, share, tuple(results), not reason, reason, "", 0.0, zero, zero, "")


def _map(
    matches: Sequence[Matches], model: Model | Literal["auto"], shape: tuple[int, int]
) -> tuple[Doubles, Model]:
    tolerance = _TOLERANCE * max(shape)
    pooled = joined(matches)
    kind = justified(pooled, tolerance) if model == "auto" else model
    return robust_fit(pooled, kind, tolerance), kind


def _nothing(frames: Sequence[Frame], why: str) -> Alignment:
    stretch = to_kept((frames[0].fir.shape[1], frames[0].fir.shape[0]), frames[0].rgb)
    none = tuple(FrameResult(frame.name, 0.0, float("inf"), "") for frame in frames)
    zero = (0, 0)
    return Alignment(stretch, "similarity", 0.0, 0.0, float("inf"), none, False, why, "", 0.0, zero, zero, "")


def _mirrored(
    frames: Sequence[Frame], way: Method, model: Model | Literal["auto"], refused: Alignment
) -> Alignment:
    """`refused`, or how the thermal stream must be flipped, where that registers."""
    some = searched(frames)
    best = {name: search([flipped(f, axes) for f in some], _GLANCE)[0].score for name, axes in FLIPS.items()}
    name = max(best, key=lambda flip: best[flip])
    if best[name] <= search(some, _GLANCE)[0].score:
        return refused
    turned = [flipped(frame, FLIPS[name]) for frame in frames]
    found = _registered(turned, way, model)
    if not found.accepted:
        return refused
    h, w = frames[0].fir.shape
    undo = np.eye(3)
    for axis, extent in ((0, h), (1, w)):
        if axis in FLIPS[name]:
            undo[1 - axis, 1 - axis], undo[1 - axis, 2] = -1, extent - 1
    words = f"the thermal stream is {name}: flip it back, then it aligns (correlation {found.score:.2f})"
    return replace(found, H_rgb_fir=found.H_rgb_fir @ undo, accepted=False, reason=words, flip=name)
