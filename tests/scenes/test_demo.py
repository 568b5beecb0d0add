"""The demo scene: exact geometry, correct visibility, varied photos, and equal files for equal seeds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from clsplat.cameras.camera import Camera
from clsplat.errors import InputError, OutputError
from clsplat.scenes.colmap_binary import check_binary_model
from clsplat.scenes.demo.scene import photograph, ring_cameras, visible, write_capture
from clsplat.scenes.demo.world import DOME_RADIUS, GROUND_RADIUS, SURFACES, Hits, World
from clsplat.scenes.scene import Scene, load_scene

WIDTH, HEIGHT, N_VIEWS = 64, 48, 12


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small capture."""
    return write_capture(tmp_path_factory.mktemp("capture") / "demo", WIDTH, HEIGHT, N_VIEWS)


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    """The small capture, loaded."""
    return load_scene(folder)


def _look(world: World, camera: Camera) -> tuple[Hits, np.ndarray]:
    """Return where the rays through the pixel centres end, and their directions."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    local = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    direction = local.reshape(-1, 3) @ camera.rotation
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = np.broadcast_to(camera.position, direction.shape)
    return world.cast(origin.astype(np.float32), direction.astype(np.float32)), direction


def test_capture_is_a_scene(folder: Path, scene: Scene) -> None:
    check_binary_model(folder / "sparse" / "0")
    assert len(scene.views) == N_VIEWS
    assert all(image.shape == (HEIGHT, WIDTH, 3) for image in scene.images)
    assert 2000 < len(scene.points) <= 3100
    assert scene.points.track_length.min() >= 3
    for camera, made in zip(scene.cameras, ring_cameras(WIDTH, HEIGHT, N_VIEWS), strict=True):
        np.testing.assert_allclose(camera.cam_from_world, made.cam_from_world, atol=1e-12)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (made.fx, made.fy, made.cx, made.cy)
    heights = [camera.position[2] for camera in scene.cameras]
    assert len(set(np.round(heights, 9))) == 2


def test_test_views_come_from_both_rings() -> None:
    heights = {round(camera.position[2], 6) for camera in ring_cameras(200, 150, 40)[::8]}
    assert len(heights) == 2


def test_photos_are_those_of_the_world(scene: Scene) -> None:
    image = photograph(World(0), scene.cameras[3])
    np.testing.assert_allclose(scene.images[3] / 255.0, image, atol=0.5 / 255 + 1e-6)


def test_photos_are_well_lit_and_rich() -> None:
    world = World(0)
    for camera in ring_cameras(100, 75, 8):
        image = photograph(world, camera)
        assert 0.3 < image.mean() < 0.7
        assert image.std() > 0.12
        assert (image < 0.02).mean() < 0.01
        assert (image > 0.995).mean() < 0.02
        steps = np.abs(np.diff(image, axis=1)).max(axis=2)
        assert (steps > 0.3).mean() > 0.01  # hard edges


def test_points_lie_on_the_surfaces(scene: Scene) -> None:
    xyz = scene.points.xyz
    on_ground = (np.abs(xyz[:, 2]) < 1e-4) & (np.linalg.norm(xyz[:, :2], axis=1) < GROUND_RADIUS)
    on_dome = np.abs(np.linalg.norm(xyz, axis=1) - DOME_RADIUS) < 1e-3
    assert 0.2 < on_ground.mean() < 0.5
    assert 0.01 < on_dome.mean() < 0.3  # few of the views see the same distant points
    things = xyz[~on_ground & ~on_dome]
    assert np.linalg.norm(things[:, :2], axis=1).max() < 2
    assert things[:, 2].min() >= 0
    assert things[:, 2].max() <= 1.5 + 1e-5


def test_tracks_are_correct(folder: Path, scene: Scene) -> None:
    """Each observation is the point's projection, and the first surface along its ray is at the point."""
    import pycolmap

    world = World(0)
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    agree, count = 0, 0
    for view in scene.views:
        camera = view.camera
        observed = model.find_image_with_name(view.name).get_observation_points2D()
        assert len(observed) > 100
        points = [model.points3D[point.point3D_id] for point in observed]
        offset = np.array([point.xyz for point in points]) - camera.position
        local = offset @ camera.rotation.T
        pixels = local[:, :2] / local[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        np.testing.assert_allclose(pixels, [point.xy for point in observed], atol=1e-9)
        assert ((pixels >= 0) & (pixels < (WIDTH, HEIGHT))).all()
        distance = np.linalg.norm(offset, axis=1)
        origin = np.broadcast_to(camera.position, offset.shape).astype(np.float32)
        hits = world.cast(origin, (offset / distance[:, None]).astype(np.float32))
        np.testing.assert_allclose(hits.distance, distance, atol=2e-3)
        dull = hits.surface != SURFACES.index("ball")  # the ball's highlight moves with the view
        color = np.array([point.color for point in points])
        agree += int((np.abs(255 * hits.color - color).max(axis=1) < 8)[dull].sum())
        count += int(dull.sum())
    assert agree > 0.97 * count  # at an edge of colour or shadow, float32 rounding may choose either side


def test_hidden_points_are_not_visible() -> None:
    """A point on the panel's front is visible from the front, not from the back, and not through the box."""
    world, cameras = World(0), ring_cameras(100, 75, 40)
    panel = SURFACES.index("panel")
    for camera in cameras[:20]:
        hits, direction = _look(world, camera)
        assert visible(world, camera, hits.position, hits.normal).all()
        behind = hits.position + 0.1 * direction
        assert not visible(world, camera, behind, hits.normal).any()
        of = hits.surface == panel
        if of.sum() > 50:
            across = cameras[(cameras.index(camera) + 10) % 20]  # the other side of the ring
            assert not visible(world, across, hits.position[of], hits.normal[of]).any()
            assert visible(world, camera, hits.position[of], hits.normal[of]).all()
            break
    else:
        pytest.fail("no view shows the panel")


def test_panel_sides_differ() -> None:
    world = World(0)
    normal_to_panel = np.array([-np.sin(0.6), np.cos(0.6), 0.0])
    along = np.array([np.cos(0.6), np.sin(0.6), 0.0])
    places = np.array([0.55, -0.75, 0.55]) + np.linspace(-0.5, 0.5, 21)[:, None] * along
    sides = [
        world.cast((places - 0.2 * normal).astype(np.float32), np.broadcast_to(normal, places.shape).astype(np.float32))
        for normal in (normal_to_panel, -normal_to_panel)
    ]
    assert all((side.surface == SURFACES.index("panel")).all() for side in sides)
    assert np.abs(sides[0].color - sides[1].color).max(axis=1).mean() > 0.2
    np.testing.assert_allclose(sides[0].normal, -sides[1].normal, atol=1e-6)


def test_every_surface_is_photographed() -> None:
    world, seen = World(0), set()
    for camera in ring_cameras(40, 30, 8):
        hits, _ = _look(world, camera)
        assert np.isfinite(hits.distance).all()
        seen |= {SURFACES[index] for index in hits.surface}
    assert seen == set(SURFACES)


def test_equal_seeds_give_equal_files(folder: Path, tmp_path: Path) -> None:
    again = write_capture(tmp_path / "again", WIDTH, HEIGHT, N_VIEWS)
    other = write_capture(tmp_path / "other", WIDTH, HEIGHT, N_VIEWS, seed=1)
    files = [file.relative_to(folder) for file in sorted(folder.rglob("*.*")) if file.is_file()]
    assert len(files) == N_VIEWS + 3
    for file in files:
        assert (again / file).read_bytes() == (folder / file).read_bytes()
    assert (other / "images/view_000.png").read_bytes() != (folder / "images/view_000.png").read_bytes()


def test_used_folders_and_small_scenes_are_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(OutputError, match="not an empty folder"):
        write_capture(tmp_path)
    with pytest.raises(InputError, match="8x48 px"):
        write_capture(tmp_path / "new", width=8, height=48)
    with pytest.raises(InputError, match="3 views"):
        write_capture(tmp_path / "new", n_views=3)
    assert not (tmp_path / "new").exists()
