"""Photos with other names than in the model: another suffix, or, if reduced, numbers as in LLFF's scenes."""

from __future__ import annotations

from pathlib import Path

import pytest

from clsplat.scenes.reduced_photos import with_reduced_photos


def made(folder: Path, *names: str) -> Path:
    folder.mkdir()
    for name in names:
        (folder / name).write_bytes(b"")
    return folder


def paired(folder: Path, *names: str) -> dict[str, str]:
    found = with_reduced_photos(folder, {name: folder / name for name in names})
    return {name: file.name for name, file in found.items()}


@pytest.mark.parametrize("name", ["images_4", "images", "cut out"])
def test_another_suffix(tmp_path: Path, name: str) -> None:
    folder = made(tmp_path / name, "a.png", "b.JPG", "c.png", "c.jpg", "d.1.png", "e.png")
    assert paired(folder, "a.JPG", "b.JPG", "c.bmp", "d.1", "e.jpg", "e.png") == {
        "a.JPG": "a.png",
        "b.JPG": "b.JPG",
        "c.bmp": "c.bmp",  # two others have its name
        "d.1": "d.1.png",
        "e.jpg": "e.jpg",  # the other one is another photo of the model
        "e.png": "e.png",
    }


def test_numbers_in_the_order_of_the_photos(tmp_path: Path) -> None:
    folder = made(tmp_path / "images_8", "image000.png", "image001.png", "image002.png", "notes.txt")
    expected = {"IMG_7.JPG": "image000.png", "IMG_8.JPG": "image001.png", "IMG_9.JPG": "image002.png"}
    assert paired(folder, *reversed(expected)) == expected
    # The photos beside count, not those of the model, which may lack one.
    made(tmp_path / "images", *expected)
    assert paired(folder, "IMG_9.JPG", "IMG_7.JPG") == {"IMG_9.JPG": "image002.png", "IMG_7.JPG": "image000.png"}


@pytest.mark.parametrize(
    ("name", "there"),
    [("images_4", ["image000.png"]), ("images_4", ["a.jpg", "image001.png"]), ("photos", ["x.png", "y.png"])],
)
def test_nothing_is_guessed(tmp_path: Path, name: str, there: list[str]) -> None:
    """Another number of photos, a name that fits, or a folder with another name."""
    folder = made(tmp_path / name, *there)
    assert paired(folder, "a.jpg", "b.jpg") == {"a.jpg": "a.jpg", "b.jpg": "b.jpg"}
