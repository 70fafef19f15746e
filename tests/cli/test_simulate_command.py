"""`fusion simulate mine` and `session` as a user meets them: small, but through the whole command."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from fusion.simulate.mine.truth import Truth
from tests.cli.conftest import Answer
from tests.worlds import tree

Fusion = Callable[..., Answer]

SMALL = """\
format = "fusion-mine/1"
duration_s = 0.25
[scene]
cell_m = 0.3
[rgb]
rate_hz = 10
[rgb.camera]
size_wh = [64, 48]
fov_deg = 84
distortion = [-0.05, 0.005, 0.0, 0.0, 0.0]
[thermal]
rate_hz = 10
[thermal.camera]
size_wh = [64, 52]
fov_deg = 68
distortion = [-0.05, 0.005, 0.0, 0.0, 0.0]
[lidar]
columns = 64
"""


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(SMALL, encoding="utf-8")
    return path


def test_mine_writes_what_its_page_says(fusion: Fusion, small: Path, tmp_path: Path) -> None:
    answer = fusion("simulate", "mine", tmp_path / "mine", "--config", small, "--rings", 16, "--seed", 4)
    assert answer.code == 0, answer.err
    assert "2 RGB and" in answer.out
    names = tree(tmp_path / "mine")
    kinds = {name.rsplit("/", 1)[0] for name in names if not name.endswith((".toml", ".tum", ".csv"))}
    assert kinds == {"rgb", "fir", "lidar"} | {
        f"truth/{kind}" for kind in ("depth_rgb", "depth_fir", "flow_rgb", "occluded_rgb", "temperature_fir")
    }
    truth = Truth(tmp_path / "mine")
    assert (truth.config.seed, truth.config.lidar.rings) == (4, 16)
    assert {f"rgb/{stamp}.jpg" for stamp in truth.stamps("rgb")} == {n for n in names if n[:4] == "rgb/"}
    blended = fusion(
        *("blend", tmp_path / "mine/rgb", tmp_path / "mine/fir", "-o", tmp_path / "fused", "--pair", "stamp"),
        *("--homography", tmp_path / "mine/truth/homography_5m.toml", "--quiet"),
    )
    assert blended.code == 0, blended.err
    depth = fusion(
        *("depth", tmp_path / "mine/lidar", "-o", tmp_path / "depth", "--quiet"),
        *("--rig", tmp_path / "mine/truth/rig.toml", "--overlay", tmp_path / "mine/rgb"),
    )
    assert depth.code == 0, depth.err
    assert {name.split("/")[0] for name in tree(tmp_path / "depth")} >= {"depth", "picture", "overlay"}


def test_session_shows_the_board_as_often_as_asked(fusion: Fusion, small: Path, tmp_path: Path) -> None:
    answer = fusion(
        *("simulate", "session", tmp_path / "board", "--config", small, "--board", "circles", "--poses", 2)
    )
    assert answer.code == 0, answer.err
    assert "2 poses of a circles" in answer.out
    rows = (tmp_path / "board/truth/corners_rgb.csv").read_text().splitlines()
    assert len(rows) == 1 + 2 * 44  # 4 x 11 circles, twice


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--preset", "foggy"), "preset"),
        (("--duration", "0"), "duration_s"),
        (("--speed", "-1"), "speed_m_s"),
        (("--config", "missing.toml"), "missing.toml"),
        (("--workers", "0"), "--workers"),
    ],
)
def test_bad_options_are_one_line_and_write_nothing(
    fusion: Fusion, tmp_path: Path, words: tuple[str, ...], said: str
) -> None:
    answer = fusion("simulate", "mine", tmp_path / "mine", *words)
    assert answer.code in (1, 2)
    assert said in answer.err
    assert len(answer.err.strip().splitlines()) == 1
    assert not (tmp_path / "mine").exists()


def test_a_folder_in_use_is_refused(fusion: Fusion, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    answer = fusion("simulate", "mine", tmp_path)
    assert answer.code == 1
    assert "not empty" in answer.err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_ctrl_c_does_not_promise_to_go_on(
    fusion: Fusion, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("fusion.simulate.mine.recording.make_mine", stopped)
    answer = fusion("simulate", "mine", tmp_path / "mine", "--quiet")
    assert answer.code == 130
    assert "starts afresh" in answer.err
    assert "goes on" not in answer.err
