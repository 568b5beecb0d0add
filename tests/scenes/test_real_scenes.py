"""Training on a real scene, for shapes and published systems. It takes minutes and needs `-m slow` and the scenes."""

from __future__ import annotations

import numpy as np
import pytest
from scenes_data import scene_folder

import clsplat
from clsplat.evaluation.evaluate import evaluate
from clsplat.scenes.scene import Scene
from clsplat.training.presets import PRESETS, preset

pytestmark = [pytest.mark.slow, pytest.mark.data]


def check_training(scene: Scene, config: clsplat.TrainConfig, gain_db: float) -> None:
    """Train and check that the cap holds, values are finite, and test views are far better than the mean colour."""
    model = clsplat.train(scene, config)
    assert 0 < len(model.splats) <= config.cap_max
    assert all(np.isfinite(array).all() for array in model.splats.to_numpy().values())
    held_out = evaluate(clsplat.Renderer(), model.splats, scene.test)
    colour = np.mean([view.image.mean((0, 1)) for view in scene.train], axis=0) / 255
    flat = [10 * np.log10(1 / np.mean((view.image / 255 - colour) ** 2)) for view in scene.test]
    assert held_out.psnr > np.mean(flat) + gain_db, (held_out.psnr, flat)


@pytest.mark.parametrize("shape", ["gaussian", "skew-normal", "generalised-exponential"])
def test_training_on_kitchen(shape: str) -> None:
    scene = clsplat.load_scene(scene_folder("kitchen"))
    check_training(scene, clsplat.TrainConfig(shape=shape, iterations=300, cap_max=4000), 3.0)


@pytest.mark.parametrize("name", PRESETS)
def test_every_published_system_learns(name: str) -> None:
    scene = clsplat.load_scene(scene_folder("fox"), resolution=4)
    check_training(scene, clsplat.TrainConfig(**preset(name) | {"iterations": 200, "cap_max": 2000}), 3.0)
