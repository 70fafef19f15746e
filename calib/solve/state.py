"""What the solver turns, and its names in a row: cameras, sensors' poses, time offsets, boards' poses."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.solve.cameras import corner_radius, effect_powers, parameter_names, parameters, with_parameters
from calib.solve.estimate import Estimate
from calib.solve.motion import moved
from fusion.geometry import Floats

# One standard deviation of what a single distortion coefficient may do to the radius in the picture's corner,
# as a share of that radius: several times what lenses do. It speaks where data do not: the rational's six.
_CORNER_PRIOR = 1.0
POSE = ("rx", "ry", "rz", "tx", "ty", "tz")


@dataclass(frozen=True, slots=True)
class State:
    """One guess at everything: `camera` (P,) parameters and `T` (4, 4) T_ref_sensor by name, `offset_s` by
    name, `boards` (M, 4, 4) T_ref_board by moment."""

    camera: Mapping[str, Floats]
    T: Mapping[str, Floats]
    offset_s: Mapping[str, float]
    boards: Floats


class Layout:
    """The shared parameters in a row: intrinsics, then T_ref_sensor, then time offsets; which are free.

    `names` (all of them), `free` bool of each; `columns(sensor)` are a sensor's own, in the order intrinsics,
    pose, offset. `prior` is the information (1 / variance) that each free one has without any data.
    """

    def __init__(
        self, start: Estimate, sensors: Sequence[str], moments: Sequence[str], fixed: Collection[str]
    ) -> None:
        self.start, self.moments = start, tuple(moments)
        self.cameras = {name: start.cameras[name] for name in sensors if name in start.cameras}
        self.posed = tuple(name for name in sensors if name != start.reference)
        self.timed = tuple(name for name in sensors if name in start.time_offset_s)
        self._slices: dict[tuple[str, str], slice] = {}
        names: list[str] = []
        for sensor, camera in self.cameras.items():
            self._append(names, ("camera", sensor), [f"{sensor}.{p}" for p in parameter_names(camera)])
        for sensor in self.posed:
            self._append(names, ("T", sensor), [f"{self.transform(sensor)}.{p}" for p in POSE])
        for sensor in self.timed:
            self._append(names, ("offset", sensor), [f"{sensor}.time_offset_s"])
        self.names = tuple(names)
        self.free = np.array([not self._held(name, fixed) for name in names], bool)
        self.position = np.cumsum(self.free) - 1
        self.free_names = tuple(name for name, free in zip(names, self.free, strict=True) if free)
        self.prior = self._prior()[self.free]

    def transform(self, sensor: str) -> str:
        return f"T_{self.start.reference}_{sensor}"

    def columns(self, sensor: str) -> NDArray[np.intp]:
        """Where a sensor's parameters stand in `names`."""
        spans = (self._slices.get((kind, sensor), slice(0, 0)) for kind in ("camera", "T", "offset"))
        return np.concatenate([np.arange(s.start, s.stop) for s in spans])

    def first_state(self) -> State:
        start = self.start
        return State(
            {name: parameters(camera) for name, camera in self.cameras.items()},
            {name: np.array(start.T_ref_sensor[name], np.float64) for name in (start.reference, *self.posed)},
            {name: float(start.time_offset_s[name]) for name in self.timed},
            np.stack([np.asarray(start.T_ref_board[m], np.float64) for m in self.moments]),
        )

    def moved(self, state: State, shared: Floats, boards: Floats) -> State:
        """The state after a step: (free,) of the shared parameters, (M, 6) of the boards."""
        step = np.zeros(len(self.names))
        step[self.free] = shared
        cameras = {n: v + step[self._slices["camera", n]] for n, v in state.camera.items()}
        poses = {
            n: moved(T, step[self._slices["T", n]]) if n in self.posed else T for n, T in state.T.items()
        }
        offsets = {n: s + float(step[self._slices["offset", n]][0]) for n, s in state.offset_s.items()}
        return State(cameras, poses, offsets, moved(state.boards, boards))

    def distortion_step(self, state: State) -> Floats:
        """(free,) how far each parameter with a prior is from it; the others' are zero."""
        away = np.zeros(len(self.names))
        for name, values in state.camera.items():
            away[self._slices["camera", name]] = np.where(effect_powers(self.cameras[name]) > 0, values, 0)
        return away[self.free]

    def estimate(self, state: State) -> Estimate:
        """The start with what took part in the solve replaced. Raises `UsageError` for impossible cameras."""
        start = self.start
        cameras = {n: with_parameters(self.cameras[n], v) for n, v in state.camera.items()}
        boards = dict(zip(self.moments, state.boards, strict=True))
        return replace(
            start,
            cameras={**start.cameras, **cameras},
            T_ref_sensor={**start.T_ref_sensor, **state.T},
            T_ref_board=boards,
            twist={m: start.twist[m] for m in self.moments if m in start.twist},
            time_offset_s={**start.time_offset_s, **state.offset_s},
        )

    def _append(self, names: list[str], key: tuple[str, str], new: list[str]) -> None:
        self._slices[key] = slice(len(names), len(names) + len(new))
        names += new

    def _held(self, name: str, fixed: Collection[str]) -> bool:
        owner, _, what = name.rpartition(".")
        if name in fixed:
            return True
        if what == "time_offset_s":  # a camera's name holds its intrinsics, a LiDAR's all it has
            return owner in fixed and owner not in self.cameras
        sensor = owner.removeprefix(f"T_{self.start.reference}_")
        return owner in fixed or (sensor in fixed and sensor not in self.cameras)

    def _prior(self) -> Floats:
        prior = np.zeros(len(self.names))
        for name, camera in self.cameras.items():
            powers = effect_powers(camera)
            spread = _CORNER_PRIOR / corner_radius(camera) ** powers
            prior[self._slices["camera", name]] = np.where(powers > 0, spread**-2, 0)
        return prior
