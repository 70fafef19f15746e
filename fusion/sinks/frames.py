"""Frames as files: one folder a kind, one file a frame, wherever the storage is.

fused/<stem>.png|jpg   the frame
mask/<stem>.png        255 where thermal was seen, only where that is not everywhere
fir/<stem>.png         thermal as it was measured, uint16 on the RGB grid, 0 = none
depth/<stem>.png       uint16, metres x 256, 0 = none; support/<stem>.png 255 where samples stand behind it
sparse/<stem>.npz      the LiDAR's samples, as `fusion.sinks.depth` writes them
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fusion.chunks import Chunk
from fusion.sinks.base import Made, Setup
from fusion.sinks.depth import sparse_npz
from fusion.storage import Storage


@dataclass(frozen=True)
class FrameFiles:
    """The output ``folder``."""

    setup: Setup

    def open(self, chunk: Chunk, out: Storage) -> _Writing:  # noqa: ARG002 - files are not kept by chunk
        return _Writing(out, self.setup.image_format)

    def finish(self, chunks: Sequence[Chunk], out: Storage) -> Sequence[str]:  # noqa: ARG002 - nothing to join
        return ["fused/"]


class _Writing:
    def __init__(self, out: Storage, image_format: str) -> None:
        self._out, self._suffix = out, {"fused": image_format, "sparse": "npz"}
        self._sizes: dict[str, int] = {}

    def add(self, made: Made) -> None:
        for kind, data in made.encoded.items():
            if kind != "fused":
                self._write(kind, made.stem, data)
        if made.depth is not None:
            self._write("sparse", made.stem, sparse_npz(made.depth.sparse))
        self._write("fused", made.stem, made.encoded["fused"])  # last: whoever sees it finds the rest

    def close(self) -> Mapping[str, int]:
        return self._sizes

    def discard(self) -> None: ...

    def _write(self, kind: str, stem: str, data: bytes) -> None:
        name = f"{kind}/{stem}.{self._suffix.get(kind, 'png')}"
        self._out.write(name, data)
        self._sizes[name] = len(data)
