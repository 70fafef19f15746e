"""One camera, end to end from detections, and what cannot be calibrated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.intrinsics import calibrate_camera, tilt_spread
from calib.scenes import MODELS, errors, scene
from fusion.errors import InputError, UsageError
from fusion.geometry import FisheyeCamera

SESSION = scene(3, 14, models=("pinhole5",), lidar=False)


@pytest.mark.parametrize(
    ("model", "lens"), [("pinhole", "pinhole5"), ("rational", "pinhole8"), ("fisheye", "fisheye")]
)
def test_each_model_recovers_its_lens(model, lens):
    """Errors within four of their own standard deviations, residuals of the noise."""
    session = SESSION if lens == "pinhole5" else scene(4, 14, models=(lens,), lidar=False)
    found = calibrate_camera(session.board, session.views, model)
    camera, truth = found.estimate.cameras["rgb"], MODELS[lens]
    assert isinstance(camera, FisheyeCamera) == (model == "fisheye")
    assert found.sigma_px["rgb"] == pytest.approx(0.1, rel=0.1)
    off = errors(found, session.truth)
    assert np.abs(off[:4] / np.sqrt(np.diag(found.covariance))[:4]).max() < 4
    assert camera.fx == pytest.approx(truth.fx, rel=0.01)
    assert not found.dropped_views


def test_a_view_that_does_not_fit_is_named():
    views = list(SESSION.views)
    rng = np.random.default_rng(0)
    views[4] = replace(views[4], uv=views[4].uv[rng.permutation(len(views[4].uv))])
    views[7] = replace(views[7], ids=views[7].ids[:5], uv=views[7].uv[:5])
    found = calibrate_camera(SESSION.board, views)
    named = dict(found.dropped_views)
    assert set(named) == {views[4].file, views[7].file}
    assert "5 points" in named[views[7].file]
    assert np.abs(errors(found, SESSION.truth)[:4] / np.sqrt(np.diag(found.covariance))[:4]).max() < 4


def refused(views, what: str) -> str:
    with pytest.raises(InputError, match=what) as error:
        calibrate_camera(SESSION.board, views)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_what_cannot_be_calibrated_is_said_in_one_line():
    views = list(SESSION.views)
    refused([], "no board in any image")
    assert "record 15 or more views" in refused(views[:1], "rgb: one view only")
    refused(views[:2], "rgb: 2 views only")
    small = replace(views[0], size_wh=(320, 240))
    refused([small, *views[1:]], "images of different sizes: 13 of 640x480, 1 of 320x240")
    cut = [replace(v, ids=v.ids[:5], uv=v.uv[:5]) for v in views]
    refused(cut, r"rgb: only 0 of 14 views can be used \(rgb/000.png: 5 points, 6 are needed")


def test_views_that_are_all_alike():
    """One tilt, moved about: the focal length and the distance cannot be told apart."""
    flat = scene(1, 12, models=("pinhole5",), lidar=False, tilt_rad=0.0)
    with pytest.raises(InputError, match=r"rgb: all 12 views are alike: their tilts differ by .*record 15"):
        calibrate_camera(flat.board, flat.views)


def test_views_that_tell_too_little():
    """Five views within 7 degrees, and much noise: the solver says which figures they leave open."""
    few = scene(1, 5, 0.5, models=("pinhole5",), lidar=False, tilt_rad=0.12)
    with pytest.raises(InputError, match=r"do not determine rgb.fx.*tilted"):
        calibrate_camera(few.board, few.views)


def test_a_mirrored_stream_whose_labels_show_it():
    """Where labels come from codes or marks, a mirror shows as a board seen from behind."""
    views = [replace(v, uv=v.uv * (-1, 1) + (639, 0)) for v in SESSION.views]
    assert "flip" in refused(views, "seen from behind in 14 of 14 images")
    one = [views[0], *SESSION.views[1:]]
    found = calibrate_camera(SESSION.board, one)
    assert found.dropped_views == ((views[0].file, "the board is seen from behind: mirrored"),)


def test_programming_errors():
    with pytest.raises(UsageError, match="unknown camera model"):
        calibrate_camera(SESSION.board, SESSION.views, "kb4")
    fir = replace(SESSION.views[0], camera="fir")
    with pytest.raises(ValueError, match="one camera"):
        calibrate_camera(SESSION.board, [*SESSION.views, fir])
    twice = [*SESSION.views, SESSION.views[0]]
    with pytest.raises(ValueError, match="one view of a camera in each moment"):
        calibrate_camera(SESSION.board, twice)


def test_tilts_are_measured_between_planes():
    poses = [SESSION.truth.T_ref_board[m] for m in SESSION.truth.T_ref_board]
    normals = [T[:3, 2] for T in poses]
    expected = max(np.arccos(np.clip(a @ b, -1, 1)) for a in normals for b in normals)
    assert tilt_spread(poses) == pytest.approx(expected)
