"""What one frame became, and what an output does with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fusion.chunks import Chunk
from fusion.frames import FrameSet, FusedFrame
from fusion.geometry import Camera
from fusion.lidar.lane import DepthFrame
from fusion.rig import Rig
from fusion.storage import Storage


@dataclass(frozen=True, slots=True)
class Made:
    """One frame with all that was made of it; every part is on the RGB grid but the cloud of `frames`.

    `stem` names its files and is unique in the run. `fir_counts` is H x W uint16, thermal as it was
    measured, 0 where it does not reach. `depth` is there where a cloud was. `encoded` holds the pictures as
    they are stored, made once for all outputs: ``fused`` (PNG or JPEG), ``mask``, ``depth`` (uint16 PNG,
    metres x 256), ``support``, ``fir`` (uint16 PNG).
    """

    stem: str
    frames: FrameSet
    fused: FusedFrame
    fir_counts: NDArray[np.uint16] | None = None
    depth: DepthFrame | None = None
    encoded: Mapping[str, bytes] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Setup:
    """What outputs know of the run. `rig` is None where nobody calibrated; `camera` is the one that depth
    was made for, `rate_hz` the frames a second of the leading stream.
    """

    rig: Rig | None
    camera: Camera | None
    rate_hz: float
    image_format: str = "png"
    quality: int = 90


class ChunkOutput(Protocol):
    """One chunk's part of an output. Frames are added in the order of time, from one thread."""

    def add(self, made: Made) -> None: ...

    def close(self) -> Mapping[str, int]:
        """Finish the part and store it: name -> bytes of every file it wrote."""
        ...

    def discard(self) -> None:
        """The chunk failed: leave nothing open; what was stored already may stay, it is written again."""
        ...


class Output(Protocol):
    """A form of output. Picklable: chunks are done elsewhere."""

    def open(self, chunk: Chunk, out: Storage) -> ChunkOutput: ...

    def finish(self, chunks: Sequence[Chunk], out: Storage) -> Sequence[str]:
        """After all chunks: join what must be one file, by rename; idempotent. The names for the closing
        words."""
        ...


# Name -> "module:attribute", called with a `Setup`; text, so that naming one imports none.
OUTPUTS: dict[str, str] = {
    "folder": "fusion.sinks.frames:FrameFiles",
    "mcap": "fusion.sinks.mcap:McapOutput",
    "video": "fusion.sinks.video:VideoOutput",
}
