"""From what a file holds to a cloud: invalid points out, fields under our names, times in seconds."""

from __future__ import annotations

import re
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.clouds.base import RawCloud
from fusion.errors import FrameError
from fusion.frames import PointCloud

# Our name -> what files call it, the first that is there; in small letters, without CloudCompare's "scalar_".
ALIASES: dict[str, tuple[str, ...]] = {
    "intensity": ("intensity", "i", "intensities"),
    "ring": ("ring", "ring_id", "channel", "laser_id", "laser", "line", "beam_id", "beam"),
    "time_s": ("time_s", "time", "t", "timestamp", "time_stamp", "offset_time", "time_offset", "gps_time"),
}
_NS_PER = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_LAST_RING = 1 << 16
_LOOKED_AT = 4096
_TOO_FAR_M, _TOO_NEAR_M = 1e8, 1e-12  # beyond the one, or short of the other, nothing is measured


@np.errstate(all="ignore")  # damaged numbers may be anything, signalling NaN too
def cloud_of(raw: RawCloud, where: str, stem: str = "", stamp_ns: int | None = None) -> PointCloud:
    """The valid points of `raw`; see `read_cloud`. `stamp_ns` is the time if the points tell none."""
    columns = {_plain(name): values for name, values in reversed([*raw.columns.items()])}
    if not {"x", "y", "z"} <= columns.keys():
        raise FrameError(f"no x, y, z among its fields: {', '.join(raw.columns)[:200]}", where=where)
    axes = [columns[axis] for axis in "xyz"]
    if len({len(axis) for axis in axes}) != 1:
        raise FrameError(f"{' and '.join(str(len(a)) for a in axes)} values of x, y, z", where=where)
    keep, dropped = _valid(axes)
    _check_magnitude(axes, keep, where)
    n = int(np.count_nonzero(keep))
    every = n == len(keep)
    xyz_m: Any = np.empty((n, 3), _float_type(axes))
    for k, axis in enumerate(axes):
        xyz_m[:, k] = axis if every else axis[keep]
    fields, clock = _fields(raw.columns, slice(None) if every else keep)
    return PointCloud(xyz_m, fields, stem, stamp_ns if clock is None else clock, len(keep), dropped)


def _plain(name: str) -> str:
    return name.lower().removeprefix("scalar_")


def _valid(axes: list[NDArray[Any]]) -> tuple[NDArray[np.bool_], dict[str, int]]:
    """Which points are neither NaN nor infinite nor the (0, 0, 0) of no return; how many are what."""
    finite = np.ones(len(axes[0]), np.bool_)
    somewhere = np.zeros(len(axes[0]), np.bool_)
    for axis in axes:
        finite &= np.isfinite(axis)
        somewhere |= axis != 0
    nan = len(finite) - int(np.count_nonzero(finite))
    zero = len(finite) - int(np.count_nonzero(somewhere))  # a point with a NaN is not at the origin
    return np.logical_and(finite, somewhere, out=finite), {"nan": nan, "zero": zero}


def _float_type(axes: list[NDArray[Any]]) -> type[np.float32] | type[np.float64]:
    """float32, if it holds the file's numbers exactly."""
    exact = all(a.dtype.itemsize <= (4 if a.dtype.kind == "f" else 2) for a in axes)
    return np.float32 if exact else np.float64


def _check_magnitude(axes: list[NDArray[Any]], keep: NDArray[np.bool_], where: str) -> None:
    """Raise where more than a tenth of the points lie where none can: the bytes are something else."""
    some = np.flatnonzero(keep[:: max(len(keep) // _LOOKED_AT, 1)]) * max(len(keep) // _LOOKED_AT, 1)
    seen = [axis[some] for axis in axes]
    absurd = _absurd(seen)
    if not absurd.size or absurd.mean() <= 0.1:
        return
    if _absurd([values.byteswap() for values in seen]).mean() <= 0.1:
        what = "its numbers are byte-swapped: they are metres only in the other byte order"
        raise FrameError(what, where=where, hint="write it again in the byte order that its format says")
    odd = ", ".join(f"{float(values[absurd.argmax()]):g}" for values in seen)
    what = f"its points are no metres: one of them is ({odd})"
    raise FrameError(what, where=where, hint="is it damaged, or of another form than its suffix says?")


def _absurd(seen: list[NDArray[Any]]) -> NDArray[np.bool_]:
    farthest = np.max([np.abs(values.astype(np.float64)) for values in seen], axis=0, initial=0)
    return ~((farthest == 0) | ((farthest > _TOO_NEAR_M) & (farthest < _TOO_FAR_M)))


def _fields(
    columns: Mapping[str, NDArray[Any]], keep: slice | NDArray[np.bool_]
) -> tuple[dict[str, NDArray[Any]], int | None]:
    """The fields under our names, and when the earliest point was measured, if they tell."""
    names = {_plain(name): name for name in reversed([*columns])}
    ours = {names[file]: name for name in ALIASES if (file := _first(name, names)) is not None}
    fields: dict[str, NDArray[Any]] = {}
    stamp_ns = None
    for name, values in columns.items():
        if name in (names["x"], names["y"], names["z"]):
            continue
        native = values[keep].astype(values.dtype.newbyteorder("="), order="C", copy=isinstance(keep, slice))
        known = ours.get(name, name if name not in ours.values() else f"{name}_2")
        if known == "time_s" and _plain(name) != "time_s":
            native, stamp_ns = seconds(name, native)
        elif known == "time_s":
            native = native.astype(np.float64)
        elif known == "ring":
            known, native = _ring(native)
        fields[known] = native
    return fields, stamp_ns


def _first(name: str, names: Mapping[str, str]) -> str | None:
    """What a file calls our field `name`; a time may say its unit ("time_ns")."""
    for alias in ALIASES[name]:
        for unit in ("", *(f"_{unit}" for unit in _NS_PER if name == "time_s")):
            if alias + unit in names:
                return alias + unit
    return None


def _ring(values: NDArray[Any]) -> tuple[str, NDArray[Any]]:
    """int32, or the values as they are, under a name that promises nothing."""
    wide = values.astype(np.float64)  # ends of the range that float16 and int8 cannot be compared with
    if not ((wide >= 0) & (wide < _LAST_RING) & (wide == np.floor(wide))).all():
        return "ring_as_stored", values
    return "ring", values.astype(np.int32)


@np.errstate(all="ignore")
def seconds(name: str, values: NDArray[Any]) -> tuple[NDArray[np.float64], int | None]:
    """Seconds since the earliest of the times, and that one in ns since 1970 where the times are counted
    from there.

    The unit is in the name (`_s`, `_ms`, `_us`, `_ns`). Without one, 64-bit times of 10, 13, 16 or 19 whole
    digits count s, ms, us or ns since 1970 (never those of `gps_time`, which have another origin); other
    integers are ns; other floats are s, or ns where they span more than 1e6 of them. NaN stays NaN.
    """
    finite = np.isfinite(values)
    if not finite.any():
        return values.astype(np.float64), None
    least = values[finite].min()
    first, span = Fraction(least.item()), float(values[finite].max()) - float(least)
    unit, since_1970 = _unit(_plain(name), values.dtype, first, span)
    if values.dtype.kind == "f":
        passed = values.astype(np.float64) - np.float64(least)
    else:  # modulo 2^64, so that no difference of integers is too large
        passed = (values.astype(np.uint64) - least.astype(np.uint64)).astype(np.float64)
    return passed / (10**9 // unit), round(first * unit) if since_1970 else None


def _unit(name: str, dtype: np.dtype[Any], first: Fraction, span: float) -> tuple[int, bool]:
    """ns in a unit of the times, and whether they count from 1970."""
    said = re.search(r"_(s|ms|us|ns)$", name)
    candidates = [_NS_PER[said[1]]] if said else list(_NS_PER.values())
    if dtype.itemsize == 8 and not name.startswith("gps"):
        for unit in candidates:
            if 10**18 <= first * unit < 10**19:
                return unit, True
    if said:
        return candidates[0], False
    return (10**9 if dtype.kind == "f" and span <= 1e6 else 1), False
