"""Silhouettes of transparent photos say where random points start."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from looking_cameras import looking, ring
from scenes_data import scene_folder

from clsplat.cameras.camera import Camera
from clsplat.cameras.seen import seen
from clsplat.scenes.scene import load_scene
from clsplat.scenes.view import View
from clsplat.training.random_points import random_points
from clsplat.training.silhouettes import Silhouettes, transparent_share

RADIUS = 0.8  # of the ball in the photos
RED = (200, 20, 10)


def ball_photo(camera: Camera, at: np.ndarray, behind: int = 0, radius: float = RADIUS) -> View:
    """Return a photo of a red ball. behind : alpha of the pixels around it."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    local = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(rows.shape)], axis=-1)
    centre = camera.rotation @ at + camera.translation
    along = local @ centre / np.linalg.norm(local, axis=-1)
    hit = centre @ centre - along**2 < radius**2
    image = np.where(hit[:, :, None], np.array(RED, np.uint8), np.uint8(255))
    return View("ball.png", camera, image, alpha=np.where(hit, 255, behind).astype(np.uint8))


def ball(
    at: tuple[float, float, float] = (0.0, 0.0, 0.0), size: int = 50, unlike: int = 0, radius: float = RADIUS
) -> list[View]:
    """Return photos from a ring and from above. unlike : number of photos of a ball in another place."""
    middle = np.array(at)
    places = np.concatenate([ring(40), ring(40) * (1, 1, -1), [(0.01, 0.0, 4.0), (0.0, 0.01, -4.0)]])
    cameras = [camera.resized(size, size) for camera in looking(places + middle, middle)]
    return [ball_photo(camera, middle + (n < unlike) * 9.0, radius=radius) for n, camera in enumerate(cameras)]


def scene_of(views: list[View]) -> Any:
    """Return the parts of a Scene that `random_points` reads."""
    return SimpleNamespace(train=views, extent=4.0)


@pytest.mark.parametrize("at", [(0.0, 0.0, 0.0), (50.0, -20.0, 7.0)])
def test_points_fill_the_object(at: tuple[float, float, float]) -> None:
    views = ball(at)
    xyz, rgb, where = random_points(scene_of(views), 4000, np.random.default_rng(0))
    assert where == "inside the silhouettes of the photos"
    assert xyz.shape == (4000, 3)
    distance = np.linalg.norm(xyz - at, axis=1) / RADIUS
    assert distance.max() < 1.25, "blocks of pixels and the hull of a finite number of photos are a little larger"
    assert np.mean(distance < 0.8) / np.mean(distance < 1.0) == pytest.approx(0.8**3, abs=0.05), "uniform"
    np.testing.assert_array_equal(rgb, np.broadcast_to(RED, xyz.shape))


@pytest.mark.parametrize(("radius", "size"), [(RADIUS, 50), (0.05, 200)])
def test_few_points_fill_the_object_too(radius: float, size: int) -> None:
    """They reach its ends, and an object that is small in its photos is found."""
    views = ball(radius=radius, size=size)
    for seed in range(5):
        xyz, _, where = random_points(scene_of(views), 300, np.random.default_rng(seed))
        assert where == "inside the silhouettes of the photos"
        xyz /= radius
        assert len(xyz) == 300
        assert (xyz.min(axis=0) < -0.8).all()
        assert (xyz.max(axis=0) > 0.8).all()


@pytest.mark.parametrize("count", [8, 16, 52])
def test_far_parts_of_the_hull_do_not_decide(count: int) -> None:
    """The hull of some photos has parts far behind the object, in which there is nothing."""
    whole = load_scene(scene_folder("lego"), resolution=8)
    chosen = {whole.train[i].name for i in np.linspace(0, len(whole.train) - 1, count).round().astype(int)}
    scene = replace(whole, views=[view for view in whole.views if view.name in chosen])
    xyz, _, where = random_points(scene, 5000, np.random.default_rng(0))
    assert where == "inside the silhouettes of the photos"
    assert len(xyz) == 5000
    cameras = [np.linalg.norm(view.camera.position) for view in scene.train]
    assert np.linalg.norm(xyz, axis=1).max() < 2.1 * np.median(cameras), "the corners of a box"


def test_large_photos_are_reduced() -> None:
    """Blocks of 3x3 pixels: the last ones of 599 px need a margin. 50 px stay as they are."""
    small, large = (Silhouettes(ball(size=size)) for size in (50, 599))
    xyz = np.random.default_rng(0).uniform(-1.2, 1.2, (20_000, 3))
    distance = np.linalg.norm(xyz, axis=1) / RADIUS
    assert np.mean(small.admit(xyz) != large.admit(xyz)) < 0.02
    assert large.admit(xyz[distance < 0.99]).all(), "no part of the object is left out"
    assert not large.admit(xyz[distance > 1.15]).any()
    assert large.admit(np.full((1, 3), 99.0)).all(), "outside all photos"
    np.testing.assert_array_equal(np.unique(large.colors(xyz[distance < 1.05]), axis=0), [RED], "no background")


def test_some_silhouettes_may_be_wrong() -> None:
    """One of 82 photos shows nothing where the ball is: a cut-out that failed. If nine fail, no hull is left."""
    for unlike, where in ((1, "inside the silhouettes of the photos"), (9, "where the cameras look")):
        assert random_points(scene_of(ball(unlike=unlike)), 500, np.random.default_rng(0)).where == where


def test_a_landscape_without_its_sky_reaches_far() -> None:
    """The visual hull is not bounded, so the points are as rare far away as without silhouettes."""
    cameras = looking(ring(), np.zeros(3))
    views = [
        View("photo.png", camera, np.zeros((32, 32, 3), np.uint8), alpha=np.repeat([[0], [255]], 16, 0).repeat(32, 1))
        for camera in cameras
    ]
    views = [replace(view, alpha=view.alpha.astype(np.uint8)) for view in views if view.alpha is not None]
    assert transparent_share(views) == pytest.approx(0.5)
    xyz, _, where = random_points(scene_of(views), 2000, np.random.default_rng(0))
    assert where == "inside the silhouettes of the photos"
    distance = np.linalg.norm(xyz, axis=1)
    assert distance.max() > 6
    assert np.mean(distance < 4) > 0.56, "uniform points would have less than half of them within the ring"
    for camera in cameras:
        _, pixel, inside = seen(camera, xyz)
        assert (pixel[inside, 1] >= 16).all()


def test_photos_without_transparency_exclude_nothing() -> None:
    views = [replace(view, alpha=None) for view in ball()]
    assert transparent_share(views) == 0
    assert Silhouettes(views).admit(np.zeros((3, 3))).all()
    assert not Silhouettes(views).colors(np.zeros((3, 3))).any()
    opaque = [ball_photo(view.camera, np.zeros(3), behind=255) for view in views]
    assert random_points(scene_of(opaque), 100, np.random.default_rng(0)).where == "where the cameras look"
