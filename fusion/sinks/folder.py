"""A folder of fused frames with their index.

OUT/fused/<stem>.png|jpg   the frames
OUT/mask/<stem>.png        255 where thermal was seen, only where that is not everywhere
OUT/frames.csv             one row per pair (`sinks.index.Row`)
OUT/run.toml               effective configuration, registration, window, versions, hashes
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.codecs import encode_jpeg, encode_png
from fusion.frames import FusedFrame
from fusion.sinks.index import Row
from fusion.sinks.run_folder import RunFolder, inside


class FolderSink(RunFolder[Row]):
    """Writes fused frames into the folder `out`; resumable, see `run_folder`.

    PNG is lossless; JPEG has `quality` 1 to 100.
    """

    row_kind = Row
    main_folder = "fused"

    def __init__(
        self,
        out: str | Path,
        run: Mapping[str, Any] | None = None,
        *,
        image_format: str = "png",
        quality: int = 90,
        overwrite: bool = False,
    ) -> None:
        super().__init__(out, run, overwrite=overwrite)
        self._suffix, self._quality = f".{image_format}", quality
        self._encoded_mask: tuple[NDArray[np.uint8], bytes] | None = None

    def write(self, frame: FusedFrame, fir_stem: str) -> Row:
        lossless = self._suffix == ".png"
        data = encode_png(frame.bgr) if lossless else encode_jpeg(frame.bgr, self._quality)
        mask_size = None
        if frame.mask is not None:
            mask = self._mask_png(frame.mask)
            mask_size = len(mask)
            self._replace(self._mask_path(frame.stem), mask)
        self._replace(self._frame_path(frame.stem), data)
        return Row.fused(frame, fir_stem, len(data), mask_size)

    def files(self, row: Row) -> Mapping[Path, int]:
        files = {self._frame_path(row.stem): int(row.size)}
        return {**files, self._mask_path(row.stem): int(row.mask_size)} if row.mask_size else files

    def paths(self, stem: str) -> Iterable[Path]:
        return (*(self._frame_path(stem, suffix) for suffix in (".png", ".jpg")), self._mask_path(stem))

    def _frame_path(self, stem: str, suffix: str | None = None) -> Path:
        return self.out / "fused" / f"{inside(stem)}{suffix or self._suffix}"

    def _mask_path(self, stem: str) -> Path:
        return self.out / "mask" / f"{inside(stem)}.png"

    def _mask_png(self, mask: NDArray[np.uint8]) -> bytes:
        known = self._encoded_mask
        if known is None or known[0] is not mask:  # a fixed warp hands out one and the same array
            known = self._encoded_mask = (mask, encode_png(mask))
        return known[1]
