"""Validation views, held out from the training views. Nothing else may be used to choose between models."""

from __future__ import annotations

from dataclasses import replace

from ..errors import InputError, Remedy
from .scene import Scene

STRIDE = 7  # hold out every 7th training view, or every 3rd, ... of a scene with few views
MIN_TRAIN_VIEWS = 3  # smallest number of training views that can be split: one to validate, two to train


def hold_out(scene: Scene) -> Scene:
    """Return the scene without its test views, and with every 7th training view as a test view instead.

    A scene with fewer than 21 training views has a smaller stride, so that three views are held out if possible. The
    first view is never held out: cameras often follow a path, and its end sees things that no other view sees.

    Raises
    ------
    InputError : the scene has fewer than three training views.
    """
    test_names = _every_few(scene, Remedy("choose the number of splats yourself", "--cap-max"))
    return replace(scene, views=scene.train, test_names=test_names, validation_names=frozenset())


def with_validation(scene: Scene) -> Scene:
    """Return the scene with the views as validation views that `hold_out` chooses. Its test views stay.

    Raises
    ------
    InputError : the scene has fewer than three training views.
    """
    return replace(scene, validation_names=_every_few(scene, Remedy("train without validation views")))


def split_for_run(scene: Scene, validate: bool) -> Scene:
    """Return the scene of a run. With `validate` it has validation views; those that it has already stay.

    Raises
    ------
    InputError : the scene has fewer than three training views.
    """
    return with_validation(scene) if validate and not scene.validation_names else scene


def _every_few(scene: Scene, without: Remedy) -> frozenset[str]:
    """Return the names of the training views that are held out. without : what to do if they are too few."""
    views = scene.train
    if len(views) < MIN_TRAIN_VIEWS:
        raise InputError(
            f"{scene.path}: has {len(views)} training views; at least {MIN_TRAIN_VIEWS} are needed to hold one out",
            Remedy("add photos"),
            without,
        )
    stride = max(2, min(STRIDE, len(views) // MIN_TRAIN_VIEWS))
    return frozenset(view.name for view in views[stride // 2 :: stride])
