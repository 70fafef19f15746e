"""Depth from a map of a real mine, on points held out; and from a few samples and a picture."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from table import at_most, grid

from fusion.clouds import clouds_in, read_cloud
from fusion.geometry import T_CAM_LIDAR, Floats, PinholeCamera, invert, pose, transform
from fusion.lidar.densify import Demand, densifier
from fusion.lidar.project import from_image
from fusion.lidar.sparse import SparseDepth
from fusion.lidar.surfels import Surfels, surfels_of, visible_in_map

METHODS = ("plane", "plane-fast", "natural-discrete", "natural", "linear", "nearest")
CAMERA = PinholeCamera.of_fov((640, 480), 120)
STATIONS, HEIGHT_M, FREE_M = 12, 1.2, 0.8
HELD, LIMITS_M = 0.2, (1.0, 10.0)
EDGE_M, EDGE_SHARE, EDGE_PX = 0.3, 0.1, 4.0
WANTED_CM, WANTED_EDGE_CM = (30.0, 12.5), 23.0
WANTED_GUIDED_M = 1.77

MAP_TEXT = """\
The map of a real mine (Jinchuan, handheld scanner): {views} virtual 120-degree cameras of 640x480, {height:g}
m above the floor in the middle of its longest straight drift. A fifth of the visible points between {lo:g}
and {hi:g} m is held out ({points} points); errors of depth at their pixels in cm, RMSE / MAE. An edge is
where visible points within {px:g} pixels differ by more than {step:g} m + {share:.0%}. *Seen through*: hidden
points left in. Wanted: {wanted[0]:g} RMSE, {wanted[1]:g} MAE, {edge:g} at edges, read as MAE. Where the
cameras of those targets stood is not known. The points are held out of those that our visibility keeps, so a
stricter one would look better here without being so."""

GUIDED_TEXT = """\
One indoor scene of 640x480 with dense truth (`depth_dense`): 1000 samples, and 100 and 10 of these; RMSE /
MAE in metres over the pixels that have a truth. Wanted of `guided` with 1000: {wanted:g} m RMSE."""


def markdown(data: Path) -> str:
    """The sections of the page; a word where the data is not there."""
    return f"{_map_section(data / 'mine_lidar')}\n\n{_guided_section(data / 'depth_dense')}"


def _map_section(folder: Path) -> str:
    title = "### A map of a real mine"
    if not folder.is_dir():
        return f"{title}\n\nNot measured: the map was not there."
    cloud = read_cloud(next(iter(clouds_in(folder))))
    xyz, surfels = cloud.xyz_m, surfels_of(cloud)
    ways = [*((method, True) for method in METHODS), ("linear", False)]
    errors, edge, views = _errors(xyz, surfels, ways)
    lines = [_map_line(way, 100 * error, edge) for way, error in zip(ways, errors, strict=True)]
    text = MAP_TEXT.format(
        views=views,
        height=HEIGHT_M,
        lo=LIMITS_M[0],
        hi=LIMITS_M[1],
        points=len(edge),
        px=EDGE_PX,
        step=EDGE_M,
        share=EDGE_SHARE,
        wanted=WANTED_CM,
        edge=WANTED_EDGE_CM,
    )
    return f"{title}\n\n{text}\n\n{grid(('method', 'all', 'edges', 'open', 'no value', 'verdict'), lines)}"


def _map_line(way: tuple[str, bool], error_cm: Floats, edge: NDArray[np.bool_]) -> list[str]:
    there = np.isfinite(error_cm)
    (rmse, mae), (_, edge_mae), _ = parts = [
        _rmse_mae(error_cm[there & part]) for part in (edge | True, edge, ~edge)
    ]
    verdict = ""
    if way == ("plane", True):
        limits = (
            (rmse, WANTED_CM[0], "RMSE"),
            (mae, WANTED_CM[1], "MAE"),
            (edge_mae, WANTED_EDGE_CM, "edges"),
        )
        missed = [name for value, most, name in limits if not at_most(most).met(value)]
        verdict = f"**missed**: {', '.join(missed)}" if missed else "met"
    name = f"`{way[0]}`" + ("" if way[1] else ", seen through")
    return [name, *(f"{a:.1f} / {b:.1f}" for a, b in parts), f"{1 - there.mean():.1%}", verdict]


def _errors(
    xyz: NDArray[Any], surfels: Surfels, ways: list[tuple[str, bool]]
) -> tuple[list[Floats], NDArray[np.bool_], int]:
    """Errors of every way at all points held out, in metres; which points are at an edge; how many views."""
    rng = np.random.default_rng(0)
    found: list[list[Floats]] = [[] for _ in ways]
    edge: list[NDArray[np.bool_]] = []
    for T in _poses(xyz):
        every, visible = _view(xyz, surfels, T)
        near = (every.value_m >= LIMITS_M[0]) & (every.value_m < LIMITS_M[1])
        held = visible & near & (rng.random(len(every)) < HELD)
        truth = every.take(held)
        edge.append(_at_edge(every.take(visible), np.flatnonzero(held[visible])))
        rows, columns = np.floor(truth.v + 0.5).astype(int), np.floor(truth.u + 0.5).astype(int)
        for errors, (method, removal) in zip(found, ways, strict=True):
            kept = every.take(visible & ~held if removal else ~held)
            dense = np.nan_to_num(densifier(method)(kept, Demand(threads=2)))[rows, columns]
            errors.append(np.where(dense > 0, dense.astype(np.float64) - truth.value_m, np.nan))
    return [np.concatenate(errors) for errors in found], np.concatenate(edge), len(edge)


def _poses(xyz: NDArray[Any]) -> Iterator[Floats]:
    """T_cam_map of cameras along the longest drift: forward, back, 50 degrees to each side in turn."""
    centre = np.median(xyz, 0)
    near = xyz[np.abs(xyz[:, 2] - centre[2]) < 8].astype(np.float64)
    axis = _axis(near[:, :2])
    for turn, along in enumerate(np.linspace(-35, 40, STATIONS)):
        place = _place(near, centre, axis, along)
        if place is None:
            continue
        yaw = np.arctan2(axis[1], axis[0]) + np.radians((0, 50, 180, -50)[turn % 4])
        c, s = np.cos(yaw), np.sin(yaw)
        yield T_CAM_LIDAR @ invert(pose(((c, -s, 0), (s, c, 0), (0, 0, 1)), place))


def _axis(xy: Floats) -> Floats:
    """The direction along which the most points lie within 2.5 m of a line through their median."""
    angles = np.radians(np.arange(0, 180, 1.0))
    off = xy - np.median(xy, 0)
    counts = [np.count_nonzero(np.abs(off @ (-np.sin(a), np.cos(a))) < 2.5) for a in angles]
    best = angles[int(np.argmax(counts))]
    return np.array([np.cos(best), np.sin(best)])


def _place(xyz: Floats, centre: Floats, axis: Floats, along: float) -> Floats | None:
    """The freest place across the drift, so far along it; None where there is no room."""
    side = np.array([-axis[1], axis[0]])
    off = xyz[:, :2] - centre[:2]
    s, t = off @ axis, off @ side
    here = (np.abs(s - along) < 1) & (np.abs(t) < 4)
    if here.sum() < 200:
        return None
    floor = np.percentile(xyz[here, 2], 3)
    close = xyz[np.abs(s - along) < 4]
    across = np.arange(-2, 4, 0.25)
    level = np.full(len(across), floor + HEIGHT_M)
    places = np.c_[centre[:2] + along * axis + across[:, None] * side, level]
    clear = np.array([np.linalg.norm(close - place, axis=1).min() for place in places])
    clear[(across < np.percentile(t[here], 5) + 0.7) | (across > np.percentile(t[here], 95) - 0.7)] = 0
    return places[np.argmax(clear)] if clear.max() > FREE_M else None


def _view(xyz: NDArray[Any], surfels: Surfels, T: Floats) -> tuple[SparseDepth, NDArray[np.bool_]]:
    """All samples of a view, hidden or not, and which are visible."""
    at = transform(T, xyz)
    uv, seen = CAMERA.project(at)
    w, h = CAMERA.size_wh
    inside = seen & (uv >= -0.5).all(1) & (uv[:, 0] < w - 0.5) & (uv[:, 1] < h - 0.5) & (at[:, 2] > 0.1)
    visible = visible_in_map(at, CAMERA, surfels.normal @ T[:3, :3].T, surfels.radius_m)
    i = np.flatnonzero(inside)
    return SparseDepth((w, h), uv[i, 0], uv[i, 1], at[i, 2].astype(np.float32), "depth", i), visible[i]


def _at_edge(sparse: SparseDepth, which: NDArray[np.int64]) -> NDArray[np.bool_]:
    from scipy.spatial import KDTree

    uv = np.stack([sparse.u, sparse.v], 1)
    around = KDTree(uv).query_ball_point(uv[which], EDGE_PX)
    z = sparse.value_m
    return np.array([np.ptp(z[k]) > EDGE_M + EDGE_SHARE * z[k].min() for k in around], np.bool_)


def _guided_section(folder: Path) -> str:
    title = "### A few samples and a picture"
    if not folder.is_dir():
        return f"{title}\n\nNot measured: the scene was not there."
    truth = np.load(folder / "gt.npy", allow_pickle=False)
    samples = np.load(folder / "sparse_1000.npy", allow_pickle=False)
    guide = np.asarray(cv2.imread(str(folder / "image.png")), np.uint8)
    lines = []
    for method in ("guided", "plane", "natural-discrete"):
        cells, verdict = [], ""
        for count in (1000, 100, 10):
            rmse, mae = _rmse_mae(_sparse_error(method, _thinned(samples, count), truth, guide))
            cells.append(f"{rmse:.2f} / {mae:.2f}")
            if (method, count) == ("guided", 1000):
                verdict = "met" if at_most(WANTED_GUIDED_M).met(rmse) else "**missed**"
        lines.append([f"`{method}`", *cells, verdict])
    text = GUIDED_TEXT.format(wanted=WANTED_GUIDED_M)
    return f"{title}\n\n{text}\n\n{grid(('method', '1000', '100', '10', 'verdict'), lines)}"


def _thinned(samples: Floats, count: int) -> Floats:
    """Some of the samples, always the same ones."""
    there = np.flatnonzero(samples)
    kept = there if count >= len(there) else np.random.default_rng(0).choice(there, count, replace=False)
    thinned = np.zeros_like(samples)
    thinned.flat[kept] = samples.flat[kept]
    return thinned


def _sparse_error(method: str, samples: Floats, truth: Floats, guide: NDArray[np.uint8]) -> Floats:
    dense = densifier(method)(from_image(samples), Demand(guide_bgr=guide, threads=2))
    known = np.isfinite(truth) & (truth > 0)
    return dense[known].astype(np.float64) - truth[known]


def _rmse_mae(error: Floats) -> tuple[float, float]:
    return float(np.sqrt(np.mean(error**2))), float(np.mean(np.abs(error)))
