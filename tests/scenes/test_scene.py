"""COLMAP models and scenes: reading, split, image sizes, and refused files."""

from __future__ import annotations

import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from scenes_data import scene_folder
from small_scene import (
    CX,
    CY,
    FX,
    FY,
    HEIGHT,
    N_POINTS,
    N_VIEWS,
    NAMES,
    WIDTH,
    as_text,
    cloud,
    model_views,
    photo_of,
    write_garden,
)

from clsplat.errors import InputError
from clsplat.files.images import write_png
from clsplat.scenes.colmap import find_model, read_model
from clsplat.scenes.colmap_binary import write_binary_model
from clsplat.scenes.scene import load_scene


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A small scene."""
    return write_garden(tmp_path)


def _message(error: pytest.ExceptionInfo[InputError]) -> str:
    message = str(error.value)
    assert "\n" not in message
    return message


# --- reading -------------------------------------------------------------------------------


def test_scene_contains_what_was_written(folder: Path) -> None:
    scene = load_scene(folder)
    xyz, rgb = cloud()
    assert scene.name == "garden"
    assert scene.names == NAMES
    for index, (view, written) in enumerate(zip(scene.views, model_views(), strict=True)):
        camera = view.camera
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (FX, FY, CX, CY)
        np.testing.assert_allclose(camera.cam_from_world, written.cam_from_world, atol=1e-14)
        np.testing.assert_array_equal(view.image, photo_of(index))
    np.testing.assert_array_equal(scene.points.xyz, xyz)
    np.testing.assert_array_equal(scene.points.rgb, rgb)
    expected = np.bincount(np.concatenate([view.point_index for view in model_views()]), minlength=N_POINTS)
    np.testing.assert_array_equal(scene.points.track_length, expected)


def test_text_model_equals_binary(folder: Path, tmp_path: Path) -> None:
    as_text(folder / "sparse" / "0", tmp_path / "text")
    binary, text = read_model(folder / "sparse" / "0"), read_model(tmp_path / "text")
    assert [photo.name for photo in text.photos] == [photo.name for photo in binary.photos]
    for one, other in zip(binary.photos, text.photos, strict=True):
        np.testing.assert_allclose(other.cam_from_world, one.cam_from_world, atol=1e-12)
    np.testing.assert_allclose(text.points.xyz, binary.points.xyz, atol=1e-12)
    np.testing.assert_array_equal(text.points.rgb, binary.points.rgb)
    np.testing.assert_array_equal(text.points.track_length, binary.points.track_length)


def test_largest_model_is_chosen(folder: Path) -> None:
    write_binary_model(folder / "sparse" / "1", model_views()[:2], *cloud())
    shutil.move(folder / "sparse" / "0", folder / "sparse" / "2")
    assert find_model(folder).name == "2"
    as_text(folder / "sparse" / "2", folder / "sparse" / "text")
    shutil.rmtree(folder / "sparse" / "2")
    assert find_model(folder).name == "text"


def test_model_directly_in_sparse(folder: Path) -> None:
    for file in (folder / "sparse" / "0").iterdir():
        shutil.move(file, folder / "sparse" / file.name)
    (folder / "sparse" / "0").rmdir()
    assert len(load_scene(folder).views) == N_VIEWS


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_missing_points_give_an_empty_cloud(folder: Path, suffix: str) -> None:
    model = folder / "sparse" / "0"
    if suffix == ".txt":
        as_text(model, folder / "sparse" / "t")
        shutil.rmtree(model)
        model = folder / "sparse" / "t"
    (model / f"points3D{suffix}").unlink()
    scene = load_scene(folder)
    assert len(scene.points) == 0
    assert scene.points.xyz.shape == scene.points.rgb.shape == (0, 3)
    assert len(scene.views) == N_VIEWS


def test_few_registered_images_warn(folder: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_scene(folder)
    for index in range(3):
        write_png(folder / "images" / f"other_{index}.png", photo_of(0))
    with pytest.warns(UserWarning, match="only 9 of 12 photos"):
        load_scene(folder)


def test_pillow_is_loaded_before_pycolmap() -> None:
    code = (
        "import sys, clsplat.scenes.scene\n"
        "sys.exit(0 if 'PIL.Image' in sys.modules and 'pycolmap' not in sys.modules else 1)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# --- split, extent -------------------------------------------------------------------------


def test_split_holds_out_every_eighth(folder: Path) -> None:
    scene = load_scene(folder)
    assert [view.name for view in scene.test] == [NAMES[0], NAMES[8]]
    assert [view.name for view in scene.train] == NAMES[1:8]
    assert [view.name for view in load_scene(folder, test_every=4).test] == [NAMES[0], NAMES[4], NAMES[8]]
    everything = load_scene(folder, eval=False)
    assert everything.test == []
    assert [view.name for view in everything.train] == NAMES


def test_split_by_list(folder: Path, tmp_path: Path) -> None:
    names = tmp_path / "test.txt"
    names.write_text(f"{NAMES[3]}\n\n{NAMES[1]}\r\n", encoding="utf-8")
    assert [view.name for view in load_scene(folder, test_list=names).test] == [NAMES[1], NAMES[3]]
    names.write_text(f"  {NAMES[3]}\t\n \t \n{NAMES[1]} \r\n", encoding="utf-8")
    spaced = load_scene(folder, test_list=names)
    assert [view.name for view in spaced.test] == [NAMES[1], NAMES[3]], "spaces around a name do not count"
    names.write_text("nobody.png\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"nobody\.png"):
        load_scene(folder, test_list=names)
    names.write_text("\n".join(NAMES), encoding="utf-8")
    with pytest.raises(InputError, match="no training view"):
        load_scene(folder, test_list=names)
    with pytest.raises(InputError, match="list of names"):
        load_scene(folder, test_list=tmp_path / "absent.txt")


def test_extent_is_that_of_the_training_cameras(folder: Path) -> None:
    scene = load_scene(folder)
    centres = np.array([camera.position for camera in scene.cameras[1:8]])
    farthest = max(np.linalg.norm(centre - centres.mean(axis=0)) for centre in centres)
    assert scene.extent == pytest.approx(1.1 * farthest, rel=1e-12)


# --- sizes ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("resolution", "size"),
    [(-1, (40, 30)), (1, (40, 30)), (2, (20, 15)), (4, (10, 8)), (8, (5, 4)), (33, (33, 24)), (39, (39, 29))],
)
def test_resolution(folder: Path, resolution: int, size: tuple[int, int]) -> None:
    view = load_scene(folder, resolution=resolution).views[2]
    assert (view.camera.width, view.camera.height) == size
    assert view.image.shape == (size[1], size[0], 3)
    assert view.camera.fx == pytest.approx(FX * size[0] / WIDTH)
    assert view.camera.cy == pytest.approx(CY * size[1] / HEIGHT)


def test_wide_images_are_reduced_to_1600(folder: Path) -> None:
    for index, name in enumerate(NAMES):
        write_png(folder / "images" / name, photo_of(index, 1640, 1230))
    small = load_scene(folder).views[0]
    assert (small.camera.width, small.camera.height) == (1600, 1200)
    assert small.camera.fx == pytest.approx(FX * 40)


@pytest.mark.parametrize("size", [(20, 15), (13, 10), (14, 10), (5, 4)])
def test_reduced_photos_scale_the_camera(folder: Path, size: tuple[int, int]) -> None:
    for index, name in enumerate(NAMES):
        write_png(folder / "images_s" / name, photo_of(index, *size))
    view = load_scene(folder, images="images_s").views[0]
    assert (view.camera.width, view.camera.height) == size
    assert view.image.shape == (size[1], size[0], 3)
    np.testing.assert_allclose([view.camera.fx, view.camera.cx], np.array([FX, CX]) * size[0] / WIDTH)
    np.testing.assert_allclose([view.camera.fy, view.camera.cy], np.array([FY, CY]) * size[1] / HEIGHT)


@pytest.mark.parametrize("size", [(30, 40), (20, 20), (40, 20)])
def test_photo_of_another_aspect_is_refused(folder: Path, size: tuple[int, int]) -> None:
    write_png(folder / "images" / NAMES[4], photo_of(0, *size))
    with pytest.raises(InputError) as error:
        load_scene(folder)
    assert NAMES[4] in _message(error)
    assert f"{size[0]}x{size[1]}" in _message(error)
    assert "40x30" in _message(error)


def test_transparent_photos_get_the_background(folder: Path) -> None:
    image = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    image[..., 0], image[: HEIGHT // 2, :, 3], image[HEIGHT // 2 :, :, 3] = 200, 255, 51
    write_png(folder / "images" / NAMES[0], image)
    black = load_scene(folder, alpha="background").images[0]
    white = load_scene(folder, background=(1, 1, 1), alpha="background").images[0]
    np.testing.assert_array_equal(black[0, 0], [200, 0, 0])
    np.testing.assert_array_equal(black[-1, 0], [40, 0, 0])
    np.testing.assert_array_equal(white[0, 0], [200, 0, 0])
    np.testing.assert_array_equal(white[-1, 0], [244, 204, 204])


# --- refusals ------------------------------------------------------------------------------


def test_missing_parts_are_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        load_scene(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"images_4.*choose one of: images$"):
        load_scene(folder, images="images_4")
    for name in NAMES[:7]:
        (folder / "images" / name).unlink()
    with pytest.raises(InputError, match=r"only 2 of its 9 photos can be used, at least 3 must be; .*shot_0\.png"):
        load_scene(folder)
    (folder / "sparse" / "0" / "images.bin").unlink()
    with pytest.raises(InputError, match="no COLMAP model"):
        load_scene(folder)
    shutil.rmtree(folder / "sparse")
    with pytest.raises(InputError, match="no folder 'sparse'"):
        load_scene(folder)


@pytest.mark.parametrize(("option", "value"), [("resolution", 0), ("resolution", -2), ("test_every", 1)])
def test_bad_options(folder: Path, option: str, value: int) -> None:
    with pytest.raises(InputError, match=f"{option} {value}"):
        load_scene(folder, **{option: value})


def test_model_without_images(folder: Path) -> None:
    write_binary_model(folder / "sparse" / "0", [], np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    with pytest.raises(InputError, match="registers no image"):
        load_scene(folder)


def test_damaged_photo_is_named_and_left_out(folder: Path) -> None:
    photos = [folder / "images" / name for name in NAMES]
    photos[2].write_bytes(photos[2].read_bytes()[:60])
    with pytest.warns(UserWarning, match=rf"1 of {N_VIEWS} photos are left out \(12 %\): .*{NAMES[2]}"):
        scene = load_scene(folder)
    assert scene.names == [name for name in NAMES if name != NAMES[2]]
    for photo in photos:
        photo.write_bytes(b"")
    with pytest.raises(InputError, match=rf"none of its {N_VIEWS} photos can be used, .*{NAMES[0]}"):
        load_scene(folder)


def test_points_that_are_not_finite(folder: Path) -> None:
    xyz, rgb = cloud()
    xyz[3, 1] = np.nan
    write_binary_model(folder / "sparse" / "0", model_views(), xyz, rgb)
    with pytest.raises(InputError, match="1 points have a position that is not finite"):
        load_scene(folder)


# --- the real scenes -----------------------------------------------------------------------


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "n_views", "size", "n_points", "track", "reprojection_px"),
    [
        ("fox", 50, (400, 713), 13204, 6.1, 0.28),
        ("sceaux_castle", 11, (400, 296), 8865, 4.7, 0.07),
        ("kitchen", 25, (400, 267), 21014, 3.0, 0.21),
    ],
)
def test_real_scene_reprojects(
    name: str, n_views: int, size: tuple[int, int], n_points: int, track: float, reprojection_px: float
) -> None:
    import pycolmap

    folder = scene_folder(name)
    scene = load_scene(folder)
    assert (len(scene.views), len(scene.points)) == (n_views, n_points)
    assert scene.points.track_length.mean() == pytest.approx(track, abs=0.05)
    truth = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    errors = []
    for view in scene.views:
        camera = view.camera
        assert (camera.width, camera.height) == size == view.image.shape[1::-1]
        observed = truth.find_image_with_name(view.name).get_observation_points2D()
        world = np.array([truth.points3D[point.point3D_id].xyz for point in observed])
        local = world @ camera.rotation.T + camera.translation
        pixels = local[:, :2] / local[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        errors.append(np.linalg.norm(pixels - np.array([point.xy for point in observed]), axis=1))
    assert np.concatenate(errors).mean() == pytest.approx(reprojection_px, abs=0.006)
