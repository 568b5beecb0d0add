"""Masks: where they are found, how they follow their photos, and that hidden pixels do not affect training."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from small_scene import HEIGHT, N_VIEWS, NAMES, WIDTH, photo_of, write_garden

from clsplat.errors import InputError
from clsplat.files.images import read_image, write_png
from clsplat.files.masks import mask_files, read_mask, resize_mask
from clsplat.scenes.reconstruct.photo_files import find_photos, fingerprint
from clsplat.scenes.scene import load_scene
from clsplat.training.config import TrainConfig
from clsplat.training.trainer import Trainer


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A small scene."""
    return write_garden(tmp_path)


def left_half(width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.bool_]:
    """Return a mask whose left half counts."""
    return np.broadcast_to(np.arange(width) < width // 2, (height, width))


def write_mask(path: Path, mask: NDArray[np.bool_]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, np.uint8(255) * mask)


@pytest.mark.parametrize("form", ["{name}.png", "{stem}.png", "{stem}.mask.png"])
def test_masks_are_found_by_the_names_of_their_photos(folder: Path, form: str) -> None:
    name = NAMES[3]
    write_mask(folder / "masks" / form.format(name=name, stem=Path(name).stem), left_half())
    scene = load_scene(folder)
    for view in scene.views:
        if view.name == name:
            assert view.mask is not None
            np.testing.assert_array_equal(view.mask, left_half())
        else:
            assert view.mask is None
    assert all(view.mask is None for view in load_scene(folder, masks="none").views)


@pytest.mark.parametrize("form", ["{name}.mask.png", "{stem}.mask.png"])
def test_masks_beside_photos(folder: Path, form: str) -> None:
    """RealityScan writes them there."""
    masks = {name: folder / "images" / form.format(name=name, stem=Path(name).stem) for name in NAMES[3:5]}
    for mask in masks.values():
        write_mask(mask, left_half())
    photos = [photo.name for photo in find_photos(folder / "images")]
    assert photos == NAMES, "masks are no photos"
    assert [photo.mask for photo in find_photos(folder / "images")] == [masks.get(name) for name in NAMES]
    scene = load_scene(folder)
    assert scene.names == NAMES
    assert [view.name for view in scene.views if view.mask is not None] == NAMES[3:5]
    write_mask(folder / "masks" / f"{NAMES[3]}.png", ~left_half())
    found = {view.name: view.mask for view in load_scene(folder).views}
    np.testing.assert_array_equal(found[NAMES[3]], ~left_half(), "those in the folder come first")
    np.testing.assert_array_equal(found[NAMES[4]], left_half())
    assert all(view.mask is None for view in load_scene(folder, masks="none").views)


def test_a_photo_whose_name_ends_like_a_mask(tmp_path: Path) -> None:
    write_png(tmp_path / "a.mask.png", photo_of(0))
    assert [photo.name for photo in find_photos(tmp_path)] == ["a.mask.png"]


@pytest.mark.parametrize(
    ("stored", "counts"),
    [
        ([[0, 255], [127, 128]], [[0, 1], [0, 1]]),
        ([[0, 1], [1, 0]], [[0, 1], [1, 0]]),  # as numbers of classes
        ([[0, 38], [0, 0]], [[0, 1], [0, 0]]),  # a dark colour of a palette
        ([[1, 1], [1, 1]], [[1, 1], [1, 1]]),
        ([[0, 0], [0, 0]], [[0, 0], [0, 0]]),
        ([[60, 60], [60, 60]], [[0, 0], [0, 0]]),  # one grey alone says nothing
        ([[0, 20], [40, 60]], [[0, 0], [0, 0]]),  # a dark picture does not number classes
    ],
)
def test_values_that_count(tmp_path: Path, stored: list[list[int]], counts: list[list[int]]) -> None:
    file = tmp_path / "mask.png"
    write_png(file, np.array(stored, np.uint8))
    assert read_mask(file).tolist() == np.array(counts, bool).tolist()


def test_masks_in_folders_of_photos(tmp_path: Path) -> None:
    for file in ("a.jpg.png", "left/b.png"):
        write_mask(tmp_path / file, left_half())
    photos = {name: tmp_path / "photos" / name for name in ("a.jpg", "left/b.jpg", "right/b.jpg")}
    assert mask_files(tmp_path, photos) == {
        "a.jpg": tmp_path / "a.jpg.png",
        "left/b.jpg": tmp_path / "left/b.png",
    }


def test_masks_follow_the_size_of_the_photos(folder: Path) -> None:
    """The mask has twice the photo's size, and the photo is read at half its size."""
    write_mask(folder / "masks" / f"{NAMES[0]}.png", left_half(2 * WIDTH, 2 * HEIGHT))
    for resolution, size in ((1, (WIDTH, HEIGHT)), (2, (WIDTH // 2, HEIGHT // 2))):
        view = load_scene(folder, resolution=resolution).views[0]
        assert view.mask is not None
        np.testing.assert_array_equal(view.mask, left_half(*size))


def test_grey_becomes_black_or_white(tmp_path: Path) -> None:
    write_png(tmp_path / "grey.png", np.array([[0, 127, 128, 255]], np.uint8))
    np.testing.assert_array_equal(read_mask(tmp_path / "grey.png"), [[False, False, True, True]])


def test_nearest_pixel() -> None:
    mask = np.array([[True, False, False, True]])
    np.testing.assert_array_equal(resize_mask(mask, 8, 2), np.tile(np.repeat(mask, 2, axis=1), (2, 1)))
    np.testing.assert_array_equal(resize_mask(mask, 2, 1), [[False, True]])


@pytest.mark.parametrize(("old", "new"), [(9, 3), (4, 2), (3, 7), (5, 2), (100, 33)])
def test_a_resized_mask_shows_what_lies_at_the_centre_of_each_pixel(old: int, new: int) -> None:
    """Pixel i of the new mask has its centre at (i + 1/2) old / new, and old pixel j covers j to j + 1."""
    for place in range(old):
        mask = np.zeros((old, 2), bool)
        mask[place] = True
        expected = [place <= (2 * i + 1) * old / (2 * new) < place + 1 for i in range(new)]
        np.testing.assert_array_equal(resize_mask(mask, 2, new)[:, 0], expected)
        np.testing.assert_array_equal(resize_mask(mask.T, new, 2)[0], expected)


def test_a_white_mask_is_dropped_and_a_black_mask_leaves_the_photo_out(folder: Path) -> None:
    write_mask(folder / "masks" / f"{NAMES[0]}.png", np.ones((HEIGHT, WIDTH), bool))
    write_mask(folder / "masks" / f"{NAMES[1]}.png", np.zeros((HEIGHT, WIDTH), bool))
    with pytest.warns(
        UserWarning, match=rf"1 of {N_VIEWS} photos are left out .*{NAMES[1]}: its mask hides every pixel"
    ):
        scene = load_scene(folder)
    assert NAMES[1] not in scene.names
    assert scene.views[0].mask is None


def test_a_mask_may_hide_all_of_a_small_image(folder: Path) -> None:
    """A run begins with small images, in which one row of a photo may vanish. Such an image has no error."""
    scene = load_scene(folder)
    name = scene.train[0].name
    views = [
        replace(view.loaded(), mask=np.arange(HEIGHT)[:, None] == np.full((1, WIDTH), 0)) if view.name == name else view
        for view in scene.views
    ]
    trainer = Trainer(replace(scene, views=views), TrainConfig(iterations=40, cap_max=60, coarse_to_fine=False))
    masked = next(index for index, view in enumerate(trainer.targets.views) if view.name == name)
    target = trainer.targets.get(masked, 4)
    assert target.unmasked == 0
    frame_loss = trainer.loss.value_later(trainer.main.learn(target, (0.0, 0.0, 0.0), 0, 1)[1]).wait()
    assert (frame_loss.l1, frame_loss.mse) == pytest.approx((0.0, 0.0), abs=1e-7)
    assert frame_loss.ssim == pytest.approx(1.0, abs=1e-6)


def test_bad_masks_are_named(folder: Path) -> None:
    with pytest.raises(InputError, match=r"shades: no such folder of masks; .*'none'"):
        load_scene(folder, masks="shades")
    (folder / "shades").mkdir()
    with pytest.raises(InputError, match=rf"no mask of any photo in it; a mask of '{NAMES[0]}' is {NAMES[0]}.png"):
        load_scene(folder, masks="shades")
    write_mask(folder / "shades" / f"{NAMES[0]}.png", left_half(WIDTH, 3 * HEIGHT))
    with pytest.raises(InputError, match=rf"{NAMES[0]}.*its mask is {WIDTH}x{3 * HEIGHT} px"):
        load_scene(folder, masks="shades")
    (folder / "shades" / f"{NAMES[0]}.png").write_text("no image")
    with pytest.raises(InputError, match=rf"{NAMES[0]}.png: cannot be read as an image"):
        load_scene(folder, masks="shades")


def test_transparency_as_background_or_mask(folder: Path) -> None:
    file = folder / "images" / NAMES[0]
    rgb = photo_of(0)
    alpha = np.where(left_half(), 255, 51).astype(np.uint8)
    write_png(file, np.dstack([rgb, alpha]))
    over = load_scene(folder, background=(1.0, 0.0, 0.0), alpha="background").views[0]
    assert over.mask is None
    np.testing.assert_array_equal(over.alpha, alpha)
    laid_over = 0.2 * rgb + 0.8 * np.array([255, 0, 0])
    np.testing.assert_allclose(over.image, np.where(left_half()[:, :, None], rgb, laid_over), atol=0.51)
    hidden = load_scene(folder, alpha="mask").views[0]
    assert hidden.alpha is None
    np.testing.assert_array_equal(hidden.mask, left_half())
    np.testing.assert_array_equal(hidden.image, read_image(file)[:, :, :3])
    write_mask(folder / "masks" / f"{NAMES[0]}.png", np.arange(HEIGHT)[:, None] < np.full(WIDTH, HEIGHT // 2))
    both = load_scene(folder, alpha="mask").views[0]
    assert both.mask is not None
    np.testing.assert_array_equal(both.mask, left_half() & (np.arange(HEIGHT)[:, None] < HEIGHT // 2))
    with pytest.raises(InputError, match=r"alpha 'over': choose one of background, mask"):
        load_scene(folder, alpha="over")


def test_mask_path_of_a_frame(tmp_path: Path) -> None:
    """`mask_path` is nerfstudio's key."""
    write_png(tmp_path / "a.png", photo_of(0))
    write_mask(tmp_path / "hidden" / "whatever.png", left_half())
    frame = {"file_path": "a.png", "mask_path": "hidden/whatever.png", "transform_matrix": np.eye(4).tolist()}
    document = {"fl_x": 50.0, "frames": [frame]}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    view = load_scene(tmp_path, eval=False).views[0]
    assert view.mask is not None
    np.testing.assert_array_equal(view.mask, left_half())
    bad = {"nowhere.png": "mask_path 'nowhere.png' is not a file", 3: "mask_path 3 is not the name of a file"}
    for mask_path, message in bad.items():
        (tmp_path / "transforms.json").write_text(json.dumps(document | {"frames": [frame | {"mask_path": mask_path}]}))
        with pytest.raises(InputError, match=message):
            load_scene(tmp_path, eval=False)


def test_masks_with_names_that_are_not_quite_right_are_reported(folder: Path) -> None:
    """Masks of other photos, which a scene may lack, are no reason."""
    masks, (first, second, *others) = folder / "masks", NAMES
    for name in others:
        write_mask(masks / f"{name}.png", left_half())
    for name in (f"{Path(first).stem}.tif.png", f"{Path(second).stem}.jpg.mask.png", "of_another_photo.png"):
        write_mask(masks / name, left_half())
    with pytest.warns(UserWarning, match=rf"2 images in it are masks of no photo.*is {first}.png: rename them"):
        load_scene(folder)
    (masks / f"{Path(first).stem}.tif.png").rename(masks / f"{Path(first).stem}.PNG")
    (masks / f"{Path(second).stem}.jpg.mask.png").rename(masks / f"{second}.PNG")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert all(view.loaded().mask is not None for view in load_scene(folder).views)


def test_a_folder_of_masks_with_other_names_is_reported(folder: Path) -> None:
    for number in range(3):
        write_mask(folder / "masks" / f"mask{number}.png", left_half())
    with pytest.warns(UserWarning, match=r"3 images in it are masks of no photo, for example 'mask0.png'"):
        load_scene(folder)
    (folder / "masks").rename(folder / "images" / "masks")
    with pytest.warns(UserWarning, match=r"3 images in it are masks of no photo"):
        find_photos(folder / "images")


def test_the_fingerprint_of_photos_does_not_warn_again(folder: Path) -> None:
    write_mask(folder / "images" / "masks" / "other.png", left_half())
    with pytest.warns(UserWarning, match="masks of no photo"):
        find_photos(folder / "images")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        before = fingerprint(folder / "images")
        (folder / "images" / "masks" / "other.png").rename(folder / "images" / "masks" / f"{NAMES[0]}.png")
        assert fingerprint(folder / "images") != before, "masks belong to it"
