"""FLIR's radiometric JPEG: the sensor's counts, what turns them into degrees, and the visible image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.codecs import MAX_PIXELS
from fusion.errors import FrameError
from fusion.radiometric import block as fff
from fusion.radiometric.planck import Planck
from fusion.radiometric.segments import JPEG_START, first_part, flir_block, is_dji

HEAD_BYTES = 1 << 18  # of a file: what stands in front of the FLIR data fits into half of it

_DJI = "DJI's own radiometric JPEG (R-JPEG): its temperatures lie in DJI's APP3 and APP4 segments"
_DJI_WAY_OUT = "take the temperatures out with DJI's Thermal SDK and save them as 16-bit TIFF"


@dataclass(frozen=True, slots=True, eq=False)
class FlirImage:
    """One radiometric image as the camera wrote it.

    `counts` is H x W uint16; `planck` turns them into degrees. `visible_bgr` is the embedded visible image,
    H' x W' x 3 uint8, None where there is none (or it was not asked for); it is not registered to the counts.
    `pip` says how the camera lays one over the other, None where it does not. `stamp_ns` is the camera's
    clock, `model`, `serial` and `lens` are its texts.
    """

    counts: NDArray[np.uint16]
    planck: Planck
    visible_bgr: NDArray[np.uint8] | None
    pip: fff.PictureInPicture | None
    stamp_ns: int | None
    model: str
    serial: str
    lens: str

    def celsius(self) -> NDArray[np.float32]:
        """Degrees Celsius of every pixel, H x W float32; NaN where the counts are below any temperature."""
        least = int(self.counts.min())
        table = self.planck.celsius(np.arange(least, int(self.counts.max()) + 1))  # far fewer than pixels
        return table[self.counts - np.uint16(least)]

    def counts_at(self, celsius: float) -> float:
        """The counts that a temperature gives in this image, not rounded."""
        return self.planck.counts_at(celsius)


@dataclass(frozen=True, slots=True)
class Holds:
    """What a file holds, told from its beginning: FLIR's thermal counts, and a visible image."""

    counts: bool
    visible: bool


def read_flir(data: bytes, where: str, *, max_pixels: int = MAX_PIXELS, visible: bool = True) -> FlirImage:
    """Read a FLIR radiometric JPEG, or a bare FLIR block (FFF), held in memory.

    `where` names it in messages; `max_pixels` bounds either image; without `visible` the embedded image is
    left alone. Raises `FrameError` where `data` is no such file (what it is instead is said, if known), or is
    damaged.
    """
    records = _records(data, where)
    camera, embedded = records[fff.CAMERA_INFO], records.get(fff.EMBEDDED_IMAGE)
    pip = records.get(fff.PICTURE_IN_PICTURE)
    return FlirImage(
        fff.raw_counts(records[fff.RAW_DATA], where, max_pixels),
        fff.planck(camera, where),
        fff.embedded_image(embedded, where, max_pixels) if embedded and visible else None,
        fff.picture_in_picture(pip) if pip else None,
        fff.taken_ns(camera),
        **fff.camera_texts(camera),
    )


def read_planck(data: bytes, where: str) -> Planck:
    """What turns the counts of a radiometric file into degrees, without its images. Raises as `read_flir`."""
    return fff.planck(_records(data, where)[fff.CAMERA_INFO], where)


def glance(head: bytes) -> Holds | None:
    """What a file holds by its first `HEAD_BYTES`; None where no FLIR data begin there."""
    part = first_part(head)
    if part is None:
        return None
    try:
        places = fff.directory(part, "")
    except FrameError:
        return Holds(True, True)  # damaged, or farther on in the file: reading it says how
    return Holds(fff.RAW_DATA in places, fff.EMBEDDED_IMAGE in places)


def why_no_counts(head: bytes) -> FrameError | None:
    """The refusal of a radiometric image whose counts we cannot read; None for any other image."""
    return FrameError(_DJI, hint=_DJI_WAY_OUT) if is_dji(head) else None


def flir_in(data: bytes, where: str, max_pixels: int, *, dji: bool = False) -> FlirImage | None:
    """The radiometric image in a file's `data`, without its visible one; None where it is another image.

    Raises `FrameError` for a radiometric file that is damaged or whose counts cannot be read: DJI's own kind,
    unless `dji` lets its picture pass, and those of the visible camera only.
    """
    if not data.startswith(JPEG_START):
        return None
    if glance(data) is not None:
        return read_flir(data, where, max_pixels=max_pixels, visible=False)
    refusal = None if dji else why_no_counts(data)
    if refusal is not None:
        raise FrameError(refusal.what, where=where, hint=refusal.hint)
    return None


def shows_temperatures(data: bytes) -> bool:
    """Whether the picture of a JPEG belongs to thermal counts, so that it is hardly a visible image."""
    holds = glance(data) if data.startswith(JPEG_START) else None
    return holds is not None and holds.counts


def _records(data: bytes, where: str) -> dict[int, fff.Record]:
    """The records of a file, counts and camera among them."""
    block = flir_block(data, where)
    if block is None:
        raise _no_block(data, where)
    records = fff.records(block, where)
    for kind, what in ((fff.RAW_DATA, "thermal counts"), (fff.CAMERA_INFO, "camera constants")):
        if kind not in records:
            hint = "a picture of the visible camera only, or saved again without the raw data"
            raise FrameError(f"its FLIR data hold no {what}", where=where, hint=hint)
    return records


def _no_block(data: bytes, where: str) -> FrameError:
    if is_dji(data):
        return FrameError(_DJI, where=where, hint=_DJI_WAY_OUT)
    kind = "a plain JPEG" if data.startswith(JPEG_START) else "no JPEG"
    hint = "use the file as the camera wrote it: editors and messengers leave the data out"
    return FrameError(f"{kind}, without FLIR's radiometric data", where=where, hint=hint)
