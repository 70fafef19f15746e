"""A whole rig from detections: labels, wrong boards, LiDAR and clocks; against known truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.boards import Board
from calib.rigging import calibrate_rig, loop_closure
from calib.scenes import T_RGB_LIDAR, errors, scene
from calib.solve import solve
from fusion.errors import InputError
from fusion.geometry import invert, pose

SESSION = scene(11, 16)
PLATE = SESSION.board.plate_m
BOARD = Board.of("chessboard", 9, 6, 0.08, plate_m=PLATE)
CAMERAS = SESSION.truth.cameras


def surprise(found, truth=SESSION.truth) -> float:
    """The largest error over its standard deviation: 30 normal numbers stay below four."""
    return float(np.abs(errors(found, truth) / np.sqrt(np.diag(found.covariance))).max())


def without_lidar(truth):
    return replace(truth, T_ref_sensor={n: T for n, T in truth.T_ref_sensor.items() if n != "lidar"})


def test_cameras_and_lidar_together_with_boards_turned_and_cut():
    half, views = BOARD.symmetries()[1], list(SESSION.views)
    for k, v in enumerate(views):
        if v.camera == "fir" and v.moment in {"002", "005", "009"}:
            views[k] = replace(v, ids=half[v.ids])
        if v.camera == "fir" and v.moment == "004":
            ok = v.ids % 9 < 8
            views[k] = replace(v, ids=v.ids[ok] + 1, uv=v.uv[ok])
    cameras = calibrate_rig(BOARD, views)
    truth = SESSION.truth
    placed = {**cameras.estimate.T_ref_sensor, "lidar": truth.T_ref_sensor["lidar"]}
    found = solve(BOARD, cameras.views, SESSION.clouds, start=replace(cameras.estimate, T_ref_sensor=placed))
    found = replace(found, dropped_views=cameras.dropped_views, notes=cameras.notes)
    assert surprise(found) < 4
    assert [file for file, _ in found.dropped_views] == ["fir/004.png"]
    assert any("3 views had the board turned" in note for note in found.notes)
    assert len(found.clouds) == len(SESSION.clouds)
    T = found.estimate.T_ref_sensor["lidar"]
    assert np.abs(T[:3, 3] - T_RGB_LIDAR[:3, 3]).max() < 0.01


def test_known_cameras_are_held_or_refined():
    truth = without_lidar(SESSION.truth)
    held = calibrate_rig(BOARD, SESSION.views, known=CAMERAS)
    assert all(held.estimate.cameras[c] == CAMERAS[c] for c in CAMERAS)
    assert held.names == tuple(f"T_rgb_fir.{p}" for p in ("rx", "ry", "rz", "tx", "ty", "tz"))
    assert surprise(held, truth) < 4
    free = calibrate_rig(BOARD, SESSION.views, known=CAMERAS, refine_known=True)
    assert "rgb.fx" in free.names
    assert surprise(free, truth) < 4


@pytest.mark.parametrize("reference", ["rgb", "fir"])
def test_the_reference_is_whom_one_asks_for(reference):
    found = calibrate_rig(BOARD, SESSION.views, known=CAMERAS, reference=reference).estimate
    T = found.T_ref_sensor["fir"] if reference == "rgb" else invert(found.T_ref_sensor["rgb"])
    assert found.reference == reference
    assert np.abs(T - SESSION.truth.T_ref_sensor["fir"]).max() < 2e-3


def test_what_cannot_be_a_rig_is_said_in_one_line():
    views = SESSION.views
    swapped = [replace(v, camera={"rgb": "fir", "fir": "rgb"}[v.camera]) for v in views]
    rgb = [v for v in views if v.camera == "rgb"]
    cases = [
        ([], {}, "no board in any image of any camera"),
        (rgb, {"models": {"rgb": "pinhole", "fir": "pinhole"}}, r"fir: no board in any image .*16 of rgb"),
        (rgb, {"reference": "nir"}, "nir: no board in any image"),
        (swapped, {"known": CAMERAS}, "640x512, but the rig's camera has 640x480 .*rgb and fir look swapped"),
        (rgb, {"known": {"rgb": CAMERAS["fir"]}}, "another camera's, or scaled"),
        (views[:3], {}, "rgb: 2 views only"),
    ]
    for given, options, what in cases:
        with pytest.raises(InputError, match=what) as error:
            calibrate_rig(BOARD, given, **options)
        assert "\n" not in str(error.value)


def test_a_closed_loop_and_one_that_is_not():
    A, B = (
        pose(Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix(), (1, 2, 3)),
        SESSION.truth.T_ref_sensor["fir"],
    )
    angle, gap = loop_closure(A, B, invert(A @ B))
    assert angle == pytest.approx(0, abs=1e-7)
    assert gap == pytest.approx(0, abs=1e-12)
    off = pose(Rotation.from_rotvec([0, 0.002, 0]).as_matrix(), (0.003, 0, 0.004))
    angle, gap = loop_closure(A, B, invert(A @ B) @ off)
    assert angle == pytest.approx(0.002)
    assert gap == pytest.approx(np.linalg.norm((A @ B @ invert(A @ B) @ off)[:3, 3]))
    assert gap == pytest.approx(0.005)
