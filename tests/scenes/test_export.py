"""Cameras for other programs: our readers and COLMAP's read back what was written."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_runner import clsplat, error_of
from small_scene import NAMES, write_garden

from clsplat.cameras.cameras_json import read_cameras
from clsplat.cameras.path import CameraPath, write_path
from clsplat.errors import InputError
from clsplat.files.images import write_png
from clsplat.scenes.colmap import read_model
from clsplat.scenes.export import relative_files, write_colmap, write_transforms
from clsplat.scenes.posed_images import PosedImages
from clsplat.scenes.scene import load_scene, read_posed_images
from clsplat.scenes.undistort import RegisteredImage, make_lens
from clsplat.splats.splats import Splats

# Parameters of lenses by COLMAP model; transforms.json supports only a few models.
LENSES = {
    "SIMPLE_PINHOLE": [33.0, 18.5, 16.25],
    "PINHOLE": [33.0, 31.0, 18.5, 16.25],
    "SIMPLE_RADIAL": [33.0, 18.5, 16.25, -0.1],
    "RADIAL": [33.0, 18.5, 16.25, -0.1, 0.02],
    "OPENCV": [33.0, 31.0, 18.5, 16.25, -0.1, 0.02, 1e-3, -2e-3],
    "FULL_OPENCV": [33.0, 31.0, 18.5, 16.25, -0.1, 0.02, 1e-3, -2e-3, 0.01, 0.0, 0.0, 0.0],
    "OPENCV_FISHEYE": [33.0, 31.0, 18.5, 16.25, 0.01, 0.002, 0.0, 1e-4],
}


@pytest.fixture
def garden(tmp_path: Path) -> Path:
    return write_garden(tmp_path)


def with_lens(garden: Path, model: str) -> PosedImages:
    posed = read_posed_images(garden, None)
    photos = [
        RegisteredImage(photo.name, photo.cam_from_world, make_lens(model, 40, 30, LENSES[model]))
        for photo in posed.photos
    ]
    return replace(posed, photos=photos)


def assert_same(photos: list[RegisteredImage], expected: list[RegisteredImage]) -> None:
    """Compare poses to 1e-9, and lenses by the pixels where they see points."""
    rng = np.random.default_rng(0)
    rays = np.column_stack([rng.uniform(-0.4, 0.4, (30, 2)), np.ones(30)])
    assert [photo.name for photo in photos] == [photo.name for photo in expected]
    for one, other in zip(photos, expected, strict=True):
        np.testing.assert_allclose(one.cam_from_world, other.cam_from_world, atol=1e-9)
        assert (one.lens.width, one.lens.height) == (other.lens.width, other.lens.height)
        np.testing.assert_allclose(one.lens.img_from_cam(rays), other.lens.img_from_cam(rays), atol=1e-9)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("model", [*LENSES, "FOV"])
def test_colmap_models_come_back(garden: Path, tmp_path: Path, model: str, text: bool) -> None:
    LENSES.setdefault("FOV", [33.0, 31.0, 18.5, 16.25, 0.9])
    posed = with_lens(garden, model)
    write_colmap(tmp_path / "out", posed.photos, posed.points, text)
    assert {path.suffix for path in (tmp_path / "out").iterdir()} == {".txt" if text else ".bin"}
    back = read_model(tmp_path / "out")
    assert_same(posed.photos, back.photos)
    np.testing.assert_array_equal(back.points.xyz, posed.points.xyz)
    np.testing.assert_array_equal(back.points.rgb, posed.points.rgb)


@pytest.mark.parametrize("model", [name for name in LENSES if name != "FOV"])
def test_transforms_come_back(garden: Path, model: str) -> None:
    posed = with_lens(garden, model)
    write_transforms(garden / "transforms.json", posed.photos, [f"images/{name}" for name in NAMES], posed.points)
    shutil.rmtree(garden / "sparse")
    back = read_posed_images(garden, None)
    named = [RegisteredImage(f"images/{photo.name}", photo.cam_from_world, photo.lens) for photo in posed.photos]
    assert_same(named, back.photos)
    np.testing.assert_allclose(back.points.xyz, posed.points.xyz, rtol=1e-6)
    np.testing.assert_array_equal(back.points.rgb, posed.points.rgb)


def test_undistorted_lenses_are_written_as_pinhole(garden: Path, tmp_path: Path) -> None:
    """3DGS reads PINHOLE only, and transforms.json is read as FULL_OPENCV."""
    posed = read_posed_images(garden, None)
    photos = [
        RegisteredImage(p.name, p.cam_from_world, make_lens("FULL_OPENCV", 40, 30, [33, 31, 18.5, 16.25, *[0] * 8]))
        for p in posed.photos
    ]
    write_colmap(tmp_path / "out", photos, posed.points)
    assert {photo.lens.model.name for photo in read_model(tmp_path / "out").photos} == {"PINHOLE"}


def test_a_scene_is_written_and_trains_as_before(garden: Path, tmp_path: Path) -> None:
    before = load_scene(garden)
    assert "9 cameras, 12 points" in clsplat("cameras", garden, garden / "transforms.json")
    assert "exists already" in error_of("cameras", garden, garden / "transforms.json")
    other = tmp_path / "elsewhere" / "deep"
    clsplat("cameras", garden, other / "transforms.json", "-q")
    frames = json.loads((other / "transforms.json").read_text())["frames"]
    assert [(other / frame["file_path"]).resolve() for frame in frames] == [garden / "images" / name for name in NAMES]
    assert [view.name for view in load_scene(other).views] == NAMES
    moved = garden.parent / "moved"
    shutil.copytree(garden, moved)
    shutil.rmtree(moved / "sparse")
    clsplat("cameras", moved, moved / "sparse" / "0", "--format", "colmap-text")  # from transforms.json, and back
    after = load_scene(moved)
    assert after.names == before.names
    for one, two in zip(before.views, after.views, strict=True):
        np.testing.assert_allclose(one.camera.cam_from_world, two.camera.cam_from_world, atol=1e-9)
        np.testing.assert_array_equal(one.image, two.image)


def test_cameras_and_splat_centres_of_a_model(tmp_path: Path, model_folder: Path) -> None:
    model = model_folder
    output = clsplat("cameras", model, tmp_path / "sparse" / "0")
    named, found = read_cameras(model / "cameras.json"), read_model(tmp_path / "sparse" / "0")
    assert sorted(f"{entry.name}.png" for entry in named) == [photo.name for photo in found.photos]
    poses = {f"{entry.name}.png": entry.camera for entry in named}
    for photo in found.photos:
        np.testing.assert_allclose(photo.cam_from_world, poses[photo.name].cam_from_world, atol=1e-9)
        assert list(photo.lens.params) == [getattr(poses[photo.name], name) for name in ("fx", "fy", "cx", "cy")]
    splats = Splats.load(sorted(model.glob("point_cloud/*_60/point_cloud.ply"))[-1])
    opaque = splats.mean[splats.opacity_logit >= 0]
    np.testing.assert_array_equal(found.points.xyz, opaque)
    assert f"{len(opaque)} points" in output
    clsplat("cameras", model, tmp_path / "cameras.json")
    for one, two in zip(read_cameras(tmp_path / "cameras.json"), named, strict=True):
        assert (one.name, one.camera.fx, one.camera.cy) == (two.name, two.camera.fx, two.camera.cy)
        np.testing.assert_allclose(one.camera.cam_from_world, two.camera.cam_from_world, atol=1e-12)
    path = CameraPath(tuple(entry.camera for entry in named[:3]))
    write_path(tmp_path / "path.json", path)
    assert "3 cameras" in clsplat("cameras", tmp_path / "path.json", tmp_path / "t" / "transforms.json")


def test_points_of_other_cameras_stay(garden: Path, tmp_path: Path, model_folder: Path) -> None:
    """Two files of cameras in one folder have points of their own, and no points are replaced without being asked."""
    folder = tmp_path / "nerf"
    shutil.copytree(garden / "images", folder / "images")
    clsplat("cameras", garden, folder / "transforms.json")
    points = load_scene(folder).points.xyz
    clsplat("cameras", model_folder, folder / "again.json")
    np.testing.assert_array_equal(load_scene(folder / "transforms.json").points.xyz, points)
    assert json.loads((folder / "again.json").read_text())["ply_file_path"] == "again.ply"
    (folder / "third.ply").write_text("precious")
    assert "third.ply: exists already" in error_of("cameras", model_folder, folder / "third.json")
    assert not (folder / "third.json").exists()
    assert (folder / "third.ply").read_text() == "precious"
    clsplat("cameras", model_folder, folder / "third.json", "--overwrite")


def test_missing_cameras_and_unsupported_lenses_are_refused(garden: Path, tmp_path: Path, model_folder: Path) -> None:
    ply = sorted(model_folder.glob("point_cloud/*/point_cloud.ply"))[0]
    assert "has no cameras" in error_of("cameras", ply, tmp_path / "out.json")
    posed = with_lens(garden, "RADIAL")
    write_colmap(garden / "sparse" / "0", posed.photos, posed.points)
    assert "does not support distorted lenses" in error_of("cameras", garden, tmp_path / "cameras.json")
    photo = RegisteredImage("a.png", np.eye(4), make_lens("FOV", 40, 30, [33.0, 31.0, 18.5, 16.25, 0.9]))
    with pytest.raises(Exception, match="not support COLMAP's lens model FOV"):
        write_transforms(tmp_path / "t.json", [photo], ["a.png"], posed.points)
    six = make_lens("FULL_OPENCV", 40, 30, [33.0, 31.0, 18.5, 16.25, 0, 0, 0, 0, 0, 0.1, 0, 0])
    with pytest.raises(Exception, match="not support k4, k5 and k6"):
        write_transforms(tmp_path / "t.json", [RegisteredImage("a.png", np.eye(4), six)], ["a.png"], posed.points)
    assert not (tmp_path / "t.json").exists()
    assert relative_files([garden / "images" / "a.png"], garden / "out") == ["../images/a.png"]


@pytest.mark.parametrize("text", [False, True])
def test_names_that_a_colmap_model_cannot_store(garden: Path, tmp_path: Path, text: bool) -> None:
    posed = with_lens(garden, "PINHOLE")
    for name in ("view_\udcff.png", "two\nlines.png"):
        photo = replace(posed.photos[0], name=name)
        with pytest.raises(InputError, match="cannot store this name; rename the photo"):
            write_colmap(tmp_path / "model", [photo], posed.points, text)
        assert not (tmp_path / "model").exists()


def test_masks_and_held_out_photos_are_written(garden: Path, tmp_path: Path) -> None:
    """Without them a run from the file would learn what masks hide, and the test photos."""
    mask = np.full((30, 40), 255, np.uint8)
    mask[:, :9] = 0
    write_png(garden / "masks" / f"{NAMES[3]}.png", mask)
    clsplat("cameras", garden, tmp_path / "one" / "transforms.json")
    one = load_scene(tmp_path / "one")
    assert [view.mask is not None for view in one.views] == [name == NAMES[3] for name in NAMES]
    np.testing.assert_array_equal(one.views[3].mask, mask > 0)

    values = json.loads((tmp_path / "one" / "transforms.json").read_text())
    assert "test_filenames" not in values, "the scene holds out every eighth photo only if it is asked"
    files = [frame["file_path"] for frame in values["frames"]]
    lists = {"train_filenames": files[2:], "test_filenames": files[:2]}
    (tmp_path / "one" / "transforms.json").write_text(json.dumps(values | lists))
    clsplat("cameras", tmp_path / "one", tmp_path / "two" / "transforms.json")
    two = load_scene(tmp_path / "two")
    assert [Path(view.name).name for view in two.test] == NAMES[:2]
    assert [view.mask is not None for view in two.views] == [name == NAMES[3] for name in NAMES]


def test_cameras_of_a_transforms_file_are_those_of_its_scene(garden: Path, tmp_path: Path) -> None:
    """Two objects are in files of this ending: transforms.json has `frames`, a camera path has `camera_path`."""
    clsplat("cameras", garden, garden / "transforms.json")
    clsplat("cameras", garden / "transforms.json", tmp_path / "colmap")
    assert len(read_model(tmp_path / "colmap").photos) == len(NAMES)
    (tmp_path / "list.json").write_text("{}")
    assert "render_width" in error_of("cameras", tmp_path / "list.json", tmp_path / "other")
