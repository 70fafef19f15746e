"""One image, one radiometric file, one video."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.codecs import decode_image
from fusion.errors import FrameError, FusionError, InputError
from fusion.inspect.base import QUICK_ITEMS, Asked, Finding, InspectKind, Looked, Stream, steps_of
from fusion.inspect.measure import PixelTally, spread, times_of
from fusion.inspect.pictures import histogram, thumbnail
from fusion.radiometric import FlirImage, read_flir
from fusion.radiometric.flir import HEAD_BYTES, glance, why_no_counts
from fusion.sources.folders import IMAGE_SUFFIXES
from fusion.sources.video import VIDEO_SUFFIXES

_MOST_BYTES = 1 << 30


def look_at_image(path: Path, asked: Asked) -> Finding:
    """A picture in a file: what its pixels are, their range, and what it can be used for."""
    data = _read(path)
    try:
        pixels = decode_image(data, str(path))
    except FrameError as error:
        raise InputError(error.what, where=path, hint=error.hint) from None
    tally = PixelTally()
    tally.add(pixels)
    facts = {"file_bytes": len(data), **pixels_said(pixels), "values": tally.facts()}
    refused = why_no_counts(data[:HEAD_BYTES])
    notes = [f"{refused.what}: {refused.hint}"] if refused else _plain_notes(path)
    steps, pictures = _image_steps(path, pixels, bool(refused)), []
    if asked.pictures:
        pictures = [thumbnail(path.name, pixels), histogram("counts of all channels", tally)]
    title = "an image" + (" without counts that can be read" if refused else "")
    return Finding(
        str(path),
        "image",
        title,
        facts,
        notes=tuple(notes),
        steps=steps,
        pictures=tuple(p for p in pictures if p),
    )


def pixels_said(pixels: NDArray[Any]) -> dict[str, Any]:
    """Size, bits and channels of decoded pixels."""
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    return {
        "size_wh": [pixels.shape[1], pixels.shape[0]],
        "bits": pixels.dtype.itemsize * 8,
        "channels": channels,
        "content": what_of(pixels),
    }


def what_of(pixels: NDArray[Any]) -> str:
    """In words what an image's channels are."""
    if pixels.ndim == 2:
        return "counts" if pixels.dtype == np.uint16 else "grey"
    colour = pixels[..., :3]
    equal = bool(
        np.array_equal(colour[..., 0], colour[..., 1]) and np.array_equal(colour[..., 1], colour[..., 2])
    )
    words = "grey stored as colour" if equal else "colour"
    return words + (", with a fourth channel" if pixels.shape[2] == 4 else "")


def look_at_radiometric(path: Path, asked: Asked) -> Finding:
    """A FLIR file: counts, degrees, what the camera took them with, and the visible image within."""
    data = _read(path)
    try:
        flir = read_flir(data, str(path))
    except FrameError as error:
        raise InputError(error.what, where=path, hint=error.hint) from None
    tally = PixelTally()
    tally.add(flir.counts)
    facts = {"file_bytes": len(data), **flir_said(flir), "counts": tally.facts()}
    notes = []
    if flir.visible_bgr is not None:
        notes.append("the visible image is not registered to the counts")
    pictures = []
    if asked.pictures:
        pictures = [thumbnail("thermal counts", flir.counts), histogram("counts", tally)]
        pictures += [thumbnail("visible image", flir.visible_bgr)] if flir.visible_bgr is not None else []
    why = "blend its own two images, one scaled onto the other; --align or --points register them"
    steps = steps_of((["fusion", "blend", path, "-o", "OUT", "--preview"], why))
    return Finding(
        str(path),
        "radiometric",
        "a FLIR radiometric image",
        facts,
        notes=tuple(notes),
        steps=steps if flir.visible_bgr is not None else steps_of(_fir_step(path)),
        pictures=tuple(p for p in pictures if p),
    )


def flir_said(flir: FlirImage) -> dict[str, Any]:
    """What a FLIR file says of itself, and the degrees that its counts stand for."""
    celsius = flir.celsius()
    known = celsius[np.isfinite(celsius)]
    height, width = flir.counts.shape
    facts: dict[str, Any] = {"thermal_size_wh": [width, height]}
    facts |= {key: text for key in ("model", "lens") if (text := getattr(flir, key))}
    facts |= {"taken_ns": flir.stamp_ns} if flir.stamp_ns is not None else {}
    if known.size:
        low, middle, high = (round(float(v), 2) for v in np.quantile(known, (0, 0.5, 1)))
        facts["temperature_celsius"] = {"least": low, "median": middle, "most": high}
    if known.size < celsius.size:
        facts["pixels_below_any_temperature"] = int(celsius.size - known.size)
    facts["emissivity"] = round(float(flir.planck.emissivity), 4)
    facts["distance_m"] = round(float(flir.planck.distance_m), 3)
    if flir.visible_bgr is None:
        facts["visible_image"] = "none"
    else:
        facts["visible_size_wh"] = [flir.visible_bgr.shape[1], flir.visible_bgr.shape[0]]
    return facts


def look_at_video(path: Path, asked: Asked) -> Finding:
    """A video: its frames' times from the container, and a sample of its pictures."""
    from fusion.sources import open_source

    source = open_source(path, "rgb")
    try:
        count = len(source.entries)
        chosen = range(count) if asked.full else spread(count, QUICK_ITEMS)
        tally, faults, shown, sizes = PixelTally(), [], [], set()
        for done, index in enumerate(chosen):
            asked.progress(done, len(chosen))
            try:
                image = source.read(index)
            except FrameError as error:
                faults.append(str(error))
                continue
            tally.add(image.pixels)
            sizes.add(image.size_wh)
            shown = shown or [thumbnail(source.entries[index].where, image.pixels)]
        stamps = [entry.stamp_ns for entry in source.entries]
    finally:
        source.close()
    looked = Looked(len(chosen), count, "frames decoded")
    times = times_of(stamps, "log", Looked(count, count, "frames"))
    facts = {"size_wh": [list(size) for size in sorted(sizes)], "values": tally.facts()}
    line = np.array([s for s in stamps if s is not None], np.int64) if asked.pictures else None
    stream = Stream(path.name, "video", "image", count, "", looked, facts, times, (), line)
    return Finding(
        str(path),
        "video",
        "a video",
        {"file_bytes": path.stat().st_size, "frames": count},
        (stream,),
        notes=("damage between the sampled frames is not seen without --full",)
        if len(chosen) < count
        else (),
        faults=tuple(faults[:20]),
        steps=steps_of((["fusion", "blend", path, "FIR", "-o", "OUT"], "with the thermal video as FIR")),
        pictures=tuple(shown if asked.pictures else ()),
    )


def _image_steps(path: Path, pixels: NDArray[Any], refused: bool) -> Any:
    if refused:
        return ()
    if pixels.ndim == 2:
        return steps_of(_fir_step(path))
    if pixels.shape[2] == 4:
        return steps_of((["fusion", "blend", path, "-o", "OUT"], "if the fourth channel is thermal"))
    return steps_of((["fusion", "blend", path, "FIR", "-o", "OUT"], "with the thermal image as FIR"))


def _fir_step(path: Path) -> tuple[list[object], str]:
    return ["fusion", "blend", "RGB", path, "-o", "OUT"], "with the visible image as RGB"


def _plain_notes(path: Path) -> list[str]:
    if path.suffix.lower() in (".jpg", ".jpeg"):
        return ["a plain picture: without radiometric data there are no temperatures in it"]
    return []


def _is_radiometric(path: Path) -> bool:
    if not path.is_file() or path.suffix.lower() not in (".jpg", ".jpeg", ".fff", ".seq"):
        return False
    with path.open("rb") as file:
        return glance(file.read(HEAD_BYTES)) is not None


def _read(path: Path) -> bytes:
    size = path.stat().st_size
    if size == 0:
        raise InputError("an empty file (0 bytes)", where=path)
    if size > _MOST_BYTES:
        raise InputError(f"{size:,} bytes are too many for one image", where=path)
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", where=path) from error


def _safe(path: Path) -> bool:
    try:
        return _is_radiometric(path)
    except (OSError, FusionError):
        return False


RADIOMETRIC = InspectKind("a radiometric JPEG", _safe, look_at_radiometric)
IMAGE = InspectKind(
    "an image file", lambda path: path.is_file() and path.suffix.lower() in IMAGE_SUFFIXES, look_at_image
)
VIDEO = InspectKind(
    "a video", lambda path: path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES, look_at_video
)
