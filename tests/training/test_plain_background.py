"""Photos of an object in front of one colour get that colour behind the splats; others do not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from clsplat.blocks import job
from clsplat.blocks.state import BlocksOptions
from clsplat.blocks.train import train_in_blocks
from clsplat.scenes.scene import Scene, View
from clsplat.training.config import TrainConfig
from clsplat.training.decisions import as_decided, decide
from clsplat.training.plain_background import plain_background
from clsplat.training.run import evaluate_test_views, train
from clsplat.training.trainer import Trainer

GREY = (200, 180, 160)


def framed(view: View, color: tuple[int, int, int], noise: int = 0, thick: int = 1) -> View:
    """Return a view whose photo has a frame of a colour."""
    image = np.asarray(view.image).copy()
    rng = np.random.default_rng(len(view.name))
    frame = np.clip(np.int64(color) + rng.integers(-noise, noise + 1, image.shape), 0, 255).astype(np.uint8)
    frame[thick:-thick, thick:-thick] = image[thick:-thick, thick:-thick]
    return View(view.name, view.camera, frame)


def with_frames(scene: Scene, colors: list[tuple[int, int, int] | None], noise: int = 0, thick: int = 1) -> Scene:
    views = [
        view if color is None else framed(view, color, noise, thick)
        for view, color in zip(scene.views, colors, strict=True)
    ]
    return replace(scene, views=views)


def objects(scene: Scene, color: tuple[int, int, int] = GREY) -> Scene:
    """Return the scene with photos that show something in their middle only."""
    return with_frames(scene, [color] * len(scene.views), thick=10)


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


@pytest.mark.parametrize("color", [GREY, (0, 0, 0)])
def test_objects_are_cut_out(scene: Scene, color: tuple[int, int, int]) -> None:
    decision = decide(objects(scene, color), TrainConfig(iterations=10))
    assert decision.config.cut_background
    assert decision.config.random_background
    assert decision.config.background == pytest.approx(np.array(color) / 255)
    assert "the background is cut out of the photos, because" in str(decision)
    assert decide(objects(scene, color), decision.config).config == decision.config


def test_what_is_not_cut_out(scene: Scene) -> None:
    n = len(scene.views)
    short = TrainConfig(iterations=10)
    assert not decide(scene, short).config.cut_background, "photos of a yard"
    frames = decide(with_frames(scene, [(0, 0, 0)] * n), short).config
    assert not frames.cut_background, "a frame around photos of a yard"
    assert not frames.random_background
    refused = decide(objects(scene), TrainConfig(iterations=10, cut_background=False)).config
    assert not refused.cut_background
    assert not refused.random_background
    assert refused.background == pytest.approx(np.array(GREY) / 255)
    other = decide(objects(scene), TrainConfig(iterations=10, background=(0.0, 0.0, 0.0))).config
    assert not other.cut_background, "the background that the caller named is not that of the photos"
    same = decide(objects(scene), TrainConfig(iterations=10, background=(200 / 255, 180 / 255, 160 / 255))).config
    assert same.cut_background


def test_a_named_cut_needs_no_plain_photos(scene: Scene) -> None:
    n = len(scene.views)
    some = with_frames(scene, [(0, 0, 0), None] * (n // 2), thick=10)
    assert not decide(some, TrainConfig(iterations=10)).config.cut_background
    named = decide(some, TrainConfig(iterations=10, cut_background=True)).config
    assert named.cut_background
    assert named.random_background, "the cut photos are transparent"
    assert not decide(scene, TrainConfig(iterations=10, cut_background=True)).config.random_background, "nothing is cut"


def test_a_run_learns_from_photos_that_are_cut_out(scene: Scene) -> None:
    held_out = replace(objects(scene), validation_names=frozenset([scene.train[0].name]))
    config = decide(held_out, TrainConfig(iterations=3, cap_max=50)).config
    trainer = Trainer(held_out, config)
    for view in trainer.scene.train:
        assert view.alpha is not None
        assert view.alpha[0, 0] == 0
        assert view.alpha[18, 24] == 255
    assert all(view.alpha is None for view in (*trainer.scene.test, *trainer.scene.validation))
    whole = Trainer(held_out, config.replace(cut_background=False))
    assert all(view.alpha is None for view in whole.scene.train)


def test_blocks_learn_from_photos_that_are_cut_out(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    def looked_at(scene: Scene, *rest: object) -> Scene:
        seen.extend(view.alpha is not None for view in scene.train)
        return scene

    monkeypatch.setattr(job, "with_block_targets", looked_at)
    config = TrainConfig(iterations=6, cap_max=60, sh_degree=0)
    train_in_blocks(objects(scene), BlocksOptions(2, 1), config, output=tmp_path / "model")
    assert seen
    assert all(seen)
