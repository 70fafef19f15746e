"""The index of a campaign: `frames.csv`, one row a frame."""

from __future__ import annotations

from dataclasses import dataclass

from fusion.errors import FrameError
from fusion.sinks.base import Made


@dataclass(frozen=True, slots=True)
class FrameRow:
    """One frame. `status` is ``made`` or ``skipped`` (then `reason` says why and the rest is empty).

    Stamps are integer nanoseconds of the reference's clock; `fir_dt_ns` and `lidar_dt_ns` are theirs minus
    RGB's. Windows are thermal counts, clipped and coverage shares [0, 1]. `points` to `visible` count LiDAR
    points left after each step, `covered` and `supported` pixels of the depth map. `reason` may name what
    went wrong with the depth of a frame that was made without it.
    """

    stem: str
    status: str
    rgb_stamp_ns: str = ""
    fir_stamp_ns: str = ""
    lidar_stamp_ns: str = ""
    fir_dt_ns: str = ""
    lidar_dt_ns: str = ""
    window_lo: str = ""
    window_hi: str = ""
    clipped_below: str = ""
    clipped_above: str = ""
    coverage: str = ""
    points: str = ""
    in_frame: str = ""
    visible: str = ""
    covered: str = ""
    supported: str = ""
    flags: str = ""
    reason: str = ""

    @property
    def done(self) -> bool:
        return self.status == "made"

    @classmethod
    def made(cls, made: Made, trouble: str = "") -> FrameRow:
        fused, cloud = made.fused, made.frames.cloud
        rgb_ns, fir_ns = fused.rgb_stamp_ns, fused.fir_stamp_ns
        lidar_ns = None if cloud is None else cloud.stamp_ns
        counts = {} if made.depth is None else made.depth.counts
        return cls(
            made.stem,
            "made",
            _text(rgb_ns),
            _text(fir_ns),
            _text(lidar_ns),
            _difference(fir_ns, rgb_ns),
            _difference(lidar_ns, rgb_ns),
            f"{fused.window.lo:.9g}",
            f"{fused.window.hi:.9g}",
            f"{fused.clipped_below:.6f}",
            f"{fused.clipped_above:.6f}",
            f"{fused.coverage:.6f}",
            _text(counts.get("read")),
            _text(counts.get("in_frame")),
            _text(counts.get("visible")),
            _text(counts.get("covered")),
            _text(counts.get("supported")),
            ";".join(fused.flags),
            trouble,
        )

    @classmethod
    def skipped(cls, stem: str, error: FrameError) -> FrameRow:
        return cls(stem, "skipped", reason=f"{error.what} ({error.hint})" if error.hint else error.what)


def _text(value: int | None) -> str:
    return "" if value is None else str(value)


def _difference(a: int | None, b: int | None) -> str:
    return "" if a is None or b is None else str(a - b)
