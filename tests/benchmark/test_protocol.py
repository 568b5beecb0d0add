"""Scenes of a set: how they are found and read, and what is said where they differ from the published protocol."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from set_folders import as_blender, as_colmap, as_llff

from clsplat.benchmark.protocol import find_scenes
from clsplat.benchmark.sets import benchmark_set
from clsplat.errors import InputError
from clsplat.files.images import read_image, write_png
from clsplat.scenes.scene import load_scene
from clsplat.splats.color import BLACK, WHITE

TANKS, M360 = benchmark_set("tanks"), benchmark_set("mipnerf360")
SYNTHETIC, LLFF = benchmark_set("nerf-synthetic"), benchmark_set("llff")


def test_scenes_are_found_by_name_in_the_order_of_the_set(capture_folder: Path, tmp_path: Path) -> None:
    for name in ("Train", "other", "truck"):
        as_colmap(capture_folder, tmp_path / name)
    found = find_scenes(TANKS, tmp_path)
    assert [(each.scene.name, each.path.name) for each in found] == [("truck", "truck"), ("train", "Train")]
    (one,) = find_scenes(TANKS, tmp_path / "truck")
    assert one.path == tmp_path / "truck"
    assert one.identity == {"name": "truck", "width": 48, "height": 36, "train": 8, "test": 2}
    assert list(one.differences) == ["48x36 px, not 979x546", "8 training views, not 219", "2 test views, not 32"]


def test_a_link_gives_a_scene_its_name(capture_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "truck").symlink_to(capture_folder)
    (found,) = find_scenes(TANKS, tmp_path)
    loaded = found.load(BLACK)
    assert loaded.name == "truck"
    assert [view.name for view in loaded.test] == ["view_000.png", "view_008.png"]


def test_masks_are_not_part_of_a_protocol(capture_folder: Path, tmp_path: Path) -> None:
    scene = as_colmap(capture_folder, tmp_path / "truck")
    mask = np.full((36, 48), 255, np.uint8)
    mask[:9] = 0
    write_png(scene / "masks" / "view_000.png.png", mask)
    assert any(view.mask is not None for view in load_scene(scene).views)
    (found,) = find_scenes(TANKS, tmp_path)
    assert all(view.mask is None for view in found.load(BLACK).views)


def test_no_scene_of_the_set(capture_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none: no such folder: name the folder with the scenes of Tanks"):
        find_scenes(TANKS, tmp_path / "none")
    with pytest.raises(InputError, match=r"no scene of Tanks and Temples in it: expected folders called truck, train$"):
        find_scenes(TANKS, tmp_path)
    (tmp_path / "truck").mkdir()
    with pytest.raises(InputError, match="in it; truck is there, but it has no folder sparse: expected folders called"):
        find_scenes(TANKS, tmp_path)
    as_colmap(capture_folder, tmp_path / "train")
    with pytest.warns(UserWarning, match="truck: left out: it has no folder sparse"):
        assert len(find_scenes(TANKS, tmp_path)) == 1


def test_photos_that_the_set_reduces(capture_folder: Path, tmp_path: Path) -> None:
    as_colmap(capture_folder, tmp_path / "garden", "images_4")
    (found,) = find_scenes(M360, tmp_path)
    assert (found.images, found.resolution) == ("images_4", -1)
    shutil.rmtree(tmp_path / "garden" / "images_4")
    with pytest.raises(InputError) as refused:
        find_scenes(M360, tmp_path)
    message = refused.value.for_command({"-i"})
    assert (
        f"{tmp_path / 'garden' / 'images_4'}: no such folder of photos: copy the folder of the set there or" in message
    )
    assert "(-i images)" in message
    (found,) = find_scenes(M360, tmp_path, "images")
    assert (found.images, found.resolution) == ("images", 4)
    assert found.differences[:3] == (
        "photos of images, not of images_4",
        "photos reduced here by 4",
        "12x9 px, not 1297x840",
    )
    (found,) = find_scenes(M360, tmp_path, "images", 24)
    assert (found.identity["width"], found.load(BLACK).views[0].image.shape) == (24, (18, 24, 3))
    with pytest.raises(InputError, match="images_8: no such folder"):
        find_scenes(M360, tmp_path, "images_8")


def test_a_blender_scene_has_its_files_and_its_background(capture_folder: Path, tmp_path: Path) -> None:
    scene = as_blender(capture_folder, tmp_path / "lego")
    shutil.copytree(capture_folder / "sparse", scene / "sparse")  # a COLMAP model must not come first
    (found,) = find_scenes(SYNTHETIC, tmp_path)
    assert (found.identity["train"], found.identity["test"]) == (7, 3)
    assert "3 test views, not 200" in found.differences
    for background, value in ((WHITE, 255), (BLACK, 0)):
        views = found.load(background).views
        assert all((view.image[:8, :8] == value).all() for view in views)
    with pytest.raises(InputError, match="images 'test': the scenes of NeRF-synthetic have one size of photos"):
        find_scenes(SYNTHETIC, tmp_path, "test")
    (scene / "transforms_test.json").unlink()
    with pytest.raises(InputError, match=r"lego: no transforms_test.json: copy the test views of NeRF-synthetic there"):
        find_scenes(SYNTHETIC, tmp_path)


def test_llff_numbers_its_reduced_photos(capture_folder: Path, tmp_path: Path) -> None:
    scene = as_llff(capture_folder, tmp_path / "fern")
    (found,) = find_scenes(LLFF, tmp_path)
    loaded = found.load(BLACK)
    assert loaded.names == [f"view_{number:03d}.png" for number in range(10)]
    for number, view in enumerate(loaded.views):
        assert (view.image == read_image(scene / "images" / f"view_{number:03d}.png")).all()
    shutil.move(scene / "images_4", scene / "images_8")
    (found,) = find_scenes(LLFF, tmp_path)
    assert found.images == "images_8"
    assert found.differences[0] == "photos of images_8, not of images_4"
