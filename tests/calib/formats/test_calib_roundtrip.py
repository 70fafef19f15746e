"""Every lens in every form that can say it comes back to the last digit; what cannot be said is told or
refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from calib.formats import FORMATS, convert, form_of_name, read_rig, read_with_notes, write_rig
from fusion.errors import UsageError
from fusion.geometry import FisheyeCamera, PinholeCamera, pose
from fusion.rig import Rig, RigCamera

QUICK = settings(max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
LENSES: dict[str, tuple[type[Any], int]] = {
    "pinhole": (PinholeCamera, 0),
    "radtan": (PinholeCamera, 4),
    "radtan5": (PinholeCamera, 5),
    "rational": (PinholeCamera, 8),
    "fisheye": (FisheyeCamera, 4),
    "equidistant": (FisheyeCamera, 0),
}
SAYS = {
    "rig": set(LENSES),
    "opencv": set(LENSES),
    "ros": set(LENSES),
    "kalibr": set(LENSES) - {"radtan5", "rational"},
    "koide": set(LENSES) - {"rational"},
    "plain": set(LENSES) - {"fisheye", "equidistant"},
    "kitti": {"pinhole"},
    "kitti-raw": {"pinhole"},
}
PATHS = {
    "rig": "rig.toml",
    "opencv": "rig.yml",
    "ros": "ros",
    "kalibr": "camchain.yaml",
    "koide": "calib.json",
    "plain": "kdt.txt",
    "kitti": "calib.txt",
    "kitti-raw": "kitti",
}
NO_LIDAR, NO_FIR = {"kalibr", "ros"}, {"koide", "plain", "kitti", "kitti-raw"}

small = st.floats(-0.5, 0.5).filter(lambda x: x == 0 or abs(x) > 1e-300) | st.sampled_from([1e-5, -3e-17])
focal = st.floats(100, 3000)


@st.composite
def lenses(draw: st.DrawFn, kind: str) -> RigCamera:
    make, count = LENSES[kind]
    size = draw(st.tuples(st.integers(1, 5000), st.integers(1, 5000)))
    D = draw(st.tuples(*[small] * count))
    if kind in ("radtan5", "rational"):
        D = (*D[:-1], D[-1] or 0.25)  # else fewer would say the same
    return make(size, draw(focal), draw(focal), draw(st.floats(-50, 5000)), draw(st.floats(-50, 5000)), D)


@st.composite
def poses(draw: st.DrawFn) -> np.ndarray:
    turn = draw(st.tuples(*[st.floats(-math.pi, math.pi)] * 3))
    return pose(Rotation.from_euler("xyz", turn).as_matrix(), draw(st.tuples(*[st.floats(-10, 10)] * 3)))


def same_lens(a: RigCamera, b: RigCamera) -> None:
    """Coefficients that are not there are zeros."""
    assert type(a) is type(b)
    zeros = (0.0,) * 8
    assert (a.distortion + zeros)[:8] == (b.distortion + zeros)[:8]
    assert (a.size_wh, a.fx, a.fy, a.cx, a.cy) == (b.size_wh, b.fx, b.fy, b.cx, b.cy)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("form", FORMATS)
@QUICK
@given(data=st.data())
def test_a_rig_comes_back_or_is_refused(form: str, lens: str, data: st.DataObject, tmp_path: Path) -> None:
    rgb, fir = data.draw(lenses(lens)), data.draw(lenses("radtan"))
    T_rgb_fir, T_rgb_lidar = data.draw(poses()), data.draw(poses())
    rig = Rig({"rgb": rgb, "fir": fir}, {"T_rgb_fir": T_rgb_fir, "T_rgb_lidar": T_rgb_lidar})
    path = tmp_path / PATHS[form]
    if lens not in SAYS[form] and any(rgb.distortion[4 if form == "kalibr" else 0 :]):
        with pytest.raises(UsageError, match=r"distortion|fisheye"):
            write_rig(path, rig, form)
        assert not path.exists()
        return
    if lens not in SAYS[form]:
        return
    notes = write_rig(path, rig, form)
    back = read_rig(path, rgb.size_wh)
    same_lens(back.camera("rgb"), rgb)
    if form in NO_FIR:
        assert "camera fir" in notes[0]
        assert "T_rgb_fir" in notes[0]
    else:
        same_lens(back.camera("fir"), fir)
    if form in NO_LIDAR:
        assert "T_rgb_lidar" in notes[0]
    else:
        np.testing.assert_allclose(back.pose("rgb", "lidar"), rig.pose("rgb", "lidar"), rtol=0, atol=1e-14)
    if form not in NO_FIR | {"ros"}:
        np.testing.assert_allclose(back.pose("rgb", "fir"), rig.pose("rgb", "fir"), rtol=0, atol=1e-14)


RGB = PinholeCamera((640, 480), 520.1, 521.2, 319.5, 240.25, (-0.1, 0.02, 1e-5, -3e-4))
FIR = FisheyeCamera((382, 288), 300.5, 301.5, 190.25, 143.5, (0.01, -0.02, 1e-7, 0.3))
T_FIR_RGB = pose(Rotation.from_euler("xyz", [0.01, -0.02, 0.005]).as_matrix(), (-0.04, 0.001, 1e-17))
RIG = Rig({"rgb": RGB, "fir": FIR}, {"T_fir_rgb": T_FIR_RGB}, {"rgb": -8.1e-05, "fir": 0.0125})


@pytest.mark.parametrize("form", ["rig", "kalibr", "opencv"])
def test_what_stands_as_the_form_says_it_is_exact_to_the_bit(form: str, tmp_path: Path) -> None:
    path = tmp_path / PATHS[form]
    write_rig(path, RIG, form)
    back = read_rig(path)
    assert (back.transforms["T_fir_rgb"] == RIG.transforms["T_fir_rgb"]).all()
    assert dict(back.time_offset_s) == RIG.time_offset_s
    same_lens(back.camera("fir"), FIR)
    first = path.read_bytes()
    write_rig(path, back, form)
    assert path.read_bytes() == first


def test_there_and_back_through_every_form_that_holds_two_cameras(tmp_path: Path) -> None:
    write_rig(tmp_path / "rig.toml", RIG, "rig")
    told = convert(tmp_path / "rig.toml", tmp_path / "camchain.yaml")
    assert told == ("rostopic is made up: /rgb/image_raw, /fir/image_raw",)
    convert(tmp_path / "camchain.yaml", tmp_path / "stereo.yml")
    convert(tmp_path / "stereo.yml", tmp_path / "again.toml")
    back = read_rig(tmp_path / "again.toml")
    same_lens(back.camera("rgb"), RGB)
    same_lens(back.camera("fir"), FIR)
    assert (back.transforms["T_fir_rgb"] == RIG.transforms["T_fir_rgb"]).all()
    assert dict(back.time_offset_s) == RIG.time_offset_s


def test_nothing_is_lost_in_silence(tmp_path: Path) -> None:
    """What a form leaves out is in its notes, word for word; what it keeps is not."""
    lidar = {"T_fir_rgb": T_FIR_RGB, "T_rgb_lidar": np.eye(4), "T_rgb_imu": np.eye(4)}
    cameras = {"rgb": PinholeCamera((64, 48), 50, 50, 32, 24), "fir": FIR, "left": RGB}
    rig = Rig(cameras, {**lidar, "T_left_fir": T_FIR_RGB}, {"fir": 0.01}, {"verdict": "good"})
    lost = {form: " ".join(write_rig(tmp_path / PATHS[form], rig, form)) for form in FORMATS}
    everything = ["camera fir", "camera left", "T_fir_rgb", "T_rgb_lidar", "T_rgb_imu", "T_left_fir"]
    everything += ["time offsets of fir", "evidence"]
    said = {form: [thing for thing in everything if thing in note] for form, note in lost.items()}
    one = ["camera fir", "camera left", "T_fir_rgb", "T_left_fir", "time offsets of fir", "evidence"]
    assert said["rig"] == []
    assert said["kalibr"] == ["T_rgb_lidar", "evidence"]
    assert said["ros"] == ["T_fir_rgb", "T_rgb_lidar", "T_rgb_imu", "T_left_fir", *one[-2:]]
    assert said["kitti"] == one
    for form in ("koide", "plain", "kitti-raw"):
        assert said[form] == [*one[:3], "T_rgb_imu", *one[3:]]
    assert said["opencv"] == ["T_rgb_lidar", "T_rgb_imu", "T_left_fir", "evidence"]
    assert "cannot say, so not written: evidence" in lost["opencv"]
    back = read_rig(tmp_path / PATHS["kalibr"], names=("rgb", "fir", "left"))
    np.testing.assert_allclose(back.pose("left", "imu"), rig.pose("left", "imu"), atol=1e-15)


def test_forms_are_told_from_names() -> None:
    names = {
        "rig.toml": "rig",
        "calib.json": "koide",
        "camchain.yaml": "kalibr",
        "my-camchain-2026.yaml": "kalibr",
        "out/stereo.yml": "opencv",
        "head_camera.yaml": "ros",
        "calib.txt": "kitti",
        "000123.txt": "kitti",
        "kdt.txt": "plain",
    }
    assert {name: form_of_name(name) for name in names} == names
    with pytest.raises(UsageError, match=r"does not tell the form.*rig, kalibr, ros, opencv"):
        form_of_name("rig.yaml")
    with pytest.raises(UsageError, match=r"two files"):
        form_of_name("x/calib_cam_to_cam.txt")


def test_unknown_forms_and_missing_sensors_are_told(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"unknown form of calibration 'xml'.*kalibr"):
        write_rig(tmp_path / "x", RIG, "xml")
    with pytest.raises(UsageError, match=r"how lidar stands|how rgb stands to lidar"):
        write_rig(tmp_path / "x", RIG, "plain")
    with pytest.raises(UsageError, match=r"needs how fir stands to rgb.*T_rgb_fir"):
        write_rig(tmp_path / "x", Rig(RIG.cameras), "kalibr")
    for form in set(FORMATS) - {"rig"}:
        with pytest.raises(UsageError, match=r"needs"):
            write_rig(tmp_path / "x.y", Rig({}, {"T_rgb_lidar": np.eye(4)}), form)
    assert list(tmp_path.iterdir()) == []


def test_force_leaves_distortion_out_of_kitti_and_says_so(tmp_path: Path) -> None:
    rig = Rig({"rgb": RGB}, {"T_rgb_lidar": np.eye(4)})
    for form in ("kitti", "kitti-raw"):
        with pytest.raises(UsageError, match=r"undistorted images; rgb has distortion"):
            write_rig(tmp_path / form, rig, form)
        notes = write_rig(tmp_path / form, rig, form, force=True)
        assert "undistort the images with the same camera matrix" in notes[0]
        same_lens(
            read_rig(tmp_path / form, RGB.size_wh).camera("rgb"),
            PinholeCamera(RGB.size_wh, 520.1, 521.2, 319.5, 240.25),
        )
    with pytest.raises(UsageError, match=r"fisheye"):
        write_rig(tmp_path / "x", Rig({"rgb": FIR}, {"T_rgb_lidar": np.eye(4)}), "kitti", force=True)


def test_names_and_sizes_that_are_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    write_rig(path, RIG, "kalibr")
    assert list(read_rig(path, names=("fir", "rgb")).cameras) == ["fir", "rgb"]
    assert read_rig(path, {"rgb": (640, 480), "fir": (382, 288)}).camera("fir").size_wh == (382, 288)
    with pytest.raises(UsageError, match=r"for pictures of fir of 382x288 pixels, not 640x512"):
        read_rig(path, {"fir": (640, 512)})
    for names, message in (
        (("rgb",), "2 cameras, but 1"),
        (("a b", "fir"), "unusable"),
        (("a", "a"), "unusable"),
    ):
        with pytest.raises(UsageError, match=message):
            read_rig(path, names=names)
    assert read_with_notes(path)[1] == ()
