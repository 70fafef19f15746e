"""The truth that is read back is true: against numpy twins of the geometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_worlds import Line, Room, small

from fusion.errors import FusionError, InputError, UsageError
from fusion.geometry import Floats, invert, transform
from fusion.simulate.mine.motion import mounted
from fusion.simulate.mine.recording import World, make_mine
from fusion.simulate.mine.truth import Truth

PATH = Line((2.0, 0.3, 0.1), turn=0.5)
SCREEN = Room(screen=5.0)
BENT = (-0.19, 0.035, 2e-3, -3e-3, 0.02)  # every coefficient counts


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("mine") / "recording"
    settings = {
        "rgb": {"camera": {"size_wh": (160, 120), "distortion": BENT}, "rate_hz": 5},
        "duration_s": 0.6,
    }
    make_mine(out, small(settings), world=World(SCREEN, PATH))
    return out


@pytest.fixture(scope="module")
def truth(recording: Path) -> Truth:
    return Truth(recording)


def grid(w: int, h: int) -> Floats:
    return np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).reshape(-1, 2).astype(float)


def test_poses_are_the_sensors(truth: Truth) -> None:
    config = truth.config
    mounts = {"rgb": config.rgb.mount, "fir": config.thermal.mount, "lidar": config.lidar.mount}
    T_body = {name: mounted(mount, name != "lidar") for name, mount in mounts.items()}
    for sensor in T_body:
        for stamp in truth.stamps(sensor):
            T_world_body = PATH.pose_at(truth.true_s(sensor, stamp))
            np.testing.assert_allclose(truth.pose(sensor, stamp), T_world_body @ T_body[sensor], atol=1e-9)
        np.testing.assert_allclose(T_body["rgb"] @ truth.rig.pose("rgb", sensor), T_body[sensor], atol=1e-9)
    a, b, c = (_mount(truth, name)[:3, 3] for name in ("rgb", "fir", "lidar"))
    for one, other in ((a, b), (a, c), (b, c)):
        assert 0.05 < np.linalg.norm(one - other) < 0.15


def _mount(truth: Truth, sensor: str) -> Floats:
    """T_body_sensor, from the first pose."""
    stamp = truth.stamps(sensor)[0]
    return invert(PATH.pose_at(truth.true_s(sensor, stamp))) @ truth.pose(sensor, stamp)


def test_depth_points_lie_on_the_walls(truth: Truth) -> None:
    for camera in ("rgb", "fir"):
        stamp = truth.stamps(camera)[-1]
        depth = truth.depth_m(camera, stamp)
        model = truth.rig.camera(camera)
        way = model.unproject(grid(*model.size_wh))
        world = transform(truth.pose(camera, stamp), way / way[:, 2:] * depth.reshape(-1, 1).astype(float))
        walls = np.minimum(np.abs(world - SCREEN.low), np.abs(world - SCREEN.high)).min(1)
        screen = np.where(world[:, 1] > -0.02, np.abs(world[:, 0] - 5.0), np.inf)
        assert np.minimum(walls, screen).max() < 0.01
        assert (screen < 0.01).mean() > 0.1


def test_flow_is_where_points_go(truth: Truth) -> None:
    """Twin: the analytic point on the wall, carried to the next pose, projected by the camera model."""
    this, following = truth.stamps("rgb")[:2]
    camera, flow = truth.rig.camera("rgb"), truth.flow(truth.stamps("rgb")[0])
    w, h = camera.size_wh
    uv, T = grid(w, h), truth.pose("rgb", this)
    way = camera.unproject(uv)
    rays = np.hstack([np.broadcast_to(T[:3, 3], way.shape), way @ T[:3, :3].T])
    ends = rays[:, :3] + _range(rays)[:, None] * rays[:, 3:]
    there, seen = camera.project(transform(invert(truth.pose("rgb", following)), ends))
    valid = flow.valid.ravel()
    assert valid[seen & (np.abs(there - uv).max(1) < 500)].all()
    error = np.abs(flow.uv_px.reshape(-1, 2) - (there - uv))[valid]
    assert error.max() <= 1 / 64
    assert np.abs(there - uv)[valid].max() > 3
    outside = ((there < -0.5) | (there >= np.array([w, h]) - 0.5)).any(1) & seen
    assert flow.occluded.ravel()[outside & valid].all()


def _range(rays: Floats) -> Floats:
    """Independent of the room's own: all planes of the room and the screen, the nearest in front."""
    best = np.full(len(rays), np.inf)
    for axis in range(3):
        for value in (SCREEN.low[axis], SCREEN.high[axis], 5.0 if axis == 0 else np.nan):
            t = (value - rays[:, axis]) / rays[:, 3 + axis]
            end = rays[:, :3] + t[:, None] * rays[:, 3:]
            inside = ((end > SCREEN.low - 1e-9) & (end < SCREEN.high + 1e-9)).all(1)
            inside &= (value != 5.0) | (end[:, 1] > 0)
            best = np.where(inside & (t > 0) & (t < best), t, best)
    return best


def test_occlusion_by_the_screen(truth: Truth) -> None:
    """Exactly: a point is hidden where the segment from the next camera to it passes the screen."""
    this, following = truth.stamps("rgb")[:2]
    camera, flow = truth.rig.camera("rgb"), truth.flow(this)
    uv, T, T_next = grid(*camera.size_wh), truth.pose("rgb", this), truth.pose("rgb", following)
    way = camera.unproject(uv) @ T[:3, :3].T
    rays = np.hstack([np.broadcast_to(T[:3, 3], way.shape), way])
    ends = rays[:, :3] + _range(rays)[:, None] * way
    back = ends - T_next[:3, 3]
    far = np.linalg.norm(back, axis=1)
    blocked = (
        _range(np.hstack([np.broadcast_to(T_next[:3, 3], back.shape), back / far[:, None]])) < far - 0.01
    )
    there, seen = camera.project(transform(invert(T_next), ends))
    inside = seen & ((there >= 0) & (there <= np.array(camera.size_wh) - 1)).all(1)
    assert blocked[inside].sum() > 20
    wrong = inside & (flow.occluded.ravel() != blocked)
    assert wrong.sum() < 0.35 * blocked[inside].sum()
    # where they differ is the rim of the screen, less than two pixels wide
    edge = transform(
        invert(T_next), np.stack([np.full(200, 5.0), np.zeros(200), np.linspace(-2, 2, 200)], -1)
    )
    rim, _ = camera.project(edge)
    away = np.abs(there[wrong][:, None] - rim[None]).max(2).min(1)
    assert away.size == 0 or away.max() < 2


def test_last_frame_has_no_flow(truth: Truth) -> None:
    with pytest.raises(InputError, match="last"):
        truth.flow(truth.stamps("rgb")[-1])


def test_temperatures_are_the_materials(truth: Truth) -> None:
    degC = truth.temperature_degC(truth.stamps("fir")[0])
    assert set(np.round(np.unique(degC[np.isfinite(degC)]), 1)) <= {12.0, 40.0}


def test_scan_fits_the_depth_of_the_camera(truth: Truth, recording: Path) -> None:
    """T_rgb_lidar, clocks, poses and depth agree: scan points fall on the depth image of the same moment."""
    from fusion.clouds import read_cloud

    stamp = truth.stamps("lidar")[0]
    cloud = read_cloud(recording / f"lidar/{stamp}.pcd")
    rgb = min(truth.stamps("rgb"), key=lambda s: abs(truth.true_s("rgb", s) - truth.true_s("lidar", stamp)))
    after = truth.true_s("lidar", stamp) + cloud.fields["time_s"].astype(float)
    T = PATH.pose_at(after) @ _mount(truth, "lidar")
    world = np.einsum("nij,nj->ni", T[:, :3, :3], cloud.xyz_m.astype(float)) + T[:, :3, 3]
    xyz = transform(invert(truth.pose("rgb", rgb)), world)
    camera = truth.rig.camera("rgb")
    uv, seen = camera.project(xyz)
    w, h = camera.size_wh
    seen &= ((uv >= 0) & (uv <= (w - 1, h - 1))).all(1)
    c, r = np.rint(uv[seen]).astype(int).T
    off = np.abs(truth.depth_m("rgb", rgb)[r, c] - xyz[seen, 2])
    assert seen.sum() > 50
    assert np.median(off) < 0.05


# --- what is wrong is said in one line


def said(call) -> str:
    with pytest.raises(FusionError) as caught:
        call()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_errors_are_clear(truth: Truth, tmp_path: Path) -> None:
    assert "truth/" in said(lambda: Truth(tmp_path))
    assert "nearest" in said(lambda: truth.depth_m("rgb", 5))
    assert "rgb, fir" in said(lambda: truth.depth_m("lidar", 5))
    assert "lidar" in said(lambda: truth.stamps("radar"))
    assert issubclass(UsageError, FusionError)


@pytest.mark.parametrize(
    ("name", "content", "use"),
    [
        ("clocks.toml", "format = 3", lambda t: t.clocks),
        ("clocks.toml", 'format = "fusion-mine-clocks/1"\nrgb = 3', lambda t: t.clocks),
        ("poses_rgb.tum", "1 2 3", lambda t: t.stamps("rgb")),
        ("poses_rgb.tum", "1 2 3 4 5 6 7 x", lambda t: t.stamps("rgb")),
        ("freezes.csv", "stamp_ns\n3", lambda t: t.freezes),
        ("mine.toml", "[", lambda t: t.config),
        ("rig.toml", "", lambda t: t.rig),
    ],
)
def test_damaged_files_are_named(recording: Path, tmp_path: Path, name: str, content: str, use) -> None:
    (tmp_path / "truth").mkdir()
    for other in ("clocks.toml", "poses_rgb.tum"):
        (tmp_path / "truth" / other).write_bytes((recording / "truth" / other).read_bytes())
    (tmp_path / "truth" / name).write_text(content)
    assert name in said(lambda: use(Truth(tmp_path)))
    (tmp_path / "truth" / name).unlink()
    assert name in said(lambda: use(Truth(tmp_path)))


def test_damaged_picture_is_named(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "truth" / "depth_rgb").mkdir(parents=True)
    for other in ("clocks.toml", "poses_rgb.tum"):
        (tmp_path / "truth" / other).write_bytes((recording / "truth" / other).read_bytes())
    truth = Truth(tmp_path)
    stamp = truth.stamps("rgb")[0]
    assert "depth_rgb" in said(lambda: truth.depth_m("rgb", stamp))
    (tmp_path / "truth" / "depth_rgb" / f"{stamp}.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    assert "depth_rgb" in said(lambda: truth.depth_m("rgb", stamp))
