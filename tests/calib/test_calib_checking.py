"""Planted faults are found and named, each made from a good rig; a good rig has notes only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.checking import Finding, check_file, check_rig, overlap
from fusion.geometry import T_CAM_LIDAR, FisheyeCamera, PinholeCamera, invert, pose
from fusion.rig import Rig, save_rig

NOW = datetime(2026, 11, 22, tzinfo=UTC)
RGB = PinholeCamera((640, 480), 520, 521, 318.5, 241.5, (-0.1, 0.02, 1e-4, -1e-4, 0.0))
FIR = PinholeCamera((384, 288), 310, 311, 190.5, 144.5, (-0.2, 0.05, 0.0, 0.0))
SMALL = Rotation.from_euler("xyz", [0.02, -0.03, 0.04]).as_matrix()
T_RGB_FIR = pose(SMALL, (0.06, 0.01, -0.005))
T_RGB_LIDAR = pose(SMALL @ T_CAM_LIDAR[:3, :3], (0.03, -0.12, -0.05))
GOOD = Rig({"rgb": RGB, "fir": FIR}, {"T_rgb_fir": T_RGB_FIR, "T_rgb_lidar": T_RGB_LIDAR})


def found(rig: Rig, **options: object) -> list[Finding]:
    return [f for f in check_rig(rig, now=NOW, **options) if f.severity != "note"]  # type: ignore[arg-type]


def told(rig: Rig, severity: str, **options: object) -> str:
    """The one thing found wrong."""
    findings = found(rig, **options)
    assert [f.severity for f in findings] == [severity], findings
    assert "\n" not in str(findings[0])
    return str(findings[0])


def lidar(T: np.ndarray) -> Rig:
    return replace(GOOD, transforms={"T_rgb_fir": T_RGB_FIR, "T_rgb_lidar": T})


def test_a_good_rig_has_notes_only() -> None:
    notes = [f.what for f in check_rig(GOOD, size_wh={"rgb": (640, 480), "fir": (384, 288)}, now=NOW)]
    assert found(GOOD, size_wh={"rgb": (640, 480), "fir": (384, 288)}) == []
    assert "rgb and fir are 61 mm apart" in notes
    assert "rgb and lidar are 133 mm apart" in notes
    assert sum("fir sees" in note for note in notes) == 1


def test_the_simulated_mines_rig_and_real_ones_are_good(shared_data: Path) -> None:
    for path, size in (
        (shared_data / "kitti_depth", (1242, 375)),
        (shared_data / "kitti_object" / "calib" / "000000.txt", (1224, 370)),
        (shared_data / "lidar_camera" / "1" / "calib.txt", (1920, 1200)),
    ):
        assert [f for f in check_file(path, size_wh={"rgb": size}, now=NOW) if f.severity != "note"] == []


MIX_UPS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "inverted": (invert, "it makes sense as inverted"),
    "body axes": (lambda T: invert(T_CAM_LIDAR) @ T, "without the rotation to the camera's axes"),
    "both": (lambda T: invert(invert(T_CAM_LIDAR) @ T), "inverted and without the rotation"),
    "upside down": (lambda T: np.diag([-1.0, -1, 1, 1]) @ T, "hanging upside down"),
    "opengl": (lambda T: np.diag([1.0, -1, -1, 1]) @ T, r"y up, z backward"),
}


@pytest.mark.parametrize("turn", [(0, 0, 0), (0.1, 0.2, -0.1), (-0.2, 0.3, 0.1)])
@pytest.mark.parametrize("name", MIX_UPS)
def test_the_usual_mix_ups_of_camera_and_lidar_are_named(name: str, turn: tuple[float, ...]) -> None:
    wrong, words = MIX_UPS[name]
    T = pose(Rotation.from_euler("xyz", turn).as_matrix() @ T_RGB_LIDAR[:3, :3], T_RGB_LIDAR[:3, 3])
    assert found(lidar(T)) == []
    findings = [str(f) for f in found(lidar(wrong(T))) if "up" in f.what]
    assert len(findings) == 1, findings
    assert findings[0].startswith("error: T_rgb_lidar has the LiDAR's up")
    assert words in findings[0]


def test_cameras_to_the_side_are_no_mix_up() -> None:
    for yaw, aside in ((0.5, None), (np.pi / 2, "90"), (np.pi, "180")):
        turned = pose(T_CAM_LIDAR[:3, :3] @ Rotation.from_euler("z", yaw).as_matrix())
        rig = Rig({"rgb": RGB}, {"T_rgb_lidar": turned @ pose(translation_m=(0, 0.1, 0))})
        assert found(rig) == []
        notes = [f.what for f in check_rig(rig, now=NOW) if "off the LiDAR's forward" in f.what]
        assert notes == ([f"rgb looks {aside} degrees off the LiDAR's forward (x)"] if aside else [])


def test_a_rotation_that_nothing_explains_is_told() -> None:
    for signs in ((1, -1, -1), (-1, 1, -1)):  # half turns about x and y: none of the usual mix-ups
        rig = lidar(np.diag([*map(float, signs), 1.0]) @ pose(translation_m=(0, 0.1, 0)))
        (finding,) = (f for f in found(rig) if "off the picture's up" in f.what)
        assert finding.severity == "warning"
        assert "no usual mix-up explains it" in finding.what


def test_a_lidars_matrix_in_either_direction_is_checked() -> None:
    turned = Rig({"rgb": RGB}, {"T_lidar_rgb": T_RGB_LIDAR})  # T_rgb_lidar under the name of its inverse
    assert "it makes sense as inverted" in told(turned, "error")
    assert found(Rig({"rgb": RGB}, {"T_lidar_rgb": invert(T_RGB_LIDAR)})) == []


def test_two_cameras_in_other_axes() -> None:
    for wrong, words in (
        (T_RGB_FIR @ T_CAM_LIDAR, "from body axes"),
        (invert(T_CAM_LIDAR) @ T_RGB_FIR, "to body axes"),
        (np.diag([-1.0, -1, 1, 1]) @ T_RGB_FIR, "hanging upside down"),
    ):
        rig = Rig(GOOD.cameras, {"T_rgb_fir": wrong})
        texts = [str(f) for f in found(rig)]
        assert any("degrees to each other" in text and words in text for text in texts), texts


def test_millimetres_are_told_from_metres() -> None:
    T = T_RGB_FIR.copy()
    T[:3, 3] *= 1000
    texts = [str(f) for f in found(Rig(GOOD.cameras, {"T_rgb_fir": T}))]
    assert any("rgb and fir are 61.03 m apart (millimetres? Then divide by 1000: 61 mm)" in t for t in texts)
    far = pose(translation_m=(8.0, 0, 0)) @ T_RGB_LIDAR
    assert "millimetres? Then divide by 1000" in told(lidar(far), "error")
    far = pose(translation_m=(1e5, 0, 0)) @ T_RGB_LIDAR
    assert "lengths are metres" in told(lidar(far), "warning")


def test_transformations_that_were_never_measured_or_are_missing() -> None:
    assert "never measured" in told(Rig(GOOD.cameras, {"T_rgb_fir": np.eye(4)}), "warning")
    text = told(Rig(GOOD.cameras, {"T_rgb_lidar": T_RGB_LIDAR}), "warning")
    assert "not connected: rgb, lidar | fir" in text
    notes = [f.what for f in check_rig(Rig({"rgb": RGB}, {"T_rgb_thermal": T_RGB_FIR}), now=NOW)]
    assert any("names thermal, which is no camera of the rig" in note for note in notes)
    assert "the rig has no camera" in told(Rig({}, {"T_rgb_lidar": T_RGB_LIDAR}), "error")


def test_loops_that_do_not_close() -> None:
    closed = {**GOOD.transforms, "T_fir_lidar": invert(T_RGB_FIR) @ T_RGB_LIDAR}
    assert found(replace(GOOD, transforms=closed)) == []
    closed["T_fir_lidar"] = pose(translation_m=(0, 0.02, 0)) @ closed["T_fir_lidar"]
    assert "differ by 20 mm and" in told(replace(GOOD, transforms=closed), "warning")
    turn = pose(Rotation.from_euler("x", 1, degrees=True).as_matrix())
    closed["T_fir_lidar"] = turn @ invert(T_RGB_FIR) @ T_RGB_LIDAR
    assert "and 1 degrees" in told(replace(GOOD, transforms=closed), "warning")


@pytest.mark.parametrize(
    ("change", "severity", "message"),
    [
        ({"fx": 5.0, "fy": 5.0}, "error", "focal length of 5 px for 640 px of width (is it in millimetres?"),
        ({"fx": 15000.0, "fy": 15000.0}, "warning", "field of view of 2.44 degrees"),
        ({"fx": 100.0, "fy": 100.0, "distortion": ()}, "warning", "field of view of 145 degrees"),
        ({"fx": 600.0}, "warning", "fx and fy differ by 15 %"),
        ({"cx": 900.0}, "error", "(900.0, 241.5) of 640x480 pixels lies outside"),
        ({"cx": 450.0}, "warning", "is 20 % of the picture off its middle"),
        ({"cy": 60.0}, "warning", "is 37 % of the picture off its middle"),
        ({"distortion": (-0.8, 0.0, 0.0, 0.0)}, "warning", "the picture has no direction"),
    ],
)
def test_lenses_that_cannot_be(change: dict[str, object], severity: str, message: str) -> None:
    camera = replace(RGB, **change)
    assert message in told(Rig({"rgb": camera}), severity)


def test_a_wide_fisheye_is_plausible_where_a_pinhole_is_not() -> None:
    fish = FisheyeCamera((640, 480), 200, 200, 319.5, 239.5, (0.01, 0.0, 0.0, 0.0))
    assert found(Rig({"rgb": fish})) == []
    turning = replace(fish, distortion=(-0.2, 0.0, 0.0, 0.0))
    assert "has no direction" in told(Rig({"rgb": turning}), "warning")


@pytest.mark.parametrize(
    ("size", "hint"),
    [
        ((1280, 960), "a pure rescale by 2"),
        ((320, 240), "a pure rescale by 0.5"),
        ((480, 640), "turned by 90 degrees"),
        ((640, 360), "a crop?"),
        ((1920, 1080), "neither a rescale nor a crop"),
    ],
)
def test_stale_sizes(size: tuple[int, int], hint: str) -> None:
    text = told(GOOD, "error", size_wh={"rgb": size})
    assert f"of 640x480 pixels, the pictures are {size[0]}x{size[1]}" in text
    assert hint in text
    assert "no camera of that name" in told(GOOD, "error", size_wh={"left": size})


def test_overlap_is_that_of_brute_force() -> None:
    """Same optical centre, no distortion: the share is the ratio of the fields' areas; far off, nothing."""
    wide, tight = PinholeCamera.of_fov((640, 480), 60), PinholeCamera.of_fov((640, 480), 30)
    share = np.tan(np.radians(15)) ** 2 / np.tan(np.radians(30)) ** 2
    assert overlap(wide, tight, np.eye(4), 5.0) == pytest.approx(share, abs=0.02)
    assert overlap(tight, wide, np.eye(4), 5.0) == 1
    for way in ((100.0, 0, 0), (-100.0, 0, 0), (0, 100.0, 0), (0, -100.0, 0)):
        assert overlap(wide, tight, pose(translation_m=way), 1.0) == 0
    aside = pose(translation_m=(100.0, 0, 0))
    assert overlap(wide, tight, aside, 1e6) == pytest.approx(share, abs=0.02)


def test_cameras_that_do_not_look_the_same_way() -> None:
    away = pose(Rotation.from_euler("y", 49, degrees=True).as_matrix(), (0.06, 0, 0))
    narrow = PinholeCamera.of_fov((384, 288), 30)
    text = told(Rig({"rgb": RGB, "fir": narrow}, {"T_rgb_fir": away}), "error")
    assert "fir sees 0 % at 1 m, 0 % at 5 m, 0 % at 50 m" in text


def test_a_camera_that_looks_over_the_lidar() -> None:
    up = pose(Rotation.from_euler("x", -45, degrees=True).as_matrix() @ T_CAM_LIDAR[:3, :3], (0, 0.1, 0))
    narrow = PinholeCamera.of_fov((640, 480), 30)
    text = told(Rig({"rgb": narrow}, {"T_rgb_lidar": up}), "warning")
    assert "0 % is within 15 degrees of the LiDAR's horizon" in text


def test_old_evidence() -> None:
    old = {"made": {"at": "2024-11-22T10:00:00", "rms_px": 0.3, "files": ["2020-13-45", "a.png"]}}
    assert "the calibration is 730 days old" in told(replace(GOOD, evidence=old), "warning")
    new = {"made": [{"at": datetime(2026, 11, 1, tzinfo=UTC)}, *old["made"].values()]}
    assert found(replace(GOOD, evidence=new)) == []


def test_files_that_cannot_be_read_are_findings(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(
        "image_width: 640\nimage_height: 480\ndistortion_model: plumb_bob\nd: []\n"
        "camera_matrix: {rows: 3, cols: 3, data: [0, 0, 0, 0, 0, 0, 0, 0, 0]}\n"
    )
    (only,) = check_file(tmp_path / "c.yaml", now=NOW)
    assert (only.severity, "uncalibrated" in only.what) == ("error", True)
    (only,) = check_file(tmp_path / "none.toml", now=NOW)
    assert "No such file" in only.what
    save_rig(tmp_path / "rig.toml", GOOD)
    findings = check_file(tmp_path / "rig.toml", size_wh={"rgb": (320, 240)}, now=NOW)
    assert "pure rescale by 0.5" in findings[0].hint


def test_errors_stand_first() -> None:
    bad = Rig({"rgb": replace(RGB, fx=5.0, fy=5.0, cx=900.0), "fir": FIR}, {"T_rgb_fir": np.eye(4)})
    order = [f.severity for f in check_rig(bad, now=NOW)]
    assert order == sorted(order, key=("error", "warning", "note").index)
    assert set(order) == {"error", "warning", "note"}
