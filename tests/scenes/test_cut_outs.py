"""Transparent parts of some photos, while others are opaque: they are cut-outs, and no background of an object."""

from __future__ import annotations

import shutil
import warnings
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded_scenes import scene_and_warnings

from clsplat.files.images import read_image, write_png
from clsplat.scenes.colmap import Points
from clsplat.scenes.posed_images import PosedImages
from clsplat.scenes.read_view import PhotoReader
from clsplat.scenes.scene import load_scene, read_posed_images
from clsplat.scenes.view import View
from clsplat.scenes.without_data import use_of_alpha
from clsplat.splats.color import BLACK

N, ROWS = 10, 12  # photos, and their first rows that are transparent, of 36
MESSAGE = "3 of 10 photos have transparent parts (33% of their pixels), and the others are opaque: they are left out"


@pytest.fixture
def cut(capture_folder: Path, tmp_path: Path) -> Callable[..., Path]:
    """Return a function that returns a copy of the small capture whose first photos are transparent above."""

    def copy(n_cut: int, without_channel: Collection[int] = (), rows: int = ROWS) -> Path:
        """Photos with a number in `without_channel` are stored without an opacity."""
        folder = tmp_path / "cut"
        shutil.copytree(capture_folder, folder)
        files = sorted((folder / "images").iterdir())
        assert len(files) == N
        for number, file in enumerate(files):
            pixels = read_image(file)[..., :3]
            alpha = np.full(pixels.shape[:2], 255, np.uint8)
            alpha[: rows if number < n_cut else 0] = 0
            write_png(file, pixels if number in without_channel else np.dstack([pixels, alpha]))
        return folder

    return copy


def posed_without_points_above(folder: Path) -> PosedImages:
    """Return the photos and the points of a scene, drawn together to their middle."""
    posed = read_posed_images(folder, None)
    xyz = posed.points.xyz
    middle = np.median(xyz, axis=0)
    return replace(posed, points=replace(posed.points, xyz=middle + 0.01 * (xyz - middle)))


@pytest.mark.parametrize("without_channel", [range(3, N), ()], ids=["jpeg", "opaque"])
def test_cut_outs_of_some_photos_are_left_out(cut: Callable[..., Path], without_channel: Collection[int]) -> None:
    """An opaque photo counts as one without transparency, whatever its file can hold."""
    folder = cut(3, without_channel)
    scene, said = scene_and_warnings(folder)
    assert MESSAGE in said
    assert said.endswith('(alpha "mask"); with alpha "background" they are the background of an object')
    assert scene.reading["alpha"] == "mask"
    for number, view in enumerate(scene.views):
        photo = view.loaded()
        assert photo.alpha is None
        if number >= 3:
            assert photo.mask is None
        else:
            assert photo.mask is not None
            assert not photo.mask[:ROWS].any()
            assert photo.mask[ROWS:].all()
    for alpha in ("mask", "background"):
        assert scene_and_warnings(folder, alpha=alpha)[1] == ""


def test_opaque_photos_that_could_be_transparent_are_opaque(cut: Callable[..., Path]) -> None:
    scene, said = scene_and_warnings(cut(0))
    assert (scene.reading["alpha"], said) == ("background", "")


def test_an_object_may_fill_one_of_its_photos(cut: Callable[..., Path]) -> None:
    scene, said = scene_and_warnings(cut(N - 1, [N - 1]))
    assert (scene.reading["alpha"], said) == ("background", "")


def test_without_points_most_photos_decide(cut: Callable[..., Path]) -> None:
    for n_cut, use in ((4, "mask"), (5, "background")):
        folder = cut(n_cut, range(n_cut, N))
        nothing = Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, np.int64))
        posed = replace(read_posed_images(folder, None), points=nothing)
        if use == "mask":
            with pytest.warns(UserWarning, match="4 of 10 photos have transparent parts"):
                assert use_of_alpha(folder, posed, -1, BLACK).use == use
        else:
            assert use_of_alpha(folder, posed, -1, BLACK).use == use
        shutil.rmtree(folder)


def test_a_sky_that_was_cut_out_is_a_background(cut: Callable[..., Path]) -> None:
    """No points lie there. Some photos may show no sky."""
    folder = cut(4, range(4, N), rows=4)
    assert use_of_alpha(folder, posed_without_points_above(folder), -1, BLACK).use == "background"
    with pytest.warns(UserWarning, match="4 of 10 photos have transparent parts"):
        assert use_of_alpha(folder, read_posed_images(folder, None), -1, BLACK).use == "mask"


@pytest.mark.parametrize("n_cut", [0, 3, N], ids=["opaque", "some", "all"])
@pytest.mark.parametrize("read_photos", [True, False])
def test_photos_are_decoded_once_to_see_what_transparency_means(
    cut: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, n_cut: int, read_photos: bool
) -> None:
    """Rims and cut-outs are looked for in the same pixels. Photos over the background are not decoded again.

    A part that is cut out of all photos is a rim.
    """
    folder, decoded, read = cut(n_cut), list[str](), PhotoReader.read

    def counted(self: PhotoReader, *arguments: Callable[..., None]) -> View | str:
        decoded.append(self.photo.name)
        return read(self, *arguments)

    monkeypatch.setattr(PhotoReader, "read", counted)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = load_scene(folder, read_photos=read_photos, eval=False)
    is_mask = scene.reading["alpha"] == "mask"
    assert is_mask == (n_cut > 0)
    assert Counter(decoded) == Counter(scene.names * (1 + is_mask))
    known = load_scene(folder, alpha=scene.reading["alpha"], eval=False)
    for view, other in zip(scene.views, known.views, strict=True):
        np.testing.assert_array_equal(view.image, other.image)
        np.testing.assert_array_equal(view.mask, other.mask)
        np.testing.assert_array_equal(view.alpha, other.alpha)


def test_views_are_returned_only_if_they_are_kept(cut: Callable[..., Path]) -> None:
    folder = cut(0)
    posed = read_posed_images(folder, None)
    names = [photo.name for photo in posed.photos]
    assert use_of_alpha(folder, posed, -1, BLACK).decoded == {}
    assert list(use_of_alpha(folder, posed, -1, BLACK, names[2:4]).decoded) == names[2:4]
