"""Photos that fit their cameras only if their EXIF orientation is applied are read upright, in all places alike."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from recorded_scenes import scene_and_warnings

from clsplat.errors import InputError
from clsplat.files.images import read_image, write_png
from clsplat.scenes.info import scene_info
from clsplat.scenes.scene import load_scene

BACK: Mapping[int, Callable[[np.ndarray], np.ndarray]] = {  # from upright pixels to the stored ones
    3: lambda pixels: np.rot90(pixels, 2),
    6: lambda pixels: np.rot90(pixels, 1),
    8: lambda pixels: np.rot90(pixels, -1),
}
ROWS = 4  # of a bar


def turned(folder: Path, copy: Path, orientations: Mapping[int, int], bars: bool = False, alpha: bool = False) -> Path:
    """Return a copy of a scene with photos stored turned, by number; with bars above and below, or a transparent hole.

    Only the turned photos have a hole.
    """
    shutil.copytree(folder, copy)
    for number, file in enumerate(sorted((copy / "images").iterdir())):
        pixels = read_image(file)[..., :3].copy()
        if bars:
            pixels[:ROWS], pixels[-ROWS:] = 0, 0
        if alpha and number in orientations:
            opacity = np.full(pixels.shape[:2], 255, np.uint8)
            opacity[: len(pixels) // 3] = 0
            pixels = np.dstack([pixels, opacity])
        exif = Image.Exif()
        if number in orientations:
            pixels = BACK[orientations[number]](pixels)
            exif[0x0112] = orientations[number]
        Image.fromarray(np.ascontiguousarray(pixels)).save(file, exif=exif)
    return copy


@pytest.mark.parametrize("orientation", [6, 8])
@pytest.mark.parametrize("n", [3, 10])
def test_turned_photos_are_read_upright(capture_folder: Path, tmp_path: Path, orientation: int, n: int) -> None:
    upright = load_scene(capture_folder)
    folder = turned(capture_folder, tmp_path / "turned", dict.fromkeys(range(n), orientation))
    scene, said = scene_and_warnings(folder)
    assert said == ""
    for view, other in zip(scene.views, upright.views, strict=True):
        np.testing.assert_array_equal(view.image, other.image)
        assert view.camera.width == other.camera.width
    first = upright.views[0].camera
    assert scene_info(folder).sizes == (((first.width, first.height), len(upright.views)),)
    reduced = load_scene(folder, resolution=2, only=[scene.names[0]]).views[0]
    np.testing.assert_array_equal(reduced.image, load_scene(capture_folder, resolution=2).views[0].image)


def test_photos_upside_down_are_turned_with_the_others(capture_folder: Path, tmp_path: Path) -> None:
    """They fit both ways. The other photos show that the program which found the poses turned them."""
    upright = load_scene(capture_folder).images
    for name, orientations, is_turned in (("both", {0: 6, 1: 3}, True), ("alone", {1: 3}, False)):
        image = load_scene(turned(capture_folder, tmp_path / name, orientations)).images[1]
        np.testing.assert_array_equal(image, upright[1] if is_turned else np.rot90(upright[1], 2))


def test_pixels_that_fit_as_stored_stay(capture_folder: Path, tmp_path: Path) -> None:
    """Some programs turn the pixels and leave the EXIF orientation as it was."""
    folder = turned(capture_folder, tmp_path / "kept", {})
    for file in (folder / "images").iterdir():
        exif = Image.Exif()
        exif[0x0112] = 6
        Image.fromarray(read_image(file)).save(file, exif=exif)
    for image, other in zip(load_scene(folder).images, load_scene(capture_folder).images, strict=True):
        np.testing.assert_array_equal(image, other)


def test_turned_pixels_without_an_orientation_are_refused(capture_folder: Path, tmp_path: Path) -> None:
    folder = turned(capture_folder, tmp_path / "bare", {})
    file = min((folder / "images").iterdir())
    write_png(file, np.ascontiguousarray(np.rot90(read_image(file))))
    with pytest.raises(InputError, match="whole, and turned as its poses are"):
        load_scene(folder)


def test_bars_and_holes_of_turned_photos_are_found(capture_folder: Path, tmp_path: Path) -> None:
    scene, said = scene_and_warnings(turned(capture_folder, tmp_path / "bars", {0: 6, 1: 8}, bars=True))
    assert "are bars at the top and bottom of all photos" in said
    for view in scene.views:
        mask = view.loaded().mask
        assert mask is not None
        assert not mask[:ROWS].any()
        assert mask[ROWS + 1 : -ROWS - 1].all()
    scene, said = scene_and_warnings(turned(capture_folder, tmp_path / "holes", {0: 6, 1: 8}, alpha=True))
    assert "2 of 10 photos have transparent parts (33% of their pixels)" in said
    mask = scene.views[0].loaded().mask
    assert mask is not None
    assert not mask[: len(mask) // 3].any()
    assert mask[len(mask) // 3 :].all()
