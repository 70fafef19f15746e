"""Counts to degrees and back: the formula written out again, its limits, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion.radiometric import Planck
from tests.radiometric.flirfile import CONSTANTS

CAMERA = Planck(**CONSTANTS)


def forward(c: Planck, celsius: float) -> float:
    """What the camera measures of an object, step by step along the ray, from first principles."""
    black = lambda kelvin: c.r1 / c.r2 / (math.exp(c.b / kelvin) - c.f)  # noqa: E731 - without the offset
    t = c.atmosphere_k - 273.15
    water = c.humidity * math.exp(1.5587 + 6.939e-2 * t - 2.7816e-4 * t**2 + 6.8455e-7 * t**3)
    air = c.x * math.exp(-math.sqrt(c.distance_m) * (c.alpha1 + c.beta1 * math.sqrt(water)))
    air += (1 - c.x) * math.exp(-math.sqrt(c.distance_m) * (c.alpha2 + c.beta2 * math.sqrt(water)))
    leaves = c.emissivity * black(celsius + 273.15) + (1 - c.emissivity) * black(c.reflected_k)
    arrives = air * leaves + (1 - air) * black(c.atmosphere_k)
    through = c.window_transmission * arrives + (1 - c.window_transmission) * black(c.window_k)
    return through - c.o


cameras = st.builds(
    lambda f, e, d, refl, air, window, w, h: replace(
        CAMERA,
        f=f,
        emissivity=e,
        distance_m=d,
        reflected_k=refl,
        atmosphere_k=air,
        window_k=window,
        window_transmission=w,
        humidity=h,
    ),
    st.floats(0.5, 1.5),
    st.floats(0.1, 1),
    st.floats(0, 100),
    *[st.floats(250, 320)] * 3,
    st.floats(0.5, 1),
    st.floats(0, 1),
)


@given(cameras, st.floats(-30, 300))
def test_counts_are_those_of_the_ray_and_come_back(camera: Planck, celsius: float) -> None:
    counts = camera.counts_at(celsius)
    assert counts == pytest.approx(forward(camera, celsius), rel=1e-12)
    assert camera.celsius(np.array([counts]))[0] == pytest.approx(celsius, abs=1e-3)


@settings(max_examples=15)
@given(cameras)
def test_every_count_comes_back_exactly(camera: Planck) -> None:
    counts = np.arange(0, 65536, 211, dtype=np.uint16)
    celsius = camera.celsius(counts)
    assert celsius.dtype == np.float32
    told = np.isfinite(celsius)
    assert told[counts > 20000].all()
    assert (np.diff(celsius[told]) > 0).all()
    back = [round(camera.counts_at(float(degc))) for degc in celsius[told]]
    assert back == counts[told].tolist()


def test_a_black_body_right_before_the_camera_needs_nothing_but_planck() -> None:
    plain = replace(CAMERA, emissivity=1.0, distance_m=0.0, window_transmission=1.0)
    assert plain.transmission == 1
    assert plain.counts_at(30) == plain.signal(303.15)
    # surroundings and air play no part then
    other = replace(plain, reflected_k=400.0, atmosphere_k=250.0, window_k=400.0)
    assert other.counts_at(30) == pytest.approx(plain.counts_at(30), rel=1e-14)


def test_below_what_surroundings_alone_give_there_is_no_temperature() -> None:
    camera = replace(CAMERA, emissivity=0.1, o=0.0)
    celsius = camera.celsius(np.array([[0, 60000]], np.uint16))
    assert np.isnan(celsius[0, 0])
    assert celsius[0, 1] > 100


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("emissivity", 0.0),
        ("emissivity", 1.01),
        ("emissivity", math.nan),
        ("window_transmission", 0.0),
        ("r1", 0.0),
        ("r2", 0.0),
        ("b", math.inf),
        ("distance_m", -1.0),
        ("atmosphere_k", 0.0),
        ("reflected_k", 0.0),
        ("humidity", 49.0),
        ("x", -1e30),
    ],
)
def test_constants_that_tell_no_temperature_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        replace(CAMERA, **{name: value})


def test_air_that_lets_nothing_through_is_refused() -> None:
    with pytest.raises(ValueError, match="arrives"):
        replace(CAMERA, alpha1=1.0, alpha2=0.5, distance_m=1e5)


def test_constants_that_lead_beyond_all_numbers_are_refused() -> None:
    with pytest.raises(ValueError, match="beyond all numbers"):
        replace(CAMERA, alpha1=-1.0, beta1=-1.0, distance_m=1e5)


def test_near_absolute_zero_nothing_is_sent() -> None:
    plain = replace(CAMERA, emissivity=1.0, distance_m=0.0, window_transmission=1.0)
    assert plain.counts_at(-273.149) == 4405
    assert plain.counts_at(-271) == pytest.approx(4405)


@pytest.mark.parametrize("celsius", [-273.15, -300.0, math.nan, math.inf])
def test_no_temperature(celsius: float) -> None:
    with pytest.raises(ValueError, match="no temperature"):
        CAMERA.counts_at(celsius)
