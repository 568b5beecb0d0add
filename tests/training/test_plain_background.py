"""Photos of an object in front of one colour get that colour behind the splats; others do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from clsplat.scenes.scene import Scene, View
from clsplat.training.config import TrainConfig
from clsplat.training.decisions import as_decided, decide
from clsplat.training.plain_background import plain_background
from clsplat.training.run import evaluate_test_views, train

GREY = (200, 180, 160)


def framed(view: View, color: tuple[int, int, int], noise: int = 0, thick: int = 1) -> View:
    """Return a view whose photo has a frame of a colour."""
    image = np.asarray(view.image).copy()
    rng = np.random.default_rng(len(view.name))
    frame = np.clip(np.int64(color) + rng.integers(-noise, noise + 1, image.shape), 0, 255).astype(np.uint8)
    frame[thick:-thick, thick:-thick] = image[thick:-thick, thick:-thick]
    return View(view.name, view.camera, frame)


def with_frames(scene: Scene, colors: list[tuple[int, int, int] | None], noise: int = 0) -> Scene:
    views = [
        view if color is None else framed(view, color, noise) for view, color in zip(scene.views, colors, strict=True)
    ]
    return replace(scene, views=views)


@pytest.mark.parametrize(("color", "noise"), [((255, 255, 255), 0), (GREY, 3)])
def test_the_colour_of_all_photos(scene: Scene, color: tuple[int, int, int], noise: int) -> None:
    found = plain_background(with_frames(scene, [color] * len(scene.views), noise).train)
    assert found == pytest.approx(np.array(color) / 255, abs=1 / 255)
    decision = decide(with_frames(scene, [color] * len(scene.views), noise), TrainConfig(iterations=10))
    assert decision.config.background == found
    assert "because all photos end in it" in str(decision)


def test_photos_that_do_not_agree(scene: Scene) -> None:
    n = len(scene.views)
    assert plain_background(scene.train) is None, "photos of a yard"
    assert plain_background(with_frames(scene, [GREY, None] * (n // 2)).train) is None
    assert plain_background(with_frames(scene, [GREY, (255, 255, 255)] * (n // 2)).train) is None
    assert plain_background(with_frames(scene, [GREY] * n, 30).train) is None, "colours differ along the sides"
    assert decide(scene, TrainConfig(iterations=10)).config.background == (0.0, 0.0, 0.0)


def test_one_photo_of_many_may_differ(scene: Scene) -> None:
    white = with_frames(scene, [(255, 255, 255)] * len(scene.views))
    many = white.train * 3
    assert plain_background([*many, scene.train[0]]) == (1.0, 1.0, 1.0)


def test_transparent_and_masked_photos_say_what_is_background(scene: Scene) -> None:
    white = with_frames(scene, [(255, 255, 255)] * len(scene.views))
    for change in ({"alpha": np.full(white.views[1].image.shape[:2], 255, np.uint8)}, {"mask": True}):
        first = white.train[0]
        mask = np.ones(first.image.shape[:2], np.bool_) if "mask" in change else None
        view = View(first.name, first.camera, first.image, mask, change.get("alpha"))  # type: ignore[arg-type]
        assert plain_background([view, *white.train[1:]]) is None


def test_a_named_background_and_a_stored_one_stay(scene: Scene) -> None:
    white = with_frames(scene, [(255, 255, 255)] * len(scene.views))
    named = TrainConfig(iterations=10, background=(0.0, 0.0, 0.0))
    assert decide(white, named).config.background == (0.0, 0.0, 0.0)
    stored = decide(white, TrainConfig(iterations=10)).config.to_json()
    assert as_decided(TrainConfig(iterations=10), stored).background == (1.0, 1.0, 1.0)


def test_the_model_is_trained_and_measured_over_it(scene: Scene) -> None:
    white = with_frames(scene, [(255, 255, 255)] * len(scene.views))
    model = train(white, TrainConfig(iterations=5, cap_max=50, sh_degree=0))
    assert model.config.background == (1.0, 1.0, 1.0)
    over_white = evaluate_test_views(model.splats, white, model.config)
    over_black = evaluate_test_views(model.splats, white, model.config.replace(background=(0.0, 0.0, 0.0)))
    assert over_white is not None
    assert over_black is not None
    assert over_white.psnr > over_black.psnr + 1
