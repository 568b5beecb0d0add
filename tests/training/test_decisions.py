"""Decisions of a run: what the scene shows, what the caller named, and that commands and library decide alike."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clsplat.scenes.scene import Points, Scene
from clsplat.training.config import TrainConfig
from clsplat.training.decisions import (
    FEWEST_ITERATIONS,
    PENALTY,
    RANDOM_SHARE,
    RANDOM_SHARE_OF_FEW,
    RANDOM_START_RATES,
    Decision,
    as_decided,
    decide,
    transparent_share,
)
from clsplat.training.folder import ModelFolder
from clsplat.training.log import Progress
from clsplat.training.presets import PRESETS, preset
from clsplat.training.run import train


def without_points(scene: Scene) -> Scene:
    points = scene.points
    return replace(scene, points=Points(points.xyz[:0], points.rgb[:0], points.track_length[:0]))


def transparent(scene: Scene, share: float) -> Scene:
    """Return the scene with photos whose upper rows are transparent."""

    def alpha(height: int, width: int) -> np.ndarray:
        values = np.full((height, width), 255, np.uint8)
        values[: round(share * height)] = 0
        return values

    return replace(scene, views=[replace(view, alpha=alpha(*view.image.shape[:2])) for view in scene.views])


def test_good_points_and_opaque_photos_need_no_decision(scene: Scene) -> None:
    config = TrainConfig(cap_max=len(scene.points), random_points=0.0)
    assert decide(scene, config) == Decision(config, ())
    assert decide(scene, TrainConfig(init="model.ply")).reasons == ()
    assert decide(transparent(scene, 0.5), config).config == config.replace(random_background=True)


def test_some_points_are_random_beside_good_ones(scene: Scene) -> None:
    """A twentieth of the cap, or a tenth if the scene has fewer points. A penalty on opacity removes needless ones."""
    for cap, share in ((len(scene.points), RANDOM_SHARE), (int(len(scene.points) / RANDOM_SHARE_OF_FEW) + 9, 0.1)):
        config = TrainConfig(cap_max=cap)
        decision = decide(scene, config)
        assert decision.config == config.replace(random_points=share, opacity_reg=PENALTY)
        assert f"random points beside the scene's ({share:.0%} of the cap)" in str(decision)
    config = TrainConfig(cap_max=len(scene.points))
    assert decide(scene, config.replace(opacity_reg=0.0)).config.density.opacity_reg == 0
    named = config.replace(random_points=0.02)
    assert decide(scene, named).config == named.replace(opacity_reg=PENALTY)
    assert decide(scene, TrainConfig(init="model.ply", random_points=0.1)).reasons == ()
    by_relocation = config.replace(strategy="mcmc")
    assert decide(scene, by_relocation).config == by_relocation.replace(random_points=RANDOM_SHARE)


@pytest.mark.parametrize("options", [{"init": "random"}, {"cap_max": 1_000_000}, {}])
def test_random_starts_and_few_points(scene: Scene, options: dict[str, Any]) -> None:
    """Transparent photos get the strategy that relocates, other photos a penalty on opacity."""
    start = scene if options else without_points(scene)
    beside = {"random_points": RANDOM_SHARE_OF_FEW} if "cap_max" in options else {}
    config = TrainConfig(opacity_lr=0.07, **options)
    assert decide(start, config).config == config.replace(opacity_reg=PENALTY, **beside)
    seen = transparent(start, 0.5)
    expected = TrainConfig(opacity_lr=0.07, strategy="mcmc", random_background=True, **options, **beside)
    assert decide(seen, config).config == expected
    by_gradient = TrainConfig(strategy="adc", **options)
    assert decide(seen, by_gradient).config == by_gradient.replace(
        random_background=True, opacity_reg=PENALTY, lr_factor=RANDOM_START_RATES, **beside
    )


def test_transparent_photos_get_random_backgrounds(scene: Scene) -> None:
    seen = transparent(scene, 0.5)
    assert transparent_share(seen.train) == pytest.approx(0.5, abs=0.1)
    decision = decide(seen, TrainConfig())
    assert decision.config.random_background
    assert "% of the photos' pixels are transparent" in str(decision)
    assert not decide(seen, TrainConfig(random_background=False)).config.random_background
    assert not decide(transparent(scene, 0.0), TrainConfig()).config.random_background, "an alpha of 255 is opaque"


def test_named_options_stay(scene: Scene) -> None:
    """Options of a strategy that is not the default are kept until the strategy is known."""
    start = transparent(without_points(scene), 0.5)
    assert decide(start, TrainConfig(growth=1.2, init_scale=0.3)).config == TrainConfig(
        growth=1.2, init_scale=0.3, strategy="mcmc", random_background=True, lr_factor=2.0
    )
    named = TrainConfig(strategy="adc", random_background=False, opacity_reg=0.0, lr_factor=1.0)
    assert decide(start, named).config == named
    assert decide(start, named).reasons == ()
    assert decide(start, TrainConfig(cap_max=7).replace(strategy="adc")).config.strategy == "adc"
    complete = decide(start, TrainConfig()).config
    again = decide(scene, complete)
    assert again.config == complete, "nothing is decided twice"
    assert again.reasons == ()


@pytest.mark.parametrize("named", [{"scaling_lr": 0.01}, {"position_lr_final": 1e-6}, {"lr_factor": 1.0}], ids=str)
def test_random_starts_have_higher_rates_unless_a_rate_is_named(scene: Scene, named: dict[str, float]) -> None:
    start = without_points(scene)
    assert decide(start, TrainConfig()).config.optim.lr_factor == RANDOM_START_RATES
    assert decide(scene, TrainConfig(init="random")).config.optim.lr_factor == RANDOM_START_RATES
    assert decide(scene, TrainConfig(cap_max=len(scene.points))).config.optim.lr_factor == 1
    assert decide(start, TrainConfig(iterations=FEWEST_ITERATIONS - 1)).config.optim.lr_factor == 1
    assert decide(start, TrainConfig(**named)).config.optim == TrainConfig(**named).optim


@pytest.mark.parametrize("name", PRESETS)
def test_presets_decide_nothing(scene: Scene, name: str) -> None:
    config = TrainConfig(**preset(name))
    decision = decide(transparent(without_points(scene), 0.5), config)
    assert decision.config == config
    assert decision.reasons == ()


def test_a_run_stores_what_it_decided_and_says_it_once(scene: Scene, tmp_path: Path) -> None:
    """A resumed run keeps the decisions, also if it is longer."""
    start, messages = without_points(scene), []

    def hear(progress: Progress) -> None:
        messages.append(progress.message)

    config = TrainConfig(iterations=2, cap_max=40, sh_degree=0)
    train(start, config, hear, output=tmp_path)
    stored = ModelFolder(tmp_path).read_config()["config"]
    assert (stored["strategy"], stored["random_background"], stored["opacity_reg"]) == ("adc", False, PENALTY)
    assert sum(message.startswith("decided:") for message in messages) == 1
    messages.clear()
    # The points would decide otherwise.
    train(scene, config.replace(iterations=4), hear, output=tmp_path, resume=True)
    assert ModelFolder(tmp_path).read_config()["config"] == stored | {"iterations": 4}
    assert not any(message.startswith("decided:") for message in messages)


def test_decisions_of_a_stored_run_replace_undecided_options() -> None:
    stored = TrainConfig(strategy="mcmc", random_background=True).to_json()
    penalty = stored["opacity_reg"]
    assert as_decided(TrainConfig(), stored) == TrainConfig(strategy="mcmc", random_background=True)
    assert as_decided(TrainConfig(strategy="adc"), stored) == TrainConfig(
        strategy="adc", random_background=True, opacity_reg=penalty
    )
