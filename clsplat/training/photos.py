"""The photos that a run learns from."""

from __future__ import annotations

from dataclasses import replace

from ..errors import InputError
from ..scenes.cut_out import cut_out_when_read
from ..scenes.read_view import keep_photos
from ..scenes.scene import Scene
from ..splats.color import Color
from .config import TrainConfig

_OPAQUE = 255


def with_photos(scene: Scene, config: TrainConfig) -> Scene:
    """Return the scene with the training photos in memory, cut out from their background if the run has that option.

    Raises
    ------
    InputError : a photo cannot be used, or transparent photos lie over another background than that of the run.
    """
    if config.cut_background:
        photos, scene = scene.train, with_cut_outs(scene, config.background)
        for view in photos:  # its cut-out has the pixels, and gives them up when the device has them
            view.release()
    keep_photos(scene.train)
    if not config.cut_background and tuple(scene.background) != tuple(config.background):
        _check_background(scene, config.background)
    return scene


def _check_background(scene: Scene, background: Color) -> None:
    """Raise InputError if a photo is transparent: its image is composited over the background of the scene."""
    for view in scene.train:
        if view.alpha is not None and view.alpha.min() < _OPAQUE:
            raise InputError(
                f"{scene.path}: its transparent photos, such as {view.name!r}, lie over the background "
                f"{_numbers(scene.background)}, but the run has {_numbers(background)}: read the scene with "
                "background=config.background"
            )


def _numbers(color: Color) -> str:
    return ",".join(f"{part:.3g}" for part in color)


def with_cut_outs(scene: Scene, color: Color) -> Scene:
    """Return the scene with training views that are cut out from a background of this colour, each part 0 to 1."""
    trained = {view.name for view in scene.train}
    views = [cut_out_when_read(view, color) if view.name in trained else view for view in scene.views]
    return replace(scene, views=views)
