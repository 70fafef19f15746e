"""Frames of one rig made ready, and matched together, both ways."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.align.channels import Doubles, Grey, grey, inverse, resized
from calib.align.models import Matches, Model
from calib.align.refine import Frame, chosen, matched
from calib.align.search import WIDTH, Candidate, candidates
from fusion.errors import FusionError, InputError, UsageError
from fusion.tables import lookup

Size = tuple[int, int]
Progress = Callable[[str], None]
# A learned matcher, as the entry points "fusion.matchers" offer it: (rgb, fir), two grey images, H x W uint8,
# to (rgb_xy, fir_xy, confidence): (N, 2), (N, 2) pixels of the same spots and (N,) in [0, 1].
Matcher = Callable[[NDArray[np.uint8], NDArray[np.uint8]], tuple[NDArray, NDArray, NDArray]]
# What the table holds: frames and the largest map to matches of every frame, RGB from thermal and the
# other way about, each found on its own.
BothWays = tuple[list[Matches], list[Matches]]
Method = Callable[[Sequence[Frame], Model], BothWays]

_LARGEST = 640  # pixels of the longer side that are kept
_SMALLEST = 32
_SEARCHED = 5  # frames that take part in the search; all take part in the rest
FLIPS = {"mirrored left-right": (1,), "mirrored top-bottom": (0,), "upside down": (0, 1)}


def prepared(
    pairs: Iterable[tuple[NDArray, NDArray]], progress: Progress | None
) -> tuple[list[Frame], list[tuple[Size, Size]]]:
    """The frames, small enough to keep many, and the full sizes ((w, h) of RGB, of thermal) of every one.

    Raises `InputError` for no frames, for sizes that differ between frames, and for images that show
    nothing or are smaller than 32 px.
    """
    frames: list[Frame] = []
    sizes: list[tuple[Size, Size]] = []
    for k, (rgb, fir) in enumerate(pairs):
        name = f"frame {k}"
        sizes.append(((rgb.shape[1], rgb.shape[0]), (fir.shape[1], fir.shape[0])))
        if sizes[k] != sizes[0]:
            raise InputError(
                f"RGB {_wh(sizes[k][0])} and thermal {_wh(sizes[k][1])}, but frame 0 has"
                f" {_wh(sizes[0][0])} and {_wh(sizes[0][1])}",
                where=name,
                hint="give frames of one rig, all of one size",
            )
        frames.append(Frame(_kept(rgb, f"{name}, RGB"), _kept(fir, f"{name}, thermal"), name))
        if progress:
            progress(f"{name} read")
    if not frames:
        raise InputError("no pair of images to align", hint="give at least one RGB image and its thermal one")
    return frames, sizes


def _wh(size: Size) -> str:
    return f"{size[0]}x{size[1]}"


def _kept(image: NDArray, where: str) -> Grey:
    if min(image.shape[:2]) < _SMALLEST:
        raise InputError(f"{image.shape[1]}x{image.shape[0]} pixels are too few to align", where=where)
    try:
        whole = grey(image)
    except FusionError as error:
        raise InputError(error.what, where=where, hint="give frames that show the scene") from None
    return resized(whole, min(_LARGEST / max(image.shape[:2]), 1))[0]


def to_kept(size: Size, kept: Grey) -> Doubles:
    """The matrix from an image's full pixels to those kept of it."""
    sx, sy = kept.shape[1] / size[0], kept.shape[0] / size[1]
    return np.array([[sx, 0, 0.5 * sx - 0.5], [0, sy, 0.5 * sy - 0.5], [0, 0, 1]])


def by_channels(frames: Sequence[Frame], top: Model) -> BothWays:
    """Matches by orientation channels: search, candidates, blocks. The search is one for both ways."""
    some = searched(frames)
    found = [c.H_rgb_fir for c in search(some)]
    back = [frame.swapped for frame in frames]
    ways = (
        (frames, some, found),
        (back, [frame.swapped for frame in some], [inverse(H) for H in found]),
    )
    first, second = (matched(all_, chosen(few, starts), top) for all_, few, starts in ways)
    return first, second


def searched(frames: Sequence[Frame]) -> list[Frame]:
    """Some frames, spread evenly."""
    picks = np.unique(np.linspace(0, len(frames) - 1, _SEARCHED).round().astype(int))
    return [frames[k] for k in picks]


def search(frames: Sequence[Frame], width: int = WIDTH) -> list[Candidate]:
    return candidates([frame.rgb for frame in frames], [frame.fir for frame in frames], width=width)


def flipped(frame: Frame, axes: tuple[int, ...]) -> Frame:
    fir = frame.fir
    turned = Grey(np.flip(fir.pixels, axes).copy(), np.flip(fir.seen, axes).copy())
    return Frame(frame.rgb, turned, frame.name)


MATCHERS: dict[str, Method] = {"channels": by_channels}


def method(name: str) -> Method:
    """The way to match called `name`: of `MATCHERS`, or an installed `Matcher` of `fusion.matchers`.

    Raises `UsageError` that lists the names where there is none.
    """
    if name in MATCHERS:
        return MATCHERS[name]
    foreign: Any = lookup(MATCHERS, "fusion.matchers", name, "matcher")
    return lambda frames, _: _both_ways(name, foreign, frames)


def _both_ways(name: str, matcher: Matcher, frames: Sequence[Frame]) -> BothWays:
    first = [_asked(name, matcher, frame) for frame in frames]
    return first, [_asked(name, matcher, frame.swapped) for frame in frames]


def _asked(name: str, matcher: Matcher, frame: Frame) -> Matches:
    """What a foreign matcher says of one pair, checked."""
    a, b = (np.floor(255 * image.pixels + 0.5).astype(np.uint8) for image in (frame.rgb, frame.fir))
    try:
        rgb_xy, fir_xy, confidence = (np.asarray(x, np.float64) for x in matcher(a, b))
        found = Matches(rgb_xy, fir_xy, confidence)
    except (ValueError, TypeError) as error:
        raise UsageError(f"matcher {name!r} gave no matched points: {error}", where=frame.name) from error
    if not all(np.isfinite(x).all() for x in (rgb_xy, fir_xy, confidence)) or (confidence < 0).any():
        raise UsageError(f"matcher {name!r} gave NaN, infinity or a negative confidence", where=frame.name)
    return found
