"""The background of photos is cut out: against discs whose opacity is known, and with photos that are decoded late."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import cast

import numpy as np
import pytest
from PIL import Image

from clsplat.cameras.camera import Camera
from clsplat.scenes.cut_out import cut_out
from clsplat.scenes.scene import Scene, View
from clsplat.scenes.view import StoredView
from clsplat.splats.color import SPREAD
from clsplat.splats.fields import DoubleArray
from clsplat.training.photos import with_cut_outs

SIDE = 96
WHITE, BLACK, GREEN = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.8, 0.2)


def disc(center: tuple[float, float], radius: float) -> DoubleArray:
    """Return the share of each pixel that a disc covers, by 8 x 8 samples."""
    at = (np.arange(8 * SIDE) + 0.5) / 8
    inside = (at[:, None] - center[1]) ** 2 + (at[None, :] - center[0]) ** 2 <= radius**2
    share: DoubleArray = inside.reshape(SIDE, 8, SIDE, 8).mean(axis=(1, 3))
    return share


def texture() -> DoubleArray:
    """Return colours (SIDE, SIDE, 3) of an object: smooth, and far from white, black and green."""
    y, x = np.mgrid[:SIDE, :SIDE] / SIDE
    return np.stack([150 + 40 * x, 90 + 30 * y, 120 + 30 * np.sin(6 * x)], axis=2)


def view_of(pixels: DoubleArray, name: str = "a.png") -> View:
    camera = Camera(SIDE, SIDE, 90.0, 90.0, SIDE / 2, SIDE / 2, np.eye(4))
    return View(name, camera, np.rint(np.clip(pixels, 0, 255)).astype(np.uint8))


def over(color: tuple[float, float, float], alpha: DoubleArray, pixels: DoubleArray) -> DoubleArray:
    return alpha[..., None] * pixels + (1 - alpha[..., None]) * 255 * np.array(color)


def opacity(view: View, color: tuple[float, float, float]) -> DoubleArray:
    alpha = cut_out(view, color).alpha
    assert alpha is not None
    return alpha / 255.0


@pytest.mark.parametrize("color", [WHITE, BLACK, GREEN])
def test_a_ring_has_the_opacity_that_it_was_drawn_with(color: tuple[float, float, float]) -> None:
    alpha = disc((50.3, 44.8), 30.0) * (1 - disc((55.0, 48.0), 9.5))
    found = opacity(view_of(over(color, alpha, texture())), color)
    assert np.all(found[alpha == 0] == 0), "outside, and in the hole"
    assert np.all(found[disc((50.3, 44.8), 28.0) * (1 - disc((55.0, 48.0), 11.5)) == 1] == 1), "inside"
    mixed = (alpha > 0.05) & (alpha < 0.95)
    assert mixed.sum() > 100
    assert np.abs(found - alpha)[mixed].max() < 0.12
    assert np.abs(found - alpha)[mixed].mean() < 0.03


def test_noise_of_the_background_is_cut_out() -> None:
    alpha, rng = disc((48.0, 48.0), 25.0), np.random.default_rng(0)
    pixels = over((0.8, 0.8, 0.8), alpha, texture()) + rng.integers(-3, 4, (SIDE, SIDE, 3))
    assert np.all(opacity(view_of(pixels), (0.8, 0.8, 0.8))[alpha == 0] == 0)


@pytest.mark.parametrize("quality", [75, 90])
def test_traces_of_jpeg_are_cut_out(quality: int) -> None:
    alpha = disc((50.3, 44.8), 30.0) * (1 - disc((55.0, 48.0), 9.5))
    image = np.asarray(view_of(over(WHITE, alpha, texture())).image)
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=quality)
    photo = np.array(Image.open(file))
    assert np.count_nonzero(np.abs(photo.astype(int) - 255).max(axis=2)[alpha == 0] > SPREAD) > 100, "traces"
    found = opacity(replace(view_of(texture()), image=photo), WHITE)
    assert np.mean(found[alpha == 0] == 0) > 0.97
    assert np.abs(found - alpha).mean() < 0.02


def test_a_pale_object_without_noise_stays() -> None:
    """Its colours are within the noise of JPEG files, but this photo does not have any."""
    alpha = disc((48.0, 48.0), 30.0)
    pale = np.full((SIDE, SIDE, 3), 247.0)
    assert np.all(opacity(view_of(over(WHITE, alpha, pale)), WHITE)[alpha == 1] == 1)


def test_a_highlight_that_fades_stays() -> None:
    """A spot within the object reaches white, and its surroundings are nearly white: it is not a hole."""
    y, x = np.mgrid[:SIDE, :SIDE]
    glow = np.exp(-((x - 48) ** 2 + (y - 48) ** 2) / 500.0)[..., None]
    pixels = texture() * (1 - glow) + 255 * np.minimum(1.3 * glow, 1.0)
    alpha = disc((48.0, 48.0), 40.0)
    view = view_of(over(WHITE, alpha, pixels))
    assert (np.asarray(view.image) == 255).all(axis=2)[40:56, 40:56].sum() > 50, "the spot is white"
    assert np.all(opacity(view, WHITE)[20:76, 20:76] == 1)


def test_an_object_like_its_background_keeps_opaque_sides() -> None:
    """A mixture looks like the object here, so no pixel beside the cut becomes transparent."""
    alpha = disc((48.0, 48.0), 30.0)
    pale = np.full((SIDE, SIDE, 3), 240.0)
    found = opacity(view_of(over(WHITE, alpha, pale)), WHITE)
    assert set(np.unique(found)) == {0.0, 1.0}
    assert np.all(found[alpha == 1] == 1)


def test_single_pixels_of_the_colour_stay() -> None:
    pixels = texture()
    pixels[40, 40] = 255
    found = opacity(view_of(over(WHITE, disc((48.0, 48.0), 30.0), pixels)), WHITE)
    assert found[40, 40] == 1


def test_a_photo_without_the_colour_stays_opaque() -> None:
    assert np.all(opacity(view_of(texture()), WHITE) == 1)


@pytest.mark.parametrize(
    "change", [{"alpha": np.full((SIDE, SIDE), 9, np.uint8)}, {"mask": np.ones((SIDE, SIDE), bool)}]
)
def test_transparent_and_masked_photos_stay(change: dict[str, np.ndarray]) -> None:
    view = replace(view_of(np.full((SIDE, SIDE, 3), 255.0)), **change)
    assert cut_out(view, WHITE) is view


def scene_of(views: list[View], scene: Scene, **fields: frozenset[str]) -> Scene:
    return replace(scene, views=views, test_names=frozenset(), **fields)


def test_only_training_views_are_cut_out(scene: Scene) -> None:
    photo = over(WHITE, disc((48.0, 48.0), 30.0), texture())
    views = [view_of(photo, name) for name in ("a", "b", "c")]
    whole = replace(scene, views=views, test_names=frozenset("a"), validation_names=frozenset("b"))
    cut = with_cut_outs(whole, WHITE)
    assert [view.alpha is None for view in cut.views] == [True, True, False]
    assert cut.views[0] is views[0]
    assert all(np.array_equal(one.image, other.image) for one, other in zip(cut.views, views, strict=True))


def test_photos_that_are_not_in_memory_are_cut_out_when_they_are_decoded(scene: Scene) -> None:
    photo, decoded = view_of(over(WHITE, disc((48.0, 48.0), 30.0), texture())), []

    def read() -> View:
        decoded.append(photo.name)
        return photo

    stored = StoredView(photo.name, photo.camera, read, decoding_bytes=10, may_hide_pixels=False)
    (cut,) = with_cut_outs(scene_of([stored], scene), WHITE).views
    late = cast(StoredView, cut)
    assert decoded == []
    assert not late.may_hide_pixels
    assert late.decoding_bytes > 10
    expected = cut_out(photo, WHITE).alpha
    assert np.array_equal(cast(np.ndarray, late.loaded().alpha), cast(np.ndarray, expected))
    late.keep()
    assert late.loaded() is late.loaded()
    late.release()
    assert not late.is_kept
    assert len(decoded) == 2
    stored.keep()
    (kept,) = with_cut_outs(scene_of([stored], scene), WHITE).views
    assert cast(StoredView, kept).is_kept
