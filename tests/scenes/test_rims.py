"""Rims around all photos, as of fisheye lenses, are found and left out where the scene goes on behind them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_runner import SHORT, run
from recorded_scenes import go_on_without_record, scene_and_warnings

from clsplat.errors import InputError
from clsplat.files.images import read_image, write_png
from clsplat.scenes.bars import NO_BARS
from clsplat.scenes.rims import find_rim, rim_of
from clsplat.scenes.scene import Scene, load_scene, read_posed_images

MESSAGE = "% of the pixels are a rim of one colour around all photos, and points of the scene lie there"


def outside(height: int, width: int, radius: float, shift: float = 0.0) -> np.ndarray:
    """Return the pixels outside an ellipse, (height, width); a radius of 1 touches all four sides."""
    y, x = np.mgrid[:height, :width]
    across, down = (x + 0.5) / width * 2 - 1 - shift, (y + 0.5) / height * 2 - 1
    return np.asarray(across**2 + down**2 > radius**2)


def with_rim(folder: Path, copy: Path, radius: float = 1.0, color: int = 0, but: int | None = None) -> Path:
    """Return a copy of a scene whose photos have the rim of a fisheye lens, but for one of them."""
    shutil.copytree(folder, copy)
    for number, file in enumerate(sorted((copy / "images").iterdir())):
        pixels = read_image(file)[..., :3].copy()
        if number != but:
            pixels[outside(*pixels.shape[:2], radius)] = color
        write_png(file, pixels)
    return copy


@pytest.fixture
def circles(capture_folder: Path, tmp_path: Path) -> Path:
    return with_rim(capture_folder, tmp_path / "circles")


def has_rim(scene: Scene, radius: float = 1.0) -> bool:
    """Return whether the pixels outside an ellipse are left out in all photos, and those well inside are not."""
    masks = [view.mask for view in (*scene.train, *scene.test)]
    if all(mask is None for mask in masks):
        return False
    for mask in masks:
        assert mask is not None
        assert not mask[outside(*mask.shape, radius)].any()
        assert mask[~outside(*mask.shape, radius - 0.15)].all()
    return True


@pytest.mark.parametrize(("radius", "color"), [(1.0, 0), (1.2, 0), (0.75, 0), (1.0, 200)])
def test_rims_are_left_out(capture_folder: Path, tmp_path: Path, radius: float, color: int) -> None:
    scene, said = scene_and_warnings(with_rim(capture_folder, tmp_path / "circles", radius, color))
    assert MESSAGE in said
    assert has_rim(scene, radius)
    assert scene.reading["rim"] is True


def test_what_keeps_rims(circles: Path, capture_folder: Path, tmp_path: Path) -> None:
    for arguments in ({"masks": "none"}, {"rim": False}, {"bars": NO_BARS}):
        scene, said = scene_and_warnings(circles, **arguments)
        assert MESSAGE not in said
        assert not has_rim(scene)
        assert scene.reading["rim"] is False
    one_without = with_rim(capture_folder, tmp_path / "one", but=3)
    assert not has_rim(scene_and_warnings(one_without)[0]), "a photo has none"
    usual, said = scene_and_warnings(capture_folder)
    assert usual.reading["rim"] is False
    assert "rim" not in said


def test_an_object_before_one_colour_has_no_rim(circles: Path) -> None:
    """Its points lie on the object alone."""
    posed = read_posed_images(circles, None)
    middle = np.median(posed.points.xyz, axis=0)
    near = replace(posed.points, xyz=middle + 0.01 * (posed.points.xyz - middle))
    with pytest.warns(UserWarning, match=MESSAGE):
        assert rim_of(circles, posed, {}) is not None
    assert rim_of(circles, replace(posed, points=near), {}) is None
    assert rim_of(circles, replace(posed, points=near), {}, known=True) is not None


def test_outlines_that_differ_are_those_of_objects(tmp_path: Path) -> None:
    rng, files = np.random.default_rng(0), []
    for number in range(8):
        files.append(tmp_path / f"{number}.png")
        pixels = rng.integers(10, 256, (60, 48, 3)).astype(np.uint8)
        pixels[outside(60, 48, 0.6, 0.02 * number)] = 0
        write_png(files[-1], pixels)
    assert find_rim(files) is None
    assert find_rim(files[:2]) is not None


def test_dark_pixels_of_the_scene_are_kept(circles: Path) -> None:
    """They are not connected with a rim in all photos."""
    for file in (circles / "images").iterdir():
        pixels = read_image(file)
        pixels[16:20, 20:24] = 0
        write_png(file, pixels)
    scene, _ = scene_and_warnings(circles)
    assert has_rim(scene)


def test_masks_that_hide_the_rim_are_enough(circles: Path) -> None:
    (circles / "masks").mkdir()
    for file in (circles / "images").iterdir():
        pixels = read_image(file)
        pixels[...] = 255
        pixels[outside(*pixels.shape[:2], 1.0)] = 0
        write_png(circles / "masks" / f"{file.name}.png", pixels)
    scene, said = scene_and_warnings(circles)
    assert MESSAGE not in said
    assert scene.reading["rim"] is False


def test_a_part_of_a_scene_and_smaller_photos_are_read_as_the_whole(circles: Path) -> None:
    part, _ = scene_and_warnings(circles, only=[load_scene(circles, rim=False).names[3]])
    assert len(part.views) == 1
    assert has_rim(part)
    mask = scene_and_warnings(circles, resolution=2)[0].train[0].mask
    assert mask is not None
    assert not mask[[0, 0, -1, -1], [0, -1, 0, -1]].any()
    assert mask[~outside(*mask.shape, 0.8)].all()


def test_reading_ends_at_the_first_photo_without_a_rim(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", np.random.default_rng(0).integers(0, 256, (36, 48, 3)).astype(np.uint8))
    assert find_rim([tmp_path / "a.png", tmp_path / "missing.png"]) is None
    with pytest.raises(InputError, match="missing"):
        find_rim([tmp_path / "missing.png"])
    assert find_rim([]) is None


def test_large_photos_are_looked_at_in_fewer_pixels(circles: Path, tmp_path: Path) -> None:
    files = []
    for file in sorted((circles / "images").iterdir()):
        files.append(tmp_path / file.name)
        write_png(files[-1], np.repeat(np.repeat(read_image(file), 30, axis=0), 30, axis=1)[:-1])
    rim = find_rim(files)
    small = find_rim(sorted((circles / "images").iterdir()))
    assert rim is not None
    assert small is not None
    assert rim.shape == (30 * small.shape[0] - 1, 30 * small.shape[1])
    assert np.mean(rim != np.repeat(np.repeat(small, 30, axis=0), 30, axis=1)[:-1]) < 0.1


def test_a_run_records_the_rim_and_goes_on_with_it(circles: Path, tmp_path: Path) -> None:
    model = tmp_path / "m"
    said = run("train", circles, "-m", model, "--eval", *SHORT)
    assert MESSAGE in said.stderr
    assert "are the same in all photos" not in said.output
    assert "background is cut out" not in said.output
    assert json.loads((model / "config.json").read_text())["scene"]["rim"] is True
    said = run("eval", model)
    assert said.exit_code == 0, said.output
    assert MESSAGE not in said.stderr, "it is recorded"
    with_it = json.loads((model / "results.json").read_text())
    go_on_without_record(model, "rim", MESSAGE)  # as runs of earlier versions
    assert json.loads((model / "results.json").read_text()) != with_it
