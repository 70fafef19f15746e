"""What the mine is made of.

Emissivities are for 8 to 14 um and lean on the tables in the manuals of FLIR's cameras (rough granite 0.77 to
0.97, water 0.96, wood 0.90, oil paint 0.94, oxidised steel 0.79, galvanised and oxidised 0.28 to 0.85, glass
0.97, skin and cloth 0.98). Albedos are linear, of dark and damp rock, worn paint and dirty cloth; lidar
reflectances are of the same surfaces at 905 nm, where retro-reflecting tape reads as 1. Temperatures are of a
mine in hard rock at moderate depth, with one machine just parked. None of albedo, reflectance and temperature
is a measurement.
"""

from __future__ import annotations

from fusion.simulate.mine.hits import Material

_GLOW = (7.0, 9.0, 10.0)

# name, albedo b g r, its spread, bump, tile m, degC, spread, emissivity, lidar
_TABLE = (
    ("rock", (0.125, 0.135, 0.145), 0.40, 0.55, 1.9, 12.0, 0.6, 0.95, 0.22),
    ("floor", (0.060, 0.076, 0.090), 0.45, 0.45, 1.3, 11.0, 0.5, 0.95, 0.13),
    ("muck", (0.135, 0.145, 0.155), 0.50, 0.65, 1.1, 12.6, 0.6, 0.94, 0.24),
    ("stone", (0.140, 0.150, 0.160), 0.40, 0.50, 0.9, 12.2, 0.5, 0.94, 0.24),
    ("water", (0.014, 0.018, 0.020), 0.15, 0.00, 2.0, 8.6, 0.2, 0.96, 0.02),
    ("timber", (0.095, 0.150, 0.210), 0.45, 0.35, 0.7, 12.8, 0.3, 0.90, 0.35),
    ("steel", (0.080, 0.085, 0.100), 0.40, 0.20, 0.5, 12.0, 0.2, 0.79, 0.25),
    ("plate", (0.230, 0.235, 0.235), 0.35, 0.12, 0.4, 11.8, 0.2, 0.60, 0.40),
    ("pipe", (0.150, 0.200, 0.270), 0.35, 0.12, 0.6, 41.0, 0.8, 0.90, 0.30),
    ("flange", (0.070, 0.080, 0.100), 0.35, 0.15, 0.4, 37.0, 0.6, 0.85, 0.25),
    ("duct", (0.040, 0.270, 0.400), 0.25, 0.18, 0.8, 9.2, 0.3, 0.93, 0.45),
    ("cable", (0.022, 0.022, 0.024), 0.20, 0.10, 0.3, 16.5, 0.5, 0.95, 0.06),
    ("paint", (0.030, 0.250, 0.420), 0.35, 0.10, 1.1, 20.0, 1.0, 0.94, 0.45),
    ("hood", (0.028, 0.230, 0.390), 0.35, 0.10, 0.9, 38.0, 2.5, 0.94, 0.45),
    ("frame", (0.045, 0.047, 0.050), 0.40, 0.20, 0.8, 19.0, 0.8, 0.88, 0.15),
    ("bucket", (0.110, 0.115, 0.125), 0.45, 0.25, 0.7, 13.5, 0.5, 0.75, 0.30),
    ("tyre", (0.022, 0.023, 0.025), 0.30, 0.40, 0.4, 25.0, 1.5, 0.95, 0.05),
    ("rim", (0.060, 0.150, 0.210), 0.45, 0.15, 0.5, 21.0, 0.8, 0.92, 0.30),
    ("glass", (0.015, 0.018, 0.018), 0.10, 0.00, 1.0, 16.0, 0.3, 0.92, 0.08),
    ("radiator", (0.035, 0.036, 0.038), 0.30, 0.30, 0.3, 66.0, 3.0, 0.92, 0.15),
    ("exhaust", (0.050, 0.055, 0.075), 0.40, 0.20, 0.3, 80.0, 3.0, 0.80, 0.20),
    ("reflector", (0.120, 0.120, 0.600), 0.05, 0.00, 0.2, 18.0, 0.2, 0.93, 1.00),
    ("lamp", (0.600, 0.600, 0.600), 0.00, 0.00, 0.2, 34.0, 0.5, 0.92, 0.60),
    ("skin", (0.190, 0.250, 0.380), 0.10, 0.05, 0.3, 33.5, 0.4, 0.98, 0.50),
    ("overall", (0.150, 0.070, 0.035), 0.25, 0.25, 0.3, 28.5, 0.8, 0.96, 0.35),
    ("vest", (0.040, 0.330, 0.620), 0.20, 0.20, 0.3, 27.0, 0.6, 0.95, 0.60),
    ("tape", (0.500, 0.500, 0.500), 0.10, 0.05, 0.1, 26.0, 0.3, 0.92, 1.00),
    ("helmet", (0.550, 0.560, 0.570), 0.10, 0.02, 0.3, 22.0, 0.4, 0.94, 0.75),
    ("boot", (0.030, 0.032, 0.035), 0.30, 0.15, 0.2, 20.5, 0.5, 0.95, 0.10),
)
_EMITS = {"lamp": _GLOW}

MATERIALS: tuple[Material, ...] = tuple(
    Material(*row[:8], emits_bgr=_EMITS.get(row[0], (0.0, 0.0, 0.0)), lidar_reflectance=row[8])
    for row in _TABLE
)
INDEX: dict[str, int] = {material.name: k for k, material in enumerate(MATERIALS)}
