"""What messages mean, whatever wire they came over: plain values, arrays still as the bytes sent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

Role = Literal["rgb", "fir", "lidar", "info", "depth", "transforms"]
Bytes = bytes | memoryview


@dataclass(frozen=True, slots=True)
class Header:
    """`stamp_ns` is when it was measured, by its sender; None where there is no stamp, or one of zero."""

    stamp_ns: int | None = None
    frame_id: str = ""


@dataclass(frozen=True, slots=True)
class RawImage:
    """Pixels as they were sent. `encoding` is ROS's word (``mono16``, ``bayer_rggb8``, ``16UC1``)."""

    header: Header
    width: int
    height: int
    encoding: str
    big_endian: bool
    step: int  # bytes a row, padding included
    data: Bytes


@dataclass(frozen=True, slots=True)
class CompressedImage:
    """A picture in a file's form. `format` is the sender's word (``jpeg``, ``16UC1; compressedDepth``)."""

    header: Header
    format: str
    data: Bytes


@dataclass(frozen=True, slots=True)
class PointField:
    name: str
    offset: int  # bytes from the beginning of a point
    dtype: np.dtype  # in the byte order of the data
    count: int = 1


@dataclass(frozen=True, slots=True)
class Points:
    """`height` rows of `width` points, `point_step` bytes each, rows `row_step` bytes apart.

    The bytes may end with the last field of the last point. `T_frame_points` takes the points to the header's
    frame, where they are not in it already (foxglove's `pose`).
    """

    header: Header
    width: int
    height: int
    fields: tuple[PointField, ...]
    point_step: int
    row_step: int
    data: Bytes
    T_frame_points: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """ROS's calibration of a camera. `model` is its word (``plumb_bob``); D, K 3x3, R 3x3, P 3x4."""

    header: Header
    width: int
    height: int
    model: str
    D: tuple[float, ...]
    K: NDArray[np.float64]
    R: NDArray[np.float64]
    P: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Transform:
    """T_parent_child: takes points of frame `child` to frame `parent`; metres."""

    stamp_ns: int | None
    parent: str
    child: str
    T_parent_child: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Transforms:
    """`static` is not told by the message: the topic's name says it."""

    transforms: tuple[Transform, ...]

    @property
    def header(self) -> Header:
        first = self.transforms[0] if self.transforms else None
        return Header() if first is None else Header(first.stamp_ns, first.parent)


Message = RawImage | CompressedImage | Points | CameraInfo | Transforms


class MessageReader(Protocol):
    """Reads the messages of one topic; made by `fusion.messages.reader_of`. Safe from several threads.

    `kind` is what its messages are read as, None for types that we do not use: of those only the header
    can be had. All methods raise `FrameError` for bytes that are not such a message.
    """

    kind: type[Message] | None

    def header(self, data: Bytes) -> Header:
        """The header alone, without touching pixels or points."""
        ...

    def message(self, data: Bytes) -> Message:
        """All of it; arrays are views of `data` wherever the wire allows it."""
        ...
