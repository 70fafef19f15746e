"""Every derivative against differences, every model against `fusion.geometry`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from calib.scenes import MODELS, scene
from calib.solve.blocks import blocks_of
from calib.solve.cameras import parameter_names, parameters, project, with_parameters
from calib.solve.motion import cross, exp_motion, hat, moved
from calib.solve.normal import assemble, part_of
from calib.solve.state import Layout
from fusion.geometry import FisheyeCamera

POINTS = np.random.default_rng(0).normal((0, 0, 1), 0.25, (40, 3))
EQUIDISTANT = FisheyeCamera((640, 480), 330.0, 331.0, 322.9, 234.3)
CAMERAS = {**MODELS, "equidistant": EQUIDISTANT}


def _differences(f, x: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Central differences of f by each entry of x, last axis."""
    columns = []
    for i, h in enumerate(step):
        up, down = x.copy(), x.copy()
        up[i] += h
        down[i] -= h
        columns.append((f(up) - f(down)) / (2 * h))
    return np.stack(columns, -1)


@pytest.mark.parametrize("name", CAMERAS)
def test_a_model_projects_as_fusion_does(name: str) -> None:
    camera = CAMERAS[name]
    ours = project(camera, parameters(camera), POINTS)
    uv, seen = camera.project(POINTS)
    assert seen.sum() > 30
    np.testing.assert_allclose(ours.uv[seen], uv[seen], rtol=0, atol=1e-9)
    assert ours.seen[seen].all()


@pytest.mark.parametrize("name", CAMERAS)
def test_derivatives_of_a_model_are_those_of_differences(name: str) -> None:
    camera = CAMERAS[name]
    values = parameters(camera)
    at = project(camera, values, POINTS)
    by_parameter = _differences(lambda v: project(camera, v, POINTS).uv, values, np.full(len(values), 1e-5))
    np.testing.assert_allclose(at.by_parameter, by_parameter, rtol=1e-6, atol=1e-4)
    for i, point in enumerate(POINTS):
        by_point = _differences(lambda p: project(camera, values, p[None]).uv[0], point, np.full(3, 1e-6))
        np.testing.assert_allclose(at.by_point[i], by_point, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("camera", [MODELS["fisheye"], EQUIDISTANT])
def test_a_fisheye_is_smooth_on_its_axis_and_sees_behind(camera: FisheyeCamera) -> None:
    values = parameters(camera)
    axis = project(camera, values, np.array([[0.0, 0, 2], [1e-7, 0, 2]]))
    np.testing.assert_allclose(axis.uv, [[camera.cx, camera.cy]] * 2, atol=1e-4)
    np.testing.assert_allclose(axis.by_point[0], axis.by_point[1], atol=1e-4)
    assert axis.by_point[0, 0, 0] == pytest.approx(camera.fx / 2)
    assert project(camera, values, np.array([[1.0, 0, -0.1], [0, 0, -1.0]])).seen.tolist() == [True, False]


def test_a_point_behind_a_pinhole_is_not_seen() -> None:
    camera = MODELS["pinhole5"]
    assert project(
        camera, parameters(camera), np.array([[0.1, 0, -1], [0, 0, 0], [0, 0, 1]])
    ).seen.tolist() == [
        False,
        False,
        True,
    ]


@pytest.mark.parametrize("name", CAMERAS)
def test_parameters_go_there_and_back(name: str) -> None:
    camera = CAMERAS[name]
    assert with_parameters(camera, parameters(camera)) == camera
    assert len(parameter_names(camera)) == 4 + len(camera.distortion)


@pytest.mark.parametrize("size", [0.0, 1e-8, 1e-4, 1e-2, 1.0, 3.0])
def test_a_motion_is_the_matrix_exponential(size: float) -> None:
    xi = np.random.default_rng(1).normal(0, 1, (5, 6)) * (*[size] * 3, 1, 1, 1)
    for one, T in zip(xi, exp_motion(xi), strict=True):
        M = np.zeros((4, 4))
        M[:3, :3], M[:3, 3] = hat(one[:3]), one[3:]
        np.testing.assert_allclose(T, expm(M), rtol=0, atol=1e-12)


def test_a_cross_product_is_numpys() -> None:
    a, b = np.random.default_rng(2).normal(size=(2, 7, 3))
    np.testing.assert_allclose(cross(a, b), np.cross(a, b))


def test_a_pose_moves_to_the_left() -> None:
    T = exp_motion(np.array([0.3, -0.2, 0.5, 1, 2, 3.0]))
    turned = moved(T, np.array([0.1, 0, 0, 0.5, 0, 0]))
    np.testing.assert_allclose(turned[:3, :3], exp_motion(np.array([0.1, 0, 0, 0, 0, 0]))[:3, :3] @ T[:3, :3])
    np.testing.assert_allclose(turned[:3, 3], T[:3, 3] + (0.5, 0, 0))


@pytest.mark.parametrize("reference", ["rgb", "lidar"])
def test_derivatives_of_the_residuals_are_those_of_differences(reference: str) -> None:
    """All sensors, moving boards, late stamps, plane and rim: by every shared parameter and board pose."""
    world = scene(3, views=2, models=("fisheye", "thermal5"), moving=True)
    truth, T = world.truth, world.truth.T_ref_sensor
    if reference == "lidar":
        to = np.linalg.inv(T["lidar"])
        truth = replace(
            truth,
            reference="lidar",
            T_ref_sensor={n: np.eye(4) if n == "lidar" else to @ t for n, t in T.items()},
            T_ref_board={m: to @ t for m, t in truth.T_ref_board.items()},
            time_offset_s={"fir": 0.012, "rgb": 0.02, "lidar": 0.01},
        )
    layout = Layout(truth, ("rgb", "fir", "lidar"), tuple(truth.T_ref_board), ())
    blocks, state = blocks_of(world.board, world.views, world.clouds, layout), layout.first_state()
    assert [(b.sensor, b.kind) for b in blocks] == [
        ("rgb", "px"),
        ("fir", "px"),
        ("lidar", "plane"),
        ("lidar", "edge"),
    ]
    P, M = len(layout.names), len(layout.moments)
    step = np.full(P + 6 * M, 1e-6)
    for block in blocks:
        at = block.linearise(state)
        numeric = _differences(
            lambda x, b=block: b.linearise(layout.moved(state, x[:P], x[P:].reshape(M, 6))).r,
            np.zeros(P + 6 * M),
            step,
        )
        ours = np.zeros(numeric.shape)
        ours[..., layout.columns(block.sensor)] = at.by_shared
        for part, moment in zip(block.parts, block.moments, strict=True):
            ours[part, :, P + 6 * moment : P + 6 * moment + 6] = at.by_board[part]
        np.testing.assert_allclose(ours, numeric, rtol=1e-5, atol=2e-3 if block.kind == "px" else 1e-7)
        assert np.abs(numeric).max() > 0.1


def test_the_gradient_is_that_of_the_cost_with_its_prior() -> None:
    world = scene(4, views=2, models=("pinhole8", "thermal5"))
    layout = Layout(
        world.truth, ("rgb", "fir", "lidar"), tuple(world.truth.T_ref_board), ("rgb.fy", "T_rgb_fir.rx")
    )
    layout.prior *= 1e6  # as strong as the data
    blocks, state = blocks_of(world.board, world.views, world.clouds, layout), layout.first_state()
    weights = [np.full(len(b.linearise(state).r), 1 / (0.1 if b.kind == "px" else 0.01) ** 2) for b in blocks]
    P, M = len(layout.free_names), len(layout.moments)

    def half_cost(x: np.ndarray) -> np.ndarray:
        at = layout.moved(state, x[:P], x[P:].reshape(M, 6))
        data = sum(w[0] * (b.linearise(at).r ** 2).sum() for b, w in zip(blocks, weights, strict=True))
        return np.array(data + layout.prior @ layout.distortion_step(at) ** 2) / 2

    parts = [part_of(b, b.linearise(state), w, layout) for b, w in zip(blocks, weights, strict=True)]
    normal = assemble(parts, layout, state)
    numeric = _differences(half_cost, np.zeros(P + 6 * M), np.full(P + 6 * M, 1e-6))
    ours = np.concatenate([normal.gs, normal.gb.ravel()])
    np.testing.assert_allclose(ours, numeric, rtol=1e-4, atol=1e-5 * np.abs(numeric).max())
