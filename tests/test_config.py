from __future__ import annotations

from pathlib import Path

import pytest

from fusion.config import BlendConfig, load_config
from fusion.errors import UsageError


def test_auto_is_the_default_and_as_the_readme_says() -> None:
    config = BlendConfig.of()
    assert config.preset == "auto"
    assert (config.thermal.window, config.thermal.window_unit, config.thermal.window_over) == (
        (1.0, 99.0),
        "percentile",
        "sequence",
    )
    assert config.thermal.colormap == "hsv-cold-hot"
    assert config.blend.alpha == 0.85


def test_thesis_preset_is_the_thesis() -> None:
    config = BlendConfig.of(preset="thesis")
    assert (config.thermal.window, config.thermal.window_unit) == ((0.3, 0.6), "fraction")
    assert (config.thermal.colormap, config.blend.method, config.blend.alpha) == ("hsv", "alpha", 0.85)
    assert config.warp.outside == "crop"


def test_options_win_over_the_file_and_the_file_over_the_preset(tmp_path: Path) -> None:
    path = tmp_path / "run.toml"
    path.write_text(
        'format = "fusion-blend/1"\npreset = "thesis"\n[blend]\nalpha = 0.7\n[thermal]\nclahe = 2\n'
    )
    config = load_config(path, {"blend": {"alpha": 0.6}})
    assert (config.preset, config.blend.alpha, config.thermal.clahe) == ("thesis", 0.6, 2)
    assert config.thermal.colormap == "hsv"


def test_a_window_by_hand_is_a_fraction_whatever_the_preset() -> None:
    assert BlendConfig.of(thermal={"window": (0.2, 0.8)}).thermal.window_unit == "fraction"
    with pytest.raises(UsageError, match="--window"):
        BlendConfig.of(thermal={"window": (2, 98)})  # percentiles without saying so


@pytest.mark.parametrize(
    ("given", "mode"),
    [
        ({}, "infinity"),
        ({"distance_m": 5}, "distance"),
        ({"depth": "maps"}, "depth"),
        ({"depth": "maps", "distance_m": 5}, "depth"),
    ],
)
def test_the_mode_of_a_rig_follows_from_what_is_given(given: dict[str, object], mode: str) -> None:
    assert BlendConfig.of(warp={"rig": "rig.toml", **given}).warp.mode == mode
    assert BlendConfig.of(warp={"rig": "rig.toml", "mode": mode, **given}).warp.mode == mode
    assert BlendConfig.of().warp.mode is None


def test_paths_in_the_file_count_from_its_folder(tmp_path: Path) -> None:
    path = tmp_path / "sub" / "run.toml"
    path.parent.mkdir()
    path.write_text('format = "fusion-blend/1"\n[warp]\nhomography = "H.toml"\n')
    assert load_config(path, {}).warp.homography == str(path.parent / "H.toml")


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"blend": {"alfa": 0.5}}, "blend.alfa"),
        ({"blend": {"alpha": 1.5}}, "blend.alpha"),
        ({"blend": {"alpha": float("nan")}}, "blend.alpha"),
        ({"colour": 1}, "colour"),
        ({"output": {"quality": 0}}, "output.quality"),
        ({"warp": {"fill_bgr": (0, 0, 256)}}, "warp.fill_bgr"),
        ({"preset": "best"}, "best"),
        ({"thermal": {"window": (0.6, 0.3)}}, "--window"),
        ({"thermal": {"window": (0.1, 0.2, 0.3)}}, "thermal.window"),
        ({"warp": {"homography": "a", "points": "b"}}, "exclude"),
        ({"warp": {"homography": "a", "rig": "b"}}, "exclude"),
        ({"warp": {"points": "a", "rig": "b"}}, "exclude"),
        ({"warp": {"mode": "infinity"}}, "warp.mode means nothing without a rig"),
        ({"warp": {"undistort": True}}, "warp.undistort means nothing without a rig"),
        ({"warp": {"rig": "a", "mode": "distance"}}, "has no distance"),
        ({"warp": {"rig": "a", "mode": "depth", "distance_m": 2}}, "has no depth"),
        ({"warp": {"rig": "a", "mode": "infinity", "depth": "b"}}, "warp.depth means nothing"),
        ({"warp": {"rig": "a", "distance_m": -1}}, "warp.distance_m"),
    ],
)
def test_bad_settings_name_their_key(settings: dict[str, object], named: str) -> None:
    with pytest.raises(UsageError, match=named):
        BlendConfig.of(settings)


@pytest.mark.parametrize("text", ["", "format = 1", "format = ", 'format = "fusion-blend/2"', "\xff"])
def test_a_file_that_is_no_configuration_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(UsageError, match=r"bad\.toml"):
        load_config(path, {})


def test_effective_settings_are_settings_again() -> None:
    config = BlendConfig.of(preset="thesis", blend={"alpha": 0.5})
    assert BlendConfig.of(config.model_dump(exclude_none=True)) == config
