"""What `fusion calibrate align` and `fusion blend --align` do: thermal onto RGB from the scene alone."""

from __future__ import annotations

import sys
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from calib.align import align
from calib.align.picture import overlay_picture
from fusion.batch import opencv_on_one_thread
from fusion.cli.running import quiet_libraries, refuse_existing, warn
from fusion.codecs import encode_jpeg
from fusion.errors import FrameError, InputError, UsageError
from fusion.files import replace_file
from fusion.frames import FrameSet
from fusion.pairing import PairingRule
from fusion.registration import Registration, write_homography
from fusion.sync import open_pairs

Model = Literal["auto", "similarity", "affine", "homography"]
FRAMES = 8  # pairs that are pooled


class Frames(Protocol):
    """What can be aligned: any number of frames, read by their number."""

    def __len__(self) -> int: ...

    def read(self, index: int) -> FrameSet: ...


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """An alignment that may be used, and the picture that shows it."""

    registration: Registration
    picture_jpg: bytes


def run_align(
    rgb: str,
    fir: str,
    out: Path,
    model: Model,
    matcher: str,
    frames: int,
    pair: Any,
    tolerance_ms: float | None,
    *,
    overwrite: bool,
    quiet: bool,
) -> None:
    if frames < 1:
        raise UsageError(f"{frames} frames", where="--frames", hint="at least 1")
    refuse_existing(out, overwrite)
    picture = out.with_suffix(".jpg")
    tolerance_ns = None if tolerance_ms is None else round(tolerance_ms * 1e6)
    rule = PairingRule(by=pair or "auto", tolerance_ns=tolerance_ns)
    with quiet_libraries(), closing(open_pairs(rgb, fir, rule, fir_colour="luma")) as pairs:
        found = aligned(pairs, model, matcher, frames, quiet=quiet, refused=picture)
    replace_file(picture, found.picture_jpg)
    write_homography(out, found.registration)
    if not quiet:
        print("\n".join(found.registration.notes))
        print(f"{out} and {picture} written: look at the picture before you trust it")


def aligned(
    pairs: Frames,
    model: Model = "auto",
    matcher: str = "channels",
    frames: int = FRAMES,
    *,
    quiet: bool,
    refused: Path | None = None,
) -> Aligned:
    """Align a few pairs, evenly spread.

    Raises `InputError` where the result is not to be trusted; its picture is written to `refused`.
    """
    chosen = _spread(pairs, frames)
    images = [(frame.bgr, frame.counts) for frame in chosen]
    with opencv_on_one_thread():
        found = align(images, model=model, matcher=matcher, progress=None if quiet else _say)
    title = f"{chosen[0].stem}: {'accepted' if found.accepted else 'refused: ' + found.reason}"
    drawn = encode_jpeg(overlay_picture(*images[0], found.H_rgb_fir, title), 90)
    if found.accepted:
        return Aligned(found.registration(), drawn)
    hint = "give more or sharper frames, point pairs, or a board"
    if refused is not None:
        replace_file(refused, drawn)
        hint = f"see {refused}; {hint}"
    raise InputError(f"thermal cannot be laid onto RGB: {found.reason}", hint=hint)


def _say(step: str) -> None:
    """What it is at, on a terminal."""
    if sys.stderr.isatty():
        print(f"  {step}", file=sys.stderr, flush=True)


def _spread(pairs: Frames, count: int) -> list[FrameSet]:
    """Evenly spread pairs that can be read. Raises `InputError` where none can."""
    chosen, broken = [], []
    for index in np.unique(np.linspace(0, len(pairs) - 1, min(count, len(pairs))).astype(int)):
        try:
            chosen.append(pairs.read(int(index)))
        except FrameError as error:
            broken.append(str(error))
    if not chosen:
        raise InputError(f"none of {len(broken)} pairs can be read; the first: {broken[0]}")
    warn(broken)
    return chosen
