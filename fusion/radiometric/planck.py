"""Counts to degrees Celsius, and back, by the constants that a FLIR camera writes into its images.

The camera's signal for a black body of temperature T is S(T) = R1 / (R2 (exp(B / T) - F)) - O (the Planck
constants as ExifTool's documentation names them). What it sees of an object is, with emissivity e,
transmission of the air a and of an external window w,

    counts = w (a (e S(object) + (1 - e) S(reflected)) + (1 - a) S(air)) + (1 - w) S(window),

the measurement formula in FLIR's user manuals, with the window (external optics) right before the lens. With
distance d in metres and water in g/m3, from humidity and temperature, the air lets through

    a = X exp(-sqrt(d) (alpha1 + beta1 sqrt(water))) + (1 - X) exp(-sqrt(d) (alpha2 + beta2 sqrt(water))).

Published conversions that put the window half-way, with sqrt(d / 2) on either side of it, let the air take
more off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

KELVIN_AT_ZERO_CELSIUS = 273.15
_WATER = (1.5587, 0.06939, -0.00027816, 0.00000068455)  # ln(g/m3 at saturation), powers of degrees Celsius


@dataclass(frozen=True, slots=True)
class Planck:
    """The constants of one radiometric image.

    `r1`, `r2`, `b` (kelvin), `f`, `o` (counts) describe the camera; `emissivity` (0, 1] the object and
    `distance_m` how far it is; `reflected_k`, `atmosphere_k`, `window_k` are temperatures in kelvin;
    `window_transmission` (0, 1], `humidity` [0, 1]; `alpha1` to `x` describe the air. Raises `ValueError` for
    values with which no temperature could be told.
    """

    r1: float
    r2: float
    b: float
    f: float
    o: float
    emissivity: float
    distance_m: float
    reflected_k: float
    atmosphere_k: float
    window_k: float
    window_transmission: float
    humidity: float
    alpha1: float
    alpha2: float
    beta1: float
    beta2: float
    x: float

    def __post_init__(self) -> None:
        for field in fields(self):
            if not math.isfinite(getattr(self, field.name)):
                raise ValueError(f"{field.name} is {getattr(self, field.name)}")
        for name in ("emissivity", "window_transmission"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name):g}, expected more than 0, at most 1")
        for name, least, most in _RANGES:
            if not least <= getattr(self, name) <= most:
                raise ValueError(f"{name} is {getattr(self, name):g}, expected {least:g} to {most:g}")
        try:
            gain, rest = self._path()
        except ArithmeticError as error:
            raise ValueError("they lead beyond all numbers") from error
        if not (math.isfinite(rest) and 1e-3 <= gain <= 2):
            raise ValueError(f"only {gain:g} of what the object sends arrives")

    @property
    def transmission(self) -> float:
        """The share of the object's radiation that the air lets through."""
        degc = self.atmosphere_k - KELVIN_AT_ZERO_CELSIUS
        water = self.humidity * math.exp(sum(c * degc**power for power, c in enumerate(_WATER)))
        root, wet = math.sqrt(self.distance_m), math.sqrt(water)
        first = math.exp(-root * (self.alpha1 + self.beta1 * wet))
        second = math.exp(-root * (self.alpha2 + self.beta2 * wet))
        return self.x * first + (1 - self.x) * second

    def signal(self, kelvin: float) -> float:
        """The counts of a black body at `kelvin`, right in front of the camera."""
        if self.b / kelvin > 700:  # near absolute zero, where nothing is sent
            return -self.o
        return self.r1 / (self.r2 * (math.exp(self.b / kelvin) - self.f)) - self.o

    def _path(self) -> tuple[float, float]:
        """What the object's signal is multiplied by on its way, and what is added."""
        e, a, w = self.emissivity, self.transmission, self.window_transmission
        reflected, air, window = map(self.signal, (self.reflected_k, self.atmosphere_k, self.window_k))
        return w * a * e, w * (a * (1 - e) * reflected + (1 - a) * air) + (1 - w) * window

    def celsius(self, counts: NDArray[np.generic]) -> NDArray[np.float32]:
        """Degrees Celsius of counts, float32 of the same shape; NaN far below the camera's range.

        There less came in than surroundings and air send by themselves.
        """
        gain, rest = self._path()
        signal = (np.asarray(counts, np.float64) - rest) / gain + self.o
        with np.errstate(all="ignore"):
            kelvin = self.b / np.log(self.r1 / (self.r2 * signal) + self.f)
        kelvin = np.where((signal > 0) & (kelvin > 0) & np.isfinite(kelvin), kelvin, np.nan)
        return (kelvin - KELVIN_AT_ZERO_CELSIUS).astype(np.float32)

    def counts_at(self, celsius: float) -> float:
        """The counts, not rounded, that an object of this temperature gives. Raises `ValueError`.

        The inverse of `celsius`; it may lie outside 0 to 65535.
        """
        kelvin = celsius + KELVIN_AT_ZERO_CELSIUS
        if not kelvin > 0 or not math.isfinite(kelvin):
            raise ValueError(f"no temperature: {celsius} degC")
        gain, rest = self._path()
        return gain * self.signal(kelvin) + rest


# Far wider than any camera's, and narrow enough that no step above leaves the floats.
_RANGES = (
    ("r1", 1e-3, 1e9),
    ("r2", 1e-9, 1e6),
    ("b", 100.0, 1e4),
    ("f", 0.0, 10.0),
    ("distance_m", 0.0, 1e5),
    ("reflected_k", 30.0, 5000.0),
    ("atmosphere_k", 150.0, 500.0),
    ("window_k", 30.0, 5000.0),
    ("humidity", 0.0, 1.0),
    ("alpha1", -1.0, 1.0),
    ("alpha2", -1.0, 1.0),
    ("beta1", -1.0, 1.0),
    ("beta2", -1.0, 1.0),
    ("x", -10.0, 10.0),
)
