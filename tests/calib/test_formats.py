"""Calibrations of other tools: the textbook's projection comes out, and what is broken says where."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from calib.formats import read_rig
from fusion.errors import UsageError
from fusion.frames import PointCloud
from fusion.geometry import PinholeCamera, pose
from fusion.lidar.project import project
from fusion.rig import Rig, save_rig

# Like KITTI's, made up: rotations of full precision, offsets in all three rows of P.
R_RECT = Rotation.from_euler("xyz", [0.01, -0.02, 0.005]).as_matrix()
R_VELO = Rotation.from_euler("xyz", [0.02, 0.01, -0.015]).as_matrix() @ [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
T_VELO = np.array([-0.004, -0.08, -0.27])
P2 = np.array([[700.0, 0, 601.5, 45.1], [0, 690.0, 180.25, -0.4], [0, 0, 1, 0.005]])
K = np.array([[700.0, 0, 601.5], [0, 690.0, 180.25], [0, 0, 1]])
D = (-0.12, 0.16, 7e-4, 1.4e-3)


def words(numbers: Any) -> str:
    return " ".join(repr(float(x)) for x in np.ravel(numbers))


OBJECT = f"""P0: {words(K @ np.eye(3, 4))}
P2: {words(P2)}
R0_rect: {words(R_RECT)}
Tr_velo_to_cam: {words(pose(R_VELO, T_VELO)[:3])}

"""
CAMERAS = f"""calib_time: 09-Jan-2012 13:57:47
S_rect_02: 1.242000e+03 3.750000e+02
R_rect_00: {words(R_RECT)}
P_rect_02: {words(P2)}
"""
LIDAR = f"""calib_time: 15-Mar-2012 11:37:16
R: {words(R_VELO)}
T: {words(T_VELO)}
delta_f: 0.000000e+00 0.000000e+00
"""
PLAIN = f"K: {words(K)}\nD: {words(D)}\nT: {words(pose(R_VELO, T_VELO)[:3])}\n"
MINIATURES = {"object": OBJECT, "plain": PLAIN}


def written(folder: Path, text: str | bytes, name: str = "calib.txt") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def raw_folder(folder: Path, cameras: str = CAMERAS, lidar: str = LIDAR) -> Path:
    written(folder, cameras, "calib_cam_to_cam.txt")
    written(folder, lidar, "calib_velo_to_cam.txt")
    return folder


def cloud(seed: int = 0, count: int = 2000) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    return rng.uniform((3, -10, -2), (60, 10, 2), (count, 3))


def textbook(P: NDArray, R_rect: NDArray, T_velo: NDArray, xyz: NDArray) -> NDArray[np.float64]:
    """The columns u, v, z of P R T p, all 4 x 4 as in the benchmark's devkit."""
    R = np.eye(4)
    R[:3, :3] = R_rect
    T = np.eye(4)
    T[:3] = T_velo
    u, v, z = P @ R @ T @ np.vstack([xyz.T, np.ones(len(xyz))])
    return np.stack([u / z, v / z, z], -1)


def ours(rig: Rig, xyz: NDArray) -> NDArray[np.float64]:
    at = np.column_stack([xyz, np.ones(len(xyz))]) @ rig.pose("rgb", "lidar").T
    return np.column_stack([rig.camera("rgb").project(at[:, :3])[0], at[:, 2]])


# ---------------------------------------------------------------- the textbook


@pytest.mark.parametrize("form", ["object", "raw"])
def test_miniature_kitti_is_the_textbooks_product(form: str, tmp_path: Path) -> None:
    if form == "object":
        rig = read_rig(written(tmp_path, OBJECT), (1242, 375))
    else:
        rig = read_rig(raw_folder(tmp_path))
    expected = textbook(P2, R_RECT, pose(R_VELO, T_VELO)[:3], cloud())
    np.testing.assert_allclose(ours(rig, cloud()), expected, atol=1e-9)
    assert rig.camera("rgb") == PinholeCamera((1242, 375), 700.0, 690.0, 601.5, 180.25)
    assert list(rig.cameras) == ["rgb"]
    assert list(rig.transforms) == ["T_rgb_lidar"]


@pytest.mark.parametrize("form", ["object", "raw"])
def test_real_kitti_is_the_textbooks_product(form: str, shared_data: Path) -> None:
    """To 1e-9 px with the nearest rotations (by SciPy); with the rounded ones, to what rounding is worth."""
    if form == "object":
        path = shared_data / "kitti_object" / "calib" / "000000.txt"
        rig = read_rig(path, (1224, 370))
        found = table(path)
        P, R, T = found["P2"], found["R0_rect"], found["Tr_velo_to_cam"].reshape(3, 4)
    else:
        folder = shared_data / "kitti_depth"
        rig = read_rig(folder)
        found, lidar = table(folder / "calib_cam_to_cam.txt"), table(folder / "calib_velo_to_cam.txt")
        P, R = found["P_rect_02"], found["R_rect_00"]
        T = np.column_stack([lidar["R"].reshape(3, 3), lidar["T"]])
        assert rig.camera("rgb").size_wh == (1242, 375)
    P, R = P.reshape(3, 4), R.reshape(3, 3)
    exact = np.column_stack([polar(T[:, :3])[0], T[:, 3]])
    xyz = cloud()
    np.testing.assert_allclose(ours(rig, xyz), textbook(P, polar(R)[0], exact, xyz), atol=1e-9)
    # Seven digits: each of nine numbers is off by 5e-8, at most 700 px away from the centre, and twice.
    np.testing.assert_allclose(ours(rig, xyz), textbook(P, R, T, xyz), atol=2e-3)


def table(path: Path) -> dict[str, NDArray]:
    lines = [line.partition(":") for line in path.read_text().splitlines() if line.strip()]
    return {key: np.array(rest.split(), float) for key, _, rest in lines if key != "calib_time"}


@pytest.mark.parametrize("extra", [(), (0.05,), (0.05, 0.01, -0.02, 0.003)])
def test_miniature_plain_is_opencvs(extra: tuple[float, ...], tmp_path: Path) -> None:
    text = PLAIN.replace(words(D), words((*D, *extra)))
    rig = read_rig(written(tmp_path, text), (1242, 375))
    near = cloud() * (1, 0.2, 1)
    rvec = cv2.Rodrigues(R_VELO)[0]
    expected = cv2.projectPoints(near[:, None], rvec, T_VELO, K, np.array((*D, *extra)))[0][:, 0]
    np.testing.assert_allclose(ours(rig, near)[:, :2], expected, atol=1e-9)


def test_real_plain_is_opencvs(shared_data: Path) -> None:
    for folder in ("1", "2"):
        path = shared_data / "lidar_camera" / folder / "calib.txt"
        rig, found = read_rig(path, (1920, 1200)), table(path)
        T = found["T"].reshape(3, 4)
        xyz = cloud() * (1, 0.3, 1)
        rvec = cv2.Rodrigues(polar(T[:, :3])[0])[0]
        expected = cv2.projectPoints(xyz[:, None], rvec, T[:, 3], found["K"].reshape(3, 3), found["D"])[0]
        np.testing.assert_allclose(ours(rig, xyz)[:, :2], expected[:, 0], atol=1e-7)


def test_our_own_file(tmp_path: Path) -> None:
    rig = Rig({"rgb": PinholeCamera((64, 48), 50, 51, 32, 24, D)}, {"T_rgb_lidar": pose(R_VELO, T_VELO)})
    save_rig(tmp_path / "anything.txt", rig)
    for size_wh in (None, (64, 48)):
        back = read_rig(str(tmp_path / "anything.txt"), size_wh)
        assert back.cameras == rig.cameras
        assert (back.transforms["T_rgb_lidar"] == rig.transforms["T_rgb_lidar"]).all()


# ---------------------------------------------------------------- real pictures


def edges_off_samples(rig: Rig, xyz: NDArray, image: NDArray, turn_deg: float) -> float:
    """How far, in px on average, the picture's edges are from where neighbouring returns leap in depth."""
    T = pose(Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()) @ rig.pose("rgb", "lidar")
    sparse = project(PointCloud(xyz), rig.camera("rgb"), T, limits_m=(2, 40))
    near, far = sparse.value_m[:-1], sparse.value_m[1:]
    neighbours = (np.hypot(np.diff(sparse.u), np.diff(sparse.v)) < 12) & (np.diff(sparse.index) < 3)
    closer = np.where(far > 1.15 * near + 0.5, 0, 1)
    leap = neighbours & (np.abs(far - near) > 0.15 * np.minimum(near, far) + 0.5)
    at = np.flatnonzero(leap) + closer[leap]
    canny = cv2.Canny(cv2.GaussianBlur(image, (5, 5), 0), 60, 150)
    distance = cv2.distanceTransform(255 - canny, cv2.DIST_L2, 5)
    rows, columns = (sparse.v[at] + 0.5).astype(int), (sparse.u[at] + 0.5).astype(int)
    assert at.size > 200
    return float(np.minimum(distance[rows, columns], 20).mean())


def test_depth_edges_of_kitti_stand_on_edges_of_its_picture(shared_data: Path) -> None:
    """Turned by half a degree (6 px) or more to either side, they fit less well: the calibration is right."""
    folder = shared_data / "kitti_object"
    image = cv2.imread(str(folder / "image_2" / "000000.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    xyz = np.fromfile(folder / "velodyne" / "000000.bin", np.float32).reshape(-1, 4)[:, :3]
    rig = read_rig(folder / "calib" / "000000.txt", (image.shape[1], image.shape[0]))
    right = edges_off_samples(rig, xyz, image, 0)
    for turn_deg in (-2, -1, -0.5, 0.5, 1, 2):
        assert right < edges_off_samples(rig, xyz, image, turn_deg), turn_deg


# ---------------------------------------------------------------- telling the form


def test_either_file_of_a_raw_recording_and_its_folder_are_one_rig(tmp_path: Path) -> None:
    raw_folder(tmp_path)
    poses = [
        read_rig(path).pose("rgb", "lidar")
        for path in (tmp_path, tmp_path / "calib_cam_to_cam.txt", tmp_path / "calib_velo_to_cam.txt")
    ]
    assert (poses[0] == poses[1]).all()
    assert (poses[0] == poses[2]).all()


def test_the_name_does_not_matter_nor_do_line_ends_or_a_byte_order_mark(tmp_path: Path) -> None:
    expected = read_rig(written(tmp_path, OBJECT), (1242, 375)).pose("rgb", "lidar")
    for text in (OBJECT.replace("\n", "\r\n"), "\ufeff" + OBJECT, "\n\n" + OBJECT, OBJECT.replace(" ", "\t")):
        path = written(tmp_path, text, "rig.toml")
        assert (read_rig(path, (1242, 375)).pose("rgb", "lidar") == expected).all()


@pytest.mark.parametrize("form", MINIATURES)
def test_a_form_without_a_size_asks_for_it(form: str, tmp_path: Path) -> None:
    path = written(tmp_path, MINIATURES[form])
    with pytest.raises(UsageError, match="does not say how large the pictures are") as error:
        read_rig(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "size_wh" in error.value.hint
    with pytest.raises(UsageError, match="an image of 0x3"):
        read_rig(path, (0, 3))


def test_a_form_with_a_size_refuses_another(tmp_path: Path) -> None:
    raw_folder(tmp_path)
    assert read_rig(tmp_path, (1242, 375)).camera("rgb").size_wh == (1242, 375)
    with pytest.raises(UsageError, match="for pictures of 1242x375 pixels, not 640x480"):
        read_rig(tmp_path, (640, 480))


@pytest.mark.parametrize(
    "text", ["width: 3\nheight: 4", "R: 1\nT: 2", "P0: 1 2 3", "hello there", '{"camera": {}}', "a, b\n1, 2"]
)
def test_no_known_form_lists_the_forms(text: str, tmp_path: Path) -> None:
    path = written(tmp_path, text)
    for there in (path, tmp_path):
        with pytest.raises(UsageError, match=r"rig\.toml, a KITTI object") as error:
            read_rig(there)
        assert str(error.value).startswith(f"{there}: ")


def test_another_transformation_beside_a_raw_recording_is_not_taken_for_it(tmp_path: Path) -> None:
    raw_folder(tmp_path)
    imu = written(tmp_path, f"R: {words(R_RECT)}\nT: 0 0 0\n", "calib_imu_to_velo.txt")
    with pytest.raises(UsageError, match="no calibration of a known form"):
        read_rig(imu)


# ---------------------------------------------------------------- broken files

KEYS = {
    "object": (OBJECT, ["P2", "R0_rect", "Tr_velo_to_cam"]),
    "plain": (PLAIN, ["K", "D", "T"]),
    "raw cameras": (CAMERAS, ["S_rect_02", "R_rect_00", "P_rect_02"]),
    "raw lidar": (LIDAR, ["R", "T"]),
}


def spoiled(text: str, key: str, change: str) -> str:
    lines = text.splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith(f"{key}:"))
    first, *rest = lines[at].split(":")[1].split()
    new = {
        "missing": None,
        "short": f"{key}: {' '.join(rest)}",
        "long": f"{lines[at]} 1.0 1.0",
        "empty": f"{key}:",
        "nan": f"{key}: nan {' '.join(rest)}",
        "inf": f"{key}: -inf {' '.join(rest)}",
        "text": f"{key}: x{first} {' '.join(rest)}",
        "commas": f"{key}: {', '.join([first, *rest])}",
        "twice": f"{lines[at]}\n{lines[at]}",
    }[change]
    lines[at : at + 1] = [] if new is None else [new]
    return "\n".join(lines)


CHANGES = ["missing", "short", "long", "empty", "nan", "inf", "text", "commas", "twice"]


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize(("form", "key"), [(form, key) for form, (_, keys) in KEYS.items() for key in keys])
def test_a_broken_key_is_one_line_with_file_and_key(form: str, key: str, change: str, tmp_path: Path) -> None:
    text = spoiled(KEYS[form][0], key, change)
    if form == "raw cameras":
        path = raw_folder(tmp_path, cameras=text) / "calib_cam_to_cam.txt"
    elif form == "raw lidar":
        path = raw_folder(tmp_path, lidar=text) / "calib_velo_to_cam.txt"
    else:
        path = written(tmp_path, text)
    with pytest.raises(UsageError) as error:
        read_rig(tmp_path if form.startswith("raw") else path, (1242, 375))
    line = str(error.value)
    assert line.startswith(f"{path}: {key} ")
    assert "\n" not in line
    told = {"missing": "is missing", "twice": "stands twice", "nan": "not finite", "inf": "not finite"}
    counted = {"short": "numbers", "long": "numbers", "empty": "has 0 numbers"}
    assert (told | counted | {"text": "no number", "commas": "no number"})[change] in line


def test_numbers_that_are_no_calibration(tmp_path: Path) -> None:
    skewed, scaled, mirrored = P2.copy(), pose(2 * R_VELO, T_VELO)[:3], pose(-R_VELO, T_VELO)[:3]
    skewed[0, 1] = 1
    good = words(pose(R_VELO, T_VELO)[:3])
    for old, new, message in (
        (words(P2), words(skewed), "P2 is no camera matrix without skew"),
        (words(P2), words(2 * P2), "P2 is no camera matrix"),
        (words(P2), words(P2 * [[-1], [1], [1]]), "P2: focal lengths must be positive"),
        (words(P2), words(0 * P2), "P2: the camera is uncalibrated"),
        (words(R_RECT), words(0 * R_RECT), "R0_rect: the transformation is not rigid"),
        (good, words(scaled), "Tr_velo_to_cam: the transformation is not rigid"),
        (good, words(mirrored), "Tr_velo_to_cam: the transformation mirrors"),
    ):
        assert old in OBJECT
        path = written(tmp_path, OBJECT.replace(old, new))
        with pytest.raises(UsageError) as error:
            read_rig(path, (1242, 375))
        assert str(error.value).startswith(f"{path}: {message}")
    with pytest.raises(UsageError, match="S_rect_02 holds no whole numbers"):
        read_rig(raw_folder(tmp_path, cameras=CAMERAS.replace("3.750000e+02", "375.5")))
    with pytest.raises(UsageError, match="P_rect_02: an image of 0x375"):
        read_rig(raw_folder(tmp_path, cameras=CAMERAS.replace("1.242000e+03", "0")))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b" \r\n\t\n", "is empty"),
        (bytes(range(256)) * 10, "is not text"),
        (b"P2: 1 2\0 3", "is not text"),
        (np.random.default_rng(0).bytes(5000), "is not text"),
        (b"P2: " + b"1 " * (1 << 20), "too large"),
        (b"\n" * (1 << 20), "is empty"),
        (b"\n" * ((1 << 20) - 1) + b"x", "is not KEY: numbers"),
        (b"P2 1 2 3", "line 1 is not KEY: numbers"),
        (OBJECT.encode() + b"and so on", "line 6 is not KEY: numbers"),
        (b'format = "fusion-rig/7"', "format: "),
        (b"[cameras.rgb]\nmodel = 'pinhole'", "format: field required"),
    ],
)
def test_files_that_are_no_calibration(content: bytes, message: str, tmp_path: Path) -> None:
    path = written(tmp_path, content)
    with pytest.raises(UsageError) as error:
        read_rig(path, (1242, 375))
    assert str(error.value).startswith(f"{path}: ")
    assert message in str(error.value)


def test_files_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"none\.txt: .*No such file"):
        read_rig(tmp_path / "none.txt")
    raw_folder(tmp_path)
    (tmp_path / "calib_velo_to_cam.txt").unlink()
    with pytest.raises(UsageError, match=r"calib_velo_to_cam\.txt: .*No such file"):
        read_rig(tmp_path / "calib_cam_to_cam.txt")
    shutil.rmtree(tmp_path)
    with pytest.raises(UsageError, match="No such file"):
        read_rig(tmp_path)
