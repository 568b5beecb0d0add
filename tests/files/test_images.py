"""Image files: exact round trips, conversions, filters, and one-line errors for damaged files."""

from __future__ import annotations

import re
import struct
import subprocess
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image
from scenes_data import scene_folder

from clsplat.errors import InputError, OutputError
from clsplat.files.image_names import READS_HEIC
from clsplat.files.images import image_size, read_image, resize_area, write_png

FIXTURE_OK = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
pixels = st.tuples(st.integers(1, 12), st.integers(1, 12), st.sampled_from([3, 4])).flatmap(
    lambda shape: arrays(np.uint8, shape)
)


@FIXTURE_OK
@given(image=pixels)
def test_png_round_trip_is_exact(tmp_path: Path, image: np.ndarray) -> None:
    write_png(tmp_path / "a.png", image)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), image)
    assert image_size(tmp_path / "a.png") == (image.shape[1], image.shape[0])
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


def test_write_rounds_and_clips(tmp_path: Path) -> None:
    values = np.array([[[-1.0, 0.0, 0.4 / 255], [0.6 / 255, 127.6 / 255, 1.0], [2.0, np.inf, -np.inf]]])
    write_png(tmp_path / "deep" / "a.png", values)
    assert read_image(tmp_path / "deep" / "a.png").tolist() == [[[0, 0, 0], [1, 128, 255], [255, 255, 0]]]


def test_write_refuses_nan_and_odd_shapes(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="NaN"):
        write_png(tmp_path / "a.png", np.full((2, 2, 3), np.nan))
    with pytest.raises(OutputError, match=r"\(2, 2, 5\)"):
        write_png(tmp_path / "a.png", np.zeros((2, 2, 5)))
    assert not (tmp_path / "a.png").exists()


def test_write_into_a_file_as_folder_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OutputError, match="cannot be written") as caught:
        write_png(tmp_path / "file" / "a.png", np.zeros((2, 2, 3)))
    assert "\n" not in str(caught.value)


def test_modes_become_rgb_or_rgba(tmp_path: Path) -> None:
    grey = np.array([[0, 128, 255]], dtype=np.uint8)
    Image.fromarray(grey).save(tmp_path / "grey.png")
    np.testing.assert_array_equal(read_image(tmp_path / "grey.png"), np.repeat(grey[:, :, None], 3, axis=2))
    Image.fromarray(np.array([[0, 128, 129, 65535]], dtype=np.uint16)).save(tmp_path / "deep.png")
    assert read_image(tmp_path / "deep.png")[0, :, 0].tolist() == [0, 0, 1, 255]
    Image.fromarray(np.array([[[7, 9]]], dtype=np.uint8), "LA").save(tmp_path / "la.png")
    assert read_image(tmp_path / "la.png").tolist() == [[[7, 7, 7, 9]]]
    palette = Image.fromarray(np.array([[0, 1]], dtype=np.uint8), "P")
    palette.putpalette([255, 0, 0, 0, 255, 0])
    palette.save(tmp_path / "palette.png", transparency=1)
    assert read_image(tmp_path / "palette.png").tolist() == [[[255, 0, 0, 255], [0, 255, 0, 0]]]
    Image.fromarray(np.zeros((2, 2), dtype=np.float32)).save(tmp_path / "real.tiff")
    with pytest.raises(InputError, match="float pixels"):
        read_image(tmp_path / "real.tiff")


def test_box_reduction_is_the_block_mean() -> None:
    image = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    mean = image.reshape(3, 2, 2, 4, 3).mean(axis=(1, 3))
    reduced = resize_area(image, 2, 3)
    assert reduced.shape == (3, 2, 3)
    assert np.abs(reduced - mean).max() <= 0.5


def test_transparent_pixels_do_not_colour_their_neighbours() -> None:
    image = np.zeros((2, 2, 4), dtype=np.uint8)
    image[0, 0] = (200, 100, 50, 255)
    image[1, 1] = (0, 0, 255, 0)
    red, green, blue, alpha = (int(v) for v in resize_area(image, 1, 1)[0, 0])
    assert abs(alpha - 64) <= 1
    assert max(abs(red - 200), abs(green - 100), abs(blue - 50)) <= 3


@settings(max_examples=40, deadline=None)
@given(image=pixels, width=st.integers(1, 20), height=st.integers(1, 20), level=st.integers(0, 255))
def test_resize_gives_the_size_and_keeps_constants(image: np.ndarray, width: int, height: int, level: int) -> None:
    assert resize_area(image, width, height).shape == (height, width, image.shape[2])
    flat = np.full_like(image[:, :, :3], level)
    assert (resize_area(flat, width, height) == level).all()


def test_resize_to_nothing_is_refused() -> None:
    with pytest.raises(InputError, match="0x3"):
        resize_area(np.zeros((2, 2, 3), dtype=np.uint8), 0, 3)


@pytest.mark.filterwarnings("ignore::UserWarning:PIL")  # Pillow may warn of damage
@pytest.mark.parametrize("kind", ["png", "jpg", "tiff", "webp", "bmp", "gif"])
def test_damaged_files_raise_input_error_only(tmp_path: Path, kind: str) -> None:
    rng = np.random.default_rng(3)
    good = tmp_path / f"good.{kind}"
    Image.fromarray(rng.integers(0, 256, (16, 16, 3), dtype=np.uint8)).save(good)
    data, bad = good.read_bytes(), tmp_path / f"bad.{kind}"
    for trial in range(40):
        damaged = bytearray(data[: int(rng.integers(0, len(data)))] if trial % 2 else data)
        for _ in range(3):
            if damaged:
                damaged[int(rng.integers(0, len(damaged)))] = int(rng.integers(0, 256))
        bad.write_bytes(damaged)
        message = f"{bad}"
        try:
            read_image(bad)
        except InputError as error:
            message = str(error)
        assert message.startswith(str(bad))
        assert "\n" not in message


def test_missing_empty_and_folder(tmp_path: Path) -> None:
    (tmp_path / "empty.png").write_bytes(b"")
    for name, what in (("none.png", "no such image"), ("empty.png", "not an image"), (".", "is a folder")):
        for reader in (read_image, image_size):
            with pytest.raises(InputError, match=what):
                reader(tmp_path / name)


@pytest.mark.data
def test_real_photo_and_transparent_render() -> None:
    photo = scene_folder("fox") / "images" / "0001.jpg"
    assert read_image(photo).shape == (713, 400, 3)
    assert image_size(photo) == (400, 713)
    assert read_image(scene_folder("lego") / "train" / "r_0.png").shape == (400, 400, 4)


def test_other_formats_start_no_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow reads EPS with Ghostscript, whatever the name of the file is."""
    head = "%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n%%EOF\n"
    (tmp_path / "a.jpg").write_text(head)
    monkeypatch.setattr(subprocess, "Popen", lambda *command, **options: pytest.fail("a program was started"))
    with pytest.raises(InputError, match=r"a\.jpg: cannot be read as an image \(not an image of a supported format\)"):
        image_size(tmp_path / "a.jpg")


@pytest.mark.parametrize("form", ["JPEG", "PNG", "TIFF", "WEBP", "BMP", "GIF", "PPM"])
def test_formats_are_known_by_their_contents(tmp_path: Path, form: str) -> None:
    Image.new("RGB", (7, 5)).save(tmp_path / "a.jpg", format=form)
    assert image_size(tmp_path / "a.jpg") == (7, 5)


def png_header(width: int, height: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", len(header)) + b"IHDR" + header + struct.pack(">I", zlib.crc32(b"IHDR" + header))
    return b"\x89PNG\r\n\x1a\n" + chunk + struct.pack(">I", 4) + b"IDAT"


def test_large_photos_are_read_without_a_warning(tmp_path: Path) -> None:
    """Pillow warns at 89 megapixels, and refuses 179."""
    limit = Image.MAX_IMAGE_PIXELS
    (tmp_path / "a.png").write_bytes(png_header(20_000, 20_000))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert image_size(tmp_path / "a.png") == (20_000, 20_000)
        (tmp_path / "a.png").write_bytes(png_header(20_000, 20_001))
        with pytest.raises(InputError, match=r"a\.png: has 20000x20001 px, more than 400 megapixels; replace"):
            image_size(tmp_path / "a.png")
    assert limit == Image.MAX_IMAGE_PIXELS, "the limit of other programs stays"


@pytest.mark.skipif(READS_HEIC, reason="pillow-heif is installed (test_heic.py)")
def test_heic_names_a_converter(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(struct.pack(">I", 24) + b"ftypheic" + bytes(50))
    remedy = "pip install 'clsplat[heic]', or convert it to JPEG with heif-convert"
    with pytest.raises(InputError, match=rf"a\.jpg: is a HEIC image: {re.escape(remedy)}"):
        read_image(tmp_path / "a.jpg")
