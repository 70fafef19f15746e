"""LiDAR depth: projection, gaps filled, start-up; against Open3D and SciPy on the same points."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from table import Row, Section, at_least, at_most, milliseconds
from timing import Job, Sample, interleaved, repeated
from workspace import FUSION, Workspace, run_clocked

from fusion.clouds import write_pcd
from fusion.frames import PointCloud
from fusion.geometry import PinholeCamera, pose
from fusion.lidar.densify import Demand, densifier
from fusion.lidar.occlusion import occluded
from fusion.lidar.project import project, z_buffer
from fusion.lidar.sparse import SparseDepth
from fusion.open3d import load

THREADS = 2
VGA = PinholeCamera.of_fov((640, 480), 120)
STREET = PinholeCamera((1242, 375), 721.5, 721.5, 609.6, 172.9)  # KITTI's camera 2
T_STREET_LIDAR = pose([[0, -1, 0], [0, 0, -1], [1, 0, 0]], [0.0, -0.08, -0.27])

TEXT = """\
Scans are cast by the benchmark into boxes with planes around them, with 2 cm of noise: a drift (64 rings
over 45 degrees; a virtual 120-degree camera of 640x480) and a street (64 rings over 27 degrees,
2048 columns; KITTI's camera of 1242x375, {street} samples). *{threads} threads* where a method shares out its
rows. Open3D's is `PointCloud.project_to_depth_image`, SciPy's `LinearNDInterpolator` evaluated at every
pixel, its triangulation included. `natural` is exact (Sibson's, `scatteredInterpolant`'s); `natural-discrete`
is its raster form, which the target is for."""


def measure(rounds: int) -> Section:
    big, drift, street = drift_scan(2048), project(drift_scan(1024), VGA), _street()
    jobs: dict[str, Job] = {
        "project": repeated(lambda: z_buffer(project(big, VGA)), 20),
        "open3d": repeated(_open3d(big), 3),
        "scan": repeated(partial(_fill, "scan", drift), 20),
        "natural-discrete": repeated(partial(_fill, "natural-discrete", drift), 5),
        "natural": repeated(partial(_fill, "natural", drift), 1),
        "linear": repeated(partial(_fill, "linear", street), 1),
        "plane": repeated(partial(_fill, "plane", street), 3),
        "plane-fast": repeated(partial(_fill, "plane-fast", street), 3),
        "plane drift": repeated(partial(_fill, "plane", drift), 3),
        "occluded": repeated(lambda: occluded(street), 5),
        "scipy": repeated(partial(_scipy, street), 1),
    }
    taken = interleaved(jobs, rounds)
    text = TEXT.format(threads=THREADS, street=len(street))
    return Section("LiDAR", text, ("ours", "other"), _rows(taken))


def _rows(taken: dict[str, Sample]) -> list[Row]:
    def limit(what: str, name: str, most_ms: float | None) -> Row:
        if most_ms is None:
            return Row(what, milliseconds(taken[name]), note="for information")
        return Row(what, milliseconds(taken[name]), "", taken[name].per(1e-3), at_most(most_ms, " ms"))

    def against(what: str, other: str, name: str, least: float | None) -> Row:
        target = None if least is None else at_least(least)
        ratio = taken[other].over(taken[name])
        return Row(what, milliseconds(taken[name]), milliseconds(taken[other]), ratio, target)

    return [
        limit("projection and z-buffer, 131,072 points", "project", 0.5),
        against("the same, Open3D / ours", "open3d", "project", 5),
        limit("`scan` to 640x480", "scan", 0.8),
        limit("`natural-discrete` to 640x480", "natural-discrete", 12),
        limit("`natural`, exact, to 640x480", "natural", None),
        limit("`plane`, street frame", "plane", 30),
        against("the same, SciPy's linear / ours", "scipy", "plane", 3),
        limit("`plane-fast`, street frame", "plane-fast", None),
        limit("`plane` to 640x480, drift", "plane drift", None),
        against("`linear`, street frame: SciPy's / ours", "scipy", "linear", None),
        limit("hidden points of a scan, street frame", "occluded", None),
    ]


def measure_start(space: Workspace, rounds: int) -> list[Row]:
    """Whole processes: one small cloud to a depth map, machine code cached before."""
    path = space.root / "small.pcd"
    scan = drift_scan(64)
    write_pcd(path, scan)

    def run(method: str) -> float:
        command = [str(FUSION), "depth", str(path), "-o", str(space.fresh_out()), "--size", "64", "48"]
        return run_clocked([*command, "--method", method, "--quiet"])

    taken = interleaved({"scan": lambda: run("scan"), "plane": lambda: run("plane")}, rounds, warm=2)
    return [
        Row(f"`fusion depth` of one small cloud, `{name}`", "", "", sample, at_most(0.5, " s"))
        for name, sample in taken.items()
    ]


def drift_scan(columns: int, rings: int = 64) -> PointCloud:
    """A scan from the middle of a straight drift with a few boxes standing in it."""
    elevation = np.radians(np.linspace(-22.5, 22.5, rings) + 1e-3)
    boxes = [(6, 0.8, -1.5, 7, 1.6, 0.4), (9, -2.0, -1.5, 12, -0.8, 0.6), (4, -0.4, 1.2, 4.2, 0.4, 2.2)]
    return _scan(elevation, columns, ((-30, 60), (-2.3, 2.3), (-1.5, 2.5)), boxes)


def _street() -> SparseDepth:
    elevation = np.radians(np.linspace(-24.8, 2.0, 64))
    boxes = [(8 + 6 * k, 3 + (k % 3), -1.73, 12 + 6 * k, 5 + (k % 3), -0.2) for k in range(8)]
    boxes += [(12 + 9 * k, -6, -1.73, 12.4 + 9 * k, -5.6, 4) for k in range(6)]
    cloud = _scan(elevation, 2048, ((-80, 90), (-14, 14), (-1.73, 12)), boxes)
    sparse = project(cloud, STREET, T_STREET_LIDAR)
    return sparse.take(~occluded(sparse))


def _scan(elevation: NDArray[Any], columns: int, room: Any, boxes: Any) -> PointCloud:
    """Every ray's nearest hit with the room's walls or a box, ring by ring, with noise."""
    azimuth = np.linspace(-np.pi, np.pi, columns, endpoint=False) + 1e-4  # no ray along an axis
    up, turn = (a.ravel() for a in np.meshgrid(elevation, azimuth, indexing="ij"))
    ray = np.stack([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)], -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        walls = [np.where(ray[:, k] > 0, hi / ray[:, k], lo / ray[:, k]) for k, (lo, hi) in enumerate(room)]
        away = np.min(walls, axis=0)
        for box in boxes:
            lo, hi = np.array(box[:3]) / ray, np.array(box[3:]) / ray
            enter, leave = np.minimum(lo, hi).max(1), np.maximum(lo, hi).min(1)
            away = np.where((enter < leave) & (enter > 0), np.minimum(away, enter), away)
    away = away + np.random.default_rng(1).normal(0, 0.02, away.shape)
    ring = np.repeat(np.arange(len(elevation), dtype=np.int32), columns)
    return PointCloud((ray * away[:, None]).astype(np.float32), {"ring": ring})


def _fill(method: str, sparse: SparseDepth) -> object:
    return densifier(method)(sparse, Demand(threads=THREADS))


def _open3d(cloud: PointCloud) -> Callable[[], object]:
    o3d = load()
    points = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.asarray(cloud.xyz_m)))
    intrinsics, extrinsics = (
        o3d.core.Tensor(VGA.matrix()),
        o3d.core.Tensor(pose([[0, -1, 0], [0, 0, -1], [1, 0, 0]])),
    )
    return lambda: points.project_to_depth_image(
        640, 480, intrinsics, extrinsics, depth_scale=1.0, depth_max=255.0
    )


def _scipy(sparse: SparseDepth) -> object:
    from scipy.interpolate import LinearNDInterpolator

    w, h = sparse.size_wh
    columns, rows = np.meshgrid(np.arange(w), np.arange(h))
    return LinearNDInterpolator(np.stack([sparse.u, sparse.v], -1), sparse.value_m)(columns, rows)
