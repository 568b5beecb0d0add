"""The photos of a run: they lie over the background that its renders have."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.scenes.scene import Scene, View
from clsplat.training.config import TrainConfig
from clsplat.training.photos import with_photos
from clsplat.training.run import train

WHITE = (1.0, 1.0, 1.0)


def with_opacity(scene: Scene, lowest: int) -> Scene:
    """Return the scene with one pixel of this opacity in each photo."""

    def changed(view: View) -> View:
        alpha = np.full(view.image.shape[:2], 255, np.uint8)
        alpha[0, 0] = lowest
        return replace(view, alpha=alpha)

    return replace(scene, views=[changed(view.loaded()) for view in scene.views])


def test_transparent_photos_must_lie_over_the_background_of_the_run(scene: Scene, tmp_path: Path) -> None:
    config = TrainConfig(iterations=5, cap_max=50, background=WHITE)
    with pytest.raises(InputError, match=r"transparent photos.*0,0,0.*1,1,1.*background=config.background"):
        train(with_opacity(scene, 254), config, output=tmp_path / "model")
    assert not (tmp_path / "model" / "config.json").exists()
    over_white = replace(with_opacity(scene, 254), background=WHITE)
    assert with_photos(over_white, config).background == WHITE
    for opaque in (scene, with_opacity(scene, 255)):
        assert with_photos(opaque, config).train
