"""The joint solve: truth from perfect data, tolerances from the noise, oracles, outliers, refusals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from calib.observations import View
from calib.scenes import Scene, errors, perturbed, planted, scene
from calib.solve import Solution, solve
from calib.solve.blocks import blocks_of
from calib.solve.cameras import parameters
from calib.solve.state import Layout
from fusion.errors import InputError
from fusion.geometry import PinholeCamera, transform


@lru_cache(maxsize=8)
def _world(seed: int, **kind: Any) -> Scene:
    return scene(seed, **kind)


@lru_cache(maxsize=8)
def _solved(seed: int, **kind: Any) -> Solution:
    world = _world(seed, **kind)
    return solve(world.board, world.views, world.clouds, start=perturbed(world.truth, seed))


def _by_name(solution: Solution, world: Scene) -> dict[str, float]:
    return dict(zip(solution.names, errors(solution, world.truth), strict=True))


def _of(views: Sequence[View], *cameras: str) -> list[View]:
    return [v for v in views if v.camera in cameras]


def _numbers(solution: Solution) -> np.ndarray:
    parts = [
        *solution.residual_px,
        *solution.plane_residual_m,
        *solution.edge_residual_m,
        solution.covariance,
    ]
    return np.concatenate([p.ravel() for p in (*parts, *solution.estimate.T_ref_board.values())])


# --- truth


@pytest.mark.parametrize("model", ["pinhole0", "pinhole4", "pinhole5", "fisheye"])
def test_perfect_data_give_the_truth(model: str) -> None:
    kind: dict[str, Any] = {
        "views": 10,
        "noise_px": 0.0,
        "lidar_noise_m": 0.0,
        "models": (model, "thermal5"),
        "moving": True,
    }
    found, world = _solved(11, **kind), _world(11, **kind)
    for name, error in _by_name(found, world).items():
        scale = 500 if name.endswith((".fx", ".fy", ".cx", ".cy")) else 1
        assert abs(error) < 1e-6 * scale, name
    for moment, T in world.truth.T_ref_board.items():
        np.testing.assert_allclose(found.estimate.T_ref_board[moment], T, atol=1e-6)
    assert max(np.abs(r).max() for r in found.residual_px) < 1e-6
    assert not found.dropped_views
    assert all(u.all() for u in found.used)


def test_the_rational_model_projects_rightly_and_says_what_it_does_not_know() -> None:
    kind: dict[str, Any] = {
        "views": 12,
        "noise_px": 0.0,
        "lidar_noise_m": 0.0,
        "models": ("pinhole8", "thermal5"),
    }
    found, world = _solved(12, **kind), _world(12, **kind)
    assert max(np.abs(r).max() for r in found.residual_px) < 1e-6
    assert abs(_by_name(found, world)["T_rgb_fir.tx"]) < 1e-6
    kind |= {"noise_px": 0.1, "lidar_noise_m": 0.01}
    found, world = _solved(12, **kind), _world(12, **kind)
    assert any(n.startswith("rgb: ") and "k4" in n and "poorly determined" in n for n in found.notes)
    assert not any(n.startswith("fir: ") for n in found.notes)
    assert found.sigma_px["rgb"] == pytest.approx(0.1, rel=0.1)
    assert abs(_by_name(found, world)["rgb.fx"]) < 0.0015 * 520


@pytest.mark.parametrize("seed", [1, 2])
def test_noisy_data_give_the_truth_to_the_tolerances(seed: int) -> None:
    """0.1 px, 1 cm, 30 views: the tolerances of the project's brief."""
    found, world = _solved(seed, moving=True), _world(seed, moving=True)
    limits = {"fx": 0.0015 * 520, "fy": 0.0015 * 520, "cx": 1.0, "cy": 1.0, "time_offset_s": 3e-3}
    limits |= {f"T_rgb_fir.r{axis}": 5e-4 for axis in "xyz"} | {f"T_rgb_fir.t{axis}": 1e-3 for axis in "xyz"}
    limits |= {f"T_rgb_lidar.r{axis}": 1e-3 for axis in "xyz"} | {
        f"T_rgb_lidar.t{axis}": 5e-3 for axis in "xyz"
    }
    for name, error in _by_name(found, world).items():
        limit = limits.get(name, limits.get(name.rpartition(".")[2], np.inf))
        spread = np.sqrt(found.covariance[found.names.index(name), found.names.index(name)])
        # The scene must be good enough for its tolerance; then the error keeps both.
        assert 1.5 * spread < limit, name
        assert abs(error) < min(limit, 4.5 * spread), name


def test_a_rough_start_comes_to_the_same_optimum() -> None:
    world, near = _world(1, moving=True), _solved(1, moving=True)
    far = solve(world.board, world.views, world.clouds, start=perturbed(world.truth, 4, 3.0))
    apart = np.abs(errors(far, world.truth) - errors(near, world.truth))
    assert (apart < 0.02 * np.sqrt(np.diag(near.covariance))).all()


# --- oracles


def test_scipys_least_squares_comes_to_the_same_optimum() -> None:
    """Same residuals and weights, its own derivatives by differences."""
    world = _world(13, views=3, models=("pinhole4", "pinhole0"))
    found = solve(world.board, world.views, world.clouds, start=world.truth, robust=False)
    layout = Layout(found.estimate, ("rgb", "fir", "lidar"), tuple(world.truth.T_ref_board), ())
    blocks, state = blocks_of(world.board, world.views, world.clouds, layout), layout.first_state()
    assert found.sigma_m is not None
    assert found.sigma_edge_m is not None
    sigma = {**found.sigma_px, "plane": found.sigma_m, "edge": found.sigma_edge_m}
    P, spread = len(layout.names), np.sqrt(np.diag(found.covariance))

    def residual(x: np.ndarray) -> np.ndarray:
        at = layout.moved(state, x[:P] * spread, x[P:].reshape(-1, 6) * 1e-3)
        rows = [(b.linearise(at).r / sigma[b.sensor if b.kind == "px" else b.kind]).ravel() for b in blocks]
        return np.concatenate([*rows, np.sqrt(layout.prior) * layout.distortion_step(at)])

    start = np.random.default_rng(0).normal(0, 1, P + 6 * len(layout.moments))
    best = least_squares(residual, start, x_scale="jac", xtol=1e-9, ftol=1e-9)
    assert np.abs(best.x[:P]).max() < 0.01  # in standard deviations, from ours


def _cv_points(world: Scene, views: Sequence[View]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    return (
        [world.board.points_m[v.ids].astype(np.float32)[:, None] for v in views],
        [v.uv.astype(np.float32)[:, None] for v in views],
    )


@pytest.mark.parametrize("model", ["pinhole5", "pinhole8", "fisheye"])
def test_opencv_calibrates_to_the_same_camera(model: str) -> None:
    kind: dict[str, Any] = {"views": 15, "models": (model,), "lidar": False}
    world, found = _world(14, **kind), _solved(14, **kind)
    points, pixels = _cv_points(world, world.views)
    size, K = (640, 480), np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    if model == "fisheye":
        K[0, 0] = K[1, 1] = 330
        flags = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-12)
        points = [p.astype(np.float64).reshape(1, -1, 3) for p in points]
        pixels = [p.astype(np.float64).reshape(1, -1, 2) for p in pixels]
        rms, K, *_ = cv2.fisheye.calibrate(points, pixels, size, K, np.zeros((4, 1)), None, None, flags, stop)
    else:
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-14)
        flags = cv2.CALIB_RATIONAL_MODEL if model == "pinhole8" else 0
        rms, K, lens, *_ = cv2.calibrateCamera(
            points, pixels, size, K, np.zeros(5), flags=flags, criteria=stop
        )
        if model == "pinhole5":  # all of it: the prior pulls at nothing that the data know
            theirs = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *lens.ravel()[:5]]
            off = parameters(found.estimate.cameras["rgb"]) - theirs
            assert (np.abs(off) < 0.1 * np.sqrt(np.diag(found.covariance))).all()
    camera = found.estimate.cameras["rgb"]
    assert found.rms_px("rgb") == pytest.approx(rms, abs=1e-3)
    assert [camera.fx, camera.fy] == pytest.approx([K[0, 0], K[1, 1]], rel=1e-3)
    if model != "pinhole8":  # without a prior its coefficients, and with them the centre, follow the noise
        assert [camera.cx, camera.cy] == pytest.approx([K[0, 2], K[1, 2]], abs=0.15)


def test_opencv_sees_the_second_camera_at_the_same_place() -> None:
    """`stereoCalibrate` with our intrinsics fixed: the same pose, within a standard deviation."""
    kind: dict[str, Any] = {"views": 12, "lidar": False, "models": ("pinhole5", "thermal5")}
    world = _world(15, **kind)
    shared = {v.moment for v in _of(world.views, "fir") if len(v.ids) == 54}
    shared &= {v.moment for v in _of(world.views, "rgb") if len(v.ids) == 54}
    views = [v for v in world.views if v.moment in shared]
    found = solve(world.board, views, start=world.truth)
    cameras = {n: c for n, c in found.estimate.cameras.items() if isinstance(c, PinholeCamera)}
    points, rgb = _cv_points(world, _of(views, "rgb"))
    _, fir = _cv_points(world, _of(views, "fir"))
    lens = {n: (c.matrix(), np.array(c.distortion)) for n, c in cameras.items()}
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-14)
    rms, *_, R, t, _E, _F = cv2.stereoCalibrate(
        points, fir, rgb, *lens["fir"], *lens["rgb"], (640, 480), flags=cv2.CALIB_FIX_INTRINSIC, criteria=stop
    )
    T = found.estimate.T_ref_sensor["fir"]
    held = solve(world.board, views, start=found.estimate, fixed=("rgb", "fir"))
    spread = np.sqrt(np.diag(held.covariance))
    np.testing.assert_allclose(T[:3, :3], R, atol=spread[:3].max())
    np.testing.assert_allclose(T[:3, 3], t[:, 0], atol=spread[3:].max())
    assert rms == pytest.approx(np.hypot(found.rms_px("rgb"), found.rms_px("fir")) / np.sqrt(2), abs=1e-3)


# --- outliers


def test_a_tenth_of_outliers_moves_it_less_than_noise_does() -> None:
    world, clean = _world(1, moving=True), _solved(1, moving=True)
    views = planted(world.views, 1)
    found = solve(world.board, views, world.clouds, start=perturbed(world.truth, 1))
    moved = errors(found, world.truth) - errors(clean, world.truth)
    assert (np.abs(moved) < 2 * np.sqrt(np.diag(clean.covariance))).all()
    assert found.sigma_px["rgb"] == pytest.approx(0.1, rel=0.1)
    bad = [np.abs(a.uv - b.uv).max(1) > 1 for a, b in zip(views, world.views, strict=True)]
    np.testing.assert_array_equal(np.concatenate(found.used), ~np.concatenate(bad))
    assert not found.dropped_views
    assert any(
        f"{sum(b.sum() for b, v in zip(bad, views, strict=True) if v.camera == 'rgb')} of" in n
        for n in found.notes
    )


def test_many_outliers_cost_few_steps() -> None:
    """Three in ten: the Cauchy loss comes near in a few steps; cutting off alone takes twice as many."""
    world, steps = _world(2, views=8), []
    views = planted(world.views, 0, 0.3)
    start = perturbed(world.truth, 0)
    found = solve(world.board, views, world.clouds, start=start, progress=lambda done, _: steps.append(done))
    assert len(steps) < 30
    assert found.sigma_px["rgb"] == pytest.approx(0.1, rel=0.15)


def test_without_robustness_outliers_do_move_it() -> None:
    world, clean = _world(1, moving=True), _solved(1, moving=True)
    views = planted(world.views, 1)
    found = solve(world.board, views, world.clouds, start=world.truth, robust=False, drop_views=False)
    moved = errors(found, world.truth) - errors(clean, world.truth)
    assert (np.abs(moved) > 4 * np.sqrt(np.diag(clean.covariance))).any()
    assert all(u.all() for u in found.used)


def test_lidar_points_beside_the_board_do_not_count() -> None:
    world, clean = _world(1, moving=True), _solved(1, moving=True)
    clouds = []
    for cloud in world.clouds:
        plane = cloud.plane_m.copy()
        plane[::12] *= 1.2
        clouds.append(replace(cloud, plane_m=plane))
    found = solve(world.board, world.views, clouds, start=perturbed(world.truth, 1))
    assert all(not u[::12].any() and u[1::12].all() for u in found.plane_used)
    moved = errors(found, world.truth) - errors(clean, world.truth)
    assert (np.abs(moved) < 2 * np.sqrt(np.diag(clean.covariance))).all()


def test_mislabelled_and_blurred_views_are_dropped_and_named() -> None:
    world, clean = _world(1, moving=True), _solved(1, moving=True)
    rng = np.random.default_rng(0)
    views = list(world.views)
    turned = next(i for i, v in enumerate(views) if v.camera == "fir" and len(v.ids) == 54)
    blurred = next(
        i for i, v in enumerate(views) if v.camera == "rgb" and i > turned + 1 and len(v.ids) == 54
    )
    views[turned] = replace(views[turned], ids=53 - views[turned].ids)
    views[blurred] = replace(views[blurred], uv=views[blurred].uv + rng.normal(0, 1, (54, 2)))
    found = solve(world.board, views, world.clouds, start=perturbed(world.truth, 1))
    assert {file for file, _ in found.dropped_views} == {views[turned].file, views[blurred].file}
    assert all("px" in reason for _, reason in found.dropped_views)
    assert len(found.views) == len(views) - 2
    moved = errors(found, world.truth) - errors(clean, world.truth)
    assert (np.abs(moved) < 2 * np.sqrt(np.diag(clean.covariance))).all()


def test_a_view_a_few_times_noisier_than_the_others_is_dropped_only_when_asked() -> None:
    world = _world(16, views=12, lidar=False, models=("pinhole5",))
    views = list(world.views)
    views[3] = replace(views[3], uv=views[3].uv + np.random.default_rng(1).normal(0, 0.4, views[3].uv.shape))
    found = solve(world.board, views, start=world.truth)
    assert [file for file, _ in found.dropped_views] == [views[3].file]
    assert "px" in found.dropped_views[0][1]
    kept = solve(world.board, views, start=world.truth, drop_views=False)
    assert not kept.dropped_views


def test_clean_views_are_not_dropped() -> None:
    for seed in range(20, 22):
        found = _solved(seed, views=10)
        assert not found.dropped_views
        assert sum(int((~u).sum()) for u in found.used) <= 1


def test_views_that_cannot_take_part_are_named() -> None:
    world = _world(1, moving=True)
    a, b, c, d, *rest = _of(world.views, "rgb")
    few = replace(a, ids=a.ids[:3], uv=a.uv[:3])
    line = np.flatnonzero(b.ids < 9)
    row = replace(b, ids=b.ids[line], uv=b.uv[line])
    behind = {**world.truth.T_ref_board}
    behind[c.moment] = behind[c.moment].copy()
    behind[c.moment][2, 3] = -2.0
    del behind[d.moment]
    clouds = [k for k in world.clouds if k.moment in (a.moment, rest[0].moment)]
    start = replace(world.truth, T_ref_board=behind)
    found = solve(world.board, [few, row, c, d, *rest], clouds, start=start, fixed=("lidar",))
    reasons = dict(found.dropped_views)
    assert set(reasons) == {a.file, b.file, c.file, d.file, clouds[0].file}
    assert "3 points" in reasons[a.file]
    assert "one line" in reasons[b.file]
    assert "behind" in reasons[c.file]
    assert "start" in reasons[d.file]
    assert "camera" in reasons[clouds[0].file]
    assert np.isfinite(_numbers(found)).all()


# --- what is refused


def test_one_view_does_not_give_a_focal_length() -> None:
    world = _world(1, moving=True)
    with pytest.raises(InputError, match=r"do not determine rgb\.fx, rgb\.fy.*tilted 20 to 45"):
        solve(world.board, _of(world.views, "rgb")[:1], start=perturbed(world.truth, 1))


@pytest.mark.parametrize("tilt_rad", [0.0, 0.05])
def test_boards_without_tilt_do_not_give_a_focal_length(tilt_rad: float) -> None:
    world = _world(2, views=12, lidar=False, tilt_rad=tilt_rad)
    with pytest.raises(InputError, match=r"do not determine rgb\.fx, rgb\.fy.*fir\.fx, fir\.fy.*tilted"):
        solve(world.board, world.views, start=perturbed(world.truth, 1))


def test_views_all_alike_do_not_give_a_focal_length() -> None:
    world = _world(1, moving=True)
    one, rng = _of(world.views, "rgb")[2], np.random.default_rng(0)
    names = [f"{i}" for i in range(15)]
    views = [replace(one, moment=n, uv=one.uv + rng.normal(0, 0.1, one.uv.shape)) for n in names]
    start = perturbed(world.truth, 1)
    start = replace(start, twist={}, T_ref_board=dict.fromkeys(names, start.T_ref_board[one.moment]))
    with pytest.raises(InputError, match=r"rgb\.fx, rgb\.fy: one tilt of the board in all 15 views"):
        solve(world.board, views, start=start)


def test_few_noisy_views_leave_the_focal_length_open() -> None:
    """Two tilts 6 degrees apart, 1 px of noise: enough in theory, not in numbers."""
    world = _world(3, views=2, lidar=False, models=("pinhole5",), tilt_rad=0.12, noise_px=1.0)
    with pytest.raises(InputError, match=r"do not determine .*rgb\.f[xy]"):
        solve(world.board, world.views, start=world.truth)


def test_a_camera_that_shares_no_moment_is_named_with_the_remedy() -> None:
    world = _world(1, moving=True)
    views = [v for v in world.views if (v.camera == "rgb") == (int(v.moment) % 2 == 0)]
    with pytest.raises(InputError, match=r"no moment at which fir sees.*as well as rgb.*hold T_rgb_fir"):
        solve(world.board, views, start=perturbed(world.truth, 1))
    found = solve(world.board, views, start=world.truth, fixed=("T_rgb_fir", "fir.time_offset_s"))
    assert not any(n.startswith("T_") for n in found.names)


def test_a_clock_needs_boards_that_move() -> None:
    world = _world(2, views=8, lidar=False)
    start = replace(world.truth, time_offset_s={"fir": 0.0})
    with pytest.raises(InputError, match=r"do not determine fir\.time_offset_s \(record a board that moves"):
        solve(world.board, world.views, start=start)


def test_one_plane_does_not_place_the_lidar() -> None:
    world = _world(2, views=8)
    bare = [replace(c, edge_m=c.edge_m[:0], edge_of=c.edge_of[:0]) for c in world.clouds]
    with pytest.raises(InputError, match=r"T_rgb_lidar\.t.*turned in at least 3 directions"):
        solve(world.board, world.views, bare[:1], start=world.truth)
    found = solve(world.board, world.views, bare, start=world.truth)
    assert found.sigma_edge_m is None
    assert all(r.shape == (0,) for r in found.edge_residual_m)


def test_points_in_the_wrong_order_are_no_board() -> None:
    world, rng = _world(2, views=5, lidar=False), np.random.default_rng(0)
    views = [replace(v, uv=rng.permutation(v.uv)) for v in world.views]
    with pytest.raises(InputError, match=r"nothing fits: points of rgb are \d+ px off"):
        solve(world.board, views, start=perturbed(world.truth, 1))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"uv": np.full((54, 2), np.nan)}, "not finite"),
        ({"lag_s": float("inf")}, "not finite"),
        ({"size_wh": (1280, 960)}, "1280x960 where rgb has 640x480"),
    ],
)
def test_a_view_that_cannot_be_right_is_named(change: dict[str, Any], match: str) -> None:
    world = _world(2, views=8, lidar=False)
    view = next(v for v in world.views if v.camera == "rgb" and len(v.ids) == 54)
    with pytest.raises(InputError, match=f"{view.file}.*{match}"):
        solve(world.board, [replace(view, **change)], start=world.truth)


def test_nan_in_a_cloud_is_named() -> None:
    world = _world(2, views=8)
    cloud = replace(world.clouds[0], plane_m=world.clouds[0].plane_m * np.nan)
    with pytest.raises(InputError, match=f"{cloud.file}.*not finite"):
        solve(world.board, world.views, [cloud], start=world.truth)


def test_nothing_gives_no_solution() -> None:
    world = _world(2, views=8)
    with pytest.raises(InputError, match="no views"):
        solve(world.board, [], start=world.truth)


def test_a_program_that_misnames_things_hears_of_it() -> None:
    world = _world(2, views=8)
    view = world.views[0]

    def refused(match: str, *args: Any, **kwargs: Any) -> None:
        with pytest.raises(ValueError, match=match):
            solve(world.board, *args, **{"start": world.truth, **kwargs})

    refused("expected names among .*rgb.k3.*got .*rgb.k9", world.views, fixed=("rgb.k9",))
    refused("T_ref_sensor of every sensor", [replace(view, camera="nir")])
    refused("ids of 54 points", [replace(view, ids=view.ids + 60)])
    refused("identity for the reference", [view], start=replace(world.truth, reference="fir"))
    bare = replace(world.board, plate_m=None)
    with pytest.raises(ValueError, match="plate_m"):
        solve(bare, world.views, world.clouds, start=world.truth)


# --- behaviour


def test_it_repeats_itself_and_changes_no_input() -> None:
    world = _world(2, views=8)
    start = perturbed(world.truth, 3)
    before = [v.uv.copy() for v in world.views], {m: T.copy() for m, T in start.T_ref_board.items()}
    first = solve(world.board, world.views, world.clouds, start=start)
    second = solve(world.board, world.views, world.clouds, start=start)
    np.testing.assert_array_equal(_numbers(first), _numbers(second))
    assert all(np.array_equal(a, v.uv) for a, v in zip(before[0], world.views, strict=True))
    assert all(np.array_equal(T, start.T_ref_board[m]) for m, T in before[1].items())


def test_residuals_are_projected_minus_seen_in_the_order_of_the_views() -> None:
    found, world = _solved(1, moving=False, views=8), _world(1, moving=False, views=8)
    assert [v.file for v in found.views] == [v.file for v in world.views]
    assert [c.file for c in found.clouds] == [c.file for c in world.clouds]
    estimate = found.estimate
    for view, r in zip(found.views, found.residual_px, strict=True):
        T = np.linalg.inv(estimate.T_ref_sensor[view.camera]) @ estimate.T_ref_board[view.moment]
        uv, _ = estimate.cameras[view.camera].project(transform(T, world.board.points_m[view.ids]))
        np.testing.assert_allclose(r, uv - view.uv, atol=1e-9)
    cloud, r, edge = found.clouds[2], found.plane_residual_m[2], found.edge_residual_m[2]
    T = np.linalg.inv(estimate.T_ref_board[cloud.moment]) @ estimate.T_ref_sensor["lidar"]
    np.testing.assert_allclose(r, transform(T, cloud.plane_m)[:, 2], atol=1e-9)
    assert world.board.plate_m is not None
    left, top, right, bottom = world.board.plate_m
    x, y, _ = transform(T, cloud.edge_m).T
    outwards = np.choose(cloud.edge_of, [top - y, x - right, y - bottom, left - x])
    np.testing.assert_allclose(edge, outwards, atol=1e-9)


def test_a_sensor_without_data_stays_and_a_moment_goes() -> None:
    world = _world(2, views=8)
    views = [v for v in _of(world.views, "rgb") if v.moment != "003"]
    found = solve(world.board, views, start=world.truth)
    assert found.estimate.cameras["fir"] == world.truth.cameras["fir"]
    assert set(found.estimate.T_ref_sensor) == {"rgb", "fir", "lidar"}
    assert "003" not in found.estimate.T_ref_board
    assert found.sigma_m is None
    assert set(found.sigma_px) == {"rgb"}
    assert np.isnan(found.rms_px("fir"))


def test_progress_is_told() -> None:
    world = _world(2, views=8)
    calls: list[tuple[int, int]] = []
    solve(world.board, world.views, start=world.truth, progress=lambda done, most: calls.append((done, most)))
    assert [done for done, _ in calls] == list(range(1, len(calls) + 1))
    assert all(done <= most for done, most in calls)
