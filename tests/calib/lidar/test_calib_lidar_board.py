"""Boards in clouds made here: a plate before a wall, seen by a spinning LiDAR with a known place."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib.boards import Board
from calib.lidar.board import CloudBoard, find_in_cloud
from calib.lidar.start import edge_distances, lidar_start
from calib.observations import Refusal
from fusion.errors import InputError, UsageError
from fusion.geometry import T_CAM_LIDAR, Floats, invert, pose, transform

PLATE = (-0.1, -0.08, 0.7, 0.52)
NOISE_M = 0.01
T_CAM_TRUE = pose(Rotation.from_rotvec([0.03, -0.05, 0.02]).as_matrix(), (0.04, -0.12, -0.06)) @ T_CAM_LIDAR


def board(plate: tuple[float, float, float, float] | None = PLATE) -> Board:
    j, i = np.meshgrid(np.arange(8), np.arange(6))
    points = 0.08 * np.stack([j.ravel(), i.ravel(), 0 * j.ravel()], 1).astype(np.float64)
    return Board("chessboard", 8, 6, 0.08, points, np.ones(48, np.bool_), plate)


def cloud(
    T_lidar_board: Floats | None, seed: int = 0, noise_m: float = NOISE_M
) -> tuple[Floats, NDArray[np.int64]]:
    """Rays 0.35 x 0.7 degrees apart, ahead; a wall at x = 6 m, a floor, and a plate."""
    azimuth, elevation = np.radians(np.arange(50, -50, -0.35)), np.radians(np.arange(-22, 22, 0.7))
    e, a = np.meshgrid(elevation, azimuth, indexing="ij")
    ray = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1).reshape(-1, 3)
    ring = np.repeat(np.arange(len(elevation)), len(azimuth))
    with np.errstate(divide="ignore"):
        r = np.minimum(6 / ray[:, 0], np.where(ray[:, 2] < 0, -1.5 / ray[:, 2], np.inf))
    if T_lidar_board is not None:
        n, o = T_lidar_board[:3, 2], T_lidar_board[:3, 3]
        hit = (n @ o) / (ray @ n)
        x, y, _ = ((ray * hit[:, None] - o) @ T_lidar_board[:3, :3]).T
        inside = (x > PLATE[0]) & (x < PLATE[2]) & (y > PLATE[1]) & (y < PLATE[3]) & (hit > 0)
        r = np.where(inside & (hit < r), hit, r)
    r = r + noise_m * np.random.default_rng(seed).standard_normal(len(r))
    return ray * r[:, None], ring


def poses(count: int, tilt: float = 0.6) -> dict[str, Floats]:
    """T_cam_board, tilted about axes all round, some of them turned in their plane."""
    rng = np.random.default_rng(5)
    found = {}
    for k in range(count):
        a = 2 * np.pi * k / count + 0.3
        R = Rotation.from_rotvec(tilt * np.array([np.cos(a), np.sin(a), 0])) * Rotation.from_rotvec(
            [0, 0, rng.uniform(-0.3, 0.3)]
        )
        middle = np.array([rng.uniform(-0.5, 0.5), rng.uniform(-0.25, 0.25), rng.uniform(1.6, 3)])
        found[f"{k:02d}"] = pose(R.as_matrix(), middle - R.as_matrix() @ [0.3, 0.22, 0])
    return found


def angle(A: Floats, B: Floats) -> float:
    return float(np.linalg.norm(Rotation.from_matrix(A[:3, :3] @ B[:3, :3].T).as_rotvec()))


FACING = invert(T_CAM_TRUE) @ pose(Rotation.from_rotvec([0.3, -0.4, 0.1]).as_matrix(), (-0.4, -0.3, 2.2))


@pytest.mark.parametrize("guessed", [True, False])
def test_a_plate_is_found_where_it_is(guessed: bool) -> None:
    xyz, ring = cloud(FACING)
    off = pose(Rotation.from_rotvec([0.1, -0.08, 0.06]).as_matrix(), (0.1, -0.1, 0.1))
    guess = pose(FACING[:3, :3] @ off[:3, :3], FACING[:3, 3] + off[:3, 3]) if guessed else None
    found = find_in_cloud(xyz, board(), T_lidar_board_guess=guess, rings=ring, moment="m")
    assert isinstance(found, CloudBoard)
    # About 1100 points of 1 cm, rims known to some mm each.
    assert angle(found.T_lidar_board, FACING) < 0.01
    assert np.linalg.norm(found.T_lidar_board[:3, 3] - FACING[:3, 3]) < 0.008
    assert found.sigma_plane_m == pytest.approx(NOISE_M * 0.9, rel=0.25)
    on_board = transform(invert(FACING), found.view.plane_m)
    assert abs(on_board[:, 2].mean()) < 0.002
    assert (on_board[:, :2] > np.array(PLATE[:2]) - 0.02).all()
    assert (on_board[:, :2] < np.array(PLATE[2:]) + 0.02).all()


@pytest.mark.parametrize("with_rings", [True, False])
def test_the_rim_is_where_the_plate_ends_on_every_side(with_rings: bool) -> None:
    xyz, ring = cloud(FACING)
    found = find_in_cloud(xyz, board(), T_lidar_board_guess=FACING, rings=ring if with_rings else None)
    assert isinstance(found, CloudBoard)
    assert found.sigma_edge_m < 0.012  # a step of 0.35 to 0.7 degrees at 2.3 m, over root 12
    out = edge_distances(transform(invert(FACING), found.view.edge_m), found.view.edge_of, board())
    for side in range(4):
        mine = out[found.view.edge_of == side]
        assert len(mine) >= 8
        assert (
            abs(mine.mean()) < 0.004
        )  # the last ray on the plate alone would be half a step, 7 to 14 mm, inside
        assert np.abs(mine).max() < 0.03


def test_the_rim_is_known_before_the_sky_if_rings_are() -> None:
    xyz, ring = cloud(FACING)
    near = np.linalg.norm(xyz, axis=1) < 3.2
    behind_nothing = near & (xyz[:, 2] > -1.2)  # all that is left is the plate
    alone = find_in_cloud(xyz[behind_nothing], board(), T_lidar_board_guess=FACING)
    rings = find_in_cloud(
        xyz[behind_nothing], board(), T_lidar_board_guess=FACING, rings=ring[behind_nothing]
    )
    assert isinstance(rings, CloudBoard)
    assert not isinstance(alone, CloudBoard) or not len(alone.view.edge_m)
    out = edge_distances(transform(invert(FACING), rings.view.edge_m), rings.view.edge_of, board())
    assert len(out) >= 30
    assert abs(out.mean()) < 0.004


def test_invalid_points_are_counted_and_the_input_is_left_alone() -> None:
    xyz, ring = cloud(FACING)
    xyz[::50] = np.nan
    xyz[1::70] = 0
    xyz[2::90, 1] = np.inf
    bad = int((~np.isfinite(xyz).all(1) | (xyz == 0).all(1)).sum())
    before = xyz.copy()
    found = find_in_cloud(xyz, board(), T_lidar_board_guess=FACING, rings=ring)
    assert isinstance(found, CloudBoard)
    assert found.invalid == bad
    assert np.isfinite(found.view.plane_m).all()
    np.testing.assert_array_equal(xyz, before)


def test_no_board_is_a_refusal_in_words() -> None:
    xyz, ring = cloud(None)
    for guess in (None, FACING):
        found = find_in_cloud(xyz, board(), T_lidar_board_guess=guess, rings=ring)
        assert isinstance(found, Refusal)
    assert "m away" in found.reason
    empty = find_in_cloud(np.full((9, 3), np.nan), board())
    assert isinstance(empty, Refusal)
    assert "9 of no use" in empty.reason


def test_a_board_of_another_size_is_refused() -> None:
    xyz, ring = cloud(FACING)
    twice = board((-0.1, -0.08, 1.5, 1.12))
    assert isinstance(find_in_cloud(xyz, twice, T_lidar_board_guess=FACING, rings=ring), Refusal)


def test_too_few_points_on_the_board_say_how_many_and_how_far() -> None:
    xyz, ring = cloud(FACING)
    thin = np.r_[np.arange(0, len(xyz), 60)]
    found = find_in_cloud(xyz[thin], board(), T_lidar_board_guess=FACING, rings=ring[thin])
    assert isinstance(found, Refusal)
    assert "points" in found.reason


def test_the_plate_must_be_known() -> None:
    with pytest.raises(UsageError, match="plate_m"):
        find_in_cloud(np.ones((50, 3)), board(None))


def start_of(count: int = 8, **changes: object) -> tuple[dict[str, Floats], dict[str, Floats], dict]:
    T_cam_board = poses(count)
    scans = {m: cloud(invert(T_CAM_TRUE) @ T, seed) for seed, (m, T) in enumerate(T_cam_board.items())}
    return T_cam_board, {m: s[0] for m, s in scans.items()}, {m: s[1] for m, s in scans.items()}


@pytest.fixture(scope="module")
def scans() -> tuple[dict[str, Floats], dict[str, Floats], dict]:
    return start_of()


def test_the_lidar_is_placed_to_the_noise(scans: tuple[dict, dict, dict]) -> None:
    T_cam_board, clouds, rings = scans
    found = lidar_start(board(), T_cam_board, clouds, rings=rings)
    assert len(found.views) == 8
    assert found.dropped == ()
    # Eight poses of 700 to 2000 points of 1 cm: sigma is 0.4 mrad and 1 mm; the issue asks for 1 mrad and 5
    # mm.
    assert angle(found.T_ref_lidar, T_CAM_TRUE) < 1.5e-3
    assert np.linalg.norm(found.T_ref_lidar[:3, 3] - T_CAM_TRUE[:3, 3]) < 4e-3
    assert found.sigma_plane_m == pytest.approx(NOISE_M, rel=0.3)


def test_bad_poses_are_dropped_by_name(scans: tuple[dict, dict, dict]) -> None:
    T_cam_board, clouds, rings = scans
    wrong = dict(T_cam_board)
    wrong["03"] = wrong["03"] @ pose(Rotation.from_rotvec([0.15, 0.1, 0]).as_matrix(), (0.05, 0, 0.02))
    wrong["90"] = wrong["00"]
    missing = {m: c for m, c in clouds.items() if m != "05"} | {"91": clouds["01"]}
    found = lidar_start(board(), wrong, missing, rings=rings)
    reasons = dict(found.dropped)
    assert set(reasons) == {"03", "05", "90", "91"}
    assert "agree" in reasons["03"]
    assert "no cloud" in reasons["05"]
    assert "not known" in reasons["91"]
    assert angle(found.T_ref_lidar, T_CAM_TRUE) < 2e-3
    assert {v.moment for v in found.views} == {"00", "01", "02", "04", "06", "07"}


def test_a_lidar_that_looks_elsewhere_is_found_without_a_guess(scans: tuple[dict, dict, dict]) -> None:
    """The LiDAR's own axes turned by 40 degrees: the convention does not lead to the board."""
    T_cam_board, clouds, rings = scans
    turned = pose(Rotation.from_rotvec([0, 0, 0.7]).as_matrix())
    some = sorted(clouds)[::2]
    moved = {m: transform(turned, clouds[m]) for m in some}
    found = lidar_start(board(), {m: T_cam_board[m] for m in some}, moved, rings=rings)
    expected = T_CAM_TRUE @ invert(turned)
    assert angle(found.T_ref_lidar, expected) < 3e-3
    assert np.linalg.norm(found.T_ref_lidar[:3, 3] - expected[:3, 3]) < 6e-3


def test_too_few_or_parallel_poses_are_refused(scans: tuple[dict, dict, dict]) -> None:
    T_cam_board, clouds, rings = scans
    two = {m: clouds[m] for m in ("00", "01")}
    with pytest.raises(InputError, match="2 clouds, at least 3"):
        lidar_start(board(), T_cam_board, two, rings=rings)
    flat = {f"{k}": pose(np.eye(3), (-0.5 + 0.1 * k, -0.3, 1.8 + 0.2 * k)) for k in range(4)}
    parallel = {m: cloud(invert(T_CAM_TRUE) @ T)[0] for m, T in flat.items()}
    with pytest.raises(InputError, match="parallel"):
        lidar_start(board(), flat, parallel)
