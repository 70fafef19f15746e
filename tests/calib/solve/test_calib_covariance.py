"""The stated covariance is true: over seeded runs, and against the full problem's dense inverse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.scenes import chi_square, coverage, perturbed, scene
from calib.solve import solve
from calib.solve.blocks import blocks_of
from calib.solve.state import Layout


def test_the_truth_lies_in_the_ellipsoid_as_often_as_it_says() -> None:
    """The mean of chi-square / n over 8 runs is 1 but for 4 of its own standard deviations."""
    runs, owners = 8, ("", "rgb.", "T_rgb_fir", "T_rgb_lidar", "fir.time")
    squares = dict.fromkeys(owners, 0.0)
    counts = dict.fromkeys(owners, 0)
    for seed in range(runs):
        world = scene(seed, views=8, moving=True)
        found = solve(world.board, world.views, world.clouds, start=world.truth)
        for owner in owners:
            squared, counts[owner] = chi_square(found, world.truth, owner)
            squares[owner] += squared
    for owner in owners:
        n = runs * counts[owner]
        assert abs(squares[owner] / n - 1) < 4 * np.sqrt(2 / n), owner


def test_coverage_counts_what_lies_inside() -> None:
    shares = coverage(4, owners=("", "T_rgb_fir"), views=8, lidar=False)
    assert set(shares) == {"", "T_rgb_fir"}
    assert all(share >= 2 / 4 for share in shares.values())


def test_it_is_the_marginal_of_the_dense_inverse() -> None:
    """The Jacobian of all unknowns, boards too, inverted whole: no Schur complement, no blocks."""
    world = scene(5, views=6, moving=True)
    found = solve(world.board, world.views, world.clouds, start=perturbed(world.truth, 1), robust=False)
    layout = Layout(found.estimate, ("rgb", "fir", "lidar"), tuple(world.truth.T_ref_board), ())
    P, M = len(layout.names), len(layout.moments)
    assert found.sigma_m is not None
    sigma = {**found.sigma_px, "plane": found.sigma_m, "edge": found.sigma_edge_m}
    H = np.diag([*layout.prior, *np.zeros(6 * M)])
    for block in blocks_of(world.board, world.views, world.clouds, layout):
        at = block.linearise(layout.first_state())
        J = np.zeros((*at.r.shape, P + 6 * M))
        J[..., layout.columns(block.sensor)] = at.by_shared
        for part, moment in zip(block.parts, block.moments, strict=True):
            J[part, :, P + 6 * moment : P + 6 * moment + 6] = at.by_board[part]
        J = J.reshape(-1, P + 6 * M) / sigma[block.sensor if block.kind == "px" else block.kind]
        H += J.T @ J
    scale = 1 / np.sqrt(np.diag(H))
    C = np.outer(scale, scale) * np.linalg.inv(H * np.outer(scale, scale))
    np.testing.assert_allclose(found.covariance, C[:P, :P], rtol=1e-3, atol=1e-6 * np.abs(C[:P, :P]).max())
    np.testing.assert_allclose(np.diag(found.covariance), np.diag(C)[:P], rtol=1e-4)


def test_each_sensor_gets_its_own_noise() -> None:
    """Thermal four times as noisy as RGB, and the LiDAR's rim apart from its plane."""
    world = scene(6, views=6, noise_px=0.0, lidar_noise_m=0.0)
    rng = np.random.default_rng(0)
    noise = {"rgb": 0.1, "fir": 0.4}
    views = [replace(v, uv=v.uv + rng.normal(0, noise[v.camera], v.uv.shape)) for v in world.views]
    clouds = [
        replace(
            c,
            plane_m=c.plane_m + rng.normal(0, 0.02, c.plane_m.shape),
            edge_m=c.edge_m + rng.normal(0, 0.005, c.edge_m.shape),
        )
        for c in world.clouds
    ]
    found = solve(world.board, views, clouds, start=world.truth)
    assert found.sigma_px["rgb"] == pytest.approx(0.1, rel=0.12)
    assert found.sigma_px["fir"] == pytest.approx(0.4, rel=0.12)
    assert found.sigma_m == pytest.approx(0.02, rel=0.12)
    assert found.sigma_edge_m == pytest.approx(0.005, rel=0.2)


def test_few_points_do_not_make_the_noise_small() -> None:
    """With 12 points a view, a third of what is measured goes into the boards' poses: n - p, not n."""
    world = scene(7, views=30, lidar=False, models=("pinhole0",))
    chosen = np.arange(0, 54, 5)
    views = []
    for view in world.views:
        rows = np.flatnonzero(np.isin(view.ids, chosen))
        views.append(replace(view, ids=view.ids[rows], uv=view.uv[rows]))
    found = solve(world.board, views, start=world.truth)
    naive = np.sqrt(
        np.mean(
            np.concatenate([r[u].ravel() for r, u in zip(found.residual_px, found.used, strict=True)]) ** 2
        )
    )
    assert naive < 0.09
    assert found.sigma_px["rgb"] == pytest.approx(0.1, rel=0.1)


def test_what_is_held_has_no_row_and_makes_the_rest_surer() -> None:
    world = scene(8, views=8)
    free = solve(world.board, world.views, world.clouds, start=world.truth)
    held = solve(world.board, world.views, world.clouds, start=world.truth, fixed=("rgb", "fir.k3", "lidar"))
    assert not any(n.startswith(("rgb.", "T_rgb_lidar")) or n == "fir.k3" for n in held.names)
    assert held.covariance.shape == (len(held.names),) * 2
    assert held.estimate.cameras["rgb"] == world.truth.cameras["rgb"]
    np.testing.assert_array_equal(held.estimate.T_ref_sensor["lidar"], world.truth.T_ref_sensor["lidar"])
    ratio = (
        np.diag(held.covariance)[held.names.index("fir.fx")]
        / np.diag(free.covariance)[free.names.index("fir.fx")]
    )
    assert ratio < 0.8
