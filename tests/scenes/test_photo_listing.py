"""Which folders below photos are left out: what clsplat wrote there, and other scenes."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest
from small_scene import write_garden

from clsplat.errors import InputError
from clsplat.files.image_names import IMAGE_SUFFIXES
from clsplat.files.images import is_render, write_grey16, write_png
from clsplat.scenes import photo_listing, wrong_folder
from clsplat.scenes.photo_listing import has_images, is_posed, list_images
from clsplat.scenes.reconstruct.photo_files import find_photos, fingerprint, is_photographs, left_out_below

PIXELS = np.arange(8 * 6 * 3, dtype=np.uint8).reshape(6, 8, 3)


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Three photos, one of them in a subfolder."""
    for name in ("a.png", "b.png", "day/c.png"):
        write_png(tmp_path / "photos" / name, PIXELS)
    return tmp_path / "photos"


NAMES = ("a.png", "b.png", "day/c.png")


def write_record(folder: Path, name: str, values: object) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(json.dumps(values))


def test_a_reconstructed_scene_is_left_out(photos: Path) -> None:
    write_png(photos / "mine" / "images" / "a.png", PIXELS)
    before = fingerprint(photos)
    assert len(list_images(photos, IMAGE_SUFFIXES).names) == 4, "a folder called images alone is not a scene"
    (photos / "mine" / "sparse").mkdir()
    write_record(photos / "mine", "reconstruct.json", {})
    listing = list_images(photos, IMAGE_SUFFIXES)
    assert (listing.names, listing.outputs, listing.scenes) == (NAMES, ("mine",), ())
    assert fingerprint(photos) != before
    assert [photo.name for photo in find_photos(photos)] == list(NAMES)
    assert left_out_below(photos) == "mine"


@pytest.mark.parametrize("record", ["config.json", "budget.json"])
def test_a_model_is_left_out(photos: Path, record: str) -> None:
    write_png(photos / "day" / "m" / "rounds.png", PIXELS)
    write_record(photos / "day" / "m", record, {"config": {}, "scene": "no record of a scene"})
    assert "day/m/rounds.png" in list_images(photos, IMAGE_SUFFIXES).names
    write_record(photos / "day" / "m", record, {"config": {}, "scene": {}})
    assert list_images(photos, IMAGE_SUFFIXES).outputs == ("day/m",)
    (photos / "day" / "m" / record).write_text("damaged")
    assert list_images(photos, IMAGE_SUFFIXES).outputs == ()
    (photos / "day" / "m" / "point_cloud").mkdir()
    write_record(photos / "day" / "m", "cameras.json", [])
    assert list_images(photos, IMAGE_SUFFIXES).outputs == ("day/m",), "a model of 3DGS"


def test_a_comparison_is_left_out(photos: Path) -> None:
    write_png(photos / "c" / "chart.png", PIXELS)
    for name in ("runs.jsonl", "results.json"):
        assert list_images(photos, IMAGE_SUFFIXES).outputs == ()
        write_record(photos / "c", name, {})
    assert list_images(photos, IMAGE_SUFFIXES).outputs == ("c",)


def test_renders_are_left_out_beside_photos(photos: Path) -> None:
    write_png(photos / "r" / "0.png", PIXELS, render=True)
    write_grey16(photos / "r" / "0_depth.png", np.zeros((4, 5), np.uint16))
    assert is_render(photos / "r" / "0.png")
    assert not is_render(photos / "a.png")
    assert not is_render(photos / "none.png")
    listing = list_images(photos, IMAGE_SUFFIXES)
    assert (listing.names, listing.outputs) == (NAMES, ("2 renders",))
    assert list_images(photos / "r", IMAGE_SUFFIXES).names == ("0.png", "0_depth.png"), "asked for by name"


def test_other_scenes_are_left_out_beside_photos_and_refused_instead_of_photos(photos: Path) -> None:
    garden = write_garden(photos)
    assert is_posed(garden)
    assert not is_posed(photos)
    listing = list_images(photos, IMAGE_SUFFIXES)
    assert (listing.names, listing.outputs, listing.scenes) == (NAMES, (), ("garden",))
    assert len(find_photos(photos)) == 3
    for name in NAMES[:2]:
        (photos / name).unlink()
    with pytest.raises(InputError, match=r"photos: the subfolder garden is a scene: give .*photos/garden$"):
        find_photos(photos)


def test_masks_and_hidden_files_are_no_photos(photos: Path) -> None:
    """Masks are in the folder `masks` beside the photos. A subfolder of that name is one of the photos' folders."""
    for name in ("masks/a.png", ".cache/a.png", ".a.png", "day/masks/d.png"):
        write_png(photos / name, PIXELS)
    assert list_images(photos, IMAGE_SUFFIXES).names == ("a.png", "b.png", "day/c.png", "day/masks/d.png")


def test_folders_that_cannot_be_read_are_left_out_with_one_warning(
    photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Root reads everything, so the system's answer is a pretended one: of a folder, and of a file in another."""
    for name in ("closed", "locked"):
        (photos / name).mkdir()

    def of_user(path: Path) -> bool:
        if path.name == "closed":
            raise PermissionError(errno.EACCES, "Permission denied", str(path / "reconstruct.json"))
        return is_posed(path)

    def scan(path: str) -> object:
        if Path(path).name == "locked":
            raise PermissionError(errno.EACCES, "Permission denied", path)
        return listed(path)

    listed = os.scandir
    monkeypatch.setattr(photo_listing, "is_posed", of_user)
    monkeypatch.setattr(os, "scandir", scan)
    monkeypatch.setattr(wrong_folder, "is_posed", of_user)
    with pytest.warns(UserWarning, match="photos: 2 folders cannot be read and are left out, such as") as told:
        assert list_images(photos, IMAGE_SUFFIXES).names == NAMES
    assert len(told) == 1
    assert str(photos / "closed:") in str(told[0].message)
    assert wrong_folder.scenes_below(photos) == []


def test_the_first_photo_ends_the_search_for_one(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether a folder has photos does not depend on what else is in it."""
    looked: list[str] = []

    def looked_at(path: Path) -> bool:
        looked.append(path.name)
        return is_posed(path)

    monkeypatch.setattr(photo_listing, "is_posed", looked_at)
    assert is_photographs(photos)
    assert looked == []
    assert has_images(photos.parent, IMAGE_SUFFIXES)
    assert looked == ["photos"]


def test_the_search_for_a_photo_ends_after_many_folders(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Looking through a whole disk would take long."""
    for number in range(3):
        (photos.parent / "disk" / str(number) / "etc").mkdir(parents=True)
    photos.rename(photos.parent / "disk" / "photos")
    monkeypatch.setattr(photo_listing, "_MAX_FOLDERS", 8)
    assert has_images(photos.parent, IMAGE_SUFFIXES) is False
    monkeypatch.setattr(photo_listing, "_MAX_FOLDERS", 9)
    assert has_images(photos.parent, IMAGE_SUFFIXES) is True


def test_masks_and_renders_alone_are_found_as_they_are_listed(photos: Path) -> None:
    write_png(photos / "m" / "a.mask.png", PIXELS)
    write_png(photos / "r" / "0.png", PIXELS, render=True)
    (photos / "e").mkdir()
    for name in ("m", "r", "e"):
        folder = photos / name
        assert has_images(folder, IMAGE_SUFFIXES) == bool(list_images(folder, IMAGE_SUFFIXES).names) == (name != "e")
