"""Bars at the sides of photos are found and left out where the scene goes on behind them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_runner import SHORT, clsplat, run
from recorded_scenes import go_on_without_record, scene_and_warnings

from clsplat.errors import InputError
from clsplat.files.images import read_image, write_photo, write_png
from clsplat.scenes.bars import NO_BARS, Bars, find_bars
from clsplat.scenes.scene import Scene, load_scene, read_posed_images
from clsplat.scenes.without_data import bars_of

ROWS = 4  # of the 36 of a photo, above and below
LEFT_OUT = ROWS + 1  # with the row beside the bar
MESSAGE = "22% of the pixels are bars at the top and bottom of all photos, and points of the scene lie there"


def with_bars(folder: Path, copy: Path, color: int = 0, but: int | None = None) -> Path:
    """Return a copy of a scene whose photos have bars above and below, but for one of them."""
    shutil.copytree(folder, copy)
    for number, file in enumerate(sorted((copy / "images").iterdir())):
        pixels = read_image(file)[..., :3].copy()
        if number != but:
            pixels[:ROWS], pixels[-ROWS:] = color, color
        write_png(file, pixels)
    return copy


@pytest.fixture
def barred(capture_folder: Path, tmp_path: Path) -> Path:
    return with_bars(capture_folder, tmp_path / "barred")


def has_bars(scene: Scene, rows: int = LEFT_OUT) -> bool:
    """Return whether the pixels above and below are left out in all photos, and no others are."""
    masks = [view.mask for view in (*scene.train, *scene.test)]
    if all(mask is None for mask in masks):
        return False
    for mask in masks:
        assert mask is not None
        assert not mask[:rows].any()
        assert not mask[-rows:].any()
        assert mask[rows:-rows].all()
    return True


@pytest.mark.parametrize("color", [0, 90, 255])
def test_bars_are_left_out(capture_folder: Path, tmp_path: Path, color: int) -> None:
    scene, said = scene_and_warnings(with_bars(capture_folder, tmp_path / "barred", color))
    assert MESSAGE in said
    assert has_bars(scene)
    assert scene.reading["bars"] == pytest.approx([ROWS / 36, 0, ROWS / 36, 0])


def test_bars_at_the_left_and_right(capture_folder: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(capture_folder, tmp_path / "barred"))
    for file in (folder / "images").iterdir():
        pixels = read_image(file)[..., :3].copy()
        pixels[:, :5], pixels[:, -3:] = 16, 16
        write_png(file, pixels)
    scene, said = scene_and_warnings(folder)
    assert "bars at the right and left of all photos" in said
    mask = scene.train[0].mask
    assert mask is not None
    kept = np.zeros_like(mask)
    kept[:, 6:-4] = True
    np.testing.assert_array_equal(mask, kept)


def test_what_keeps_bars(barred: Path, capture_folder: Path, tmp_path: Path) -> None:
    for arguments in ({"masks": "none"}, {"bars": NO_BARS}):
        scene, said = scene_and_warnings(barred, **arguments)
        assert MESSAGE not in said
        assert not has_bars(scene)
        assert scene.reading["bars"] == list(NO_BARS)
    one_without = with_bars(capture_folder, tmp_path / "one", but=3)
    assert not has_bars(scene_and_warnings(one_without)[0]), "a photo has none: the scene is dark there"
    usual, said = scene_and_warnings(capture_folder)
    assert usual.reading["bars"] == list(NO_BARS)
    assert "bars" not in said


def test_an_object_before_one_colour_has_no_bars(barred: Path) -> None:
    """Its points lie on the object alone."""
    posed = read_posed_images(barred, None)
    middle = np.median(posed.points.xyz, axis=0)
    near = replace(posed.points, xyz=middle + 0.01 * (posed.points.xyz - middle))
    with pytest.warns(UserWarning, match=MESSAGE):
        assert bars_of(barred, posed, {}) != NO_BARS
    assert bars_of(barred, replace(posed, points=near), {}) == NO_BARS


def test_masks_that_hide_the_bars_are_enough(barred: Path) -> None:
    (barred / "masks").mkdir()
    for file in (barred / "images").iterdir():
        mask = np.full((36, read_image(file).shape[1], 3), 255, np.uint8)
        mask[:ROWS], mask[-ROWS:] = 0, 0
        write_png(barred / "masks" / f"{file.name}.png", mask)
    scene, said = scene_and_warnings(barred)
    assert MESSAGE not in said
    assert has_bars(scene, ROWS)
    assert scene.reading["bars"] == list(NO_BARS)
    for file in (barred / "masks").iterdir():
        mask = np.full((36, read_image(file).shape[1], 3), 255, np.uint8)
        mask[10:14] = 0
        write_png(file, mask)
    scene, said = scene_and_warnings(barred)
    assert MESSAGE in said, "these masks hide other pixels"
    assert scene.train[0].mask is not None
    assert not scene.train[0].mask[[*range(LEFT_OUT), *range(10, 14)]].any()


def test_a_part_of_a_scene_and_smaller_photos_are_read_as_the_whole(barred: Path) -> None:
    names = load_scene(barred, bars=NO_BARS).names
    part, _ = scene_and_warnings(barred, only=[names[3]])
    assert len(part.views) == 1
    assert has_bars(part)
    small, _ = scene_and_warnings(barred, resolution=2)
    mask = small.train[0].mask
    assert mask is not None
    assert not mask[[0, 1, -2, -1]].any()
    assert mask[3:-3].all()


def test_photos_of_another_size_are_not_touched(barred: Path) -> None:
    bars = load_scene(barred).reading["bars"]
    file = sorted((barred / "images").iterdir())[1]
    pixels = read_image(file)
    write_png(file, np.repeat(np.repeat(pixels, 2, axis=0), 2, axis=1))
    scene, said = scene_and_warnings(barred)
    assert MESSAGE in said
    assert scene.reading["bars"] == bars
    assert {view.name for view in scene.views if view.mask is None} == {file.name}


def test_jpeg_bars(barred: Path, tmp_path: Path) -> None:
    files = []
    for number, file in enumerate(sorted((barred / "images").iterdir())):
        files.append(tmp_path / f"{number}.jpg")
        large = np.repeat(np.repeat(read_image(file), 5, axis=0), 5, axis=1)
        write_photo(files[-1], large)
    bars = find_bars(files)
    assert (bars.left, bars.right) == (0, 0)
    for share in (bars.top, bars.bottom):
        assert 0 <= share * 180 - 5 * ROWS <= 3, "blurred rows at the edge belong to neither"


def test_reading_ends_at_the_first_photo_without_bars(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (36, 48, 3)).astype(np.uint8)
    write_png(tmp_path / "a.png", noise)
    assert find_bars([tmp_path / "a.png", tmp_path / "missing.png"]) == NO_BARS
    with pytest.raises(InputError, match="missing"):
        find_bars([tmp_path / "missing.png"])
    assert find_bars([]) == NO_BARS


def test_a_sky_is_not_a_bar(tmp_path: Path) -> None:
    """It has one colour at the top of all photos, and ends in another row in each."""
    rng, files = np.random.default_rng(0), []
    for number in range(8):
        files.append(tmp_path / f"{number}.png")
        pixels = rng.integers(0, 200, (60, 48, 3)).astype(np.uint8)
        pixels[: 6 + 3 * number] = 255
        write_png(files[-1], pixels)
    assert find_bars(files) == NO_BARS
    assert find_bars(files[:2]).top > 0
    assert find_bars([files[0]] * 4 + [files[7]] * 3).top == pytest.approx(6 / 60), "a dark scene beside a bar"


def test_transparent_photos_have_no_bars(barred: Path) -> None:
    """What lies in their transparent pixels is a matter of `alpha`."""
    files = sorted((barred / "images").iterdir())
    assert find_bars(files) != NO_BARS
    for file in files:
        pixels = read_image(file)
        alpha = np.full(pixels.shape[:2], 255, np.uint8)
        alpha[:ROWS] = 0
        write_png(file, np.dstack([pixels, alpha]))
    assert find_bars(files) == NO_BARS


def test_few_photos_have_no_bars(barred: Path) -> None:
    names = load_scene(barred, bars=NO_BARS).names
    for name in names[5:]:
        (barred / "images" / name).unlink()
    scene, said = scene_and_warnings(barred)
    assert len(scene.views) == 5
    assert MESSAGE not in said


def test_the_pixels_that_bars_leave() -> None:
    kept = Bars(0.25, 0.0, 0.5, 0.1).uncovered(10, 8)
    assert kept.shape == (8, 10)
    assert kept[2:4, 1:].all()
    assert kept.sum() == 2 * 9


@pytest.mark.parametrize("bars", [(0.1, 0.1), (0.0, 0.0, 0.0, 1.5), (0.0, -0.1, 0.0, 0.0)])
def test_bars_that_cannot_be_are_named(barred: Path, bars: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match=r"bars .* give four parts from 0 to 1: top, right, bottom, left"):
        load_scene(barred, bars=bars)


def test_a_run_records_bars_and_goes_on_with_them(barred: Path, tmp_path: Path) -> None:
    model = tmp_path / "m"
    said = run("train", barred, "-m", model, "--eval", *SHORT)
    assert MESSAGE in said.stderr
    assert "are the same in all photos" not in said.output
    file = model / "config.json"
    values = json.loads(file.read_text())
    assert values["scene"]["bars"] == pytest.approx([ROWS / 36, 0, ROWS / 36, 0])
    said = run("eval", model)
    assert said.exit_code == 0, said.output
    assert MESSAGE not in said.stderr, "they are recorded"
    with_them = json.loads((model / "results.json").read_text())
    go_on_without_record(model, "bars", MESSAGE)  # as runs of earlier versions
    assert json.loads((model / "results.json").read_text()) != with_them


def test_blocks_have_the_bars_of_the_whole(barred: Path, tmp_path: Path) -> None:
    model = tmp_path / "m"
    clsplat("train", barred, "-m", model, "--eval", "--blocks", "2x1", "-q", *SHORT)
    assert has_bars(load_scene(barred, bars=json.loads((model / "config.json").read_text())["scene"]["bars"]))
