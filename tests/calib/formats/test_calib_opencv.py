"""FileStorage: what OpenCV writes we read, what we write OpenCV reads; directions and spellings."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.formats import read_rig, read_with_notes, write_rig
from fusion.errors import UsageError
from fusion.geometry import FisheyeCamera, PinholeCamera, pose, transform
from fusion.rig import Rig

K1 = np.array([[520.1, 0, 319.5], [0, 521.2, 240.1 / 3], [0, 0, 1]])
K2 = np.array([[400.7, 0, 159.5], [0, 401.2, 128.3], [0, 0, 1]])
D1, D2 = np.array([[-0.1, 1 / 30, 1e-5, 3e-4, 0.01]]), np.array([[-0.3, 0.1, 0, 0, 1e-7]])
R = cv2.Rodrigues(np.array([0.01, -0.02, 0.03]))[0]
T = np.array([[-0.05], [0.001], [0.002]])
# The shape of calibration.cpp's out_camera_data.xml/yml and of rtabmap's and older OpenCV's header.
SAMPLE = """%YAML:1.0
---
calibration_time: "Sun Nov 22 10:00:00 2026"
nr_of_frames: 25
image_width: 640
image_height: 480
board_width: 9
square_size: 50.
flags: 6
fisheye_model: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 6.5746697810243404e+02, 0., 3.1950000000000000e+02, 0.,
       6.5746697810243404e+02, 2.3950000000000000e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -4.1802327018241026e-01, 5.0715243805833121e-01, 0., 0.,
       -5.7843596847939704e-01 ]
avg_reprojection_error: 3.8441346462381665e-01
per_view_reprojection_errors: !!opencv-matrix
   rows: 2
   cols: 1
   dt: f
   data: [ .Nan, 5.1e-01 ]
"""


def stored(path: Path, **values: object) -> Path:
    """A file as this OpenCV writes it."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        storage.write(key, value)  # type: ignore[arg-type]
    storage.release()
    return path


def test_the_calibration_samples_file(tmp_path: Path) -> None:
    path = tmp_path / "out_camera_data.yml"
    path.write_text(SAMPLE)
    rig, notes = read_with_notes(path)
    D = (-0.41802327018241026, 0.50715243805833121, 0.0, 0.0, -0.57843596847939704)
    assert rig.camera("rgb") == PinholeCamera(
        (640, 480), 657.46697810243404, 657.46697810243404, 319.5, 239.5, D
    )
    assert "not read: calibration_time, nr_of_frames, board_width" in notes[-1]
    path.write_text(SAMPLE.replace("---\n", ""))
    assert read_rig(path).camera("rgb") == rig.camera("rgb")
    fish = SAMPLE.replace("fisheye_model: 0", "fisheye_model: 1").replace("rows: 5", "rows: 4")
    path.write_text(fish.replace(",\n       -5.7843596847939704e-01", ""))
    assert read_rig(path).camera("rgb") == FisheyeCamera(
        (640, 480), 657.46697810243404, 657.46697810243404, 319.5, 239.5, D[:4]
    )


@pytest.mark.parametrize("suffix", [".yml", ".json"])
def test_what_opencv_writes_we_read_to_the_last_digit(suffix: str, tmp_path: Path) -> None:
    path = stored(
        tmp_path / f"c{suffix}", image_width=640, image_height=480, M1=K1, D1=D1, M2=K2, D2=D2, R=R, T=T
    )
    rig = read_rig(path)
    assert rig.camera("rgb") == PinholeCamera((640, 480), 520.1, 521.2, 319.5, 240.1 / 3, tuple(D1[0]))
    assert rig.camera("fir") == PinholeCamera((640, 480), 400.7, 401.2, 159.5, 128.3, tuple(D2[0]))
    np.testing.assert_allclose(rig.transforms["T_fir_rgb"], pose(R, T[:, 0]), rtol=0, atol=1e-15)


def test_what_we_write_opencv_reads_to_the_last_digit(tmp_path: Path) -> None:
    rgb = PinholeCamera((640, 480), 520.1, 521.2, 319.5, 240.1 / 3, tuple(D1[0]))
    fir = FisheyeCamera((320, 256), 400.7, 401.2, 159.5, 128.3, (1e-5, -1e-17, 1 / 3, 1e8))
    rig = Rig({"rgb": rgb, "fir": fir}, {"T_rgb_fir": pose(R, T[:, 0]), "T_rgb_lidar": pose(R.T, T[:, 0])})
    write_rig(tmp_path / "c.yml", rig, "opencv")
    storage = cv2.FileStorage(str(tmp_path / "c.yml"), cv2.FILE_STORAGE_READ)
    assert (storage.getNode("camera_matrix1").mat() == rgb.matrix()).all()
    assert (storage.getNode("distortion_coefficients1").mat() == np.array([rgb.distortion])).all()
    assert (storage.getNode("distortion_coefficients2").mat() == np.array([fir.distortion])).all()
    assert storage.getNode("image_width2").real() == 320
    assert storage.getNode("fisheye_model2").real() == 1
    got = pose(storage.getNode("R").mat(), storage.getNode("T").mat()[:, 0])
    np.testing.assert_allclose(got, rig.pose("fir", "rgb"), rtol=0, atol=0)
    assert (storage.getNode("T_rgb_lidar").mat() == rig.transforms["T_rgb_lidar"]).all()


def test_the_direction_of_stereo_calibrate(tmp_path: Path) -> None:
    """Two cameras are simulated with known poses; what cv2.stereoCalibrate finds is read as T_fir_rgb."""
    grid = np.zeros((54, 3), np.float32)
    grid[:, :2] = 0.05 * np.stack(np.meshgrid(np.arange(9), np.arange(6)), -1).reshape(-1, 2)
    truth = pose(R, T[:, 0])  # takes rgb's points to fir
    rng, objects, left, right = np.random.default_rng(3), [], [], []
    for _ in range(6):
        board = pose(
            cv2.Rodrigues(rng.uniform(-0.5, 0.5, 3))[0], (*rng.uniform(-0.2, 0, 2), rng.uniform(0.8, 1.2))
        )
        at = transform(board, grid.astype(float))
        rgb = PinholeCamera((640, 480), 520.1, 521.2, 319.5, 240.1 / 3)
        fir = PinholeCamera((320, 256), 400.7, 401.2, 159.5, 128.3)
        objects.append(grid)
        left.append(rgb.project(at)[0].astype(np.float32))
        right.append(fir.project(transform(truth, at))[0].astype(np.float32))
    zeros = np.zeros((1, 5))
    found = cv2.stereoCalibrate(
        objects, left, right, K1, zeros, K2, zeros, (640, 480), flags=cv2.CALIB_FIX_INTRINSIC
    )
    path = stored(tmp_path / "s.yml", M1=K1, D1=zeros, M2=K2, D2=zeros, R=found[5], T=found[6])
    rig = read_rig(path, {"rgb": (640, 480), "fir": (320, 256)})
    np.testing.assert_allclose(rig.pose("fir", "rgb"), truth, atol=1e-5)


SPELLINGS = """camera_matrix distortion_coefficients, cameraMatrix distCoeffs, K D, mtx dist,
CameraMat DistCoeff, Camera_Matrix Distortion_Coefficients, intrinsic_matrix dist_coeffs"""


@pytest.mark.parametrize("keys", [tuple(pair.split()) for pair in SPELLINGS.split(",")])
def test_the_many_spellings(keys: tuple[str, str], tmp_path: Path) -> None:
    path = stored(tmp_path / "c.yml", **{keys[0]: K1, keys[1]: D1})
    assert read_rig(path, (640, 480)).camera("rgb").distortion == tuple(D1[0])
    with pytest.raises(UsageError, match="how large the pictures are"):
        read_rig(path)
    for left, right in (("1", "2"), ("_left", "_right"), ("0", "1"), ("_1", "_2")):
        two = {keys[0] + left: K1, keys[1] + left: D1, keys[0] + right: K2, keys[1] + right: D2}
        rig = read_rig(stored(tmp_path / "s.yml", **two), {"rgb": (640, 480), "fir": (320, 256)})
        assert (rig.camera("rgb").fx, rig.camera("fir").fx) == (520.1, 400.7)


def test_rows_of_plain_yaml_and_image_size(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(f"K: {K1.tolist()}\nD: {D1[0].tolist()}\nimage_size: [640, 480]\n")
    assert read_rig(path).camera("rgb") == PinholeCamera(
        (640, 480), 520.1, 521.2, 319.5, 240.1 / 3, tuple(D1[0])
    )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("6.5746697810243404e+02, 0., 3", ".Nan, 0., 3", "camera_matrix holds a number that is not finite"),
        ("rows: 3", "rows: 30000000000", "camera_matrix is no matrix of 3x3"),
        ("rows: 3", "rows: -3", "camera_matrix is no matrix of 3x3"),
        ("cols: 3\n", "cols: x\n", r"camera_matrix\.cols holds something"),
        ("!!opencv-matrix", "!!python/object/apply:os.system", "the YAML tag tag:yaml.org,2002:python"),
        ("!!opencv-matrix", "!!opencv-sparse-matrix", "the YAML tag"),
        (
            "flags: 6",
            "cameraMatrix: 6",
            "camera_matrix and cameraMatrix say the same|cameraMatrix .* say the same",
        ),
        ("image_width: 640", "image_width: 0", "distortion_coefficients: an image of 0x480"),
        ("       -5.7843596847939704e-01 ]", "       1, 2 ]", "distortion_coefficients has 6 numbers"),
        ("fisheye_model: 0", "fisheye_model: [0]", "fisheye_model must be one word"),
        ("fisheye_model: 0", "distortion_model: ftheta", "distortion_model is ftheta|not supported"),
    ],
)
def test_broken_files_are_one_line_with_the_key(old: str, new: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "c.yml"
    path.write_text(SAMPLE.replace(old, new, 1))
    with pytest.raises(UsageError, match=message) as error:
        read_rig(path)
    assert str(error.value).startswith(f"{path}: ")


def test_xml_and_json_that_are_not_ours(tmp_path: Path) -> None:
    path = stored(tmp_path / "c.xml", M1=K1)
    with pytest.raises(UsageError, match="XML is not read"):
        read_rig(path)
    for text, message in (
        ('{"K": NaN, "D": [1,2,3,4]}', "K holds a number that is not finite"),
        ('{"K": 1, "K": 2}', "K stands twice"),
        ('{"K": ' + "[" * 5000 + "]" * 5000 + "}", "nested too deeply"),
        ('{"K": ' + "[" * 30 + "]" * 30 + "}", "nested too deeply"),
        ('{"K": 1,', "no JSON"),
        (json.dumps({"a": None}), "no calibration of a known form"),
    ):
        path = tmp_path / "c.json"
        path.write_text(text)
        with pytest.raises(UsageError, match=message):
            read_rig(path)
