"""Kalibr's camchain: as Kalibr writes it, what of it is refused, and YAML made to break its reader."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from calib.formats import read_rig, read_with_notes, write_rig
from fusion.errors import UsageError
from fusion.geometry import FisheyeCamera, PinholeCamera, pose
from fusion.rig import Rig

# The shape of camchain-imucam-*.yaml, numbers made up.
IMUCAM = """cam0:
  T_cam_imu:
  - [0.0, -1.0, 0.0, 0.07]
  - [0.0, 0.0, -1.0, -0.017]
  - [1.0, 0.0, 0.0, 0.004]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.27695497, 0.06712482, 8.7538e-04, 0.00011556]
  distortion_model: radtan
  intrinsics: [461.629, 460.152, 362.68, 246.049]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: -8.121e-05
cam1:
  T_cam_imu:
  - [0.0, -1.0, 0.0, -0.03]
  - [0.0, 0.0, -1.0, -0.016]
  - [1.0, 0.0, 0.0, 0.006]
  - [0.0, 0.0, 0.0, 1.0]
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.1]
  - [0.0, 1.0, 0.0, 0.001]
  - [0.0, 0.0, 1.0, 0.002]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [-0.01, 0.05, -0.045, 0.0124]
  distortion_model: equidistant
  intrinsics: [301.5, 302.5, 160.25, 128.75]
  resolution: [320, 256]
  rostopic: /cam1/image_raw
  timeshift_cam_imu: 0.0125
"""


def written(folder: Path, text: str | bytes, name: str = "camchain.yaml") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_what_kalibr_writes(tmp_path: Path) -> None:
    rig, notes = read_with_notes(written(tmp_path, IMUCAM))
    assert rig.camera("rgb") == PinholeCamera(
        (752, 480), 461.629, 460.152, 362.68, 246.049, (-0.27695497, 0.06712482, 8.7538e-04, 0.00011556)
    )
    assert rig.camera("fir") == FisheyeCamera(
        (320, 256), 301.5, 302.5, 160.25, 128.75, (-0.01, 0.05, -0.045, 0.0124)
    )
    at_fir = pose(translation_m=(-0.1, 0.001, 0.002))  # cam1's T_cn_cnm1 takes cam0's points to cam1
    np.testing.assert_allclose(rig.pose("fir", "rgb"), at_fir, atol=1e-15)
    np.testing.assert_allclose(rig.pose("rgb", "imu")[:3, 3], (0.07, -0.017, 0.004), atol=1e-15)
    assert rig.time_offset_s["fir"] - rig.time_offset_s["rgb"] == pytest.approx(0.0125 + 8.121e-05)
    assert "/cam0/image_raw as rgb, /cam1/image_raw as fir" in notes[0]
    assert "cam1.T_cam_imu follows from the chain" in notes[1]


def test_both_lenses_are_opencvs(tmp_path: Path) -> None:
    """`radtan` and `equidistant` have OpenCV's order of coefficients: the file's numbers, projected by it."""
    rig = read_rig(written(tmp_path, IMUCAM))
    xyz = np.random.default_rng(0).uniform((-1, -1, 3), (1, 1, 9), (50, 3))
    raw = yaml.safe_load(IMUCAM)
    for name, cam, project in (
        ("rgb", "cam0", cv2.projectPoints),
        ("fir", "cam1", cv2.fisheye.projectPoints),
    ):
        fx, fy, cx, cy = raw[cam]["intrinsics"]
        K, D = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(raw[cam]["distortion_coeffs"])
        uv = project(xyz[:, None], np.zeros(3), np.zeros(3), K, D)[0][:, 0]
        np.testing.assert_allclose(rig.camera(name).project(xyz)[0], uv, atol=1e-9)


def test_topics_tell_which_camera_is_thermal(tmp_path: Path) -> None:
    for first, second, names in (
        ("/lwir/image_raw", "/color/image_raw", ["fir", "rgb"]),
        ("/flir_boson/image", "/left/image", ["fir", "rgb"]),
        ("/left/image_raw", "/thermal_camera/image", ["rgb", "fir"]),
        ("/camera/ir/image", "/camera/first/image", ["fir", "rgb"]),
        ("/thermal_left/image", "/thermal_right/image", ["rgb", "fir"]),
    ):
        text = IMUCAM.replace("/cam0/image_raw", first).replace("/cam1/image_raw", second)
        assert list(read_rig(written(tmp_path, text)).cameras) == names, first


def test_what_we_write_is_what_kalibr_would_read(tmp_path: Path) -> None:
    """Its reader is yaml.safe_load: all numbers must be floats to it, small ones too."""
    tiny = PinholeCamera((64, 48), 5e2, 1e8, 32.0, 24, (1e-5, -1e-17, 0.0, 3e-300))
    write_rig(tmp_path / "c.yaml", Rig({"rgb": tiny}, {}, {"rgb": 1e-05}), "kalibr")
    cam = yaml.safe_load((tmp_path / "c.yaml").read_text())["cam0"]
    assert cam["distortion_coeffs"] == [1e-5, -1e-17, 0.0, 3e-300]
    assert cam["intrinsics"] == [5e2, 1e8, 32.0, 24.0]
    assert cam["timeshift_cam_imu"] == 1e-05
    assert cam["resolution"] == [64, 48]
    assert all(type(x) is float for x in cam["distortion_coeffs"] + cam["intrinsics"])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "camera_model: pinhole",
            "camera_model: omni",
            r"cam0\.camera_model is omni, which is not supported",
        ),
        ("radtan", "fov", r"cam0\.distortion_model is fov"),
        ("  resolution: [752, 480]\n", "", r"cam0\.resolution is missing \(it has T_cam_imu"),
        ("[752, 480]", "[752.5, 480]", r"cam0\.resolution holds no whole numbers"),
        ("[752, 480]", "[752]", r"cam0\.resolution has 1 numbers \(it needs 2\)"),
        ("461.629", ".nan", r"cam0\.intrinsics holds a number that is not finite"),
        ("461.629", "nan", r"cam0\.intrinsics holds a number that is not finite"),
        ("461.629", "x", r"cam0\.intrinsics holds something that is no number"),
        ("461.629", "-4", r"cam0\.intrinsics: focal lengths must be positive"),
        (
            "  - [1.0, 0.0, 0.0, -0.1]",
            "  - [2.0, 0.0, 0.0, -0.1]",
            r"cam1\.T_cn_cnm1: the transformation is not",
        ),
        ("  - [1.0, 0.0, 0.0, -0.1]", "  - [-1.0, 0.0, 0.0, -0.1]", r"cam1\.T_cn_cnm1: .* mirrors"),
        ("  - [1.0, 0.0, 0.0, -0.1]\n", "", r"cam1\.T_cn_cnm1 has 12 numbers|is no matrix|mirrors|not rigid"),
        ("0.0, -0.03]", "0.0, -0.3]", r"cam1\.T_cam_imu contradicts the chain of T_cn_cnm1 by 0\.27 m"),
        ("cam_overlaps: [1]", "cam_overlaps: *a", "no YAML: line 7|anchor or alias"),
        ("cam_overlaps: [1]", "cam_overlaps: &a [1]", r"anchor or alias \(line 7\)"),
        ("cam_overlaps: [1]", "cam_overlaps: !!python/name:os.system", "tag .*python/name.* refused"),
        ("cam_overlaps: [1]", "camera_model: pinhole", r"camera_model stands twice \(line 8\)"),
        ("cam_overlaps: [1]", "cam_overlaps: [1", "no YAML: line"),
        ("cam_overlaps: [1]", "? [a, b]\n  : 3", "a key that is no word"),
        ("cam_overlaps: [1]", "cam_overlaps: " + "[" * 40 + "]" * 40, "nesting this deep"),
        ("cam_overlaps: [1]", "note: \x07", "no YAML"),
    ],
)
def test_broken_camchains_are_one_line_with_the_key(old: str, new: str, message: str, tmp_path: Path) -> None:
    path = written(tmp_path, IMUCAM.replace(old, new, 1))
    with pytest.raises(UsageError, match=message) as error:
        read_rig(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def test_yaml_made_to_break_its_reader_is_refused_at_once(tmp_path: Path) -> None:
    laughs = "a: &a [lol, lol]\n" + "".join(
        f"{y}: &{y} [*{x}, *{x}]\n" for x, y in zip("abcdefgh", "bcdefghi", strict=True)
    )
    hostile = {
        "laughs": IMUCAM + laughs,
        "deep flow": "cam0: " + "[" * 500_000,
        "deep block": "cam0:\n" + "".join(" " * i + "a:\n" for i in range(1, 1000)),
        "merge": "cam0: {<<: {camera_model: pinhole}, intrinsics: [1, 2, 3, 4]}",
        "second document": IMUCAM + "---\ncam2: 3\n",
        "only comments": "---\n# nothing\n",
        "unclosed": "cam0: {intrinsics: [1, 2",
        "blank lines": "\n" * 1_000_000 + "cam0:\n  intrinsics: 3",
        "spaces": "cam0:\n " + " " * 1_000_000 + "x",
    }
    for name, text in hostile.items():
        with pytest.raises(UsageError) as error:
            read_rig(written(tmp_path, text))
        assert len(str(error.value)) < 1500, name


def test_a_camera_without_a_chain_or_a_shift_is_told(tmp_path: Path) -> None:
    rig, notes = read_with_notes(
        written(tmp_path, IMUCAM.replace("  timeshift_cam_imu: 0.0125\n", "  new_key: 1\n"))
    )
    assert not rig.time_offset_s
    assert any(
        "timeshift_cam_imu is not kept, not every camera has one: rgb -8.121e-05 s" in n for n in notes
    )
    assert any(n == "not read: new_key" for n in notes)
