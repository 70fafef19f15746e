"""Labels that agree over cameras: turned boards, cut boards, mirrors, and which camera hangs on which."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.boards import Board
from calib.links import find_link, join_views, mirrored_camera, reflection
from calib.observations import View
from calib.scenes import MODELS, T_RGB_FIR, scene
from fusion.errors import InputError
from fusion.geometry import FisheyeCamera, Floats, PinholeCamera, invert, pose, transform

BOARD = Board.of("chessboard", 9, 6, 0.08)
SESSION = scene(7, 12, lidar=False)
CAMERAS = SESSION.truth.cameras


def join(views, moment_ns=None):
    return join_views(BOARD, CAMERAS, views, "rgb", moment_ns)


def close_to_truth(T: Floats) -> bool:
    off = T @ invert(T_RGB_FIR)
    return bool(Rotation.from_matrix(off[:3, :3]).magnitude() < 3e-3 and np.abs(off[:3, 3]).max() < 6e-3)


def fir(views, change) -> list[View]:
    return [change(k, v) if v.camera == "fir" else v for k, v in enumerate(views)]


def labels_agree(views) -> bool:
    """Whether all labels are those of the truth (up to one turn for all of them)."""
    ids = {(v.camera, v.moment): v for v in views}
    return all(np.array_equal(ids[v.camera, v.moment].ids, v.ids) for v in SESSION.views)


def test_views_that_agree_stay_as_they_are():
    found = join(SESSION.views)
    assert close_to_truth(found.T_ref_sensor["fir"])
    assert labels_agree(found.views)
    assert not found.dropped
    assert not found.notes
    for moment, T in SESSION.truth.T_ref_board.items():
        assert np.abs(found.T_ref_board[moment] - T).max() < 0.03


def test_boards_labelled_turned_by_half_are_turned_back():
    half = BOARD.symmetries()[1]
    found = join(fir(SESSION.views, lambda k, v: replace(v, ids=half[v.ids]) if k % 3 else v))
    assert labels_agree(found.views)
    assert close_to_truth(found.T_ref_sensor["fir"])
    turned = sum(v.camera == "fir" and k % 3 > 0 for k, v in enumerate(SESSION.views))
    assert found.notes[0].startswith(f"{turned} views had the board turned")


def test_a_square_board_has_four_turns():
    board = Board.of("chessboard", 6, 6, 0.08)
    turns, rng = board.symmetries(), np.random.default_rng(2)
    assert len(turns) == 4
    views = []
    for moment, T in SESSION.truth.T_ref_board.items():
        for name, camera in CAMERAS.items():
            uv, ok = camera.project(transform(invert(SESSION.truth.T_ref_sensor[name]) @ T, board.points_m))
            ids = turns[rng.integers(4)] if name == "fir" else np.arange(36)
            views.append(View(name, moment, ids[ok], uv[ok], camera.size_wh, 0.0, f"{name}{moment}"))
    found = join_views(board, CAMERAS, views, "rgb")
    assert close_to_truth(found.T_ref_sensor["fir"])
    assert all(np.array_equal(v.ids, np.arange(36)) for v in found.views)


def test_a_cut_board_labelled_a_column_off_is_dropped_and_named():
    """Alone it fits as well as any other."""

    def shift(_: int, view: View) -> View:
        ok = view.ids % 9 < 8
        return replace(view, ids=view.ids[ok] + 1, uv=view.uv[ok]) if view.moment in {"003", "007"} else view

    found = join(fir(SESSION.views, shift))
    assert [file for file, _ in found.dropped] == ["fir/003.png", "fir/007.png"]
    assert all("wrongly labelled, or moved" in reason for _, reason in found.dropped)
    assert close_to_truth(found.T_ref_sensor["fir"])
    assert {"003", "007"} <= set(found.T_ref_board)  # rgb still has them


@pytest.mark.parametrize(("axis", "word"), [(0, "left-right"), (1, "top-bottom")])
def test_a_mirrored_stream_is_said_to_be_one(axis, word):
    """Labelled as a detector labels a mirrored image: the board in it is a proper one, of another world."""
    grid = np.arange(54).reshape(6, 9)
    mirror = (grid[:, ::-1] if axis == 0 else grid[::-1]).ravel()

    def flip(_: int, view: View) -> View:
        uv = view.uv.copy()
        uv[:, axis] = view.size_wh[axis] - 1 - uv[:, axis]
        return replace(view, ids=mirror[view.ids], uv=uv)

    with pytest.raises(InputError, match=f"fir are mirrored {word} against rgb's") as error:
        join(fir(SESSION.views, flip))
    assert f"flip fir {word}" in str(error.value)


def test_mismatched_moments_are_not_called_mirrored():
    names = sorted(SESSION.truth.T_ref_board)
    following = dict(zip(names, names[1:] + names[:1], strict=True))
    with pytest.raises(
        InputError, match=r"rgb and fir: they do not agree .* of 12 moments .*matched rightly"
    ):
        join(fir(SESSION.views, lambda _, v: replace(v, moment=following[v.moment])))


def test_cameras_that_share_nothing_give_the_table():
    apart = fir(SESSION.views, lambda _, v: replace(v, moment=v.moment + "f"))
    with pytest.raises(InputError, match="fir: no moment in which it and rgb saw the board") as error:
        join(apart)
    assert "rgb-fir: 0 shared" in str(error.value)
    late = {m: int(m[:3]) * 10**9 + (80_500_000 if m.endswith("f") else 0) for m in {v.moment for v in apart}}
    with pytest.raises(
        InputError, match=r"nearest images 80.5 ms apart.*allow 0.089 s between .* rgb and fir"
    ):
        join(apart, late)


def test_a_camera_is_reached_through_a_third():
    """rgb and nir share nothing; fir saw the board with both."""
    nir, T_rgb_nir = MODELS["pinhole0"], pose(np.eye(3), (-0.2, 0.0, 0.0))
    cameras = {**CAMERAS, "nir": nir}
    views: list[View] = []
    for k, (moment, T) in enumerate(SESSION.truth.T_ref_board.items()):
        poses = {"rgb": T, "fir": invert(T_RGB_FIR) @ T, "nir": invert(T_rgb_nir) @ T}
        for name in ("rgb", "fir") if k % 2 else ("fir", "nir"):
            uv, ok = cameras[name].project(transform(poses[name], BOARD.points_m))
            size = cameras[name].size_wh
            views.append(View(name, moment, np.flatnonzero(ok), uv[ok], size, 0.0, f"{name}{moment}"))
    found = join_views(BOARD, cameras, views, "rgb")
    np.testing.assert_allclose(found.T_ref_sensor["fir"], T_RGB_FIR, atol=1e-4)
    np.testing.assert_allclose(found.T_ref_sensor["nir"], T_rgb_nir, atol=1e-4)
    with pytest.raises(InputError, match="nir: no moment in which it and rgb or fir saw"):
        join_views(
            BOARD, cameras, [v for v in views if not (v.camera == "fir" and int(v.moment) % 2 == 0)], "rgb"
        )


def test_of_three_the_one_that_contradicts_goes():
    """With two that agree it is the third, however many points it has."""
    cameras = {**CAMERAS, "nir": MODELS["pinhole0"]}
    views = [v for v in SESSION.views if v.moment < "008"]
    for moment in sorted({v.moment for v in views}):
        uv, ok = cameras["nir"].project(transform(SESSION.truth.T_ref_board[moment], BOARD.points_m))
        views.append(View("nir", moment, np.flatnonzero(ok), uv[ok], (640, 480), 0.0, f"nir/{moment}.png"))
    k = next(i for i, v in enumerate(views) if v.camera == "rgb" and v.moment == "002")
    views[k] = replace(views[k], uv=views[k].uv + np.array([60, 0]))
    found = join_views(BOARD, cameras, views, "rgb")
    assert [file for file, _ in found.dropped] == ["rgb/002.png"]


def test_one_shared_moment_takes_the_least_turn():
    """A board that looks the same turned by half: cameras that look the same way are the likelier."""
    one = [v for v in SESSION.views if v.moment == "001"]
    half = BOARD.symmetries()[1]
    found = join(fir(one, lambda _, v: replace(v, ids=half[v.ids])))
    off = found.T_ref_sensor["fir"][:3, :3] @ T_RGB_FIR[:3, :3].T
    assert Rotation.from_matrix(off).magnitude() < 0.1


def test_no_link_without_a_shared_moment():
    assert find_link(BOARD, CAMERAS["fir"], "rgb", "fir", {"a": np.eye(4)}, {"b": np.eye(4)}) is None


def test_reflections():
    for board in (
        BOARD,
        Board.of("circles", 4, 3, 0.1),
        Board.of("chessboard", 7, 5, 0.1, hidden=[[0, 0, 1, 1]]),
    ):
        relabel = reflection(board)
        if board.visible.all():
            assert relabel is not None
            xy = board.points_m[relabel][:, :2] * (-1, 1)
            np.testing.assert_allclose(xy - xy[0], board.points_m[:, :2] - board.points_m[0, :2], atol=1e-12)
        else:
            assert relabel is None
    assert reflection(Board.of("aprilgrid", 3, 3, 0.1, marker_m=0.08)) is None


@pytest.mark.parametrize("name", ["pinhole0", "pinhole4", "pinhole8", "fisheye"])
def test_a_mirrored_camera_takes_mirrored_pictures(name):
    camera = MODELS[name]
    xyz = np.random.default_rng(0).uniform((-0.5, -0.4, 1), (0.5, 0.4, 2), (50, 3))
    uv, _ = camera.project(xyz)
    mirrored, _ = mirrored_camera(camera).project(xyz * (-1, 1, 1))
    np.testing.assert_allclose(
        mirrored, np.stack([camera.size_wh[0] - 1 - uv[:, 0], uv[:, 1]], -1), atol=1e-9
    )
    assert isinstance(mirrored_camera(camera), FisheyeCamera | PinholeCamera)
