"""ROS's camera YAML: as its tools write it, an echo of CameraInfo, and what an uncalibrated driver says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from calib.formats import read_rig, read_with_notes, write_rig
from fusion.errors import UsageError
from fusion.geometry import FisheyeCamera, PinholeCamera
from fusion.rig import Rig

# The shape of what cameracalibrator saves, numbers made up.
HEAD = """image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [526.69083,   0.     , 312.33335,
           0.     , 525.75426, 246.22795,
           0.     ,   0.     ,   1.     ]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.018641, -0.080795, 0.000670, -0.001800, 0.000000]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1., 0., 0.,
         0., 1., 0.,
         0., 0., 1.]
projection_matrix:
  rows: 3
  cols: 4
  data: [516.2002 ,   0.     , 310.36349,   0.     ,
           0.     , 514.0495 , 246.88520,   0.     ,
           0.     ,   0.     ,   1.     ,   0.     ]
"""
ECHO = """header:
  stamp:
    sec: 1700000000
    nanosec: 5
  frame_id: thermal_optical
height: 256
width: 320
distortion_model: rational_polynomial
d:
- 0.1
- -0.2
- 0.001
- 0.002
- 0.03
- 0.4
- 0.5
- 0.6
k: [301.0, 0.0, 160.0, 0.0, 302.0, 128.0, 0.0, 0.0, 1.0]
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [301.0, 0.0, 160.0, -30.1, 0.0, 302.0, 128.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 2
binning_y: 2
roi:
  x_offset: 0
  y_offset: 0
  height: 0
  width: 0
  do_rectify: false
---
"""


def written(folder: Path, text: str, name: str = "head.yaml") -> Path:
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    return path


def test_what_cameracalibrator_saves(tmp_path: Path) -> None:
    rig, notes = read_with_notes(written(tmp_path, HEAD))
    assert rig.camera("rgb") == PinholeCamera(
        (640, 480), 526.69083, 525.75426, 312.33335, 246.22795, (0.018641, -0.080795, 0.00067, -0.0018, 0)
    )
    assert not rig.transforms
    assert notes[-1] == "of rectified images only, not kept: projection_matrix (fx 516.2, fy 514.049)"


def test_an_echo_of_camera_info(tmp_path: Path) -> None:
    rig, notes = read_with_notes(written(tmp_path, ECHO, "thermal.yaml"))
    camera = rig.camera("fir")  # by the file's name
    assert camera.size_wh == (320, 256)
    assert camera.distortion == (0.1, -0.2, 0.001, 0.002, 0.03, 0.4, 0.5, 0.6)
    assert "the baseline in p, 0.1 m" in notes[-2]
    assert notes[-1].startswith("binning_x, binning_y not applied")
    first = (
        ECHO.replace("k: [", "K: [").replace("d:\n", "D:\n").replace("r: [", "R: [").replace("p: [", "P: [")
    )
    assert read_rig(written(tmp_path, first, "thermal.yaml")).camera("fir") == camera


def test_an_uncalibrated_camera_is_said_to_be_one(tmp_path: Path) -> None:
    no_file = HEAD.replace("526.69083", "0.").replace("525.75426", "0.")
    nothing = ECHO.replace("k: [301.0, 0.0, 160.0, 0.0, 302.0, 128.0, 0.0, 0.0, 1.0]", f"k: {[0.0] * 9}")
    for text in (no_file, nothing):
        with pytest.raises(UsageError, match=r"(camera_matrix|k): the camera is uncalibrated"):
            read_rig(written(tmp_path, text))


def test_equidistant_and_forgotten_zeros(tmp_path: Path) -> None:
    text = HEAD.replace("plumb_bob", "equidistant").replace(", 0.000000]", "]").replace("cols: 5", "cols: 4")
    assert isinstance(read_rig(written(tmp_path, text)).camera("rgb"), FisheyeCamera)
    twelve = HEAD.replace(", 0.000000]", ", 0, 1, 2, 3, 0, 0, 0, 0]").replace(
        "plumb_bob", "rational_polynomial"
    )
    assert read_rig(written(tmp_path, twelve)).camera("rgb").distortion[5:] == (1, 2, 3)
    with pytest.raises(UsageError, match=r"distortion_coefficients: 12 distortion coefficients"):
        read_rig(written(tmp_path, twelve.replace("0, 0, 0, 0]", "0, 0, 0, 9]")))


def test_a_folder_of_files_is_one_rig_and_is_written_as_one(tmp_path: Path) -> None:
    rig = Rig({
        "rgb": PinholeCamera((640, 480), 500, 501, 320, 240, (0.1, 0.2, 0.3, 0.4)),
        "fir": FisheyeCamera((320, 256), 300, 301, 160, 128, (0.1, 0.2, 0.3, 0.4)),
    })  # fmt: skip
    assert write_rig(tmp_path / "ros", rig, "ros") == ()
    assert sorted(p.name for p in (tmp_path / "ros").iterdir()) == ["fir.yaml", "rgb.yaml"]
    back = read_rig(tmp_path / "ros")
    assert back.camera("fir") == rig.camera("fir")
    assert back.camera("rgb").distortion == (0.1, 0.2, 0.3, 0.4, 0.0)
    with pytest.raises(UsageError, match=r"one camera a file; the rig has rgb, fir \(give a folder"):
        write_rig(tmp_path / "both.yaml", rig, "ros")
    saved = yaml.safe_load((tmp_path / "ros" / "fir.yaml").read_text())
    assert saved["distortion_model"] == "equidistant"
    assert saved["camera_matrix"] == {"rows": 3, "cols": 3, "data": [300, 0, 160, 0, 301, 128, 0, 0, 1]}
    assert saved["projection_matrix"]["data"] == [300, 0, 160, 0, 0, 301, 128, 0, 0, 0, 1, 0]
    assert np.shape(saved["rectification_matrix"]["data"]) == (9,)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("plumb_bob", "thin_prism", "distortion_model is thin_prism, which is not supported"),
        ("cols: 3", "cols: 4", "camera_matrix is no matrix of 3x3"),
        ("image_height: 480\n", "", "image_height is missing"),
        ("image_height: 480", "image_height: 480.5", r"image_height must be a whole number, not 480\.5"),
        ("image_height: 480", "image_height: [480, 3]", "image_height has 2 numbers"),
        ("246.22795", ".inf", "camera_matrix holds a number that is not finite"),
        ("0.     , 312", "0.5    , 312", "camera_matrix is no camera matrix without skew"),
        ("  data: [0.018641", "  dat: [0.018641", r"distortion_coefficients\.data is missing"),
        ("image_width: 640", "image_width: 99999999999999999999", "distortion_coefficients: an image of"),
        ("image_width: 640", "image_width: 640\nimage_width: 640", "image_width stands twice"),
    ],
)
def test_broken_files_are_one_line_with_the_key(old: str, new: str, message: str, tmp_path: Path) -> None:
    path = written(tmp_path, HEAD.replace(old, new, 1))
    with pytest.raises(UsageError, match=message) as error:
        read_rig(path)
    assert str(error.value).startswith(f"{path}: ")
