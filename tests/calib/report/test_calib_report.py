"""The report and the record: pictures show what they should, texts say what is so, nothing is believed
blindly."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.evidence.linear import with_held
from calib.evidence.verdict import Evidence, gather
from calib.report.page import page
from calib.report.pictures import (
    board_overlay,
    coverage_picture,
    residual_picture,
    to_bgr,
    uncertainty_picture,
)
from calib.report.record import known_covariance, rig_of, views_behind
from calib.report.text import closing_lines
from calib.scenes import Scene, scene
from calib.solve import Solution, solve
from fusion.codecs import decode_image
from fusion.geometry import pose
from fusion.rig import Rig, load_rig, save_rig


@pytest.fixture(scope="module")
def world() -> tuple[Scene, Solution, Evidence]:
    made = scene(0, 8)
    solution = solve(made.board, made.views, made.clouds, start=made.truth)
    return made, solution, gather(made.board, solution, closure=(0.0012, 0.0034))


World = tuple[Scene, Solution, Evidence]


def test_the_rig_comes_back_with_its_evidence(world: World, tmp_path: Path) -> None:
    made, solution, evidence = world
    picture = tmp_path / "a.png"
    picture.write_bytes(b"abc")
    save_rig(tmp_path / "rig.toml", rig_of(solution, evidence, made.board, [str(picture)]))
    again = load_rig(tmp_path / "rig.toml")
    for name, camera in solution.estimate.cameras.items():
        assert again.cameras[name] == camera
    assert np.allclose(again.pose("rgb", "lidar"), solution.estimate.T_ref_sensor["lidar"], atol=1e-12)
    names, covariance = known_covariance(again)
    assert names == solution.names
    assert np.array_equal(covariance, solution.covariance)
    assert again.evidence["inputs"][0]["sha256"].startswith("ba7816bf8f01cfea")  # of "abc", FIPS 180-2
    assert again.evidence["loop_closure"] == {"rotation_rad": 0.0012, "translation_m": 0.0034}
    assert views_behind(again, "rgb") == sum(v.camera == "rgb" for v in solution.views)
    assert views_behind(again, "lidar") == 0


def test_what_a_known_rig_says_of_others_is_kept(world: World) -> None:
    made, solution, evidence = world
    other = {
        "uncertainty_px": {"radar_to_rgb": {"5_m": 2.5}},
        "covariance": {"names": ["T_rgb_radar.tx"], "matrix": [[1e-4]]},
    }
    known = Rig({}, {"T_rgb_radar": pose(translation_m=(1, 2, 3)), "T_fir_lidar": np.eye(4)}, {}, other)
    rig = rig_of(solution, evidence, made.board, [], known=known)
    assert np.allclose(rig.transforms["T_rgb_radar"][:3, 3], (1, 2, 3))
    assert "T_fir_lidar" not in rig.transforms  # both were solved for now: the old word would contradict
    assert rig.evidence["uncertainty_px"]["radar_to_rgb"] == {"5_m": 2.5}
    assert "lidar_to_rgb" in rig.evidence["uncertainty_px"]
    names, covariance = known_covariance(rig)
    assert covariance[names.index("T_rgb_radar.tx"), names.index("T_rgb_radar.tx")] == 1e-4


@pytest.mark.parametrize(
    "table",
    [
        {},
        {"covariance": 3},
        {"covariance": {"names": ["a"], "matrix": [[1, 2]]}},
        {"covariance": {"names": ["a", 3], "matrix": [[1, 0], [0, 1]]}},
        {"covariance": {"names": ["a"], "matrix": [[float("nan")]]}},
        {"covariance": {"names": ["a", "b"], "matrix": [[1], [2, 3]]}},
    ],
)
def test_a_covariance_that_makes_no_sense_is_none(table: dict[str, object]) -> None:
    names, matrix = known_covariance(Rig(evidence=table))
    assert names == ()
    assert matrix.shape == (0, 0)


def test_held_parameters_count_as_uncertain_as_they_were(world: World) -> None:
    made, solution, _ = world
    held = solve(made.board, made.views, start=made.truth, fixed=("rgb",))
    judged = with_held(held, solution.names, solution.covariance)
    assert judged.names[: len(held.names)] == held.names
    added = set(judged.names) - set(held.names)
    assert added == {name for name in solution.names if name.startswith("rgb.")}
    one, other = judged.names.index("rgb.fx"), solution.names.index("rgb.fx")
    assert judged.covariance[one, one] == solution.covariance[other, other]
    assert not judged.covariance[: len(held.names), len(held.names) :].any()
    assert with_held(held, (), np.zeros((0, 0))) is held


def test_text_says_the_figures(world: World) -> None:
    _, solution, evidence = world
    text = "\n".join(closing_lines(solution, evidence))
    assert f"{solution.rms_px('rgb'):.3f}" in text
    assert "verdict: good" in text
    assert re.search(r"loop of three +1\.20 +3\.4", text)
    lost = replace(solution, dropped_views=(("rgb/007.png", "blurred"),))
    assert "left out: rgb/007.png: blurred" in closing_lines(lost, evidence)


def test_the_page_is_whole_and_escapes_names(world: World) -> None:
    _, solution, evidence = world
    picture = residual_picture(solution, "rgb")
    html = page("<b>rig</b>.toml", solution, evidence, [("a & b", picture)], [("<script>", "none")]).decode()
    assert "<script>" not in html
    assert "&lt;b&gt;rig&lt;/b&gt;.toml" in html
    assert "a &amp; b" in html
    assert html.count("data:image/png;base64,") == 1
    assert "http" not in html  # nothing is fetched
    assert all(name in html for name in solution.names)


def test_pictures_can_be_seen(world: World) -> None:
    _, solution, evidence = world
    pictures = [
        residual_picture(solution, "fir"),
        coverage_picture(solution, evidence.coverage["rgb"]),
        uncertainty_picture(evidence.projection["rgb"], solution, "rgb"),
        uncertainty_picture(evidence.transfer["rgb", "fir"][50.0], solution, "fir"),
        uncertainty_picture(evidence.transfer["rgb", "lidar"][1.0], solution, "rgb"),
    ]
    for data in pictures:
        image = decode_image(data, "picture")
        assert image.shape[1] > 400
        assert len(np.unique(image.reshape(-1, image.shape[-1]), axis=0)) > 20
    assert pictures[0] == residual_picture(solution, "fir")  # the same bytes every time


def test_thermal_edges_fall_on_rgb_edges(world: World) -> None:
    """Both cameras draw the same board; carried over its plane, the thermal one's edges lie on the
    other's."""
    made, solution, _ = world
    moment = next(iter(solution.estimate.T_ref_board))
    drawn = {camera: _drawn(made, solution, camera, moment) for camera in ("rgb", "fir")}
    shown = board_overlay(solution, moment, ("rgb", drawn["rgb"]), ("fir", drawn["fir"]))
    red = (shown == (60, 60, 255)).all(-1)
    edges = cv2.Canny(drawn["rgb"], 40, 110)
    away = cv2.distanceTransform((255 - edges).astype(np.uint8), cv2.DIST_L2, 5)
    assert red.sum() > 200
    assert np.percentile(away[red], 90) < 2.5
    wrong = replace(solution.estimate, T_ref_sensor={**solution.estimate.T_ref_sensor, "fir": np.eye(4)})
    apart = board_overlay(
        replace(solution, estimate=wrong), moment, ("rgb", drawn["rgb"]), ("fir", drawn["fir"])
    )
    assert np.percentile(away[(apart == (60, 60, 255)).all(-1)], 90) > 5


def _drawn(made: Scene, solution: Solution, camera: str, moment: str) -> np.ndarray:
    """The plate as a bright polygon."""
    from calib.evidence.linear import board_pose
    from fusion.geometry import transform

    lens = solution.estimate.cameras[camera]
    x0, y0, x1, y1 = made.board.plate_m or (0, 0, 1, 1)
    ends = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], float)
    t = np.linspace(0, 1, 40)[:, None]
    rim = np.concatenate([a + t * (b - a) for a, b in zip(ends, np.roll(ends, -1, 0), strict=True)])
    T = board_pose(solution.estimate, moment, camera)
    uv = lens.project(transform(T, np.c_[rim, np.zeros(len(rim))]))[0]
    image = np.full((lens.size_wh[1], lens.size_wh[0]), 40, np.uint8)
    return cv2.fillPoly(image, [np.rint(16 * uv).astype(np.int32)], 220, cv2.LINE_AA, 4)


def test_sixteen_bits_are_stretched() -> None:
    counts = np.linspace(7000, 7400, 100, dtype=np.uint16).reshape(10, 10)
    bgr = to_bgr(counts)
    assert bgr.shape == (10, 10, 3)
    assert bgr.min() == 0
    assert bgr.max() == 255
