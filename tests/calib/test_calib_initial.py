"""Starts from planes alone: poses on any lens, focal lengths, sensors' places; against known truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.boards import Board
from calib.initial import (
    board_pose,
    frame_points,
    initial_camera,
    misfit_rad,
    poses_of,
    refine_link,
    rigid_fit,
    seen_from_behind,
    spread_views,
    symmetry_motions,
)
from calib.observations import View
from fusion.errors import UsageError
from fusion.geometry import FisheyeCamera, Floats, PinholeCamera, pose, transform
from fusion.rig import RigCamera

BOARD = Board.of("chessboard", 9, 6, 0.08)
LENSES: dict[str, tuple[str, RigCamera]] = {
    "tele": ("pinhole", PinholeCamera((640, 480), 2200, 2190, 330, 250, (-0.1, 0.2, 0, 0, 0))),
    "wide": ("pinhole", PinholeCamera((640, 480), 300, 302, 310, 245, (-0.25, 0.06, 0.001, -0.001, -0.005))),
    "rational": (
        "rational",
        PinholeCamera((1280, 960), 430, 431, 650, 470, (0.5, 0.05, 5e-4, -3e-4, 0.002, 0.85, 0.15, 0.01)),
    ),
    "fisheye 190": ("fisheye", FisheyeCamera((800, 800), 230, 231, 410, 395, (-0.01, 0.006, -0.004, 0.0006))),
}


def turn(x_deg: float, y_deg: float, z_deg: float) -> Floats:
    return Rotation.from_euler("xyz", [x_deg, y_deg, z_deg], degrees=True).as_matrix()


def boards(camera: RigCamera, count: int, seed: int, share: float = 0.4) -> list[tuple[Floats, View]]:
    """Boards anywhere in the picture, tilted by up to 40 degrees, with at least `share` of their points."""
    rng, (w, h), found = np.random.default_rng(seed), camera.size_wh, []
    least = share * len(BOARD.points_m)
    while len(found) < count:
        ray = camera.unproject(rng.uniform((0, 0), (w, h))[None])[0]
        if not np.isfinite(ray).all():
            continue
        facing = Rotation.align_vectors([ray], [[0, 0, 1]])[0].as_matrix()
        R = facing @ turn(*rng.uniform((-40, -40, -20), (40, 40, 20)))
        T = pose(R, ray * rng.uniform(0.4, 2.0) * max(1, camera.fx / 400) - R @ BOARD.points_m.mean(0))
        uv, ok = camera.project(transform(T, BOARD.points_m))
        ids = np.flatnonzero(ok & ((uv > 0) & (uv < (w - 1, h - 1))).all(1))
        if len(ids) >= least:
            name = f"{len(found):02d}"
            noisy = uv[ids] + rng.normal(0, 0.1, (len(ids), 2))
            found.append((T, View("rgb", name, ids, noisy, (w, h), 0.0, name)))
    return found


@pytest.mark.parametrize("name", LENSES)
def test_a_pose_in_one_view_of_any_lens(name):
    """Noise of 0.1 px moves a pose's points by a few tenths; the rms is that of the noise."""
    _, camera = LENSES[name]
    for T, view in boards(camera, 6, 0):
        found = board_pose(BOARD, camera, view.ids, view.uv)
        assert found is not None
        assert found[1] < 0.25
        exact = board_pose(BOARD, camera, view.ids, camera.project(transform(T, BOARD.points_m[view.ids]))[0])
        assert exact is not None
        if (
            min(np.linalg.svd(BOARD.points_m[view.ids][:, :2] - BOARD.points_m[view.ids][:, :2].mean(0))[1])
            > 0.2
        ):
            assert np.abs(exact[0] - T).max() < 1e-4


def test_many_poses_are_those_of_one_by_one():
    _, camera = LENSES["wide"]
    views = [view for _, view in boards(camera, 5, 3)]
    short = View("rgb", "x", np.arange(3), np.ones((3, 2)), camera.size_wh)
    poses, rms = poses_of(BOARD, camera, [*views, short])
    assert sorted(poses) == [0, 1, 2, 3, 4]
    for k, view in enumerate(views):
        one = board_pose(BOARD, camera, view.ids, view.uv)
        assert one is not None
        np.testing.assert_allclose(poses[k], one[0], atol=1e-9)
        assert rms[k] == pytest.approx(one[1])
    assert poses_of(BOARD, camera, []) == ({}, {})


def test_no_pose_from_a_line_or_too_few_points():
    _, camera = LENSES["wide"]
    ((_, view),) = boards(camera, 1, 4, share=1.0)
    assert board_pose(BOARD, camera, view.ids[:9], view.uv[:9]) is None  # one row
    assert board_pose(BOARD, camera, view.ids[[0, 1, 9, 10, 20]], view.uv[[0, 1, 9, 10, 20]]) is None


@pytest.mark.parametrize(("name", "seed"), [(name, k % 2) for k, name in enumerate(LENSES)])
def test_a_lens_near_enough_to_start_from(name, seed):
    """Within 20 % of the focal length, and most poses leave a few pixels: the solver's valley is wider."""
    model, camera = LENSES[name]
    views = [view for _, view in boards(camera, 10, seed)]
    start = initial_camera(BOARD, views, model)
    assert start.size_wh == camera.size_wh
    assert abs(start.fx / camera.fx - 1) < 0.2
    assert isinstance(start, FisheyeCamera) == (model == "fisheye")
    assert len(start.distortion) == len(camera.distortion)
    assert np.median(list(poses_of(BOARD, start, views)[1].values())) < 5


def test_an_unknown_model_names_the_known_ones():
    with pytest.raises(
        UsageError, match=r"unknown camera model 'pinhole3'.*pinhole, radtan, rational, fisheye"
    ):
        initial_camera(BOARD, [boards(LENSES["wide"][1], 1, 0)[0][1]], "pinhole3")


def test_views_that_differ_most_are_chosen():
    """Ten of one place and three elsewhere: of four, the three are all there."""
    _, camera = LENSES["wide"]
    (_, same), *others = boards(camera, 4, 8, share=1.0)
    crowd = [View("rgb", f"same{k}", same.ids, same.uv + 0.1 * k, same.size_wh) for k in range(10)]
    chosen = spread_views([*crowd, *(view for _, view in others)], 4)
    assert {view.moment for view in chosen} >= {view.moment for _, view in others}
    assert spread_views(crowd, 20) == crowd


def test_a_mirrored_labelling_is_seen_from_behind():
    _, camera = LENSES["wide"]
    for _, view in boards(camera, 5, 2):
        assert not seen_from_behind(BOARD, view)
        flipped = View("rgb", "", view.ids, view.uv * (-1, 1) + (639, 0), view.size_wh)
        assert seen_from_behind(BOARD, flipped)


def test_symmetry_motions_move_points_to_their_labels():
    for board in (
        BOARD,
        Board.of("chessboard", 5, 5, 0.1),
        Board.of("chessboard", 7, 6, 0.1, hidden=[[0, 0, 2, 2]]),
    ):
        motions, labels = symmetry_motions(board), board.symmetries()
        assert len(motions) == len(labels)
        seen = np.flatnonzero(board.visible)
        for S, relabel in zip(motions, labels, strict=True):
            np.testing.assert_allclose(
                transform(S, board.points_m[seen]), board.points_m[relabel[seen]], atol=1e-9
            )
            assert np.linalg.det(S[:3, :3]) == pytest.approx(1)


def test_rigid_fit_recovers_a_motion():
    rng = np.random.default_rng(0)
    T, xyz = pose(turn(20, -100, 60), (1, 2, 3)), rng.normal(size=(20, 3))
    np.testing.assert_allclose(rigid_fit(xyz, transform(T, xyz)), T, atol=1e-12)


def test_a_link_is_refined_past_wrong_moments():
    """One moment in ten far off: as good as least squares without them, to half of what the noise does."""
    rng = np.random.default_rng(1)
    T_a_b = pose(turn(3, -2, 1), (0.3, 0.02, -0.05))
    there = np.stack(
        [pose(turn(*rng.uniform(-30, 30, 3)), (*rng.uniform(-0.5, 0.5, 2), 2)) for _ in range(40)]
    )
    here, wrong = T_a_b @ there, np.arange(40) % 10 == 0
    for k in range(40):
        noise = 0.4 if wrong[k] else 0.002
        jolt = Rotation.from_rotvec(rng.normal(0, noise, 3)).as_matrix()
        here[k] = here[k] @ pose(jolt, rng.normal(0, noise, 3))
    xyz, rough = frame_points(BOARD), pose(turn(4, -4, 2), (0.33, 0, 0))
    found = refine_link(rough, here, there, xyz)
    clean = refine_link(rough, here[~wrong], there[~wrong], xyz)
    assert np.abs(clean - T_a_b).max() < 0.02
    assert np.abs(found - clean).max() < 0.005
    exact = misfit_rad(T_a_b, T_a_b @ there, there, xyz)
    assert exact.shape == (40,)
    assert exact.max() < 1e-9
