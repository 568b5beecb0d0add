"""Running means of loss and PSNR: their weights, and the values that the display gets."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

import clsplat
from clsplat.scenes.scene import Scene
from clsplat.training.log import Progress
from clsplat.training.running_mean import WINDOW, RunningLoss


def weighted_means(values: list[float], window: int) -> list[float]:
    """The means by their definition: weights that fall by one factor with age, divided by their sum."""
    factor, means = (window - 1) / (window + 1), []
    for n in range(1, len(values) + 1):
        weights = factor ** np.arange(n)[::-1]
        means.append(float(np.average(values[:n], weights=weights)))
    return means


@pytest.mark.parametrize("views", [1, 2, 30, 100, 5000])
def test_the_mean_is_that_of_the_last_views(views: int) -> None:
    values = np.random.default_rng(0).normal(20, 3, 300).tolist()
    running, found = RunningLoss(views), []
    assert all(math.isnan(value) for value in running.means())
    for value in values:
        running.add(value / 100, value)
        loss, psnr = running.means()
        found.append(psnr)
        assert loss == pytest.approx(psnr / 100)
    np.testing.assert_allclose(found, weighted_means(values, min(views, 100)), rtol=1e-9)
    assert WINDOW == 100


def test_a_scene_of_different_views_has_a_steady_mean() -> None:
    """Two views of 10 and 30 dB in turn: the display must not jump between them."""
    running, found = RunningLoss(100), []
    for i in range(200):
        running.add(0.1, 10 + 20 * (i % 2))
        found.append(running.means()[1])
    assert np.ptp(found[100:]) < 1
    assert np.mean(found[100:]) == pytest.approx(20, abs=0.1)


def test_the_display_shows_means_and_the_log_single_views(scene: Scene, tmp_path: Path) -> None:
    from clsplat.training.decisions import decide
    from clsplat.training.trainer import Trainer

    shown: list[Progress] = []
    config = clsplat.TrainConfig(iterations=100, cap_max=300, sh_degree=1)
    clsplat.train(scene, config, shown.append, output=tmp_path / "model")
    trainer, losses, psnrs = Trainer(scene, decide(scene, config).config), [], []
    for _ in range(100):
        trainer.step()
        value = trainer.loss.value(trainer.loss_result)
        losses.append(value.total)
        psnrs.append(value.psnr)
    window, last = min(len(scene.train), WINDOW), [p for p in shown if not p.message and p.iteration in (50, 100)]
    assert [p.iteration for p in last] == [50, 100]
    for progress in last:
        n = progress.iteration
        assert progress.loss == pytest.approx(weighted_means(losses[:n], window)[-1], rel=1e-6)
        assert progress.psnr == pytest.approx(weighted_means(psnrs[:n], window)[-1], rel=1e-6)
    lines = [json.loads(line) for line in (tmp_path / "model" / "log.jsonl").read_text().splitlines()]
    assert [line["psnr"] for line in lines if "psnr" in line] == pytest.approx([psnrs[49], psnrs[99]])
