"""The size of a scene is that of 3DGS for cameras around an object, and follows what the cameras see for others."""

from __future__ import annotations

import numpy as np
import pytest

from clsplat.cameras.camera import Camera
from clsplat.cameras.orbits import look_at
from clsplat.scenes.extent import extent_of
from clsplat.splats.fields import DoubleArray

UP = np.array([0.0, 0.0, 1.0])
NOTHING = np.zeros((0, 3))


def camera(position: DoubleArray, target: DoubleArray, focal: float = 100.0) -> Camera:
    return Camera(160, 120, focal, focal, 80.0, 60.0, look_at(position, target, UP)[:3])


def ring(radius: float, focal: float = 100.0, n: int = 24) -> list[Camera]:
    """Return cameras on a circle that look at its centre."""
    angles = np.arange(n) * 2 * np.pi / n
    places = radius * np.stack([np.cos(angles), np.sin(angles), np.full(n, 0.2)], axis=1)
    return [camera(place, np.zeros(3), focal) for place in places]


def cloud(size: float = 1.0, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> DoubleArray:
    return np.random.default_rng(0).uniform(-size, size, (500, 3)) + centre


def published(cameras: list[Camera]) -> float:
    """Return the extent of 3DGS."""
    centres = np.array([one.position for one in cameras])
    return float(1.1 * np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())


@pytest.mark.parametrize("xyz", [cloud(), cloud(3.0), NOTHING], ids=["object", "room", "no points"])
def test_cameras_around_an_object_have_the_published_extent(xyz: DoubleArray) -> None:
    assert extent_of(ring(4.0), xyz) == published(ring(4.0))


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e4])
@pytest.mark.parametrize("xyz", [cloud(), NOTHING], ids=["points", "no points"])
def test_it_is_in_proportion_to_the_units(unit: float, xyz: DoubleArray) -> None:
    wrong = [*ring(4.0), camera(np.array([300.0, 0.0, 0.0]), np.zeros(3))]
    moved = [*ring(unit * 4.0), camera(np.array([unit * 300.0, 0.0, 0.0]), np.zeros(3))]
    assert extent_of(moved, unit * xyz) == pytest.approx(unit * extent_of(wrong, xyz), rel=1e-9)


@pytest.mark.parametrize("xyz", [cloud(), NOTHING], ids=["points", "no points"])
def test_a_wrong_pose_does_not_count(xyz: DoubleArray) -> None:
    right = ring(4.0)
    for far in (20.0, 300.0, 1e6):
        wrong = [*right, camera(np.array([far, 0.0, 0.0]), np.zeros(3))]
        assert extent_of(wrong, xyz) == pytest.approx(published(right), rel=0.15)
        assert published(wrong) > 4 * published(right)


@pytest.mark.parametrize("xyz", [cloud(), NOTHING], ids=["points", "no points"])
def test_photos_from_afar_show_a_small_scene(xyz: DoubleArray) -> None:
    """Cameras forty times as far away, with lenses as much longer, take nearly the same photos."""
    near, far = extent_of(ring(4.0, 250.0), xyz), extent_of(ring(160.0, 10_000.0), xyz)
    assert published(ring(160.0, 10_000.0)) == pytest.approx(40 * near, rel=1e-6)
    assert near < far < 1.6 * near


def test_cameras_in_one_place_see_a_large_scene() -> None:
    """A tripod: points around it are 8 units away."""
    angles = np.arange(20) * 2 * np.pi / 20
    away = np.stack([np.cos(angles), np.sin(angles), np.zeros(20)], axis=1)
    cameras = [camera(0.01 * ahead, 8 * ahead) for ahead in away]
    directions = np.random.default_rng(1).standard_normal((2000, 3))
    xyz = 8 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    assert published(cameras) < 0.02
    assert 1.5 < extent_of(cameras, xyz) < 4.0
    assert extent_of(cameras, NOTHING) == pytest.approx(published(cameras)), "nothing tells how far the scene is"


def test_cameras_that_look_ahead_and_all_cameras_in_one_place() -> None:
    row = [camera(np.array([0.02 * x, 0.0, 0.0]), np.array([0.02 * x, 9.0, 0.0])) for x in range(10)]
    assert extent_of(row, cloud(2.0, (0.0, 9.0, 0.0))) == pytest.approx(0.3 * 9.0, rel=0.1)
    assert extent_of(row, NOTHING) == published(row)
    assert extent_of(row[:1], NOTHING) == 1.0
    assert extent_of(row[:1] * 3, cloud(1.0, (0.0, -5.0, 0.0))) == 1.0, "they see no points"


def test_centres_that_differ_by_rounding_are_one_place() -> None:
    place = np.array([3.6, 0.1, 0.7])
    turned = [
        camera(place, place + np.array([np.cos(angle), np.sin(angle), 0.3 * angle])) for angle in np.arange(12) / 2
    ]
    assert 0 < published(turned) < 1e-14
    assert extent_of(turned, NOTHING) == 1.0


def test_few_points_in_an_image_do_not_count() -> None:
    assert extent_of(ring(4.0), cloud()[:19]) == published(ring(4.0))
    far = ring(160.0, 4000.0)
    assert extent_of(far[:1] * 2 + far, cloud()[:3]) < published(far), "the cameras look at one point"


def walk(length: float, ahead: bool, n: int = 24) -> list[Camera]:
    """Return cameras on a straight way, which look along it or to its side."""
    places = [np.array([along, 0.02 * np.sin(along), 0.0]) for along in np.linspace(0.0, length, n)]
    look = np.array([1.0, 0.1, 0.0]) if ahead else np.array([0.0, 1.0, 0.0])
    return [camera(place, place + look) for place in places]


def corridor(length: float) -> DoubleArray:
    """Return points on two walls beside the way."""
    rng = np.random.default_rng(1)
    along, side, up = rng.uniform(0, length + 10, 1500), rng.choice([-2.0, 2.0], 1500), rng.uniform(-1, 1, 1500)
    return np.stack([along, side, up], axis=1)


def half_diagonals(cameras: list[Camera], xyz: DoubleArray, nearer: float) -> float:
    """Return the median half diagonal of images at a depth of their points, in plain NumPy."""
    found = []
    for one in cameras:
        x, y, depth = (xyz @ one.rotation.T + one.translation).T
        front = depth > 0
        u, v = 100 * x[front] / depth[front] + 80, 100 * y[front] / depth[front] + 60
        inside = (u >= 0) & (u < 160) & (v >= 0) & (v < 120)
        if inside.sum() >= 20:
            found.append(np.quantile(depth[front][inside], nearer))
    return float(np.median(found))  # half a diagonal is 1 at a depth of 1: 200 px and a focal length of 100


def assert_follows_what_is_near(cameras: list[Camera], xyz: DoubleArray) -> None:
    """A walk has 1.4 half diagonals at the depth that a tenth of the points are nearer than."""
    assert extent_of(cameras, xyz) == pytest.approx(1.4 * half_diagonals(cameras, xyz, 0.1), rel=1e-6)
    assert extent_of(cameras, xyz) < 0.5 * published(cameras)


@pytest.mark.parametrize("n", [6, 24])
@pytest.mark.parametrize("length", [60.0, 240.0])
def test_the_extent_of_a_walk_follows_what_is_near(length: float, n: int) -> None:
    cameras, xyz = walk(length, ahead=True, n=n), corridor(length)
    assert_follows_what_is_near(cameras, xyz)
    assert extent_of(cameras, NOTHING) == published(cameras), "nothing says what is near"


@pytest.mark.parametrize("turn", [0.5 * np.pi, 2 * np.pi], ids=["a corner", "around a block"])
def test_a_walk_may_turn(turn: float) -> None:
    """Cameras on a circle that look along it see walls on both sides, but not its centre."""
    angles = np.linspace(0.0, turn, 24, endpoint=False)
    places = 40.0 * np.stack([np.cos(angles), np.sin(angles), np.zeros(24)], axis=1)
    ahead = np.stack([-np.sin(angles), np.cos(angles), np.zeros(24)], axis=1)
    cameras = [camera(place, place + step) for place, step in zip(places, ahead, strict=True)]
    rng = np.random.default_rng(1)
    along, radius = rng.uniform(0.0, turn + 0.2, 1900), rng.choice([38.0, 42.0], 1900)
    walls = np.stack([radius * np.cos(along), radius * np.sin(along), rng.uniform(-1, 1, 1900)], axis=1)
    assert_follows_what_is_near(cameras, walls)


def test_a_survey_from_above_is_a_walk() -> None:
    places = np.array([[x, y, 10.0] for x in np.linspace(-60, 60, 10) for y in np.linspace(-60, 60, 10)])
    cameras = [camera(place, place - (0.0, 0.01, 10.0)) for place in places]
    ground = np.random.default_rng(1).uniform((-70, -70, -0.5), (70, 70, 0.5), (2000, 3))
    assert_follows_what_is_near(cameras, ground)


def test_what_is_not_a_walk() -> None:
    slider = walk(4.0, ahead=False)
    assert extent_of(slider, corridor(4.0)) == published(slider), "what it sees is as wide as the way"
    places = [np.array([2.5 * index, 9.0 * np.sin(index), 0.0]) for index in range(24)]
    inwards = [camera(place, np.array([30.0, 20.0, 0.0])) for place in places]
    xyz = cloud(4.0, (30.0, 20.0, 0.0))
    assert 1.4 * half_diagonals(inwards, xyz, 0.1) < published(inwards)
    assert extent_of(inwards, xyz) == published(inwards), "all look at one place"
    row = [camera(np.array([0.3 * x, 0.0, 0.0]), np.array([0.3 * x, 9.0, 0.0])) for x in range(10)]
    xyz_of_row = np.concatenate([cloud(2.0, (1.0, 9.0, 0.0)), cloud() * (2.5, 0.1, 0.5) + (1.5, 1.0, 0.0)])
    assert 1.4 * half_diagonals(row, xyz_of_row, 0.1) < 0.3 * half_diagonals(row, xyz_of_row, 0.5)
    assert extent_of(row, xyz_of_row) == pytest.approx(0.3 * half_diagonals(row, xyz_of_row, 0.5)), (
        "the lower limit holds"
    )
    some = inwards[:18] + [camera(place, place - (0.0, 1.0, 0.0)) for place in places[18:]]
    assert extent_of(some, xyz) == published(some), "three quarters of them do"
