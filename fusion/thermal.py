"""Thermal windows: which interval of counts is stretched over the colour map.

A rule is what the user says; a plan is the rule made ready for one sequence. A window depends on the
sequence and the frame's number alone, so frames may be made in any order, by any number of workers.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.errors import FrameError, InputError, UsageError
from fusion.frames import Window

Counts = NDArray[np.uint8] | NDArray[np.uint16]
Unit = Literal["fraction", "counts", "celsius", "percentile"]
Over = Literal["frame", "sequence", "running"]

KEY_STEP = 10  # frames between two key frames of a running window
_NARROWEST = 1e-3  # counts; anything below is a slip, and tends to a division by zero
_FARTHEST = 1e7  # counts; far beyond what 16 bits hold
_ABSOLUTE_ZERO_DEGC = -273.15
_ADVISE_ABOVE = 1 / 3  # share of clipped pixels


@dataclass(frozen=True, slots=True)
class WindowRule:
    """What decides the window: `lo` and `hi` in `unit`.

    `fraction`: of the type's range, 255 or 65535 (MATLAB's `imadjust`; METHOD section 1). `counts`: as
    they are. `celsius`: by degC = `celsius_per_count` * counts + `celsius_at_zero`. `percentile`: of
    the pixels `over` each frame, the whole sequence, or a running part of it; `over` means nothing
    for the other units. Raises `UsageError`, naming the option, for a window that cannot be meant.
    """

    lo: float
    hi: float
    unit: Unit = "fraction"
    over: Over = "sequence"
    celsius_per_count: float | None = None
    celsius_at_zero: float | None = None

    def __post_init__(self) -> None:
        if self.unit not in get_args(Unit):
            raise UsageError(f"unknown unit {self.unit!r}", where="--window-unit", hint=_one_of(Unit))
        if self.over not in get_args(Over):
            raise UsageError(f"unknown choice {self.over!r}", where="--window-over", hint=_one_of(Over))
        if self.over != "sequence" and self.unit != "percentile":
            hint = "add --window-unit percentile, or leave --window-over out"
            raise UsageError(f"{self.over} has no meaning for {self.unit}", where="--window-over", hint=hint)
        self._check_scale()
        self._check_limits()

    def _check_scale(self) -> None:
        per_count, at_zero = self.celsius_per_count, self.celsius_at_zero
        if per_count is not None and not (math.isfinite(per_count) and per_count > 0):
            raise UsageError(f"expected a number above 0, got {per_count}", where="--celsius-per-count")
        if at_zero is not None and not math.isfinite(at_zero):
            raise UsageError(f"expected a finite number, got {at_zero}", where="--celsius-at-zero")
        if self.unit == "celsius" and (per_count is None or at_zero is None):
            what = "a window in degrees Celsius needs the scale from counts to degrees"
            hint = "give --celsius-per-count and --celsius-at-zero, the degrees at count 0"
            raise UsageError(what, where="--window-unit", hint=hint)

    def _check_limits(self) -> None:
        lo, hi = self.lo, self.hi
        if not (math.isfinite(lo) and math.isfinite(hi) and lo < hi):
            _refuse_window(self, "expected two finite numbers, the lower one first")
        top = {"fraction": 1, "percentile": 100}.get(self.unit, math.inf)
        if top < math.inf and not 0 <= lo < hi <= top:
            _refuse_window(self, f"a {self.unit} lies between 0 and {top}", "see --window-unit")
        if self.unit == "celsius" and lo < _ABSOLUTE_ZERO_DEGC:
            _refuse_window(self, "no temperature lies below -273.15 degC")
        if self.unit != "percentile":
            self._check_counts()

    def _check_counts(self) -> None:
        lo, hi = self.to_counts(255)
        text = f"{lo:g} to {hi:g} counts"
        if hi - lo < _NARROWEST:
            _refuse_window(self, f"{text} is too narrow to tell one count from the next", "widen it")
        if max(abs(lo), abs(hi)) > _FARTHEST or hi <= 0 or lo >= 65535:
            _refuse_window(self, f"{text} is out of reach of 16-bit thermal images", _scale_hint(self))

    def to_counts(self, top: int) -> tuple[float, float]:
        """The limits in counts for a type whose largest value is `top`. Percentiles need pixels."""
        if self.unit == "percentile":
            raise ValueError("percentiles become counts only with pixels: see plan_windows")
        if self.unit == "fraction":
            return self.lo * top, self.hi * top
        if self.celsius_per_count is None or self.celsius_at_zero is None or self.unit == "counts":
            return float(self.lo), float(self.hi)
        lo, hi = ((degc - self.celsius_at_zero) / self.celsius_per_count for degc in (self.lo, self.hi))
        return lo, hi


def _one_of(choices: object) -> str:
    return f"choose {', '.join(get_args(choices))}"


def _scale_hint(rule: WindowRule) -> str:
    if rule.unit == "celsius":
        return "check --celsius-per-count and --celsius-at-zero, the degrees at count 0"
    return "see --window-unit"


def _refuse_window(rule: WindowRule, what: str, hint: str = "") -> None:
    raise UsageError(f"{rule.lo:g} {rule.hi:g} as {rule.unit}: {what}", where="--window", hint=hint)


THESIS = WindowRule(0.3, 0.6, "fraction")  # METHOD section 1
AUTO = WindowRule(1, 99, "percentile", "sequence")


@dataclass(frozen=True, slots=True)
class WindowPlan:
    """A rule made ready for one sequence; immutable, and shared by all workers.

    `keys` are the frame numbers at which `windows` hold, ascending; between two of them the window is
    interpolated, before the first and after the last it stays. One key is one window for the whole
    sequence; none means that each frame decides for itself. `samples` are the frames that planning
    used, `dtype` is their common type, `skipped` holds the messages of those it could not read.
    """

    rule: WindowRule
    keys: tuple[int, ...] = ()
    windows: tuple[Window, ...] = ()
    samples: tuple[int, ...] = ()
    dtype: str | None = None
    skipped: tuple[str, ...] = ()

    def window(self, i: int, counts: Counts) -> Window:
        """The window of frame `i`, in counts; `counts` are its pixels, H x W uint8 or uint16.

        Raises `FrameError` for pixels of another type than the plan was made from, and where a window
        in counts or degrees lies wholly outside what the frame's type can hold.
        """
        _check_pixels(counts, i)
        if self.dtype is not None and counts.dtype.name != self.dtype:
            what = f"thermal is {counts.dtype.name}, but the window was planned for {self.dtype}"
            raise FrameError(what, where=f"frame {i}", hint="keep 8-bit and 16-bit thermal images apart")
        if self.keys:
            return self._at(i)
        if self.rule.unit == "percentile":
            return _percentile_window(_histogram(counts), self.rule)
        return _fixed_window(self.rule, counts, i)

    def _at(self, i: int) -> Window:
        right = bisect_right(self.keys, i)
        if right in (0, len(self.keys)):
            return self.windows[0 if right == 0 else -1]
        start, end = self.keys[right - 1], self.keys[right]
        a, b = self.windows[right - 1], self.windows[right]
        t = (i - start) / (end - start)
        return Window(a.lo + t * (b.lo - a.lo), a.hi + t * (b.hi - a.hi))

    def record(self) -> dict[str, object]:
        """All that is needed to repeat the plan, in TOML's types; key windows are in counts."""
        rule = self.rule
        found: dict[str, object] = {"lo": float(rule.lo), "hi": float(rule.hi), "unit": rule.unit}
        if rule.unit == "percentile":
            found["over"] = rule.over
        if rule.celsius_per_count is not None:
            found["celsius_per_count"] = float(rule.celsius_per_count)
        if rule.celsius_at_zero is not None:
            found["celsius_at_zero"] = float(rule.celsius_at_zero)
        if self.dtype is not None:
            found["dtype"] = self.dtype
            found["sample_frames"] = list(self.samples)
            found["key_frames"] = list(self.keys)
            found["key_lo_counts"] = [window.lo for window in self.windows]
            found["key_hi_counts"] = [window.hi for window in self.windows]
        return found


def plan_windows(
    rule: WindowRule, count: int, read: Callable[[int], Counts], *, sample_frames: int = 32
) -> WindowPlan:
    """Make `rule` ready for a sequence of `count` frames.

    `read(i)` gives frame i's counts, H x W uint8 or uint16. It is called from this thread only, in
    ascending order, and only for percentiles: over the sequence for `sample_frames` frames, the
    middles of as many equal parts (all frames where there are fewer); running for every tenth frame
    and the last. Only histograms are kept, one at a time. A sample for which `read` raises
    `FrameError` is passed over and named in the plan's `skipped`. Raises `InputError` where there is
    no frame, none of the samples can be read, or their types differ.

    A running window's key values are smoothed over neighbouring keys with weights 1/4, 1/2, 1/4 (3/4,
    1/4 at the ends) and interpolated linearly in between. With keys at least five frames apart, no
    limit moves by more than a tenth of the spread of its key values from one frame to the next.
    """
    if count < 1:
        raise InputError("no thermal frames to take a window from")
    if sample_frames < 1:
        raise ValueError(f"expected at least one sample frame, got {sample_frames}")
    if rule.unit != "percentile" or rule.over == "frame":
        return WindowPlan(rule)
    if rule.over == "running":
        samples = _Samples(_key_frames(count), read)
        windows = _smooth([_percentile_window(histogram, rule) for histogram in samples])
        keys = tuple(samples.used)
    else:
        samples = _Samples(_spread(count, sample_frames), read)
        windows, keys = (_percentile_window(_pool(samples), rule),), (0,)
    return WindowPlan(rule, keys, windows, tuple(samples.used), samples.dtype, tuple(samples.skipped))


class _Samples:
    """The histograms of some frames, one after the other, and what became of each frame."""

    def __init__(self, wanted: Sequence[int], read: Callable[[int], Counts]) -> None:
        self._wanted, self._read = wanted, read
        self.used: list[int] = []
        self.skipped: list[str] = []
        self.dtype: str | None = None

    def __iter__(self) -> Iterator[NDArray[np.int64]]:
        for i in self._wanted:
            try:
                counts = self._read(i)
                _check_pixels(counts, i)
            except FrameError as error:
                self.skipped.append(str(error))
                continue
            self._same_type(i, counts.dtype.name)
            self.used.append(i)
            yield _histogram(counts)
        if not self.used:
            what = f"none of the {len(self.skipped)} thermal frames looked at can be read"
            raise InputError(what, hint=f"the first: {self.skipped[0]}")

    def _same_type(self, i: int, dtype: str) -> None:
        if self.dtype not in (None, dtype):
            what = f"thermal frame {self.used[0]} is {self.dtype}, frame {i} is {dtype}: no window fits both"
            hint = "keep 8-bit and 16-bit images apart, or take --window-unit fraction"
            raise InputError(what, hint=hint)
        self.dtype = dtype


def _spread(count: int, samples: int) -> list[int]:
    """The middles of `samples` equal parts of the sequence, in whole numbers; all of a short one."""
    if count <= samples:
        return list(range(count))
    return [(2 * k + 1) * count // (2 * samples) for k in range(samples)]


def _key_frames(count: int) -> list[int]:
    """0, 10, 20, … and the last; a key that close to the last would let the window jump gives way."""
    keys, last = list(range(0, count, KEY_STEP)), count - 1
    if len(keys) > 1 and last - keys[-1] < KEY_STEP // 2:
        keys.pop()
    return keys if keys[-1] == last else [*keys, last]


def _smooth(keys: Sequence[Window]) -> tuple[Window, ...]:
    """Weights 1/4, 1/2, 1/4; an end counts twice. Written so that equal keys stay exactly equal."""
    padded = [keys[0], *keys, keys[-1]]
    return tuple(
        Window(b.lo + ((a.lo - b.lo) + (c.lo - b.lo)) / 4, b.hi + ((a.hi - b.hi) + (c.hi - b.hi)) / 4)
        for a, b, c in zip(padded, padded[1:], padded[2:], strict=False)
    )


def _check_pixels(counts: Counts, i: int) -> None:
    if counts.ndim != 2 or counts.dtype not in (np.uint8, np.uint16) or counts.size == 0:
        what = f"expected HxW uint8 or uint16 thermal counts, got {counts.shape} {counts.dtype}"
        raise FrameError(what, where=f"frame {i}")


def _fixed_window(rule: WindowRule, counts: Counts, i: int) -> Window:
    top = int(np.iinfo(counts.dtype).max)
    lo, hi = rule.to_counts(top)
    if lo >= top or hi <= 0:
        what = f"the window, {lo:g} to {hi:g} counts, lies outside {counts.dtype.name}'s 0 to {top}"
        raise FrameError(what, where=f"frame {i}", hint="see --window and --window-unit")
    return Window(lo, hi)


def _histogram(counts: Counts) -> NDArray[np.int64]:
    return np.bincount(counts.ravel(), minlength=int(np.iinfo(counts.dtype).max) + 1)


def _pool(histograms: Iterable[NDArray[np.int64]]) -> NDArray[np.int64]:
    pooled = np.zeros(1, np.int64)
    for histogram in histograms:
        pooled = pooled + histogram
    return pooled


def _percentile_window(histogram: NDArray[np.int64], rule: WindowRule) -> Window:
    cumulative = np.cumsum(histogram)
    lo, hi = _percentile(cumulative, rule.lo), _percentile(cumulative, rule.hi)
    if hi - lo < _NARROWEST:  # flat: its one value goes to the middle of the colour map
        middle = (lo + hi) / 2
        return Window(middle - 0.5, middle + 0.5)
    return Window(lo, hi)


def _percentile(cumulative: NDArray[np.int64], percent: float) -> float:
    """Between the two pixels around rank percent/100 * (n - 1), linearly, in numpy's order of steps."""
    rank = (int(cumulative[-1]) - 1) * (percent / 100)
    below = math.floor(rank)
    above = min(below + 1, int(cumulative[-1]) - 1)
    a, b = (int(value) for value in np.searchsorted(cumulative, [below, above], side="right"))
    t = rank - below
    return b - (b - a) * (1 - t) if t >= 0.5 else a + (b - a) * t


def equalise(index: NDArray[np.uint8], clip_limit: float, tiles: int = 8) -> NDArray[np.uint8]:
    """Contrast-limited adaptive histogram equalisation (CLAHE) of the windowed index image.

    `index` is H x W uint8 and is left alone; the result has its shape. The image is cut into `tiles` x
    `tiles` parts; `clip_limit` bounds the contrast in multiples of a flat histogram's bin. May be
    called from several threads. Raises `UsageError` for limits that cannot be right.
    """
    if index.ndim != 2 or index.dtype != np.uint8:
        raise ValueError(f"expected an HxW uint8 index image, got {index.shape} {index.dtype}")
    if not (math.isfinite(clip_limit) and clip_limit > 0):
        raise UsageError(f"expected a clip limit above 0, got {clip_limit}", where="--clahe", hint="try 2")
    if not 1 <= tiles <= 64:
        raise UsageError(f"expected 1 to 64 tiles a side, got {tiles}", where="--clahe", hint="try 8")
    own = cv2.createCLAHE(clip_limit, (tiles, tiles))  # it keeps buffers: one object must not be shared
    return np.asarray(own.apply(index), dtype=np.uint8)


def clip_advice(below: float, above: float, rule: WindowRule) -> str | None:
    """One sentence where more than a third of the thermal pixels is clipped, otherwise None.

    `below` and `above` are shares [0, 1] of all pixels; it names them and the option to try.
    """
    share = below + above
    if share <= _ADVISE_ABOVE:
        return None
    found = f"{share:.0%} of the thermal pixels lie outside the window ({below:.0%} below, {above:.0%} above)"
    return f"{found}: {_better_option(rule)}"


def _better_option(rule: WindowRule) -> str:
    if rule.unit != "percentile":
        return "try --preset auto, or a wider --window"
    if rule.hi - rule.lo < 100 * (1 - _ADVISE_ABOVE):
        return "try wider percentiles, such as --window 1 99 --window-unit percentile"
    if rule.over == "sequence":
        return "the scene changes along the sequence, try --window-over running"
    return "try a wider --window, or --window-over frame, which may flicker"
