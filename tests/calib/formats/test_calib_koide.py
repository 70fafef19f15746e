"""koide3's calib.json: as its programs write it, the direction of T_lidar_camera, broken files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.formats import read_rig, read_with_notes, write_rig
from fusion.errors import UsageError
from fusion.geometry import FisheyeCamera, PinholeCamera, transform
from fusion.rig import Rig

# The shape of what `calibrate` leaves behind, numbers made up.
CALIB: dict[str, Any] = {
    "camera": {
        "camera_model": "plumb_bob",
        "distortion_coeffs": [-0.055, 0.068, -3.5516146454028785e-05, -0.0001, -0.021],
        "intrinsics": [631.1903076171875, 630.41162109375, 628.8812255859375, 371.5096435546875],
    },
    "meta": {
        "bag_names": ["a.db3"],
        "image_topic": "/camera/color/image_raw",
        "points_topic": "/livox/lidar",
    },
    "results": {
        "T_lidar_camera": [0.038, -0.019, -0.076, -0.5004, 0.4973, -0.5012, 0.5011],
        "init_T_lidar_camera": [-0.01, -0.03, -0.09, -0.5, 0.5, -0.5, 0.5],
    },
}


def written(folder: Path, **changes: Any) -> Path:
    path = folder / "calib.json"
    path.write_text(
        json.dumps({key: value for key, value in {**CALIB, **changes}.items() if value is not None})
    )
    return path


def test_what_its_programs_write(tmp_path: Path) -> None:
    rig, notes = read_with_notes(written(tmp_path), (1280, 720))
    D = tuple(CALIB["camera"]["distortion_coeffs"])
    assert rig.camera("rgb") == PinholeCamera((1280, 720), *CALIB["camera"]["intrinsics"], distortion=D)
    assert notes == ()
    *t, x, y, z, w = CALIB["results"]["T_lidar_camera"]
    at_camera = np.random.default_rng(0).uniform(-3, 3, (20, 3))
    at_lidar = (
        Rotation.from_quat([x, y, z, w]).apply(at_camera) + t
    )  # "pt_lidar = T_lidar_camera * pt_camera"
    np.testing.assert_allclose(transform(rig.pose("lidar", "rgb"), at_camera), at_lidar, atol=1e-12)
    ahead = transform(rig.pose("lidar", "rgb"), np.array([[0, 0, 1.0]])) - t
    np.testing.assert_allclose(ahead, [[1, 0, 0]], atol=0.02)  # the optical axis is the LiDAR's x


def test_a_first_guess_is_read_and_said_to_be_one(tmp_path: Path) -> None:
    guess = {"init_T_lidar_camera_auto": CALIB["results"]["init_T_lidar_camera"]}
    rig, notes = read_with_notes(written(tmp_path, results=guess), (1280, 720))
    assert notes == ("only a first guess, results.init_T_lidar_camera_auto: it was not refined",)
    np.testing.assert_allclose(rig.pose("lidar", "rgb")[:3, 3], [-0.01, -0.03, -0.09])
    rig, notes = read_with_notes(written(tmp_path, results=None), (1280, 720))
    assert notes == ("no results in the file: intrinsics only",)
    assert not rig.transforms


def test_a_rig_without_a_lidar_is_written_without_results(tmp_path: Path) -> None:
    fish = FisheyeCamera((64, 48), 30, 30, 32, 24, (0.1, 0.2, 0.3, 0.4))
    notes = write_rig(tmp_path / "calib.json", Rig({"rgb": fish}), "koide")
    assert "no results are written" in notes[0]
    assert "give 64x48" in notes[1]
    saved = json.loads((tmp_path / "calib.json").read_text())
    assert saved == {
        "camera": {
            "camera_model": "fisheye",
            "distortion_coeffs": [0.1, 0.2, 0.3, 0.4],
            "intrinsics": [30.0, 30.0, 32.0, 24.0],
        }
    }
    assert read_rig(tmp_path / "calib.json", (64, 48)).camera("rgb") == fish


@pytest.mark.parametrize(
    ("part", "key", "value", "message"),
    [
        ("camera", "camera_model", "omnidir", r"camera\.camera_model is omnidir, which is not supported"),
        ("camera", "intrinsics", [1, 2, 3], r"camera\.intrinsics has 3 numbers"),
        ("camera", "intrinsics", [1, 2, 3, None], r"camera\.intrinsics holds something that is no number"),
        (
            "camera",
            "intrinsics",
            [1, 2, 3, float("nan")],
            r"camera\.intrinsics holds a number that is not finite",
        ),
        ("camera", "intrinsics", [-1, 2, 3, 4], r"camera\.distortion_coeffs: focal lengths must be positive"),
        ("camera", "distortion_coeffs", [1, 2, 3], r"camera\.distortion_coeffs has 3 numbers"),
        ("results", "T_lidar_camera", [0, 0, 0, 0, 0, 0, 0], "no unit quaternion"),
        ("results", "T_lidar_camera", [0, 0, 0, 1, 1, 0, 0], "no unit quaternion"),
        ("results", "T_lidar_camera", [0, 0, 0, 0, 0, 0], r"results\.T_lidar_camera has 6 numbers"),
        ("results", "T_lidar_camera", {"x": 1}, r"results\.T_lidar_camera\.data is missing"),
    ],
)
def test_broken_files_are_one_line_with_the_key(
    part: str, key: str, value: Any, message: str, tmp_path: Path
) -> None:
    path = written(tmp_path, **{part: {**CALIB[part], key: value}})
    with pytest.raises(UsageError, match=message) as error:
        read_rig(path, (1280, 720))
    assert str(error.value).startswith(f"{path}: ")


def test_the_size_has_to_be_given(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="how large the pictures are"):
        read_rig(written(tmp_path))
