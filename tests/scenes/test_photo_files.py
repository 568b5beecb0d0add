"""Photos without poses: which files are found, how they are read, and which are refused."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from cli_runner import error_of
from PIL import Image

from clsplat.errors import InputError
from clsplat.files.digest import file_digest
from clsplat.files.image_names import READS_HEIC
from clsplat.files.images import read_image, read_photo_header, write_photo, write_png
from clsplat.scenes.reconstruct.photo_files import (
    PhotoFile,
    StagedPhoto,
    find_photos,
    fingerprint,
    group_by_camera,
    is_photographs,
    stage_photo,
    unsupported_photos,
)

ORIENTATION, MODEL = 0x0112, 0x0110
PICTURE = np.random.default_rng(0).integers(0, 256, (12, 20, 3)).astype(np.uint8)


def put(path: Path, pixels: np.ndarray = PICTURE, mode: str | None = None, **options: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(pixels)
    (image.convert(mode) if mode else image).save(path, **options)
    return path


def exif(orientation: int, model: str = "") -> Image.Exif:
    tags = Image.Exif()
    tags[ORIENTATION] = orientation
    if model:
        tags[MODEL] = model
    return tags


def staged(tmp_path: Path, photo: PhotoFile) -> StagedPhoto | str:
    for part in ("photos", "masks"):
        (tmp_path / "work" / part).mkdir(parents=True, exist_ok=True)
    return stage_photo(photo, 0, tmp_path / "work" / "photos", tmp_path / "work" / "masks")


# --- finding -------------------------------------------------------------------------------


def test_photos_are_found_in_subfolders_without_hidden_files_and_masks(tmp_path: Path) -> None:
    for name in ("b.JPG", "a.png", "day/2.tif", "day/1.jpg", ".hidden/x.png", ".y.png", "masks/a.png"):
        put(tmp_path / name)
    (tmp_path / "notes.txt").write_text("no photo")
    photos = find_photos(tmp_path)
    assert [photo.name for photo in photos] == ["a.png", "b.JPG", "day/1.jpg", "day/2.png"]
    assert [photo.mask for photo in photos] == [tmp_path / "masks" / "a.png", None, None, None]
    assert is_photographs(tmp_path)


def test_images_folder_and_its_masks(tmp_path: Path) -> None:
    put(tmp_path / "images" / "a.png")
    put(tmp_path / "cover.png")
    put(tmp_path / "masks" / "a.png.png")
    (photo,) = find_photos(tmp_path)
    assert (photo.file, photo.mask) == (tmp_path / "images" / "a.png", tmp_path / "masks" / "a.png.png")
    (tmp_path / "sparse").mkdir()
    assert not is_photographs(tmp_path)


@pytest.mark.parametrize("folder", ["images", "corrected_images"])
def test_raw_data_of_polycam_has_photos_in_one_folder(tmp_path: Path, folder: str) -> None:
    """Depth, confidence and photos before their correction are no photos of their own."""
    for name in {"depth", "confidence", "images", folder}:
        write_png(tmp_path / "keyframes" / name / "1.png", np.zeros((4, 4, 3)))
    assert is_photographs(tmp_path)
    assert [photo.file for photo in find_photos(tmp_path)] == [tmp_path / "keyframes" / folder / "1.png"]


def test_scene_names_stay_unique(tmp_path: Path) -> None:
    for name in ("a.png", "a.tif", "a.bmp", "b.webp"):
        put(tmp_path / name)
    assert sorted(photo.name for photo in find_photos(tmp_path)) == ["a.bmp.png", "a.png", "a.tif.png", "b.png"]


def test_folders_without_photos(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        find_photos(tmp_path / "absent")
    with pytest.raises(InputError, match=r"no photos in this folder or below; looked for \.avif, \.bmp"):
        find_photos(tmp_path)
    assert not is_photographs(tmp_path)
    for name in ("b.cr2", "b.NEF"):
        (tmp_path / name).write_bytes(b"raw")
    text = "2 files .cr2, .nef: convert them to JPEG, for example with darktable-cli"
    with pytest.raises(InputError, match=f"no photos in this folder or below; {text}"):
        find_photos(tmp_path)
    assert unsupported_photos(tmp_path) == text
    assert is_photographs(tmp_path)
    assert text in error_of("train", tmp_path, "-m", tmp_path / "m")
    assert text in error_of("reconstruct", tmp_path, "-o", tmp_path / "s")
    if READS_HEIC:
        return
    (tmp_path / "IMG_1.HEIC").write_bytes(b"heic")
    text = "3 files .cr2, .heic, .nef: convert them to JPEG, for example with darktable-cli or heif-convert"
    assert unsupported_photos(tmp_path) == f"{text}; or pip install 'clsplat[heic]'"


def test_names_that_a_model_cannot_store(tmp_path: Path) -> None:
    try:
        (tmp_path / os.fsdecode(b"\xff.png")).write_bytes(b"")
    except OSError:
        pytest.skip("this file system takes UTF-8 names only")
    with pytest.raises(InputError, match=r"udcff.*rename the photo"):
        find_photos(tmp_path)


def test_fingerprint_follows_every_change_of_contents(tmp_path: Path) -> None:
    home = tmp_path / "first"
    for name in ("a.png", "b.bmp"):
        put(home / name)
    marks = [fingerprint(home)]
    os.utime(home / "a.png", ns=(1, 1))
    home = home.rename(tmp_path / "second")
    assert fingerprint(home) == marks[0], "times and places do not count"
    size = (home / "b.bmp").stat().st_size
    put(home / "b.bmp", 255 - PICTURE)
    assert (home / "b.bmp").stat().st_size == size
    marks.append(fingerprint(home))
    put(home / "masks" / "a.png")
    marks.append(fingerprint(home))
    (home / "a.png").rename(home / "c.png")
    marks.append(fingerprint(home))
    (home / "b.bmp").unlink()
    (home / "b.bmp").symlink_to(home / "nowhere.png")
    marks.append(fingerprint(home))
    assert len(set(marks)) == 5


def test_digest_reads_the_start_the_middle_and_the_end(tmp_path: Path) -> None:
    file, data = tmp_path / "large", bytearray(1_000_000)
    marks = set()
    for place in (None, 0, 500_001, 999_999):
        changed = bytearray(data)
        if place is not None:
            changed[place] = 1
        file.write_bytes(changed)
        marks.add(file_digest(file))
    file.write_bytes(data + b"\0")
    marks.add(file_digest(file))
    marks.add(file_digest(file, file))
    assert len(marks) == 6


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes")
def test_a_pipe_is_never_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.png")
    put(tmp_path / "b.png")
    assert [photo.name for photo in find_photos(tmp_path)] == ["a.png", "b.png"]
    assert len(fingerprint(tmp_path)) == 64
    assert "a.png: is not a regular file" in str(staged(tmp_path, PhotoFile("a.png", tmp_path / "a.png")))


# --- reading -------------------------------------------------------------------------------


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_are_turned_upright(tmp_path: Path, orientation: int) -> None:
    """The stored image is the upright image, turned back by EXIF's table of orientations."""
    back = {
        1: lambda a: a,
        2: lambda a: a[:, ::-1],
        3: lambda a: a[::-1, ::-1],
        4: lambda a: a[::-1],
        5: lambda a: a.swapaxes(0, 1),
        6: lambda a: np.rot90(a, 1),
        7: lambda a: np.rot90(a, 2).swapaxes(0, 1),
        8: lambda a: np.rot90(a, -1),
    }[orientation]
    file = put(tmp_path / "a.png", np.ascontiguousarray(back(PICTURE)), exif=exif(orientation, "Phone"))
    np.testing.assert_array_equal(read_image(file, upright=True), PICTURE)
    facts = read_photo_header(file)
    assert (facts.width, facts.height, facts.plain, facts.camera) == (20, 12, orientation == 1, ("Phone",))
    ready = staged(tmp_path, PhotoFile("a.png", file))
    assert isinstance(ready, StagedPhoto)
    with Image.open(tmp_path / "work" / "photos" / ready.staged) as image:
        assert (image.size, image.getexif().get(ORIENTATION, 1), image.getexif()[MODEL]) == ((20, 12), 1, "Phone")


def test_plain_photos_are_linked(tmp_path: Path) -> None:
    file = put(tmp_path / "a.jpg", quality=50)
    ready = staged(tmp_path, PhotoFile("a.jpg", file))
    assert isinstance(ready, StagedPhoto)
    assert (tmp_path / "work" / "photos" / ready.staged).read_bytes() == file.read_bytes()


def png16(pixels: np.ndarray) -> bytes:
    """Return a 16-bit PNG of (H, W, 1 to 4); Pillow does not write such PNG in colour."""
    height, width, channels = pixels.shape
    lines = b"".join(b"\0" + line.astype(">u2").tobytes() for line in pixels)
    header = struct.pack(">IIBBBBB", width, height, 16, (0, 4, 2, 6)[channels - 1], 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(lines)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_sixteen_bits_become_eight(tmp_path: Path, channels: int) -> None:
    deep = np.random.default_rng(1).integers(0, 1 << 16, (5, 7, channels)).astype(np.uint16)
    (tmp_path / "deep.png").write_bytes(png16(deep))
    assert not read_photo_header(tmp_path / "deep.png").plain
    pixels = read_image(tmp_path / "deep.png").astype(float)
    assert pixels.shape == (5, 7, 4 if channels in (2, 4) else 3)
    expected = deep if channels > 2 else np.repeat(deep[:, :, :1], 3, axis=2)
    assert np.abs(pixels[:, :, :3] - expected[:, :, :3] / 257).max() <= 1.0
    if channels in (2, 4):
        assert np.abs(pixels[:, :, 3] - deep[:, :, -1] / 257).max() <= 1.0


@pytest.mark.parametrize(("name", "mode"), [("a.jpg", "CMYK"), ("a.jpg", "L"), ("a.png", "P"), ("a.tif", "RGB")])
def test_other_kinds_are_read(tmp_path: Path, name: str, mode: str) -> None:
    smooth = np.repeat(np.linspace(0, 255, 20)[None, :, None], 12, axis=0).repeat(3, axis=2).astype(np.uint8)
    file = put(tmp_path / name, smooth, mode)
    ready = staged(tmp_path, PhotoFile(name, file))
    assert isinstance(ready, StagedPhoto)
    pixels = read_image(tmp_path / "work" / "photos" / ready.staged).astype(float)
    with Image.open(file) as image:
        assert np.abs(pixels - np.asarray(image.convert("RGB"))).mean() < 4


def test_mpo_gives_its_first_picture(tmp_path: Path) -> None:
    first, second = Image.new("RGB", (20, 12), (200, 10, 10)), Image.new("RGB", (20, 12), (10, 10, 200))
    first.save(tmp_path / "a.jpg", format="MPO", save_all=True, append_images=[second])
    assert not read_photo_header(tmp_path / "a.jpg").plain
    assert read_image(tmp_path / "a.jpg")[0, 0, 0] > 190


@pytest.mark.parametrize("damage", ["empty", "cut", "text"])
def test_unreadable_photos_are_named(tmp_path: Path, damage: str) -> None:
    file = put(tmp_path / "broken.png", np.random.default_rng(0).integers(0, 256, (90, 90, 3)).astype(np.uint8))
    whole = file.read_bytes()
    file.write_bytes({"empty": b"", "cut": whole[: len(whole) // 2], "text": b"hello"}[damage])
    reason = staged(tmp_path, PhotoFile("broken.png", file))
    assert isinstance(reason, str)
    assert "broken.png" in reason
    assert "\n" not in reason


def test_transparency_and_masks_hide_pixels_from_features(tmp_path: Path) -> None:
    alpha = np.zeros((12, 20, 1), np.uint8)
    alpha[:, :10] = 255
    file = put(tmp_path / "a.png", np.dstack([PICTURE, alpha]))
    mask = put(tmp_path / "m.png", np.repeat([[0] * 5 + [255] * 15], 12, axis=0).astype(np.uint8))
    ready = staged(tmp_path, PhotoFile("a.png", file, mask))
    assert isinstance(ready, StagedPhoto)
    handed = read_image(tmp_path / "work" / "masks" / f"{ready.staged}.png")[:, :, 0]
    np.testing.assert_array_equal(handed, np.repeat([[0] * 5 + [255] * 5 + [0] * 10], 12, axis=0))
    black = put(tmp_path / "black.png", np.zeros((12, 20), np.uint8))
    assert staged(tmp_path, PhotoFile("a.png", file, black)) == f"{file}: its mask {black} hides every pixel"
    clear = put(tmp_path / "clear.png", np.dstack([PICTURE, np.zeros((12, 20, 1), np.uint8)]))
    assert staged(tmp_path, PhotoFile("clear.png", clear)) == f"{clear}: every pixel is transparent"
    wrong = put(tmp_path / "w.png", PICTURE.swapaxes(0, 1))
    reason = staged(tmp_path, PhotoFile("a.png", file, wrong))
    assert isinstance(reason, str)
    assert "w.png: is 12x20 px, the photo a.png 20x12" in reason


def test_photos_of_one_size_and_camera_share_a_lens(tmp_path: Path) -> None:
    files = [
        put(tmp_path / "1.jpg", exif=exif(1, "A")),
        put(tmp_path / "2.jpg", exif=exif(1, "A")),
        put(tmp_path / "3.jpg", exif=exif(1, "B")),
        put(tmp_path / "d" / "4.jpg", PICTURE[:8], exif=exif(1, "A")),
    ]
    ready = [
        StagedPhoto(PhotoFile(str(file.relative_to(tmp_path)), file), read_photo_header(file), f"{number}.jpg")
        for number, file in enumerate(files)
    ]

    def grouped(mode: str) -> list[list[str]]:
        return [[photo.staged for photo in group] for group in group_by_camera(ready, mode)]

    assert grouped("auto") == [["0.jpg", "1.jpg"], ["2.jpg"], ["3.jpg"]]
    assert grouped("per-image") == [["0.jpg"], ["1.jpg"], ["2.jpg"], ["3.jpg"]]
    assert grouped("per-folder") == [["0.jpg", "1.jpg", "2.jpg"], ["3.jpg"]]
    with pytest.raises(InputError, match=r"4\.jpg: is 20x8 px, 1\.jpg 20x12"):
        grouped("single")


def test_written_photos(tmp_path: Path) -> None:
    smooth = np.tile(np.arange(0, 240, 12, np.uint8)[None, :, None], (12, 1, 3))
    write_photo(tmp_path / "a.jpg", smooth)
    write_photo(tmp_path / "a.png", smooth)
    assert np.abs(read_image(tmp_path / "a.jpg").astype(int) - smooth).max() <= 3
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), smooth)
