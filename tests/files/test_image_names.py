"""Names of image files, and names that stand for the same photo."""

from __future__ import annotations

import pytest

from clsplat.files.image_names import bare_name, match_names


def test_bare_names_keep_dots_that_are_no_extension() -> None:
    assert [bare_name(name) for name in ("a/b.JPG", "v1.2", ".png", "a.tar.png")] == ["a/b", "v1.2", ".png", "a.tar"]


@pytest.mark.parametrize(
    ("names", "others", "matched"),
    [
        (["1.jpg", "2.jpg"], ["images/2.jpg", "images/1.png"], {"images/2.jpg": "2.jpg", "images/1.png": "1.jpg"}),
        (["a/1", "b/1"], ["x/b/1", "x/a/1"], {"x/b/1": "b/1", "x/a/1": "a/1"}),
        (["1.jpg", "1.png"], ["1.png", "1.jpg"], {"1.jpg": "1.jpg", "1.png": "1.png"}),
        (["1", "a/1"], ["1.png", "a/1.png"], {"1.png": "1", "a/1.png": "a/1"}),
        (["1.jpg", "2.jpg"], ["1.jpg"], None),
        (["1.jpg"], ["1.jpg", "2.jpg"], None),
        (["a/1", "b/1"], ["1", "2"], None),
        (["a/1", "b/2"], ["c/1", "c/2"], None),
        (["1", "2"], ["a/1", "b/1"], None),
        ([], [], {}),
    ],
)
def test_names_of_one_photo(names: list[str], others: list[str], matched: dict[str, str] | None) -> None:
    assert match_names(names, others) == matched


def test_a_name_that_fits_two_photos_is_not_guessed() -> None:
    assert match_names(["a/x.jpg", "b/x.jpg"], ["x.png", "b/x.png"]) is None
