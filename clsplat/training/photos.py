"""The photos that a run learns from."""

from __future__ import annotations

from ..scenes.cut_out import with_cut_outs
from ..scenes.read_view import keep_photos
from ..scenes.scene import Scene
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
