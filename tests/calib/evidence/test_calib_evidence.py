"""Evidence against the truth: spread of many calibrations, views that were really added, planted faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from calib.boards import Board
from calib.evidence import heldout
from calib.evidence.coverage import coverage, next_view
from calib.evidence.heldout import held_out
from calib.evidence.linear import derivative, moments_of, seen_px, shifted
from calib.evidence.uncertainty import projection_uncertainty, transfer_uncertainty
from calib.evidence.verdict import Evidence, gather, judge
from calib.observations import View
from calib.scenes import Scene, perturbed, scene
from calib.solve import Solution, solve
from calib.solve.motion import moved
from fusion.geometry import Floats, transform

VIEWS = 12


def solved(seed: int = 0, views: int = VIEWS, **options: object) -> tuple[Scene, Solution]:
    made = scene(seed, views, lidar=False, **options)  # type: ignore[arg-type]
    return made, solve(made.board, made.views, start=made.truth)


@pytest.fixture(scope="module")
def usual() -> tuple[Scene, Solution]:
    return solved()


def landed(solution: Solution, uv: Floats, depth_m: float) -> Floats:
    """Where a thermal pixel, so far away, comes to lie on RGB."""
    points = solution.estimate.cameras["fir"].unproject(uv) * depth_m
    return solution.estimate.cameras["rgb"].project(transform(solution.estimate.T_ref_sensor["fir"], points))[
        0
    ]


def test_transfer_uncertainty_is_the_spread_of_many_calibrations(usual: tuple[Scene, Solution]) -> None:
    uv, depth = np.array([[320.0, 256.0]]), 2.0
    made, first = usual
    runs = [first]
    rng = np.random.default_rng(5)
    clean = replace(first.estimate)
    for _ in range(24):  # the same views with other noise
        views = [
            replace(v, uv=seen_px(made.board, v, made.truth) + rng.normal(0, 0.1, v.uv.shape))
            for v in made.views
        ]
        runs.append(solve(made.board, views, start=clean))
    spread = np.cov(np.concatenate([landed(run, uv, depth) for run in runs[1:]]).T)
    found = transfer_uncertainty(first, "rgb", "fir", depth)
    row, column = (
        (np.abs(found.uv - uv[0]).sum(-1)).argmin() // 24,
        (np.abs(found.uv - uv[0]).sum(-1)).argmin() % 24,
    )
    expected = np.sqrt(np.linalg.eigvalsh(spread)[-1])
    # the standard deviation of a deviation from 24 runs is 15 %; the grid's pixel is some px off
    assert found.sigma_px[row, column] == pytest.approx(expected, rel=0.35)


def test_a_shift_is_undone_by_its_opposite(usual: tuple[Scene, Solution]) -> None:
    _, solution = usual
    for name in solution.names:
        there = shifted(solution.estimate, name, 1e-3)
        back = shifted(there, name, -1e-3)
        for sensor, T in solution.estimate.T_ref_sensor.items():
            assert np.allclose(back.T_ref_sensor[sensor], T, atol=1e-12)
        assert all(
            np.allclose([c.fx, c.cy, *c.distortion], [d.fx, d.cy, *d.distortion], atol=1e-12)
            for c, d in zip(back.cameras.values(), solution.estimate.cameras.values(), strict=True)
        )
        assert there != back
    with pytest.raises(ValueError, match=r"rgb\.nothing"):
        shifted(solution.estimate, "rgb.nothing", 1.0)


def test_derivative_is_that_of_a_known_function(usual: tuple[Scene, Solution]) -> None:
    _, solution = usual
    J = derivative(solution, lambda e: np.array([e.cameras["rgb"].fx ** 2, e.T_ref_sensor["fir"][1, 3]]))
    assert J[0, solution.names.index("rgb.fx")] == pytest.approx(2 * solution.estimate.cameras["rgb"].fx)
    assert J[1, solution.names.index("T_rgb_fir.ty")] == pytest.approx(1)
    assert np.count_nonzero(np.abs(J) > 1e-6) == 2


def test_information_of_the_moments_is_the_solvers_covariance(usual: tuple[Scene, Solution]) -> None:
    """Two ways to the same: differences here, the solver's analytic derivatives there."""
    made, solution = usual
    information = np.sum([m.information() for m in moments_of(made.board, solution)], 0)
    ours, theirs = np.linalg.inv(information), solution.covariance
    assert np.sqrt(np.diag(ours)) == pytest.approx(np.sqrt(np.diag(theirs)), rel=0.05)


def test_the_lidar_counts_with_its_plane_and_its_rim() -> None:
    """As above, with clouds; a point that the solver left out counts in neither."""
    made = scene(1, VIEWS)
    spoilt = replace(made.clouds[0], plane_m=made.clouds[0].plane_m + np.eye(200, 1) * 0.5)
    solution = solve(made.board, made.views, [spoilt, *made.clouds[1:]], start=made.truth)
    assert not solution.plane_used[0].all()
    information = np.sum([m.information() for m in moments_of(made.board, solution)], 0)
    ours, theirs = np.linalg.inv(information), solution.covariance
    assert np.sqrt(np.diag(ours)) == pytest.approx(np.sqrt(np.diag(theirs)), rel=0.05)


def test_uncertainty_grows_where_no_point_was_seen(usual: tuple[Scene, Solution]) -> None:
    made, solution = usual
    found = projection_uncertainty(made.board, solution, "rgb", 1.5)
    assert found.sigma_px[9, 12] < 0.2
    assert found.sigma_px[0, 0] > 2 * found.sigma_px[9, 12]
    assert found.worst_px >= found.median_px >= 0


def test_four_times_the_views_halve_the_uncertainty(usual: tuple[Scene, Solution]) -> None:
    made, solution = usual
    more, richer = solved(1, 4 * VIEWS)
    few = projection_uncertainty(made.board, solution, "rgb", 1.5).median_px
    assert projection_uncertainty(more.board, richer, "rgb", 1.5).median_px == pytest.approx(
        few / 2, rel=0.35
    )


def test_coverage_says_where_nothing_was_shown(usual: tuple[Scene, Solution]) -> None:
    made, _ = usual
    left = [
        replace(v, ids=v.ids[keep], uv=v.uv[keep])
        for v in made.views
        if v.camera == "rgb" and (keep := v.uv[:, 0] < 300).sum() > 20
    ]
    solution = solve(made.board, left, start=made.truth, fixed=("rgb", "fir"))
    found = coverage(made.board, solution, "rgb")
    assert found.cells[:, 4:].sum() == 0
    assert found.cells.sum() == sum(int(u.sum()) for u in solution.used)
    assert found.share <= 0.5
    assert any("right" in fault for fault in found.faults())
    T = made.truth.T_ref_board[left[0].moment]
    middle = transform(T, made.board.points_m.mean(0)[None])[0]
    assert found.distance_m[0] == pytest.approx(np.linalg.norm(middle), rel=0.01)


def test_next_view_helps_as_it_says(usual: tuple[Scene, Solution]) -> None:
    made, solution = usual
    advice = next_view(made.board, solution, "rgb")
    assert advice is not None
    assert advice.then_px < advice.now_px
    assert advice.words.startswith("the board at the ")
    fixed = solve(made.board, made.views, start=made.truth, fixed=("rgb",))
    assert next_view(made.board, fixed, "rgb") is None


def test_held_out_error_is_the_noise_for_a_sound_model(usual: tuple[Scene, Solution]) -> None:
    made, solution = usual
    judged = held_out(made.board, solution, folds=4)
    assert judged.failed == 0
    assert judged.views == len(made.views)
    for camera in ("rgb", "fir"):
        assert judged.own_px[camera] == pytest.approx(solution.rms_px(camera), rel=0.25)
    assert judged.across_px["rgb", "fir"] > judged.own_px["rgb"]
    assert judged.across_px["rgb", "fir"] < 4 * judged.own_px["rgb"]


def test_every_moment_is_left_out_once(
    usual: tuple[Scene, Solution], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A spy around the real solver: what it was not given is what is judged, and that is everything once."""
    made, solution = usual
    left_out: list[str] = []

    def spy(board: Board, views: Sequence[View], *clouds: object, **options: Any) -> Solution:
        given = {view.moment for view in views}
        assert given == set(options["start"].T_ref_board)
        left_out.extend(set(solution.estimate.T_ref_board) - given)
        return solve(board, views, *clouds, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(heldout, "solve", spy)
    judged = held_out(made.board, solution, folds=4)
    assert sorted(left_out) == sorted(solution.estimate.T_ref_board)
    assert judged.folds == 4


@pytest.fixture(scope="module")
def evidence(usual: tuple[Scene, Solution]) -> Evidence:
    return gather(usual[0].board, usual[1])


def test_verdict_is_good_for_a_good_rig_and_not_for_a_bad_one(
    usual: tuple[Scene, Solution], evidence: Evidence
) -> None:
    _, solution = usual
    assert evidence.verdict.grade == "good"
    assert any("laying fir on rgb" in line for line in evidence.verdict.good_for)
    spoilt = replace(solution, covariance=4e4 * solution.covariance)
    maps = {("rgb", "fir"): {d: transfer_uncertainty(spoilt, "rgb", "fir", d) for d in (1.0, 5.0)}}
    bad = judge(spoilt, evidence.coverage, maps, evidence.held_out, {})
    assert bad.grade != "good"
    assert any("laying fir on rgb" in line for line in bad.not_for)


def test_verdict_warns_of_the_rim(usual: tuple[Scene, Solution], evidence: Evidence) -> None:
    found = evidence.projection["rgb"]
    sure, unsure = (replace(found, sigma_px=scale * found.sigma_px / found.worst_px) for scale in (2.9, 3.1))
    said = [
        judge(usual[1], evidence.coverage, {}, evidence.held_out, {}, {"rgb": one}).not_for
        for one in (sure, unsure)
    ]
    assert not any("rim of rgb" in line for line in said[0])
    assert any("rim of rgb" in line and "3.1 px" in line for line in said[1])


def test_verdict_says_when_the_model_does_not_fit(usual: tuple[Scene, Solution], evidence: Evidence) -> None:
    _, solution = usual
    rough = replace(solution, residual_px=tuple(40 * r for r in solution.residual_px))
    found = judge(rough, evidence.coverage, evidence.transfer, evidence.held_out, {})
    assert found.grade == "not usable"
    assert any("rms" in line for line in found.not_for)


def test_a_start_far_off_leads_to_the_same_evidence() -> None:
    made = scene(2, VIEWS, lidar=False)
    near, far = (solve(made.board, made.views, start=s) for s in (made.truth, perturbed(made.truth, 1)))
    a, b = (projection_uncertainty(made.board, s, "rgb", 1.5).sigma_px for s in (near, far))
    assert np.allclose(a, b, rtol=1e-3)


def test_moved_is_what_the_covariance_speaks_of(usual: tuple[Scene, Solution]) -> None:
    _, solution = usual
    name = "T_rgb_fir.rz"
    there = shifted(solution.estimate, name, 0.01).T_ref_sensor["fir"]
    assert np.allclose(there, moved(solution.estimate.T_ref_sensor["fir"], np.array([0, 0, 0.01, 0, 0, 0])))
