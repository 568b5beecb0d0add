"""Pixels that never change: found where the scene goes on, and left out automatically if they are transparent."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from cli_runner import SHORT, clsplat, error_of, run
from recorded_scenes import go_on_without_record, scene_and_warnings

from clsplat.files.images import read_image, write_png
from clsplat.scenes.scene import Scene, View, load_scene
from clsplat.scenes.still_pixels import still_pixels

ROWS = 4  # of the 36 of a photo, above and below
MESSAGE = "22% of the pixels are transparent in all photos, but points of the scene lie there"


@pytest.fixture
def rims(capture_folder: Path, tmp_path: Path) -> Path:
    """The small capture with rims without data in all photos."""
    folder = tmp_path / "rims"
    shutil.copytree(capture_folder, folder)
    for file in (folder / "images").iterdir():
        pixels = read_image(file)
        alpha = np.full(pixels.shape[:2], 255, np.uint8)
        alpha[:ROWS], alpha[-ROWS:] = 0, 0
        write_png(file, np.dstack([pixels[..., :3], alpha]))
    return folder


def test_rims_without_data_are_left_out(rims: Path) -> None:
    scene, said = scene_and_warnings(rims)
    assert MESSAGE in said
    assert scene.reading["alpha"] == "mask"
    for view in (*scene.train, *scene.test):
        assert view.mask is not None
        assert not view.mask[:ROWS].any()
        assert view.mask[ROWS:-ROWS].all()
        assert view.alpha is None
    for alpha in ("mask", "background"):
        scene, said = scene_and_warnings(rims, alpha=alpha)
        assert scene.reading["alpha"] == alpha
        assert MESSAGE not in said
        assert (scene.train[0].mask is None) == (alpha == "background")


def test_most_of_a_photo_may_be_a_rim(rims: Path) -> None:
    """As around the image circle of a fisheye lens. What the photos show has the same outline."""
    for file in (rims / "images").iterdir():
        pixels = read_image(file)
        pixels[:10, :, 3] = 0
        pixels[-10:, :, 3] = 0
        write_png(file, pixels)
    scene, said = scene_and_warnings(rims)
    assert "56% of the pixels are transparent in all photos, but points of the scene lie there" in said
    assert scene.reading["alpha"] == "mask"
    for number, file in enumerate(sorted((rims / "images").iterdir())):
        pixels = read_image(file)
        pixels[10 + number % 2 : -10 : 2, :, 3] = 0
        write_png(file, pixels)
    scene, said = scene_and_warnings(rims)
    assert "transparent in all photos" not in said, "a photo shows half of what all show"


def test_a_part_of_a_scene_is_read_as_the_whole(rims: Path) -> None:
    scene, _ = scene_and_warnings(rims, only=[load_scene(rims, alpha="mask").names[3]])
    assert len(scene.views) == 1
    assert scene.reading["alpha"] == "mask"


def test_photos_that_are_transparent_everywhere_count_as_opaque(rims: Path, tmp_path: Path) -> None:
    opaque = load_scene(rims, alpha="ignore")
    assert opaque.train[0].alpha is None
    assert opaque.train[0].mask is None
    for file in (rims / "images").iterdir():
        pixels = read_image(file)
        pixels[..., 3] = 0
        write_png(file, pixels)
    scene, said = scene_and_warnings(rims)
    assert "all pixels of all photos are transparent: their alpha channel says nothing, and is ignored" in said
    assert scene.reading["alpha"] == "ignore"
    assert all(np.array_equal(view.image, other.image) for view, other in zip(scene.train, opaque.train, strict=True))
    model = tmp_path / "m"
    clsplat("train", rims, "-m", model, "--eval", "-q", *SHORT)
    assert "all pixels of all photos" not in run("eval", model).stderr, "it is recorded"
    for file in (rims / "images").iterdir():
        pixels = read_image(file)
        pixels[10, 10, 3] = 200
        write_png(file, pixels)
    assert scene_and_warnings(rims)[0].reading["alpha"] == "background", "the photos show something"


def test_photos_of_an_object_stay_transparent(rims: Path) -> None:
    """Their silhouettes differ, or no points lie around them."""
    for number, file in enumerate(sorted((rims / "images").iterdir())):
        pixels = read_image(file)
        pixels[..., 3] = 255
        pixels[: 4 + number, :, 3] = 0
        pixels[:, : 14 - number, 3] = 0
        write_png(file, np.roll(pixels, 12 * number, axis=1))
    scene, said = scene_and_warnings(rims)
    assert scene.reading["alpha"] == "background"
    assert "transparent in all photos" not in said


def test_a_run_records_the_use_and_goes_on_with_it(rims: Path, tmp_path: Path) -> None:
    model = tmp_path / "m"
    said = run("train", rims, "-m", model, "--eval", *SHORT)
    assert MESSAGE in said.stderr
    assert json.loads((model / "config.json").read_text())["scene"]["alpha"] == "mask"
    assert MESSAGE not in run("eval", model).stderr, "it is recorded"
    assert "alpha=background" in error_of("train", rims, "-m", model, "--resume", "--alpha", "background")
    opaque = tmp_path / "b"
    clsplat("train", rims, "-m", opaque, "--eval", "--alpha", "background", "-q", *SHORT)
    assert json.loads((opaque / "config.json").read_text())["scene"]["alpha"] == "background"


def test_runs_of_earlier_versions_go_on_as_they_began(rims: Path, tmp_path: Path) -> None:
    """They recorded nothing for the default, which was the background."""
    model = tmp_path / "m"
    clsplat("train", rims, "-m", model, "--eval", "--alpha", "background", "-q", *SHORT)
    go_on_without_record(model, "alpha", MESSAGE)


def test_still_pixels_are_those_that_vary_by_noise_only(scene: Scene) -> None:
    rng = np.random.default_rng(0)
    views = []
    for view in scene.train:
        image = np.asarray(view.image).astype(int)
        image[:ROWS] = 100 + rng.integers(-2, 3, image[:ROWS].shape)
        image[-ROWS:] = 0
        views.append(View(view.name, view.camera, np.clip(image, 0, 255).astype(np.uint8)))
    still, is_empty, is_rim = still_pixels(views)
    assert not is_empty
    assert not is_rim
    assert still[:ROWS].all()
    assert still[-ROWS:].all()
    assert still[ROWS:-ROWS].mean() < 0.05
