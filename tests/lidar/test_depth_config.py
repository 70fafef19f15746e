"""What `fusion depth` may be told, and that what cannot be meant is refused by its key."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusion.errors import UsageError
from fusion.geometry import invert
from fusion.lidar.config import CameraConfig, DepthConfig, load_depth_config


def test_the_thesis_preset_is_method_section_2() -> None:
    config = DepthConfig.of(preset="thesis")
    assert (config.samples.value, config.samples.visibility) == ("range", "none")
    assert (config.dense.method, config.dense.extrapolate) == ("linear", "linear")
    assert (config.camera.model, config.camera.fov_deg) == ("pinhole", 120)
    assert (config.picture.colormap, config.picture.show_m) == ("jet", (1, 10))
    assert (config.cloud.range_m, config.cloud.voxel_m, config.camera.look_deg) == (None, None, None)
    assert config.dense.max_gap_px is not None
    assert config.dense.max_gap_px > math.hypot(*config.camera.size_wh)  # no gap is too large


def test_settings_win_over_their_preset_key_by_key() -> None:
    config = DepthConfig.of(preset="thesis", dense={"method": "natural"})
    assert (config.dense.method, config.dense.extrapolate) == ("natural", "linear")
    assert DepthConfig.of().dense.extrapolate == "none"


@pytest.mark.parametrize(
    ("groups", "words"),
    [
        ({"preset": "thesys"}, ["thesys", "auto, thesis"]),
        ({"preset": ["thesis"]}, ["preset"]),
        ({"dens": {}}, ["dens"]),
        ({"dense": {"methd": "linear"}}, ["dense.methd"]),
        ({"dense": {"max_gap_px": 0}}, ["dense.max_gap_px"]),
        ({"dense": {"max_gap_px": math.nan}}, ["dense.max_gap_px"]),
        ({"cloud": {"range_m": (5, 1)}}, ["cloud.range_m", "5 to 1"]),
        ({"cloud": {"range_m": (-1, 1)}}, ["cloud.range_m"]),
        ({"cloud": {"box_m": (0, 0, 1, 1, 1, 1)}}, ["cloud.box_m", "lower corner first"]),
        ({"cloud": {"voxel_m": 0}}, ["cloud.voxel_m"]),
        ({"cloud": {"outliers": (1, 2.0)}}, ["cloud.outliers"]),
        ({"cloud": {"outliers": (20, 0.0)}}, ["cloud.outliers"]),
        ({"samples": {"limits_m": (0, 256)}}, ["samples.limits_m", "at most 255.996"]),
        ({"samples": {"limits_m": (3, 3)}}, ["samples.limits_m"]),
        ({"picture": {"show_m": (10, 1)}}, ["picture.show_m"]),
        ({"picture": {"show_m": (0, 1e300)}}, ["picture.show_m"]),
        ({"camera": {"size_wh": (0, 4)}}, ["camera.size_wh"]),
        ({"camera": {"size_wh": (32768, 32768)}}, ["camera.size_wh", "32768x32768"]),
        ({"camera": {"fov_deg": math.nan}}, ["camera.fov_deg"]),
        ({"camera": {"rig": "r.toml", "look_deg": (0, 0, 0)}}, ["placed twice"]),
        ({"camera": {"rig": "r.toml", "fov_deg": 90}}, ["camera.fov_deg", "rig"]),
        ({"camera": {"sensor": "fir"}}, ["camera.sensor", "rig"]),
        ({"camera": {"position_m": (0, 0, 0), "T_cam_lidar": np.eye(4).tolist()}}, ["placed twice"]),
    ],
)
def test_what_cannot_be_meant_is_refused_by_its_key(groups: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(UsageError) as refused:
        DepthConfig.of(**groups)
    for word in words:
        assert word in str(refused.value)


def test_the_farthest_limit_that_the_message_names_is_accepted() -> None:
    assert DepthConfig.of(samples={"limits_m": (0, 255.996)}).samples.limits_m[1] == 255.996


@pytest.mark.parametrize("fov_deg", [0, -5, 180, 360])
def test_a_field_of_view_that_a_pinhole_cannot_have(fov_deg: float) -> None:
    with pytest.raises(UsageError, match="field of view"):
        CameraConfig(fov_deg=fov_deg).virtual()


@pytest.mark.parametrize("model", ["pinhole", "fisheye", "cylindrical", "spherical"])
def test_every_model_sees_its_field_of_view_from_edge_to_edge(model: Any) -> None:
    camera = CameraConfig(model=model, fov_deg=100, size_wh=(64, 48)).virtual()
    edges = camera.unproject(np.array([[-0.5, 23.5], [63.5, 23.5]]))
    azimuth = np.degrees(np.arctan2(edges[:, 0], edges[:, 2]))
    np.testing.assert_allclose(azimuth, [-50, 50], atol=1e-9)


@pytest.mark.parametrize(
    ("look_deg", "seen_ahead", "seen_above"),  # LiDAR axes: x forward, y left, z up
    [
        ((0, 0, 0), (1, 0, 0), (0, 0, 1)),
        ((90, 0, 0), (0, 1, 0), (0, 0, 1)),  # to the left
        ((0, 90, 0), (0, 0, -1), (1, 0, 0)),  # down
        ((0, 0, 90), (1, 0, 0), (0, -1, 0)),  # clockwise: its top goes to the right
        ((90, 90, 0), (0, 0, -1), (0, 1, 0)),  # yaw first
    ],
)
def test_where_a_camera_looks(look_deg: Any, seen_ahead: Any, seen_above: Any) -> None:
    position = np.array([12, 0.5, 1.4])
    T_lidar_cam = invert(CameraConfig(position_m=tuple(position.tolist()), look_deg=look_deg).pose())
    np.testing.assert_allclose(T_lidar_cam[:3, 3], position, atol=1e-12)
    np.testing.assert_allclose(T_lidar_cam[:3, :3] @ (0, 0, 1), seen_ahead, atol=1e-12)
    np.testing.assert_allclose(T_lidar_cam[:3, :3] @ (0, -1, 0), seen_above, atol=1e-12)


def test_a_given_pose_is_taken_as_it_is_and_must_be_rigid() -> None:
    T = [[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3]]
    assert CameraConfig.model_validate({"T_cam_lidar": T}).pose()[:3].tolist() == T
    with pytest.raises(UsageError, match=r"camera\.T_cam_lidar.*not rigid"):
        CameraConfig.model_validate({"T_cam_lidar": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]]}).pose()


def test_options_win_over_the_file_and_its_paths_count_from_its_folder(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text('format = "fusion-depth/1"\n[camera]\nrig = "r.toml"\n[dense]\nmethod = "scan"\n')
    config = load_depth_config(path, {"dense": {"method": "linear"}})
    assert config.dense.method == "linear"
    assert config.camera.rig == str(tmp_path / "r.toml")


@pytest.mark.parametrize("line", ["dense = 3", 'camera = "rgb"', "preset = 1", "[dense]\nmethod = 1"])
def test_a_file_that_is_wrong_is_refused_even_where_options_would_win(tmp_path: Path, line: str) -> None:
    path = tmp_path / "c.toml"
    path.write_text(f'format = "fusion-depth/1"\n{line}\n')
    with pytest.raises(UsageError, match=r"c\.toml"):
        load_depth_config(path, {"camera": {"fov_deg": 90.0}, "dense": {"extrapolate": "none"}})


def test_a_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text('format = "fusion-blend/1"\n')
    with pytest.raises(UsageError, match="fusion-depth/1"):
        load_depth_config(path, {})
    with pytest.raises(UsageError, match="nowhere"):
        load_depth_config(tmp_path / "nowhere.toml", {})
