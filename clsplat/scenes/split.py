"""Views held out of the training set: all that may be looked at when something is chosen."""

from __future__ import annotations

from dataclasses import replace

from ..errors import InputError
from .scene import Scene

EVERY = 7  # of the training views, one is held out, but three where there are as many
FEWEST = 3  # training views: one to judge by, two to learn from


def hold_out(scene: Scene) -> Scene:
    """The scene without its test views, and every 7th training view held out in their place (of few: every third).

    The first view is kept: cameras often walk a path, and its ends see what no other view sees.

    Raises
    ------
    InputError : fewer than three training views.
    """
    views = scene.train
    if len(views) < FEWEST:
        raise InputError(
            f"{scene.path}: has {len(views)} training views; at least {FEWEST} are needed to hold one "
            "out: add photos, or choose the number of splats yourself (--cap-max)"
        )
    every = max(2, min(EVERY, len(views) // FEWEST))
    held_out = views[every // 2 :: every]
    return replace(scene, views=views, test_names=frozenset(view.name for view in held_out))
