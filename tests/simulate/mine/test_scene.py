"""The mine is closed, open where it should be, the same twice, and rays find what is there."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion.simulate.mine.course import Course, Plan
from fusion.simulate.mine.meshes import Mesh, box, capsule, ellipsoid, join, rod, stone
from fusion.simulate.mine.nets import surface
from fusion.simulate.mine.scene import MineScene, build_scene, free_radius
from fusion.simulate.mine.scene_config import SceneConfig

COARSE = SceneConfig(cell_m=0.3, length_m=60)
PERSON = {"skin", "overall", "vest", "tape", "helmet", "boot", "lamp"}


@pytest.fixture(scope="module")
def scene() -> MineScene:
    return build_scene(COARSE, 7)


@pytest.fixture(scope="module")
def plain() -> MineScene:
    """Without guests and without a side drift, of another seed."""
    return build_scene(COARSE.model_copy(update={"person": False, "machine": False, "side_drift": False}), 8)


def volume(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def open_edges(mesh: Mesh) -> int:
    """How many directed edges lack their opposite: 0 if the mesh encloses space."""
    edges = np.vstack([mesh.triangles[:, [0, 1]], mesh.triangles[:, [1, 2]], mesh.triangles[:, [2, 0]]])
    balance: dict[tuple[int, int], int] = {}
    for a, b in edges.tolist():
        key, sign = ((a, b), 1) if a < b else ((b, a), -1)
        balance[key] = balance.get(key, 0) + sign
    return sum(value != 0 for value in balance.values())


def anywhere(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    way = rng.standard_normal((n, 3))
    return way / np.linalg.norm(way, axis=1, keepdims=True)


def rays_of(points: NDArray[np.float64], ways: NDArray[np.float64]) -> NDArray[np.float32]:
    points, ways = np.broadcast_arrays(points, ways)
    return np.hstack([points, ways]).astype(np.float32)


def brute_force(mesh: Mesh, ray: NDArray[np.float32]) -> tuple[float, int]:
    """Range and triangle of one ray against all triangles (Möller and Trumbore), float64."""
    origin, way = ray[:3].astype(np.float64), ray[3:].astype(np.float64)
    a, b, c = (mesh.vertices.astype(np.float32).astype(np.float64)[mesh.triangles[:, k]] for k in range(3))
    e, f = b - a, c - a
    p = np.cross(way, f)
    scale = np.einsum("ij,ij->i", e, p)
    inverse = np.divide(1.0, scale, out=np.zeros_like(scale), where=np.abs(scale) > 1e-14)
    u = np.einsum("ij,ij->i", origin - a, p) * inverse
    q = np.cross(origin - a, e)
    v, t = q @ way * inverse, np.einsum("ij,ij->i", f, q) * inverse
    found = (inverse != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    t = np.where(found, t, np.inf)
    return float(t.min()), int(t.argmin())


def test_no_ray_escapes(scene: MineScene) -> None:
    rng = np.random.default_rng(0)
    for point in scene.centre_line[:: len(scene.centre_line) // 8]:
        hits = scene.cast(rays_of(point, anywhere(rng, 12_500)))
        assert np.isfinite(hits.range_m).all()
        assert hits.range_m.min() > 0


def test_rock_is_closed_and_faces_the_air(scene: MineScene) -> None:
    names = [scene.materials[k].name for k in scene.triangle_materials]
    n = next(k for k, name in enumerate(names) if name not in ("rock", "floor", "muck"))  # rock comes first
    rock = Mesh(scene.mesh.vertices, scene.mesh.triangles[:n])
    assert open_edges(rock) == 0
    drawn = (60 + 13) * (4.6 * 2.0 + np.pi / 4 * 4.6 * 2.0)
    assert 0.9 * drawn < -volume(rock) < 1.4 * drawn  # air is enclosed from outside, and more than was drawn
    worn = np.array([name != "rock" for name in names[:n]])
    assert worn.any()
    assert (rock.normals()[worn][:, 2] > 0.3).all()


def test_smooth_drift_has_the_drawn_section() -> None:
    smooth = COARSE.model_copy(update={"roughness": 0.0})
    scene = build_scene(smooth, 7)
    at = scene.centre_line[30]
    right = scene.cast(rays_of(at, np.array([[0, -1.0, 0]]))).range_m[0]
    up = scene.cast(rays_of(at - (0, 0.8, 0), np.array([[0, 0, 1.0]]))).range_m[0]
    assert right == pytest.approx(2.3, abs=0.08)
    assert up == pytest.approx(2.0 + 2.0 * np.sqrt(1 - (0.8 / 2.3) ** 2) - 1.5, abs=0.08)


def test_rays_agree_with_brute_force(scene: MineScene) -> None:
    rng = np.random.default_rng(1)
    rays = rays_of(scene.centre_line[rng.integers(0, len(scene.centre_line), 25)], anywhere(rng, 25))
    hits = scene.cast(rays)
    normals = scene.mesh.normals()
    for k, ray in enumerate(rays):
        range_m, triangle = brute_force(scene.mesh, ray)
        normal = normals[triangle] * -np.sign(normals[triangle] @ ray[3:])
        assert hits.range_m[k] == pytest.approx(range_m, rel=1e-4)
        assert hits.material[k] == scene.triangle_materials[triangle]
        np.testing.assert_allclose(hits.normal[k], normal, atol=1e-4)


def test_hits_keep_their_promises(scene: MineScene) -> None:
    rays = rays_of(scene.centre_line[10], anywhere(np.random.default_rng(2), 5000))
    hits = scene.cast(rays, nthreads=1)
    assert [a.dtype for a in (hits.range_m, hits.normal, hits.material, hits.printed)] == [
        "f4",
        "f4",
        "u1",
        "f4",
    ]
    np.testing.assert_allclose(np.linalg.norm(hits.normal, axis=1), 1, atol=1e-5)
    assert (np.einsum("ij,ij->i", hits.normal, rays[:, 3:]) <= 0).all()
    assert hits.material.max() < len(scene.materials)
    assert np.isnan(hits.printed).all()


def test_a_ray_that_meets_nothing_says_so(scene: MineScene) -> None:
    hits = scene.cast(np.array([[0, 0, 100, 0, 0, 1]], np.float32))
    assert np.isinf(hits.range_m[0])
    np.testing.assert_array_equal(hits.normal[0], (0, 0, -1))


def test_rays_of_a_wrong_shape_are_refused(scene: MineScene) -> None:
    with pytest.raises(ValueError, match="N x 6"):
        scene.cast(np.zeros((4, 3), np.float32))
    assert len(scene.cast(np.zeros((0, 6), np.float32)).range_m) == 0


@pytest.mark.parametrize(
    "name", ["person", "machine", "pipe", "duct", "cables", "timber", "muck pile", "arches", "bolts"]
)
def test_every_object_can_be_seen_from_the_flight(scene: MineScene, name: str) -> None:
    target = np.array(scene.objects[name].centre)
    eye = scene.centre_line[np.linalg.norm(scene.centre_line - target, axis=1).argmin()]
    around = target if name in ("person", "machine") else None
    hits = scene.cast(rays_of(eye, anywhere(np.random.default_rng(3), 60_000)))
    seen = {scene.materials[k].name for k in np.unique(hits.material)}
    known = {"person": {"vest", "overall"}, "machine": {"hood", "paint", "tyre"}, "cables": {"cable"}}
    known |= {"muck pile": {"muck", "rock"}, "arches": {"steel"}, "bolts": {"plate"}}
    assert known.get(name, {name}) & seen
    if around is not None:
        way = (around - eye) / np.linalg.norm(around - eye)
        there = eye + way * scene.cast(rays_of(eye, way[None])).range_m[0]
        low, high = np.array(scene.objects[name].low) - 0.01, np.array(scene.objects[name].high) + 0.01
        assert ((low <= there) & (there <= high)).all()


@pytest.mark.parametrize(("name", "left", "z"), [("pipe", 1.0, 1.3), ("duct", 0.0, 2.2)])
def test_pipe_and_duct_run_in_the_open(scene: MineScene, name: str, left: float, z: float) -> None:
    """From beside it, nearly every station of it is seen: it is neither buried in rock nor cut."""
    eyes = Plan.of(COARSE).main.at(np.arange(4.0, 52.0, 0.5), left, z)
    ways = anywhere(np.random.default_rng(8), 1500)
    hits = scene.cast(rays_of(np.repeat(eyes, 1500, 0), np.tile(ways, (len(eyes), 1))))
    mine = {k for k, material in enumerate(scene.materials) if material.name in (name, "flange")}
    seen = (np.isin(hits.material, list(mine)) & (hits.range_m < 1.5)).reshape(len(eyes), 1500).sum(1)
    assert np.mean(seen >= 2) > 0.9


def test_person_and_machine_can_be_left_out(scene: MineScene, plain: MineScene) -> None:
    assert {"person", "machine"} <= set(scene.objects)
    assert not {"person", "machine"} & set(plain.objects)
    names = {plain.materials[k].name for k in np.unique(plain.triangle_materials)}
    assert not (PERSON - {"lamp"}) & names


def test_side_drift_opens_in_the_wall(scene: MineScene, plain: MineScene) -> None:
    plan = Plan.of(COARSE)
    assert plan.side is not None
    eye = plan.main.at(plan.junction_s, 0.0, 1.6)
    into = plan.side.at(7.0, 0.0, 1.6) - eye
    way = into / np.linalg.norm(into)
    assert scene.cast(rays_of(eye, way)).range_m[0] > 5.0
    assert plain.cast(rays_of(eye, way)).range_m[0] < 4.5


def test_free_radius_is_the_nearest_surface(scene: MineScene) -> None:
    k = len(scene.centre_line) // 3
    hits = scene.cast(rays_of(scene.centre_line[k], anywhere(np.random.default_rng(4), 50_000)))
    assert scene.free_radius[k] == pytest.approx(hits.range_m.min(), abs=0.08)
    assert scene.free_radius.min() > 0.8
    np.testing.assert_allclose(
        free_radius(scene.caster, scene.centre_line[k : k + 1])[0], scene.free_radius[k]
    )


def test_lamps_hang_free_below_the_roof(scene: MineScene) -> None:
    assert len(scene.lamps) == len(scene.lamp_bgr) > 0
    assert (scene.lamp_bgr > 0).all()
    down = scene.cast(rays_of(scene.lamps, np.array([[0, 0, -1.0]]))).range_m
    up = scene.cast(rays_of(scene.lamps, np.array([[0, 0, 1.0]])))
    assert (down > 1.5).all()
    assert (up.range_m < 0.15).all()
    assert {scene.materials[k].name for k in up.material} == {"lamp"}


def test_rock_pipe_person_and_machine_stand_apart_in_thermal(scene: MineScene) -> None:
    degC = {material.name: material.temperature_degC for material in scene.materials}
    levels = [degC[name] for name in ("water", "rock", "overall", "skin", "pipe", "radiator", "exhaust")]
    assert all(b - a > 2 for a, b in pairwise(levels))
    assert all(0 <= m.lidar_reflectance <= 1 and 0 < m.emissivity <= 1 for m in scene.materials)


def test_a_seed_gives_the_same_bytes(scene: MineScene) -> None:
    again = build_scene(COARSE, 7)
    assert again.mesh.vertices.tobytes() == scene.mesh.vertices.tobytes()
    assert again.mesh.triangles.tobytes() == scene.mesh.triangles.tobytes()
    assert again.triangle_materials.tobytes() == scene.triangle_materials.tobytes()
    assert again.lamps.tobytes() == scene.lamps.tobytes()
    assert again.centre_line.tobytes() == scene.centre_line.tobytes()


def test_another_seed_gives_another_mine_that_is_closed_too(scene: MineScene, plain: MineScene) -> None:
    rays = rays_of(scene.centre_line[4], anywhere(np.random.default_rng(5), 20_000))
    one, other = scene.cast(rays).range_m, plain.cast(rays).range_m
    assert np.isfinite(other).all()
    assert np.mean(np.abs(one - other) > 0.01) > 0.5


def test_surface_of_a_ball() -> None:
    x = np.arange(-1.5, 1.5001, 0.1)
    gx, gy, gz = np.meshgrid(x, x, x, indexing="ij")
    field = (np.sqrt(gx**2 + gy**2 + gz**2) - 1).astype(np.float32)
    mesh = surface(field, (-1.5, -1.5, -1.5), 0.1)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 1, atol=0.01)
    assert open_edges(mesh) == 0
    assert volume(mesh) == pytest.approx(-4 / 3 * np.pi, rel=0.02)  # air inside: normals look in
    with pytest.raises(ValueError, match="outer faces"):
        surface(field[8:], (-0.7, -1.5, -1.5), 0.1)


def test_shapes_are_closed_and_have_their_volume() -> None:
    known = [
        (box((0, 0, 0), (1, 2, 3)), 6.0, 1e-9),
        (rod((0, 0, 0), (0, 3, 0), 0.5, sides=64), 3 * np.pi / 4, 0.01),
        (ellipsoid((1, 2, 3), (0.3, 0.5, 0.7), 48), 4 / 3 * np.pi * 0.3 * 0.5 * 0.7, 0.02),
        (capsule((0, 0, 0), (0, 0, 1), 0.2, 0.2, 48), np.pi * 0.04 + 4 / 3 * np.pi * 0.008, 0.03),
    ]
    for mesh, expected, tolerance in known:
        assert open_edges(mesh) == 0
        assert volume(mesh) == pytest.approx(expected, rel=tolerance)
    both = join([known[0][0], known[1][0]])
    assert volume(both) == pytest.approx(volume(known[0][0]) + volume(known[1][0]))


def test_stones_are_convex_blocks() -> None:
    for seed in range(10):
        block = stone(np.random.default_rng(seed))
        assert open_edges(block) == 0
        corner = block.vertices[block.triangles[:, 0]]
        side = np.einsum("ijk,ik->ij", block.vertices[None] - corner[:, None], block.normals())
        assert side.max() < 1e-9
        assert volume(block) > 0.02


def test_course_goes_there_and_back() -> None:
    course = Course.of(np.array([1.0, 2.0]), 0.3, [(10.0, 0.0), (5.0, 0.6), (10.0, 0.0)])
    assert course.length_m == pytest.approx(25.0)
    rng = np.random.default_rng(6)
    s, left = rng.uniform(0, 25, 300), rng.uniform(-2, 2, 300)
    again_s, again_left = course.local(course.at(s, left)[:, :2])
    np.testing.assert_allclose(again_s, s, atol=0.01)
    np.testing.assert_allclose(again_left, left, atol=0.01)
