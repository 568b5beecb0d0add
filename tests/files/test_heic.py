"""HEIC photos (extra `heic`): pixels, EXIF, and a scene of them."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from small_scene import photo_of

from clsplat.errors import InputError
from clsplat.files.images import image_size, is_whole, read_image, read_photo_header
from clsplat.scenes.reconstruct.photo_files import (
    StagedPhoto,
    find_photos,
    is_photographs,
    stage_photo,
    unsupported_photos,
)

pillow_heif = pytest.importorskip("pillow_heif")


def put(path: Path, pixels: np.ndarray, orientation: int = 1) -> Path:
    from PIL import Image

    pillow_heif.register_heif_opener()
    exif = Image.Exif()
    exif[0x0112], exif[0x010F], exif[0x0110] = orientation, "Maker", "Model"
    exif.get_ifd(0x8769).update({0x920A: 35.0, 0xA405: 35})
    Image.fromarray(pixels).save(path, quality=98, exif=exif)
    return path


def smooth(height: int = 48, width: int = 64) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.stack([3 * x, 4 * y, 255 - 2 * x], axis=2).astype(np.uint8)


def test_pixels_and_header(tmp_path: Path) -> None:
    path = put(tmp_path / "a.heic", smooth())
    assert image_size(path) == (64, 48)
    assert np.abs(read_image(path).astype(int) - smooth()).mean() < 2
    header = read_photo_header(path)
    assert (header.width, header.height, header.plain) == (64, 48, False)
    assert header.camera == ("Maker", "Model", "35.0", "35")
    assert not is_whole(path)


def test_the_orientation_is_applied_once(tmp_path: Path) -> None:
    """The library turns a photo by itself, and removes the orientation from its EXIF data."""
    path = put(tmp_path / "a.heic", smooth(), 6)
    header, upright = read_photo_header(path), read_image(path, upright=True)
    assert (header.width, header.height) == (upright.shape[1], upright.shape[0])
    np.testing.assert_array_equal(upright, read_image(path))


def test_photographs_of_a_phone(tmp_path: Path) -> None:
    folder, work, masks = tmp_path / "trip", tmp_path / "work", tmp_path / "masks"
    for path in (folder, work, masks):
        path.mkdir()
    for index in range(3):
        put(folder / f"IMG_{index}.HEIC", np.repeat(np.repeat(photo_of(index), 2, 0), 2, 1))
    assert is_photographs(folder)
    assert unsupported_photos(folder) == ""
    photos = find_photos(folder)
    assert [photo.name for photo in photos] == ["IMG_0.png", "IMG_1.png", "IMG_2.png"]
    staged = stage_photo(photos[0], 0, work, masks)
    assert isinstance(staged, StagedPhoto)
    assert np.abs(read_image(work / staged.staged).astype(int) - staged.pixels()).mean() < 3


def test_damaged_files_have_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.heic").write_bytes(struct.pack(">I", 24) + b"ftypheic" + bytes(500))
    data = put(tmp_path / "b.heic", smooth()).read_bytes()
    (tmp_path / "b.heic").write_bytes(data[: len(data) // 2])
    for name in ("a.heic", "b.heic"):
        with pytest.raises(InputError, match=rf"{name}: cannot be read as an image") as caught:
            read_image(tmp_path / name)
        assert "\n" not in str(caught.value)
