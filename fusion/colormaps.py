"""Colour maps: 256-entry tables from an 8-bit index to BGR.

A bare name is looked for among our own maps first, then matplotlib's, then OpenCV's: `hsv` and `jet`
are MATLAB's, `inferno` is matplotlib's, `parula` is OpenCV's. `mpl:NAME` and `cv:NAME` ask one library.
matplotlib is imported only when a name leads there.
"""

from __future__ import annotations

import difflib
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.errors import UsageError

if TYPE_CHECKING:
    from matplotlib.cm import ColormapRegistry

_ENTRIES = np.arange(256, dtype=np.uint8)
_CV_PREFIX, _MPL_PREFIX = "cv:", "mpl:"


def _hue_table(hue_sixths: NDArray[np.int64], denominator: int) -> NDArray[np.uint8]:
    """BGR of the fully saturated hues `hue_sixths / denominator / 6`, channels rounded half up.

    In whole numbers, so that no platform's floating point can move an entry.
    """
    sector, offset = np.divmod(hue_sixths, denominator)
    rising = (2 * 255 * offset + denominator) // (2 * denominator)
    falling = (2 * 255 * (denominator - offset) + denominator) // (2 * denominator)
    full, none = np.full_like(offset, 255), np.zeros_like(offset)
    red = np.choose(sector, [full, falling, none, none, rising, full])
    green = np.choose(sector, [rising, full, full, falling, none, none])
    blue = np.choose(sector, [none, none, rising, full, full, falling])
    return np.stack([blue, green, red], axis=1).astype(np.uint8)


def _hsv() -> NDArray[np.uint8]:
    """MATLAB's hsv(256): entry k has hue k/256, saturation 1, value 1. Both ends are red."""
    return _hue_table(6 * np.arange(256, dtype=np.int64), 256)


def _hsv_cold_hot() -> NDArray[np.uint8]:
    """The same colours without the cycle: entry k has hue 2/3 * (1 - k/255), blue to red."""
    return _hue_table(4 * np.arange(255, -1, -1, dtype=np.int64), 255)


def _jet() -> NDArray[np.uint8]:
    """MATLAB's jet(256): three equal trapezia with sides of 64 entries, blue, green, red, 64 apart."""
    k = np.arange(256, dtype=np.int64)
    sixtyfourths = [np.clip(np.minimum(k + 33 - shift, 159 - k + shift), 0, 64) for shift in (0, 64, 128)]
    return ((2 * 255 * np.stack(sixtyfourths, axis=1) + 64) // (2 * 64)).astype(np.uint8)


def _grey() -> NDArray[np.uint8]:
    return np.repeat(_ENTRIES[:, None], 3, axis=1)


_OURS = {"hsv-cold-hot": _hsv_cold_hot, "hsv": _hsv, "jet": _jet, "grey": _grey}
_OPENCV: dict[str, int] = {
    name.removeprefix("COLORMAP_").lower(): getattr(cv2, name)
    for name in sorted(dir(cv2))
    if name.startswith("COLORMAP_")
}


def _mpl_registry() -> ColormapRegistry:
    from matplotlib import colormaps  # nearly a second, and most runs never ask for it

    return colormaps


def _from_matplotlib(name: str) -> NDArray[np.uint8]:
    # k/255 is how matplotlib itself shows 8-bit data; a map of 10 or 510 colours comes out at 256
    rgba = np.asarray(_mpl_registry()[name](_ENTRIES / 255.0, bytes=True))
    return np.ascontiguousarray(rgba[:, 2::-1], dtype=np.uint8)


def _from_opencv(name: str) -> NDArray[np.uint8]:
    table = cv2.applyColorMap(_ENTRIES[:, None], _OPENCV[name])
    return np.asarray(table, dtype=np.uint8).reshape(256, 3)


def _look_up(name: str) -> NDArray[np.uint8] | None:
    if name.startswith(_CV_PREFIX):
        bare = name.removeprefix(_CV_PREFIX)
        return _from_opencv(bare) if bare in _OPENCV else None
    if name in _OURS:
        return _OURS[name]()
    bare = name.removeprefix(_MPL_PREFIX)
    if bare in _mpl_registry():
        return _from_matplotlib(bare)
    return _from_opencv(name) if name in _OPENCV else None


@lru_cache(maxsize=64)
def colormap_bgr(name: str) -> NDArray[np.uint8]:
    """The colour map `name` as a read-only 256 x 3 uint8 table in BGR order.

    Ours: `hsv` (MATLAB's hsv(256), METHOD section 1; both ends are red), `hsv-cold-hot` (its blue to
    red part, no cycle), `jet` (MATLAB's jet(256)), `grey`. Then every matplotlib map (`inferno`, or
    `mpl:inferno`) and every OpenCV map (`cv:jet`). A bare name is looked for in that order: ours,
    matplotlib, OpenCV.
    matplotlib's colours are those it shows 8-bit data in; its maps with fewer or more entries are
    brought to 256 as matplotlib does. Raises `UsageError` with the nearest names for an unknown one.
    """
    table = _look_up(name)
    if table is None:
        raise UsageError(f"unknown colour map {name!r}", where="--colormap", hint=_near_misses(name))
    table.setflags(write=False)
    return table


def colormap_names() -> list[str]:
    """One accepted name for every map: ours, matplotlib's, then OpenCV's. Imports matplotlib.

    A matplotlib map that one of ours hides is listed with its prefix, OpenCV's all are.
    """
    mpl = sorted(_mpl_registry(), key=str.lower)
    shown = [f"{_MPL_PREFIX}{name}" if name in _OURS else name for name in mpl]
    return [*_OURS, *shown, *(f"{_CV_PREFIX}{name}" for name in _OPENCV)]


def _near_misses(name: str) -> str:
    """What was probably meant: nearest names without regard to case, or the ways to name a map."""
    names = [*colormap_names(), *_OPENCV, *(f"{_MPL_PREFIX}{known}" for known in _mpl_registry())]
    known = {candidate.lower(): candidate for candidate in reversed(names)}
    close = difflib.get_close_matches(name.strip().lower(), known, n=4, cutoff=0.6)
    if close:
        return f"did you mean {', '.join(known[match] for match in close)}?"
    return f"choose {', '.join(_OURS)}, a matplotlib name such as inferno, or an OpenCV one such as cv:jet"
