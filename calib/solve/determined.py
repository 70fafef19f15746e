"""What the data do not determine, in words: from the covariance's worst directions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.solve.blocks import Block
from calib.solve.cameras import corner_radius, effect_powers, parameter_names
from calib.solve.normal import inverse
from calib.solve.state import Layout, State
from fusion.errors import InputError
from fusion.geometry import FisheyeCamera, Floats, PinholeCamera

# A standard deviation beyond these is no knowledge: shares of the focal length and of the picture, radians
# (and translations over the boards' distance), seconds; and of a radius in the picture's corner.
_FOCAL, _CENTRE, _ANGLE, _TIME_S, _CORNER = 0.02, 0.25, 0.05, 0.1, 0.02
_SHARE = 0.3  # of the largest component: what else takes part in a direction
_ALIKE_RAD = np.radians(5)


def check_determined(layout: Layout, state: State, information: Floats) -> None:
    """`InputError` that names the parameters which the data leave open, and says what to record.

    `information` (free, free) is the inverse of the covariance. In units of what would be no knowledge, its
    eigenvectors with eigenvalues below 1 are the combinations that are not determined. Distortion is left
    out, after elimination: its prior holds it.
    """
    limits = _limits(layout, state)
    rows, rest = np.flatnonzero(np.isfinite(limits)), np.flatnonzero(np.isinf(limits))
    S = information[np.ix_(rows, rows)]
    if rest.size:
        mixed = information[np.ix_(rows, rest)]
        S = S - mixed @ inverse(information[np.ix_(rest, rest)]) @ mixed.T
    values, vectors = np.linalg.eigh(S * np.outer(limits[rows], limits[rows]))
    parts = np.abs(vectors[:, values < 1])
    if parts.size:
        involved = rows[(parts > _SHARE * parts.max(0)).any(1)]
        names = [layout.free_names[i] for i in involved]
        hint = "; ".join(dict.fromkeys(_advice(layout, name) for name in names))
        raise InputError(f"the data do not determine {', '.join(names)}", hint=hint)


def check_angles(layout: Layout, state: State, blocks: Sequence[Block]) -> None:
    """`InputError` where every camera is a pinhole of free focal length to which all boards were parallel: in
    theory they say no more than one of them (Zhang 2000, section 4), and the rest is noise.
    """
    alike: dict[str, str] = {}
    for block in (b for b in blocks if b.kind == "px"):
        name, views = block.sensor, len(block.moments)
        normals = state.boards[block.moments, :3, 2] @ state.T[name][:3, :3]
        middle = normals.mean(0) / np.linalg.norm(normals.mean(0))
        angle = float(np.arccos(np.clip(normals @ middle, -1, 1)).max())
        free = {f"{name}.fx", f"{name}.fy"} & set(layout.free_names)
        if not free or isinstance(layout.cameras[name], FisheyeCamera) or angle > _ALIKE_RAD:
            return
        seen = "the only view" if views == 1 else f"all {views} views (to {np.degrees(angle):.1f} degrees)"
        alike[f"{', '.join(sorted(free))}: one tilt of the board in {seen}"] = _advice(layout, f"{name}.fx")
    if alike:
        raise InputError(f"the data do not determine {'; '.join(alike)}", hint="; ".join(alike.values()))


def poorly_told_apart(layout: Layout, covariance: Floats) -> list[str]:
    """Notes on distortion coefficients that are known in combination only, if at all."""
    spread = dict(zip(layout.free_names, np.sqrt(np.diag(covariance)), strict=True))
    notes = []
    for name, camera in layout.cameras.items():
        effect = corner_radius(camera) ** effect_powers(camera)
        loose = [
            p
            for p, at_corner, power in zip(
                parameter_names(camera), effect, effect_powers(camera), strict=True
            )
            if power and spread.get(f"{name}.{p}", 0.0) * at_corner > _CORNER
        ]
        if loose:
            what = (
                "only their combination is known, which is what projects"
                if len(loose) > 1
                else "loosely known"
            )
            rational = isinstance(camera, PinholeCamera) and len(camera.distortion) == 8
            hint = " (8 coefficients: take 5 unless the residuals need them)" if rational else ""
            notes.append(f"{name}: {', '.join(loose)} poorly determined, {what}{hint}")
    return notes


def _limits(layout: Layout, state: State) -> Floats:
    """(free,) the standard deviation at which a parameter counts as unknown; inf for distortion."""
    limits = np.full(len(layout.names), np.inf)
    for sensor in {*layout.cameras, *layout.posed, *layout.timed}:
        for column in layout.columns(sensor):
            limits[column] = _limit(layout, state, sensor, layout.names[column].rpartition(".")[2])
    return limits[layout.free]


def _limit(layout: Layout, state: State, sensor: str, what: str) -> float:
    if what in ("fx", "fy"):
        return _FOCAL * float(state.camera[sensor][0])
    if what in ("cx", "cy"):
        return _CENTRE * layout.cameras[sensor].size_wh[what == "cy"]
    if what in ("rx", "ry", "rz"):
        return _ANGLE
    if what in ("tx", "ty", "tz"):
        return _ANGLE * float(np.median(np.linalg.norm(state.boards[:, :3, 3], axis=1)))
    return _TIME_S if what == "time_offset_s" else np.inf


def _advice(layout: Layout, name: str) -> str:
    owner, _, what = name.rpartition(".")
    if what == "time_offset_s":
        return f"record a board that moves before {owner} and {layout.start.reference}, or give the offset"
    if owner in layout.cameras:
        tilts = "tilted 20 to 45 degrees both ways, near and far"
        return f"record at least 10 views of {owner} with the board {tilts}"
    sensor = owner.removeprefix(f"T_{layout.start.reference}_")
    if sensor in layout.cameras:
        return f"record moments at which {layout.start.reference} and {sensor} both see the board"
    return f"record the board before {sensor} turned in at least 3 directions, its rim in sight"
