"""The photos that a run learns from."""

from __future__ import annotations

from dataclasses import replace

from ..scenes.cut_out import cut_out_when_read
from ..scenes.read_view import keep_photos
from ..scenes.scene import Scene
from ..splats.color import Color
from .config import TrainConfig


def with_photos(scene: Scene, config: TrainConfig) -> Scene:
    """Return the scene with the training photos in memory, cut out from their background if the run has that option.

    Raises
    ------
    InputError : a photo cannot be used.
    """
    if config.cut_background:
        scene = with_cut_outs(scene, config.background)
    keep_photos(scene.train)
    return scene


def with_cut_outs(scene: Scene, color: Color) -> Scene:
    """Return the scene with training views that are cut out from a background of this colour, each part 0 to 1."""
    trained = {view.name for view in scene.train}
    views = [cut_out_when_read(view, color) if view.name in trained else view for view in scene.views]
    return replace(scene, views=views)
