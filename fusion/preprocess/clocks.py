"""Offset and drift between the clocks of RGB and thermal, from footage itself."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from fusion.frames import Image
from fusion.timing.clock import ClockEstimate, estimate_clock
from fusion.timing.motion import Motion, MotionMeter

LONGEST_S = 180.0  # of footage that is looked at: more costs time, and drift is known by then


class Pictures(Protocol):
    """Footage that can show one camera alone, in the order it was recorded, with its own stamps."""

    def pictures(self, role: str, longest_s: float) -> Iterator[Image]: ...


def clock_of(footage: Pictures, longest_s: float = LONGEST_S) -> ClockEstimate:
    """See `fusion.timing.clock.estimate_clock`. Raises `InputError` where the pictures cannot tell."""
    return estimate_clock(_motion(footage, "rgb", longest_s), _motion(footage, "fir", longest_s))


def _motion(footage: Pictures, role: str, longest_s: float) -> Motion:
    meter = MotionMeter()
    for image in footage.pictures(role, longest_s):
        if image.stamp_ns is not None:
            meter.add(image.stamp_ns, image.pixels)
    return meter.motion()


def in_words(found: ClockEstimate) -> str:
    """One line: what was found, and how sure that is."""
    return (
        f"clock: thermal {found.offset_ns / 1e6:+.1f} ms (sigma {found.offset_sigma_ns / 1e6:.1f}),"
        f" {found.drift * 1e6:+.0f} ppm (sigma {found.drift_sigma * 1e6:.0f}),"
        f" correlation {found.score:.2f}, from {found.overlap_s:.0f} s"
    )
