"""Splats that cover a view between the photos, and that no photo shows as large, leave the run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from looking_cameras import looking

from clsplat.cameras.between import between
from clsplat.cameras.camera import Camera
from clsplat.evaluation.contributions import shares_of_images
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene
from clsplat.splats.splats import Splats
from clsplat.training.config import TrainConfig
from clsplat.training.decisions import FEW_VIEWS, decide
from clsplat.training.occluders import CHECKS, OccluderCheck
from clsplat.training.presets import PRESETS, preset
from clsplat.training.run import train
from clsplat.training.trainer import Trainer

ROW = np.stack([np.linspace(-1.5, 1.5, 4), np.full(4, -4.0), np.zeros(4)], axis=1)  # four cameras side by side
BEFORE = np.array([0.0, 0.6, 0.0])  # in front of a camera
GAP = (ROW[1] + ROW[2]) / 2


def config_of(**options: Any) -> TrainConfig:
    values = {"iterations": 40, "cap_max": 900, "sh_degree": 1, "densify_interval": 5, "near_plane": 0.1}
    return TrainConfig(**{**values, "occluder_check": True, "strategy": "adc", **options})


def wall_and(*more: tuple[np.ndarray, float, float]) -> Splats:
    """A wall of splats at y = 0, and more splats, each with place, standard deviation and opacity."""
    x, z = (axis.ravel() for axis in np.meshgrid(np.linspace(-3, 3, 25), np.linspace(-2, 2, 17)))
    place = np.vstack([np.stack([x, np.zeros_like(x), z], axis=1), *(at[None] for at, _, _ in more)])
    size = np.concatenate([np.full(len(x), 0.15), [deviation for _, deviation, _ in more]])
    opacity = np.concatenate([np.full(len(x), 0.9), [alpha for _, _, alpha in more]])
    n = len(place)
    return Splats(
        "gaussian",
        {
            "mean": place,
            "quat": np.tile([1.0, 0, 0, 0], (n, 1)),
            "log_scale": np.tile(np.log(size)[:, None], (1, 3)),
            "opacity_logit": np.log(opacity / (1 - opacity)),
            "sh": np.zeros((n, 1, 3)),
        },
    )


def check_of(scene: Scene, **options: Any) -> OccluderCheck:
    trainer = Trainer(scene, config_of(**options))
    check = trainer.occluders
    check.photos = looking(ROW, np.zeros(3))
    check.between = between(check.photos)
    return check


def test_the_weight_of_a_splat_is_its_share_of_the_image() -> None:
    camera = Camera(40, 30, 30, 30, 20, 15, np.eye(4))
    front = Splats(
        "gaussian",
        {
            "mean": np.array([[0, 0, 2.0], [0, 0, 4.0]]),
            "quat": np.tile([1.0, 0, 0, 0], (2, 1)),
            "log_scale": np.full((2, 3), np.log(100.0)),  # both fill the image
            "opacity_logit": np.log([0.6 / 0.4, 0.5 / 0.5]),
            "sh": np.zeros((2, 1, 3)),
        },
    )
    (shares,) = shares_of_images(Renderer(), front, [camera])
    np.testing.assert_allclose(shares, [0.6, 0.4 * 0.5], rtol=0.02)


def test_a_splat_between_the_photos_goes(scene: Scene) -> None:
    splats = wall_and((GAP + BEFORE, 0.08, 0.95))  # at the edge of the photos
    found = check_of(scene).occluders(splats)
    assert np.flatnonzero(found).tolist() == [len(splats) - 1]


def test_what_a_photo_shows_as_large_stays(scene: Scene) -> None:
    assert not check_of(scene).occluders(wall_and((ROW[1] + BEFORE, 0.08, 0.95))).any()


def test_small_and_faint_splats_stay(scene: Scene) -> None:
    splats = wall_and((GAP + BEFORE, 0.003, 0.3), (GAP + BEFORE, 0.08, 0.005))
    assert not check_of(scene).occluders(splats).any()


def test_a_run_removes_it_and_keeps_the_statistics(scene: Scene) -> None:
    trainer = Trainer(scene, config_of(densify_interval=1000, iterations=400))
    for _ in range(3):
        trainer.step()
    n = trainer.splats.n
    before, statistics = trainer.snapshot(), trainer.pipeline.statistics.read(n)
    gone = np.zeros(n, bool)
    gone[[2, 5]] = True
    trainer.occluders.occluders = lambda _: gone  # type: ignore[method-assign]
    trainer.occluders.remove(before)
    assert trainer.splats.n == n - 2
    np.testing.assert_array_equal(trainer.snapshot().mean, before.mean[~gone])
    np.testing.assert_array_equal(trainer.pipeline.statistics.read(n - 2), statistics[:, ~gone])
    trainer.step()


def test_splats_that_are_not_finite_wait_for_the_densification(scene: Scene) -> None:
    trainer = Trainer(scene, config_of())
    splats = trainer.snapshot().select(np.arange(trainer.splats.n - 1))
    trainer.occluders.occluders = lambda _: np.arange(len(splats)) < 3  # type: ignore[method-assign]
    trainer.occluders.remove(splats)
    assert trainer.splats.n == len(splats) + 1


@pytest.mark.parametrize("strategy", ["adc", "mcmc"])
def test_checks_come_after_each_tenth_but_the_last(
    scene: Scene, strategy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []
    trainer = Trainer(scene, config_of(strategy=strategy, average_last=0))
    monkeypatch.setattr(OccluderCheck, "remove", lambda self, splats: seen.append(trainer.iteration))
    while trainer.iteration < 40:
        trainer.step()
    assert seen == [4 * tenth for tenth in range(1, CHECKS)]


def test_no_check_once_the_mean_has_begun(scene: Scene) -> None:
    trainer = Trainer(scene, config_of(average_last=0.4, densify_until=0.3))
    assert [it for it in range(1, 41) if trainer.occluders.is_due(it)] == [4, 8, 12, 16, 20, 24]


def test_a_resumed_run_has_the_same_bits(scene: Scene, tmp_path: Path) -> None:
    def stops(trainer: Trainer, stop: Any) -> None:
        if trainer.iteration == 18:
            stop.set()

    whole = train(scene, config_of())
    folder = tmp_path / "model"
    train(scene, config_of(), output=folder, visit=stops)
    resumed = train(scene, config_of(), output=folder, resume=True)
    for name, array in whole.splats.arrays.items():
        assert array.tobytes() == resumed.splats.arrays[name].tobytes(), name


def test_runs_of_few_photos_check_and_presets_do_not(scene: Scene) -> None:
    assert len(scene.train) <= FEW_VIEWS
    assert decide(scene, TrainConfig()).config.views.occluder_check
    assert not decide(scene, TrainConfig(occluder_check=False)).config.views.occluder_check
    for name in PRESETS:
        assert not decide(scene, TrainConfig(**preset(name))).config.views.occluder_check, name
