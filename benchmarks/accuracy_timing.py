"""Clocks and frozen frames against the truth of simulated flights."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from table import grid

from fusion.codecs import decode_image
from fusion.errors import InputError
from fusion.simulate.mine.config import MineConfig
from fusion.simulate.mine.recording import make_mine
from fusion.timing.clock import LAG, ClockEstimate, estimate_clock
from fusion.timing.freeze import FreezeFinder, Run, frozen, frozen_runs
from fusion.timing.motion import Motion, MotionMeter

EPOCH_NS = 1_700_000_000 * 10**9
DURATION_S = 20.0
CLOCKS = 10  # drawn for each flight
WANTED_MS = 5.0

# RGB and thermal rate (Hz), seconds between corrections and frozen for one, time constant (ms), preset
FLIGHTS: Sequence[tuple[int, int, float, float, float, str]] = (
    (20, 25, 5.0, 0.40, 10.0, "clear"),
    (30, 10, 4.0, 0.40, 10.0, "clear"),
    (15, 30, 6.0, 0.80, 10.0, "clear"),
    (10, 25, 5.0, 0.30, 10.0, "clear"),
    (20, 25, 5.0, 0.40, 10.0, "dusty"),
    (20, 9, 5.0, 0.50, 10.0, "dark"),
    (20, 30, 3.0, 0.12, 0.0, "clear"),
    (20, 30, 3.0, 0.25, 20.0, "clear"),
)

TEXT = """\
{flights} flights of {duration:g} s (seeds {first} to {last}; the method was made with others), cameras of
160x120 and 160x128 pixels at different rates, with frozen frames; the thermal clock of each set {clocks}
times by a random offset of up to 1.9 s and a drift of up to 100 ppm. Errors of the offset are in the
middle of the recording, in milliseconds: median with its sign / 95th percentile / largest; wanted is
{wanted:g} ms. `stated` is told the sensor's time constant, `unknown` is told 0: what is left is what the
sensor's lag makes of it. The estimator takes {lag:g} of the time constant off."""
UNRELATED = """\
RGB of one flight with thermal of another, {count} times: {refused} refused, {taken} taken for one
recording. Of {all} true ones {lost} were refused. The drift's error was {drift:.0f} ppm (root mean
square; the stated sigma {sigma:.0f} ppm): {duration:g} s tell little of it. Over 10 minutes of drawn
motion (0.1 px of noise at 128 px) it was {long:.1f} ppm, the offset's {long_ms:.2f} ms."""
FREEZES = """\
The same flights' thermal frames, and the same in 8 bits, stretched from the 1st to the 99th percentile:
runs of three frames or more against `truth/freezes.csv`. `false` counts runs that are none."""


@dataclass(frozen=True, slots=True)
class Flight:
    """What is measured of one flight; stamps are true times."""

    rgb: Motion
    fir: Motion
    true: list[Run]
    found: list[Run]
    found_8bit: list[Run]
    time_constant_s: float
    name: str


def markdown(flights: int = len(FLIGHTS), seed: int = 100) -> str:
    """The section of the page."""
    with ThreadPoolExecutor(2) as pool, tempfile.TemporaryDirectory() as folder:
        jobs = [pool.submit(_fly, Path(folder) / str(k), seed + k, *FLIGHTS[k]) for k in range(flights)]
        flown = [job.result() for job in jobs]
    rng = np.random.default_rng(seed)
    return "\n\n".join(["### Clocks", *_clocks(flown, rng, seed), "### Frozen frames", *_freezes(flown)])


# --- flights


def _fly(
    out: Path,
    seed: int,
    rgb_hz: int,
    fir_hz: int,
    every_s: float,
    frozen_s: float,
    tau_ms: float,
    preset: str,
) -> Flight:
    settings: dict[str, Any] = {
        "rgb": {"rate_hz": rgb_hz, "camera": {"size_wh": [160, 120]}},
        "thermal": {
            "rate_hz": fir_hz,
            "camera": {"size_wh": [160, 128]},
            "clock": {"offset_s": EPOCH_NS / 1e9, "drift_ppm": 0.0},
            "ffc_interval_s": every_s,
            "ffc_freeze_s": frozen_s,
            "time_constant_ms": tau_ms,
        },
        "lidar": {"rate_hz": 0.1, "rings": 16, "columns": 64},
    }
    make_mine(
        out, MineConfig.of(settings, preset=preset, seed=seed, duration_s=DURATION_S, truth=False), threads=1
    )
    rgb, fir = (dict(_pictures(out / role)) for role in ("rgb", "fir"))
    still = (out / "truth" / "freezes.csv").read_text().split()[1:]
    repeats = {int(row.split(",")[0]) for row in still}
    name = f"{preset}, {rgb_hz} and {fir_hz} Hz, {tau_ms:g} ms"
    return Flight(
        _motion(rgb),
        _motion(fir),
        frozen_runs(np.array([stamp in repeats for stamp in fir]), 3),
        _found(list(fir.values())),
        _found(_stretched(list(fir.values()))),
        tau_ms / 1e3,
        name,
    )


def _pictures(folder: Path) -> Iterator[tuple[int, NDArray[Any]]]:
    for path in sorted(folder.iterdir()):
        yield int(path.stem), decode_image(path.read_bytes(), str(path))


def _motion(pictures: dict[int, NDArray[Any]]) -> Motion:
    meter = MotionMeter()
    for stamp_ns, pixels in pictures.items():
        meter.add(stamp_ns, pixels)
    return meter.motion()


def _found(frames: Sequence[NDArray[Any]]) -> list[Run]:
    finder = FreezeFinder()
    return frozen_runs(frozen([finder.add(pixels) for pixels in frames]), 3)


def _stretched(frames: Sequence[NDArray[Any]]) -> list[NDArray[Any]]:
    low, high = np.percentile(frames[0], [1, 99])
    return [np.clip((f - low) * (255 / (high - low)), 0, 255).astype(np.uint8) for f in frames]


# --- clocks


def _clocks(flown: Sequence[Flight], rng: np.random.Generator, seed: int) -> list[str]:
    rows, drifts, sigmas, lost = [], [], [], 0
    for flight in flown:
        cells, met = [], ""
        draws = [(rng.uniform(-1.9, 1.9), rng.uniform(-1e-4, 1e-4)) for _ in range(CLOCKS)]
        for tau_s in (flight.time_constant_s, 0.0):
            errors: list[float] = []
            for offset_s, drift in draws:
                found = _estimate(flight.rgb, _told(flight.fir, offset_s, drift), tau_s)
                if found is None:
                    lost += 1
                    continue
                errors.append(_error_ms(found, offset_s, drift))
                drifts.append(1e6 * (found.drift - (1 / (1 + drift) - 1)))
                sigmas.append(1e6 * found.drift_sigma)
            cells.append(_spread(errors))
            if len(cells) == 1:
                met = "met" if errors and max(map(abs, errors)) <= WANTED_MS else "**missed**"
        rows.append((flight.name, *cells, met))
    text = TEXT.format(
        flights=len(flown), duration=DURATION_S, first=seed, last=seed + len(flown) - 1, clocks=CLOCKS,
        wanted=WANTED_MS, lag=LAG,
    )  # fmt: skip
    table = grid(("flight, thermal time constant", "stated", "unknown", ""), rows)
    taken, count = _mixed(flown)
    long_ppm, long_ms = _long(rng)
    rest = UNRELATED.format(
        count=count, refused=count - taken, taken=taken, all=2 * CLOCKS * len(flown), lost=lost,
        drift=_rms(drifts), sigma=_rms(sigmas), duration=DURATION_S, long=long_ppm, long_ms=long_ms,
    )  # fmt: skip
    return [text, table, rest]


def _told(motion: Motion, offset_s: float, drift: float) -> Motion:
    """The same with stamps of another clock: own = true * (1 + drift) + offset."""
    true_ns = motion.stamps_ns - EPOCH_NS
    own_ns = true_ns + np.rint(true_ns * drift + offset_s * 1e9).astype(np.int64)
    return Motion(own_ns + EPOCH_NS, motion.shift_px)


def _estimate(rgb: Motion, fir: Motion, tau_s: float) -> ClockEstimate | None:
    try:
        return estimate_clock(rgb, fir, time_constant_s=tau_s)
    except InputError:
        return None


def _error_ms(found: ClockEstimate, offset_s: float, drift: float) -> float:
    own_s = (found.at_ns - EPOCH_NS) * 1e-9
    true_s = (own_s - offset_s) / (1 + drift)
    return found.offset_ns / 1e6 - 1e3 * (true_s - own_s)


def _spread(errors: Sequence[float]) -> str:
    if not errors:
        return "refused"
    off = np.abs(errors)
    return f"{np.median(errors):+.1f} / {np.percentile(off, 95):.1f} / {off.max():.1f}"


def _mixed(flown: Sequence[Flight]) -> tuple[int, int]:
    """How many of how many pairs that do not belong together are taken to."""
    pairs = [(a, b) for a in flown for b in flown if a is not b]
    taken = [_estimate(a.rgb, _told(b.fir, at_s, 0.0), 0.01) for a, b in pairs for at_s in (-3.0, 0.0, 3.0)]
    return sum(found is not None for found in taken), len(taken)


def _long(rng: np.random.Generator, runs: int = 5) -> tuple[float, float]:
    """Root mean square error of drift (ppm) and offset (ms) of ten minutes of drawn motion."""
    drifts, offsets = [], []
    for _ in range(runs):
        hz, phase = rng.uniform(0.1, 2.0, (20, 2)), rng.uniform(0, 2 * np.pi, (20, 2))
        size = 2 * rng.uniform(0.5, 1.0, (20, 2)) / (1 + 2 * hz)  # no one of them rules
        motions = []
        for rate_hz in (20, 25):
            t = np.arange(0, 600, 1 / rate_hz)
            way = (size * np.sin(2 * np.pi * hz * t[:, None, None] + phase)).sum(1)
            shift = np.diff(way, axis=0) + rng.normal(0, 0.1, (len(t) - 1, 2))
            motions.append(Motion(EPOCH_NS + np.rint(t * 1e9).astype(np.int64), shift))
        offset_s, drift = rng.uniform(-1.9, 1.9), rng.uniform(-1e-4, 1e-4)
        found = estimate_clock(motions[0], _told(motions[1], offset_s, drift), time_constant_s=0.0)
        drifts.append(1e6 * (found.drift - (1 / (1 + drift) - 1)))
        offsets.append(_error_ms(found, offset_s, drift))
    return _rms(drifts), _rms(offsets)


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


# --- frozen frames


def _freezes(flown: Sequence[Flight]) -> list[str]:
    rows = []
    for flight in flown:
        cells = [_judged(flight.true, found) for found in (flight.found, flight.found_8bit)]
        rows.append((flight.name, str(len(flight.true)), *cells))
    return [
        FREEZES,
        grid(("flight", "runs", "16 bits: found, missed, false", "8 bits: found, missed, false"), rows),
    ]


def _judged(true: Sequence[Run], found: Sequence[Run]) -> str:
    """A run is found where it begins and ends as it truly does."""
    return f"{len({*true} & {*found})}, {len({*true} - {*found})}, {len({*found} - {*true})}"


if __name__ == "__main__":
    print(markdown())
