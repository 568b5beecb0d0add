"""The street of the large demo: solids against a float64 reference, points on surfaces, equal files for equal seeds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from clsplat.errors import InputError, OutputError
from clsplat.scenes.demo.capture import photograph, pixels, rays_through
from clsplat.scenes.demo.make import make_large_demo_scene
from clsplat.scenes.demo.rays import SUN
from clsplat.scenes.demo.solids import Solid, SolidGroup, box, gable_roof, post, round_solid
from clsplat.scenes.demo.street import DOME, DOME_RADIUS, GROUND, LOT, Street
from clsplat.scenes.demo.street_scene import street_cameras, write_street
from clsplat.scenes.scene import Scene, load_scene

TINT = (0.5, 0.5, 0.5)
SOLIDS = {
    "box": box("plain", (1.0, -1.0, 0.0), (3.0, 1.5, 2.0), TINT),
    "roof": gable_roof("roof", (1.0, -1.0, 1.0), (3.0, 1.5, 2.5), TINT),
    "post": post("plain", (2.0, 0.5, 0.0), 0.4, 2.0, TINT),
    "ball": round_solid("leaves", (2.0, 0.0, 1.0), 0.9, TINT),
}
SIZE = (32, 24)


def rays(count: int, seed: int = 0) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return rays from a shell around the solids towards their surroundings."""
    rng = np.random.default_rng(seed)
    origin = rng.normal(size=(count, 3))
    origin = np.array([2.0, 0.2, 1.0]) + 6 * origin / np.linalg.norm(origin, axis=1, keepdims=True)
    direction = np.array([2.0, 0.2, 1.0]) + rng.uniform(-1.6, 1.6, (count, 3)) - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return origin.astype(np.float32), direction.astype(np.float32)


def inside(name: str, p: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether points (..., 3) are in the solid of that name, from its description in plain words."""
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    if name == "ball":
        return (x - 2) ** 2 + y**2 + (z - 1) ** 2 < 0.81
    if name == "post":  # an octagon of inner radius 0.4
        turns = [np.cos(a) * (x - 2) + np.sin(a) * (y - 0.5) for a in np.pi / 4 * np.arange(8)]
        return (np.max(turns, axis=0) < 0.4) & (z > 0) & (z < 2)
    within = (x > 1) & (x < 3) & (y > -1) & (y < 1.5)
    if name == "box":
        return within & (z > 0) & (z < 2)
    return within & (z > 1) & (z < 2.5 - 1.5 * np.abs(y - 0.25) / 1.25)  # the ridge is 1.5 above the eaves


@pytest.mark.parametrize("name", SOLIDS)
def test_rays_hit_solids_where_they_enter(name: str) -> None:
    origin, direction = rays(400)
    solid = SOLIDS[name]
    distance = solid.distance(origin, direction)
    hit = np.isfinite(distance)
    assert 0.05 < hit.mean() < 0.95
    start, step = origin.astype(np.float64), direction.astype(np.float64)
    along = np.linspace(0, 14, 2801)
    within = inside(name, start[:, None] + along[None, :, None] * step[:, None])
    found = within.any(axis=1)
    grazing = within.sum(axis=1) < 4  # the samples may miss a corner
    assert (found == hit)[~grazing | found].all()
    assert (hit & ~found).mean() < 0.02
    both = found & hit
    np.testing.assert_allclose(distance[both], along[within[both].argmax(axis=1)], atol=0.006)
    at = origin[both] + distance[both, None] * direction[both]
    normal = solid.normal(at)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-5)
    assert (np.einsum("ij,ij->i", normal, direction[both]) < 1e-3).all(), "it points against the ray"
    assert not inside(name, at.astype(np.float64) + 1e-3 * normal).any()
    assert inside(name, at.astype(np.float64) - 1e-3 * normal).mean() > 0.97, "corners are thin"


def test_groups_find_the_nearest_of_all_solids() -> None:
    solids: list[Solid] = list(SOLIDS.values())
    far = [post("plain", (9.0, 3.0, 0.0), 0.2, 5.0, TINT), box("plain", (-4.0, 4.0, 0.0), (-3.0, 6.0, 3.0), TINT)]
    group = SolidGroup([SolidGroup(solids), SolidGroup(far)])
    rng = np.random.default_rng(2)
    origin = rng.uniform(-12, 12, (6000, 3)).astype(np.float32)
    middles = np.array([solid.centre for solid in (*solids, *far)])[rng.integers(6, size=len(origin))]
    direction = middles + rng.normal(size=origin.shape) - origin
    direction = (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
    limit = rng.uniform(3, 20, len(origin)).astype(np.float32)
    distance, number = group.hits(origin, direction, limit)
    every = np.array([solid.distance(origin, direction) for solid in (*solids, *far)])
    every = np.where(every < limit, every, np.inf)
    expected = np.where(np.isinf(every).all(axis=0), -1, every.argmin(axis=0))
    np.testing.assert_array_equal(number, expected)
    np.testing.assert_array_equal(distance, np.minimum(every.min(axis=0), limit))
    assert set(number) == {-1, 0, 1, 3, 4, 5}, "the post is inside the box"
    assert group.solids == [*solids, *far]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short street with few photos."""
    return write_street(tmp_path_factory.mktemp("street") / "s", *SIZE, n_views=18, n_points=600, lots=3)


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    return load_scene(folder)


def test_a_street_is_a_scene(folder: Path, scene: Scene) -> None:
    assert len(scene.views) == 18
    assert len(scene.points) == 600
    for camera, made in zip(scene.cameras, street_cameras(Street(3), *SIZE, 18), strict=True):
        np.testing.assert_allclose(camera.cam_from_world, made.cam_from_world, atol=1e-9)
        assert (camera.fx, camera.cx, camera.cy) == (made.fx, made.cx, made.cy)
    for number in (0, 7, 14):
        image = photograph(Street(3), scene.cameras[number])
        np.testing.assert_allclose(scene.images[number] / 255.0, image, atol=0.5 / 255 + 1e-6)
        assert image.std() > 0.1
    positions = np.array([camera.position for camera in scene.cameras])
    assert np.abs(positions[:, 0]).max() < 0.5 * 3 * LOT
    assert len(set(np.round(positions[:, 2], 3))) == 2


def test_points_are_on_surfaces_and_have_their_colours(scene: Scene) -> None:
    street = Street(3)
    xyz = scene.points.xyz
    on = np.min([np.abs(signed(solid, xyz)) for solid in street.houses.solids], axis=0) < 2e-3
    ground, dome = np.abs(xyz[:, 2]) < 1e-3, np.abs(np.linalg.norm(xyz, axis=1) - DOME_RADIUS) < 0.05
    assert (on | ground | dome).all()
    assert min(on.mean(), ground.mean(), dome.mean()) > 0.05
    assert scene.points.rgb.std(axis=0).min() > 20
    halves = scene.points.xyz[:300, 0], scene.points.xyz[300:, 0]
    assert abs(np.median(halves[0]) - np.median(halves[1])) < 6, "the order is random"


def signed(solid: Solid, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far points are outside of a solid, at least."""
    if not len(solid.planes):
        return np.linalg.norm(xyz - solid.centre, axis=1) - solid.radius
    outside: NDArray[np.float64] = (xyz @ solid.planes[:, :3].T - solid.planes[:, 3]).max(axis=1)
    return outside


def test_rays_end_at_the_ground_the_sky_or_a_house() -> None:
    street = Street(3)
    camera = street_cameras(street, 64, 48, 18)[2]
    origin, direction = rays_through(camera, pixels(camera) + 0.5)
    hits = street.cast(origin, direction)
    assert set(np.unique(hits.surface)) == {GROUND, DOME, 2}
    np.testing.assert_array_equal(hits.distance, street.nearest(origin, direction))
    np.testing.assert_allclose(hits.position, origin + hits.distance[:, None] * direction, atol=1e-4)
    assert hits.color.min() >= 0
    assert hits.color.max() <= 1


def test_houses_cast_shadows() -> None:
    """Two places of the same grass: one in the sun, one behind a house."""
    street = Street(1)
    wall = next(solid for solid in street.houses.solids if solid.kind == "wall" and solid.centre[1] > 0)
    behind = np.array([wall.centre[0], wall.planes[1, 3] + 0.7, 0.0])
    start = behind + np.array([[0.0, 0.0, 0.01], [40.0, 0.0, 0.01]])
    toward = np.tile(SUN, (2, 1)).astype(np.float32)
    assert wall.distance(start.astype(np.float32), toward)[0] < 50
    assert np.isinf(wall.distance(start.astype(np.float32), toward)[1])
    down = np.tile(np.array([0.0, 0.0, -1.0], np.float32), (2, 1))
    color = street.cast((start + np.array([0.0, 0.0, 0.05])).astype(np.float32), down).color
    assert color[0].mean() < 0.75 * color[1].mean()


def test_equal_seeds_give_equal_files(folder: Path, tmp_path: Path) -> None:
    again = write_street(tmp_path / "a", *SIZE, n_views=18, n_points=600, lots=3)
    other = write_street(tmp_path / "b", *SIZE, n_views=18, n_points=600, lots=3, seed=1)
    names = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    assert len(names) == 18 + 2
    assert all((folder / name).read_bytes() == (again / name).read_bytes() for name in names)
    assert (folder / "sparse_pc.ply").read_bytes() != (other / "sparse_pc.ply").read_bytes()


def test_a_large_demo_is_made_once_and_completely(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="at least 16x16 px, 12 views"):
        make_large_demo_scene(tmp_path / "few", 32, 11)
    made = make_large_demo_scene(tmp_path / "s", 32, 12)
    assert len(load_scene(made).points) == 40_000
    stamp = (made / "transforms.json").stat().st_mtime_ns
    assert make_large_demo_scene(made) == made
    assert (made / "transforms.json").stat().st_mtime_ns == stamp

    def stop(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("clsplat.scenes.demo.street_scene.write_transforms", stop)
    with pytest.raises(KeyboardInterrupt):
        make_large_demo_scene(tmp_path / "t", 32, 12)
    assert not (tmp_path / "t").exists()
    monkeypatch.undo()
    assert len(load_scene(make_large_demo_scene(tmp_path / "t", 32, 12)).views) == 12
    with pytest.raises(OutputError, match="not an empty folder"):
        write_street(tmp_path / "t")
