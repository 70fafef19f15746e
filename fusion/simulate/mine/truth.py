"""What is exactly true of a simulated recording, read back from the folder that `make_mine` wrote."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.codecs import decode_image
from fusion.errors import InputError, UsageError
from fusion.geometry import Floats
from fusion.rig import Rig, load_rig
from fusion.simulate.mine import layout
from fusion.simulate.mine.config import MineConfig, load_mine_config
from fusion.simulate.mine.motion import Clock


@dataclass(frozen=True, slots=True)
class Flow:
    """Where an RGB frame's pixels go in the next RGB frame.

    `uv_px` (H x W x 2 float32) is displacement to the right and down; `valid` (H x W bool) says where it is
    known, `occluded` (H x W bool) where its end lies outside the next frame or behind something.
    """

    uv_px: NDArray[np.float32]
    valid: NDArray[np.bool_]
    occluded: NDArray[np.bool_]


class Truth:
    """The truth of the recording in `folder`. Stamps are integer nanoseconds of the sensor's own clock.

    Everything raises `InputError` in one line where the folder has no truth, a file of it is missing or
    damaged, or a stamp is none of the sensor's; sensors are ``rgb``, ``fir``, ``lidar``.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._truth = self.folder / "truth"
        if not self._truth.is_dir():
            hint = "it is no recording of `fusion simulate mine`"
            raise InputError("there is no folder truth/ in it", where=self.folder, hint=hint)

    @cached_property
    def config(self) -> MineConfig:
        """The settings that were in effect, with the seed."""
        return load_mine_config(self._truth / "mine.toml")

    @cached_property
    def rig(self) -> Rig:
        """Both cameras, T_rgb_fir and T_rgb_lidar."""
        return load_rig(self._truth / "rig.toml")

    @cached_property
    def clocks(self) -> Mapping[str, Clock]:
        """Every sensor's clock."""
        return layout.read_clocks(self._truth / "clocks.toml")

    @cached_property
    def freezes(self) -> Mapping[int, int]:
        """Thermal stamps whose picture stands still, and the stamp of the picture that they repeat."""
        path = self._truth / "freezes.csv"
        try:
            return {int(row["stamp_ns"]): int(row["shown_stamp_ns"]) for row in layout.read_rows(path)}
        except (KeyError, TypeError, ValueError) as error:
            raise layout.unreadable(path, error) from None

    def stamps(self, sensor: str) -> list[int]:
        """All stamps of a sensor, rising."""
        return list(self._poses(sensor))

    def true_s(self, sensor: str, stamp_ns: int) -> float:
        """The true time of a stamp, seconds."""
        return self._row(sensor, stamp_ns)[0]

    def pose(self, sensor: str, stamp_ns: int) -> Floats:
        """T_world_sensor, 4 x 4 (a LiDAR's at the beginning of its scan)."""
        return self._row(sensor, stamp_ns)[1]

    def depth_m(self, camera: str, stamp_ns: int) -> NDArray[np.float32]:
        """Depth along z of every pixel of ``rgb`` or ``fir``, H x W, metres in steps of 1/256; 0 where there
        is none.
        """
        stored = self._image(f"depth_{self._camera(camera)}", camera, stamp_ns)
        return np.asarray(stored / np.float32(layout.DEPTH_PER_M), np.float32)

    def temperature_degC(self, stamp_ns: int) -> NDArray[np.float32]:  # noqa: N802 - the unit as it is written
        """Surface temperature at every thermal pixel, H x W degC in steps of 0.01 K; NaN where there is no
        surface.
        """
        stored = self._image("temperature_fir", "fir", stamp_ns)
        kelvin = stored.astype(np.float64) * layout.KELVIN_PER_STEP
        return np.where(stored > 0, kelvin - 273.15, np.nan).astype(np.float32)

    def flow(self, stamp_ns: int) -> Flow:
        """The flow of an RGB frame to the next one, in steps of 1/64 px. The last frame has none."""
        if stamp_ns == (self.stamps("rgb") or [None])[-1]:
            raise InputError(f"the last RGB frame, {stamp_ns}, has no flow", where=self.folder)
        stored = self._image("flow_rgb", "rgb", stamp_ns)  # BGR: validity, v, u
        if stored.ndim != 3:
            raise InputError("no flow in KITTI's form", where=self._truth / "flow_rgb" / f"{stamp_ns}.png")
        uv = (stored[..., :0:-1].astype(np.float32) - layout.FLOW_ZERO) / np.float32(layout.FLOW_PER_PX)
        valid = stored[..., 0] > 0
        uv[~valid] = 0
        return Flow(uv, valid, self._image("occluded_rgb", "rgb", stamp_ns) > 0)

    @cached_property
    def _tables(self) -> dict[str, dict[int, tuple[float, Floats]]]:
        return {}

    def _poses(self, sensor: str) -> dict[int, tuple[float, Floats]]:
        if sensor not in layout.SENSORS:
            raise UsageError(f"unknown sensor {sensor!r}", hint=f"one of: {', '.join(layout.SENSORS)}")
        if sensor not in self._tables:
            times, poses = layout.read_tum(self._truth / f"poses_{sensor}.tum")
            if sensor not in self.clocks:
                raise InputError(f"there is no clock of {sensor}", where=self._truth / "clocks.toml")
            stamps = [self.clocks[sensor].stamp_ns(float(t)) for t in times]
            self._tables[sensor] = {s: (float(t), T) for s, t, T in zip(stamps, times, poses, strict=True)}
        return self._tables[sensor]

    def _row(self, sensor: str, stamp_ns: int) -> tuple[float, Floats]:
        rows = self._poses(sensor)
        if stamp_ns not in rows:
            near = min(rows, key=lambda s: abs(s - stamp_ns)) if rows else "none"
            raise InputError(
                f"{sensor} has no stamp {stamp_ns}", where=self.folder, hint=f"the nearest is {near}"
            )
        return rows[stamp_ns]

    @staticmethod
    def _camera(name: str) -> str:
        if name not in ("rgb", "fir"):
            raise UsageError(f"unknown camera {name!r}", hint="one of: rgb, fir")
        return name

    def _image(self, kind: str, sensor: str, stamp_ns: int) -> NDArray[Any]:
        self._row(sensor, stamp_ns)
        path = self._truth / kind / f"{stamp_ns}.png"
        try:
            return decode_image(path.read_bytes(), str(path))
        except OSError as error:
            raise layout.unreadable(path, error) from None
