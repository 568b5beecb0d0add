"""Random points lie where the cameras look, and are denser where more cameras look."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from looking_cameras import looking, ring

from clsplat.cameras.camera import Camera
from clsplat.cameras.seen import seen
from clsplat.splats.splats import Splats
from clsplat.training.initialise import RANDOM_POINTS
from clsplat.training.options.density import Mcmc
from clsplat.training.random_points import random_points as random_points_of


def scene(cameras: list[Camera], extent: float = 4.0) -> Any:
    return SimpleNamespace(train=[SimpleNamespace(camera=camera, alpha=None) for camera in cameras], extent=extent)


def random_points(source: Any, count: int, rng: np.random.Generator) -> np.ndarray:
    """Random points of a scene with opaque photos."""
    xyz, rgb, where = random_points_of(source, count, rng)
    assert rgb is None
    assert where == "where the cameras look"
    return xyz


def lookers(cameras: list[Camera], xyz: np.ndarray) -> np.ndarray:
    return np.sum([seen(camera, xyz).inside for camera in cameras], axis=0)


@pytest.mark.parametrize("middle", [(0.0, 0.0, 0.0), (50.0, -20.0, 7.0)])
def test_half_of_them_are_where_most_cameras_look(middle: tuple[float, float, float]) -> None:
    at = np.array(middle)
    cameras = looking(ring() + at, at)
    xyz = random_points(scene(cameras), 2000, np.random.default_rng(0))
    assert xyz.shape == (2000, 3)
    count = lookers(cameras, xyz)
    assert (count >= 2).all()
    assert 0.5 <= np.mean(count >= 9) < 0.8
    assert np.mean(np.linalg.norm(xyz - at, axis=1) < 4) > 0.5, "within the ring"
    assert np.linalg.norm(xyz - at, axis=1).max() > 12, "and far behind it"


def test_the_scale_of_the_world_does_not_matter() -> None:
    small, large = (
        random_points(scene(looking(size * ring(), np.zeros(3)), 4.0 * size), 500, np.random.default_rng(3))
        for size in (1.0, 1000.0)
    )
    np.testing.assert_allclose(1000 * small, large, rtol=1e-6)


def test_parallel_cameras_look_ahead() -> None:
    """The cameras form a row along x and look along z."""
    cameras = []
    for x in (4.0, 5.0, 6.0):
        pose = np.eye(4)
        pose[0, 3] = -x
        cameras.append(Camera(20, 10, 5, 5, 10, 5, pose))
    xyz = random_points(scene(cameras, 1.1), 400, np.random.default_rng(0))
    assert (lookers(cameras, xyz) >= 2).all()
    assert (xyz[:, 2] > 0).all()


def test_one_camera_and_cameras_in_one_place_do() -> None:
    one = looking(ring(1), np.zeros(3))
    assert (lookers(one, random_points(scene(one, 1.0), 200, np.random.default_rng(0))) == 1).all()
    turned = looking(np.tile([0.0, 0.0, 1.0], (8, 1)), np.array([3.0, 0.0, 1.0]))
    xyz = random_points(scene(turned, 0.0), 100, np.random.default_rng(0))
    assert np.isfinite(xyz).all()


def test_centres_that_differ_by_rounding_are_one_place() -> None:
    """Photos of a tripod, whose poses are matrices: the points were within 1e-14 units."""
    place = np.array([3.6, 0.1, 0.7])
    angles = np.arange(12) / 2
    away = np.stack([np.cos(angles), np.sin(angles), 0.3 * angles], axis=1)
    turned = [looking(place[None], place + ahead)[0] for ahead in away]
    assert np.ptp([camera.position for camera in turned], axis=0).max() > 0
    xyz = random_points(scene(turned, 1.0), 200, np.random.default_rng(0))
    assert 0.2 < np.median(np.linalg.norm(xyz - place, axis=1)) < 5.0


def test_light_reaches_the_middle_of_the_largest_random_start() -> None:
    """Inside an opaque fog no splat has a gradient. Training failed with a transmittance of 1e-8."""
    density = Mcmc()
    cameras = looking(ring(40), np.zeros(3))
    xyz = random_points(scene(cameras), RANDOM_POINTS, np.random.default_rng(0))
    splats = Splats.from_points(
        xyz, np.zeros(xyz.shape, np.uint8), opacity=density.init_opacity, scale_factor=density.init_scale
    )
    scale = np.exp(splats.to_numpy()["log_scale"]).mean(axis=1)
    depths = []
    for camera in cameras[::4]:
        from_camera = xyz - camera.position
        along = from_camera @ camera.rotation[2]
        distance = np.linalg.norm(from_camera - along[:, None] * camera.rotation[2], axis=1)
        before = (along > 0) & (along < np.linalg.norm(camera.position))
        alpha = density.init_opacity * np.exp(-0.5 * (distance / scale) ** 2)
        depths.append(-np.log1p(-alpha[before]).sum())
    assert np.exp(-np.mean(depths)) > 1e-4


@pytest.mark.parametrize("far", [10.0, 40.0, 1000.0])
def test_long_lenses_show_a_small_part_of_the_space(far: float) -> None:
    """The region that all cameras see is a tiny part of the ball between them."""
    cameras = looking(far * ring(), np.zeros(3), 0.7 / far)
    xyz = random_points(scene(cameras), 1000, np.random.default_rng(0))
    assert np.mean(lookers(cameras, xyz) >= 9) >= 0.5
    central = xyz[lookers(cameras, xyz) >= 9]
    assert np.abs(central).max() < 4


def test_a_wrong_pose_moves_no_points() -> None:
    cameras = looking(ring(24), np.zeros(3))
    away = np.eye(4)
    away[:3, 3] = (3000.0, 0.0, 500.0)
    wrong = [*cameras, Camera(32, 32, 40, 40, 16, 16, away)]
    xyz = random_points(scene(wrong), 1000, np.random.default_rng(0))
    assert np.mean(lookers(cameras, xyz) >= 18) >= 0.45
