"""Both shapes learn a real scene; minutes, so only with `-m slow`, and only where the scenes are."""

from __future__ import annotations

import numpy as np
import pytest
from scenes_data import scene_folder

import clsplat
from clsplat.evaluate import evaluate

pytestmark = [pytest.mark.slow, pytest.mark.data]


@pytest.mark.parametrize("shape", ["gaussian", "skew-normal"])
def test_kitchen_is_learnt(shape: str) -> None:
    """300 iterations from SfM points: far better than the mean colour, on views never seen."""
    scene = clsplat.load_scene(scene_folder("kitchen"))
    config = clsplat.TrainConfig(shape=shape, iterations=300, cap_max=4000)
    model = clsplat.train(scene, config)
    assert len(model.splats) <= config.cap_max
    assert all(np.isfinite(array).all() for array in model.splats.to_numpy().values())
    held_out = evaluate(clsplat.Renderer(), model.splats, scene.test)
    colour = np.mean([view.image.mean((0, 1)) for view in scene.train], axis=0) / 255
    flat = [10 * np.log10(1 / np.mean((view.image / 255 - colour) ** 2)) for view in scene.test]
    assert held_out.psnr > np.mean(flat) + 3, (held_out.psnr, flat)
