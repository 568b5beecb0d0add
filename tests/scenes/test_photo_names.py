"""COLMAP models and transforms files that name photos by absolute paths, or outside of the folder of photos."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from cli_runner import clsplat
from small_scene import HEIGHT, NAMES, WIDTH, as_text, photo_of, write_garden

from clsplat.errors import InputError
from clsplat.files.images import write_png
from clsplat.scenes.info import scene_info
from clsplat.scenes.photo_names import place_photos
from clsplat.scenes.scene import load_scene


def rename(root: Path, new_name: str) -> None:
    """Give the images of a scene's model other names; `{}` stands for the old name."""
    model = root / "sparse" / "0"
    as_text(model, root / "text")
    text = (root / "text" / "images.txt").read_text()
    for name in NAMES:
        text = text.replace(f" {name}\n", f" {new_name.format(name)}\n")
    (root / "text" / "images.txt").write_text(text)
    shutil.rmtree(model)
    (root / "text").rename(model)


@pytest.fixture
def garden(tmp_path: Path) -> Path:
    return write_garden(tmp_path)


def test_a_photo_with_an_absolute_name_is_not_its_own_mask(garden: Path) -> None:
    before = load_scene(garden)
    (garden / "masks").mkdir()
    rename(garden, f"{garden / 'images'}/{{}}")
    scene = load_scene(garden)
    assert scene.names == before.names == NAMES
    assert all(view.mask is None for view in scene.views)
    assert scene.test_names == before.test_names
    assert scene_info(garden).masked == 0
    hidden = np.full((HEIGHT, WIDTH), 255, np.uint8)
    hidden[:, :9] = 0
    write_png(garden / "masks" / f"{NAMES[2]}.png", hidden)
    masks = [view.mask for view in load_scene(garden).views]
    assert [index for index, mask in enumerate(masks) if mask is not None] == [2]


@pytest.mark.parametrize("folder", ["photos", "."])
def test_a_photo_in_the_folder_of_masks_is_not_its_own_mask(garden: Path, folder: str) -> None:
    (garden / "images").rename(garden / "photos")
    frames = [
        {"file_path": f"photos/{name}", "transform_matrix": np.eye(4).tolist(), "fl_x": 30.0 + index}
        for index, name in enumerate(NAMES)
    ]
    shutil.rmtree(garden / "sparse")
    (garden / "transforms.json").write_text(json.dumps({"frames": frames}))
    with pytest.raises(InputError, match="no mask of any photo in it"):
        load_scene(garden, masks=folder)
    frames[1]["mask_path"] = f"./photos/{NAMES[1]}"
    (garden / "transforms.json").write_text(json.dumps({"frames": frames}))
    with pytest.raises(InputError, match=r"frame 1: mask_path '\./photos/.*' is the photo itself; name a mask"):
        load_scene(garden)


@pytest.mark.parametrize("form", ["colmap", "transforms"])
def test_photos_outside_the_scene(garden: Path, tmp_path: Path, form: str) -> None:
    """The command `info` does not list the other photos of the folder that they lie in."""
    outside = tmp_path / "elsewhere" / "deep"
    outside.mkdir(parents=True)
    for name in NAMES:
        (garden / "images" / name).rename(outside / name)
    write_png(tmp_path / "elsewhere" / "private.png", photo_of(1))
    write_png(outside / "private.png", photo_of(1))
    if form == "colmap":
        rename(garden, "../../elsewhere/deep/{}")
    else:
        frames = [
            {"file_path": f"../elsewhere/deep/{name}", "transform_matrix": np.eye(4).tolist()} for name in NAMES[:4]
        ]
        shutil.rmtree(garden / "sparse")
        (garden / "transforms.json").write_text(json.dumps({"fl_x": 30.0, "frames": frames}))
    info = scene_info(garden)
    assert info.unregistered == ()
    assert "private" not in clsplat("info", garden)
    names = load_scene(garden).names
    assert names == (NAMES if form == "colmap" else NAMES[:4])


def test_info_lists_photos_without_a_pose_and_no_outputs(garden: Path) -> None:
    write_png(garden / "images" / "extra" / "z.png", photo_of(1))
    write_png(garden / "images" / "renders" / "z.png", photo_of(1), render=True)
    assert scene_info(garden).unregistered == ("extra/z.png",)


def test_models_of_another_computer(tmp_path: Path) -> None:
    """An absolute path that does not exist is found by its last parts."""
    write_png(tmp_path / "images" / "day" / "a.png", photo_of(0))
    write_png(tmp_path / "images" / "b.png", photo_of(1))
    folder = tmp_path / "images"
    stored = ["/home/her/images/day/a.png", r"C:\Users\her\images\b.png", "missing.png", "/nowhere/c.png"]
    placed = place_photos(folder, stored)
    assert placed[stored[0]] == ("day/a.png", folder / "day" / "a.png")
    assert placed[stored[1]] == ("b.png", folder / "b.png")
    assert placed[stored[2]] == ("missing.png", folder / "missing.png")
    assert placed[stored[3]] == ("c.png", Path("/nowhere/c.png"))


def test_names_with_the_slashes_of_windows_and_with_the_folder_of_the_photos(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    for index, name in enumerate(("day/a.png", "b.png", "images/c.png")):
        write_png(folder / name, photo_of(index))
    stored = [r"day\a.png", "images/b.png", "images/c.png", "other/b.png"]
    placed = place_photos(folder, stored)
    assert placed[stored[0]] == ("day/a.png", folder / "day" / "a.png")
    assert placed[stored[1]] == ("b.png", folder / "b.png")
    assert placed[stored[2]] == ("images/c.png", folder / "images" / "c.png"), "a file with the stored name comes first"
    assert not placed[stored[3]][1].exists(), "other folders are not left out"


@pytest.mark.parametrize("form", ["/home/her/data/images/{}", r"C:\data\images\{}", "/home/her/{}"])
def test_transforms_of_another_computer(garden: Path, form: str) -> None:
    shutil.rmtree(garden / "sparse")
    frames = [
        {"file_path": form.format(name.removesuffix(".png")), "transform_matrix": np.eye(4).tolist()} for name in NAMES
    ]
    for index, frame in enumerate(frames):
        frame["fl_x"] = 30.0 + index
    (garden / "transforms.json").write_text(json.dumps({"w": WIDTH, "h": HEIGHT, "frames": frames}))
    scene = load_scene(garden)
    assert scene.names == [f"images/{name}" for name in NAMES]
    assert [view.camera.fx for view in scene.views] == [30.0 + index for index in range(len(NAMES))]
    shutil.copytree(garden / "images", garden / "images_b")
    assert load_scene(garden, "images_b").names == [f"images_b/{name}" for name in NAMES]
    with pytest.raises(InputError, match=rf"images_c/{NAMES[0]}: no such image file"):
        load_scene(garden, "images_c")


def test_names_stay_unique(tmp_path: Path) -> None:
    placed = place_photos(tmp_path, ["/x/1/a.jpg", "/x/2/a.jpg", "b.jpg", "sub/../c.jpg"])
    assert [name for name, _ in placed.values()] == ["1/a.jpg", "2/a.jpg", "b.jpg", "c.jpg"]
    with pytest.raises(InputError, match=r"images 'a\.jpg' and '/x/a\.jpg' of the model are both called 'a\.jpg'"):
        place_photos(tmp_path, ["/x/a.jpg", "a.jpg"])


def test_a_link_that_leads_to_itself(garden: Path) -> None:
    photo = garden / "images" / NAMES[2]
    photo.unlink()
    photo.symlink_to(photo.name)
    assert list(scene_info(garden).left_out) == [NAMES[2]]


@pytest.mark.parametrize("name", ["1" * 300 + ".jpg", "a/" * 3000 + "b.jpg", "a\0b.jpg", "a\ud800.jpg"])
def test_a_name_that_no_file_can_have_is_one_line(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"is not the name of a photo: is it damaged\?") as found:
        place_photos(tmp_path, ["a.jpg", name])
    assert len(str(found.value)) < len(str(tmp_path)) + 150
