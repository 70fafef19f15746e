"""rig.toml out and in to the last bit, chains of transformations, and files that are none."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fusion.errors import UsageError
from fusion.geometry import FisheyeCamera, PinholeCamera, pose
from fusion.rig import Rig, load_rig, save_rig

GOOD = """
format = "fusion-rig/1"

[cameras.rgb]
model = "pinhole"
size_wh = [640, 480]
focal_px = [520.0, 521.0]
centre_px = [319.5, 239.5]
distortion = [-0.1, 0.02, 0.0, 0.0, 0.001]

[transforms]
T_rgb_lidar = [[0, -1, 0, 0.05], [0, 0, -1, 0.1], [1, 0, 0, 0], [0, 0, 0, 1]]
"""

Write = Callable[[str], Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def _write(text: str) -> Path:
        path = tmp_path / "rig.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return _write


def some_pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return pose(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))


# ---------------------------------------------------------------- out and in


@settings(max_examples=30)
@given(
    st.lists(st.floats(1e-300, 1e300), min_size=2, max_size=2),
    st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=2, max_size=2),
    st.lists(st.floats(-1e9, 1e9), min_size=4, max_size=4),
    st.integers(0, 2**32),
)
def test_every_number_comes_back_to_the_last_bit(
    tmp_path_factory: pytest.TempPathFactory, f: list[float], c: list[float], k: list[float], seed: int
) -> None:
    path = tmp_path_factory.mktemp("rig") / "rig.toml"
    cameras = {
        "rgb": PinholeCamera((640, 480), f[0], f[1], c[0], c[1], (*k, 0.1, -0.0, 1e-9, 5e-324)),
        "fir": FisheyeCamera((640, 512), f[1], f[0], c[1], c[0], tuple(k)),
        "plain": PinholeCamera((1, 32768), 500, 501, 3, 4),
    }
    rig = Rig(cameras, {"T_rgb_lidar": some_pose(seed), "T_rgb_fir": some_pose(seed + 1)})
    save_rig(path, rig)
    back = load_rig(path)
    assert back.cameras == cameras
    assert list(back.transforms) == list(rig.transforms)
    for name, T in rig.transforms.items():
        assert back.transforms[name].tobytes() == T.tobytes()
    first = path.read_bytes()
    save_rig(path, back)
    assert path.read_bytes() == first


def test_a_rounded_rotation_is_repaired_once_and_then_stays(tmp_path: Path) -> None:
    rig = Rig({}, {"T_rgb_lidar": some_pose(3).round(5)})
    R = rig.transforms["T_rgb_lidar"][:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    save_rig(tmp_path / "rig.toml", rig)
    again = load_rig(tmp_path / "rig.toml")
    assert (again.transforms["T_rgb_lidar"] == rig.transforms["T_rgb_lidar"]).all()


def test_numpy_numbers_can_be_written(tmp_path: Path) -> None:
    w, h = np.array([640, 480])
    fx, fy, cx, cy = np.array([500, 501, 320, 240], np.float32)
    save_rig(tmp_path / "rig.toml", Rig({"rgb": PinholeCamera((w, h), fx, fy, cx, cy)}))
    assert load_rig(tmp_path / "rig.toml").camera("rgb") == PinholeCamera((640, 480), 500, 501, 320, 240)


def test_the_documented_file_is_read(write: Write) -> None:
    rig = load_rig(write(GOOD))
    expected = PinholeCamera((640, 480), 520, 521, 319.5, 239.5, (-0.1, 0.02, 0, 0, 0.001))
    assert rig.camera("rgb") == expected
    assert (rig.pose("rgb", "lidar") @ (10, 2, 1, 1) == (-1.95, -0.9, 10, 1)).all()


def test_three_rows_and_an_empty_rig_are_read(write: Write) -> None:
    three = GOOD.replace(", [0, 0, 0, 1]]", "]")
    assert (load_rig(write(three)).pose("rgb", "lidar")[3] == (0, 0, 0, 1)).all()
    assert load_rig(write('format = "fusion-rig/1"')) == Rig({}, {})


# ---------------------------------------------------------------- chains


def test_chains_and_inverses() -> None:
    T_rgb_lidar, T_fir_rgb, T_imu_lidar = some_pose(1), some_pose(2), some_pose(3)
    rig = Rig({}, {"T_imu_lidar": T_imu_lidar, "T_fir_rgb": T_fir_rgb, "T_rgb_lidar": T_rgb_lidar})
    np.testing.assert_allclose(rig.pose("rgb", "lidar"), T_rgb_lidar, atol=1e-15)
    np.testing.assert_allclose(rig.pose("lidar", "rgb"), np.linalg.inv(T_rgb_lidar), atol=1e-14)
    np.testing.assert_allclose(rig.pose("fir", "lidar"), T_fir_rgb @ T_rgb_lidar, atol=1e-14)
    expected = T_imu_lidar @ np.linalg.inv(T_rgb_lidar) @ np.linalg.inv(T_fir_rgb)
    np.testing.assert_allclose(rig.pose("imu", "fir"), expected, atol=1e-14)
    assert (rig.pose("fir", "fir") == np.eye(4)).all()


def test_the_shortest_chain_is_taken() -> None:
    direct = some_pose(9)
    rig = Rig({}, {"T_a_b": some_pose(1), "T_b_c": some_pose(2), "T_a_c": direct})
    np.testing.assert_allclose(rig.pose("a", "c"), direct, atol=1e-15)


def test_what_is_unknown_lists_what_there_is() -> None:
    rig = Rig({"rgb": PinholeCamera((4, 4), 1, 1, 0, 0)}, {"T_rgb_lidar": np.eye(4), "T_a_b": np.eye(4)})
    with pytest.raises(UsageError, match=r"no camera 'fir' .*has rgb"):
        rig.camera("fir")
    with pytest.raises(UsageError, match="has none"):
        Rig().camera("fir")
    with pytest.raises(UsageError, match=r"how a stands to rgb .*T_a_b, T_rgb_lidar"):
        rig.pose("a", "rgb")
    with pytest.raises(UsageError, match="no transformation"):
        Rig().pose("a", "rgb")


def test_a_rig_is_checked_when_made_and_keeps_its_own_copy() -> None:
    T = some_pose(1)
    rig = Rig({}, {"T_rgb_lidar": T})
    T[0, 3] = 99
    assert rig.transforms["T_rgb_lidar"][0, 3] != 99
    with pytest.raises(UsageError, match="T_rgb_lidar: the transformation is not rigid"):
        Rig({}, {"T_rgb_lidar": 2 * np.eye(4)})
    for name in ("rgb_lidar", "T_rgb", "T_a_b_c", "T_rgb_LiDAR", "T_rgb_", "H_rgb_fir"):
        with pytest.raises(UsageError, match="T_dst_src"):
            Rig({}, {name: np.eye(4)})


# ---------------------------------------------------------------- files that are none


BROKEN = {
    "unknown key": ('format = "', 'colour = 1\nformat = "', "colour: extra"),
    "unknown key of a camera": ("model =", "f = 3\nmodel =", "cameras.rgb.f: extra"),
    "no format": ('format = "fusion-rig/1"', "", "format: field required"),
    "another format": ("fusion-rig/1", "fusion-rig/2", "format: "),
    "unknown model": ('"pinhole"', '"pinhol"', "cameras.rgb.model"),
    "no size": ("size_wh = [640, 480]", "", "cameras.rgb.size_wh: field required"),
    "size 0": ("[640, 480]", "[640, 0]", "cameras.rgb.size_wh.1"),
    "giant size": ("[640, 480]", "[640, 1000000]", "cameras.rgb: an image of 640x1000000"),
    "one focal length": ("[520.0, 521.0]", "[520.0]", "cameras.rgb.focal_px"),
    "negative focal length": ("520.0", "-520.0", "cameras.rgb: focal lengths"),
    "nan": ("520.0", "nan", "cameras.rgb.focal_px.0"),
    "inf in distortion": ("0.001]", "inf]", "cameras.rgb.distortion.4"),
    "three coefficients": ("[-0.1, 0.02, 0.0, 0.0, 0.001]", "[1.0, 0.0, 0.0]", "cameras.rgb: 3 distortion"),
    "text for a number": ("520.0", '"wide"', "cameras.rgb.focal_px.0"),
    "two rows": (", [1, 0, 0, 0], [0, 0, 0, 1]]", "]", "transforms.T_rgb_lidar"),
    "short row": ("[1, 0, 0, 0]", "[1, 0, 0]", "transforms.T_rgb_lidar.2"),
    "nan in a pose": ("0.05", "nan", "transforms.T_rgb_lidar.0.3"),
    "mirrored": ("[1, 0, 0, 0]", "[-1, 0, 0, 0]", "T_rgb_lidar: the transformation mirrors"),
    "scaled": ("[1, 0, 0, 0]", "[2, 0, 0, 0]", "T_rgb_lidar: the transformation is not rigid"),
    "misnamed": ("T_rgb_lidar", "lidar2rgb", "lidar2rgb"),
    "no TOML": ("[cameras.rgb]", "[cameras.rgb", "cannot be read"),
    "twice": ("[transforms]", "[cameras.rgb]", "cannot be read"),
    "deep": ("[640, 480]", "[" * 50_000, "cannot be read"),
    "long number": ("[640, 480]", "[" + "9" * 5000 + ", 1]", "cannot be read"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_one_line_with_file_and_key(name: str, write: Write) -> None:
    old, new, message = BROKEN[name]
    assert old in GOOD
    path = write(GOOD.replace(old, new, 1))
    with pytest.raises(UsageError) as error:
        load_rig(path)
    text = str(error.value)
    assert text.startswith(f"{path}: ")
    assert message in text
    assert "\n" not in text
    assert len(text) < 400


def test_files_that_are_not_there_or_not_text(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="No such file"):
        load_rig(tmp_path / "none.toml")
    with pytest.raises(UsageError, match="directory"):
        load_rig(tmp_path)
    path = tmp_path / "rig.toml"
    path.write_bytes(bytes(range(256)))
    with pytest.raises(UsageError, match="cannot be read"):
        load_rig(path)
    with path.open("wb") as file:
        file.truncate((1 << 24) + 1)  # a hole: no disk is used
    with pytest.raises(UsageError, match="too large"):
        load_rig(path)


def test_offsets_and_evidence_come_back(tmp_path: Path) -> None:
    evidence = {
        "verdict": "good for 5 m",
        "figures": {"rms_px": {"rgb": 0.25}, "views": 30},
        "covariance": [[1e-9, -2.5e-10], [-2.5e-10, 3e-9]],
        "inputs": [{"file": "a.png", "sha256": "00"}],
    }
    rig = Rig({"rgb": PinholeCamera((640, 480), 500, 500, 319.5, 239.5)}, {}, {"fir": -0.0125}, evidence)
    save_rig(tmp_path / "rig.toml", rig)
    again = load_rig(tmp_path / "rig.toml")
    assert again.time_offset_s == {"fir": -0.0125}
    assert again.evidence == evidence


def test_an_offset_must_be_a_number(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text('format = "fusion-rig/1"\n[time_offset_s]\nfir = nan\n')
    with pytest.raises(UsageError, match=r"time_offset_s\.fir"):
        load_rig(path)
