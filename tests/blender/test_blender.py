"""The Blender add-on without Blender: camera, colours and zip file. test_blender_real.py uses a real Blender."""

from __future__ import annotations

import tomllib
import zipfile
from pathlib import Path

import numpy as np
import pytest
from blender_scene import HEIGHT, WIDTH, encoded, facing, some_splats
from cli_runner import clsplat, error_of
from clsplat_blender.lens import Lens, Raster, camera_of, camera_of_matrices, lens_of, matrix_world_of, moved
from clsplat_blender.pictures import NOTHING, Placed, Studio, combined, depths, to_linear
from clsplat_cli.blender_addon import addon_zip
from scipy.spatial.transform import Rotation

import clsplat as package
from clsplat.cameras.camera import Camera
from clsplat.errors import InputError
from clsplat.rendering.renderer import Rendered, Renderer
from clsplat.splats.transform import joined, transformed

# --- lens ----------------------------------------------------------------------------------------


def test_a_pinhole_survives_blenders_values() -> None:
    rng = np.random.default_rng(2)
    for aspect in (1.0, 0.8, 1.3):
        pose = np.hstack([Rotation.random(rng=rng).as_matrix(), rng.normal(size=(3, 1))])
        camera = Camera(70, 50, 60.0, 60.0 / aspect, 31.0, 28.0, pose)
        lens, aspects = lens_of(camera)
        assert min(aspects) == 1.0
        back = camera_of(lens, Raster(70, 50, *aspects), matrix_world_of(camera))
        for key in ("fx", "fy", "cx", "cy"):
            assert getattr(back, key) == pytest.approx(getattr(camera, key), rel=1e-12)
        np.testing.assert_allclose(back.cam_from_world, camera.cam_from_world, atol=1e-12)


def test_a_border_is_a_part_of_the_image() -> None:
    raster = Raster.of_settings(201, 101, 50, border=(0.25, 0.5, 0.75, 1.0))
    assert (raster.width, raster.height) == (100, 50)
    assert raster.pixels == (25, 25, 75, 50)
    assert Raster(100, 50).pixels == (0, 0, 100, 50)


def test_other_cameras_are_refused() -> None:
    for kind, word in (("ORTHO", "orthographic"), ("PANO", "panoramic"), ("CUSTOM", "custom")):
        with pytest.raises(InputError, match=f"Camera is {word}: set its type to Perspective"):
            camera_of(Lens(type=kind), Raster(10, 10), np.eye(4), "Camera")
    sheared = np.eye(4)
    sheared[0, 1] = 1.0
    with pytest.raises(InputError, match=r"Camera: .*rotation"):
        camera_of(Lens(), Raster(10, 10), sheared, "Camera")


def test_the_viewports_matrices_are_a_pinhole() -> None:
    camera = Camera(80, 60, 70.0, 75.0, 35.0, 33.0, facing(0.3).cam_from_world)
    near, far = 0.1, 100.0
    projection = np.array(
        [
            [2 * 70 / 80, 0, 1 - 2 * 35 / 80, 0],
            [0, 2 * 75 / 60, 2 * 33 / 60 - 1, 0],
            [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, -1, 0],
        ]
    )
    back = camera_of_matrices(np.linalg.inv(matrix_world_of(camera)), projection, 80, 60)
    for key in ("width", "height", "fx", "fy", "cx", "cy"):
        assert getattr(back, key) == pytest.approx(getattr(camera, key))
    np.testing.assert_allclose(back.cam_from_world, camera.cam_from_world, atol=1e-12)
    projection[3] = (0, 0, 0, 1)
    with pytest.raises(InputError, match="orthographic"):
        camera_of_matrices(np.eye(4), projection, 80, 60)


# --- pictures --------------------------------------------------------------------------------------


def test_colours_come_back_through_srgb() -> None:
    values = np.linspace(0, 1.5, 301, dtype=np.float32)
    np.testing.assert_allclose(encoded(to_linear(values).astype(float)), values, atol=2e-6)


def test_combined_is_premultiplied_and_bottom_up() -> None:
    image = Rendered(
        np.array([[[0.3, 0.2, 0.1]], [[0.0, 0.0, 0.0]]], np.float32),
        np.array([[0.5], [0.0]], np.float32),
        np.array([[2.0], [0.0]], np.float32),
    )
    clear = combined(image, None)
    np.testing.assert_allclose(clear[1, 0], [*(0.5 * to_linear(np.float32([0.6, 0.4, 0.2]))), 0.5], rtol=1e-6)
    np.testing.assert_array_equal(clear[0, 0], 0)
    solid = combined(image, (1.0, 0.0, 0.0))
    np.testing.assert_allclose(solid[1, 0], [*to_linear(np.float32([0.8, 0.2, 0.1])), 1], rtol=1e-6)
    np.testing.assert_allclose(combined(image, (1.0, 0.0, 0.0), linear=False)[1, 0], [0.8, 0.2, 0.1, 1], rtol=1e-6)
    np.testing.assert_array_equal(depths(image), np.float32([[NOTHING], [4.0]]))


def test_the_studio_shows_one_object_as_it_is(tmp_path: Path) -> None:
    """A single object has the bits of `render`, also if object and camera are turned and scaled together."""
    splats, camera = some_splats(), facing(0.4)
    splats.save(tmp_path / "a.ply")
    studio = Studio()
    expected = Renderer(studio.renderer.device).render(splats, camera)
    plain = studio.render([Placed("a", tmp_path / "a.ply", np.eye(4))], camera)
    np.testing.assert_array_equal(plain.color, expected.color)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2 * Rotation.from_rotvec((0.3, 1, 2)).as_matrix(), (1, 2, 3)
    back = np.linalg.inv(matrix)
    there = moved(camera, 0.5, 2 * back[:3, :3], back[:3, 3])
    image = studio.render([Placed("a", tmp_path / "a.ply", matrix)], there)
    np.testing.assert_allclose(image.color, expected.color, atol=1e-5)
    np.testing.assert_allclose(image.depth, 2 * expected.depth, rtol=1e-4, atol=1e-5)


def test_the_studio_joins_objects_and_reads_changed_files_again(tmp_path: Path) -> None:
    first, second, camera = some_splats(0), some_splats(1, "gaussian"), facing(0.4)
    first.save(tmp_path / "a.ply")
    second.save(tmp_path / "b.ply")
    matrix = np.diag([0.5, 0.5, 0.5, 1.0])
    objects = [Placed("a", tmp_path / "a.ply", np.eye(4)), Placed("b", tmp_path / "b.ply", matrix)]
    studio = Studio()
    renderer = Renderer(studio.renderer.device)
    expected = renderer.render(joined([first, transformed(second, matrix)]), camera)
    np.testing.assert_array_equal(studio.render(objects, camera).color, expected.color)
    second.select(range(10)).save(tmp_path / "b.ply")
    fewer = renderer.render(joined([first, transformed(second.select(range(10)), matrix)]), camera)
    np.testing.assert_array_equal(studio.render(objects, camera).color, fewer.color)
    assert np.abs(fewer.color - expected.color).max() > 0.1


def test_the_studio_clips_and_shows_nothing_where_nothing_is(tmp_path: Path) -> None:
    splats, camera = some_splats(), facing(0.4)
    splats.save(tmp_path / "a.ply")
    item, studio = Placed("a", tmp_path / "a.ply", np.eye(4)), Studio()
    depth = splats.mean @ camera.rotation[2] + camera.translation[2]
    expected = Renderer(studio.renderer.device).render(splats.select(depth <= 4.0), camera)
    np.testing.assert_array_equal(studio.render([item], camera, (0.0, 4.0)).color, expected.color)
    assert studio.render([item], camera, (0.0, 0.1)).alpha.max() == 0
    assert studio.render([], camera).color.shape == (HEIGHT, WIDTH, 3)


def test_the_studio_names_the_object_at_fault(tmp_path: Path) -> None:
    some_splats().save(tmp_path / "a.ply")
    with pytest.raises(InputError, match=r"thing: .*b\.ply: No such file"):
        Studio().render([Placed("thing", tmp_path / "b.ply", np.eye(4))], facing(0))
    with pytest.raises(InputError, match=r"thing: its axes are scaled by 1, 2, 1"):
        Studio().render([Placed("thing", tmp_path / "a.ply", np.diag([1.0, 2.0, 1.0, 1.0]))], facing(0))


# --- the zip ------------------------------------------------------------------------------------------


def test_the_zip_holds_the_add_on(tmp_path: Path) -> None:
    out = clsplat("blender-addon", "-o", tmp_path / "a.zip")
    assert str(tmp_path / "a.zip") in out
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        names = set(archive.namelist())
        about = tomllib.loads(archive.read("blender_manifest.toml").decode())
    assert {"__init__.py", "engine.py", "lens.py", "blender_manifest.toml"} <= names
    assert (about["id"], about["version"], about["type"]) == ("clsplat", package.__version__, "add-on")
    assert "wheels" not in about
    assert (tmp_path / "a.zip").read_bytes() == addon_zip([])


def test_the_zip_takes_wheels(tmp_path: Path) -> None:
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    assert "no wheel of clsplat" in error_of("blender-addon", "-o", tmp_path / "a.zip", "--wheels", wheels)
    for name in (
        "clsplat-0.1.0-py3-none-any",
        "numpy-2.0-cp311-cp311-manylinux_2_17_x86_64",
        "pyopencl-2026.1-cp311-cp311-manylinux_2_28_x86_64",
    ):
        (wheels / f"{name}.whl").write_bytes(b"wheel")
    clsplat("blender-addon", "-o", tmp_path / "a.zip", "--wheels", wheels)
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        about = tomllib.loads(archive.read("blender_manifest.toml").decode())
        for path in about["wheels"]:
            assert archive.read(path.removeprefix("./")) == b"wheel"
    assert [path.split("/")[-1].split("-")[0] for path in about["wheels"]] == ["clsplat", "pyopencl"]
    assert about["platforms"] == ["linux-x64"]
    assert "no such folder" in error_of("blender-addon", "--wheels", tmp_path / "none", "-o", tmp_path / "b.zip")


def test_a_border_is_rounded_as_blender_does() -> None:
    """Blender keeps shares as float32, in which 0.7 times 1920 is 1344. In double precision that is a little less."""
    border = tuple(float(np.float32(share)) for share in (0.1, 0.1, 0.7, 0.9))
    assert Raster(1920, 1080, border=border).pixels == (192, 108, 1344, 972)  # type: ignore[arg-type]
    assert Raster(100, 60, border=(float(np.float32(0.29)), 0.0, float(np.float32(0.58)), 1.0)).pixels == (
        29,
        0,
        58,
        60,
    )


@pytest.mark.parametrize("scale", [(-1.0, 1.0, 1.0), (-1.0, -1.0, -1.0), (1.0, 0.0, 1.0)])
def test_a_mirrored_camera_says_so(scale: tuple[float, float, float]) -> None:
    with pytest.raises(InputError, match="view_0: its transform is mirrored or flat; set its scale above 0"):
        camera_of(Lens(50.0, 36.0, 24.0, "AUTO", 0.0, 0.0), Raster(96, 64), np.diag([*scale, 1.0]), "view_0")
