"""Scenes with few of their photos, as if no others had been taken: the start of benchmarks with 3, 6 or 9 photos."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from ..errors import InputError
from .colmap import Points, find_model, points_of_photos
from .colmap_folder import colmap_folder
from .scene import Scene
from .scene_files import described_by

SEEN_BY = 2  # photos that a point needs: one alone gives no depth


def few_photos(scene: Scene, count: int) -> Scene:
    """Return a scene with `count` of its training views, and the points of a COLMAP model that two of them show.

    The photos are at equal steps along the sorted names, with the first and the last one (RegNeRF, Niemeyer et al.
    2022). Test views stay. Points without a COLMAP model stay as they are: nobody knows which photos show them.

    Raises
    ------
    InputError : the scene has fewer training views, or the count is not positive.
    """
    n = len(scene.train)
    if not 1 <= count <= n:
        raise InputError(f"{scene.path}: {count} photos, but it has {n} training views: choose 1 to {n}")
    steps = np.linspace(0, n - 1, count).round().astype(int)
    chosen = {scene.train[step].name for step in steps}
    views = [view for view in scene.views if view.name in chosen | scene.test_names]
    return replace(scene, views=views, points=_points(scene, chosen), validation_names=frozenset())


def _points(scene: Scene, photos: Collection[str]) -> Points:
    if described_by(scene.path) or colmap_folder(scene.path) is None:
        return scene.points
    return points_of_photos(find_model(scene.path), photos, SEEN_BY)
