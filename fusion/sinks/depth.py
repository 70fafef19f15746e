"""A folder of depth maps with their index.

OUT/depth/<stem>.png     uint16, metres x 256, 0 = none (KITTI's form)
OUT/support/<stem>.png   255 where samples stand behind the value
OUT/sparse/<stem>.npz    the samples: row, col, value_m, index, ring (-1: unknown), value, size_wh
OUT/picture/<stem>.png   the map in colour, with its scale
OUT/overlay/<stem>.png   the samples over a camera's image, where one was given
OUT/frames.csv           one row per cloud (`DepthRow`)
OUT/run.toml             effective configuration, camera, versions
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.codecs import encode_png
from fusion.errors import FrameError
from fusion.lidar.lane import DepthFrame
from fusion.lidar.sparse import SparseDepth
from fusion.sinks.run_folder import RunFolder, inside

PER_METRE = 256
COUNTS = ("read", "finite", "in_front", "in_frame", "in_range", "visible", "covered", "supported", "pixels")
KINDS = {"depth": ".png", "support": ".png", "sparse": ".npz", "picture": ".png", "overlay": ".png"}


@dataclass(frozen=True, slots=True)
class DepthRow:
    """One cloud. `status` is ``made`` or ``skipped`` (then `reason` says why and the rest is empty).

    `read` to `visible` count points left after each step, `covered` and `supported` pixels; `least_m` and
    `most_m` are the dense map's, `…_size` the lengths of the files in bytes.
    """

    stem: str
    status: str
    stamp_ns: str = ""
    value: str = ""
    read: str = ""
    finite: str = ""
    in_front: str = ""
    in_frame: str = ""
    in_range: str = ""
    visible: str = ""
    covered: str = ""
    supported: str = ""
    pixels: str = ""
    least_m: str = ""
    most_m: str = ""
    depth_size: str = ""
    support_size: str = ""
    sparse_size: str = ""
    picture_size: str = ""
    overlay_size: str = ""
    dropped: str = ""
    flags: str = ""
    reason: str = ""

    @property
    def done(self) -> bool:
        return self.status == "made"

    @classmethod
    def made(cls, frame: DepthFrame, sizes: Mapping[str, int]) -> DepthRow:
        filled = frame.dense.value_m[frame.dense.value_m > 0]
        dropped = (frame.dropped or {}).items()
        return cls(
            frame.stem,
            "made",
            "" if frame.stamp_ns is None else str(frame.stamp_ns),
            frame.dense.value,
            **{name: str(count) for name, count in frame.counts.items()},
            pixels=str(frame.dense.value_m.size),
            least_m=f"{filled.min():.3f}" if filled.size else "",
            most_m=f"{filled.max():.3f}" if filled.size else "",
            **{f"{kind}_size": str(size) for kind, size in sizes.items()},
            dropped=";".join(f"{why}={count}" for why, count in sorted(dropped) if count),
            flags=";".join(frame.flags),
        )

    @classmethod
    def skipped(cls, stem: str, error: FrameError) -> DepthRow:
        return cls(stem, "skipped", reason=f"{error.what} ({error.hint})" if error.hint else error.what)


class DepthSink(RunFolder[DepthRow]):
    """Writes depth maps into the folder `out`; resumable, see `run_folder`."""

    row_kind = DepthRow
    main_folder = "depth"

    def write(
        self,
        frame: DepthFrame,
        picture_bgr: NDArray[np.uint8],
        overlay_bgr: NDArray[np.uint8] | None = None,
    ) -> DepthRow:
        """Store one frame and return its row of the index. Raises `OutputError`."""
        data = {
            "support": encode_png(np.where(frame.dense.support, np.uint8(255), np.uint8(0))),
            "sparse": sparse_npz(frame.sparse),
            "picture": encode_png(picture_bgr),
            "depth": encode_png(quantised(frame.dense.value_m)),
        }
        if overlay_bgr is not None:
            data["overlay"] = encode_png(overlay_bgr)
        for kind, content in data.items():
            self._replace(self._path(kind, frame.stem), content)
        return DepthRow.made(frame, {kind: len(content) for kind, content in data.items()})

    def files(self, row: DepthRow) -> Mapping[Path, int]:
        """Raises `ValueError` for a row that is not ours: what it stands for is made again."""
        if not all(getattr(row, name).isdecimal() for name in COUNTS):
            raise ValueError(f"expected counts, got {row}")
        sizes = {kind: getattr(row, f"{kind}_size") for kind in KINDS}
        needed = {kind: size for kind, size in sizes.items() if size or kind != "overlay"}
        return {self._path(kind, row.stem): int(size) for kind, size in needed.items()}

    def paths(self, stem: str) -> Iterable[Path]:
        return [self._path(kind, stem) for kind in KINDS]

    def _path(self, kind: str, stem: str) -> Path:
        return self.out / kind / f"{inside(stem)}{KINDS[kind]}"


def quantised(value_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Metres as metres x 256, rounded half up: 0 = none, at least 1 where there is a value."""
    scaled = np.floor(np.minimum(value_m, np.float32(65535 / PER_METRE)) * PER_METRE + 0.5)
    return np.where(value_m > 0, np.maximum(scaled, 1), 0).astype(np.uint16)


def sparse_npz(sparse: SparseDepth) -> bytes:
    """The samples as an NPZ: row, col, value_m, index, ring (-1: unknown), value, size_wh."""
    buffer = io.BytesIO()
    ring = np.full(len(sparse), -1, np.int32) if sparse.ring is None else sparse.ring
    np.savez(
        buffer,
        row=sparse.v,
        col=sparse.u,
        value_m=sparse.value_m,
        index=sparse.index,
        ring=ring,
        value=np.array(sparse.value),
        size_wh=np.array(sparse.size_wh),
    )
    return buffer.getvalue()
